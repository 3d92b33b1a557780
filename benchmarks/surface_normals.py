"""Lit images of surfaces with and without normal maps, against those of the fine surface they come from.

    python benchmarks/surface_normals.py --data ../shared/data --views 24 --rounds 1 playbot guitar

The fine surface has all triangles that the voxels give, without a fit to images; the light one is made of it,
by default options but for the number of images. Both are plaster: white, rough, lit from three sides. Where
both are in the image, the light one's plaster, with smooth normals and with the normal map, is compared with
the fine one's, in 400 pixels at middle distance: mean square errors in dB, and mean angles of the normals.
Megabytes are what the map and its tangents add to the .glb.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from _common import DATA, PHOTOGRAPHED, SCENES, Report, arguments

import meshsplats as ms
from meshsplats._common.geometry import vertex_normals
from meshsplats.formats.surfaces.tangents import corner_frames, unit
from meshsplats.rendering.backward import TapedRendering, TapeOptions
from meshsplats.scene.base_mesh import BaseMesh, Texture
from meshsplats.scene.mesh import Triangles

LIGHTS = np.array([(1, 1, 1), (-1, 0.3, 0.5), (0.2, -0.5, -1.0)])
STRENGTHS = np.array([0.7, 0.35, 0.25])
AMBIENT = 0.1


def corners(base: BaseMesh, camera: ms.Camera, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Images (h, w, k) of values (f, 3, k) of corners, and where they are (h, w)."""
    count = len(base.faces)
    places = base.vertices[base.faces].reshape(-1, 3)
    indices = np.arange(3 * count, dtype=np.int32).reshape(-1, 3)
    black = np.tile(np.array([0, 0, 0, 1], np.float32), (3 * count, 1))
    camera = camera.with_near_plane(base.vertices)
    parts = []
    for first in range(0, values.shape[2], 4):
        some = np.ascontiguousarray(values[..., first : first + 4].reshape(3 * count, -1), np.float32)
        triangles = Triangles(places, indices, black, values=some)
        image = TapedRendering(triangles, camera, TapeOptions(background=(0, 0, 0)), tape_bytes=None)
        parts.append(image.attributes)
    return np.concatenate(parts, axis=2), image.alpha > 0.5


def smooth_normals(base: BaseMesh, camera: ms.Camera) -> tuple[np.ndarray, np.ndarray]:
    found, shown = corners(base, camera, vertex_normals(base.vertices, base.faces)[base.faces])
    return unit(found), shown


def mapped_normals(base: BaseMesh, camera: ms.Camera) -> np.ndarray:
    """Normals as a shader computes them from the map."""
    assert base.uv is not None
    assert base.normal_map is not None
    frames = corner_frames(base.vertices, base.faces, base.uv)
    signs = frames.signs[..., None]
    found, _ = corners(
        base, camera, np.concatenate([frames.normals, frames.tangents, signs, base.uv], axis=2)
    )
    normal, tangent, sign, uv = np.split(found, (3, 6, 7), axis=2)
    rgba = np.concatenate([base.normal_map, np.full_like(base.normal_map[..., :1], 255)], axis=2)
    x, y, z, _ = np.moveaxis(2 * Texture(rgba, ("clamp", "clamp")).at(uv.reshape(-1, 2)) - 1, 1, 0)
    x, y, z = (a.reshape(*uv.shape[:2], 1) for a in (x, y, z))
    return unit(x * tangent + y * sign * np.cross(normal, tangent) + z * normal)


def plaster(normals: np.ndarray) -> np.ndarray:
    return AMBIENT + np.maximum(normals @ unit(LIGHTS).T, 0) @ STRENGTHS


def compared(pairs: list[tuple[np.ndarray, np.ndarray]]) -> tuple[str, str]:
    """dB of the plaster and mean angle in degrees, of normals (k, 3) and true ones."""
    errors = np.concatenate([plaster(one) - plaster(true) for one, true in pairs])
    cosines = np.concatenate([(one * true).sum(axis=1) for one, true in pairs])
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return f"{-10 * np.log10(np.square(errors).mean()):.2f}", f"{angles.mean():.1f}"


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("scenes", nargs="+", choices=[*SCENES, *PHOTOGRAPHED])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--faces", type=int, default=20_000)
    parser.add_argument("--views", type=int, default=64)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    with Report(options) as report, tempfile.TemporaryDirectory() as folder:
        report.table(*("scene", "triangles", "fine", "smooth dB", "degrees", "map dB", "degrees", "MB"))
        for name in options.scenes:
            scene = SCENES.get(name) or PHOTOGRAPHED[name]
            cloud = scene.cloud(options.data)
            how = {"sh_degree": 0, "threads": options.threads, "views": options.views}
            fine = ms.make_surface(cloud, faces=0, texture=0, rounds=0, **how)
            light = ms.make_surface(cloud, faces=options.faces, rounds=options.rounds, **how)
            sizes = []
            for base in (replace(light, normal_map=None), light):
                ms.save_base(base, Path(folder) / "surface.glb")
                sizes.append((Path(folder) / "surface.glb").stat().st_size / 1e6)
            smooth, mapped = [], []
            for camera in scene.cameras(options.data, "mid"):
                true, behind = smooth_normals(fine, camera)
                own, before = smooth_normals(light, camera)
                both = behind & before
                smooth.append((own[both], true[both]))
                mapped.append((mapped_normals(light, camera)[both], true[both]))
            counts = (f"{len(base.faces):,}" for base in (light, fine))
            added = f"{sizes[1] - sizes[0]:.1f}"
            report.row(name, *counts, *compared(smooth), *compared(mapped), added)


if __name__ == "__main__":
    main()
