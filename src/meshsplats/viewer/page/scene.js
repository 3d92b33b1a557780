// The packed scene: base64 text, gzip, rows of whole numbers, and what they decode to. Python writes it
// (streams.py, packing.py); both sides compute with the same numbers in the same order.

export const MAGIC = "MSplat01";

export function bytesOf(base64) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
  const text = atob(base64), bytes = new Uint8Array(text.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

export async function unpack(base64) {
  const stream = new Blob([bytesOf(base64)]).stream().pipeThrough(new DecompressionStream("gzip"));
  const body = new Uint8Array(await new Response(stream).arrayBuffer());
  const text = new TextDecoder();
  if (text.decode(body.subarray(0, 8)) !== MAGIC) throw new Error("the scene in this page is damaged");
  const length = new DataView(body.buffer).getUint32(8, true);
  const header = JSON.parse(text.decode(body.subarray(12, 12 + length)));
  let at = 12 + length;
  const places = header.rows.map(([count, planes, delta]) => {
    const place = { count, planes, delta, at };
    at += count * planes;
    return place;
  });
  // Row `index` as doubles, which hold all its whole numbers.
  const row = index => {
    const { count, planes, delta, at } = places[index], values = new Float64Array(count);
    for (let i = 0, sum = 0; i < count; i++) {
      let code = 0;
      for (let k = planes - 1; k >= 0; k--) code = code * 256 + body[at + k * count + i];
      const value = code % 2 ? -(code + 1) / 2 : code / 2;
      values[i] = sum = delta ? sum + value : value;
    }
    return values;
  };
  return { header, row, rows: (first, count) => Array.from({ length: count }, (_, k) => row(first + k)) };
}

// 0, 1, 2, ...
export function counting(n) {
  const values = new Uint32Array(n);
  for (let i = 0; i < n; i++) values[i] = i;
  return values;
}

// vertices (3 a vertex), colors (4), faces (3 a triangle), splat (1 a triangle) or null, group or null;
// fans: first triangle of each fan, and their count at the end; without fans, each triangle is one.
// harmonics: null or {terms, step, values}, with whole numbers of steps, 3 for each of the terms of a splat.
export function decodeMesh({ header, row, rows }) {
  const V = header.vertices, F = header.triangles;
  const mesh = {
    vertices: new Float32Array(3 * V), colors: new Float32Array(4 * V), faces: new Uint32Array(3 * F),
    splat: null, group: null, fans: null, blending: header.blending, filter: header.filter,
    order: header.order ?? "fragment", harmonics: null,
  };
  const steps = { ...header, row, rows, store: (v, x, y, z) => {
    mesh.vertices[3 * v] = x + header.origin[0];
    mesh.vertices[3 * v + 1] = y + header.origin[1];
    mesh.vertices[3 * v + 2] = z + header.origin[2];
  } };
  if (header.patterns) decodeFans(mesh, steps); else decodeVertices(mesh, steps);
  decodeFar({ header, row, rows }, mesh.vertices);
  const { color, alpha } = header;
  for (let v = 0; v < V; v++) {
    for (let c = 0; c < 3; c++) mesh.colors[4 * v + c] /= color;
    mesh.colors[4 * v + 3] /= alpha;
  }
  mesh.fans ??= mesh.order === "splat" ? startsOf(mesh.splat) : counting(F + 1);
  if (header.group >= 0) mesh.group = Int32Array.from(row(header.group));
  if (header.harmonics) mesh.harmonics = decodeHarmonics(header.harmonics, row);
  return mesh;
}

function decodeHarmonics({ terms, step, row: first }, row) {
  const width = 3 * terms;
  let values = null;
  for (let k = 0; k < width; k++) {
    const column = row(first + k);
    values ??= new Int16Array(width * column.length);
    for (let i = 0; i < column.length; i++) values[width * i + k] = column[i];
  }
  return { terms, step, values };
}

// A surface: a mesh with texture coordinates (2 a vertex) and the picture of its texture, or without both.
export async function decodeSurface(mesh, coordinates, picture) {
  const surface = decodeMesh(mesh);
  if (!coordinates) return surface;
  const { row, steps, wrap, type } = coordinates.header, [u, v] = coordinates.rows(row, 2);
  const uv = new Float32Array(2 * u.length);
  for (let i = 0; i < u.length; i++) uv.set([u[i] / steps, v[i] / steps], 2 * i);
  const image = await createImageBitmap(new Blob([bytesOf(picture)], { type }),
    { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  return Object.assign(surface, { uv, wrap, image });
}

// First triangle of each splat, and their count at the end.
export function startsOf(splat) {
  const starts = [];
  splat.forEach((name, f) => { if (f === 0 || name !== splat[f - 1]) starts.push(f); });
  return Uint32Array.from([...starts, splat.length]);
}

// The splat of each vertex, counted in the order of the triangles; 0 for a vertex of no triangle.
export function ownersOf({ vertices, faces, splat }) {
  const owners = new Uint32Array(vertices.length / 3);
  for (let f = 0, index = -1; f < splat.length; f++) {
    if (f === 0 || splat[f] !== splat[f - 1]) index++;
    for (let k = 3 * f; k < 3 * f + 3; k++) owners[faces[k]] = index;
  }
  return owners;
}

// Strays, as the two halves of their bits, into points (3 floats each).
function decodeFar({ header, row, rows }, points) {
  if (header.far < 0) return;
  const halves = rows(header.far_places, 6);
  const bits = new Uint32Array(points.buffer, points.byteOffset, points.length);
  row(header.far).forEach((point, i) => {
    for (let k = 0; k < 3; k++) bits[3 * point + k] = halves[k][i] * 65536 + halves[3 + k][i];
  });
}

function decodeVertices(mesh, { rows, row, store, step, attributes, faces, splat, vertices, triangles }) {
  const sums = new Float64Array(7), columns = rows(attributes, 7);
  for (let v = 0; v < vertices; v++) {
    for (let c = 0; c < 7; c++) sums[c] += columns[c][v];
    store(v, sums[0] * step, sums[1] * step, sums[2] * step);
    mesh.colors.set(sums.subarray(3), 4 * v);
  }
  const corners = rows(faces, 3);
  for (let i = 0, fresh = 0; i < 3 * triangles; i++) {
    const code = corners[i % 3][Math.floor(i / 3)];
    mesh.faces[i] = fresh - code;
    if (code === 0) fresh++;
  }
  if (splat >= 0) mesh.splat = Int32Array.from(row(splat));
}

function decodeFans(mesh, source) {
  const { row, rows, store, step, finer, patterns } = source, fine = step / finer, { colors } = mesh;
  const choice = row(source.choice), fanSplat = row(source.splat), count = choice.length;
  const first = new Uint32Array(count), fans = new Uint32Array(count + 1);
  const members = patterns.map(pattern => new Uint32Array(pattern.fans)), filled = patterns.map(() => 0);
  for (let i = 0, v = 0; i < count; i++) {
    const p = choice[i];
    members[p][filled[p]++] = i;
    first[i] = v;
    v += patterns[p].size;
    fans[i + 1] = fans[i] + patterns[p].faces.length;
  }
  mesh.fans = fans;
  mesh.splat = new Int32Array(fans[count]);
  for (let i = 0; i < count; i++) mesh.splat.fill(fanSplat[i], fans[i], fans[i + 1]);
  patterns.forEach((pattern, index) => {
    const own = members[index], n = own.length, m = pattern.size;
    const anchor = rows(pattern.anchor, 3).map(axis => axis.map(value => value * fine));
    const known = pattern.offsets.map(at => rows(at, 3).map(axis => axis.map(value => value * fine)));
    own.forEach((fan, i) => store(first[fan], anchor[0][i], anchor[1][i], anchor[2][i]));
    known.forEach((offset, k) => own.forEach((fan, i) => store(first[fan] + pattern.basis[k],
      anchor[0][i] + offset[0][i], anchor[1][i] + offset[1][i], anchor[2][i] + offset[2][i])));
    others(m, [0, ...pattern.basis]).forEach((vertex, r) => {
      const rest = rows(pattern.rest[r], 3);
      const weights = pattern.weights.slice(r * known.length, (r + 1) * known.length);
      const value = (axis, i) => {
        let predicted = 0;
        for (let k = 0; k < weights.length; k++) predicted = predicted + weights[k] * known[k][axis][i];
        return anchor[axis][i] + (predicted + rest[axis][i] * step);
      };
      for (let i = 0; i < n; i++) store(first[own[i]] + vertex, value(0, i), value(1, i), value(2, i));
    });

    const rgb = rows(pattern.rgb, 3);
    for (let vertex = 0; vertex < m; vertex++) {
      const shade = vertex ? rows(pattern.shades[vertex - 1], 3) : null;
      for (let c = 0; c < 3; c++) {
        for (let i = 0; i < n; i++) {
          colors[4 * (first[own[i]] + vertex) + c] = rgb[c][i] + (shade ? shade[c][i] : 0);
        }
      }
    }
    const alpha = pattern.alpha.map(row), basis = pattern.alpha_basis, K = basis.length;
    basis.forEach((vertex, k) => own.forEach(
      (fan, i) => { colors[4 * (first[fan] + vertex) + 3] = alpha[k][i]; }));
    others(m, basis).forEach((vertex, r) => {
      const rest = row(pattern.alpha_rest[r]);
      for (let i = 0; i < n; i++) {
        let predicted = 0;
        for (let k = 0; k < K; k++) predicted = predicted + pattern.alpha_weights[r * K + k] * alpha[k][i];
        colors[4 * (first[own[i]] + vertex) + 3] = Math.floor(predicted + 0.5) + rest[i];
      }
    });
    const local = pattern.faces.flat();
    for (let i = 0; i < n; i++) {
      const from = 3 * fans[own[i]], base = first[own[i]];
      for (let k = 0; k < local.length; k++) mesh.faces[from + k] = base + local[k];
    }
  });
}

function others(m, basis) {
  return Array.from({ length: m }, (_, i) => i).filter(i => !basis.includes(i));
}

// means (3 a splat), covariances (6: xx xy xz yy yz zz), colors (4 bytes: RGB and opacity).
export function decodeSplats({ header, row, rows }) {
  const n = header.splats;
  const splats = {
    count: n, kernel: header.kernel, means: new Float32Array(3 * n), covariances: new Float32Array(6 * n),
    colors: new Uint8Array(4 * n),
  };
  const means = rows(header.means, 3), scales = rows(header.scales, 3), rotations = rows(header.rotations, 3);
  const leader = row(header.leader), colors = rows(header.colors, 3), opacities = row(header.opacities);
  const q = new Float64Array(4), s = new Float64Array(3), m = new Float64Array(9);
  for (let i = 0; i < n; i++) {
    for (let k = 0; k < 3; k++) {
      splats.means[3 * i + k] = means[k][i] * header.step + header.origin[k];
      s[k] = header.largest * 2 ** (scales[k][i] / header.scale_steps);
      splats.colors[4 * i + k] = colors[k][i];
      q[(leader[i] + 1 + k) % 4] = rotations[k][i] / header.rotation_steps;
    }
    splats.colors[4 * i + 3] = opacities[i];
    q[leader[i]] = 0;
    q[leader[i]] = Math.sqrt(Math.max(0, 1 - q[0] * q[0] - q[1] * q[1] - q[2] * q[2] - q[3] * q[3]));
    const [w, x, y, z] = q;
    m.set([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
      2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
      2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]);
    for (let a = 0, at = 6 * i; a < 3; a++) {
      for (let b = a; b < 3; b++) {
        let sum = 0;
        for (let k = 0; k < 3; k++) sum += m[3 * a + k] * m[3 * b + k] * s[k] * s[k];
        splats.covariances[at++] = sum;
      }
    }
  }
  decodeFar({ header, row, rows }, splats.means);
  return splats;
}
