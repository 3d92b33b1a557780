// The page: settings, the loop that draws while something moves and refines the image when it is still.

import { add, nearestVertex } from "./camera.js";
import { Contents, connectOptions } from "./contents.js";
import { ViewController, connect, connectPanel, fillCameras } from "./controls.js";
import { CropBox } from "./crop.js";
import { ExactRenderer } from "./exact.js";
import { SortedRenderer } from "./sorted.js";
import { element, note, number, report, say, seen } from "./status.js";

const QUIET = 180; // milliseconds without a change, after which the image is still
const DRAFTS = [1 / 4, 1 / 3, 1 / 2, 1]; // sizes of the image while it moves
// milliseconds of a frame: a smaller draft, a larger one, the other renderer
const SLOW = 50, QUICK = 16, HOPELESS = 150;
const PICK = 8; // CSS pixels around a double click
const MOST_PIXELS = 1.6e7, LONGEST = 8192; // of the canvas, where the devices set no other limit
const DRAFT_PIXELS = 3.9e6; // of the largest image while it moves
// milliseconds before WebGPU's device is asked for again, each time that it was lost
const AGAIN = [2e3, 60e3, 60e3];
const LOST = "The graphics device was lost. If it does not come back by itself, load the page again.";

const PHONE = 600; // CSS pixels of the shorter side of a screen, below which a device with touch is a phone

export class App extends ViewController {
  // levels: the meshes that are unpacked, "coarse" and "fine", and the "surface"; unpackFine() gives the
  // fine one, once, where it is not.
  constructor(settings, levels, splats, unpackFine) {
    super(settings);
    Object.assign(this, { levels, splats, unpackFine });
    this.stage = element("stage");
    this.canvases = { exact: element("exact"), sorted: element("sorted") };
    this.meshes = ["coarse", "fine"].filter(level => levels[level]);
    const there = { mesh: this.meshes.length, splats, surface: levels.surface };
    this.contents = new Contents(Object.keys(there).filter(kind => there[kind]));
    this.options = { style: "blended", renderer: "exact", samples: 2, gain: 1 };
    const phone = matchMedia("(pointer: coarse)").matches && Math.min(screen.width, screen.height) < PHONE;
    this.options.detail = phone && levels.coarse ? "coarse" : "fine";
    this.changedAt = -Infinity;
    this.passes = 0;
    this.dirty = true;
    this.drafts = { exact: 2, sorted: 2 };
    this.again = [...AGAIN];
    this.exactOnly = new Set(); // levels that WebGL cannot draw
    this.wake = () => {};
  }

  // The level of the image at rest, and its mesh.
  get resting() {
    const { kinds, chosen } = this.contents;
    if (chosen === "surface" || this.levels.surface && !kinds.includes("mesh")) return "surface";
    if (this.options.detail === "fine" && this.levels.fine) return "fine";
    return this.levels.coarse ? "coarse" : "fine";
  }

  get mesh() { return this.levels[this.resting]; }

