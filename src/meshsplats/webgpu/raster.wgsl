// Draws tiles: a workgroup a tile, an invocation a sample.
//
// The host replaces what begins with $, and adds image.wgsl, or tape.wgsl, which records fragments for
// gradients.
//
// The list of a tile comes nearest run first. Each sample keeps the nearest K of its fragments that are not
// blended yet, sorted. One that is nearer than all runs to come is blended. If there are more than K, the
// farthest is dropped, and the list is walked again, behind the last fragment that was blended: the result is
// exact for any K.
//
// In the order of the splats nothing waits: fragments are blended in the order of the list, those of a run
// from its last triangle to the first.

const BY_SPLAT = $BY_SPLAT;    // the order of the splats
const K = $Ku;                 // fragments of the queue of each sample
const OUTPUT = $OUTPUTu;       // 0: RGB of the vertices; 1: depth; 2: normals of vertices; 3: of faces
const GROUPS = $GROUPS;        // whether the mesh has depth groups

@group(0) @binding(1) var<storage, read> projected: array<vec4u>;
@group(0) @binding(2) var<storage, read> mesh: array<u32>;
@group(0) @binding(4) var<storage, read> pairs: array<vec2u>;
// from 1 on: (tile, first pair, end, walks so far)
@group(0) @binding(5) var<storage, read> work: array<vec4u>;
// RGB and transmittance; then the state
@group(0) @binding(6) var<storage, read_write> samples: array<vec4u>;
// tiles to walk again, as `work`
@group(0) @binding(7) var<storage, read_write> next_work: array<atomic<u32>>;
@group(0) @binding(8) var<storage, read_write> counters: array<atomic<u32>>;

const OWNER = 0x20000000u;     // with the face: bit i says that edge i owns the samples on it
const FACE = 0x1fffffffu;

// By slot. Edge i lies opposite to corner i: E_i = a (x - x_i) + b (y - y_i) + c_i, from the corner of the
// tile.
var<workgroup> edges: array<vec4f, 192>;   // a, b, x_i, y_i
// c_i, 0 except where the near plane cuts; 1 / determinant there, else 0
var<workgroup> ends: array<vec4f, 64>;
// E_i times these are proportional to the weights of corners; largest 1 / z
var<workgroup> scales: array<vec4f, 64>;
var<workgroup> least: array<f32, 64>;      // least 1 / z
var<workgroup> ids: array<u32, 64>;        // face and OWNER bits
var<workgroup> corners: array<vec4f, 192>; // values
// From the corner of the core's tile: 1 / z = a x + b y + c; E_i = a x + b y + constants[i]. Where the E_i of
// the tile is nearer to 0 than the fourth constant, the core's may have another sign.
var<workgroup> depths: array<vec3f, 64>;
var<workgroup> constants: array<vec4f, 64>;
// of the depth group: slopes, 1 / z at the corner of the tile; 1 if there is one
var<workgroup> planes: array<vec4f, 64>;
var<workgroup> ranges: array<vec2f, 64>;   // of 1 / z of the depth group
// By column and by row of samples: the slots whose boxes reach it, one bit each in two words. Twice, for
// batches in turn: those of one are cleared while the other's are in use.
var<workgroup> columns: array<atomic<u32>, 32>;
var<workgroup> rows: array<atomic<u32>, 32>;
var<workgroup> keys: array<f32, 8>;        // of the runs
var<workgroup> ready: array<atomic<u32>, 2>;
var<workgroup> open_count: atomic<u32>;
var<workgroup> begin_again: atomic<u32>;
var<workgroup> moved: atomic<u32>;
var<workgroup> broken: atomic<u32>;
var<workgroup> totals: array<atomic<u32>, 4>;
var<workgroup> decision: vec4u;
// Iterations of nested loops of 16 invocations together: not less than those of the SIMD lanes that run in
// step.
var<workgroup> efforts: array<atomic<u32>, 4>;

