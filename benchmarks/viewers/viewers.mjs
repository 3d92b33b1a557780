// Draws .glb files with three.js and Babylon.js in a headless Chromium, from given cameras.
//
//   node viewers.mjs jobs.json      jobs: [{viewer, glb, cameras, out, hash, sorted, antialias, passes, near, far}, ...]
//
// Runs in a folder where `npm install three babylonjs babylonjs-loaders puppeteer-core` was run; CHROMIUM names
// the browser. `out` receives one PNG per camera. `sorted` (three.js): triangles are sorted by their centres for each
// camera, far to near; `passes` (Babylon.js): useOrderIndependentTransparency with so many, each of which peels a
// layer from either side; `antialias`: MSAA. See viewers.py, passes.py and tuned.py.

import fs from 'fs';
import path from 'path';
import { home, launchChromium, serve } from './_chromium.mjs';

const modules = path.join(process.cwd(), 'node_modules');

// Cameras are OpenCV pinholes in the mesh's own frame: x right, y down, z forward. Both viewers get the same
// OpenGL matrices, column by column, and the inverse of the node's rotation in front.
const MATRICES = `
function projection(k, n, f) {
  const { width: w, height: h } = k;
  return [2*k.fx/w, 0, 0, 0,  0, 2*k.fy/h, 0, 0,  1-2*k.cx/w, 2*k.cy/h-1, -(f+n)/(f-n), -1,  0, 0, -2*f*n/(f-n), 0];
}
function view(k) {
  const m = k.world_to_camera, s = [1, -1, -1, 1], out = [];
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) out.push(s[r] * m[r][c]);
  return out;
}`;

const THREE_PAGE = `<!doctype html><link rel="icon" href="data:,"><canvas id="c"></canvas>
<script type="importmap">{"imports": {"three": "/modules/three/build/three.module.js",
  "three/addons/": "/modules/three/examples/jsm/"}}</script>
<script type="module">
import * as THREE from 'three';
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
${MATRICES}
const canvas = document.getElementById('c');
// Far triangles first: an index sorted by the depths of the triangles' centres.
function sortTriangles(geometry, order, view) {
  const p = geometry.attributes.position, n = order.length / 3, depth = new Float32Array(n), e = view.elements;
  for (let i = 0; i < n; i++) {
    let z = 0;
    for (let k = 0; k < 3; k++) {
      const v = order[3 * i + k];
      z += e[2] * p.getX(v) + e[6] * p.getY(v) + e[10] * p.getZ(v);
    }
    depth[i] = z;
  }
  const sorted = Uint32Array.from({ length: n }, (_, i) => i).sort((a, b) => depth[a] - depth[b]);
  const index = new Uint32Array(3 * n);
  sorted.forEach((t, i) => { for (let k = 0; k < 3; k++) index[3 * i + k] = order[3 * t + k]; });
  geometry.setIndex(new THREE.BufferAttribute(index, 1));
}
window.draw = async (url, cameras, near, far, hash, sorted, antialias, passes) => {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias, preserveDrawingBuffer: true });
  const gltf = await new GLTFLoader().loadAsync(url);
  const scene = new THREE.Scene();
  scene.background = new THREE.Color(1, 1, 1);
  scene.add(gltf.scene);
  scene.updateMatrixWorld(true);
  const meshes = [];
  gltf.scene.traverse(o => { if (o.isMesh) meshes.push(o); });
  for (const m of meshes) m.frustumCulled = false;
  const mesh = meshes[0];
  if (hash) Object.assign(mesh.material, { alphaHash: true, transparent: false, depthWrite: true, needsUpdate: true });
  if (sorted) mesh.material.forceSinglePass = true;  // else back faces are drawn before front faces
  const order = mesh.geometry.index.array.slice();
  const images = [];
  for (const k of cameras) {
    renderer.setSize(k.width, k.height, false);
    const camera = new THREE.PerspectiveCamera();
    camera.matrixAutoUpdate = camera.matrixWorldAutoUpdate = false;
    camera.matrixWorldInverse.fromArray(view(k)).multiply(mesh.matrixWorld.clone().invert());
    camera.matrixWorld.copy(camera.matrixWorldInverse).invert();
    camera.projectionMatrix.fromArray(projection(k, near, far));
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    if (sorted) {
      sortTriangles(mesh.geometry, order, camera.matrixWorldInverse.clone().multiply(mesh.matrixWorld));
    }
    renderer.render(scene, camera);
    images.push(canvas.toDataURL('image/png'));
  }
  return images;
};
window.version = 'three.js r' + THREE.REVISION;
</script>`;

