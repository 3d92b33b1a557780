// The order of the splats: on the bindings of lists.wgsl.
//
// Runs are sorted by the depths of their splats' centres, nearest first, before pairs are made of them. Pairs
// are emitted in the order of the runs, and the sort by tiles is stable: so it needs no depth. Of equal
// depths, the later splat is in front, and of one splat the later run, as where triangles are painted one by
// one.

@group(0) @binding(24) var<storage, read_write> mesh_out: array<u32>;

// The bits of a depth as a number that ascends with it. -0 and 0 are one depth.
fn ascending(z: f32) -> u32 {
  let bits = select(bitcast<u32>(z), 0u, z == 0.0);
  return select(bits | 0x80000000u, ~bits, (bits >> 31u) == 1u);
}

fn from_center(x: vec2f, center: f32, rest: f32) -> vec2f {
  return add_pairs(add_pairs(x, vec2f(-center, 0.0)), vec2f(-rest, 0.0));
}

// Writes (depth of the splat, run) for each run of a splat, the last run first. The centre of a splat is the
// mean of the corners of its triangles, as they are without a filter.
@compute @workgroup_size(256)
fn find_depths(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= frame.splats) { return; }
  let begin = fans[id.x];
  let end = fans[id.x + 1u];
  var x = vec2f(0.0);
  var y = vec2f(0.0);
  var z = vec2f(0.0);
  for (var i = 3u * begin; i < 3u * end; i++) {
    let p = world(mesh[i]);
    x = add_pairs(x, vec2f(p.x, 0.0));
    y = add_pairs(y, vec2f(p.y, 0.0));
    z = add_pairs(z, vec2f(p.z, 0.0));
  }
  let share = invert_pair(vec2f(f32(3u * (end - begin)), 0.0));
  let depth = along(frame.forward, frame.forward_rest,
    from_center(multiply_pairs(x, share), frame.center.x, frame.center_rest.x),
    from_center(multiply_pairs(y, share), frame.center.y, frame.center_rest.y),
    from_center(multiply_pairs(z, share), frame.center.z, frame.center_rest.z));
  let key = ascending(depth.x);
  var place = frame.runs - 1u - fans[frame.splats + 1u + id.x];
  for (var f = begin; f < end; f += RUN) {
    pairs_out[place] = vec2u(key, f | ((min(end - f, RUN) - 1u) << 29u));
    place--;
  }
}

@compute @workgroup_size(1)
fn plan_runs() { write_plan(frame.runs); }

// After the sort.
@compute @workgroup_size(256)
fn order_runs(@builtin(global_invocation_id) id: vec3u) {
  if (id.x < frame.runs) { mesh_out[frame.runs_at + id.x] = pairs[id.x].y; }
}
