// Loss, its gradient, and Adam: what fine-tuning does between the forward and the backward pass, and behind
// it.

struct Step {
  width: u32, height: u32,               // of the image, in pixels
  x: u32, y: u32,                        // corner of the window
  columns: u32, rows: u32,               // size of the window
  samples: u32,                          // side of the grid of samples in a pixel
  tiles: u32,                            // of the window
  background: vec3f,                     // RGB
  position_epsilon: f32,                 // Adam's for positions
  l1_weight: f32, ssim_weight: f32, l2_weight: f32,  // derivatives of the loss with respect to the sums
  color_epsilon: f32,                    // Adam's for colours
  color_step: f32, position_step: f32,   // learning rates with bias corrections; 0: positions are fixed
  one_minus_beta1: f32, one_minus_beta2: f32,
  harmonic_step: f32,                    // learning rate with bias corrections; 0: harmonics are fixed
  brightest: f32,                        // largest value of RGB
  masked: u32,                           // 1: behind its RGB, the target says which pixels count
  harmonic_splats: u32,                  // splats with harmonics
  opacity_kept: f32,                     // share of its opacity that a vertex with a gradient keeps
};
@group(0) @binding(1) var<uniform> step_of: Step;
// RGB and transmittance; states; gradients by pixel
@group(0) @binding(2) var<storage, read_write> samples: array<vec4f>;
@group(0) @binding(3) var<storage, read_write> image: array<vec4f>;        // RGB over the background
@group(0) @binding(4) var<storage, read> target_image: array<f32>;  // RGB; 1 where a pixel counts, else 0
// three by pixel: of SSIM, for each channel
@group(0) @binding(5) var<storage, read_write> derivatives: array<vec4f>;
// of RGB; of the background's share
@group(0) @binding(6) var<storage, read_write> image_gradient: array<vec4f>;
// by workgroup: sums of |d|, d^2 and SSIM
@group(0) @binding(7) var<storage, read_write> losses: array<vec4f>;
// the three sums; at 4: unfinished, 5: not finite
@group(0) @binding(8) var<storage, read_write> results: array<atomic<u32>>;
@group(0) @binding(9) var<storage, read> counters: array<u32>;
// two by vertex: position in camera axes; RGB and opacity
@group(0) @binding(10) var<storage, read> gradients: array<vec4f>;
@group(0) @binding(11) var<storage, read_write> vertices: array<f32>;
@group(0) @binding(12) var<storage, read_write> colors: array<vec4f>;      // RGB and opacity
// two by vertex: mean, square
@group(0) @binding(13) var<storage, read_write> position_moments: array<vec4f>;
@group(0) @binding(14) var<storage, read_write> color_moments: array<vec4f>;
// unit of the position; 1 where an opacity of 0 stays
@group(0) @binding(15) var<storage, read> traits: array<vec2f>;
@group(0) @binding(16) var<storage, read> values: array<vec4f>;            // the colours of the view
@group(0) @binding(17) var<storage, read_write> harmonics: array<f32>;     // (splats, terms, 3)
@group(0) @binding(18) var<storage, read_write> harmonic_means: array<f32>;
@group(0) @binding(19) var<storage, read_write> harmonic_squares: array<f32>;
// first vertices of splats, their end; then the vertices of one splat after the other
@group(0) @binding(20) var<storage, read> splat_vertices: array<u32>;

struct Rounding { share: f32, corners: u32, fans: u32 };
@group(0) @binding(21) var<uniform> rounding: Rounding;
@group(0) @binding(22) var<storage, read> polygon: array<vec2f>;  // regular, of the corners of a rim

const SIDE = 16u;              // pixels along each side of a workgroup's tile
const RADIUS = 5u;
const WIDE = 26u;              // SIDE + 2 RADIUS
const C1 = 1e-4;
const C2 = 9e-4;
const WEIGHT = array<f32, 6>(0.26601171, 0.21300554, 0.10936069, 0.036000773, 0.0075987582, 0.0010283801);

fn is_finite(x: f32) -> bool { return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u; }

// -------------------------------------------------------------------------------- windows

// Averages the samples of a window.
@compute @workgroup_size(8, 8)
fn store_window(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= step_of.columns || id.y >= step_of.rows) { return; }
  let s = step_of.samples;
  var sum = vec4f(0.0);
  for (var j = 0u; j < s; j++) {
    for (var i = 0u; i < s; i++) { sum += samples[(id.y * s + j) * step_of.columns * s + id.x * s + i]; }
  }
  sum *= 1.0 / f32(s * s);
  image[(step_of.y + id.y) * step_of.width + step_of.x + id.x] =
    vec4f(sum.xyz + sum.w * step_of.background, sum.w);
}

