// WebGPU: the exact image, by the kernels of meshsplats/webgpu. Their text and the steps of a frame are in
// the page as Python wrote them; docs/webgpu-host.md says what a host has to do.

import { TILE, findFans, findGroups, findRuns, fitting, frameUniform, shadingOf } from "./arrays.js";
import { counting } from "./scene.js";

const ROWS = 16; // strips of an image begin at multiples of it

// Sums frames and shows their mean over the background.
const PRESENT = `
struct Show { background: vec3f, gain: f32, size: vec2u, canvas: vec2f, weight: f32, linear: u32, first: u32,
  top: u32, rows: u32 };
@group(0) @binding(0) var<uniform> show: Show;
@group(0) @binding(1) var<storage, read> samples: array<vec4f>;
@group(0) @binding(2) var<storage, read_write> sums: array<vec4f>;
@group(0) @binding(3) var<storage, read> total: array<vec4f>;

@compute @workgroup_size(8, 8) fn collect(@builtin(global_invocation_id) id: vec3u) {
  if (any(id.xy >= vec2u(show.size.x, show.rows))) { return; }
  let i = (show.top + id.y) * show.size.x + id.x;
  sums[i] = select(sums[i], vec4f(0), show.first == 1u) + samples[id.y * show.size.x + id.x];
}
@vertex fn corner(@builtin(vertex_index) i: u32) -> @builtin(position) vec4f {
  return vec4f(f32(i & 1u) * 4 - 1, f32(i >> 1u) * 4 - 1, 0, 1);
}
fn decode(c: vec3f) -> vec3f {
  return select(pow((max(c, vec3f(0)) + 0.055) / 1.055, vec3f(2.4)), c / 12.92, c <= vec3f(0.04045));
}
fn encode(c: vec3f) -> vec3f {
  return select(1.055 * pow(max(c, vec3f(0)), vec3f(1 / 2.4)) - 0.055, c * 12.92, c <= vec3f(0.0031308));
}
fn pixel(p: vec2i) -> vec4f {
  let q = vec2u(clamp(p, vec2i(0), vec2i(show.size) - 1));
  return total[q.y * show.size.x + q.x] * show.weight;
}
@fragment fn paint(@builtin(position) at: vec4f) -> @location(0) vec4f {
  let p = at.xy * vec2f(show.size) / show.canvas - 0.5;
  let low = floor(p + 1e-4);
  let t = max(p - low, vec2f(0));
  let i = vec2i(low);
  var c = pixel(i);
  if (any(vec2f(show.size) != show.canvas)) {
    let top = mix(c, pixel(i + vec2i(1, 0)), t.x);
    c = mix(top, mix(pixel(i + vec2i(0, 1)), pixel(i + vec2i(1, 1)), t.x), t.y);
  }
  var rgb = c.xyz;
  let alpha = 1 - c.w;
  let linear = show.linear == 1u;
  if (show.gain != 1) {
    let own = rgb / max(alpha, 1e-6);
    rgb = alpha * select(encode(decode(own) * show.gain), own * show.gain, linear);
  }
  rgb += c.w * select(show.background, decode(show.background), linear);
  return vec4f(select(rgb, encode(rgb), linear), 1);
}`;

