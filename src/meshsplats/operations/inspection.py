"""What a file or folder is and holds: splats, a mesh, a tileset, levels of detail, cameras, a data set."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.json_files import read_json
from meshsplats._common.kinds import as_path
from meshsplats.cameras.camera_path import is_camera_path
from meshsplats.cameras.files import load_cameras
from meshsplats.cameras.framing import Bounds, guess_up, scene_bounds, warn_of_strays_in, warn_of_unseen
from meshsplats.datasets.colmap import count_points
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.layouts import Layout, find_layout
from meshsplats.datasets.photo_file import PhotoFile
from meshsplats.errors import FileFormatError
from meshsplats.evaluation.level_tables import find_table, load_table, table_in_words
from meshsplats.formats.gaussians import format_of, load_gaussians, moving_splats
from meshsplats.formats.gltf.reader import listed_nodes
from meshsplats.formats.meshes import load_mesh
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_paths import splat_file
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import LEAST_OPACITY, GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.scene.origin import choose_origin
from meshsplats.tiles import is_tileset
from meshsplats.viewpoints.beside import cameras_beside

SAMPLE = 4000
"""Number of splats that are converted to estimate the size of the mesh."""

_OF_TABLE = ("look", "samples", "levels")
"""Findings about levels of detail that their table has in its lines."""
HARMONICS_DRAWN_BY = "meshsplats, its page, Blender unlit; three.js and engines by shaders of docs/viewers.md"
PLAIN = "plain colours, the mean of views"
BASE = "the part of degree 0"


def describe(path: str | os.PathLike[str], reading: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Findings about ``path``, ready for JSON, first its ``kind``. Lengths are in scene units.

    ``reading``: arguments of ``load_gaussians``, for splats.

    Raises FileFormatError for a file or folder that is none of these, and OSError.
    """
    path = as_path("path", path)
    if is_tileset(path):
        return {"kind": "tileset", **_tileset(path)}
    if (table := _levels(path)) is not None:
        return {"kind": "levels", **table}
    layout = _layout(path)
    kind = "data set" if layout is not None else identify(path)
    found: dict[str, Any] = {"kind": kind}
    if path.is_file():
        found["bytes"] = path.stat().st_size
    if layout is not None:
        found |= _photographs(path, layout)
    elif kind == "splats":
        cloud = load_gaussians(path, **(reading or {}))
        warn_of_strays_in(cloud)
        warn_of_unseen(cloud)
        found |= {"format": format_of(path)} | _in_time(path) | _splats(cloud)
        cameras = cameras_beside(path, np.zeros(3))
        if cameras:
            found |= {"cameras": len(cameras), "up_by_cameras": _rounded(guess_up(None, cameras))}
        found |= _seen(cloud, guess_up(cloud, cameras) if cameras else None)
    elif kind == "mesh":
        mesh = load_mesh(path)
        warn_of_strays_in(mesh)
        found |= _mesh(mesh)
        if path.suffix.lower() in (".glb", ".gltf") and (nodes := listed_nodes(path)):
            listed = "1 node" if nodes == 1 else f"{nodes} nodes"
            found["order"] = f"for viewers that cull: every triangle twice, in {listed}"
    else:
        found |= _world_cameras(load_cameras(path))
        if is_camera_path(read_json(path)):
            found["frame"] = "nerfstudio's, that of the splats it exports"
            if (path.parent / "dataparser_transforms.json").is_file():
                found["frame"] += "; dataparser_transforms.json leads from that of the photographs to it"
    return found


def in_words(findings: Mapping[str, Any]) -> list[str]:
    """A line for each of the findings of ``describe``; for levels of detail, one for each level."""
    if findings.get("kind") == "levels":
        others = {name: value for name, value in findings.items() if name not in _OF_TABLE}
        return [*in_words({**others, "kind": "levels of detail"}), "", *table_in_words(dict(findings))]
    width = max(map(len, findings))
    return [f"{key.replace('_', ' '):<{width}}  {_in_words(value)}" for key, value in findings.items()]


def _in_words(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, Place):
        return f"{value:.12g}"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        if value and isinstance(value[0], list):
            return ", ".join(" x ".join(map(str, size)) for size in value)
        return "  ".join(_in_words(v) for v in value) or "none"
    return str(value)


def _layout(path: Path) -> Layout | None:
    """That of a data set; None for anything else."""
    if path.is_dir():
        try:
            splat_file(path)
        except FileFormatError:
            return find_layout(path)
        return None
    if path.suffix.lower() != ".json" or identify(path) != "cameras":
        return None
    content = read_json(path)
    return find_layout(path) if isinstance(content, dict) and "frames" in content else None


