// WebGL2: the mesh with its triangles sorted by their centres, and the splats. Not exact, as triangles that
// overlap in depth are not split, but quick, and it runs where WebGPU is missing. A mesh in the order of its
// splats is blended in that order. Surfaces are opaque, so a depth buffer sorts them.

import { fanMiddles, middlesOf } from "./crop.js";
import { depthsOf, sortFarToNear, sortFarToNearExactly } from "./order.js";
import { counting, ownersOf } from "./scene.js";
import { PRESENT_FRAGMENT, PRESENT_VERTEX, SPLAT_FRAGMENT, SPLAT_VERTEX, meshFragment, meshVertex }
  from "./shaders.js";

const WIDTH = 4096; // texels in a row of a data texture
// triangles and pixels of a draw call: long ones block slow devices, or lose them
const PART = 1 << 18, FILL = 1 << 22;
const SOLID = { blended: -1, opaque: 1, wireframe: 0.8 };

export class SortedRenderer {
  // levels: meshes by name; others may be added later. note(text) is told what the device lacks. Throws where
  // there is no WebGL2.
  constructor(canvas, levels, splats, note) {
    const gl = canvas.getContext("webgl2", { alpha: true, antialias: false, premultipliedAlpha: true });
    if (!gl) throw new Error("this browser has no WebGL2");
    Object.assign(this, { canvas, gl, levels, splats, note, triangles: {}, frames: new Map() });
    // Phones may have the second one alone, which suffices for the format here.
    this.float = Boolean(gl.getExtension("EXT_color_buffer_float") ??
      gl.getExtension("EXT_color_buffer_half_float"));
    if (!this.float && !this.lost) note("WebGL draws with 8 bits a colour here: faint layers are lost.");
    this.longest = gl.getParameter(gl.MAX_TEXTURE_SIZE); // texels
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    this.name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : gl.getParameter(gl.RENDERER);
    this.programs = { present: program(gl, PRESENT_VERTEX, PRESENT_FRAGMENT) };
    this.cloud = null;
  }

  // Whether the device has taken everything with it.
  get lost() { return this.gl.isContextLost(); }