// Hands the gradient of the image to the samples of a window.
@compute @workgroup_size(8, 8)
fn load_window(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= step_of.columns || id.y >= step_of.rows) { return; }
  let s = step_of.samples;
  let at = 2u * step_of.columns * step_of.rows * s * s + id.y * step_of.columns + id.x;
  samples[at] = image_gradient[(step_of.y + id.y) * step_of.width + step_of.x + id.x] * (1.0 / f32(s * s));
}

@compute @workgroup_size(1)
fn judge() {
  if (counters[2] != step_of.tiles || counters[15] != 0u) { atomicStore(&results[4], 1u); }
}

// -------------------------------------------------------------------------------- loss
//
// L1, L2 and SSIM with Gaussian windows of 11 x 11 pixels and sigma 1.5. Values outside the image, and of
// pixels that do not count, are 0. With m = (x + y) / 2, d = x - y and G the windowed mean, SSIM is
//     (1 - p^2 / B1) (1 - v / B2),  p = G d,         B1 = 2 (G m)^2 + p^2 / 2 + C1,
//                                   v = G d^2 - p^2, B2 = 2 (G m^2 - (G m)^2) + v / 2 + C2,
// where rounding is relative to 1 - SSIM. A constant subtracted from m does not change B2: 1/2 keeps more of
// bright regions. The window is separable.

var<workgroup> wide_m: array<f32, 676>;      // WIDE x WIDE
var<workgroup> wide_d: array<f32, 676>;
var<workgroup> filtered: array<vec4f, 416>;  // SIDE x WIDE: filtered along rows

// x, y and whether the pixel counts, of a channel; zeros outside.
fn pixel_at(x: i32, y: i32, c: u32) -> vec3f {
  if (x < 0 || y < 0 || x >= i32(step_of.width) || y >= i32(step_of.height)) { return vec3f(0.0); }
  let at = u32(y) * step_of.width + u32(x);
  if (step_of.masked == 1u && target_image[3u * step_of.width * step_of.height + at] == 0.0) {
    return vec3f(0.0);
  }
  return vec3f(image[at][c], target_image[3u * at + c], 1.0);
}
fn weight_of(k: u32) -> f32 {
  var weights = WEIGHT;
  return weights[select(RADIUS - k, k - RADIUS, k > RADIUS)];
}

// Rates the pixels of a tile, and finds the derivatives of SSIM through p and G m (together), G d^2 and G
// m^2.
var<workgroup> rated: array<vec4f, 256>;
@compute @workgroup_size(256)
fn rate(@builtin(workgroup_id) wg: vec3u, @builtin(num_workgroups) size: vec3u,
  @builtin(local_invocation_index) t: u32) {
  let corner = vec2i(wg.xy * SIDE) - i32(RADIUS);
  let here = vec2i(wg.xy * SIDE) + vec2i(i32(t % SIDE), i32(t / SIDE));
  var sum = vec4f(0.0);
  for (var c = 0u; c < 3u; c++) {
    for (var i = t; i < WIDE * WIDE; i += 256u) {
      let p = pixel_at(corner.x + i32(i % WIDE), corner.y + i32(i / WIDE), c);
      wide_m[i] = 0.5 * (p.x + p.y) - 0.5;
      wide_d[i] = p.x - p.y;
    }
    workgroupBarrier();
    for (var i = t; i < SIDE * WIDE; i += 256u) {
      let at = (i / SIDE) * WIDE + i % SIDE;
      var f = vec4f(0.0);
      for (var k = 0u; k < 11u; k++) {
        let m = wide_m[at + k];
        let d = wide_d[at + k];
        f += weight_of(k) * vec4f(m, d, m * m, d * d);
      }
      filtered[i] = f;
    }
    workgroupBarrier();
    var f = vec4f(0.0);
    for (var k = 0u; k < 11u; k++) { f += weight_of(k) * filtered[t + SIDE * k]; }
    let own = pixel_at(here.x, here.y, c);
    let q = f.x + 0.5;
    let p = f.y;
    let v = max(f.w - p * p, 0.0);
    let w = max(f.z - f.x * f.x, 0.0);
    let b1 = 2.0 * q * q + 0.5 * p * p + C1;
    let b2_of_m = 2.0 * w + C2;
    let b2 = b2_of_m + 0.5 * v;
    let luminance = 1.0 - p * p / b1;
    let contrast = 1.0 - v / b2;
    let k = luminance / (b2 * b2) * own.z;
    let by_square = -k * b2_of_m;
    let by_mean_square = 2.0 * k * v;
    let l = contrast / b1 * own.z;
    let by_p = l * p * (p * p / b1 - 2.0) - 2.0 * p * by_square;
    let by_mean = 4.0 * l * p * p * q / b1 - 2.0 * f.x * by_mean_square;
    if (here.x < i32(step_of.width) && here.y < i32(step_of.height)) {
      derivatives[3u * (u32(here.y) * step_of.width + u32(here.x)) + c] =
        vec4f(by_p + 0.5 * by_mean, by_square, by_mean_square, 0.0);
    }
    let d = own.x - own.y;
    sum += vec4f(abs(d), d * d, luminance * contrast * own.z, 0.0);
    workgroupBarrier();
  }
  rated[t] = sum;
  for (var half = 128u; half > 0u; half /= 2u) {
    workgroupBarrier();
    if (t < half) { rated[t] += rated[t + half]; }
  }
  if (t == 0u) { losses[wg.y * size.x + wg.x] = rated[0]; }
}

