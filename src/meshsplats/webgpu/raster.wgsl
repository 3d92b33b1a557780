// Draws tiles: a workgroup a tile, an invocation a sample.
//
// The host replaces what begins with $, and adds image.wgsl, or tape.wgsl, which records fragments for gradients.
//
// The list of a tile comes nearest run first. Each sample keeps the nearest K of its fragments that are not blended
// yet, sorted. One that is nearer than all runs to come is blended. If there are more than K, the farthest is
// dropped, and the list is walked again, behind the last fragment that was blended: the result is exact for any K.

const K = $Ku;                 // fragments of the queue of each sample
const OUTPUT = $OUTPUTu;       // 0: RGB of the vertices; 1: depth; 2: normals of vertices; 3: of faces
const GROUPS = $GROUPS;        // whether the mesh has depth groups

@group(0) @binding(1) var<storage, read> projected: array<vec4u>;
@group(0) @binding(2) var<storage, read> mesh: array<u32>;
@group(0) @binding(4) var<storage, read> pairs: array<vec2u>;
@group(0) @binding(5) var<storage, read> work: array<vec4u>;     // from 1 on: (tile, first pair, end, walks so far)
@group(0) @binding(6) var<storage, read_write> samples: array<vec4u>;  // RGB and transmittance; then the state
@group(0) @binding(7) var<storage, read_write> next_work: array<atomic<u32>>;  // tiles to walk again, as `work`
@group(0) @binding(8) var<storage, read_write> counters: array<atomic<u32>>;

const OWNER = 0x20000000u;     // with the face: bit i says that edge i owns the samples on it
const FACE = 0x1fffffffu;

// By slot. Edge i lies opposite to corner i: E_i = a (x - x_i) + b (y - y_i) + c_i, from the corner of the tile.
var<workgroup> edges: array<vec4f, 192>;   // a, b, x_i, y_i
var<workgroup> ends: array<vec4f, 64>;     // c_i, 0 except where the near plane cuts; 1 / determinant there, else 0
var<workgroup> scales: array<vec4f, 64>;   // E_i times these are proportional to the weights of corners; largest 1 / z
var<workgroup> least: array<f32, 64>;      // least 1 / z
var<workgroup> ids: array<u32, 64>;        // face and OWNER bits
var<workgroup> corners: array<vec4f, 192>; // values
// From the corner of the core's tile: 1 / z = a x + b y + c; E_i = a x + b y + constants[i]. Where the E_i of the tile
// is nearer to 0 than the fourth constant, the core's may have another sign.
var<workgroup> depths: array<vec3f, 64>;
var<workgroup> constants: array<vec4f, 64>;
var<workgroup> planes: array<vec4f, 64>;   // of the depth group: slopes, 1 / z at the corner of the tile; 1 if there is one
var<workgroup> ranges: array<vec2f, 64>;   // of 1 / z of the depth group
var<workgroup> boxes: array<u32, 128>;     // the samples in its box, one bit each: two words a slot
var<workgroup> keys: array<f32, 8>;        // of the runs
var<workgroup> ready: array<atomic<u32>, 2>;
var<workgroup> open_count: atomic<u32>;
var<workgroup> begin_again: atomic<u32>;
var<workgroup> moved: atomic<u32>;
var<workgroup> broken: atomic<u32>;
var<workgroup> totals: array<atomic<u32>, 4>;
var<workgroup> decision: vec4u;
// Iterations of nested loops of 16 invocations together: not less than those of the SIMD lanes that run in step.
var<workgroup> efforts: array<atomic<u32>, 4>;

// The sample.
var<private> core_corner: vec2f;  // of the core's tile
var<private> block: vec2f;        // corner of its block of 4 x 4 samples, from core_corner
var<private> in_block: vec2f;     // its centre, from the corner of the block
var<private> rgb: vec3f;
var<private> through: f32;        // transmittance
var<private> layers: u32;         // fragments blended
var<private> floor_q: f32;        // the last fragment blended
var<private> floor_face: u32;
var<private> limit_q: f32;        // the nearest fragment dropped; below 0: none
var<private> limit_face: u32;
var<private> blended: u32;        // in this walk, visible ones
var<private> advanced: bool;      // in this walk
var<private> effort: u32;         // iterations of nested loops in this batch
// Its queue: a ring, nearest first.
var<private> head: u32;
var<private> count: u32;
var<private> queue_key: array<f32, K>;
var<private> queue_face: array<u32, K>;
var<private> queue_value: array<vec4f, K>;

