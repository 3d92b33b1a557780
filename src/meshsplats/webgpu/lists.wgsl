// From vertices to sorted tile lists.

@group(0) @binding(1) var<storage, read> vertices: array<f32>;             // (vertices, 3) world space
@group(0) @binding(2) var<storage, read> values: array<vec4f>;             // by vertex: RGB and opacity
@group(0) @binding(3) var<storage, read> mesh: array<u32>;
@group(0) @binding(4) var<storage, read> fans: array<u32>;  // first faces of splats, their end; first runs
@group(0) @binding(5) var<storage, read> projected: array<vec4u>;
@group(0) @binding(6) var<storage, read_write> projected_out: array<vec4u>;
// by group: largest 1 / z, complement of the least
@group(0) @binding(7) var<storage, read_write> group_bounds: array<atomic<u32>>;
// by run: x0 | x1 << 16, y0 | y1 << 16, in tiles
@group(0) @binding(8) var<storage, read_write> boxes_out: array<vec2u>;
@group(0) @binding(9) var<storage, read> boxes: array<vec2u>;
@group(0) @binding(10) var<storage, read_write> scanned: array<u32>;
@group(0) @binding(11) var<storage, read_write> sums: array<u32>;
@group(0) @binding(12) var<storage, read_write> plan_out: array<u32>;
@group(0) @binding(13) var<storage, read> plan: array<u32>;  // dispatch sizes; at 9 the count of pairs
@group(0) @binding(14) var<storage, read> offsets: array<u32>;             // by run: its first pair
@group(0) @binding(15) var<storage, read_write> pairs_out: array<vec2u>;
@group(0) @binding(16) var<storage, read> pairs: array<vec2u>;
@group(0) @binding(17) var<uniform> digit: Digit;
@group(0) @binding(18) var<storage, read_write> work_out: array<u32>;  // from 4 on, four words for each tile
@group(0) @binding(19) var<storage, read_write> counters: array<atomic<u32>>;
@group(0) @binding(20) var<storage, read> samples_in: array<vec4u>;
@group(0) @binding(21) var<storage, read_write> pixels: array<vec4f>;

struct Digit { shift: u32, word: u32, of_table: u32, unused: u32 };

// -------------------------------------------------------------------------------- vertices

fn rotate(d: vec3f) -> vec3f {
  return vec3f(dot(frame.right.xyz, d), dot(frame.down.xyz, d), dot(frame.forward.xyz, d));
}
fn world(i: u32) -> vec3f { return vec3f(vertices[3u * i], vertices[3u * i + 1u], vertices[3u * i + 2u]); }

// Positions in the image are computed with pairs of numbers: a sample of a tiny triangle is easily on the
// wrong side of an edge, and two layers easily in the wrong order.
fn along(axis: vec4f, rest: vec4f, x: vec2f, y: vec2f, z: vec2f) -> vec2f {
  let xy = add_pairs(multiply_pairs(vec2f(axis.x, rest.x), x), multiply_pairs(vec2f(axis.y, rest.y), y));
  return add_pairs(xy, multiply_pairs(vec2f(axis.z, rest.z), z));
}

const FARTHEST = 68719476736.0;  // 2^36 depths of the near plane
struct Point { x: vec2f, y: vec2f, z: vec2f };
// In camera space.
fn precise_point(p: vec3f) -> Point {
  let x = add_pairs(sum_of(p.x, -frame.center.x), vec2f(-frame.center_rest.x, 0.0));
  let y = add_pairs(sum_of(p.y, -frame.center.y), vec2f(-frame.center_rest.y, 0.0));
  let z = add_pairs(sum_of(p.z, -frame.center.z), vec2f(-frame.center_rest.z, 0.0));
  return Point(
    along(frame.right, frame.right_rest, x, y, z), along(frame.down, frame.down_rest, x, y, z),
    along(frame.forward, frame.forward_rest, x, y, z));
}
fn to_camera(p: vec3f) -> vec3f {
  let c = precise_point(p);
  return vec3f(c.x.x, c.y.x, c.z.x);
}
fn place_of(c: Point) -> Place {
  let inverse = invert_pair(c.z);
  return Place(
    add_pairs(multiply_pairs(multiply_pairs(vec2f(frame.lens.x, frame.lens_rest.x), c.x), inverse),
      vec2f(frame.lens.z, frame.lens_rest.z)),
    add_pairs(multiply_pairs(multiply_pairs(vec2f(frame.lens.y, frame.lens_rest.y), c.y), inverse),
      vec2f(frame.lens.w, frame.lens_rest.w)),
    inverse);
}