const BABYLON_PAGE = `<!doctype html><link rel="icon" href="data:,"><canvas id="c"></canvas>
<script src="/modules/babylonjs/babylon.js"></script>
<script src="/modules/babylonjs-loaders/babylonjs.loaders.min.js"></script>
<script>
${MATRICES}
const canvas = document.getElementById('c');
window.draw = async (url, cameras, near, far, hash, sorted, antialias, passes) => {
  canvas.width = cameras[0].width; canvas.height = cameras[0].height;
  const engine = new BABYLON.Engine(canvas, antialias, { preserveDrawingBuffer: true, useHighPrecisionMatrix: true, useExactSrgbConversions: true });
  const scene = new BABYLON.Scene(engine);
  scene.useRightHandedSystem = true;
  scene.clearColor = new BABYLON.Color4(1, 1, 1, 1);
  const camera = new BABYLON.FreeCamera('camera', BABYLON.Vector3.Zero(), scene);
  await BABYLON.SceneLoader.AppendAsync('', url, scene, undefined, '.glb');
  const meshes = scene.meshes.filter(m => m.getTotalVertices() > 0);
  for (const m of meshes) m.alwaysSelectAsActiveMesh = true;
  const mesh = meshes[0];
  if (passes) {
    scene.useOrderIndependentTransparency = true;
    scene.depthPeelingRenderer.passCount = passes;
  }
  await scene.whenReadyAsync();
  const back = mesh.computeWorldMatrix(true).clone().invert();
  const images = [];
  for (const k of cameras) {
    // Babylon writes matrices for row vectors: its array of a product reads left to right.
    const matrix = back.multiply(BABYLON.Matrix.FromArray(view(k)));
    camera.getViewMatrix = () => matrix;
    camera._computedViewMatrix = matrix;
    camera._globalPosition = matrix.clone().invert().getTranslation();  // by which meshes are sorted
    camera.freezeProjectionMatrix(BABYLON.Matrix.FromArray(projection(k, near, far)));
    scene.render();
    images.push(canvas.toDataURL('image/png'));
  }
  engine.dispose();
  return images;
};
window.version = 'Babylon.js ' + BABYLON.Engine.Version;
</script>`;

const jobs = JSON.parse(fs.readFileSync(process.argv[2]));
const files = Object.fromEntries(jobs.map((job, i) => ['/glb/' + i, job.glb]));
const pages = { '/three': THREE_PAGE, '/babylon': BABYLON_PAGE };
const server = serve(url => url in pages
  ? { data: pages[url], name: 'index.html' }
  : { data: fs.readFileSync(files[url] ?? path.join(modules, url.replace('/modules', ''))), name: url });
const browser = await launchChromium(600000);
for (const [i, job] of jobs.entries()) {
  const page = await browser.newPage();
  page.on('pageerror', error => console.error(String(error)));
  await page.goto(home(server) + '/' + job.viewer);
  await page.waitForFunction('window.version');
  console.log(job.viewer + '=' + await page.evaluate('window.version'));
  const cameras = JSON.parse(fs.readFileSync(job.cameras));
  const images = await page.evaluate(
    (...args) => window.draw(...args), home(server) + '/glb/' + i, cameras, job.near, job.far, job.hash, Boolean(job.sorted), Boolean(job.antialias), job.passes ?? 0);
  fs.mkdirSync(job.out, { recursive: true });
  images.forEach((p, n) => fs.writeFileSync(
    path.join(job.out, n + '.png'), Buffer.from(p.split(',')[1], 'base64')));
  await page.close();
}
await browser.close();
server.close();
