// Backward pass of the low-pass filter: replaces the gradients of the moved vertices of each fan by those of
// its own positions, and adds those of opacities. Both are in the axes of the camera.
//
// A A = I + s M^-1. For a gradient G of A, the Sylvester equation A X + X A = G has the solution
// X = (det A G + adj A G adj A) / (2 tr A det A), and H = -s M^-1 X M^-1 is the gradient of M. With C that of
// the mean, the density of opacity has the gradient (q^T H q + C . q - H : M) / mass at q, relative to the
// mean; the integrals of lists.wgsl take it to opacities, positions and areas. All is relative to the mean,
// along the axes of the fan.

// two by vertex: position, RGB and opacity
@group(0) @binding(22) var<storage, read_write> gradients: array<vec4f>;
// (vertices + 1) first corner; then 3 face + corner
@group(0) @binding(23) var<storage, read> vertex_corners: array<u32>;

// Whether a corner is the first of its vertex: loops over the triangles of a fan meet each vertex once so.
fn is_first(corner: u32, vertex: u32) -> bool {
  return vertex_corners[frame.vertices + 1u + vertex_corners[vertex]] == corner;
}
// a b a for symmetric matrices (xx, xy, yy).
fn congruence(a: vec3f, b: vec3f) -> vec3f {
  let p = a.x * b.x + a.y * b.y;
  let q = a.x * b.y + a.y * b.z;
  let r = a.y * b.x + a.z * b.y;
  let t = a.y * b.y + a.z * b.z;
  return vec3f(p * a.x + q * a.y, p * a.y + q * a.z, r * a.y + t * a.z);
}
fn apply(m: vec3f, x: vec2f) -> vec2f { return vec2f(m.x * x.x + m.y * x.y, m.y * x.x + m.z * x.y); }
fn turn(axis: vec2f, x: vec2f) -> vec2f { return vec2f(dot(axis, x), axis.x * x.y - axis.y * x.x); }
fn turn_back(axis: vec2f, x: vec2f) -> vec2f {
  return vec2f(axis.x * x.x - axis.y * x.y, axis.y * x.x + axis.x * x.y);
}

// From the gradient g of a position p in the image, relative to the principal point, to camera space.
fn to_position(g: vec2f, p: vec2f, w: f32) -> vec3f { return vec3f(frame.lens.xy * g * w, -dot(g, p) * w); }