  async #needMesh(level) {
    if (this.triangles[level]) return this.triangles[level];
    const { gl } = this, mesh = this.levels[level], { fans } = mesh, F = mesh.faces.length / 3,
      V = mesh.vertices.length / 3;
    const harmonics = this.#harmonicsOf(mesh), { uv } = mesh, terms = harmonics?.terms ?? 0;
    const drawing = this.programs[`mesh ${uv ? "textured" : terms}`] ??= program(
      gl, meshVertex(terms, uv), meshFragment(uv));
    const brightest = mesh.colors.reduce((most, value) => Math.max(most, value), 1), bright = brightest > 1;
    const largest = bright ? 65535 : 255, colors = new (bright ? Uint16Array : Uint8Array)(4 * V);
    for (let i = 0; i < 4 * V; i++)
      colors[i] = Math.round(largest * mesh.colors[i] / (i % 4 === 3 ? 1 : brightest));
    const attributes = [["position", mesh.vertices, 3, gl.FLOAT],
      ["color", colors, 4, bright ? gl.UNSIGNED_SHORT : gl.UNSIGNED_BYTE]], textures = {};
    if (harmonics) {
      attributes.push(["owner", ownersOf(mesh), 1, gl.UNSIGNED_INT]);
      textures.harmonics = texture(gl, gl.RGBA16I, gl.RGBA_INTEGER, gl.SHORT, inFours(harmonics.values));
    }
    if (uv) {
      attributes.push(["coordinate", uv, 2, gl.FLOAT]);
      mesh.image = await shrunk(mesh.image, this.longest, this.note);
      textures.picture = picture(gl, mesh);
    }
    // In the order of the splats, the centres have the precision of the core's.
    const bySplat = mesh.order === "splat", middles = bySplat ? middlesOf(mesh, fans, Float64Array)
      : fanMiddles(mesh), centers = bySplat || fans.length - 1 === F ? middles
      : middlesOf(mesh, counting(F + 1));
    this.triangles[level] = {
      ...indexedArray(gl, drawing, attributes), drawing, textures, brightest,
      harmonicStep: harmonics?.step ?? 0, centers, middles, fans, bySplat, order: new Uint32Array(F),
      depths: new Float32Array(F), fanDepths: new Float32Array(fans.length - 1),
      fanOrder: new Uint32Array(fans.length - 1), count: 0,
    };
    this.crop(this.kept ?? null);
    return this.triangles[level];
  }

  // Those of a mesh, where a texture holds them.
  #harmonicsOf({ harmonics }) {
    if (!harmonics || harmonics.values.length / 3 <= WIDTH * this.longest) return harmonics;
    this.note("WebGL draws without view-dependent colour: its textures are too small for it on this device.");
    return null;
  }

  #needSplats() {
    if (this.cloud) return this.cloud;
    const { gl, splats } = this, n = splats.count, four = new Float32Array(4 * n),
      shapes = new Float32Array(8 * n);
    this.programs.splats = program(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    for (let i = 0; i < n; i++) {
      four.set(splats.means.subarray(3 * i, 3 * i + 3), 4 * i);
      shapes.set(splats.covariances.subarray(6 * i, 6 * i + 6), 8 * i);
    }
    this.cloud = {
      textures: {
        means: texture(gl, gl.RGBA32F, gl.RGBA, gl.FLOAT, four),
        shapes: texture(gl, gl.RGBA32F, gl.RGBA, gl.FLOAT, shapes),
        colors: texture(gl, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, splats.colors),
      },
      ...vertexArray(gl, this.programs.splats), order: new Uint32Array(n), depths: new Float32Array(n),
    };
    this.crop(this.kept ?? null);
    return this.cloud;
  }

  // kept: {splats, and by level {fans, triangles}}, lists of indices in ascending order; null: everything.
  crop(kept) {
    this.kept = kept;
    for (const [level, all] of Object.entries(this.triangles)) {
      all.fanItems = kept ? kept[level].fans : counting(all.fans.length - 1);
      all.items = kept ? kept[level].triangles : counting(all.order.length);
    }
    if (this.cloud) {
      this.cloud.items = kept ? kept.splats : counting(this.splats.count);
    }
  }

  // Draws parts [{what: "mesh", "splats" or "surface", from, to}] of the image's width, 0 to 1, and leaves
  // the rest of the canvas transparent. scale: size of the image in that of the canvas; still: triangles are
  // sorted one by one, not fan by fan, unless the mesh is in the order of its splats, and the device may take
  // its time, unless stop() says that the image is not wanted any more: then the canvas stays as it is, and
  // the result is false. An error says at which `part` and level it arose.
  async draw({ view, level, parts, style, still, scale, background, gain, stop }) {
    const { gl, canvas } = this, w = Math.max(1, Math.round(canvas.width * scale));
    const h = Math.max(1, Math.round(canvas.height * scale)), pinhole = view.pinhole(w, h), images = [];
    const goesOn = still ? async () => { await this.#idle(); return !stop(); } : () => true;
    for (const { what } of parts) {
      try {
        images.push(what === "splats" ? await this.#drawSplats(pinhole, scale, goesOn) : what === "mesh"
          ? await this.#drawMesh("mesh", level, pinhole, style, still, goesOn)
          : await this.#drawMesh(what, what, pinhole, style === "blended" ? "opaque" : style, still, goesOn));
      } catch (error) {
        throw Object.assign(error, { part: what, level });
      }
      if (!images.at(-1)) return false;
    }
    for (const [key, frame] of this.frames) if (!images.includes(frame.image)) this.#free(key);
    gl.disable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    parts.forEach(({ what, from, to }, i) => {
      gl.viewport(0, 0, canvas.width, canvas.height);
      gl.enable(gl.SCISSOR_TEST);
      const x0 = Math.round(from * canvas.width), x1 = Math.round(to * canvas.width);
      gl.scissor(x0, 0, Math.max(0, x1 - x0), canvas.height);
      const { id, at } = this.programs.present;
      gl.useProgram(id);
      bindTextures(gl, this.programs.present, { image: images[i] });
      gl.uniform3fv(at("background"), background);
      gl.uniform1f(at("gain"), gain);
      gl.uniform1i(at("linear"), Number(what === "mesh" && this.levels[level].blending === "linear"));
      gl.disable(gl.BLEND);
      gl.disable(gl.DEPTH_TEST);
      gl.drawArrays(gl.TRIANGLES, 0, 3);
      gl.disable(gl.SCISSOR_TEST);
    });
    return true;
  }

  // goesOn(): waited for between the draw calls; whether the image is still wanted.
  async #drawMesh(what, level, pinhole, style, still, goesOn) {
    const { gl } = this, all = await this.#needMesh(level), opaque = style === "opaque",
      wires = style === "wireframe";
    if (!opaque) this.#sortMesh(all, pinhole, still);
    const list = opaque ? all.items : all.order.subarray(0, all.count);
    const frame = this.#frame(what, pinhole.width, pinhole.height, 4, opaque), corners = wires ? 6 : 3;
    for (let bottom = 0; bottom < frame.height; bottom += frame.rows) {
      for (let at = 0; at === 0 || at < list.length; at += PART) {
        if (bottom + at > 0 && !await goesOn()) return null;
        const some = list.subarray(at, at + PART);
        this.#begin(frame, all.drawing, pinhole, bottom, at === 0);
        if (opaque) {
          gl.disable(gl.BLEND);
          gl.enable(gl.DEPTH_TEST);
        }
        const place = all.drawing.at;
        bindTextures(gl, all.drawing, all.textures);
        gl.uniform1f(place("solid"), SOLID[style]);
        gl.uniform1f(place("brightest"), all.brightest);
        gl.uniform1f(place("harmonicStep"), all.harmonicStep);
        gl.uniform3fv(place("eye"), pinhole.center);
        gl.bindVertexArray(all.array);
        gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, cornersOf(this.levels[level].faces, some, wires),
          gl.STREAM_DRAW);
        gl.drawElements(wires ? gl.LINES : gl.TRIANGLES, corners * some.length, gl.UNSIGNED_INT, 0);
        gl.bindVertexArray(null);
      }
      resolve(gl, frame, bottom);
    }
    return frame.image;
  }

  // Until the device has done what it was given.
  async #idle() {
    const { gl } = this, fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED)
      await new Promise(done => setTimeout(done, 2));
    gl.deleteSync(fence);
  }

  #sortMesh(all, pinhole, still) {
    const row = pinhole.rows[2];
    if (!all.bySplat && (still || all.fans.length - 1 === all.order.length)) {
      depthsOf(all.centers, row, pinhole.near, all.depths);
      sortFarToNear(all.depths, all.items, all.order);
      all.count = all.items.length;
      return;
    }
    depthsOf(all.middles, row, all.bySplat ? -Infinity : pinhole.near, all.fanDepths);
    const sort = all.bySplat ? sortFarToNearExactly : sortFarToNear;
    sort(all.fanDepths, all.fanItems, all.fanOrder);
    let at = 0;
    for (let i = 0; i < all.fanItems.length; i++) {
      const fan = all.fanOrder[i];
      for (let f = all.fans[fan]; f < all.fans[fan + 1]; f++) all.order[at++] = f;
    }
    all.count = at;
  }

  async #drawSplats(pinhole, scale, goesOn) {
    const { gl } = this, all = this.#needSplats();
    depthsOf(this.splats.means, pinhole.rows[2], pinhole.near, all.depths);
    sortFarToNear(all.depths, all.items, all.order);
    const frame = this.#frame("splats", pinhole.width, pinhole.height, 0, false);
    const list = all.order.subarray(0, all.items.length);
    for (let bottom = 0; bottom < frame.height; bottom += frame.rows) {
      if (bottom > 0 && !await goesOn()) return null;
      this.#begin(frame, this.programs.splats, pinhole, bottom, true);
      bindTextures(gl, this.programs.splats, all.textures);
      gl.bindVertexArray(all.array);
      gl.bindBuffer(gl.ARRAY_BUFFER, all.buffer);
      gl.bufferData(gl.ARRAY_BUFFER, list, gl.STREAM_DRAW);
      gl.uniform1f(this.programs.splats.at("dilation"), 0.3 * scale * scale);
      gl.uniform1i(this.programs.splats.at("antialiased"), Number(this.splats.kernel === "antialiased"));
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, list.length);
      gl.bindVertexArray(null);
    }
    return frame.image;
  }

  // The rows of a frame from `bottom` on. A target with samples has the size of one strip, another that of
  // the image.
  #begin(frame, { id, at }, pinhole, bottom, clear) {
    const { gl } = this, low = frame.target === frame.plain ? bottom : 0;
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame.target);
    gl.viewport(0, low - bottom, frame.width, frame.height);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(0, low, frame.width, frame.rows);
    gl.clearColor(0, 0, 0, 0);
    gl.depthMask(true);
    if (clear) gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.useProgram(id);
    pinhole.rows.forEach((row, k) => gl.uniform4fv(at("row" + k), row));
    gl.uniform4f(at("lens"), pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy);
    gl.uniform3f(at("size"), pinhole.width, pinhole.height, pinhole.near);
  }

  #free(key) {
    for (const free of this.frames.get(key).free) free();
    this.frames.delete(key);
  }

  // A frame buffer of that size for a part of the image, drawn in strips of some rows, kept until another
  // size is asked for, or an image without that part.
  #frame(what, width, height, samples, depth) {
    const { gl } = this, format = this.float ? gl.RGBA16F : gl.RGBA8, key = `${what} ${depth}`;
    const old = this.frames.get(key);
    if (old && old.width === width && old.height === height) return old;
    if (old) this.#free(key);
    const rows = Math.max(1, Math.min(height, Math.floor(FILL / width)));
    const frame = { width, height, rows, free: [] };
    frame.image = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, frame.image);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T])
      gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    frame.target = frame.plain = framebuffer(gl, frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, frame.image, 0);
    frame.free.push(() => gl.deleteTexture(frame.image));
    const most = gl.getInternalformatParameter(gl.RENDERBUFFER, format, gl.SAMPLES)[0] ?? 0;
    if (samples && most) {
      if (rows < height) {
        frame.strip = framebuffer(gl, frame);
        attach(gl, frame, gl.COLOR_ATTACHMENT0, format, 0, rows);
      }
      frame.target = framebuffer(gl, frame);
      attach(gl, frame, gl.COLOR_ATTACHMENT0, format, Math.min(samples, most), rows);
      if (depth) attach(gl, frame, gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24, Math.min(samples, most), rows);
    } else if (depth) {
      attach(gl, frame, gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT24, 0, height);
    }
    this.frames.set(key, frame);
    return frame;
  }
}