  // WebGL draws from the first moment on, the coarse level if there is one; WebGPU takes over when its
  // shaders are compiled.
  async start(kernels) {
    const problems = [];
    try {
      this.sorted = new SortedRenderer(this.canvases.sorted, this.levels, this.splats, note);
    } catch (error) {
      problems.push(error.message);
    }
    this.#connect();
    this.kernels = kernels;
    this.preparing = this.awaited = Boolean(kernels); // awaited: the exact renderer may come
    if (this.sorted) this.#begin();
    await this.#refine();
    if (kernels) await this.#prepareExact(problems);
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

  async #prepareExact(problems) {
    this.preparing = true;
    let exact = null;
    try {
      exact = await ExactRenderer.create(this.canvases.exact, this.kernels, lost => this.#lose(lost));
      for (const level of this.meshes) this.#give(exact, level);
      if (exact.lost) throw new Error(`the graphics device was lost (${exact.lost})`);
      this.exact = exact;
    } catch (error) {
      exact?.free();
      problems.push(error.message);
    }
    this.preparing = this.awaited = false;
  }

  // WebGPU's device went, as it may when the machine sleeps: it is asked for again, while WebGL draws.
  async #lose(exact) {
    if (exact !== this.exact) return;
    const why = `The graphics device was lost (${exact.lost})`;
    this.exact = null;
    this.awaited = true;
    if (this.sorted) say(`${why}; triangles are drawn by WebGL until it is back.`);
    this.changed();
    while (this.awaited && this.again.length) {
      await seen(this.again.shift());
      const problems = [];
      await this.#prepareExact(problems);
      this.awaited = problems.length > 0;
    }
    if (this.awaited) this.#fall(`${why}; triangles are drawn by WebGL now.`);
    else this.#regained();
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
      this.#dropFine(error.message);
    }
    this.preparing = false;
    this.changed();
  }

  #dropFine(reason) {
    delete this.levels.fine;
    this.meshes = this.meshes.filter(level => level !== "fine");
    say(`Only the coarse mesh is shown: ${reason}`);
  }

  #give(exact, level) {
    exact.kept = this.kept;
    const left = exact.add(level, this.levels[level]);
    if (left) {
      say(`WebGPU limits buffers to ${Math.round(exact.most / 2 ** 20)} MiB on this device:` +
        ` the exact image leaves out ${(100 * left).toFixed(left < 0.1 ? 1 : 0)} % of the triangles,` +
        " those that contribute least.");
    }
  }

  // From now on without the exact renderer.
  #fall(message) {
    this.exact?.free();
    this.exact = null;
    this.awaited = false;
    if (this.exactOnly.size) this.#offer(true);
    this.exactOnly.clear();
    this.options.renderer = "sorted";
    element("renderer").value = "sorted";
    element("renderer").options[0].disabled = true;
    if (message) say(message);
    this.changed();
  }

  // ---- Views

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

  // Centres the nearest visible vertex at a point of the stage, in CSS pixels.
  pick(x, y) {
    const pinhole = this.view.pinhole(this.stage.clientWidth, this.stage.clientHeight), { mesh } = this;
    const found = nearestVertex(mesh, this.kept?.[this.resting].triangles, pinhole, x, y, PICK);
    if (!found) return;
    const target = this.view.copy();
    target.distance = found.depth;
    target.position = add(found.point, target.forward, -found.depth);
    this.flyTo(target);
  }

  // ---- Settings

  #connect() {
    const { settings, options } = this, list = element("cameras"), changed = () => this.changed();
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
    this.contents.connect(this.stage, changed);
    connectOptions(options, settings.background, changed);
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
    element("crop").addEventListener("toggle", changed);
    connectPanel(element("panel"), element("toggle"));
    element("dismiss").addEventListener("click", () => { element("message").hidden = true; });
    this.canvases.sorted.addEventListener("webglcontextlost", event => {
      event.preventDefault(); // else it never comes back
      this.changed();
    });
    this.canvases.sorted.addEventListener("webglcontextrestored", () => this.#regain());
    connect(this.stage, this, settings.radius);
    new ResizeObserver(changed).observe(this.stage);
    const watch = () => matchMedia(`(resolution: ${devicePixelRatio}dppx)`).addEventListener("change", () => {
      watch();
      this.changed();
    }, { once: true });
    watch();
    this.#measure();
  }

  #regain() {
    this.sorted = new SortedRenderer(this.canvases.sorted, this.levels, this.splats, note);
    this.sorted.crop(this.kept ?? null);
    this.#regained();
  }

  #regained() {
    if (element("messageText").textContent === LOST) element("message").hidden = true;
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
      this.advance(Math.min(100, now - before) / 1000);
      before = now;
      try {
        await this.#frame(now);
      } catch (error) {
        if (await this.#without(error)) continue;
        say(`Drawing failed: ${error.message}`, true);
        document.body.dataset.state = "failed";
        return;
      }
    }
  }

  // Whether drawing goes on without what failed: a part of the image by one of the renderers.
  async #without({ renderer, part, level, message }) {
    const { sorted } = this;
    await new Promise(done => setTimeout(done, 200)); // a device that is lost may say so only now
    if (sorted !== this.sorted || part && sorted.lost || this.#waits()) return true;
    if (renderer) {
      if (renderer === this.exact && !sorted) return false;
      if (renderer === this.exact)
        this.#fall(`The exact image failed (${message}); triangles are drawn by WebGL now.`);
    } else if (part === "mesh" && (this.exact || this.awaited)) {
      this.exactOnly.add(level);
      Object.assign(this.options, { style: "blended", renderer: "exact" });
      document.querySelector("[name=style][value=blended]").checked = true;
      element("renderer").value = "exact";
      this.#offer(false);
      note(`WebGL does not draw the mesh here: ${message}`);
    } else if (part === "mesh" && level === "fine" && this.levels.coarse) {
      this.#dropFine(message);
    } else if (part && this.contents.kinds.length > 1) {
      this.contents.withdraw(part);
      say(`The ${part} cannot be drawn here: ${message}`);
    } else {
      return false;
    }
    this.changed();
    return true;
  }

  // Whether the settings have other images of the mesh than the exact one.
  #offer(others) {
    for (const input of document.querySelectorAll("[name=style], #renderer")) input.disabled = !others;
  }

  #busy() { return this.dirty || this.moves || !this.finished; }

  // Whether a part of the image has to wait for a device.
  #waits() {
    return this.sorted ? this.sorted.lost && !(this.exactly && this.contents.parts.length === 1)
      : !this.exact;
  }

  // The canvas has the pixels of the screen, where the devices take so many.
  #measure() {
    const { clientWidth, clientHeight } = this.stage, whole = devicePixelRatio || 1;
    const most = Math.min(MOST_PIXELS, this.exact ? this.exact.mostPixels : Infinity);
    const ratio = Math.min(whole, Math.sqrt(most / (clientWidth * clientHeight)),
      Math.min(LONGEST, this.sorted?.longest || LONGEST) / Math.max(clientWidth, clientHeight));
    const rounded = ratio < whole ? Math.floor : Math.round;
    const width = Math.max(1, rounded(clientWidth * ratio)),
      height = Math.max(1, rounded(clientHeight * ratio));
    const millions = (...sides) => (sides[0] * sides[1] / 1e6).toFixed(1);
    this.limited = ratio === whole ? "" : `, ${millions(width, height)} of ` +
      `${millions(clientWidth * whole, clientHeight * whole)} million pixels`;
    this.largestDraft = Math.min(1, Math.sqrt(DRAFT_PIXELS / (width * height)));
    for (const canvas of Object.values(this.canvases)) {
      if (canvas.width !== width) canvas.width = width;
      if (canvas.height !== height) canvas.height = height;
    }
  }

  async #frame(now) {
    const quiet = performance.now() - this.changedAt >= QUIET && !this.moves;
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
    if (exact) await this.#drawExact(this.resting, 1, pass, options.samples, () => this.dirty);
    if (this.dirty) return;
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
    const exact = this.exactly && (this.drafts.exact >= 0 || !this.sorted || this.exactOnly.size > 0);
    const kind = exact ? "exact" : "sorted", share = DRAFTS[Math.max(0, this.drafts[kind])];
    const scale = share * this.largestDraft;
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
      else if (share === 1 && took * ratio < SLOW / 2) this.swift = !this.sluggish;
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
    const elsewhere = exact || this.exactOnly.has(level);
    const parts = this.contents.parts.filter(({ what }) => !(elsewhere && what === "mesh"));
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
  async #drawExact(level, scale, pass, n, stop) {
    const { width, height } = this.canvases.exact, { background, gain } = this.options;
    const w = Math.max(1, Math.round(width * scale)), h = Math.max(1, Math.round(height * scale));
    const begun = performance.now();
    const dx = (pass % n + 0.5) / n - 0.5, dy = (Math.floor(pass / n) + 0.5) / n - 0.5;
    const { exact: renderer } = this, first = pass === 0;
    try {
      await renderer.draw(level, this.view.pinhole(w, h, dx, dy),
        { first, background, gain, filterScale: scale, stop });
    } catch (error) {
      throw Object.assign(error, { renderer });
    }
    this.exactTook = performance.now() - begun;
  }

  #outline() {
    const pinhole = this.view.pinhole(this.stage.clientWidth, this.stage.clientHeight);
    this.crop.show(element("box"), element("crop").open, pinhole);
  }
}