@compute @workgroup_size(256)
fn project(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.vertices) { return; }
  var p = precise_point(world(id.x));
  var c = vec3f(p.x.x, p.y.x, p.z.x);
  // What lies farther than float32 can tell is drawn nearer, in its direction.
  let far = max(max(abs(c.x), abs(c.y)), abs(c.z)) / (frame.near * FARTHEST);
  if (far > 1.0) {
    p = Point(p.x / far, p.y / far, p.z / far);
    c /= far;
  }
  if (c.z >= frame.near) {
    projected_out[id.x] = pack_place(place_of(p));
  } else {
    projected_out[id.x] = bitcast<vec4u>(vec4f(fma(frame.lens.xy, c.xy, frame.lens.zw * c.z), 0.0, c.z));
  }
}

// -------------------------------------------------------------------------------- low-pass filter
//
// Moves the projected vertices p of each fan to c + A (p - c), A = (I + s M^-1)^(1/2), where c and M are mean
// and covariance of its opacity in the image and s the variance of the filter. For a triangle of area T with
// opacities a_i at q_i, a = sum a_i, Q = sum q_i and B = sum a_i q_i, the integrals of opacity times 1, q and
// q q^T are T a / 3, T / 12 (a Q + B) and T / 60 (a Q Q^T + B Q^T + Q B^T + sum (a + 2 a_i) q_i q_i^T).
//
// In f32, the narrow direction of a needle would drown in its length. So a first loop finds the axes of the
// fan, and a second one takes the moments along them. Positions are relative to a vertex of the fan from the
// start.

const MIN_VARIANCE = 1e-4;  // added to M, as a share of the filter's variance
const DEPTH_SHARE = 0.1;    // extent of depth, against that in the image, in the area of a triangle
const OPACITY_BIAS = 1e-6;  // transparent fans need moments, too
const MAX_TRANSFORM = 1e30;

// (x, y) in the image and scaled depth, relative to the vertex at `origin` in camera space.
fn fan_position(i: u32, first: vec3f, origin: vec3f) -> vec3f {
  let d = rotate(world(i) - first);
  let w = 1.0 / (origin.z + d.z);
  return vec3f(
    frame.lens.xy * (d.xy - origin.xy * (d.z / origin.z)) * w,
    -DEPTH_SHARE * sqrt(frame.lens.x * frame.lens.y) * d.z * w);
}
struct Moments { mass: f32, mean: vec2f, xx: f32, xy: f32, yy: f32, visible: bool };
fn fan_moments(begin: u32, end: u32, first: vec3f, origin: vec3f, shift: vec2f, axis: vec2f) -> Moments {
  var m = Moments(0.0, vec2f(0.0), 0.0, 0.0, 0.0, true);
  for (var f = begin; f < end; f++) {
    var p: array<vec3f, 3>;
    var q: array<vec2f, 3>;
    var a: vec3f;
    for (var k = 0u; k < 3u; k++) {
      let i = mesh[3u * f + k];
      if (projected_out[i].z == 0u) { m.visible = false; }
      p[k] = fan_position(i, first, origin);
      let d = p[k].xy - shift;
      q[k] = vec2f(dot(axis, d), axis.x * d.y - axis.y * d.x);
      a[k] = values[i].w + OPACITY_BIAS;
    }
    let area = length(cross(p[1] - p[0], p[2] - p[0]));
    let total = a.x + a.y + a.z;
    let s = q[0] + q[1] + q[2];
    let b = a.x * q[0] + a.y * q[1] + a.z * q[2];
    var t = vec3f(0.0);
    for (var k = 0u; k < 3u; k++) { t += (total + 2.0 * a[k]) * q[k].xxy * q[k].xyy; }
    m.mass += 20.0 * total * area;
    m.mean += 5.0 * area * (total * s + b);
    m.xx += area * (t.x + s.x * (total * s.x + 2.0 * b.x));
    m.xy += area * (t.y + total * s.x * s.y + b.x * s.y + b.y * s.x);
    m.yy += area * (t.z + s.y * (total * s.y + 2.0 * b.y));
  }
  return m;
}

