"""Pages of `meshsplats view`: size, errors of quantisation, time to the first picture, the image in Chromium.

    python benchmarks/viewer.py SPLATS [SPLATS ...] --cameras FILE [FILE ...] [--chromium SIDE]
    python benchmarks/viewer.py SPLATS [SPLATS ...] --command [--chromium SIDE]

A camera file for each splat file; its first camera is the view. `--chromium` opens each page from the disk
in a headless Chromium, with WebGPU and WebGL by SwiftShader (on processors: slow), and compares a screenshot
of SIDE x SIDE pixels, one sample a pixel, with `render`.

`--command` measures the command itself, in a process of its own, as for large files. `--chromium` then opens
the page without WebGPU.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import meshsplats as ms
from meshsplats.viewer.page import Page, make_page

SIDES = (400, 800)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--cameras", type=Path, nargs="+")
    parser.add_argument("--command", action="store_true")
    parser.add_argument("--chromium", type=int, metavar="SIDE")
    args = parser.parse_args()
    if args.command:
        print("| file | splats | merged to | 400 px, dB | triangles | processor s | memory, GB | page, MB |")
        print("|---|---|---|---|---|---|---|---|")
        for path in args.splats:
            by_command(path, args.chromium)
        return
    if args.cameras is None:
        parser.error("give --cameras or --command")
    sides = " | ".join(f"{side} px: largest, pixels > 0.5, PSNR" for side in SIDES)
    print(f"| scene | triangles | bytes a triangle | page, MB | positions, radii | s | {sides} |")
    print("|---|---|---|---|---|---|" + "---|" * len(SIDES))
    pages = []
    for path, cameras in zip(args.splats, args.cameras, strict=True):
        cloud = ms.load_gaussians(path)
        mesh, views = ms.convert(cloud), ms.load_cameras(cameras)
        start = time.process_time()
        page = make_page(mesh, splats=cloud, cameras=views)
        seconds = time.process_time() - start
        cells = [
            path.stem,
            f"{len(mesh.faces):,}",
            f"{page.mesh.bytes_a_triangle:.2f}",
            f"{len(page.html) / 1e6:.2f}",
            f"{page.mesh.relative_error:.1e}",
            f"{seconds:.1f}",
        ]
        for side in SIDES:
            camera = views[0].scaled(side / views[0].width)
            one, other = (ms.render(each, camera).color for each in (mesh, page.mesh.decoded))
            off = 255 * np.abs(one - other).max(axis=-1)
            cells.append(f"{off.max():.2f}, {(off > 0.5).sum()}, {ms.psnr(one, other):.1f}")
        print(f"| {' | '.join(cells)} |", flush=True)
        pages.append((path.stem, mesh, views[0], page))
    if args.chromium:
        for name, mesh, camera, page in pages:
            in_chromium(name, mesh, camera.scaled(args.chromium / camera.width), page)


def by_command(path: Path, side: int | None) -> None:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "page.html"
        command = [sys.executable, "-m", "meshsplats", "view", str(path), "-o", str(file), "--json"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        found = json.loads(process.stdout.read())
        _, _, used = os.wait4(process.pid, 0)
        print(
            f"| {path.stem} | {found.get('merged_from', found['splats']):,} | {found['splats']:,}"
            f" | {found.get('merging_psnr', '-')} | {found['triangles']:,} + {found['coarse_triangles']:,}"
            f" | {used.ru_utime + used.ru_stime:.1f} | {used.ru_maxrss / 1e6:.2f}"
            f" | {found['bytes'] / 1e6:.1f} |",
            flush=True,
        )
        if side:
            without_webgpu(path.stem, file, side)


def without_webgpu(name: str, file: Path, side: int) -> None:
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "viewer"))
    from _browser import WEBGL, Browser

    hidden = "Object.defineProperty(Navigator.prototype, 'gpu', { get: () => undefined });"
    browser = Browser(WEBGL)
    try:
        shown = browser.page(file.as_uri(), side, side, before=hidden)
        shown.wait("document.body.dataset.firstPicture", 600)
        first = processor_seconds(browser.pid)
        shown.still(3000)
        found = shown.statistics()["triangles"]
        print(
            f"{name}, {side} x {side}, WebGL: first picture after {first:.1f} s of processor time of all"
            f" processes, {found} triangles at rest after {processor_seconds(browser.pid):.1f} s",
            flush=True,
        )
    finally:
        browser.close()


def processor_seconds(group: int) -> float:
    """Of the living processes of a group; Linux."""
    total = 0
    for folder in Path("/proc").iterdir():
        try:
            words = (folder / "stat").read_text().rpartition(")")[2].split()
        except (OSError, NotADirectoryError):
            continue
        total += int(words[11]) + int(words[12]) if int(words[2]) == group else 0
    return total / os.sysconf("SC_CLK_TCK")


def in_chromium(name: str, mesh: ms.SplatMesh, camera: ms.Camera, page: Page) -> None:
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "viewer"))
    from _browser import Browser

    expected = np.rint(255 * ms.render(mesh, camera).color.clip(0, 1)).astype(int)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "page.html"
        file.write_text(page.html, encoding="utf-8")
        browser = Browser()
        try:
            shown = browser.page(file.as_uri(), camera.width, camera.height)
            shown.wait("document.body.dataset.firstPicture", 600)
            first = float(shown.run("document.body.dataset.firstPicture")) / 1000
            shown.run("document.body.classList.add('plain')")
            shown.choose("#samples", "1")
            shown.still(3000)
            image = shown.screenshot().astype(int)
            renderer = shown.run("document.body.dataset.renderer")
            frame = shown.statistics()["exact frame"]
        finally:
            browser.close()
    off = np.abs(image - expected).max(axis=-1)
    print(
        f"{name}, {camera.width} x {camera.height}, {renderer}: first picture after {first:.1f} s,"
        f" exact frame {frame};"
        f" at most {off.max()} levels off, {(off > 1).sum()} pixels by more than 1,"
        f" {(off > 0).mean():.2%} at all; {ms.psnr(image / 255, expected / 255):.1f} dB"
    )


if __name__ == "__main__":
    main()