function framebuffer(gl, frame) {
  const made = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, made);
  frame.free.push(() => gl.deleteFramebuffer(made));
  return made;
}

function attach(gl, frame, place, format, samples, rows) {
  const buffer = gl.createRenderbuffer();
  gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
  gl.renderbufferStorageMultisample(gl.RENDERBUFFER, samples, format, frame.width, rows);
  gl.framebufferRenderbuffer(gl.FRAMEBUFFER, place, gl.RENDERBUFFER, buffer);
  frame.free.push(() => gl.deleteRenderbuffer(buffer));
}

// The rows of a frame that were drawn, from `bottom` on, to its image. Samples are resolved where they are;
// only then are they moved.
function resolve(gl, { target, strip, plain, width, height, rows }, bottom) {
  if (target === plain) return;
  gl.disable(gl.SCISSOR_TEST);
  const some = Math.min(rows, height - bottom), moves = strip ? [[target, strip, 0], [strip, plain, bottom]]
    : [[target, plain, 0]];
  for (const [from, to, low] of moves) {
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, from);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, to);
    gl.blitFramebuffer(0, 0, width, some, 0, low, width, low + some, gl.COLOR_BUFFER_BIT, gl.NEAREST);
  }
}

function program(gl, vertex, fragment) {
  const id = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(id, shader);
  }
  gl.linkProgram(id);
  if (!gl.getProgramParameter(id, gl.LINK_STATUS) && !gl.isContextLost()) { // else there is nothing to tell
    const logs = gl.getAttachedShaders(id).map(shader => gl.getShaderInfoLog(shader));
    throw new Error(`a shader does not compile: ${[...logs, gl.getProgramInfoLog(id)].join(" ")}`);
  }
  const places = new Map();
  const at = name => {
    if (!places.has(name)) places.set(name, gl.getUniformLocation(id, name));
    return places.get(name);
  };
  return { id, at };
}