fn place(i: u32) -> u32 {
  let j = head + i;
  return select(j, j - K, j >= K);
}

fn most_effort() -> u32 {
  return max(max(atomicLoad(&efforts[0]), atomicLoad(&efforts[1])), max(atomicLoad(&efforts[2]), atomicLoad(&efforts[3])));
}

fn is_nearer(q: f32, face: u32, other_q: f32, other_face: u32) -> bool {
  return q > other_q || (q == other_q && face < other_face);
}

// Puts a fragment into its place. The farthest is dropped if there are too many.
fn insert(q: f32, face: u32, value: vec4f, source: u32) {
  var dropped_q = -1.0;
  var dropped_face = 0u;
  if (count == K) {
    let last = place(K - 1u);
    if (!is_nearer(q, face, queue_key[last], queue_face[last])) {
      drop(q, face);
      return;
    }
    dropped_q = queue_key[last];
    dropped_face = queue_face[last];
    count--;
  }
  var i = count;
  while (i > 0u) {
    let before = place(i - 1u);
    if (!is_nearer(q, face, queue_key[before], queue_face[before])) { break; }
    let after = place(i);
    queue_key[after] = queue_key[before];
    queue_face[after] = queue_face[before];
    queue_value[after] = queue_value[before];
    move_source(after, before);
    i--;
    effort++;
  }
  let free = place(i);
  queue_key[free] = q;
  queue_face[free] = face;
  queue_value[free] = value;
  keep_source(free, source);
  count++;
  if (dropped_q >= 0.0) { drop(dropped_q, dropped_face); }
}

// Notes a fragment that lies behind the full queue.
fn drop(q: f32, face: u32) {
  if (limit_q < 0.0 && hidden()) { return; }  // a limit only comes nearer
  limit_q = q;
  limit_face = face;
}

// ------------------------------------------------------------------------------------------------ triangle set-up

// The core's bits decide about order and coverage: layers often lie within rounding of each other, and samples
// within rounding of an edge that two fans of a splat share. So the operations are the core's where it matters:
// coefficients with more bits than float32, rounded once, from the corner of a tile of the core; then, without
// contraction, the value at the corner of a block of 4 x 4 samples plus that of the sample from there.

const CORE_TILE = 16u;
const NO_CONSTANT = 1e38;      // of an edge with an end nearer than the near plane

// For the sample at `sample` in the tile with the corner o. Tiles of the core hold whole pixels.
fn find_block(o: vec2u, sample: vec2u) {
  let side = CORE_TILE / frame.samples * frame.samples;
  let corner = o / side * side;
  let from_corner = sample - corner;
  core_corner = vec2f(corner);
  block = vec2f(from_corner & vec2u(~3u));
  in_block = vec2f(from_corner & vec2u(3u)) + 0.5;
}
fn at_sample(f: vec3f) -> f32 {
  let at_block = kept(f.x * block.x) + kept(kept(f.y * block.y) + f.z);
  return kept(kept(f.x * in_block.x) + kept(f.y * in_block.y)) + kept(at_block);
}

fn between(a: vec2f, b: vec2f) -> vec2f { return add_pairs(b, -a); }
// a b - c d
fn cross_of(a: vec2f, b: vec2f, c: vec2f, d: vec2f) -> vec2f {
  let p = product_of(a.x, b.x);
  let q = product_of(c.x, d.x);
  let s = sum_of(p.x, -q.x);
  return sum_of(s.x, s.y + ((p.y - q.y) + ((a.x * b.y + a.y * b.x) - (c.x * d.y + c.y * d.x))));
}

