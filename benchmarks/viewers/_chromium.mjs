// A headless Chromium, and a server for its pages. The browser is controlled by puppeteer-core, of the folder in which
// the program runs; CHROMIUM names it.

import http from 'http';
import path from 'path';
import { createRequire } from 'module';
import { pathToFileURL } from 'url';

const TYPES = {
  '.js': 'text/javascript', '.json': 'application/json', '.css': 'text/css', '.html': 'text/html',
  '.wasm': 'application/wasm',
};

export async function launchChromium(protocolTimeout = 900000) {
  const require = createRequire(path.join(process.cwd(), 'index.js'));
  const { default: puppeteer } = await import(pathToFileURL(require.resolve('puppeteer-core')).href);
  return puppeteer.launch({
    executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium',
    headless: true,
    protocolTimeout,
    args: ['--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'],
  });
}

// A server on a port of its own. contents: of a path, {data, name}, the latter for the type; throws for those that are
// not there.
export function serve(contents, headers = {}) {
  return http.createServer((request, response) => {
    for (const [name, value] of Object.entries(headers)) response.setHeader(name, value);
    try {
      const { data, name } = contents(decodeURIComponent(request.url.split('?')[0]));
      response.setHeader('content-type', TYPES[path.extname(name)] ?? 'application/octet-stream');
      response.end(data);
    } catch {
      response.statusCode = 404;
      response.end();
    }
  }).listen(0);
}

export const home = server => 'http://localhost:' + server.address().port;
