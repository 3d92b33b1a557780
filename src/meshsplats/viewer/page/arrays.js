// The arrays of a mesh for WebGPU: the part of it that fits the device, its runs and depth groups; and the
// uniform of a frame.

import { sortFarToNear } from "./order.js";
import { counting, ownersOf, startsOf } from "./scene.js";

export const TILE = 8;
const RUN = 8;
const NONE = 0xffffffff;
const DISPATCH = 65535; // workgroups along an axis, on every device

// The part of a mesh whose buffers fit into `most` bytes each, null if all of it does: the fans of the
// largest area times opacity. runs: most runs. kept: 1 for each triangle in it, count: how many; vertices,
// colors: its own; vertexOf: the new index of each old vertex.
export function fitting(mesh, most, runs, groups) {
  const { vertices, colors, faces, fans } = mesh, V = vertices.length / 3, F = faces.length / 3,
    n = fans.length - 1;
  // A triangle takes three indices, a share of a run and, with depth groups, two words and two projected
  // vertices.
  const all = findRuns(faces, mesh.splat).length, words = 3 + Math.max(all / F, n / F) + (groups ? 2 : 0);
  const room = Math.floor(most / 16) * (groups ? 1 / 3 : 1);
  const mostVertices = Math.min(room, 256 * DISPATCH);
  const mostFaces = Math.min(most / 4 / words, groups ? Math.min(room, 64 * DISPATCH) : Infinity,
    F * Math.min(1, (runs - 1) / all));
  const mostFans = Math.min(mesh.harmonics ? most / 12 / mesh.harmonics.terms : Infinity,
    mesh.filter > 0 ? Math.min(64 * DISPATCH, (most / 4 - 1) / 2)
      : mesh.order === "splat" ? Math.min(256 * DISPATCH, (most / 4 - 1) / 2) : Infinity);
  if (V <= mostVertices && F <= mostFaces && n <= mostFans) return null;
  const importance = new Float32Array(n), point = k => vertices.subarray(3 * k, 3 * k + 3);
  for (let fan = 0; fan < n; fan++) {
    for (let f = fans[fan]; f < fans[fan + 1]; f++) {
      const [a, b, c] = [0, 1, 2].map(k => faces[3 * f + k]), [p, q, r] = [a, b, c].map(point);
      const u = [0, 1, 2].map(k => q[k] - p[k]), v = [0, 1, 2].map(k => r[k] - p[k]);
      const area = Math.hypot(u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0]);
      importance[fan] += area * (colors[4 * a + 3] + colors[4 * b + 3] + colors[4 * c + 3]);
    }
  }
  const order = sortFarToNear(importance, counting(n), new Uint32Array(n));
  const kept = new Uint8Array(F), used = new Uint8Array(V);
  let count = 0, corners = 0;
  for (let i = 0; i < Math.min(n, mostFans); i++) {
    const from = fans[order[i]], to = fans[order[i] + 1];
    if (count + to - from > mostFaces || corners + 3 * (to - from) > mostVertices &&
      corners + fresh(faces, used, from, to) > mostVertices) break;
    for (let k = 3 * from; k < 3 * to; k++) {
      corners += 1 - used[faces[k]];
      used[faces[k]] = 1;
    }
    kept.fill(1, from, to);
    count += to - from;
  }
  if (!count) throw new Error("not even a part of the scene fits this graphics device");
  const part = { kept, count, vertexOf: new Uint32Array(V), vertices: new Float32Array(3 * corners),
    colors: new Float32Array(4 * corners) };
  for (let v = 0, at = 0; v < V; v++) {
    if (!used[v]) continue;
    part.vertices.set(point(v), 3 * at);
    part.colors.set(colors.subarray(4 * v, 4 * v + 4), 4 * at);
    part.vertexOf[v] = at++;
  }
  return part;
}