@compute @workgroup_size(64)
fn widen_backward(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.splats) { return; }
  let begin = fans[id.x];
  let end = fans[id.x + 1u];
  var reached = false;
  for (var c = 3u * begin; c < 3u * end; c++) {
    reached = reached || any(gradients[2u * mesh[c]].xyz != vec3f(0.0));
  }
  if (!reached) { return; }
  let fan = fan_of(begin, end);
  if (!fan.moves) { return; }
  let s = frame.filter_variance;
  let start = frame.lens.xy * fan.origin.xy / fan.origin.z;  // of the first vertex, from the principal point

  // Through the moved positions, for a constant A and mean.
  var grad_a = vec3f(0.0);
  var c = vec2f(0.0);
  for (var corner = 3u * begin; corner < 3u * end; corner++) {
    let i = mesh[corner];
    if (!is_first(corner, i)) { continue; }
    let w = unpack_vertex(projected_out[i]).z;
    let relative = fan_position(i, fan.first, fan.origin).xy;
    let q = turn(fan.axis, relative - fan.middle) - fan.mean;
    let moved = fan.middle + turn_back(fan.axis, fan.mean + apply(fan.a, q));
    let t = gradients[2u * i];
    let x = t.xy / (frame.lens.xy * w);
    let g = turn(fan.axis, x);
    grad_a += vec3f(g.x * q.x, 0.5 * (g.x * q.y + g.y * q.x), g.y * q.y);
    let own = apply(fan.a, g);
    c += g - own;
    // Depth moves both positions: their difference, without the common part.
    let unmoved = turn_back(fan.axis, own);
    let depth = dot(x - unmoved, start) + (dot(x, moved) - dot(unmoved, relative));
    gradients[2u * i] = vec4f(frame.lens.xy * unmoved * w, t.z + depth * w, 0.0);
  }
  let det = fan.a.x * fan.a.z - fan.a.y * fan.a.y;
  let by_a = (det * grad_a + congruence(vec3f(fan.a.z, -fan.a.y, fan.a.x), grad_a)) /
    (2.0 * (fan.a.x + fan.a.z) * det);
  let m = fan.covariance + vec3f(MIN_VARIANCE * s, 0.0, MIN_VARIANCE * s);
  let h = -s * congruence(vec3f(m.z, -m.y, m.x) / (m.x * m.z - m.y * m.y), by_a);
  let level = h.x * fan.covariance.x + 2.0 * h.y * fan.covariance.y + h.z * fan.covariance.z;

  // Through the density.
  let k = DEPTH_SHARE * sqrt(frame.lens.x * frame.lens.y) * fan.origin.z;
  var grad_k = 0.0;
  for (var f = begin; f < end; f++) {
    let i = vec3u(mesh[3u * f], mesh[3u * f + 1u], mesh[3u * f + 2u]);
    var p: array<vec3f, 3>;
    var q: array<vec3f, 3>;
    var hq: array<vec2f, 3>;
    var a: vec3f;
    var quadratic: vec3f;
    var linear: vec3f;
    for (var j = 0u; j < 3u; j++) {
      p[j] = fan_position(i[j], fan.first, fan.origin);
      q[j] = vec3f(turn(fan.axis, p[j].xy - fan.middle) - fan.mean, p[j].z);
      hq[j] = apply(h, q[j].xy);
      a[j] = values[i[j]].w + OPACITY_BIAS;
      quadratic[j] = dot(hq[j], q[j].xy);
      linear[j] = dot(c, q[j].xy);
    }
    let total = a.x + a.y + a.z;
    let h_sum = hq[0] + hq[1] + hq[2];
    let sum_h_sum = dot(q[0].xy + q[1].xy + q[2].xy, h_sum);
    let h_alpha = a.x * hq[0] + a.y * hq[1] + a.z * hq[2];
    let u = q[1] - q[0];
    let v = q[2] - q[0];
    let normal = cross(u, v);
    let area = length(normal);
    let scale = area / fan.mass;
    var grad: array<vec3f, 3>;
    var integral = 0.0;
    var by_alpha: vec3f;
    for (var j = 0u; j < 3u; j++) {
      by_alpha[j] = sum_h_sum + 2.0 * dot(q[j].xy, h_sum) + (quadratic.x + quadratic.y + quadratic.z) +
        2.0 * quadratic[j]
        + 5.0 * (linear.x + linear.y + linear.z + linear[j]) - 20.0 * level;
      integral += a[j] * by_alpha[j];
      grad[j] = vec3f(
        scale * (2.0 * (total + a[j]) * h_sum + 2.0 * h_alpha + 2.0 * (total + 2.0 * a[j]) * hq[j] +
          5.0 * (total + a[j]) * c),
        0.0);
    }
    let grad_normal = integral / fan.mass * normal / select(1.0, area, area > 0.0);
    let grad_u = cross(v, grad_normal);
    let grad_v = cross(grad_normal, u);
    grad[0] -= grad_u + grad_v;
    grad[1] += grad_u;
    grad[2] += grad_v;
    for (var j = 0u; j < 3u; j++) {
      let w = unpack_vertex(projected_out[i[j]]).z;
      let by_image = to_position(turn_back(fan.axis, grad[j].xy), start + p[j].xy, w);
      gradients[2u * i[j]] += vec4f(by_image - vec3f(0.0, 0.0, k * grad[j].z * w * w), 0.0);
      gradients[2u * i[j] + 1u].w += scale * by_alpha[j];
      grad_k += grad[j].z * p[j].z;
    }
  }
  // k is proportional to the depth of the first vertex
  gradients[2u * mesh[3u * begin]].z += grad_k / fan.origin.z;
}