// One workgroup.
@compute @workgroup_size(256)
fn add_losses(@builtin(local_invocation_index) t: u32) {
  let n = ((step_of.width + SIDE - 1u) / SIDE) * ((step_of.height + SIDE - 1u) / SIDE);
  var sum = vec4f(0.0);
  for (var i = t; i < n; i += 256u) { sum += losses[i]; }
  rated[t] = sum;
  for (var half = 128u; half > 0u; half /= 2u) {
    workgroupBarrier();
    if (t < half) { rated[t] += rated[t + half]; }
  }
  if (t == 0u) {
    for (var c = 0u; c < 3u; c++) {
      atomicStore(&results[c], bitcast<u32>(rated[0][c]));
      if (!is_finite(rated[0][c])) { atomicStore(&results[5], 1u); }
    }
  }
}

@compute @workgroup_size(256)
fn find_image_gradient(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) t: u32) {
  let corner = vec2i(wg.xy * SIDE) - i32(RADIUS);
  let here = vec2i(wg.xy * SIDE) + vec2i(i32(t % SIDE), i32(t / SIDE));
  var gradient = vec3f(0.0);
  for (var c = 0u; c < 3u; c++) {
    for (var i = t; i < SIDE * WIDE; i += 256u) {
      let y = corner.y + i32(i / SIDE);
      var f = vec4f(0.0);
      if (y >= 0 && y < i32(step_of.height)) {
        for (var k = 0u; k < 11u; k++) {
          let x = corner.x + i32(i % SIDE + k);
          if (x >= 0 && x < i32(step_of.width)) {
            f += weight_of(k) * derivatives[3u * (u32(y) * step_of.width + u32(x)) + c];
          }
        }
      }
      filtered[i] = f;
    }
    workgroupBarrier();
    var f = vec4f(0.0);
    for (var k = 0u; k < 11u; k++) { f += weight_of(k) * filtered[t + SIDE * k]; }
    let own = pixel_at(here.x, here.y, c);
    let d = own.x - own.y;
    let m = 0.5 * (own.x + own.y) - 0.5;
    gradient[c] = own.z * (step_of.l1_weight * sign(d) + step_of.l2_weight * 2.0 * d
      + step_of.ssim_weight * (f.x + 2.0 * d * f.y + m * f.z));
    workgroupBarrier();
  }
  if (here.x < i32(step_of.width) && here.y < i32(step_of.height)) {
    image_gradient[u32(here.y) * step_of.width + u32(here.x)] =
      vec4f(gradient, dot(gradient, step_of.background));
  }
}

// -------------------------------------------------------------------------------- Adam

@compute @workgroup_size(256)
fn check_gradients(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.vertices) { return; }
  let sum = dot(abs(gradients[2u * id.x]), vec4f(1.0)) + dot(abs(gradients[2u * id.x + 1u]), vec4f(1.0));
  if (!is_finite(sum)) { atomicStore(&results[5], 1u); }
}

fn all_went_well() -> bool { return (atomicLoad(&results[4]) | atomicLoad(&results[5])) == 0u; }

// The gradient of the RGB and opacity of a vertex. Where its colour is held at 0, as harmonics may have it,
// only one that raises it counts.
fn color_gradient(i: u32) -> vec4f {
  let g = gradients[2u * i + 1u];
  if (frame.terms == 0u) { return g; }
  return vec4f(select(vec3f(0.0), g.rgb, (values[i].rgb > vec3f(0.0)) | (g.rgb < vec3f(0.0))), g.a);
}

