// Shading: vertex colours in a view, where splats have spherical harmonics. On harmonics.wgsl, the
// bindings of lists.wgsl, and:
//
// A vertex of splat s has the colour max(0, RGB + sum_k b_k(d) h_sk), with the unit vector d from the camera
// to the vertex, real spherical harmonics b_k of degree 1 and more, and frame.terms coefficients h_sk.

@group(0) @binding(25) var<storage, read_write> values_out: array<vec4f>;
@group(0) @binding(26) var<storage, read> base: array<vec4f>;      // by vertex: RGB and opacity
@group(0) @binding(27) var<storage, read> harmonics: array<f32>;   // (splats, terms, 3)
@group(0) @binding(28) var<storage, read> owners: array<u32>;      // by vertex: its splat, or NO_SPLAT

const NO_SPLAT = 0xffffffffu;
fn coefficient(at: u32) -> vec3f {
  return vec3f(harmonics[3u * at], harmonics[3u * at + 1u], harmonics[3u * at + 2u]);
}

@compute @workgroup_size(256)
fn shade(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.vertices) { return; }
  var color = base[id.x];
  let owner = owners[id.x];
  if (owner != NO_SPLAT) {
    let basis = basis_of(direction_to(world(id.x)));
    var sum = vec3f(0.0);
    for (var k = 0u; k < frame.terms; k++) { sum += basis[k] * coefficient(owner * frame.terms + k); }
    color = vec4f(max(color.rgb + sum, vec3f(0.0)), color.a);
  }
  values_out[id.x] = color;
}
