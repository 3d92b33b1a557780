// Shading: colours of vertices in a view, where splats have spherical harmonics. Bindings of lists.wgsl, and:
//
// A vertex of splat s has the colour max(0, RGB + sum_k b_k(d) h_sk), with the unit vector d from the camera
// to the vertex, real spherical harmonics b_k of degree 1 and more, and frame.terms coefficients h_sk.

@group(0) @binding(25) var<storage, read_write> values_out: array<vec4f>;
@group(0) @binding(26) var<storage, read> base: array<vec4f>;      // by vertex: RGB and opacity
@group(0) @binding(27) var<storage, read> harmonics: array<f32>;   // (splats, terms, 3)
@group(0) @binding(28) var<storage, read> owners: array<u32>;      // by vertex: its splat, or NO_SPLAT

const NO_SPLAT = 0xffffffffu;
// sqrt(n / (m pi)): n / m is 3/4; 15/4, 5/16; 7/16, 21/32, 105/4, 35/32.
const C1 = 0.48860251;
const C2 = 1.0925485;
const C20 = 0.31539157;
const C30 = 0.37317634;
const C31 = 0.45704580;
const C32 = 2.8906114;
const C33 = 0.59004360;

fn coefficient(at: u32) -> vec3f {
  return vec3f(harmonics[3u * at], harmonics[3u * at + 1u], harmonics[3u * at + 2u]);
}

@compute @workgroup_size(256)
fn shade(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.vertices) { return; }
  var color = base[id.x];
  let owner = owners[id.x];
  if (owner != NO_SPLAT) {
    let away = (world(id.x) - frame.center.xyz) - frame.center_rest.xyz;
    let square = dot(away, away);
    let d = away * select(0.0, inverseSqrt(square), square > 0.0);
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let h = owner * frame.terms;
    var sum = C1 * (z * coefficient(h + 1u) - y * coefficient(h) - x * coefficient(h + 2u));
    if (frame.terms > 3u) {
      let xx = x * x;
      let yy = y * y;
      let zz = z * z;
      sum += C2 * (x * y * coefficient(h + 3u) - y * z * coefficient(h + 4u) - x * z * coefficient(h + 6u));
      sum += C20 * (2.0 * zz - xx - yy) * coefficient(h + 5u);
      sum += 0.5 * C2 * (xx - yy) * coefficient(h + 7u);
      if (frame.terms > 8u) {
        sum += C32 * (x * y * z * coefficient(h + 9u) + 0.5 * z * (xx - yy) * coefficient(h + 13u));
        sum -= C33 * (y * (3.0 * xx - yy) * coefficient(h + 8u) + x * (xx - 3.0 * yy) * coefficient(h + 14u));
        sum -= C31 * (4.0 * zz - xx - yy) * (y * coefficient(h + 10u) + x * coefficient(h + 12u));
        sum += C30 * z * (2.0 * zz - 3.0 * (xx + yy)) * coefficient(h + 11u);
      }
    }
    color = vec4f(max(color.rgb + sum, vec3f(0.0)), color.a);
  }
  values_out[id.x] = color;
}