// The transform of a fan. Positions are fan_position(), less `middle`, turned by `axis`, less `mean`.
struct Fan {
  first: vec3f, origin: vec3f,  // its first vertex, in world and camera space
  middle: vec2f, axis: vec2f, mean: vec2f,
  covariance: vec3f,            // M: xx, xy, yy
  a: vec3f,                     // A: xx, xy, yy
  mass: f32,
  moves: bool,                  // false: the fan stays as it is
};
fn fan_of(begin: u32, end: u32) -> Fan {
  var fan: Fan;
  fan.first = world(mesh[3u * begin]);
  fan.origin = to_camera(fan.first);
  if (!(fan.origin.z >= frame.near)) { return fan; }
  let rough = fan_moments(begin, end, fan.first, fan.origin, vec2f(0.0), vec2f(1.0, 0.0));
  if (!rough.visible || !(rough.mass > 0.0)) { return fan; }
  let middle = rough.mean / rough.mass;
  let xx = rough.xx / rough.mass - middle.x * middle.x;
  let xy = rough.xy / rough.mass - middle.x * middle.y;
  let yy = rough.yy / rough.mass - middle.y * middle.y;
  // The longer axis: half the angle of (xx - yy, 2 xy).
  let angle = 0.5 * atan2(2.0 * xy, xx - yy);
  let turned = vec2f(cos(angle), sin(angle));
  fan.axis = select(vec2f(1.0, 0.0), turned, abs(xy) + abs(xx - yy) > 0.0);
  fan.middle = middle;
  let m = fan_moments(begin, end, fan.first, fan.origin, middle, fan.axis);
  fan.mass = m.mass;
  fan.mean = m.mean / m.mass;
  let s = frame.filter_variance;
  let mean = fan.mean;
  fan.covariance = vec3f(m.xx / m.mass - mean.x * mean.x, m.xy / m.mass - mean.x * mean.y,
    m.yy / m.mass - mean.y * mean.y);
  let uu = m.xx / m.mass - mean.x * mean.x + MIN_VARIANCE * s;
  let uv = m.xy / m.mass - mean.x * mean.y;
  let vv = m.yy / m.mass - mean.y * mean.y + MIN_VARIANCE * s;
  let determinant = uu * vv - uv * uv;
  if (!(determinant > 0.0)) { return fan; }
  // B = I + s M^-1; its root is (B + d I) / sqrt(tr B + 2 d) with d^2 = det B.
  let b = vec3f(1.0 + s * vv / determinant, -s * uv / determinant, 1.0 + s * uu / determinant);
  let d = sqrt(1.0 + s * ((uu + vv) / determinant) + s * (s / determinant));
  let scale = 1.0 / sqrt(b.x + b.z + 2.0 * d);
  fan.a = vec3f(b.x + d, b.y, b.z + d) * scale;
  fan.moves = fan.a.x + abs(fan.a.y) + fan.a.z < MAX_TRANSFORM;
  return fan;
}

