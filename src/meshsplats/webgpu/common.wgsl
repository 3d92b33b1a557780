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
  vertices: u32, faces: u32, runs: u32, fans: u32,
  groups: u32,                                // depth groups
  capacity: u32,                              // pairs that the lists can hold
  max_layers: u32,                            // 0: no limit
  budget: u32,                                // loop iterations of one walk through a tile list
  runs_at: u32, face_groups_at: u32, group_faces_at: u32,  // offsets in `mesh`
  samples: u32,                               // side of the grid of samples in a pixel
  right_rest: vec4f, down_rest: vec4f, forward_rest: vec4f, lens_rest: vec4f,  // what rounding left
};

const TILE = 8u;           // samples along each side of a tile
const RUN = 8u;            // most triangles of a run
const NO_GROUP = 0xffffffffu;

@group(0) @binding(0) var<uniform> frame: Frame;

// `mesh` holds the faces, three vertex indices each; from runs_at on the runs, first face | (count - 1) << 29;
// with depth groups, from face_groups_at on the group of each face, from group_faces_at on the largest face of
// each group.
struct Run { first: u32, count: u32 };
fn unpack_run(bits: u32) -> Run { return Run(bits & 0x1fffffffu, (bits >> 29u) + 1u); }

// A pair (run, tile) is a vec2u: x = complement of the depth key in 24 bits | low byte of the tile << 24,
// y = run | high byte of the tile << 24. The depth key is an upper bound of 1 / depth, rounded up.
fn pack_depth(q: f32) -> u32 { return 0xffffffu - min((bitcast<u32>(q) >> 7u) + 1u, 0xfeffffu); }
fn unpack_depth(x: u32) -> f32 { return bitcast<f32>((0xffffffu - (x & 0xffffffu)) << 7u); }
const NO_TILE = 0xffffu;

// A projected vertex is (x, y, 1 / z, rest) in samples, where the rest holds what rounding left of x and y;
// (fx X + cx Z, fy Y + cy Z, 0, Z) where it is nearer than the near plane.
fn depth_of(p: vec4f) -> f32 {
  if (p.z > 0.0) { return 1.0 / p.z; }
  return p.w;
}
fn homogeneous(p: vec4f) -> vec3f {
  let z = depth_of(p);
  if (p.z > 0.0) { return vec3f(p.xy * z, z); }
  return vec3f(p.xy, z);
}

// The rest is a float in [1, 1.5): 11 bits for each of x and y, in 1/2046 of a unit in the last place.
fn last_place(x: vec2f) -> vec2f { return bitcast<vec2f>(bitcast<vec2u>(x) & vec2u(0x7f800000u)) * 1.1920929e-7; }
fn pack_rest(x: vec2f, rest: vec2f) -> f32 {
  let places = clamp(round(rest / last_place(x) * 2046.0), vec2f(-1023.0), vec2f(1023.0));
  let known = select(vec2f(0.0), places, abs(rest) > vec2f(0.0));
  let bits = vec2u(known + 1024.0);
  return bitcast<f32>(0x3f800000u | (bits.x << 11u) | bits.y);
}
fn rest_of(p: vec4f) -> vec2f {
  let bits = bitcast<u32>(p.w);
  return (vec2f(f32((bits >> 11u) & 0x7ffu), f32(bits & 0x7ffu)) - 1024.0) * (1.0 / 2046.0) * last_place(p.xy);
}