// The coefficients of 1 / z for visible corners; (0, 0, c[0].w) if they are too large. `area` is twice the signed area.
fn depth_plane(c: array<Place, 3>, area: vec2f) -> vec3f {
  let uw = between(c[0].w, c[1].w);
  let vw = between(c[0].w, c[2].w);
  let inverse = invert_pair(area);
  let x = multiply_pairs(cross_of(uw, between(c[0].y, c[2].y), between(c[0].y, c[1].y), vw), inverse);
  let y = multiply_pairs(cross_of(between(c[0].x, c[1].x), vw, uw, between(c[0].x, c[2].x)), inverse);
  let plane = vec3f(
    x.x, y.x, add_pairs(c[0].w, -add_pairs(multiply_pairs(x, c[0].x), multiply_pairs(y, c[0].y))).x);
  return select(vec3f(0.0, 0.0, c[0].w.x), plane, all(abs(plane) < vec3f(1e30)));
}

struct Corner { p: vec4f, rest: vec3f };  // unpack_vertex and unpack_rest
fn corner_at(vertex: u32) -> Corner {
  let v = projected[vertex];
  let p = unpack_vertex(v);
  return Corner(p, unpack_rest(v, p));
}

// From p to q, from the corner o of the tile.
struct Edge { a: f32, b: f32, x: f32, y: f32, c: f32 };
fn edge(p: Corner, q: Corner, o: vec2f) -> Edge {
  if (p.p.z > 0.0 && q.p.z > 0.0) {
    let start = (p.p.xy - o) + p.rest.xy;
    let step = (q.p.xy - p.p.xy) + (q.rest - p.rest).xy;
    return Edge(-step.y, step.x, start.x, start.y, 0.0);
  }
  // The other direction has the same bits, negated.
  let swapped = q.p.x < p.p.x || (q.p.x == p.p.x && (q.p.y < p.p.y || (q.p.y == p.p.y && q.p.w < p.p.w)));
  var u = homogeneous(p.p);
  var v = homogeneous(q.p);
  var s = 1.0;
  if (swapped) { let w = u; u = v; v = w; s = -1.0; }
  let n = cross(vec3f(u.xy - o * u.z, u.z), vec3f(v.xy - o * v.z, v.z));
  return Edge(s * n.x, s * n.y, 0.0, 0.0, s * n.z);
}
// Top-left rule. Of two triangles at an edge, one sees (a, b), the other (-a, -b).
fn owns(a: f32, b: f32) -> bool { return a > 0.0 || (a == 0.0 && b > 0.0); }

fn edge_at(e: vec4f, p: vec2f, c: f32) -> f32 { return fma(e.x, p.x - e.z, fma(e.y, p.y - e.w, c)); }
fn edges_at(slot: u32, p: vec2f) -> vec3f {
  let c = ends[slot];
  return vec3f(
    edge_at(edges[3u * slot], p, c.x), edge_at(edges[3u * slot + 1u], p, c.y), edge_at(edges[3u * slot + 2u], p, c.z));
}
// Bit 8 y + x for all samples with low <= (x, y) <= high in rows 0 to 3; other rows are left out.
fn box_bits(low: vec2i, high: vec2i) -> u32 {
  let y0 = max(low.y, 0);
  let y1 = min(high.y, 3);
  if (y0 > y1) { return 0u; }
  let row = ((2u << u32(high.x - low.x)) - 1u) << u32(low.x);
  return row * ((0x01010101u << u32(8 * y0)) & (0x01010101u >> u32(8 * (3 - y1))));
}

fn covers(slot: u32, p: vec2f) -> bool {
  var e = edges_at(slot, p);
  let c = constants[slot];
  if (any(abs(e) < vec3f(c.w))) {
    let f = 3u * slot;
    let core = vec3f(
      at_sample(vec3f(edges[f].xy, c.x)), at_sample(vec3f(edges[f + 1u].xy, c.y)), at_sample(vec3f(edges[f + 2u].xy, c.z)));
    e = select(e, core, c.xyz < vec3f(NO_CONSTANT));
  }
  let id = ids[slot];
  let owned = vec3<bool>((id & OWNER) != 0u, (id & (2u * OWNER)) != 0u, (id & (4u * OWNER)) != 0u);
  return all((e > vec3f(0.0)) | ((e == vec3f(0.0)) & owned));
}