// Indices of the vertices of `some` triangles, three each; of their edges, two each.
function cornersOf(faces, some, edges) {
  const indices = new Uint32Array((edges ? 6 : 3) * some.length);
  for (let i = 0, at = 0; i < some.length; i++) {
    const from = 3 * some[i], a = faces[from], b = faces[from + 1], c = faces[from + 2];
    indices[at++] = a;
    indices[at++] = b;
    if (edges) indices[at++] = b;
    indices[at++] = c;
    if (edges) {
      indices[at++] = c;
      indices[at++] = a;
    }
  }
  return indices;
}

// Vertices with their attributes [name, values, width, type], and room for indices.
function indexedArray(gl, { id }, attributes) {
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  for (const [name, values, width, type] of attributes) {
    const at = gl.getAttribLocation(id, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at);
    if (type === gl.UNSIGNED_INT) gl.vertexAttribIPointer(at, width, type, 0, 0);
    else gl.vertexAttribPointer(at, width, type, type !== gl.FLOAT, 0, 0);
  }
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bindVertexArray(null);
  return { array };
}

// One index an instance, far ones first.
function vertexArray(gl, { id }) {
  const array = gl.createVertexArray(), buffer = gl.createBuffer(), at = gl.getAttribLocation(id, "item");
  gl.bindVertexArray(array);
  gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
  gl.enableVertexAttribArray(at);
  gl.vertexAttribIPointer(at, 1, gl.UNSIGNED_INT, 0, 0);
  gl.vertexAttribDivisor(at, 1);
  gl.bindVertexArray(null);
  return { array, buffer };
}

