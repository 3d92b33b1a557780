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

import json
import os
import sys
import tempfile
from pathlib import Path

import numpy as np
from _common import Report, Stopwatch, arguments, run

import meshsplats as ms
from meshsplats.viewer.page import Page, make_page

SIDES = (400, 800)
OFF = ("levels off, at most", "pixels by more than 1", "pixels at all", "PSNR")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("splats", type=Path, nargs="+")
    parser.add_argument("--cameras", type=Path, nargs="+")
    parser.add_argument("--command", action="store_true")
    parser.add_argument("--chromium", type=int, metavar="SIDE")
    args = parser.parse_args()
    if not args.command and args.cameras is None:
        parser.error("give --cameras or --command")
    with Report(args) as report:
        if args.command:
            by_command(report, args.splats, args.chromium)
        else:
            by_page(report, args.splats, args.cameras, args.chromium)


def by_page(report: Report, splats: list[Path], cameras: list[Path], chromium: int | None) -> None:
    sides = (f"{side} px: largest, pixels > 0.5, PSNR" for side in SIDES)
    report.table("scene", "triangles", "bytes a triangle", "page, MB", "positions, radii", "s", *sides)
    pages = []
    for path, places in zip(splats, cameras, strict=True):
        cloud = ms.load_gaussians(path)
        mesh, views = ms.convert(cloud), ms.load_cameras(places)
        watch = Stopwatch()
        page = make_page(mesh, splats=cloud, cameras=views)
        cells = [
            path.stem,
            f"{len(mesh.faces):,}",
            f"{page.mesh.bytes_a_triangle:.2f}",
            f"{len(page.html) / 1e6:.2f}",
            f"{page.mesh.relative_error:.1e}",
            f"{watch.processor:.1f}",
        ]
        for side in SIDES:
            camera = views[0].scaled(side / views[0].width)
            one, other = (ms.render(each, camera).color for each in (mesh, page.mesh.decoded))
            off = 255 * np.abs(one - other).max(axis=-1)
            cells.append(f"{off.max():.2f}, {(off > 0.5).sum()}, {ms.psnr(one, other):.1f}")
        report.row(*cells)
        pages.append((path.stem, mesh, views[0], page))
    if chromium:
        report.table("scene", "renderer", "first picture, s", "exact frame", *OFF)
        for name, mesh, camera, page in pages:
            report.row(*in_chromium(name, mesh, camera.scaled(chromium / camera.width), page))


def by_command(report: Report, splats: list[Path], chromium: int | None) -> None:
    shown = ("first picture, processor s", "at rest", "triangles at rest") if chromium else ()
    report.table(
        *("file", "splats", "merged to", "400 px, dB", "triangles", "processor s", "memory, GB", "page, MB"),
        *shown,
    )
    for path in splats:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "page.html"
            used = run([sys.executable, "-m", "meshsplats", "view", path, "-o", file, "--json"])
            found = json.loads(used.output)
            report.row(
                *(path.stem, f"{found.get('merged_from', found['splats']):,}", f"{found['splats']:,}"),
                *(found.get("merging_psnr", "-"), f"{found['triangles']:,} + {found['coarse_triangles']:,}"),
                *(f"{used.processor:.1f}", f"{used.memory / 1e9:.2f}", f"{found['bytes'] / 1e6:.1f}"),
                *(without_webgpu(file, chromium) if chromium else ()),
            )


def without_webgpu(file: Path, side: int) -> tuple[str, str, str]:
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
        return f"{first:.1f}", f"{processor_seconds(browser.pid):.1f}", str(found)
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


def in_chromium(name: str, mesh: ms.SplatMesh, camera: ms.Camera, page: Page) -> tuple[str, ...]:
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
    return (
        *(name, renderer, f"{first:.1f}", str(frame)),
        *(f"{off.max()}", f"{(off > 1).sum()}", f"{(off > 0).mean():.2%}"),
        f"{ms.psnr(image / 255, expected / 255):.1f}",
    )


if __name__ == "__main__":
    main()
