// Shows a tileset in CesiumJS in a headless Chromium, and saves an image.
//
//   node cesium.mjs TILESET_FOLDER IMAGE.png [MAXIMUM_SCREEN_SPACE_ERROR] [RANGE]
//
// Runs in a folder where `npm install cesium puppeteer-core` was run; CHROMIUM names the browser. RANGE: distance of
// the camera in radii of the tileset. Prints the tiles that were loaded, their triangles or splats, and the camera: its
// view matrix, column by column, from the frame of the tileset, and its vertical angle.

import fs from 'fs';
import path from 'path';
import { home, launchChromium, serve } from './_chromium.mjs';

const [tileset, image, error = '2', range = '2.2'] = process.argv.slice(2);
const cesium = path.join(process.cwd(), 'node_modules', 'cesium', 'Build', 'Cesium');

const PAGE = `<!doctype html><link rel="icon" href="data:,">
<link rel="stylesheet" href="/cesium/Widgets/CesiumWidget/CesiumWidget.css">
<style>html, body, #c { margin: 0; width: 100%; height: 100%; overflow: hidden }</style><div id="c"></div>
<script>window.CESIUM_BASE_URL = '/cesium/';</script>
<script src="/cesium/Cesium.js"></script>
<script>
window.show = async (error, range) => {
  Cesium.Ion.defaultAccessToken = undefined;
  const viewer = new Cesium.CesiumWidget('c', {
    baseLayer: false, globe: false, skyBox: false, skyAtmosphere: false, msaaSamples: 4,
    contextOptions: { webgl: { preserveDrawingBuffer: true } },
  });
  viewer.scene.backgroundColor = Cesium.Color.WHITE;
  const tileset = await Cesium.Cesium3DTileset.fromUrl('/tileset/tileset.json', { maximumScreenSpaceError: error });
  viewer.scene.primitives.add(tileset);
  const sphere = tileset.boundingSphere;
  viewer.camera.lookAt(
    sphere.center, new Cesium.HeadingPitchRange(0, Cesium.Math.toRadians(-25), range * sphere.radius));
  const failures = [];
  tileset.tileFailed.addEventListener(event => failures.push(event.url + ': ' + event.message));
  await new Promise(done => {
    let calm = 0;
    viewer.scene.postRender.addEventListener(() => {
      const splats = tileset.gaussianSplatPrimitive;
      calm = tileset.tilesLoaded && (!splats || splats._drawCommand) ? calm + 1 : 0;
      if (calm > (splats ? 20 : 5)) done();
    });
  });
  const statistics = tileset.statistics;
  return {
    version: Cesium.VERSION, failures, selected: statistics.selected,
    loaded: statistics.numberOfLoadedTilesTotal, triangles: statistics.numberOfTrianglesSelected,
    splats: tileset.gaussianSplatPrimitive?._numSplats ?? 0,
    view: Cesium.Matrix4.toArray(viewer.camera.viewMatrix), fovy: viewer.camera.frustum.fovy,
  };
};
</script>`;

const server = serve(url => {
  if (url === '/') return { data: PAGE, name: 'index.html' };
  const [, root, ...rest] = url.split('/');
  const name = path.join({ cesium, tileset }[root], ...rest);
  return { data: fs.readFileSync(name), name };
});
const browser = await launchChromium();
const page = await browser.newPage();
page.on('pageerror', problem => console.error(String(problem)));
await page.setViewport({ width: 480, height: 360 });
await page.goto(home(server) + '/');
console.log(JSON.stringify(await page.evaluate((e, r) => window.show(e, r), Number(error), Number(range))));
await page.screenshot({ path: image });
await browser.close();
server.close();
