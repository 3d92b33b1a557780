// The page: settings, the loop that draws while something moves and refines the image when it is still.

import { View, add, dot, nearestVertex } from "./camera.js";
import { Contents } from "./contents.js";
import { connect, connectPanel, fillCameras } from "./controls.js";
import { CropBox } from "./crop.js";
import { ExactRenderer } from "./exact.js";
import { SortedRenderer } from "./sorted.js";
import { element, note, number, report, say } from "./status.js";

const QUIET = 180; // milliseconds without a change, after which the image is still
const DRAFTS = [1 / 4, 1 / 3, 1 / 2, 1]; // sizes of the image while it moves
// milliseconds of a frame: a smaller draft, a larger one, the other renderer
const SLOW = 50, QUICK = 16, HOPELESS = 150;
const PICK = 8; // CSS pixels around a double click
const MOST_PIXELS = 3.9e6; // of the canvas: the exact renderer draws an image in one piece
const FLIGHT = 450; // milliseconds from one camera to the next
const LOST = "The graphics device was lost. If it does not come back by itself, load the page again.";

const calm = matchMedia("(prefers-reduced-motion: reduce)");
const PHONE = 600; // CSS pixels of the shorter side of a screen, below which a device with touch is a phone

export class App {
  // levels: the meshes that are unpacked, "coarse" and "fine", and the "surface"; unpackFine() gives the
  // fine one, once, where it is not.
  constructor(settings, levels, splats, unpackFine) {
    Object.assign(this, { settings, levels, splats, unpackFine });
    this.stage = element("stage");
    this.canvases = { exact: element("exact"), sorted: element("sorted") };
    this.meshes = ["coarse", "fine"].filter(level => levels[level]);
    const there = { mesh: this.meshes.length, splats, surface: levels.surface };
    this.contents = new Contents(Object.keys(there).filter(kind => there[kind]));
    this.options = { style: "blended", renderer: "exact", samples: 2, gain: 1 };
    const phone = matchMedia("(pointer: coarse)").matches && Math.min(screen.width, screen.height) < PHONE;
    this.options.detail = phone && levels.coarse ? "coarse" : "fine";
    this.view = this.#viewOf(0);
    this.camera = 0;
    this.flying = false;
    this.thrust = [0, 0, 0];
    this.changedAt = -Infinity;
    this.passes = 0;
    this.dirty = true;
    this.drafts = { exact: 2, sorted: 2 };
    this.wake = () => {};
  }

  // The level of the image at rest, and its mesh.
  get resting() {
    const { kinds, chosen } = this.contents;
    if (chosen === "surface" || !kinds.includes("mesh")) return "surface";
    if (this.options.detail === "fine" && this.levels.fine) return "fine";
    return this.levels.coarse ? "coarse" : "fine";
  }

  get mesh() { return this.levels[this.resting]; }

  // WebGL draws from the first moment on, the coarse level if there is one; WebGPU takes over when its
  // shaders are compiled.
  async start(kernels) {
    const problems = [];
    try {
      this.sorted = new SortedRenderer(this.canvases.sorted, this.levels, this.splats);
    } catch (error) {
      problems.push(error.message);
    }
    this.#connect();
    this.preparing = Boolean(kernels);
    if (this.sorted) this.#begin();
    await this.#refine();
    if (kernels) await this.#prepareExact(kernels, problems);
    if (!this.exact && !this.sorted)
      throw new Error(`This browser cannot draw the scene: ${problems.join("; ")}.`);
    if (this.exact) {
      this.changed();
    } else if (!kernels) {
      this.#fall(); // a surface alone, which is drawn by WebGL anywhere
    } else {
      this.#fall();
      note(`The image is not exact here: ${problems.join("; ")}.` +
        ` WebGL draws ${this.mesh.order === "splat" ? "whole splats" : "triangles"} sorted by` +
        " their centres. Current Chrome, Edge, Safari and Firefox have WebGPU, but not on all systems.");
    }
    if (!this.sorted) {
      for (const input of document.querySelectorAll("[name=content], [name=style]")) input.disabled = true;
      this.#begin();
    }
  }

