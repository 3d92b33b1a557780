"""three.js with its stock loader in a headless Chromium."""

from __future__ import annotations

import contextlib
import functools
import http.server
import json
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import _browser
import numpy as np
from _needs import lacking

from meshsplats import Camera

PAGE = """<!doctype html><style>body {margin: 0}</style><canvas id="c"></canvas>
<script type="importmap">{"imports": {"three": "./node_modules/three/build/three.module.js",
  "three/addons/": "./node_modules/three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
PREPARE
const load = async (name, prepared, renderer) => {
  const gltf = await new GLTFLoader().loadAsync(name);
  const scene = new THREE.Scene();
  scene.background = new THREE.Color(1, 1, 1);
  scene.add(gltf.scene);
  scene.updateMatrixWorld(true);
  gltf.scene.traverse(o => {
    if (o.isMesh) { o.frustumCulled = false; if (prepared) window.prepare(o, renderer); scene.ours = o; }
  });
  return scene;
};
window.draw = async (k, prepared, before) => {
  const canvas = document.getElementById('c');
  const renderer = new THREE.WebGLRenderer({ canvas, preserveDrawingBuffer: true });
  renderer.setSize(k.width, k.height);
  const scene = await load('./mesh.glb', prepared, renderer);
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
  if (before) renderer.render(await load('./before.glb', prepared, renderer), camera);
  renderer.render(scene, camera);
  const gl = renderer.getContext(), pixels = new Uint8Array(4 * w * h);
  gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return { message, pixels: Array.from(pixels) };
};
document.body.dataset.ready = '1';
</script>"""


class _Quiet(http.server.SimpleHTTPRequestHandler):
    extensions_map = http.server.SimpleHTTPRequestHandler.extensions_map | {".js": "text/javascript"}

    def log_message(self, *args: object) -> None:
        pass

    def end_headers(self) -> None:
        self.send_header("Cache-Control", "no-store")  # two meshes of one second have one date
        super().end_headers()


@contextlib.contextmanager
def three_js(
    folder: Path, node_package: Callable[[str], Path], prepare: str = ""
) -> Iterator[Callable[..., np.ndarray]]:
    """Gives ``draw(camera, prepared=False, before=False)``: the image (h, w, 3) of ``folder / "mesh.glb"``,
    in [0, 1]. ``prepare``: a script that sets ``window.prepare``, which is called with each mesh if
    ``prepared``. ``before``: draw ``folder / "before.glb"`` first, with the same renderer."""
    if _browser.PROGRAM is None:
        lacking("browser", "no Chromium was found")
    (folder / "node_modules").symlink_to(node_package("three") / "node_modules")
    (folder / "index.html").write_text(PAGE.replace("PREPARE", prepare))
    server = http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(_Quiet, directory=str(folder))
    )
    threading.Thread(target=server.serve_forever, daemon=True).start()
    browser = _browser.Browser(_browser.WEBGL)

    def draw(camera: Camera, prepared: bool = False, before: bool = False) -> np.ndarray:
        k = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        k |= {"world_to_camera": camera.world_to_camera.tolist(), "near": 0.05, "far": 100}
        page = browser.page(f"http://127.0.0.1:{server.server_port}/index.html", 200, 200)
        page.wait("document.body.dataset.ready")
        drawn = page.run(f"draw({json.dumps(k)}, {json.dumps(prepared)}, {json.dumps(before)})")
        assert drawn["message"] == ""
        rgba = np.array(drawn["pixels"]).reshape(camera.height, camera.width, 4)
        return rgba[::-1, :, :3] / 255

    try:
        yield draw
    finally:
        browser.close()
        server.shutdown()
        server.server_close()
