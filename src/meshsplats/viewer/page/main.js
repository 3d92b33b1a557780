// From the data in the page to the scene.

import { App } from "./app.js";
import { decodeMesh, decodeSplats, decodeSurface, unpack } from "./scene.js";
import { element, say } from "./status.js";

// `saved`: by a browser, which writes the page as it is then, without the data that was taken from it.
async function main(saved) {
  if (saved)
    throw new Error("This copy was saved by a browser, without its scene." +
      " meshsplats view FILE -o scene.html writes a page with it.");
  if (!element("end")) throw new Error("This page is incomplete: its download was cut off. Load it again.");
  element("doing").textContent = "Unpacking the scene";
  const text = id => element(id)?.textContent.trim();
  const settings = JSON.parse(text("settings"));
  const paint = () => new Promise(resolve => requestAnimationFrame(() => setTimeout(resolve)));
  await paint();
  const take = id => {
    const found = text(id);
    element(id)?.remove();
    return found;
  };
  const unpackFine = async () => decodeMesh(await unpack(take("mesh")));
  const taken = async id => text(id) ? unpack(take(id)) : null, levels = {};
  if (text("coarse")) levels.coarse = decodeMesh(await taken("coarse"));
  else if (text("mesh")) levels.fine = await unpackFine();
  if (text("surface"))
    levels.surface = await decodeSurface(await taken("surface"), await taken("coordinates"), take("picture"));
  const splats = text("splats") ? decodeSplats(await taken("splats")) : null;
  const app = new App(settings, levels, splats, text("mesh") ? unpackFine : null);
  await app.start(JSON.parse(text("kernels") ?? "null"));
}

function fail(error) {
  document.body.dataset.state = "failed";
  element("loading")?.remove();
  say(error.message, true);
}

// The scene follows this script, which may take a while to come.
const blocked = element("blocked");
blocked?.remove();
document.addEventListener("DOMContentLoaded", () => main(!blocked).catch(fail));
