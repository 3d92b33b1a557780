"""The shader of docs/viewers.md in three.js: its images are those of ``render``."""

from __future__ import annotations

import functools
import http.server
import json
import re
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshsplats as ms
from meshsplats.demo_scene import make_scene

pytest.importorskip("PIL", reason="Pillow is not installed")
import _browser
from _needs import lacking

DOCS = Path(__file__).parents[2] / "docs" / "viewers.md"
PAGE = """<!doctype html><style>body {margin: 0}</style><canvas id="c"></canvas>
<script type="importmap">{"imports": {"three": "./node_modules/three/build/three.module.js",
  "three/addons/": "./node_modules/three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
SNIPPET
window.draw = async (k, harmonics) => {
  const canvas = document.getElementById('c');
  const renderer = new THREE.WebGLRenderer({ canvas, preserveDrawingBuffer: true });
  renderer.setSize(k.width, k.height);
  const gltf = await new GLTFLoader().loadAsync('./mesh.glb');
  const scene = new THREE.Scene();
  scene.background = new THREE.Color(1, 1, 1);
  scene.add(gltf.scene);
  scene.updateMatrixWorld(true);
  gltf.scene.traverse(o => {
    if (o.isMesh) { o.frustumCulled = false; if (harmonics) showHarmonics(o); scene.ours = o; }
  });
  const camera = new THREE.PerspectiveCamera(), m = k.world_to_camera, s = [1, -1, -1, 1], view = [];
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) view.push(s[r] * m[r][c]);
  camera.matrixAutoUpdate = camera.matrixWorldAutoUpdate = false;
  camera.matrixWorldInverse.fromArray(view).multiply(scene.ours.matrixWorld.clone().invert());
  camera.matrixWorld.copy(camera.matrixWorldInverse).invert();
  const { width: w, height: h } = k, n = k.near, f = k.far;
  camera.projectionMatrix.set(2*k.fx/w, 0, 1-2*k.cx/w, 0, 0, 2*k.fy/h, 2*k.cy/h-1, 0,
    0, 0, -(f+n)/(f-n), -2*f*n/(f-n), 0, 0, -1, 0);
  let message = '';
  renderer.debug.onShaderError = (gl, program, vertex, fragment) => {
    message = gl.getShaderInfoLog(vertex) + gl.getShaderInfoLog(fragment) + gl.getProgramInfoLog(program);
  };
  renderer.render(scene, camera);
  const gl = renderer.getContext(), pixels = new Uint8Array(4 * w * h);
  gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return { message, pixels: Array.from(pixels) };
};
document.body.dataset.ready = '1';
</script>"""


@pytest.fixture(scope="module")
def drawing(tmp_path_factory, node_package):
    """Draws a mesh with three.js: (h, w, 3) in [0, 1]."""
    if _browser.PROGRAM is None:
        lacking("browser", "no Chromium was found")
    three = node_package("three")
    folder = tmp_path_factory.mktemp("three")
    (folder / "node_modules").symlink_to(three / "node_modules")
    snippet = re.search(r"```js\n(.*?)```", DOCS.read_text("utf-8"), re.DOTALL)[1]
    (folder / "index.html").write_text(PAGE.replace("SNIPPET", snippet))

    class Quiet(http.server.SimpleHTTPRequestHandler):
        extensions_map = http.server.SimpleHTTPRequestHandler.extensions_map | {".js": "text/javascript"}

        def log_message(self, *args):
            pass

        def end_headers(self):
            self.send_header("Cache-Control", "no-store")  # two meshes of one second have one date
            super().end_headers()

    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    browser = _browser.Browser(_browser.WEBGL)

    def draw(mesh, camera, *, harmonics=True):
        ms.save_mesh(mesh, folder / "mesh.glb", alpha="opaque", cutoff=0.5)
        k = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        k |= {"world_to_camera": camera.world_to_camera.tolist(), "near": 0.05, "far": 100}
        page = browser.page(f"http://127.0.0.1:{server.server_port}/index.html", 200, 200)
        page.wait("document.body.dataset.ready")
        drawn = page.run(f"draw({json.dumps(k)}, {json.dumps(harmonics)})")
        assert drawn["message"] == ""
        rgba = np.array(drawn["pixels"]).reshape(camera.height, camera.width, 4)
        return rgba[::-1, :, :3] / 255

    yield draw
    browser.close()
    server.shutdown()
    server.server_close()


@pytest.fixture(scope="module")
def mesh():
    return ms.convert(make_scene(1500))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_images_are_those_of_render(drawing, mesh, degree):
    mesh = mesh.of_degree(degree)
    if not degree:
        mesh = replace(mesh, plain_colors=np.full((len(mesh.vertices), 3), 0.5))
    camera = ms.orbit(mesh, 1, azimuth=30, elevation=20, width=160, height=120)[0]
    wanted = ms.render(ms.cut_mesh(mesh, 0.5), camera).color
    shown, plain = drawing(mesh, camera), drawing(mesh, camera, harmonics=False)
    # Where two triangles lie within rounding of one depth, the depth buffer may choose the other.
    same = np.abs(shown - wanted).max(axis=2) < 0.02
    share, with_it, without = same.mean(), *(ms.psnr(image[same], wanted[same]) for image in (shown, plain))
    print(f"degree {degree}: {with_it:.1f} dB in {share:.1%} of the pixels, without the shader {without:.1f}")
    assert share > 0.97
    assert with_it > 55
    assert without < 40
