"""What large captures cost: commands by purpose, with processor time, memory, size and likeness of each.

    python benchmarks/large_captures.py SPLATS [SPLATS ...] [--copies N] [--purposes NAME ...] [--minutes X]

Each command runs in a process of its own. Columns: processor seconds, seconds by the clock and the share of
the processors that other programs took meanwhile, peak memory, triangles, size. dB: four views, of a place
those that are found in it first, of an object from around it, 800 x 800 pixels, on white, against the splats
with all degrees, look 'area'. *sorted*: triangles sorted at every sample; *viewer*: a .glb that is blended,
masked or in an order as three.js draws it with MSAA (`viewer_images`, `ordered_image`). Of a page, its fine
mesh as the page has it; of tiles, those with an error of a pixel at most; of splats, those left.

--copies N: first makes a cloud of N copies of each file, side by side, turned and in other shades. --blender:
a Python with bpy and meshsplats, for the purpose 'blender'.
"""

from __future__ import annotations

import argparse
import base64
import json
import multiprocessing
import shlex
import shutil
import struct
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np
from _common import Report, areas, arguments, images, mean_psnr, run

import meshsplats as ms
from meshsplats.formats.gltf.reader import listed_order
from meshsplats.rendering.viewers import ordered_image, viewer_images
from meshsplats.viewer.unpacking import unpack_mesh
from meshsplats.viewpoints.showing import default_views

VIEWS, SIDE = 4, 800
MESH_BEGINS = '<script type="text/plain" id="mesh">'
PURPOSES = {
    "page": ["view {input} -o page.html"],
    "phone page": ["view {input} -o phone.html --max-triangles 300000"],
    "web": ["convert {input} -o web.glb --max-triangles 1000000"],
    "web in order": ["convert {input} -o ordered.glb --max-triangles 1000000 --alpha ordered"],
    "web tuned": ["finetune {input} -o web_tuned.glb --order file --minutes {minutes:g}"],
    "phone": ["convert {input} -o phone.glb --max-triangles 300000"],
    "engine": ["finetune {input} -o engine.glb --opacity cutoff --soft-share 0.05 --minutes {minutes:g}"],
    "engine of fewer": [
        "simplify {input} -o fewer.ply --count 300000",
        "finetune fewer.ply -o fewer.glb --opacity cutoff --soft-share 0.05 --minutes {minutes:g}",
    ],
    "tuned": ["finetune {input} -o tuned.npz --minutes {minutes:g}"],
    "blender": [
        "convert {input} -o blender.npz --max-triangles 2000000",
        "blender blender.npz -o blender.png --width 800",
    ],
    "rays": ["convert {input} -o rays.usdc --max-triangles 4000000"],
    "tiles": ["tiles {input} -o tiles"],
    "fewer": ["simplify {input} -o splats.ply --count 500000"],
}
"""Commands by purpose."""


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--copies", type=int, default=1)
    parser.add_argument("--purposes", nargs="+", choices=list(PURPOSES), default=list(PURPOSES))
    parser.add_argument("--minutes", type=float, default=3)
    parser.add_argument("--blender", default=sys.executable, metavar="PYTHON")
    parser.add_argument("--folder", type=Path, help="where clouds and results stay; default: nowhere")
    args = parser.parse_args()
    with Report(args) as report, tempfile.TemporaryDirectory() as scratch:
        report.table(
            *("command", "processor s", "clock s, others", "peak GB", "triangles", "MB", "dB: sorted, viewer")
        )
        for path in args.splats:
            folder = (args.folder or Path(scratch)) / name_of(path, args.copies)
            folder.mkdir(parents=True, exist_ok=True)
            measure(report, path.resolve(), folder, args)
            if args.folder is None:
                shutil.rmtree(folder)


def name_of(path: Path, copies: int) -> str:
    name = path.parent.name if path.suffix == ".json" else path.stem
    return name if copies == 1 else f"{name}_{copies}"


