"""The page with a scene inside the first page of the documents' site."""

from __future__ import annotations

import functools
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from _local import script
from _pages import cloud_fixture, mesh_fixture  # noqa: F401
from test_controls import NO_WEBGPU

from meshsplats.viewer.page import make_page

docs_site = script("tools/docs_site.py")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments: object) -> None:
        pass


@pytest.fixture
def site(tmp_path, mesh, cloud):
    """The address of a page that shows the scene as the site does, on a server as sites have one."""
    (tmp_path / docs_site.SCENE).parent.mkdir()
    (tmp_path / docs_site.SCENE).write_text(make_page(mesh, splats=cloud).html, encoding="utf-8")
    frame = docs_site.frame_of_scene(docs_site.SCENE)
    (tmp_path / "index.html").write_text(f"<!doctype html><title>site</title><h1>Title</h1>{frame}")
    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/index.html"
        server.shutdown()


@pytest.mark.slow
def test_the_scene_is_drawn_within_the_site(browser, site):
    page = browser.page(site, 1200, 560, before=NO_WEBGPU)  # whose shaders take long to compile
    inside = "document.querySelector('iframe').contentDocument.body"
    page.wait(f"{inside}?.dataset.state === 'still'", 400)
    assert page.run(f"{inside}.querySelector('#panel').classList.contains('closed')")
    page.run(f"{inside}.classList.add('plain')")  # without words over it
    page.wait(f"{inside}.dataset.state === 'still'", 400)
    drawn = page.screenshot()[120:500, 300:900]
    assert page.run(f"{inside}.dataset.renderer") == "sorted"
    assert np.unique(drawn.reshape(-1, 3), axis=0).shape[0] > 100  # a scene, not a message
    page.close()


def test_the_readme_says_where_it_goes():
    text = (docs_site.ROOT / "README.md").read_text(encoding="utf-8")
    assert text.count(docs_site.PLACE_OF_SCENE) == 1