@compute @workgroup_size(64)
fn widen(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.splats) { return; }
  let begin = fans[id.x];
  let end = fans[id.x + 1u];
  let fan = fan_of(begin, end);
  if (!fan.moves) { return; }
  let start = place_of(precise_point(fan.first));
  for (var f = begin; f < end; f++) {
    for (var k = 0u; k < 3u; k++) {
      let i = mesh[3u * f + k];
      let p = fan_position(i, fan.first, fan.origin).xy - fan.middle;
      let q = vec2f(dot(fan.axis, p), fan.axis.x * p.y - fan.axis.y * p.x) - fan.mean;
      let r = fan.mean + vec2f(fan.a.x * q.x + fan.a.y * q.y, fan.a.y * q.x + fan.a.z * q.y);
      let moved = fan.middle + vec2f(fan.axis.x * r.x - fan.axis.y * r.y,
        fan.axis.y * r.x + fan.axis.x * r.y);
      let x = add_pairs(start.x, vec2f(moved.x, 0.0));
      let y = add_pairs(start.y, vec2f(moved.y, 0.0));
      let unmoved = projected_out[i];
      let v = unpack_vertex(unmoved);
      projected_out[i] = pack_place(Place(x, y, vec2f(v.z, unpack_rest(unmoved, v).z)));
    }
  }
}

// -------------------------------------------------------------------------------- depth groups
//
// Behind the vertices, `projected` holds two vec4f for each group: (x, y, 1 / z there, unused) and (slope
// along x, along y, least 1 / z, largest 1 / z) of the plane of its largest face.

@compute @workgroup_size(256)
fn bound_groups(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.faces) { return; }
  let g = mesh[frame.face_groups_at + id.x];
  if (g == NO_GROUP) { return; }
  for (var k = 0u; k < 3u; k++) {
    let p = unpack_vertex(projected[mesh[3u * id.x + k]]);
    // floats > 0 are ordered as their bits
    let bits = bitcast<u32>(select(1.0 / frame.near, p.z, p.z > 0.0));
    atomicMax(&group_bounds[2u * g], bits);
    atomicMax(&group_bounds[2u * g + 1u], ~bits);
  }
}

@compute @workgroup_size(64)
fn find_planes(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.groups) { return; }
  let f = 3u * mesh[frame.group_faces_at + id.x];
  let p = array<vec4f, 3>(
    unpack_vertex(projected_out[mesh[f]]), unpack_vertex(projected_out[mesh[f + 1u]]),
    unpack_vertex(projected_out[mesh[f + 2u]]));
  let most = bitcast<f32>(atomicLoad(&group_bounds[2u * id.x]));
  let least = bitcast<f32>(~atomicLoad(&group_bounds[2u * id.x + 1u]));
  var anchor = vec3f(0.0, 0.0, most);
  var slope = vec2f(0.0);  // a plane that is seen edge on has no single depth: its nearest
  if (p[0].z > 0.0 && p[1].z > 0.0 && p[2].z > 0.0) {
    let found = plane_slope(p[0], p[1], p[2]);
    if (found.z > 0.0) { slope = found.xy; anchor = p[0].xyz; }
  } else {
    let v = array<vec3f, 3>(homogeneous(p[0]), homogeneous(p[1]), homogeneous(p[2]));
    let det = dot(v[0], cross(v[1], v[2]));
    let q = (cross(v[1], v[2]) + cross(v[2], v[0]) + cross(v[0], v[1])) / det;
    if (abs(det) > 1e-30 && all(abs(q) < vec3f(1e30))) { slope = q.xy; anchor = vec3f(0.0, 0.0, q.z); }
  }
  projected_out[frame.vertices + 2u * id.x] = bitcast<vec4u>(vec4f(anchor, 0.0));
  projected_out[frame.vertices + 2u * id.x + 1u] = bitcast<vec4u>(vec4f(slope, least, most));
}

// The slope of 1 / z in the image of a triangle; z is 1, or 0 for a triangle without area.
fn plane_slope(p: vec4f, q: vec4f, r: vec4f) -> vec3f {
  let u = q.xyz - p.xyz;
  let v = r.xyz - p.xyz;
  let d = u.x * v.y - u.y * v.x;
  let slope = vec2f(u.z * v.y - v.z * u.y, v.z * u.x - u.z * v.x) / d;
  if (abs(d) > 1e-30 && all(abs(slope) < vec2f(1e30))) { return vec3f(slope, 1.0); }
  return vec3f(0.0);
}

// -------------------------------------------------------------------------------- tiles of runs