def measure(report: Report, path: Path, folder: Path, args: argparse.Namespace) -> None:
    """The rows of one file. Clouds and meshes are loaded in a process of their own: what a command's process
    is forked from counts as its peak memory."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as worker:
        if args.copies > 1:
            whole = folder / f"{folder.name}.ply"
            if not whole.exists():
                worker.submit(save_copies, path, whole, args.copies).result()
            path = whole
        count = worker.submit(splats_of, path).result()
        report.row(f"**{folder.name}, {count:,} splats**", *[""] * 6)
        for purpose in args.purposes:
            for words in PURPOSES[purpose]:
                words = words.format(input=shlex.quote(str(path)), minutes=args.minutes)
                command = shlex.split(words)
                result = folder / command[command.index("-o") + 1]
                python = args.blender if command[0] == "blender" else sys.executable
                with open(folder / "log.txt", "a") as log:
                    call = [python, "-m", "meshsplats", *command, "--force"]
                    used = run(call, cwd=folder, stdout=log, stderr=log)
                triangles, scores = worker.submit(scored, path, result).result()
                shown = words.replace(str(path), path.name if path.suffix != ".json" else "SPLATS")
                cells = [
                    f"`{shown}`",
                    f"{used.processor:.0f}",
                    f"{used.wall:.0f}, {used.others:.0%}",
                    f"{used.memory / 1e9:.2f}",
                    f"{triangles:,}" if triangles else "",
                    f"{size(result) / 1e6:.1f}",
                    ", ".join(f"{score:.1f}" for score in scores),
                ]
                report.row(*cells)


def size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


# In the worker


def splats_of(path: Path) -> int:
    return len(ms.load_gaussians(path))


def save_copies(path: Path, target: Path, count: int) -> None:
    """Copies of a cloud on a square grid, each turned about y and a little lighter or darker."""
    cloud, rng = ms.load_gaussians(path), np.random.default_rng(0)
    low, high = np.quantile(cloud.means, [0.02, 0.98], axis=0)
    step, side = 1.1 * (high - low)[[0, 2]].max(), int(np.ceil(np.sqrt(count)))
    w, x, y, z = cloud.quaternions.T
    means, quaternions, colors = [], [], []
    for i in range(count):
        angle = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(angle / 2), np.sin(angle / 2)
        turned = np.stack([c * w - s * y, c * x + s * z, c * y + s * w, c * z - s * x], axis=1)
        quaternions.append((turned / np.linalg.norm(turned, axis=1, keepdims=True)).astype(np.float32))
        c, s = np.cos(angle), np.sin(angle)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        place = np.array([i % side * step, 0, i // side * step])
        means.append((cloud.means @ turn.T + place).astype(np.float32))
        colors.append((cloud.sh[:, :1] * rng.uniform(0.7, 1.1)).astype(np.float32))
    grid = ms.GaussianCloud(
        np.concatenate(means),
        np.concatenate(quaternions),
        np.tile(cloud.scales, (count, 1)),
        np.tile(cloud.opacities, count),
        np.concatenate(colors),
        cloud.kernel,
    )
    ms.save_gaussians(grid, target)


@cache
def truth(path: Path) -> tuple[list[ms.Camera], list[np.ndarray]]:
    cloud = ms.load_gaussians(path)
    of_place = default_views(cloud, path, VIEWS, side=(SIDE, SIDE))
    cameras = of_place[0] if of_place else ms.orbit(cloud, VIEWS, width=SIDE, height=SIDE)
    return cameras, areas(cloud, cameras)


def scored(path: Path, result: Path) -> tuple[int, list[float]]:
    """Number of triangles, and dB: sorted, and of a .glb that is not opaque also in a web viewer."""
    if result.suffix == ".png":
        return 0, []
    cameras, truths = truth(path)
    if result.is_dir():
        tileset = ms.Tileset(result)
        tiles = (ms.render_tiles(tileset, camera, max_error=1.0, samples=2) for camera in cameras)
        return 0, [mean_psnr((image.color for image in tiles), truths)]
    if result.suffix == ".ply":
        cloud = ms.load_gaussians(result)
        return 0, [mean_psnr(areas(cloud, cameras), truths)]
    mesh = page_mesh(result) if result.suffix == ".html" else ms.load_mesh(result)
    samples = ms.needed_samples(mesh, cameras)
    scores = [mean_psnr(images(mesh, cameras, samples=samples), truths)]
    if result.suffix == ".glb" and (order := listed_order(result, mesh)) is not None:
        scores.append(mean_psnr((ordered_image(mesh, order, camera) for camera in cameras), truths))
    elif result.suffix == ".glb" and (cutoffs := drawn_cutoffs(result)):
        shown = [viewer_images(mesh, camera, cutoffs)[0] for camera in cameras]
        scores.append(mean_psnr(shown, truths))
    return len(mesh.faces), scores


def page_mesh(path: Path) -> ms.SplatMesh:
    """The fine mesh in a page."""
    text = path.read_text(encoding="utf-8")
    start = text.index(MESH_BEGINS) + len(MESH_BEGINS)
    return unpack_mesh(base64.b64decode(text[start : text.index("<", start)]))


def drawn_cutoffs(path: Path) -> list[float | None]:
    """What `viewer_images` takes for a .glb of one material that is blended or masked; else nothing."""
    with open(path, "rb") as file:
        length = struct.unpack("<12xI4x", file.read(20))[0]
        materials = json.loads(file.read(length))["materials"]
    if len(materials) > 1 or materials[0].get("alphaMode", "OPAQUE") == "OPAQUE":
        return []
    return [materials[0].get("alphaCutoff", 0.5) if materials[0]["alphaMode"] == "MASK" else None]


if __name__ == "__main__":
    main()
