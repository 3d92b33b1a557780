// Triangles of a tile, set up for its samples: on the bindings and workgroup variables of raster.wgsl.

// The core's bits decide about order and coverage: layers often lie within rounding of each other, and
// samples within rounding of an edge that two fans of a splat share. So the operations are the core's where
// it matters: coefficients with more bits than float32, rounded once, from the corner of a tile of the core;
// then, without contraction, the value at the corner of a block of 4 x 4 samples plus that of the sample from
// there.

const CORE_TILE = $CORE_TILEu;
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
// a b - c d; exactly 0 for equal products, also where compilers contract.
fn cross_of(a: vec2f, b: vec2f, c: vec2f, d: vec2f) -> vec2f {
  let p = product_of(a.x, b.x);
  let q = product_of(c.x, d.x);
  let s = sum_of(p.x, -q.x);
  let low = (kept(a.x * b.y) + kept(a.y * b.x)) - (kept(c.x * d.y) + kept(c.y * d.x));
  return sum_of(s.x, s.y + ((p.y - q.y) + low));
}

// The coefficients of 1 / z for visible corners; (0, 0, c[0].w) if they are too large. `area` is twice the
// signed area.
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
fn corner_at(vertex: u32) -> Corner { return unpack_corner(projected[vertex]); }
fn unpack_corner(v: vec4u) -> Corner {
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
    edge_at(edges[3u * slot], p, c.x), edge_at(edges[3u * slot + 1u], p, c.y),
      edge_at(edges[3u * slot + 2u], p, c.z));
}

fn covers(slot: u32, p: vec2f) -> bool {
  var e = edges_at(slot, p);
  let c = constants[slot];
  if (any(abs(e) < vec3f(c.w))) {
    let f = 3u * slot;
    let core = vec3f(
      at_sample(vec3f(edges[f].xy, c.x)), at_sample(vec3f(edges[f + 1u].xy, c.y)),
        at_sample(vec3f(edges[f + 2u].xy, c.z)));
    e = select(e, core, c.xyz < vec3f(NO_CONSTANT));
  }
  let id = ids[slot];
  let owned = vec3<bool>((id & OWNER) != 0u, (id & (2u * OWNER)) != 0u, (id & (4u * OWNER)) != 0u);
  return all((e > vec3f(0.0)) | ((e == vec3f(0.0)) & owned));
}

// Sets up a face in a slot, for the tile with the corner o; false if it covers no sample of it. `i` are its
// vertices, `projected_at` what `projected` has of them.
fn set_up(slot: u32, face: u32, i: vec3u, projected_at: array<vec4u, 3>, o: vec2f) -> bool {
  let c = array<Corner, 3>(
    unpack_corner(projected_at[0]), unpack_corner(projected_at[1]), unpack_corner(projected_at[2]));
  let p = array<vec4f, 3>(c[0].p, c[1].p, c[2].p);
  let visible = vec3<bool>(p[0].z > 0.0, p[1].z > 0.0, p[2].z > 0.0);
  if (!any(visible)) { return false; }
  var low_sample = vec2u(0u);
  var high_sample = vec2u(TILE - 1u);
  if (all(visible)) {
    let low = min(min(p[0].xy, p[1].xy), p[2].xy);
    let high = max(max(p[0].xy, p[1].xy), p[2].xy);
    let room = vec2f(1e-3) + 1e-6 * max(abs(low), abs(high));
    let first = ceil(max(low - o - room, vec2f(0.5)) - 0.5);
    let last = floor(min(high - o + room, vec2f(f32(TILE) - 0.5)) - 0.5);
    if (any(first > last)) { return false; }
    low_sample = vec2u(first);
    high_sample = vec2u(last);
  }
  let v = array<vec4f, 3>(value_of(i.x), value_of(i.y), value_of(i.z));  // used late: reading takes its time
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
    if (!BY_SPLAT || OUTPUT == 1u) { depths[slot] = depth_plane(places, d); }
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
  let opacity = max(max(v[0].w, v[1].w), v[2].w);
  if (frame.cutoff >= 0.0) {
    if (opacity < frame.cutoff) { return false; }
  } else if (!(opacity > 0.0) && !TRANSPARENT) {
    return false;
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
      room = 2.5e-7 * (abs(line.x) + abs(line.y)) * (2.0 * f32(CORE_TILE) + abs(line.z) + abs(line.w));
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
  let bit = 1u << (slot % 32u);
  let word = turn + slot / 32u;
  for (var x = low_sample.x; x <= high_sample.x; x++) { atomicOr(&columns[2u * x + word], bit); }
  for (var y = low_sample.y; y <= high_sample.y; y++) { atomicOr(&rows[2u * y + word], bit); }
  if (OUTPUT == 3u) {  // values are positions
    corners[3u * slot] = vec4f(cross(v[1].xyz - v[0].xyz, v[2].xyz - v[0].xyz), v[0].w);
  }
  if (GROUPS) {
    let g = mesh[frame.face_groups_at + face];
    planes[slot] = vec4f(0.0);
    if (g != NO_GROUP) {
      let anchor = bitcast<vec4f>(projected[frame.vertices + 2u * g]);
      let plane = bitcast<vec4f>(projected[frame.vertices + 2u * g + 1u]);
      planes[slot] = vec4f(plane.xy, fma(plane.x, o.x - anchor.x, fma(plane.y, o.y - anchor.y, anchor.z)),
        1.0);
      ranges[slot] = plane.zw;
    }
  }
  return true;
}
