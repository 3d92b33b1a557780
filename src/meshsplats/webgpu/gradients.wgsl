// Backward pass: from the tape to the gradients of vertices.
//
// With B_k, the radiance behind fragment k, B_k = a_{k+1} c_{k+1} + (1 - a_{k+1}) B_{k+1} and the background
// at the end, dC/dc_k = T_k a_k and dC/da_k = T_k (c_k - B_k). `find_behind` goes through the tape of a
// sample from back to front, so nothing is divided by 1 - a.
//
// Values are v = sum_j b_j v_j with the weights b_j = s_j / sum s of the corners j, s = A p, p = (x, y, 1),
// and A the inverse of the matrix V whose columns are the corners, (x, y, 1) times depth. As ds = -A dV s, a
// gradient g of v gives
//     R_j = dL/dv_j = sum b_j g,  N_j = sum b_j g . (v - v_0),
//     dL/dV_j = -sum_k A_k^T (R_j . (v_k - v_0) - N_j)
// with sums over the samples. So a triangle needs fifteen sums. Those of each tile have a place of their own;
// a triangle adds its tiles and a vertex its triangles, in fixed orders: gradients have the same bits every
// time.

@group(0) @binding(10) var<storage, read> offsets: array<u32>;  // by run: its first pair in the order of emit
// by run: its tiles, as bound_runs has them
@group(0) @binding(11) var<storage, read> run_boxes: array<vec2u>;
@group(0) @binding(12) var<storage, read> plan: array<u32>;                // at 9 the count of pairs
@group(0) @binding(13) var<storage, read_write> fragment_starts: array<u32>;  // by sorted pair
@group(0) @binding(14) var<storage, read_write> sum_starts: array<u32>;    // by pair in the order of emit
// likewise: its triangles with fragments, one bit each
@group(0) @binding(15) var<storage, read_write> marked: array<u32>;
// four of each triangle in each tile: R_0, R_1, R_2, N
@group(0) @binding(16) var<storage, read_write> tile_sums: array<vec4f>;
@group(0) @binding(17) var<storage, read_write> face_sums: array<vec4f>;   // the same by face
// (vertices + 1) first corner; then 3 face + corner
@group(0) @binding(18) var<storage, read> vertex_corners: array<u32>;
// two by vertex: position, RGB and opacity
@group(0) @binding(19) var<storage, read_write> gradients: array<vec4f>;

const MOST_FRAGMENTS = 60000u;  // of a sample

fn tile_of(pair: vec2u) -> u32 { return (pair.x >> 24u) | ((pair.y >> 24u) << 8u); }
// The place of a sorted pair in the order of emit.
fn emitted(pair: vec2u) -> u32 {
  let run = pair.y & 0xffffffu;
  let box = run_boxes[run];
  let tile = tile_of(pair);
  let x0 = box.x & 0xffffu;
  let columns = (box.x >> 16u) - x0 + 1u;
  return offsets[run] + (tile / frame.tiles_x - (box.y & 0xffffu)) * columns + (tile % frame.tiles_x - x0);
}

// -------------------------------------------------------------------------------- places on the tape

@compute @workgroup_size(256)
fn count_marks(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= plan[9]) { return; }
  let pair = pairs[i];
  var total = 0u;
  var bits = 0u;
  for (var k = 0u; k < RUN; k++) {
    let marks = marks_of(RUN * i + k);
    let n = countOneBits(marks.x) + countOneBits(marks.y);
    atomicStore(&counters[first_of(RUN * i + k)], total);
    if (n > 0u) { bits |= 1u << k; }
    total += n;
  }
  fragment_starts[i] = total;
  if (bits != 0u) {
    let e = emitted(pair);
    sum_starts[e] = countOneBits(bits);
    marked[e] = bits;
  }
}

// After the prefix sums of both.
@compute @workgroup_size(256)
fn place_marks(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  let n = plan[9];
  if (i >= n) { return; }
  var bits = 0u;
  var total = 0u;
  let start = fragment_starts[i];
  for (var k = 0u; k < RUN; k++) {
    let marks = marks_of(RUN * i + k);
    let count = countOneBits(marks.x) + countOneBits(marks.y);
    if (count > 0u) { bits |= 1u << k; }
    total += count;
    atomicAdd(&counters[first_of(RUN * i + k)], start);
  }
  var sums = 0u;
  if (bits != 0u) { sums = sum_starts[emitted(pairs[i])] | (bits << 24u); }
  atomicStore(&counters[sums_of(i)], sums);
  if (i + 1u == n) {
    atomicStore(&counters[13], add_limited(start, total));
    atomicStore(&counters[14], add_limited(sum_starts[i], countOneBits(marked[i])));
  }
}
fn add_limited(a: u32, b: u32) -> u32 { return min(a, 0xffffffffu - b) + b; }