// Adam (Kingma & Ba 2015) on the vertices with a gradient; nothing changes unless all went well.
@compute @workgroup_size(256)
fn adam(@builtin(global_invocation_id) id: vec3u) {
  let i = id.x;
  if (i >= frame.vertices || !all_went_well()) { return; }
  let g = color_gradient(i);
  if (all(g == vec4f(0.0))) { return; }
  let value = colors[i];
  let mean = fma(g - color_moments[2u * i], vec4f(step_of.one_minus_beta1), color_moments[2u * i]);
  let square = fma(g * g - color_moments[2u * i + 1u], vec4f(step_of.one_minus_beta2),
    color_moments[2u * i + 1u]);
  color_moments[2u * i] = mean;
  color_moments[2u * i + 1u] = square;
  var moved = clamp(value - step_of.color_step * (mean / (sqrt(square) + step_of.color_epsilon)), vec4f(0.0),
    vec4f(vec3f(step_of.brightest), 1.0));
  moved.w *= step_of.opacity_kept;
  if (traits[i].y == 1.0 && value.w == 0.0) { moved.w = 0.0; }
  colors[i] = moved;
  if (step_of.position_step == 0.0) { return; }
  let c = gradients[2u * i].xyz;
  let p = c.x * frame.right.xyz + c.y * frame.down.xyz + c.z * frame.forward.xyz;
  let p_mean = fma(p - position_moments[2u * i].xyz, vec3f(step_of.one_minus_beta1),
    position_moments[2u * i].xyz);
  let p_square = fma(
    p * p - position_moments[2u * i + 1u].xyz, vec3f(step_of.one_minus_beta2),
      position_moments[2u * i + 1u].xyz);
  position_moments[2u * i] = vec4f(p_mean, 0.0);
  position_moments[2u * i + 1u] = vec4f(p_square, 0.0);
  let change = step_of.position_step * traits[i].x * (p_mean / (sqrt(p_square) + step_of.position_epsilon));
  for (var k = 0u; k < 3u; k++) { vertices[3u * i + k] -= change[k]; }
}

// The same on the harmonics of splats with a gradient, before the vertices move. An invocation a splat.
@compute @workgroup_size(64)
fn adam_harmonics(@builtin(global_invocation_id) id: vec3u) {
  let splat = id.x;
  if (splat >= step_of.harmonic_splats || step_of.harmonic_step == 0.0 || !all_went_well()) { return; }
  var sum: array<vec3f, MOST_TERMS>;
  var reached = false;
  let list = step_of.harmonic_splats + 1u;
  for (var n = splat_vertices[splat]; n < splat_vertices[splat + 1u]; n++) {
    let i = splat_vertices[list + n];
    let g = color_gradient(i).rgb;
    if (all(g == vec3f(0.0))) { continue; }
    reached = true;
    let basis = basis_of(direction_to(vertex_at(i)));
    for (var k = 0u; k < frame.terms; k++) { sum[k] += basis[k] * g; }
  }
  if (!reached) { return; }
  for (var k = 0u; k < frame.terms; k++) {
    for (var c = 0u; c < 3u; c++) {
      let at = 3u * (splat * frame.terms + k) + c;
      let g = sum[k][c];
      let mean = fma(g - harmonic_means[at], step_of.one_minus_beta1, harmonic_means[at]);
      let square = fma(g * g - harmonic_squares[at], step_of.one_minus_beta2, harmonic_squares[at]);
      harmonic_means[at] = mean;
      harmonic_squares[at] = square;
      harmonics[at] -= step_of.harmonic_step * (mean / (sqrt(square) + step_of.color_epsilon));
    }
  }
}

// -------------------------------------------------------------------------------- fans

fn vertex_at(i: u32) -> vec3f {
  return vec3f(vertices[3u * i], vertices[3u * i + 1u], vertices[3u * i + 2u]);
}
fn move_vertex(i: u32, by: vec3f) { for (var k = 0u; k < 3u; k++) { vertices[3u * i + k] += by[k]; } }

// Moves the vertices of fans towards the nearest affine image of a regular polygon, as the core does: a fan
// has its centre, then its rim. Positions are relative to a corner of the rim, for float32.
@compute @workgroup_size(64)
fn round_fans(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= rounding.fans) { return; }
  let center = id.x * rounding.corners;
  let sides = rounding.corners - 1u;
  let origin = vertex_at(center + 1u);
  var mean = vec3f(0.0);
  var cosine = vec3f(0.0);
  var sine = vec3f(0.0);
  for (var i = 0u; i < sides; i++) {
    let p = vertex_at(center + 1u + i) - origin;
    mean += p;
    cosine += polygon[i].x * p;
    sine += polygon[i].y * p;
  }
  mean /= f32(sides);
  cosine *= 2.0 / f32(sides);
  sine *= 2.0 / f32(sides);
  move_vertex(center, rounding.share * (mean - (vertex_at(center) - origin)));
  for (var i = 0u; i < sides; i++) {
    let at = center + 1u + i;
    let on_ellipse = mean + polygon[i].x * cosine + polygon[i].y * sine;
    move_vertex(at, rounding.share * (on_ellipse - (vertex_at(at) - origin)));
  }
}
