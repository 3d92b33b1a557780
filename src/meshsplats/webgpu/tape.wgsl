// The part of raster.wgsl for gradients: the same image, and a tape of its fragments.
//
// All fragments of a sample are recorded that the derivatives need: transparent ones, too, and behind opaque
// ones as many as if these transmitted some light. The tape is filled in two walks. The first marks the
// samples of each triangle of each pair. Prefix sums of the marks give every fragment its place on the tape,
// so that the fragments of one triangle in one tile follow each other. The second walk writes them there,
// linked from back to front. Both walks are one pipeline: they see the same fragments in the same order.
//
// `counters` holds, behind the counters, by pair: the marks, 16 words; the first fragment of each of its
// triangles, 8 words; its first sum | the triangles with marks, one bit each << 24.
//
// Behind the states, `samples` holds for each pixel the gradient of its RGB and of the background's share.

// by fragment: the one in front, opacity, RGB . gradient, transmittance
@group(0) @binding(3) var<storage, read_write> tape: array<vec4u>;
@group(0) @binding(9) var<uniform> walk: vec4u;                     // x: 0 marks, 1 writes the tape

const COUNTERS = 16u;
const NONE = 0xffffffffu;
const TRANSPARENT = true;
const MAX_ALPHA = 0.9;         // of fragments, where a sample ends

var<private> lane: u32;        // index of the sample in its tile
var<private> capped: f32;      // transmittance of alphas limited to MAX_ALPHA
var<private> last: u32;        // of the sample, on the tape
var<private> gradient: vec3f;  // of its RGB
var<private> queue_source: array<u32, K>;  // 8 * pair + triangle of its run

fn value_of(vertex: u32) -> vec4f {
  return bitcast<vec4f>(projected[frame.vertices + 2u * frame.groups + vertex]);
}

fn pixel_gradient(x: u32, y: u32) -> vec4f {
  let s = frame.samples;
  return bitcast<vec4f>(samples[2u * frame.width * frame.height + (y / s) * (frame.width / s) + x / s]);
}

fn begin_sample(t: u32, x: u32, y: u32) {
  lane = t;
  capped = 1.0;
  last = NONE;
  gradient = vec3f(0.0);
  if (walk.x == 1u && x < frame.width && y < frame.height) { gradient = pixel_gradient(x, y).xyz; }
}
fn keep_source(at: u32, source: u32) { queue_source[at] = source; }
fn move_source(to: u32, at: u32) { queue_source[to] = queue_source[at]; }
fn source_at(at: u32) -> u32 { return queue_source[at]; }

fn is_open() -> bool { return capped >= frame.min_transmittance; }

fn first_of(source: u32) -> u32 { return COUNTERS + 16u * frame.capacity + source; }
fn sums_of(pair: u32) -> u32 { return COUNTERS + 24u * frame.capacity + pair; }
fn marks_of(source: u32) -> vec2u {
  return vec2u(atomicLoad(&counters[COUNTERS + 2u * source]),
    atomicLoad(&counters[COUNTERS + 2u * source + 1u]));
}

// Marks the fragment, or writes it to the tape. `visible`: the transmittance, or 0 behind the last visible
// one.
fn record(source: u32, value: vec4f, visible: f32) {
  let bit = 1u << (lane % 32u);
  if (walk.x == 0u) {
    atomicOr(&counters[COUNTERS + 2u * source + lane / 32u], bit);
    return;
  }
  let marks = marks_of(source);
  var rank = 0u;
  if (lane < 32u) {
    rank = countOneBits(marks.x & (bit - 1u));
  } else {
    rank = countOneBits(marks.x) + countOneBits(marks.y & (bit - 1u));
  }
  let place = atomicLoad(&counters[first_of(source)]) + rank;
  tape[place] = vec4u(last, bitcast<u32>(value.w), bitcast<u32>(dot(value.xyz, gradient)),
    bitcast<u32>(visible));
  last = place;
}

fn blend(value: vec4f, source: u32) {
  let visible = select(0.0, through, through >= frame.min_transmittance);
  record(source, value, visible);
  if (visible > 0.0) {
    let weight = through * value.w;
    rgb = fma(vec3f(weight), value.xyz, rgb);
    through = fma(-through, value.w, through);
    if (weight > 0.0) { blended++; }
  }
  capped = fma(-capped, min(value.w, MAX_ALPHA), capped);
}

// Whether the sample ends within its queue. Rounding is why half of the limit is safe.
fn hidden() -> bool {
  if (frame.min_transmittance == 0.0) { return false; }
  var rest = capped;
  for (var i = 0u; i < K; i++) { rest *= 1.0 - min(queue_value[i].w, MAX_ALPHA); }
  effort += K;
  return rest < 0.5 * frame.min_transmittance;
}

fn resume(index: u32, state_index: u32) -> bool {
  let color = samples[index];
  let state = samples[state_index];
  rgb = bitcast<vec4f>(color).xyz;
  through = bitcast<f32>(color.w);
  if (walk.x == 1u) { last = color.x; }
  floor_q = bitcast<f32>(state.x);
  floor_face = state.y;
  capped = bitcast<f32>(state.z);
  return state.w == 1u;
}

fn suspend(index: u32, state_index: u32, again: bool, needed: bool) {
  samples[index] = bitcast<vec4u>(vec4f(rgb, through));
  if (walk.x == 1u) { samples[index].x = last; }
  if (needed) {
    samples[state_index] = vec4u(bitcast<u32>(floor_q), floor_face, bitcast<u32>(capped),
      select(0u, 1u, again));
  }
}