  async #prepareExact(kernels, problems) {
    this.preparing = true;
    try {
      const lost = reason =>
        this.#fall(`The graphics device was lost (${reason}); triangles are drawn by WebGL now.`);
      const exact = await ExactRenderer.create(this.canvases.exact, kernels, lost);
      for (const level of this.meshes) this.#give(exact, level);
      this.exact = exact;
    } catch (error) {
      problems.push(error.message);
    }
    this.preparing = false;
  }

  #begin() {
    document.body.dataset.state = "moving";
    this.#loop();
  }

  // Unpacks the fine level where it is wanted.
  async #refine() {
    if (this.options.detail !== "fine" || !this.unpackFine) return;
    const unpackFine = this.unpackFine;
    this.unpackFine = null;
    this.preparing = true;
    // a picture first: unpacking blocks the page
    if (this.sorted) await new Promise(resolve => { this.shown = resolve; });
    try {
      this.levels.fine = await unpackFine();
      this.meshes.push("fine");
      this.crop.again();
      if (this.exact) this.#give(this.exact, "fine");
    } catch (error) {
      delete this.levels.fine;
      say(`Only the coarse mesh is shown: ${error.message}`);
    }
    this.preparing = false;
    this.changed();
  }

  #give(exact, level) {
    exact.kept = this.kept;
    const left = exact.add(level, this.levels[level]);
    if (left) {
      say(`WebGPU takes buffers of ${Math.round(exact.most / 2 ** 20)} MiB here:` +
        ` the exact image lacks the ${(100 * left).toFixed(left < 0.1 ? 1 : 0)} % of the triangles` +
        " that show least.");
    }
  }

  // From now on without the exact renderer.
  #fall(message) {
    this.exact = null;
    this.options.renderer = "sorted";
    element("renderer").value = "sorted";
    element("renderer").options[0].disabled = true;
    if (message) say(message);
    this.changed();
  }

  // ---- Views

  #viewOf(index) {
    const { cameras, up, center, radius } = this.settings, camera = cameras[index];
    const view = new View(camera, up, 1);
    view.distance = Math.max(dot(add(center, view.position, -1), view.forward), 0.2 * radius);
    return view;
  }

  jump(index) {
    const count = this.settings.cameras.length;
    this.camera = (index + count) % count;
    element("cameras").value = String(this.camera);
    const target = this.#viewOf(this.camera);
    this.flight = calm.matches ? null : { from: this.view.copy(), target, start: performance.now() };
    if (!this.flight) this.view = target;
    this.changed();
  }

  changed() {
    this.changedAt = performance.now();
    this.dirty = true;
    if (document.body.dataset.state !== "loading") document.body.dataset.state = "moving";
    this.wake();
  }

  command(name) {
    const { body } = document;
    if (name === "home") this.jump(0);
    else if (name === "previous") this.jump(this.camera - 1);
    else if (name === "next") this.jump(this.camera + 1);
    else if (name === "plain") body.classList.toggle("plain");
    else document.querySelector(`input[value=${name}]:not(:disabled)`)?.click();
    if (name === "plain") this.changed();
  }

  // begun: a key went down just now; even the shortest press moves the camera.
  fly(keys, fast, begun = false) {
    const pressed = (plus, minus) => Number(keys.has(plus)) - Number(keys.has(minus));
    const speed = this.settings.radius * (fast ? 2.4 : 0.6);
    this.thrust = [pressed("d", "a"), pressed("q", "e"), pressed("w", "s")].map(value => value * speed);
    if (begun) this.view.move(...this.thrust.map(value => value / 60));
    if (keys.size) this.changed();
  }

  // Centres the nearest visible vertex at a point of the stage, in CSS pixels.
  pick(x, y) {
    const pinhole = this.view.pinhole(this.stage.clientWidth, this.stage.clientHeight), { mesh } = this;
    const found = nearestVertex(mesh, this.kept?.[this.resting].triangles, pinhole, x, y, PICK);
    if (!found) return;
    const target = this.view.copy();
    target.distance = found.depth;
    target.position = add(found.point, target.forward, -found.depth);
    this.flight = { from: this.view.copy(), target, start: calm.matches ? -Infinity : performance.now() };
    this.changed();
  }

  // ---- Settings

  #connect() {
    const { settings, options } = this, list = element("cameras");
    fillCameras(list, settings.cameras);
    element("previous").disabled = element("next").disabled = settings.cameras.length < 2;
    list.addEventListener("change", () => this.jump(Number(list.value)));
    for (const name of ["previous", "next", "home"])
      element(name).addEventListener("click", () => this.command(name));
    element("fly").addEventListener("change", event => { this.flying = event.target.checked; });
    element("spin").addEventListener("change", event => {
      this.spinning = event.target.checked;
      this.changed();
    });
    const choose = (name, apply) => {
      for (const input of document.querySelectorAll(`[name=${name}]`)) {
        input.addEventListener("change", () => { options[name] = input.value; apply(); });
      }
    };
    this.contents.connect(this.stage, () => this.changed());
    choose("style", () => this.changed());
    const background = element("background");
    background.value = settings.background;
    const paint = () => {
      options.background = [1, 3, 5].map(i => parseInt(background.value.slice(i, i + 2), 16) / 255);
      document.body.style.background = background.value;
      this.changed();
    };
    background.addEventListener("input", paint);
    paint();
    element("exposure").addEventListener("input", event => {
      const stops = Number(event.target.value);
      options.gain = 2 ** stops;
      element("exposureText").value = `${stops > 0 ? "+" : ""}${stops} EV`;
      this.changed();
    });
    element("samples").addEventListener("change", event => {
      options.samples = Number(event.target.value);
      this.changed();
    });
    element("renderer").addEventListener("change", event => {
      options.renderer = event.target.value;
      this.changed();
    });
    const detail = element("detail");
    element("detailLine").hidden = !settings.triangles.coarse;
    for (const option of detail.options)
      option.textContent = `${number(settings.triangles[option.value] ?? 0)} triangles`;
    detail.value = options.detail;
    detail.addEventListener("change", () => {
      options.detail = detail.value;
      this.changed();
      this.#refine();
    });
    this.crop = new CropBox(settings, this.levels, this.splats, kept => {
      this.kept = kept;
      this.cropped = true; // the renderers hear of it before the next frame, never within one
      this.changed();
    });
    element("crop").addEventListener("toggle", () => this.changed());
    connectPanel(element("panel"), element("toggle"));
    element("dismiss").addEventListener("click", () => { element("message").hidden = true; });
    this.canvases.sorted.addEventListener("webglcontextlost", event => {
      event.preventDefault(); // else it never comes back
      this.changed();
    });
    this.canvases.sorted.addEventListener("webglcontextrestored", () => this.#regain());
    connect(this.stage, this, settings.radius);
    new ResizeObserver(() => this.changed()).observe(this.stage);
    this.#measure();
  }

  #regain() {
    this.sorted = new SortedRenderer(this.canvases.sorted, this.levels, this.splats);
    this.sorted.crop(this.kept ?? null);
    element("message").hidden = true;
    this.changed();
  }

  // ---- Drawing

  async #loop() {
    let before = performance.now();
    for (;;) {
      const waits = this.#waits();
      if (waits) {
        say(LOST, true);
        document.body.dataset.state = "lost";
      }
      if (waits || !this.#busy()) {
        await new Promise(resolve => { this.wake = resolve; });
        continue;
      }
      const now = await new Promise(requestAnimationFrame);
      this.#advance(performance.now(), Math.min(100, now - before) / 1000);
      before = now;
      const wasExact = Boolean(this.exact);
      try {
        await this.#frame(now);
      } catch (error) {
        if (this.#waits()) continue;
        if (!wasExact || !this.sorted) {
          say(`Drawing failed: ${error.message}`, true);
          document.body.dataset.state = "failed";
          return;
        }
        this.#fall(`The exact image failed (${error.message}); triangles are drawn by WebGL now.`);
      }
    }
  }

  #busy() { return this.dirty || this.#moves() || !this.finished; }

  // Whether a part of the image has to wait for WebGL's device.
  #waits() { return this.sorted?.lost && !(this.exactly && this.contents.parts.length === 1); }

  #moves() { return Boolean(this.flight) || Boolean(this.spinning) || this.thrust.some(Boolean); }

  #advance(now, seconds) {
    if (this.flight) {
      const t = Math.min(1, (now - this.flight.start) / FLIGHT);
      this.view = this.flight.from.towards(this.flight.target, t < 1 ? t * t * (3 - 2 * t) : 1);
      if (t === 1) this.flight = null;
      this.changed();
    }
    if (this.spinning) {
      this.view.orbit(seconds * 0.5, 0);
      this.changed();
    }
    if (this.thrust.some(Boolean)) {
      this.view.move(...this.thrust.map(value => value * seconds));
      this.changed();
    }
  }

  #measure() {
    const { clientWidth, clientHeight } = this.stage;
    const ratio = Math.min(devicePixelRatio || 1, 2, Math.sqrt(MOST_PIXELS / (clientWidth * clientHeight)));
    const width = Math.max(1, Math.round(clientWidth * ratio)),
      height = Math.max(1, Math.round(clientHeight * ratio));
    for (const canvas of Object.values(this.canvases)) {
      if (canvas.width !== width) canvas.width = width;
      if (canvas.height !== height) canvas.height = height;
    }
  }

  async #frame(now) {
    const quiet = performance.now() - this.changedAt >= QUIET && !this.#moves();
    if (this.dirty) {
      this.dirty = false;
      if (this.cropped) for (const renderer of [this.sorted, this.exact]) renderer?.crop(this.kept);
      this.cropped = false;
      this.passes = 0;
      this.finished = false;
      this.#measure();
      this.#outline();
      await this.#draft(now);
      return;
    }
    if (!quiet || this.finished) return;
    const { options } = this, exact = this.exactly;
    const passes = exact ? options.samples ** 2 : 1, pass = this.passes++;
    if (exact) await this.#drawExact(this.resting, 1, pass, options.samples);
    if (pass === 0) await this.#drawSorted(this.resting, 1, true, exact);
    if (this.dirty) return;
    this.finished = this.passes >= passes;
    report(this, !this.finished ? "refining" : this.preparing ? "preparing" : "still", exact, passes, 1,
      this.resting);
    this.shown?.();
  }

  // Whether the image at rest is the exact one.
  get exactly() {
    return Boolean(this.exact?.levels[this.resting]) && this.options.renderer === "exact" &&
      this.options.style === "blended" && this.contents.shows("mesh");
  }

  // A quick image while something changes: small enough to be fluid, by WebGL where WebGPU is too slow.
  async #draft(now) {
    const exact = this.exactly && (this.drafts.exact >= 0 || !this.sorted);
    const kind = exact ? "exact" : "sorted", scale = DRAFTS[Math.max(0, this.drafts[kind])];
    const level = this.levels.coarse && !(exact && this.swift) ? "coarse" : this.resting;
    if (!exact) await this.#drawSorted(level, scale, false, false);
    let took = this.lastDraft === kind ? now - this.draftAt : 0;
    if (exact) {
      const begun = performance.now();
      await this.#drawExact(level, scale, 0, 1);
      await this.#drawSorted(level, scale, false, true);
      took = performance.now() - begun;
      // The fine level too moves where the coarse one is so quick that it should; not again where it is slow.
      const ratio = this.mesh.faces.length / this.levels[level].faces.length;
      if (this.swift && took > SLOW) [this.swift, this.sluggish] = [false, true];
      else if (scale === 1 && took * ratio < SLOW / 2) this.swift = !this.sluggish;
    }
    this.lastDraft = kind;
    this.draftAt = now;
    if (exact && took > HOPELESS && this.sorted) this.drafts.exact--;
    else if (took > SLOW && took < 1000) this.drafts[kind] = Math.max(0, this.drafts[kind] - 1);
    else if (took && took < QUICK) this.drafts[kind] = Math.min(DRAFTS.length - 1, this.drafts[kind] + 1);
    this.took = took;
    report(this, "moving", exact, 1, scale, level);
  }

  async #drawSorted(level, scale, still, exact) {
    const parts = this.contents.parts.filter(({ what }) => !(exact && what === "mesh"));
    const { style, background, gain } = this.options, stop = () => this.dirty;
    if (parts.length && this.sorted && !this.sorted.lost) {
      const drawn = await this.sorted.draw(
        { view: this.view, level, parts, style, still, scale, background, gain, stop });
      if (!drawn) return;
    }
    this.canvases.exact.style.visibility = exact ? "visible" : "hidden";
    this.canvases.sorted.style.visibility = parts.length ? "visible" : "hidden";
  }

  // Sample `pass` of n x n in each pixel.
  async #drawExact(level, scale, pass, n) {
    const { width, height } = this.canvases.exact, { background, gain } = this.options;
    const w = Math.max(1, Math.round(width * scale)), h = Math.max(1, Math.round(height * scale));
    const begun = performance.now();
    const dx = (pass % n + 0.5) / n - 0.5, dy = (Math.floor(pass / n) + 0.5) / n - 0.5;
    await this.exact.draw(level, this.view.pinhole(w, h, dx, dy),
      { first: pass === 0, background, gain, filterScale: scale });
    this.exactTook = performance.now() - begun;
  }

  #outline() {
    const pinhole = this.view.pinhole(this.stage.clientWidth, this.stage.clientHeight);
    this.crop.show(element("box"), element("crop").open, pinhole);
  }
}