export class ExactRenderer {
  // lost(renderer) is called when the device goes; renderer.lost says why. Throws where there is no WebGPU.
  static async create(canvas, kernels, lost) {
    if (!navigator.gpu) throw new Error(
      isSecureContext ? "this browser has no WebGPU" : "browsers offer WebGPU to pages by https only");
    const adapter = await navigator.gpu.requestAdapter({ powerPreference: "high-performance" });
    if (!adapter) throw new Error("WebGPU finds no graphics device");
    const { maxStorageBufferBindingSize, maxBufferSize } = adapter.limits;
    const device = await adapter.requestDevice(
      { requiredLimits: { maxStorageBufferBindingSize, maxBufferSize } });
    const self = new ExactRenderer();
    const { vendor, architecture, description } = adapter.info ?? {};
    Object.assign(self, { canvas, kernels, device, levels: {}, buffers: {}, groupsOfBindings: new Map() });
    Object.assign(self, { capacity: kernels.limits.firstPairs, budget: kernels.limits.budgets[0] });
    self.name = description || [vendor, architecture].filter(Boolean).join(" ") || "WebGPU";
    self.most = Math.min(maxStorageBufferBindingSize, maxBufferSize);
    self.mostPixels = Math.floor(self.most / 16);
    self.capacity = Math.min(self.capacity, Math.floor(self.most / 8));
    device.lost.then(({ reason, message }) => {
      if (reason === "destroyed") return;
      self.lost = message || "no reason given";
      lost(self);
    });
    device.addEventListener("uncapturederror", event => { self.problem ??= event.error.message; });
    self.context = canvas.getContext("webgpu");
    self.format = navigator.gpu.getPreferredCanvasFormat();
    self.context.configure({ device, format: self.format, alphaMode: "opaque" });
    await self.#compile();
    self.#allocate("plan", 64);
    self.#allocate("counters", 64);
    self.#allocate("frame", 256);
    self.#allocate("show", 64);
    const digits = kernels.digits, words = new Uint32Array(64 * (digits.length + 1));
    digits.forEach(([shift, word], i) => words.set([shift, word, 1], 64 * i));
    self.#upload("digits", words);
    self.back = device.createBuffer({ size: 64, usage: GPUBufferUsage.COPY_DST | GPUBufferUsage.MAP_READ });
    if (self.problem) throw new Error(self.problem);
    return self;
  }

  // Gives back what it has on the device, which the canvas holds for good; it cannot be used any more.
  free() { this.device.destroy(); }

  async #compile() {
    const { device, kernels } = this, modules = this.modules = {};
    for (const [name, code] of Object.entries({ ...kernels.sources, present: PRESENT })) {
      modules[name] = device.createShaderModule({ code });
      const wrong = (await modules[name].getCompilationInfo()).messages.find(
        message => message.type === "error");
      if (wrong)
        throw new Error(`a shader does not compile: ${name}, line ${wrong.lineNum}: ${wrong.message}`);
    }
    const steps = [...kernels.lists, ...kernels.raster].filter(step => step.kernel);
    const entries = new Map(steps.map(({ kernel }) => [kernel, kernel === "raster" ? "raster" : "lists"]));
    entries.set("collect", "present");
    this.pipelines = {};
    await Promise.all([...entries].map(([kernel, module]) => this.#compileKernel(kernel, module)));
    this.painter = await device.createRenderPipelineAsync({
      layout: "auto", vertex: { module: modules.present, entryPoint: "corner" },
      fragment: { module: modules.present, entryPoint: "paint", targets: [{ format: this.format }] },
    });
  }

  async #compileKernel(kernel, module, entryPoint = kernel) {
    const compute = { module: this.modules[module], entryPoint };
    this.pipelines[kernel] = await this.device.createComputePipelineAsync({ layout: "auto", compute });
  }

  // ---- The mesh

  // Adds a mesh under the name `level`: the part of it that fits the device. Returns the share of triangles
  // left out. Throws if not even parts fit; then nothing of it is left.
  add(level, mesh) {
    try {
      return this.#add(level, mesh);
    } catch (error) {
      delete this.levels[level];
      for (const name of Object.keys(this.buffers).filter(name => name.startsWith(`${level}/`))) {
        this.buffers[name].destroy();
        delete this.buffers[name];
      }
      this.groupsOfBindings.delete(level);
      throw error;
    }
  }