// How far outside of its box rounding may find a sample inside of a triangle.
fn slack(low: vec2f, high: vec2f) -> vec2f { return vec2f(1e-3) + 1e-6 * max(abs(low), abs(high)); }

@compute @workgroup_size(256)
fn bound_runs(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.runs) { return; }
  let run = unpack_run(mesh[frame.runs_at + id.x]);
  let last = vec2f(f32(frame.width - 1u), f32(frame.height - 1u));
  var low = last;
  var high = vec2f(0.0);
  var any_visible = false;
  for (var i = 0u; i < run.count; i++) {
    let f = 3u * (run.first + i);
    let p = array<vec4f, 3>(
      unpack_vertex(projected[mesh[f]]), unpack_vertex(projected[mesh[f + 1u]]),
        unpack_vertex(projected[mesh[f + 2u]]));
    var a = vec2f(3e38);
    var b = vec2f(-3e38);
    var visible = 0u;
    for (var k = 0u; k < 3u; k++) {
      if (p[k].z > 0.0) { visible++; a = min(a, p[k].xy); b = max(b, p[k].xy); }
    }
    if (visible == 0u) { continue; }
    if (visible < 3u) {  // near-plane clipping
      for (var k = 0u; k < 3u; k++) {
        let q = p[k];
        let r = p[(k + 1u) % 3u];
        if ((q.z > 0.0) == (r.z > 0.0)) { continue; }
        let u = homogeneous(q);
        let v = homogeneous(r);
        // Both shares on their own: differences of a corner far away and a near one lose the latter.
        let shares = vec2f(v.z - frame.near, frame.near - u.z) / (v.z - u.z);
        let cut = (shares.x * u.xy + shares.y * v.xy) / frame.near;
        let reach = 1e-4 * (abs(cut) + vec2f(1.0));
        a = min(a, cut - reach);
        b = max(b, cut + reach);
      }
    }
    let room = slack(a, b);
    a = ceil(a - 0.5 - room);
    b = floor(b - 0.5 + room);
    if (any(a > b) || any(b < vec2f(0.0)) || any(a > last)) { continue; }
    any_visible = true;
    low = min(low, max(a, vec2f(0.0)));
    high = max(high, min(b, last));
  }
  var box = vec2u(1u, 1u);
  var count = 0u;
  if (any_visible) {
    let x = vec2u(low) / TILE;
    let y = vec2u(high) / TILE;
    box = vec2u(x.x | (y.x << 16u), x.y | (y.y << 16u));
    count = (y.x - x.x + 1u) * (y.y - x.y + 1u);
  }
  boxes_out[id.x] = box;
  scanned[id.x] = count;
}

// -------------------------------------------------------------------------------- pairs

// Writes how many workgroups the later dispatches have. Lists that are too short stay empty: the host
// enlarges them and renders again.
@compute @workgroup_size(1)
fn make_plan() {
  let needed = sums[blocks(frame.runs)];
  let n = select(0u, needed, needed <= frame.capacity);
  atomicStore(&counters[0], needed);
  atomicStore(&counters[1], n);
  write_plan(n);
}
fn write_plan(n: u32) {
  let b = blocks(n);
  plan_out[0] = b;
  plan_out[3] = blocks(256u * b);
  plan_out[6] = (n + 255u) / 256u;
  plan_out[9] = n;
  for (var i = 0u; i < 9u; i += 3u) { plan_out[i + 1u] = 1u; plan_out[i + 2u] = 1u; }
}

