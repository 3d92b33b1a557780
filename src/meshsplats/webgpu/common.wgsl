// Shared by all modules: the frame, projected vertices, keys of pairs.

struct Frame {
  right: vec4f, down: vec4f, forward: vec4f,  // the camera's axes in world space: x, y, z; w is 0
  center: vec4f, center_rest: vec4f,          // the camera's centre, rounded to f32, and the rest
  lens: vec4f,                                // fx, fy, cx, cy, in samples
  near: f32, min_transmittance: f32,
  cutoff: f32,                                // negative: none
  filter_variance: f32,                       // square samples; 0: none
  width: u32, height: u32,                    // in samples
  tiles_x: u32, tiles_y: u32,
  vertices: u32, faces: u32, runs: u32,
  splats: u32,                                // with a filter, or in the order of the splats
  groups: u32,                                // depth groups
  capacity: u32,                              // pairs that the lists can hold
  max_layers: u32,                            // 0: no limit
  budget: u32,                                // loop iterations of one walk through a tile list
  runs_at: u32, face_groups_at: u32, group_faces_at: u32,  // offsets in `mesh`
  samples: u32,                               // side of the grid of samples in a pixel
  right_rest: vec4f, down_rest: vec4f, forward_rest: vec4f, lens_rest: vec4f,  // what rounding left
  terms: u32,                                 // spherical harmonics of each splat; 0: none
};

const TILE = 8u;           // samples along each side of a tile
const RUN = 8u;            // most triangles of a run
const NO_GROUP = 0xffffffffu;

@group(0) @binding(0) var<uniform> frame: Frame;

// `mesh` holds the faces, three vertex indices each; from runs_at on the runs, first face | (count - 1) <<
// 29; with depth groups, from face_groups_at on the group of each face, from group_faces_at on the largest
// face of each group.
struct Run { first: u32, count: u32 };
fn unpack_run(bits: u32) -> Run { return Run(bits & 0x1fffffffu, (bits >> 29u) + 1u); }

// A pair (run, tile) is a vec2u: x = complement of the depth key in 24 bits | low byte of the tile << 24,
// y = run | high byte of the tile << 24. The depth key is an upper bound of 1 / depth, rounded up.
fn pack_depth(q: f32) -> u32 { return 0xffffffu - min((bitcast<u32>(q) >> 7u) + 1u, 0xfeffffu); }
fn unpack_depth(x: u32) -> f32 { return bitcast<f32>((0xffffffu - (x & 0xffffffu)) << 7u); }
const NO_TILE = 0xffffu;

// -------------------------------------------------------------------------------- pairs of numbers
//
// A vec2f stands for the sum of its two numbers: twice the precision (Dekker 1971). Compilers may contract,
// reassociate and take a + b - a for b, but not across integers: `kept` has the value of x, rounded.

fn kept(x: f32) -> f32 { return bitcast<f32>(bitcast<u32>(x) ^ bitcast<u32>(frame.right.w)); }
fn sum_of(a: f32, b: f32) -> vec2f {
  let s = kept(a + b);
  let t = kept(s - a);
  return vec2f(s, (a - kept(s - t)) + (b - t));
}
fn product_of(a: f32, b: f32) -> vec2f {
  let p = kept(a * b);
  let a1 = bitcast<f32>(bitcast<u32>(a) & 0xfffff000u);  // products of halves are exact
  let b1 = bitcast<f32>(bitcast<u32>(b) & 0xfffff000u);
  let a2 = kept(a - a1);
  let b2 = kept(b - b1);
  return vec2f(p, ((kept(a1 * b1) - p) + kept(a1 * b2) + kept(a2 * b1)) + a2 * b2);
}
fn add_pairs(a: vec2f, b: vec2f) -> vec2f {
  let s = sum_of(a.x, b.x);
  return sum_of(s.x, s.y + (a.y + b.y));
}
fn multiply_pairs(a: vec2f, b: vec2f) -> vec2f {
  let p = product_of(a.x, b.x);
  return sum_of(p.x, p.y + (a.x * b.y + a.y * b.x));
}
fn invert_pair(a: vec2f) -> vec2f {
  let inverse = 1.0 / a.x;
  let one = product_of(inverse, a.x);
  return sum_of(inverse, inverse * (((1.0 - one.x) - one.y) - inverse * a.y));
}