  #add(level, mesh) {
    const part = fitting(mesh, this.most, this.kernels.limits.runs, this.kernels.groups);
    this.levels[level] = { mesh, part };
    this.#upload(`${level}/vertices`, part?.vertices ?? mesh.vertices);
    const colors = part?.colors ?? mesh.colors;
    if (mesh.harmonics) {
      const { owners, harmonics } = shadingOf(mesh, part);
      this.#upload(`${level}/base`, colors);
      this.#upload(`${level}/owners`, owners);
      this.#upload(`${level}/harmonics`, harmonics);
      this.#allocate(`${level}/values`, colors.byteLength);
    } else {
      this.#upload(`${level}/values`, colors);
    }
    this.crop(this.kept ?? null);
    if (this.problem) throw new Error(this.problem);
    return part ? 1 - part.count / (mesh.faces.length / 3) : 0;
  }

  // kept as in SortedRenderer.crop.
  crop(kept) {
    this.kept = kept;
    for (const level of Object.keys(this.levels)) this.#choose(level, kept?.[level].triangles);
  }

  // Uploads the triangles `chosen`, all by default, of a level.
  #choose(level, chosen) {
    const { mesh, part } = this.levels[level];
    if (part) chosen = (chosen ?? counting(mesh.faces.length / 3)).filter(f => part.kept[f]);
    const pick = (array, width) => {
      if (!array || !chosen) return array;
      const some = new array.constructor(chosen.length * width);
      for (let i = 0; i < chosen.length; i++) {
        for (let k = 0; k < width; k++) some[width * i + k] = array[width * chosen[i] + k];
      }
      return some;
    };
    const faces = pick(mesh.faces, 3), splat = pick(mesh.splat, 1), group = pick(mesh.group, 1);
    if (part) for (let i = 0; i < faces.length; i++) faces[i] = part.vertexOf[faces[i]];
    const vertices = part?.vertices ?? mesh.vertices, runs = findRuns(faces, splat), F = faces.length / 3;
    const counts = { one: 1, vertices: vertices.length / 3, faces: F, runs: runs.length, splats: 0, fans: 0,
      groups: 0, harmonics: mesh.harmonics?.terms ?? 0 };
    let offsets = [3 * F, 0, 0];
    const parts = [faces, runs];
    if (this.kernels.groups) {
      const { ofFace, largest } = findGroups(vertices, faces, group);
      parts.push(ofFace, largest);
      offsets = [3 * F, 3 * F + runs.length, 3 * F + runs.length + F];
      counts.groups = largest.length;
    }
    if (mesh.filter > 0 || this.kernels.order === "splat") {
      const fans = findFans(splat);
      counts.splats = (fans.length - 1) / 2;
      if (mesh.filter > 0) counts.fans = counts.splats;
      this.#upload(`${level}/fans`, fans);
    }
    Object.assign(this.levels[level], { counts, offsets });
    const joined = new Uint32Array(parts.reduce((sum, one) => sum + one.length, 0));
    parts.reduce((at, one) => { joined.set(one, at); return at + one.length; }, 0);
    this.#upload(`${level}/mesh`, joined);
    this.#allocate("projected", 16 * (counts.vertices + 2 * counts.groups));
    this.#allocate("group_bounds", 8 * counts.groups);
    this.#allocate("boxes", 8 * runs.length);
    this.#allocate("offsets", 4 * runs.length);
  }

  // A buffer of at least `bytes`; its contents are lost if it grows.
  #allocate(name, bytes) {
    const size = Math.max(64, Math.ceil(bytes / 16) * 16), old = this.buffers[name];
    if (old && old.size >= size) return;
    if (size > this.most)
      throw new Error(`${name} needs ${Math.ceil(size / 2 ** 20)} MiB, more than WebGPU allows here`);
    old?.destroy();
    const { UNIFORM, STORAGE, COPY_DST, COPY_SRC, INDIRECT } = GPUBufferUsage;
    const uniform = ["frame", "digits", "show"].includes(name);
    const indirect = ["plan", "lists", "again"].includes(name) ? INDIRECT : 0;
    const usage = uniform ? UNIFORM | COPY_DST : STORAGE | COPY_DST | COPY_SRC | indirect;
    this.buffers[name] = this.device.createBuffer({ size, usage });
    this.groupsOfBindings.clear();
  }

  #upload(name, values) {
    this.#allocate(name, values.byteLength);
    if (values.byteLength) this.device.queue.writeBuffer(this.buffers[name], 0, values);
  }

  // ---- Frames

  // Draws one sample in each pixel of a level and shows the mean of it and of the frames since the last one
  // with `first`. filterScale: size of the image in that of the canvas, for the low-pass filter of the mesh.
  // stop(): whether the image is not wanted any more; then the canvas stays as it is, and the next frame has
  // to be a first one.
  async draw(level, pinhole, { first, background, gain, filterScale, stop = () => false }) {
    const { width, height } = pinhole, { mesh, counts } = this.levels[level];
    if (width * height > this.mostPixels) throw new Error("the image is too large");
    this.#allocate("total", 16 * width * height);
    this.frames = first ? 1 : this.frames + 1;
    const show = { width, height, first, background, gain, linear: mesh.blending === "linear" };
    // The whole image, or strips of it where tile lists or samples do not fit the device.
    const waiting = [[0, height]];
    while (waiting.length) {
      const [top, rows] = waiting.pop();
      if (!this.#fits(width, rows) || (counts.faces &&
        !await this.#drawStrip(level, pinhole, top, rows, filterScale, stop))) {
        if (rows <= ROWS) throw new Error("the tile lists need more memory than WebGPU allows here");
        const upper = ROWS * Math.ceil(rows / 2 / ROWS);
        waiting.push([top + upper, rows - upper], [top, upper]);
        continue;
      }
      if (stop()) return;
      this.#collect({ ...show, top, rows }, !counts.faces);
    }
    this.#paint();
  }

  #fits(width, rows) {
    const { tiles, window } = this.kernels.limits;
    return Math.ceil(width / TILE) * Math.ceil(rows / TILE) <= tiles &&
      width * rows <= Math.min(window, this.most / 32);
  }

  // Draws some rows of the image to `samples`, unless stop(); false if they have too many pairs of a run and
  // a tile.
  async #drawStrip(level, pinhole, top, rows, filterScale, stop) {
    const strip = { ...pinhole, cy: pinhole.cy - top, height: rows };
    this.#prepare(level, strip, filterScale);
    // Loop iterations of one walk through a tile list, one limit after the other until all tiles are
    // finished. Software drivers cut loops after 65,535 iterations; walks are counted high, so the first is
    // safe, and the second mostly.
    const { budgets, pairs, rounds } = this.kernels.limits;
    const fromTheStart = () => [...this.kernels.lists, ...this.kernels.raster,
      ...this.pipelines.raster_again ? this.kernels.again : []];
    let steps = fromTheStart(), walks = -1, at = budgets.indexOf(this.budget);
    for (let round = 0; ; round++) {
      const counters = await this.#run(level, steps);
      if (this.problem) throw new Error(this.problem);
      if (stop()) return true;
      if (counters[0] > this.capacity) {
        const most = Math.min(pairs, Math.floor(this.most / 8));
        if (counters[0] > most) return false;
        this.capacity = Math.min(most, Math.ceil(counters[0] * 1.25));
        this.#prepare(level, strip, filterScale);
        continue;
      }
      if (counters[2] === this.tiles) return true;
      if (counters[9] || counters[12] || walks === counters[3] || round > rounds) {
        if (++at === budgets.length) throw new Error("the graphics device did not finish the image");
        this.budget = budgets[at];
        this.#prepare(level, strip, filterScale);
        steps = fromTheStart();
        walks = -1;
        round = 0;
        continue;
      }
      walks = counters[3];
      steps = this.kernels.again;
      // Not all meshes have tiles that need it, and this shader is one of the two that take longest.
      if (!this.pipelines.raster_again) await this.#compileKernel("raster_again", "again", "raster");
    }
  }

  #prepare(level, pinhole, filterScale) {
    const { width, height } = pinhole, { mesh, counts, offsets } = this.levels[level];
    this.tiles = Math.ceil(width / TILE) * Math.ceil(height / TILE);
    // In the order of the splats, the runs themselves are sorted first.
    const room = Math.max(this.capacity, this.kernels.order === "splat" ? counts.runs : 0);
    const blocks = Math.ceil(room / 2048);
    this.#allocate("pairs_a", 8 * room);
    this.#allocate("pairs_b", 8 * room);
    this.#allocate("table", 4 * 256 * blocks);
    this.#allocate("sums", 4 * (2 + Math.max(Math.ceil(256 * blocks / 2048), Math.ceil(counts.runs / 2048))));
    this.#allocate("lists", 16 * (this.tiles + 1));
    this.#allocate("again", 16 * (this.tiles + 1));
    this.#allocate("samples", 32 * width * height);
    const filter = mesh.filter * filterScale * filterScale;
    this.device.queue.writeBuffer(this.buffers.frame, 0,
      frameUniform(pinhole, counts, this.capacity, offsets, filter, this.budget));
  }

  // Runs steps and returns the counters.
  async #run(level, steps) {
    const counts = { ...this.levels[level].counts, tiles: this.tiles },
      encoder = this.device.createCommandEncoder();
    let pass = null;
    for (const step of steps) {
      if (step.clear) {
        pass?.end();
        pass = null;
        encoder.clearBuffer(this.buffers[step.clear], step.from);
        continue;
      }
      if (step.if && !counts[step.if]) continue;
      pass ??= encoder.beginComputePass();
      pass.setPipeline(this.pipelines[step.kernel]);
      pass.setBindGroup(0, this.#bindings(level, step));
      if (step.indirect) {
        pass.dispatchWorkgroupsIndirect(this.buffers[step.indirect[0]], step.indirect[1]);
      } else {
        pass.dispatchWorkgroups(Math.ceil(counts[step.count[0]] / step.count[1]));
      }
    }
    pass?.end();
    encoder.copyBufferToBuffer(this.buffers.counters, 0, this.back, 0, 64);
    this.device.queue.submit([encoder.finish()]);
    await this.back.mapAsync(GPUMapMode.READ);
    const counters = new Uint32Array(this.back.getMappedRange().slice(0));
    this.back.unmap();
    return counters;
  }

  #bindings(level, step) {
    if (!this.groupsOfBindings.has(level)) this.groupsOfBindings.set(level, new Map());
    const all = this.groupsOfBindings.get(level), known = all.get(step);
    if (known) return known;
    const entries = Object.entries(step.bind).map(([binding, name]) => {
      const [base, index] = name.split("."), buffer = this.buffers[`${level}/${base}`] ?? this.buffers[base];
      const part = index === undefined ? {} : { offset: 256 * Number(index), size: 16 };
      return { binding: Number(binding), resource: { buffer, ...part } };
    });
    const made = this.device.createBindGroup(
      { layout: this.pipelines[step.kernel].getBindGroupLayout(0), entries });
    all.set(step, made);
    return made;
  }

  // ---- The canvas

  // Adds the samples of some rows to the image; without triangles, transparent ones.
  #collect({ width, height, first, background, gain, linear, top, rows }, empty) {
    const { device, canvas } = this;
    this.#allocate("samples", 32 * width * rows);
    const floats = new Float32Array(16), words = new Uint32Array(floats.buffer);
    floats.set([...background, gain]);
    words.set([width, height], 4);
    floats.set([canvas.width, canvas.height, 1 / this.frames], 6);
    words.set([Number(linear), Number(first), top, rows], 9);
    device.queue.writeBuffer(this.buffers.show, 0, floats);
    if (empty)
      device.queue.writeBuffer(this.buffers.samples, 0,
        new Float32Array(4 * width * rows).map((_, i) => Number(i % 4 === 3)));
    const encoder = device.createCommandEncoder(), collect = encoder.beginComputePass();
    collect.setPipeline(this.pipelines.collect);
    collect.setBindGroup(0, this.#shown(this.pipelines.collect, [[0, "show"], [1, "samples"], [2, "total"]]));
    collect.dispatchWorkgroups(Math.ceil(width / 8), Math.ceil(rows / 8));
    collect.end();
    device.queue.submit([encoder.finish()]);
  }

  #paint() {
    const { device } = this, encoder = device.createCommandEncoder();
    const view = this.context.getCurrentTexture().createView();
    const paint = encoder.beginRenderPass({ colorAttachments: [
      { view, loadOp: "clear", storeOp: "store" }] });
    paint.setPipeline(this.painter);
    paint.setBindGroup(0, this.#shown(this.painter, [[0, "show"], [3, "total"]]));
    paint.draw(3);
    paint.end();
    device.queue.submit([encoder.finish()]);
  }

  #shown(pipeline, names) {
    const entries = names.map(([binding, name]) => ({ binding, resource: { buffer: this.buffers[name] } }));
    return this.device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries });
  }
}