// Sets up a face in a slot, for the tile with the corner o; false if it covers no sample of it.
fn set_up(slot: u32, face: u32, o: vec2f) -> bool {
  let i = vec3u(mesh[3u * face], mesh[3u * face + 1u], mesh[3u * face + 2u]);
  let c = array<Corner, 3>(corner_at(i.x), corner_at(i.y), corner_at(i.z));
  let p = array<vec4f, 3>(c[0].p, c[1].p, c[2].p);
  let visible = vec3<bool>(p[0].z > 0.0, p[1].z > 0.0, p[2].z > 0.0);
  if (!any(visible)) { return false; }
  var box = vec2u(0xffffffffu);
  if (all(visible)) {
    let low = min(min(p[0].xy, p[1].xy), p[2].xy);
    let high = max(max(p[0].xy, p[1].xy), p[2].xy);
    let room = vec2f(1e-3) + 1e-6 * max(abs(low), abs(high));
    let first = ceil(max(low - o - room, vec2f(0.5)) - 0.5);
    let last = floor(min(high - o + room, vec2f(f32(TILE) - 0.5)) - 0.5);
    if (any(first > last)) { return false; }
    let a = vec2i(first);
    let b = vec2i(last);
    box = vec2u(box_bits(a, b), box_bits(a - vec2i(0, 4), b - vec2i(0, 4)));
  }
  let v = array<vec4f, 3>(value_of(i.x), value_of(i.y), value_of(i.z));
  let opacity = max(max(v[0].w, v[1].w), v[2].w);
  if (frame.cutoff >= 0.0) {
    if (opacity < frame.cutoff) { return false; }
  } else if (!(opacity > 0.0) && !TRANSPARENT) {
    return false;
  }
  var e = array<Edge, 3>(edge(c[1], c[2], o), edge(c[2], c[0], o), edge(c[0], c[1], o));
  var flip = 1.0;
  var inverse = 0.0;
  var scale = vec3f(p[0].z, p[1].z, p[2].z);
  var farthest = min(min(p[0].z, p[1].z), p[2].z);
  var nearest = max(max(p[0].z, p[1].z), p[2].z);
  var places: array<Place, 3>;
  for (var k = 0u; k < 3u; k++) {
    places[k] = Place(
      add_pairs(vec2f(p[k].x, c[k].rest.x), vec2f(-core_corner.x, 0.0)),
      add_pairs(vec2f(p[k].y, c[k].rest.y), vec2f(-core_corner.y, 0.0)), vec2f(p[k].z, c[k].rest.z));
  }
  if (all(visible)) {
    let d = cross_of(
      between(places[0].x, places[1].x), between(places[0].y, places[2].y),
      between(places[0].x, places[2].x), between(places[0].y, places[1].y));
    if (!(abs(d.x) > 1e-30)) { return false; }
    if (d.x < 0.0) { flip = -1.0; }
    depths[slot] = depth_plane(places, d);
  } else {
    var h: array<vec3f, 3>;
    for (var k = 0u; k < 3u; k++) {
      let v = homogeneous(p[k]);
      h[k] = vec3f(v.xy - o * v.z, v.z);
    }
    let det = dot(h[0], cross(h[1], h[2]));
    if (!(abs(det) > 1e-30)) { return false; }
    if (det < 0.0) { flip = -1.0; }
    inverse = 1.0 / abs(det);
    let z = vec3f(depth_of(p[0]), depth_of(p[1]), depth_of(p[2]));
    scale = vec3f(
      select(1.0, z.y * z.z, visible.y && visible.z), select(1.0, z.z * z.x, visible.z && visible.x),
      select(1.0, z.x * z.y, visible.x && visible.y));
    farthest = 1.0 / max(max(z.x, z.y), z.z);
    nearest = 1.0 / frame.near;
  }
  var bits = face;
  var constant = vec4f(0.0);
  for (var k = 0u; k < 3u; k++) {
    let j = (k + 1u) % 3u;
    let l = (k + 2u) % 3u;
    var line = vec4f(flip * e[k].a, flip * e[k].b, e[k].x, e[k].y);
    let c = flip * e[k].c;
    var room = 0.0;
    constant[k] = NO_CONSTANT;
    if (visible[j] && visible[l]) {
      line.x = flip * between(places[l].y, places[j].y).x;
      line.y = flip * between(places[j].x, places[l].x).x;
      constant[k] = flip * cross_of(places[j].x, places[l].y, places[l].x, places[j].y).x;
      room = 2.5e-7 * (abs(line.x) + abs(line.y)) * (32.0 + abs(line.z) + abs(line.w));
    }
    let far = f32(TILE) - 0.5;
    let best = edge_at(line, vec2f(select(0.5, far, line.x > 0.0), select(0.5, far, line.y > 0.0)), c);
    if (!(best >= -room)) { return false; }
    constant.w = max(constant.w, room);
    edges[3u * slot + k] = line;
    e[k].c = c;
    if (owns(line.x, line.y)) { bits |= OWNER << k; }
    corners[3u * slot + k] = v[k];
  }
  constants[slot] = constant;
  ends[slot] = vec4f(e[0].c, e[1].c, e[2].c, inverse);
  scales[slot] = vec4f(scale, nearest);
  least[slot] = farthest;
  ids[slot] = bits;
  boxes[2u * slot] = box.x;
  boxes[2u * slot + 1u] = box.y;
  if (OUTPUT == 3u) {  // values are positions
    corners[3u * slot] = vec4f(cross(v[1].xyz - v[0].xyz, v[2].xyz - v[0].xyz), v[0].w);
  }
  if (GROUPS) {
    let g = mesh[frame.face_groups_at + face];
    planes[slot] = vec4f(0.0);
    if (g != NO_GROUP) {
      let anchor = bitcast<vec4f>(projected[frame.vertices + 2u * g]);
      let plane = bitcast<vec4f>(projected[frame.vertices + 2u * g + 1u]);
      planes[slot] = vec4f(plane.xy, fma(plane.x, o.x - anchor.x, fma(plane.y, o.y - anchor.y, anchor.z)), 1.0);
      ranges[slot] = plane.zw;
    }
  }
  return true;
}