// Triples as the first three of four.
function inFours(triples) {
  const fours = new triples.constructor(triples.length / 3 * 4);
  for (let i = 0; i < triples.length / 3; i++) fours.set(triples.subarray(3 * i, 3 * i + 3), 4 * i);
  return fours;
}

function texture(gl, format, layout, type, values) {
  const texels = values.length / 4, rows = Math.max(1, Math.ceil(texels / WIDTH));
  if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("the scene is too large for WebGL2 here");
  const padded = new values.constructor(4 * WIDTH * rows);
  padded.set(values);
  const id = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, id);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, WIDTH, rows);
  gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDTH, rows, layout, type, padded);
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  return id;
}

// A picture with sides of at most `most` pixels.
async function shrunk(image, most, note) {
  const { width, height } = image, side = Math.max(width, height);
  if (side <= most) return image;
  note(`WebGL takes textures of ${most} texels here: that of the surface, of ${side}, is made smaller.`);
  const [resizeWidth, resizeHeight] = [width, height].map(texels => Math.ceil(texels * most / side));
  const smaller = await createImageBitmap(image, { resizeWidth, resizeHeight, resizeQuality: "high",
    colorSpaceConversion: "none", premultiplyAlpha: "none" });
  image.close();
  return smaller;
}

// The texture of a surface.
function picture(gl, { image, wrap }) {
  const most = gl.getParameter(gl.MAX_TEXTURE_SIZE), side = Math.max(image.width, image.height);
  if (side > most) throw new Error(`a texture of ${side} texels is too large for WebGL2 here (${most})`);
  const modes = { clamp: gl.CLAMP_TO_EDGE, repeat: gl.REPEAT, mirror: gl.MIRRORED_REPEAT };
  const id = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, id);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
  gl.generateMipmap(gl.TEXTURE_2D);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, modes[wrap[0]]);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, modes[wrap[1]]);
  return id;
}

function bindTextures(gl, { at }, textures) {
  Object.entries(textures).forEach(([name, id], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, id);
    gl.uniform1i(at(name), unit);
  });
}