// The sample.
var<private> core_corner: vec2f;  // of the core's tile
var<private> block: vec2f;        // corner of its block of 4 x 4 samples, from core_corner
var<private> in_block: vec2f;     // its centre, from the corner of the block
var<private> rgb: vec3f;
var<private> through: f32;        // transmittance
var<private> layers: u32;         // fragments blended
var<private> floor_q: f32;        // the last fragment blended
var<private> floor_face: u32;
var<private> limit_q: f32;        // the nearest fragment dropped; below 0: none
var<private> limit_face: u32;
var<private> blended: u32;        // in this walk, visible ones
var<private> advanced: bool;      // in this walk
var<private> effort: u32;         // iterations of nested loops in this batch
var<private> turn: u32;           // of `columns` and `rows`: 0 or 16
// The triangles that come into the slot in this batch and in those after it. Where one is read depends on
// what was read of it before. So each batch reads one step of each: none waits for another.
var<private> next_pair: u32;      // where the last of them is in the list
var<private> coming_pair: array<vec2u, 4>;
var<private> coming_face: array<u32, 3>;
var<private> coming_corners: array<vec3u, 2>;
var<private> coming_vertices: array<vec4u, 3>;
// Its queue: a ring, nearest first.
var<private> head: u32;
var<private> count: u32;
var<private> queue_key: array<f32, K>;
var<private> queue_face: array<u32, K>;
var<private> queue_value: array<vec4f, K>;

fn place(i: u32) -> u32 {
  let j = head + i;
  return select(j, j - K, j >= K);
}

fn most_effort() -> u32 {
  return max(max(atomicLoad(&efforts[0]), atomicLoad(&efforts[1])),
    max(atomicLoad(&efforts[2]), atomicLoad(&efforts[3])));
}

fn is_nearer(q: f32, face: u32, other_q: f32, other_face: u32) -> bool {
  return q > other_q || (q == other_q && face < other_face);
}

// Puts a fragment into its place. The farthest is dropped if there are too many.
fn insert(q: f32, face: u32, value: vec4f, source: u32) {
  var dropped_q = -1.0;
  var dropped_face = 0u;
  if (count == K) {
    let last = place(K - 1u);
    if (!is_nearer(q, face, queue_key[last], queue_face[last])) {
      drop(q, face);
      return;
    }
    dropped_q = queue_key[last];
    dropped_face = queue_face[last];
    count--;
  }
  var i = count;
  while (i > 0u) {
    let before = place(i - 1u);
    if (!is_nearer(q, face, queue_key[before], queue_face[before])) { break; }
    let after = place(i);
    queue_key[after] = queue_key[before];
    queue_face[after] = queue_face[before];
    queue_value[after] = queue_value[before];
    move_source(after, before);
    i--;
    effort++;
  }
  let free = place(i);
  queue_key[free] = q;
  queue_face[free] = face;
  queue_value[free] = value;
  keep_source(free, source);
  count++;
  if (dropped_q >= 0.0) { drop(dropped_q, dropped_face); }
}

// Notes a fragment that lies behind the full queue.
fn drop(q: f32, face: u32) {
  if (limit_q < 0.0 && hidden()) { return; }  // a limit only comes nearer
  limit_q = q;
  limit_face = face;
}

// -------------------------------------------------------------------------------- fragments