// -------------------------------------------------------------------------------- samples

// Replaces a record of the tape by the gradients of the fragment's colour, per gradient of the sample's, and
// opacity.
@compute @workgroup_size(8, 8)
fn find_behind(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.width || id.y >= frame.height) { return; }
  var at = samples[id.y * frame.width + id.x].x;
  var behind = pixel_gradient(id.x, id.y).w;
  for (var n = 0u; n < MOST_FRAGMENTS; n++) {
    if (at == NONE) { return; }
    let fragment = tape[at];
    let f = bitcast<vec4f>(fragment);  // opacity, RGB . gradient, transmittance
    let by_alpha = f.z - behind;
    behind = fma(f.y, by_alpha, behind);
    tape[at] = bitcast<vec4u>(vec4f(f.w * f.y, f.w * by_alpha, 0.0, 0.0));
    at = fragment.x;
  }
  if (at != NONE) { atomicStore(&counters[15], 1u); }
}

// -------------------------------------------------------------------------------- triangles

// Adds the samples of a triangle in a tile.
@compute @workgroup_size(256)
fn add_samples(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) t: u32) {
  for (var c = 0u; c < RUN; c++) {
    let i = 256u * wg.x + 32u * c + t / RUN;
    if (i < plan[9]) { add_tile(i, t % RUN); }
  }
}

fn add_tile(i: u32, k: u32) {
  let source = RUN * i + k;
  var marks = marks_of(source);
  if ((marks.x | marks.y) == 0u) { return; }
  let pair = pairs[i];
  let tile = tile_of(pair);
  let corner = vec2u(tile % frame.tiles_x, tile / frame.tiles_x) * TILE;
  let o = vec2f(corner);
  let face = unpack_run(mesh[frame.runs_at + (pair.y & 0xffffffu)]).first + k;
  let ids = vec3u(mesh[3u * face], mesh[3u * face + 1u], mesh[3u * face + 2u]);
  let p = array<Corner, 3>(corner_at(ids.x), corner_at(ids.y), corner_at(ids.z));
  let v0 = value_of(ids.x);
  let v1 = value_of(ids.y) - v0;
  let v2 = value_of(ids.z) - v0;
  let e0 = edge(p[1], p[2], o);
  let e1 = edge(p[2], p[0], o);
  let e2 = edge(p[0], p[1], o);
  var scale = vec3f(p[0].p.z, p[1].p.z, p[2].p.z);
  if (!all(scale > vec3f(0.0))) {
    let z = vec3f(depth_of(p[0].p), depth_of(p[1].p), depth_of(p[2].p));
    scale = vec3f(
      select(1.0, z.y * z.z, scale.y > 0.0 && scale.z > 0.0),
        select(1.0, z.z * z.x, scale.z > 0.0 && scale.x > 0.0),
      select(1.0, z.x * z.y, scale.x > 0.0 && scale.y > 0.0));
  }
  var at = atomicLoad(&counters[first_of(source)]);
  var r0 = vec4f(0.0);
  var r1 = vec4f(0.0);
  var r2 = vec4f(0.0);
  var n = vec4f(0.0);
  while ((marks.x | marks.y) != 0u) {
    var sample = 0u;
    if (marks.x != 0u) { sample = firstTrailingBit(marks.x); marks.x &= marks.x - 1u; }
    else { sample = 32u + firstTrailingBit(marks.y); marks.y &= marks.y - 1u; }
    let xy = vec2u(sample % TILE, sample / TILE);
    let at_sample = vec2f(xy) + 0.5;
    let s = scale * vec3f(edge_of(e0, at_sample), edge_of(e1, at_sample), edge_of(e2, at_sample));
    let b = s / (s.x + s.y + s.z);
    let f = bitcast<vec4f>(tape[at]);
    at++;
    let g = vec4f(f.x * pixel_gradient(corner.x + xy.x, corner.y + xy.y).xyz, f.y);
    r0 += b.x * g;
    r1 += b.y * g;
    r2 += b.z * g;
    n += vec4f(b * dot(g, fma(vec4f(b.y), v1, b.z * v2)), 0.0);
  }
  let sums = atomicLoad(&counters[sums_of(i)]);
  let to = 4u * ((sums & 0xffffffu) + countOneBits((sums >> 24u) & ((1u << k) - 1u)));
  tile_sums[to] = r0;
  tile_sums[to + 1u] = r1;
  tile_sums[to + 2u] = r2;
  tile_sums[to + 3u] = n;
}
fn edge_of(e: Edge, p: vec2f) -> f32 { return edge_at(vec4f(e.a, e.b, e.x, e.y), p, e.c); }