def _photographs(path: Path, layout: Layout) -> dict[str, Any]:
    dataset = load_dataset(path, missing="skip")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of the first time
        own = not dataset.test or bool(load_dataset(path, test_every=0, missing="skip").test)
    sources = [view.source for view in dataset.views]
    photos = [source for source in sources if isinstance(source, PhotoFile)]
    lenses = sorted({photo.lens.model for photo in photos})
    found: dict[str, Any] = {
        "layout": layout.name,
        "read_from": str(layout.source),
        "images": len({photo.path for photo in photos}),
        "training_views": len(dataset.train),
        "held_out_views": len(dataset.test),
        "split": "the data set's own" if own else "every 8th by name",
        "lenses": lenses,
        "undistorted_when_read": not all(photo.lens.is_pinhole for photo in photos),
        "with_alpha": sum(photo.has_alpha for photo in photos),
        "with_masks": sum(photo.mask is not None for photo in photos),
        "bytes_in_memory": dataset.memory,
        **_cameras([view.camera for view in dataset.views], dataset.origin),
        "up_by_cameras": _rounded(guess_up(None, [view.upright for view in dataset.views])),
    }
    if layout.name == "COLMAP" and (points := count_points(layout.source)) is not None:
        found["points"] = points
    return found


def _in_time(path: Path) -> dict[str, Any]:
    """What is known of splats that move; nothing of others."""
    motion = moving_splats(path)
    return {} if motion is None else {"moves": motion[0], "times": _rounded(np.array(motion[1:]))}


def _splats(cloud: GaussianCloud) -> dict[str, Any]:
    from meshsplats.conversion import convert

    sample = cloud.take(np.arange(0, len(cloud), -(-len(cloud) // SAMPLE)))
    try:
        tried = convert(sample)
    except ValueError:  # nothing visible
        tried = SplatMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 4)))
    share = len(cloud) / len(sample)
    ordered = np.sort(cloud.scales, axis=1).astype(np.float64)
    flatness = ordered[:, 0] / np.maximum(ordered[:, 1], 1e-30)
    return {
        "splats": len(cloud),
        "sh_degree": cloud.sh_degree,
        "kernel": cloud.kernel,
        **({} if cloud.up is None else {"up": _rounded(cloud.up)}),
        **_extent(cloud.means, scene_bounds(cloud), cloud.origin),
        "opacity_5_50_95_percent": _quantiles(cloud.opacities),
        "faint_splats": int((cloud.opacities < LEAST_OPACITY).sum()),
        "scale_5_50_95_percent": _quantiles(ordered.mean(axis=1)),
        "flatness_median": float(np.float32(np.median(flatness))),
        "estimated_triangles": round(len(tried.faces) * share),
        "estimated_vertices": round(len(tried.vertices) * share),
    }


def _seen(cloud: GaussianCloud, up: np.ndarray | None) -> dict[str, Any]:
    """What kind of scene it is and which way is up, as splats show; ``up``: what the cameras tell."""
    from meshsplats.viewpoints.finding import first_impression

    scene = first_impression(cloud, up=up)
    if scene is None:
        return {}
    told = up is not None or cloud.up is not None
    return {
        "scene": scene.kind,
        "scene_confidence": round(scene.confidence, 2),
        **({} if told else {"up_found": _rounded(scene.up), "up_confidence": round(scene.up_confidence, 2)}),
        "view_depth": float(f"{scene.extent:.6g}"),
    }