// The fragment of the triangle in a slot at the sample p, which it covers: adds it to the queue unless it is
// blended already or lies behind what was dropped; in the order of the splats, blends it. `key` bounds it;
// `source` says where the triangle is from.
fn add_fragment(slot: u32, p: vec2f, tile: vec2f, key: f32, source: u32) {
  let e = edges_at(slot, p);
  let scale = scales[slot];
  let b = e * scale.xyz;
  let sum = b.x + b.y + b.z;
  let inverse = ends[slot].w;
  var depth = 0.0;  // 1 / z
  if (inverse == 0.0) {
    if (!BY_SPLAT || OUTPUT == 1u) { depth = at_sample(depths[slot]); }
  } else {
    depth = sum * inverse;
    if (depth > scale.w) { return; }  // nearer than the near plane
  }
  depth = clamp(depth, least[slot], scale.w);
  var q = depth;
  if (GROUPS) {
    let plane = planes[slot];
    if (plane.w > 0.0) {
      q = clamp(fma(plane.x, p.x, fma(plane.y, p.y, plane.z)), ranges[slot].x, ranges[slot].y);
    }
  }
  q = min(q, key);
  let face = ids[slot] & FACE;
  if (!BY_SPLAT) {
    if (!(q < floor_q || (q == floor_q && face > floor_face))) { return; }
    if (q < limit_q || (q == limit_q && face > limit_face)) { return; }
  }
  let w = b / sum;
  let v0 = corners[3u * slot];
  let v1 = corners[3u * slot + 1u];
  let v2 = corners[3u * slot + 2u];
  var value = fma(vec4f(w.x), v0, fma(vec4f(w.y), v1, w.z * v2));
  if (OUTPUT == 3u) { value = vec4f(v0.xyz, value.w); }
  value.w = clamp(value.w, min(min(v0.w, v1.w), v2.w), max(max(v0.w, v1.w), v2.w));
  if (frame.cutoff >= 0.0) {
    if (value.w < frame.cutoff) { return; }
    value.w = 1.0;
  }
  if (!(value.w > 0.0) && !TRANSPARENT) { return; }
  if (OUTPUT == 1u) { value = vec4f(1.0 / depth, 0.0, 0.0, value.w); }
  if (OUTPUT >= 2u) { value = vec4f(facing(value.xyz, tile + p), value.w); }
  if (BY_SPLAT) { blend(value, source); } else { insert(q, face, value, source); }
}

// Blends the nearest of the queue.
fn blend_front() {
  blend(queue_value[head], source_at(head));
  floor_q = queue_key[head];
  floor_face = queue_face[head];
  advanced = true;
  head = place(1u);
  count--;
}

// The unit normal that faces the camera at the position p of the image; 0 for one without direction.
fn facing(n: vec3f, p: vec2f) -> vec3f {
  let most = max(max(abs(n.x), abs(n.y)), abs(n.z));
  if (!(most > 0.0)) { return vec3f(0.0); }
  let unit = normalize(n / most);
  let ray = (p - frame.lens.zw) / frame.lens.xy;
  let along = dot(unit, ray.x * frame.right.xyz + ray.y * frame.down.xyz + frame.forward.xyz);
  return select(unit, -unit, along > 0.0);
}

// -------------------------------------------------------------------------------- tiles

// Which triangle of its run is in a slot.
fn face_of_slot(slot: u32) -> u32 { return select(slot % RUN, RUN - 1u - slot % RUN, BY_SPLAT); }

const NO_FACE = 0xffffffffu;
const NO_RUN = 0xffffffffu;

// Reads on, in a list that ends at `end`.
fn read_on(slot: u32, end: u32) {
  if (coming_face[1] != NO_FACE) {
    let i = coming_corners[1];
    coming_vertices = array<vec4u, 3>(projected[i.x], projected[i.y], projected[i.z]);
  }
  coming_corners[0] = coming_corners[1];
  let f = 3u * coming_face[2];
  if (coming_face[2] != NO_FACE) { coming_corners[1] = vec3u(mesh[f], mesh[f + 1u], mesh[f + 2u]); }
  coming_face[0] = coming_face[1];
  coming_face[1] = coming_face[2];
  coming_face[2] = NO_FACE;
  if (coming_pair[3].y != NO_RUN) {
    let run = unpack_run(mesh[frame.runs_at + (coming_pair[3].y & 0xffffffu)]);
    let k = face_of_slot(slot);
    if (k < run.count) { coming_face[2] = run.first + k; }
  }
  coming_pair[0] = coming_pair[1];
  coming_pair[1] = coming_pair[2];
  coming_pair[2] = coming_pair[3];
  coming_pair[3].y = NO_RUN;
  if (next_pair < end) { coming_pair[3] = pairs[next_pair]; }
  next_pair += RUN;
}

fn add_wide(at: u32, value: u32) {  // to a counter of 64 bits
  let old = atomicAdd(&counters[at], value);
  if (old > 0xffffffffu - value) { atomicAdd(&counters[at + 1u], 1u); }
}

