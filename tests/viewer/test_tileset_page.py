"""The page of docs/tiles.md: CesiumJS shows a tileset in it, alone and at a place on the globe."""

from __future__ import annotations

import contextlib
import functools
import http.server
import json
import re
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from _three import _Quiet

import meshsplats as ms
from meshsplats.demo_scene import make_scene
from meshsplats.formats._orientation import tile_frame
from meshsplats.tiles.building import build_tiles
from meshsplats.tiles.options import TileOptions

DOCS = (Path(__file__).parents[2] / "docs" / "tiles.md").read_text("utf-8")
PAGE = re.search(r"```html\n(.*?)```", DOCS, re.DOTALL)[1]  # type: ignore[index]
PLACE, MODEL, FRAME = re.search(  # type: ignore[union-attr]
    r"```js\n(const place .*?\n)(tileset\.modelMatrix .*?\n)(const frame .*?\n)```", DOCS
).groups()
ONLINE = re.compile(r"https://cesium\.com/downloads/cesiumjs/releases/[\d.]+/Build/Cesium")
SIDE = 240


def on_globe(page: str) -> str:
    """``page``, changed as the documentation says, somewhere on the globe."""
    page = page.replace("globe: false, ", "")
    page = re.sub(r"const frame = .*\n", FRAME, page)
    numbers = PLACE.replace("longitude, latitude, height", "11.5, 48.1, 520")
    return page.replace("const { center", numbers + MODEL + "const { center")


@contextlib.contextmanager
def serving(folder: Path) -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(_Quiet, directory=str(folder))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/index.html"
    finally:
        server.shutdown()
        server.server_close()


def drawn(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The image (h, w, 3) in [0, 1] that the page should show, and (h, w) where the scene covers it."""
    table = json.loads((folder / "tileset.json").read_text())
    box = np.array(table["root"]["boundingVolume"]["box"]).reshape(4, 3)
    slope, distance = np.radians(25), 2.2 * np.linalg.norm(box[1:].sum(axis=0))
    turn = tile_frame(np.array(table["extras"]["meshsplats"]["up"]))
    eye = box[0] + distance * np.array([0, -np.cos(slope), np.sin(slope)])
    up = turn.T @ [0, 0, 1]
    camera = ms.look_at(eye @ turn, box[0] @ turn, up=up, width=SIDE, height=SIDE, fov=60)
    image = ms.render_tiles(ms.Tileset(folder), camera, cutoff=0.2)
    return image.color, image.alpha > 0


@pytest.mark.nightly
@pytest.mark.parametrize("place", [False, True])
def test_the_page_shows_a_tileset(tmp_path, browser, node_package, place):
    cesium = node_package("cesium") / "node_modules" / "cesium" / "Build" / "Cesium"
    ms.save_gaussians(make_scene(2000), tmp_path / "scene.ply")
    folder = tmp_path / "tileset"
    build_tiles(ms.stream_gaussians(tmp_path / "scene.ply"), folder, TileOptions(alpha="mask"))
    (folder / "cesium").symlink_to(cesium.resolve())
    text = ONLINE.sub("cesium", on_globe(PAGE) if place else PAGE)
    assert "https://" not in text
    (folder / "index.html").write_text(text)
    (folder / "favicon.ico").touch()
    wanted, covered = drawn(folder)
    assert 0.05 < covered.mean() < 0.8
    with serving(folder) as url:
        page, quality = browser.page(url, SIDE, SIDE), 0.0
        deadline = time.monotonic() + 120
        while quality < 20 and time.monotonic() < deadline:
            time.sleep(0.3)
            shown = page.screenshot() / 255
            quality = ms.psnr(shown[covered], wanted[covered])
        print(f"{quality:.1f} dB where the scene is")
        assert quality >= 20
        if not place:  # on the globe, there is ground around it
            above = np.s_[: SIDE * 4 // 5]  # the logo of Cesium
            assert ((shown < 0.99).any(axis=2) == covered)[above].mean() > 0.97
        assert [problem for problem in page.problems() if "ReadPixels" not in problem] == []
        page.close()