// ------------------------------------------------------------------------------------------------ fragments

// The fragment of the triangle in a slot at the sample p, which it covers: adds it to the queue unless it is
// blended already or lies behind what was dropped. `key` bounds it; `source` says where the triangle is from.
fn add_fragment(slot: u32, p: vec2f, tile: vec2f, key: f32, source: u32) {
  let e = edges_at(slot, p);
  let scale = scales[slot];
  let b = e * scale.xyz;
  let sum = b.x + b.y + b.z;
  let inverse = ends[slot].w;
  var depth = 0.0;  // 1 / z
  if (inverse == 0.0) {
    depth = at_sample(depths[slot]);
  } else {
    depth = sum * inverse;
    if (depth > scale.w) { return; }  // nearer than the near plane
  }
  depth = clamp(depth, least[slot], scale.w);
  var q = depth;
  if (GROUPS) {
    let plane = planes[slot];
    if (plane.w > 0.0) { q = clamp(fma(plane.x, p.x, fma(plane.y, p.y, plane.z)), ranges[slot].x, ranges[slot].y); }
  }
  q = min(q, key);
  let face = ids[slot] & FACE;
  if (!(q < floor_q || (q == floor_q && face > floor_face))) { return; }
  if (q < limit_q || (q == limit_q && face > limit_face)) { return; }
  let w = b / sum;
  let v0 = corners[3u * slot];
  let v1 = corners[3u * slot + 1u];
  let v2 = corners[3u * slot + 2u];
  var value = fma(vec4f(w.x), v0, fma(vec4f(w.y), v1, w.z * v2));
  if (OUTPUT == 3u) { value = vec4f(v0.xyz, value.w); }
  value.w = clamp(value.w, min(min(v0.w, v1.w), v2.w), max(max(v0.w, v1.w), v2.w));
  if (frame.cutoff >= 0.0) {
    if (value.w < frame.cutoff) { return; }
    value.w = 1.0;
  }
  if (!(value.w > 0.0) && !TRANSPARENT) { return; }
  if (OUTPUT == 1u) { value = vec4f(1.0 / depth, 0.0, 0.0, value.w); }
  if (OUTPUT >= 2u) { value = vec4f(facing(value.xyz, tile + p), value.w); }
  insert(q, face, value, source);
}

