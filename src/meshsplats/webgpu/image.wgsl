// The part of raster.wgsl for images: a sample ends when nothing more is visible, and nothing is recorded.

// by vertex: RGB, normal or world position; opacity
@group(0) @binding(3) var<storage, read> values: array<vec4f>;
fn value_of(vertex: u32) -> vec4f { return values[vertex]; }

const TRANSPARENT = false;     // whether fragments without opacity count

fn begin_sample(t: u32, x: u32, y: u32) {}
fn keep_source(at: u32, source: u32) {}
fn move_source(to: u32, at: u32) {}
fn source_at(at: u32) -> u32 { return 0u; }

fn is_open() -> bool {
  return through > 0.0 && through >= frame.min_transmittance &&
    (frame.max_layers == 0u || layers < frame.max_layers);
}

fn blend(value: vec4f, source: u32) {
  let weight = through * value.w;
  rgb = fma(vec3f(weight), value.xyz, rgb);
  through = fma(-through, value.w, through);
  if (weight > 0.0) { layers++; blended++; }
}

// Whether nothing behind the whole queue can be blended. Rounding is why half of the limit is safe.
fn hidden() -> bool {
  if (frame.max_layers != 0u && layers + K >= frame.max_layers) { return true; }
  if (frame.min_transmittance == 0.0) { return false; }
  var rest = through;
  for (var i = 0u; i < K; i++) { rest *= 1.0 - queue_value[i].w; }
  effort += K;
  return rest < 0.5 * frame.min_transmittance;
}

// Continues a sample in another walk; whether it is open.
fn resume(index: u32, state_index: u32) -> bool {
  let color = bitcast<vec4f>(samples[index]);
  let state = samples[state_index];
  rgb = color.xyz;
  through = color.w;
  floor_q = bitcast<f32>(state.x);
  floor_face = state.y;
  layers = state.z;
  return state.w == 1u;
}

fn suspend(index: u32, state_index: u32, again: bool, needed: bool) {
  samples[index] = bitcast<vec4u>(vec4f(rgb, through));
  if (needed) {
    samples[state_index] = vec4u(bitcast<u32>(floor_q), floor_face, layers, select(0u, 1u, again));
  }
}