def _mesh(mesh: SplatMesh) -> dict[str, Any]:
    found: dict[str, Any] = {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
    if mesh.splat_count is not None:
        found["splats"] = mesh.splat_count
    if len(mesh.vertices):
        found |= _extent(mesh.vertices, scene_bounds(mesh), mesh.origin)
        found["opacity_5_50_95_percent"] = _quantiles(mesh.colors[:, 3])
    if mesh.sh_degree:
        found["harmonics_drawn_by"] = HARMONICS_DRAWN_BY
        found["others_show"] = (
            f"{BASE}; meshsplats bake makes means of views" if mesh.plain_colors is None else PLAIN
        )
    if mesh.binding is not None:
        base = f"{len(mesh.binding.base_vertices):,} vertices, {len(mesh.binding.base_faces):,} faces"
        found["bound_to_base_of"] = base
    return found | {
        "up": _rounded(mesh.up),
        "blending": mesh.blending,
        "filter_px2": mesh.filter_px2,
        "order": mesh.order,
        "sh_degree": mesh.sh_degree,
        "plain_colors": mesh.plain_colors is not None,
        "colors_above_white": bool(mesh.colors.max(initial=0) > 1),
        "normals": mesh.normals is not None,
        "depth_groups": mesh.depth_group is not None,
        "attributes": list(mesh.attributes),
    }


def _tileset(path: Path) -> dict[str, Any]:
    from meshsplats.tiles.tileset import Tileset

    tileset = Tileset(path)
    folder = path if path.is_dir() else path.parent
    found = {"tiles": 0, "levels": 0, "triangles": 0, "largest_tile": 0}
    for tile, level in tileset.tiles():
        found["tiles"] += 1
        found["levels"] = max(found["levels"], level)
        found["largest_tile"] = max(found["largest_tile"], tile.triangles)
        found["triangles"] += 0 if tile.children else tile.triangles
    corners, degree = tileset.root.corners(), tileset.root.load().sh_degree
    drawing = {"harmonics_drawn_by": HARMONICS_DRAWN_BY, "others_show": BASE} if degree else {}
    return {
        "bytes": sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()),
        "splats": tileset.splats,
        **found,
        "sh_degree": degree,
        **drawing,
        "geometric_error": float(f"{tileset.root.error:.6g}"),
        "lower": _in_world(corners.min(axis=0), tileset.origin),
        "upper": _in_world(corners.max(axis=0), tileset.origin),
        **_origin(tileset.origin),
        "up": _rounded(tileset.up),
    }


def _levels(path: Path) -> dict[str, Any] | None:
    """The table of a chain; None for anything else, such as a folder with another file of this name."""
    file = find_table(path)
    if file is None:
        return None
    try:
        table, folder = load_table(file), file.parent
    except FileFormatError:
        if path == file:
            raise
        return None
    names = {str(row["file"]) for row in table["levels"]}
    missing = sorted(name for name in names if not (folder / name).is_file())
    held = sum((folder / name).stat().st_size for name in names.difference(missing))
    return {"bytes": held, **table, **({"missing": missing} if missing else {})}


def _cameras(cameras: Sequence[Camera], origin: np.ndarray) -> dict[str, Any]:
    centers = np.array([camera.center for camera in cameras])
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    return {
        "cameras": len(cameras),
        "image_sizes": [list(size) for size in sizes[:8]],
        "fx": _range([camera.fx for camera in cameras]),
        "near": _near_planes(cameras),
        "lower": _in_world(centers.min(axis=0), origin),
        "upper": _in_world(centers.max(axis=0), origin),
        **_origin(origin),
        "up_by_cameras": _rounded(guess_up(None, cameras)),
    }


def _world_cameras(cameras: Sequence[Camera]) -> dict[str, Any]:
    """Findings about cameras that are in the world."""
    origin = choose_origin(np.array([camera.center for camera in cameras]))
    return _cameras([camera.relative_to(origin) for camera in cameras], origin)


def _near_planes(cameras: Sequence[Camera]) -> list[float] | str:
    """Range of those that are named."""
    named = [camera.near for camera in cameras if camera.near is not None]
    return _range(named) if named else "follows the scene"


def _extent(points: np.ndarray, bounds: Bounds, origin: np.ndarray) -> dict[str, Any]:
    """In the coordinates of the file, which are those of the world."""
    return {
        "lower": _in_world(points.min(axis=0), origin),
        "upper": _in_world(points.max(axis=0), origin),
        "center": _in_world(bounds.center, origin),
        **_origin(origin),
        "radius_90_percent": float(f"{bounds.radius:.6g}"),
    }


class Place(float):
    """A coordinate that is printed with all its digits."""


def _in_world(local: np.ndarray, origin: np.ndarray) -> list[float]:
    """``local`` (3,), six digits, plus the ``origin``."""
    rounded = _rounded(local)
    if not origin.any():
        return rounded
    return [Place(f"{x + at:.12g}") for x, at in zip(rounded, origin.tolist(), strict=True)]


def _origin(origin: np.ndarray) -> dict[str, Any]:
    """The finding about it; none for zeros."""
    return {"origin": [Place(x) for x in origin.tolist()]} if origin.any() else {}


def _quantiles(values: np.ndarray) -> list[float]:
    return _rounded(np.quantile(values, (0.05, 0.5, 0.95)))


def _range(values: Sequence[float]) -> list[float]:
    return _rounded(np.array([min(values), max(values)]))


def _rounded(values: np.ndarray) -> list[float]:
    """Six digits, and 0 for rounding errors."""
    largest = float(np.abs(values).max())
    return [float(f"{v:.6g}") if abs(v) > 1e-12 * largest else 0.0 for v in values]
