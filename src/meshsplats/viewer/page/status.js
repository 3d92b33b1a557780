// The line of the state of the image, notes about it, and statistics.

import { inWorld } from "./camera.js";

export const element = id => document.getElementById(id);
export const number = value => Math.round(value).toLocaleString("en");

const MOMENT = 8000; // milliseconds of a note over the image
let hiding;

// In the settings, once, and where the mouse rests on the line of the state.
export function note(text) {
  if ([...element("notes").children].some(line => line.textContent === text)) return;
  const line = document.createElement("p");
  element("notes").append(line);
  element("status").title = line.textContent = text;
}

// Over the image, for a moment, and a note; for good (`lasting`) where there is no image.
export function say(text, lasting = false) {
  const message = element("message");
  message.hidden = false;
  message.classList.toggle("lasting", lasting);
  element("messageText").textContent = text;
  clearTimeout(hiding);
  if (lasting) return;
  note(text);
  hiding = setTimeout(() => { message.hidden = true; }, MOMENT);
}

// Until the page is seen, and some milliseconds more.
export async function seen(milliseconds) {
  while (document.hidden)
    await new Promise(done => document.addEventListener("visibilitychange", done, { once: true }));
  await new Promise(done => setTimeout(done, milliseconds));
}

// state: of the image; exact: whether the exact renderer drew it, in so many passes; scale: of the canvas.
export function report(app, state, exact, passes, scale, level) {
  const kind = !app.contents.shows("mesh") ? app.contents.parts.map(({ what }) => what).join(", ")
    : exact ? "exact" : "sorted";
  const samples = exact ? `, ${passes} sample${passes > 1 ? "s" : ""} per pixel` : "";
  const part = Math.round(1 / scale);
  const size = part > 1 ? `, 1/${part} size` : state === "moving" ? ", moving" : samples + app.limited;
  const wording = {
    refining: `, ${app.passes} of ${passes} samples`, preparing: ", preparing the exact image",
  };
  element("status").textContent = kind + (wording[state] ?? size);
  element("samples").disabled = !app.exactly;
  document.body.dataset.renderer = kind;
  document.body.dataset.level = level;
  // milliseconds after the request
  document.body.dataset.firstPicture ??= String(Math.round(performance.now()));
  document.body.dataset.state = state;
  if (state === "moving" && !element("statistics").open) return;
  const { width, height } = app.canvases.sorted, { mesh, splats, view, settings } = app;
  const shown = app.kept, triangles = number(mesh.faces.length / 3);
  const point = values => values.map(value => Number(value.toPrecision(4))).join(" ");
  const rows = {
    triangles: shown ? `${number(shown[app.resting].triangles.length)} of ${triangles}` : triangles,
    vertices: number(mesh.vertices.length / 3),
    ...(splats ? { splats: shown ? `${number(shown.splats.length)} of ${number(splats.count)}`
      : number(splats.count) } : {}),
    image: `${width} × ${height}`,
    "exact frame": app.exactTook === undefined ? "–" : `${number(app.exactTook)} ms`,
    "graphics": (exact ? app.exact?.name : app.sorted?.name) ?? "",
    "first picture": `${number(Number(document.body.dataset.firstPicture))} ms`,
    position: inWorld(view.position, settings.origin, 1e-4 * settings.radius).join(" "),
    direction: point(view.forward),
    ...settings.statistics,
  };
  const list = element("statistics").querySelector("dl");
  list.replaceChildren(...Object.entries(rows).flatMap(([term, text]) => {
    const dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = term;
    dd.textContent = text;
    return [dt, dd];
  }));
}