// The unit normal that faces the camera at the position p of the image; 0 for one without direction.
fn facing(n: vec3f, p: vec2f) -> vec3f {
  let most = max(max(abs(n.x), abs(n.y)), abs(n.z));
  if (!(most > 0.0)) { return vec3f(0.0); }
  let unit = normalize(n / most);
  let ray = (p - frame.lens.zw) / frame.lens.xy;
  let along = dot(unit, ray.x * frame.right.xyz + ray.y * frame.down.xyz + frame.forward.xyz);
  return select(unit, -unit, along > 0.0);
}

// ------------------------------------------------------------------------------------------------ tiles

fn add_wide(at: u32, value: u32) {  // to a counter of 64 bits
  let old = atomicAdd(&counters[at], value);
  if (old > 0xffffffffu - value) { atomicAdd(&counters[at + 1u], 1u); }
}

@compute @workgroup_size(64)
fn raster(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) t: u32) {
  let item = work[wg.x + 1u];
  let tile = select(item.x, wg.x, item.w == 0u);
  let tile_x = tile % frame.tiles_x;
  let tile_y = tile / frame.tiles_x;
  let o = vec2f(f32(tile_x * TILE), f32(tile_y * TILE));
  let x = tile_x * TILE + t % TILE;
  let y = tile_y * TILE + t / TILE;
  let p = vec2f(f32(t % TILE) + 0.5, f32(t / TILE) + 0.5);
  let in_image = x < frame.width && y < frame.height;
  let index = y * frame.width + x;
  let state_index = frame.width * frame.height + index;

  rgb = vec3f(0.0);
  through = 1.0;
  layers = 0u;
  floor_q = 3e38;
  floor_face = 0u;
  limit_q = -1.0;
  limit_face = 0u;
  blended = 0u;
  advanced = false;
  head = 0u;
  count = 0u;
  effort = 0u;
  var open = in_image;
  find_block(vec2u(o), vec2u(x, y));
  begin_sample(t, x, y);
  if (item.w > 0u && in_image) {
    open = resume(index, state_index);
  }
  let was_open = open;
  if (t == 0u) { atomicStore(&broken, 0u); }
  if (t < 4u) { atomicStore(&efforts[t], 0u); }

  var clean = item.y;     // everything before it is blended
  var at = item.y;
  let end = item.z;
  var spent = 0u;
  var cut = false;        // the budget is spent
  var ended = false;      // the loop was left by its own exits
  var whole = true;       // so were the inner loops
  var tests = 0u;
  loop {
    if (at >= end) { ended = true; break; }
    if (t < 2u) { atomicStore(&ready[t], 0u); }
    if (t == 2u) { atomicStore(&open_count, 0u); }
    workgroupBarrier();
    // No fragment to come is nearer than this.
    let nearest_to_come = unpack_depth(pairs[at].x);
    if (open) {
      while (count > 0u && open && queue_key[head] > nearest_to_come) { blend_front(); open = is_open(); }
      if (count == 0u && limit_q < 0.0) { clean = at; }
      if (open) { atomicAdd(&open_count, 1u); }
    }
    let pair_at = at + t / RUN;
    if (pair_at < end) {
      let pair = pairs[pair_at];
      let run = unpack_run(mesh[frame.runs_at + (pair.y & 0xffffffu)]);
      let k = t % RUN;
      if (k == 0u) { keys[t / RUN] = unpack_depth(pair.x); }
      if (k < run.count) {
        if (set_up(t, run.first + k, o)) { atomicOr(&ready[t / 32u], 1u << (t % 32u)); }
      }
    }
    workgroupBarrier();
    if (t == 0u) { decision = vec4u(atomicLoad(&open_count), atomicLoad(&ready[0]), atomicLoad(&ready[1]), most_effort()); }
    let now = workgroupUniformLoad(&decision);
    if (now.x == 0u) { ended = true; break; }
    if (spent + now.w > frame.budget) { ended = true; cut = true; break; }
    let triangles = countOneBits(now.y) + countOneBits(now.z);
    spent += 3u * triangles + K + 8u;
    if (open) {
      // Slots whose box holds the sample; those that cover it; then their fragments: lanes differ less so.
      let word = t / 32u;
      let bit = t % 32u;
      var near = vec2u(0u);
      var rest = now.yz;
      while (rest.x != 0u) {
        let slot = firstTrailingBit(rest.x);
        near.x |= ((boxes[2u * slot + word] >> bit) & 1u) << slot;
        rest.x &= rest.x - 1u;
      }
      while (rest.y != 0u) {
        let slot = firstTrailingBit(rest.y);
        near.y |= ((boxes[2u * slot + 64u + word] >> bit) & 1u) << slot;
        rest.y &= rest.y - 1u;
      }
      tests += countOneBits(near.x) + countOneBits(near.y);
      effort = 0u;
      var hits = vec2u(0u);
      while ((near.x | near.y) != 0u) {
        var slot = 0u;
        if (near.x != 0u) { slot = firstTrailingBit(near.x); near.x &= near.x - 1u; }
        else { slot = 32u + firstTrailingBit(near.y); near.y &= near.y - 1u; }
        let hit = select(0u, 1u << (slot % 32u), covers(slot, p));
        if (slot < 32u) { hits.x |= hit; } else { hits.y |= hit; }
      }
      while ((hits.x | hits.y) != 0u && open) {
        var slot = 0u;
        if (hits.x != 0u) { slot = firstTrailingBit(hits.x); hits.x &= hits.x - 1u; }
        else { slot = 32u + firstTrailingBit(hits.y); hits.y &= hits.y - 1u; }
        let key = keys[slot / RUN];
        if (count == K && queue_key[head] > key) { blend_front(); open = is_open(); }
        if (open) { add_fragment(slot, p, o, key, RUN * at + slot); }
      }
      atomicAdd(&efforts[t / 16u], effort);
      whole = whole && (rest.x | rest.y | near.x | near.y) == 0u && ((hits.x | hits.y) == 0u || !open);
    }
    at += RUN;
  }
  if (open && !cut) {
    while (count > 0u && open) { blend_front(); open = is_open(); }
    whole = whole && (count == 0u || !open);
  }
  let again = open && (cut || limit_q >= 0.0);

  workgroupBarrier();
  if (t == 0u) { atomicStore(&open_count, 0u); atomicStore(&begin_again, end); atomicStore(&moved, 0u); }
  if (t < 4u) { atomicStore(&totals[t], 0u); }
  workgroupBarrier();
  if (again) {
    atomicAdd(&open_count, 1u);
    atomicMin(&begin_again, clean);
    if (advanced) { atomicOr(&moved, 1u); }
  }
  if (!(whole && ended)) { atomicOr(&broken, 1u); }
  if (was_open && !again) { atomicOr(&moved, 1u); }
  atomicAdd(&totals[0], tests);
  atomicAdd(&totals[1], blended);
  workgroupBarrier();
  let left = atomicLoad(&open_count);
  if (in_image) { suspend(index, state_index, again, left > 0u); }
  if (t != 0u) { return; }
  atomicAdd(&counters[3], 1u);
  atomicMax(&counters[4], item.w + 1u);
  add_wide(5u, atomicLoad(&totals[0]));
  add_wide(7u, atomicLoad(&totals[1]));
  if (cut) { atomicAdd(&counters[10], 1u); }
  if (atomicLoad(&broken) != 0u) {
    atomicAdd(&counters[12], 1u);
  } else if (left == 0u) {
    atomicAdd(&counters[2], 1u);
  } else if (atomicLoad(&moved) == 0u && atomicLoad(&begin_again) <= item.y) {
    atomicAdd(&counters[9], 1u);
  } else {
    if (item.w == 0u) { atomicAdd(&counters[11], left); }
    let place = 4u * (atomicAdd(&next_work[0], 1u) + 1u);
    atomicStore(&next_work[1], 1u);
    atomicStore(&next_work[2], 1u);
    atomicStore(&next_work[place], tile);
    atomicStore(&next_work[place + 1u], atomicLoad(&begin_again));
    atomicStore(&next_work[place + 2u], end);
    atomicStore(&next_work[place + 3u], item.w + 1u);
  }
}