// Adds the tiles of the triangles of a run: eight invocations for each.
var<workgroup> parts: array<array<vec4f, 4>, 64>;
@compute @workgroup_size(64)
fn add_tiles(
  @builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) size: vec3u,
    @builtin(local_invocation_index) t: u32) {
  let r = wg.y * size.x + wg.x;
  if (r >= frame.runs) { return; }
  let k = t % RUN;
  let run = unpack_run(mesh[frame.runs_at + r]);
  var end = plan[9];
  if (r + 1u < frame.runs) { end = offsets[r + 1u]; }
  var sum = array<vec4f, 4>();
  for (var e = offsets[r] + t / RUN; e < end; e += RUN) {
    let bits = marked[e];
    if (((bits >> k) & 1u) == 1u) {
      let from_tile = 4u * (sum_starts[e] + countOneBits(bits & ((1u << k) - 1u)));
      for (var c = 0u; c < 4u; c++) { sum[c] += tile_sums[from_tile + c]; }
    }
  }
  parts[t] = sum;
  for (var half = 32u; half >= RUN; half /= 2u) {
    workgroupBarrier();
    if (t < half) { for (var c = 0u; c < 4u; c++) { parts[t][c] += parts[t + half][c]; } }
  }
  if (t < run.count) { for (var c = 0u; c < 4u; c++) { face_sums[4u * (run.first + t) + c] = parts[t][c]; } }
}

// -------------------------------------------------------------------------------- vertices

// The rows of A for the origin o, in the image.
struct Inverse { a: array<vec3f, 3>, o: vec2f };
fn inverse_of(c: array<Corner, 3>) -> Inverse {
  var result: Inverse;
  let p = array<vec4f, 3>(c[0].p, c[1].p, c[2].p);
  if (p[0].z > 0.0 && p[1].z > 0.0 && p[2].z > 0.0) {
    let u = (p[1].xy - p[0].xy) + (c[1].rest - c[0].rest).xy;
    let w = (p[2].xy - p[0].xy) + (c[2].rest - c[0].rest).xy;
    let d = u.x * w.y - w.x * u.y;
    result.a[0] = vec3f((u.y - w.y) / d, (w.x - u.x) / d, 1.0) * p[0].z;
    result.a[1] = vec3f(w.y / d, -w.x / d, 0.0) * p[1].z;
    result.a[2] = vec3f(-u.y / d, u.x / d, 0.0) * p[2].z;
    result.o = p[0].xy;
    return result;
  }
  for (var k = 0u; k < 3u; k++) {
    if (p[k].z > 0.0) { result.o = p[k].xy; }
  }
  var h: array<vec3f, 3>;
  for (var k = 0u; k < 3u; k++) {
    let v = homogeneous(p[k]);
    h[k] = vec3f(v.xy - result.o * v.z, v.z);
  }
  let det = dot(h[0], cross(h[1], h[2]));
  for (var k = 0u; k < 3u; k++) { result.a[k] = cross(h[(k + 1u) % 3u], h[(k + 2u) % 3u]) / det; }
  return result;
}

// Adds the corners of a vertex to its gradients, those of positions in camera space.
@compute @workgroup_size(256)
fn add_corners(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.vertices) { return; }
  var position = vec3f(0.0);
  var rgba = vec4f(0.0);
  let corners_at = frame.vertices + 1u;
  for (var c = vertex_corners[id.x]; c < vertex_corners[id.x + 1u]; c++) {
    let corner = vertex_corners[corners_at + c];
    let face = corner / 3u;
    let j = corner % 3u;
    let r = face_sums[4u * face + j];
    let n = face_sums[4u * face + 3u][j];
    if (all(r == vec4f(0.0)) && n == 0.0) { continue; }
    rgba += r;
    let ids = vec3u(mesh[3u * face], mesh[3u * face + 1u], mesh[3u * face + 2u]);
    let v0 = value_of(ids.x);
    let m = vec3f(-n, dot(r, value_of(ids.y) - v0) - n, dot(r, value_of(ids.z) - v0) - n);
    let inverse = inverse_of(array<Corner, 3>(corner_at(ids.x), corner_at(ids.y), corner_at(ids.z)));
    let d = -(m.x * inverse.a[0] + m.y * inverse.a[1] + m.z * inverse.a[2]);
    position += vec3f(frame.lens.xy * d.xy, d.z + dot(frame.lens.zw - inverse.o, d.xy));
  }
  gradients[2u * id.x] += vec4f(position, 0.0);
  gradients[2u * id.x + 1u] += rgba;
}