// -------------------------------------------------------------------------------- projected vertices
//
// Of a vertex beyond the near plane, x and y in samples and 1 / z are stored with 37 bits each, in four
// words: float32 with an exponent of six bits, and 13 bits of what rounding left, in 1/8190 of a unit in the
// last place. The words:
//   sign of x, 2 bits of its rest, exponent, mantissa
//   the same of y
//   3 bits of the rest of 1 / z, exponent, mantissa; never 0
//   11 bits of the rest of x, 11 of y, 10 of 1 / z, from the lowest bit on
// Coordinates reach from 2^-20 to 2^43, 1 / z to 2^-61 of that of the near plane. A nearer vertex has the
// words (fx X + cx Z, fy Y + cy Z, 0, Z), as float32.

struct Place { x: vec2f, y: vec2f, w: vec2f };  // beyond the near plane: pairs; w is 1 / z

const FLOAT = 0x1fffffffu;     // exponent and mantissa
const REST = 4095.0;           // the largest rest
fn least_exponents() -> vec3u {  // less 1, of x, y and 1 / z, in place
  let near = bitcast<u32>(frame.near) >> 23u;
  return vec3u(106u, 106u, max(254u - min(near, 192u), 62u) - 62u) << vec3u(23u);
}
fn last_place(x: vec3f) -> vec3f {
  return bitcast<vec3f>(bitcast<vec3u>(x) & vec3u(0x7f800000u)) * 1.1920929e-7;
}
fn pack_place(p: Place) -> vec4u {
  let x = vec3f(p.x.x, p.y.x, p.w.x);
  let rest = vec3f(p.x.y, p.y.y, p.w.y);
  let places = clamp(round(rest / last_place(x) * (2.0 * REST)), vec3f(-REST), vec3f(REST));
  let r = vec3u(select(vec3f(0.0), places, abs(rest) > vec3f(0.0)) + (REST + 1.0));
  let least = least_exponents();
  let bits = clamp(bitcast<vec3u>(x) & vec3u(0x7fffffffu), least, least + vec3u(FLOAT)) - least;
  let sign = bitcast<vec2u>(x.xy) & vec2u(0x80000000u);
  return vec4u(
    sign | ((r.xy >> vec2u(11u)) << vec2u(29u)) | bits.xy, max(bits.z, 1u) | ((r.z >> 10u) << 29u),
    (r.x & 0x7ffu) | ((r.y & 0x7ffu) << 11u) | ((r.z & 0x3ffu) << 22u));
}
// (x, y, 1 / z, 0), rounded to float32; (fx X + cx Z, fy Y + cy Z, 0, Z) where it is nearer than the near
// plane.
fn unpack_vertex(v: vec4u) -> vec4f {
  if (v.z == 0u) { return bitcast<vec4f>(v); }
  let bits = v.xyz & vec3u(FLOAT);
  let size = select(vec3u(0u), bits + least_exponents(), bits > vec3u(0u));
  return vec4f(bitcast<vec3f>(size | (v.xyz & vec3u(0x80000000u, 0x80000000u, 0u))), 0.0);
}
// What rounding left of x, y and 1 / z; `p` is unpack_vertex(v).
fn unpack_rest(v: vec4u, p: vec4f) -> vec3f {
  if (v.z == 0u) { return vec3f(0.0); }
  let high = vec3u((v.xy >> vec2u(18u)) & vec2u(0x1800u), (v.z >> 19u) & 0x1c00u);
  let low = vec3u(v.w & 0x7ffu, (v.w >> 11u) & 0x7ffu, v.w >> 22u);
  return (vec3f(high | low) - (REST + 1.0)) * (0.5 / REST) * last_place(p.xyz);
}

fn depth_of(p: vec4f) -> f32 {
  if (p.z > 0.0) { return 1.0 / p.z; }
  return p.w;
}
fn homogeneous(p: vec4f) -> vec3f {
  let z = depth_of(p);
  if (p.z > 0.0) { return vec3f(p.xy * z, z); }
  return vec3f(p.xy, z);
}