// An upper bound of the keys of a run at the samples of the tile with the corner `corner`; 0 if it covers
// none.
fn nearest_in_tile(run: Run, corner: vec2f) -> f32 {
  var key = 0.0;
  for (var i = 0u; i < run.count; i++) {
    let face = run.first + i;
    let p = unpack_vertex(projected[mesh[3u * face]]);
    let q = unpack_vertex(projected[mesh[3u * face + 1u]]);
    let r = unpack_vertex(projected[mesh[3u * face + 2u]]);
    let visible = vec3<bool>(p.z > 0.0, q.z > 0.0, r.z > 0.0);
    if (!any(visible)) { continue; }
    var low = corner + 0.5;
    var high = corner + (f32(TILE) - 0.5);
    var nearest = 1.0 / frame.near;
    if (all(visible)) {
      let a = min(min(p.xy, q.xy), r.xy);
      let b = max(max(p.xy, q.xy), r.xy);
      let room = slack(a, b);
      if (any(ceil(max(a - room, low) - 0.5) > floor(min(b + room, high) - 0.5))) { continue; }
      nearest = max(max(p.z, q.z), r.z);
      low = max(low, a - room);
      high = min(high, b + room);
      let middle = 0.5 * (low + high) - p.xy;
      let half = 0.5 * (high - low) + 1e-3;
      if (outside(p.xy, q.xy, r.xy, middle, half)) { continue; }
      let slope = plane_slope(p, q, r);
      if (slope.z > 0.0) {
        let top = p.z + dot(slope.xy, middle) + 1.001 * dot(abs(slope.xy), half);
        nearest = min(nearest, max(top, 0.0));
      }
    }
    if (frame.groups > 0u) {
      let g = mesh[frame.face_groups_at + face];
      if (g != NO_GROUP) {
        let anchor = bitcast<vec4f>(projected[frame.vertices + 2u * g]);
        let plane = bitcast<vec4f>(projected[frame.vertices + 2u * g + 1u]);
        let top = anchor.z + dot(plane.xy, 0.5 * (low + high) - anchor.xy) +
          1.001 * dot(abs(plane.xy), 0.5 * (high - low));
        nearest = clamp(top, plane.z, plane.w);
      }
    }
    key = max(key, nearest * 1.000001);
  }
  return key;
}
// Whether the triangle misses the box around p + middle with half the sides `half`.
fn outside(p: vec2f, q: vec2f, r: vec2f, middle: vec2f, half: vec2f) -> bool {
  let u = q - p;
  let v = r - p;
  let t = v - u;
  let c = middle - u;
  let s = sign(u.x * v.y - u.y * v.x);
  if (s == 0.0) { return false; }
  let e = vec3f(t.x * c.y - t.y * c.x, middle.x * v.y - middle.y * v.x, u.x * middle.y - u.y * middle.x) * s;
  let room = half + 1e-6 * max(abs(c), abs(middle));
  let reach = vec3f(dot(abs(t.yx), room), dot(abs(v.yx), room), dot(abs(u.yx), room));
  return any(e + reach < vec3f(0.0));
}

@compute @workgroup_size(256)
fn emit(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= plan[9]) { return; }
  var low = 0u;
  var high = frame.runs;
  while (high - low > 1u) {  // the last run that starts at i or before
    let middle = (low + high) / 2u;
    if (offsets[middle] <= i) { low = middle; } else { high = middle; }
  }
  let box = boxes[low];
  let x0 = box.x & 0xffffu;
  let columns = (box.x >> 16u) - x0 + 1u;
  let k = i - offsets[low];
  let x = x0 + k % columns;
  let y = (box.y & 0xffffu) + k / columns;
  let key = nearest_in_tile(unpack_run(mesh[frame.runs_at + low]), vec2f(f32(x * TILE), f32(y * TILE)));
  let tile = select(NO_TILE, y * frame.tiles_x + x, key > 0.0);
  pairs_out[i] = vec2u(pack_depth(key) | (tile << 24u), low | ((tile >> 8u) << 24u));
}

// -------------------------------------------------------------------------------- pixels

// Averages the samples of each pixel: (sum of weight times RGB, transmittance).
@compute @workgroup_size(8, 8)
fn resolve(@builtin(global_invocation_id) id: vec3u) {
  let s = frame.samples;
  let size = vec2u(frame.width, frame.height) / s;
  if (id.x >= size.x || id.y >= size.y) { return; }
  var sum = vec4f(0.0);
  for (var j = 0u; j < s; j++) {
    for (var i = 0u; i < s; i++) {
      sum += bitcast<vec4f>(samples_in[(id.y * s + j) * frame.width + id.x * s + i]);
    }
  }
  pixels[id.y * size.x + id.x] = sum * (1.0 / f32(s * s));
}