@compute @workgroup_size(64)
fn raster(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) t: u32) {
  let item = work[wg.x + 1u];
  let tile = select(item.x, wg.x, item.w == 0u);
  let tile_x = tile % frame.tiles_x;
  let tile_y = tile / frame.tiles_x;
  let o = vec2f(f32(tile_x * TILE), f32(tile_y * TILE));
  let x = tile_x * TILE + t % TILE;
  let y = tile_y * TILE + t / TILE;
  let p = vec2f(f32(t % TILE) + 0.5, f32(t / TILE) + 0.5);
  let in_image = x < frame.width && y < frame.height;
  let index = y * frame.width + x;
  let state_index = frame.width * frame.height + index;

  rgb = vec3f(0.0);
  through = 1.0;
  layers = 0u;
  floor_q = 3e38;
  floor_face = 0u;
  limit_q = -1.0;
  limit_face = 0u;
  blended = 0u;
  advanced = false;
  head = 0u;
  count = 0u;
  effort = 0u;
  var open = in_image;
  find_block(vec2u(o), vec2u(x, y));
  begin_sample(t, x, y);
  if (item.w > 0u && in_image) {
    open = resume(index, state_index);
  }
  let was_open = open;
  if (t == 0u) { atomicStore(&broken, 0u); }
  if (t < 4u) { atomicStore(&efforts[t], 0u); }
  if (t < 16u) { atomicStore(&columns[t], 0u); } else if (t < 32u) { atomicStore(&rows[t - 16u], 0u); }
  turn = 0u;

  var clean = item.y;     // everything before it is blended
  var at = item.y;
  let end = item.z;
  next_pair = at + t / RUN;
  coming_face = array<u32, 3>(NO_FACE, NO_FACE, NO_FACE);
  coming_pair[3].y = NO_RUN;
  for (var i = 0u; i < 4u; i++) { read_on(t, end); }
  var nearest = 0u;
  if (at < end) { nearest = pairs[at].x; }
  var spent = 0u;
  var cut = false;        // the budget is spent
  var ended = false;      // the loop was left by its own exits
  var whole = true;       // so were the inner loops
  var tests = 0u;
  loop {
    if (at >= end) { ended = true; break; }
    if (t < 2u) { atomicStore(&ready[t], 0u); }
    if (t == 2u) { atomicStore(&open_count, 0u); }
    workgroupBarrier();
    // No fragment to come is nearer than this.
    let nearest_to_come = unpack_depth(nearest);
    if (open) {
      if (BY_SPLAT) {
        clean = at;
      } else {
        while (count > 0u && open && queue_key[head] > nearest_to_come) { blend_front(); open = is_open(); }
        if (count == 0u && limit_q < 0.0) { clean = at; }
      }
      if (open) { atomicAdd(&open_count, 1u); }
    }
    if (t % RUN == 0u) { keys[t / RUN] = unpack_depth(coming_pair[0].x); }
    if (coming_face[0] != NO_FACE) {
      if (set_up(t, coming_face[0], coming_corners[0], coming_vertices, o)) {
        atomicOr(&ready[t / 32u], 1u << (t % 32u));
      }
    }
    if (t >= 32u && t < 48u) { atomicStore(&columns[(16u - turn) + t - 32u], 0u); }
    if (t >= 48u) { atomicStore(&rows[(16u - turn) + t - 48u], 0u); }
    read_on(t, end);
    if (at + RUN < end) { nearest = pairs[at + RUN].x; }
    workgroupBarrier();
    if (t == 0u) {
      decision = vec4u(atomicLoad(&open_count), atomicLoad(&ready[0]), atomicLoad(&ready[1]), most_effort());
    }
    let now = workgroupUniformLoad(&decision);
    if (now.x == 0u) { ended = true; break; }
    if (spent + now.w > frame.budget) { ended = true; cut = true; break; }
    let triangles = countOneBits(now.y) + countOneBits(now.z);
    spent += 2u * triangles + K + 24u;
    if (open) {
      // Slots whose box holds the sample; those that cover it; then their fragments: lanes differ less so.
      let column = turn + 2u * (t % TILE);
      let row = turn + 2u * (t / TILE);
      var near = vec2u(
        atomicLoad(&columns[column]) & atomicLoad(&rows[row]),
        atomicLoad(&columns[column + 1u]) & atomicLoad(&rows[row + 1u]));
      tests += countOneBits(near.x) + countOneBits(near.y);
      effort = 0u;
      var hits = vec2u(0u);
      while ((near.x | near.y) != 0u) {
        var slot = 0u;
        if (near.x != 0u) { slot = firstTrailingBit(near.x); near.x &= near.x - 1u; }
        else { slot = 32u + firstTrailingBit(near.y); near.y &= near.y - 1u; }
        let hit = select(0u, 1u << (slot % 32u), covers(slot, p));
        if (slot < 32u) { hits.x |= hit; } else { hits.y |= hit; }
      }
      while ((hits.x | hits.y) != 0u && open) {
        var slot = 0u;
        if (hits.x != 0u) { slot = firstTrailingBit(hits.x); hits.x &= hits.x - 1u; }
        else { slot = 32u + firstTrailingBit(hits.y); hits.y &= hits.y - 1u; }
        let key = keys[slot / RUN];
        if (!BY_SPLAT && count == K && queue_key[head] > key) { blend_front(); open = is_open(); }
        if (open) { add_fragment(slot, p, o, key, RUN * (at + slot / RUN) + face_of_slot(slot)); }
        if (BY_SPLAT) { open = is_open(); }
      }
      atomicAdd(&efforts[t / 16u], effort);
      whole = whole && (near.x | near.y) == 0u && ((hits.x | hits.y) == 0u || !open);
    }
    at += RUN;
    turn = 16u - turn;
  }
  if (!BY_SPLAT && open && !cut) {
    while (count > 0u && open) { blend_front(); open = is_open(); }
    whole = whole && (count == 0u || !open);
  }
  let again = open && (cut || limit_q >= 0.0);

  workgroupBarrier();
  if (t == 0u) { atomicStore(&open_count, 0u); atomicStore(&begin_again, end); atomicStore(&moved, 0u); }
  if (t < 4u) { atomicStore(&totals[t], 0u); }
  workgroupBarrier();
  if (again) {
    atomicAdd(&open_count, 1u);
    atomicMin(&begin_again, clean);
    if (advanced) { atomicOr(&moved, 1u); }
  }
  if (!(whole && ended)) { atomicOr(&broken, 1u); }
  if (was_open && !again) { atomicOr(&moved, 1u); }
  atomicAdd(&totals[0], tests);
  atomicAdd(&totals[1], blended);
  workgroupBarrier();
  let left = atomicLoad(&open_count);
  if (in_image) { suspend(index, state_index, again, left > 0u); }
  if (t != 0u) { return; }
  atomicAdd(&counters[3], 1u);
  atomicMax(&counters[4], item.w + 1u);
  add_wide(5u, atomicLoad(&totals[0]));
  add_wide(7u, atomicLoad(&totals[1]));
  if (cut) { atomicAdd(&counters[10], 1u); }
  if (atomicLoad(&broken) != 0u) {
    atomicAdd(&counters[12], 1u);
  } else if (left == 0u) {
    atomicAdd(&counters[2], 1u);
  } else if (atomicLoad(&moved) == 0u && atomicLoad(&begin_again) <= item.y) {
    atomicAdd(&counters[9], 1u);
  } else {
    if (item.w == 0u) { atomicAdd(&counters[11], left); }
    let place = 4u * (atomicAdd(&next_work[0], 1u) + 1u);
    atomicStore(&next_work[1], 1u);
    atomicStore(&next_work[2], 1u);
    atomicStore(&next_work[place], tile);
    atomicStore(&next_work[place + 1u], atomicLoad(&begin_again));
    atomicStore(&next_work[place + 2u], end);
    atomicStore(&next_work[place + 3u], item.w + 1u);
  }
}