// The buffers `owners` and `harmonics` of docs/webgpu-host.md, of a mesh with harmonics or of a part of it.
export function shadingOf(mesh, part) {
  const { terms, step, values } = mesh.harmonics, width = 3 * terms, all = ownersOf(mesh);
  if (!part) return { owners: all, harmonics: Float32Array.from(values, value => value * step) };
  const owners = new Uint32Array(part.vertices.length / 3), places = new Map();
  mesh.faces.forEach((v, corner) => {
    if (!part.kept[Math.floor(corner / 3)]) return;
    if (!places.has(all[v])) places.set(all[v], places.size);
    owners[part.vertexOf[v]] = places.get(all[v]);
  });
  const harmonics = new Float32Array(width * places.size);
  for (const [splat, place] of places)
    for (let k = 0; k < width; k++) harmonics[width * place + k] = values[width * splat + k] * step;
  return { owners, harmonics };
}

// Vertices of some triangles that are not used yet.
function fresh(faces, used, from, to) {
  return new Set(faces.subarray(3 * from, 3 * to).filter(v => !used[v])).size;
}

// The uniform `frame` of docs/webgpu-host.md, one sample a pixel: 64 words, the last 3 unused. filter:
// variance in square samples. Each value of the pinhole is split into the nearest float32 and that of the
// rest.
export function frameUniform(
  { width, height, rows, center, fx, fy, cx, cy, near }, counts, capacity, offsets, filter, budget,
) {
  const floats = new Float32Array(64), words = new Uint32Array(floats.buffer);
  const split = (values, high, low) => {
    floats.set(values, high);
    floats.set(values.map(value => value - Math.fround(value)), low);
  };
  rows.forEach((row, k) => split(row.slice(0, 3), 4 * k, 44 + 4 * k));
  split(center, 12, 16);
  split([fx, fy, cx, cy], 20, 56);
  floats.set([near, 1e-6, -1, filter], 24);
  words.set([width, height, Math.ceil(width / TILE), Math.ceil(height / TILE)], 28);
  words.set([counts.vertices, counts.faces, counts.runs, counts.splats], 32);
  words.set([counts.groups, capacity, 0, budget, ...offsets, 1], 36);
  words[60] = counts.harmonics;
  return floats;
}

// Runs of up to 8 consecutive triangles: of one splat, or, without splats, such that each has a vertex of the
// one before. First face, and from bit 29 on the count less 1.
export function findRuns(faces, splat) {
  const F = faces.length / 3, runs = [];
  const joined = f => {
    if (splat) return splat[f] === splat[f - 1];
    for (let i = 3 * f; i < 3 * f + 3; i++)
      for (let j = 3 * f - 3; j < 3 * f; j++) if (faces[i] === faces[j]) return true;
    return false;
  };
  for (let f = 0, count = 0; f < F; f += count) {
    for (count = 1; count < RUN && f + count < F && joined(f + count);) count++;
    runs.push((f | ((count - 1) << 29)) >>> 0);
  }
  return Uint32Array.from(runs);
}

// The first triangle of each splat, and the count of triangles; then the first run of each splat.
export function findFans(splat) {
  const starts = startsOf(splat), runs = new Uint32Array(starts.length - 1);
  for (let i = 1; i < runs.length; i++) runs[i] = runs[i - 1] + Math.ceil((starts[i] - starts[i - 1]) / RUN);
  return Uint32Array.from([...starts, ...runs]);
}

// ofFace: the depth group of each face, without gaps, NONE for none; largest: the face of each with the
// largest area.
export function findGroups(vertices, faces, group) {
  const F = faces.length / 3, ofFace = new Uint32Array(F).fill(NONE), names = new Map(), largest = [],
    areas = [];
  for (let f = 0; group && f < F; f++) {
    if (group[f] < 0) continue;
    const p = [0, 1, 2].map(k => vertices.subarray(3 * faces[3 * f + k], 3 * faces[3 * f + k] + 3));
    const u = [0, 1, 2].map(c => p[1][c] - p[0][c]), v = [0, 1, 2].map(c => p[2][c] - p[0][c]);
    const area = (u[1] * v[2] - u[2] * v[1]) ** 2 + (u[2] * v[0] - u[0] * v[2]) ** 2 +
      (u[0] * v[1] - u[1] * v[0]) ** 2;
    if (!names.has(group[f])) {
      names.set(group[f], largest.length);
      largest.push(f);
      areas.push(area);
    }
    const g = names.get(group[f]);
    ofFace[f] = g;
    if (area > areas[g]) {
      areas[g] = area;
      largest[g] = f;
    }
  }
  return { ofFace, largest: Uint32Array.from(largest) };
}
