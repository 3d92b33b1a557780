// Prefix sums and the sort of the tile lists: on the bindings of lists.wgsl.

// -------------------------------------------------------------------------------- exclusive prefix sums
//
// In three dispatches, of the counts by run, of the table of digits (of_table is 1), or of counts by pair
// (2). Sums saturate: too many pairs stay too many.

const BLOCK = 2048u;  // items of one workgroup
fn blocks(n: u32) -> u32 { return (n + BLOCK - 1u) / BLOCK; }
fn add_saturated(a: u32, b: u32) -> u32 { return min(a, 0xffffffffu - b) + b; }
fn scan_length() -> u32 {
  if (digit.of_table == 1u) { return 256u * blocks(plan[9]); }
  if (digit.of_table == 2u) { return plan[9]; }
  return frame.runs;
}

var<workgroup> parts: array<u32, 256>;
fn scan_workgroup(t: u32, value: u32) -> u32 {  // inclusive
  parts[t] = value;
  workgroupBarrier();
  for (var step = 1u; step < 256u; step *= 2u) {
    var sum = parts[t];
    if (t >= step) { sum = add_saturated(sum, parts[t - step]); }
    workgroupBarrier();
    parts[t] = sum;
    workgroupBarrier();
  }
  return parts[t];
}
fn before(t: u32) -> u32 {  // the sum of the invocations before t, after scan_workgroup
  if (t == 0u) { return 0u; }
  return parts[t - 1u];
}

@compute @workgroup_size(256)
fn scan_blocks(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) t: u32) {
  let n = scan_length();
  let at = wg.x * BLOCK + 8u * t;
  var items: array<u32, 8>;
  var sum = 0u;
  for (var k = 0u; k < 8u; k++) {
    if (at + k < n) { items[k] = scanned[at + k]; }
    sum = add_saturated(sum, items[k]);
  }
  let all = scan_workgroup(t, sum);
  var start = before(t);
  for (var k = 0u; k < 8u; k++) {
    if (at + k < n) { scanned[at + k] = start; }
    start = add_saturated(start, items[k]);
  }
  if (t == 255u) { sums[wg.x] = all; }
}

// One workgroup. The total goes behind the sums.
@compute @workgroup_size(256)
fn scan_sums(@builtin(local_invocation_index) t: u32) {
  let n = blocks(scan_length());
  var carry = 0u;
  for (var at = 0u; at < n; at += 256u) {
    var value = 0u;
    if (at + t < n) { value = sums[at + t]; }
    scan_workgroup(t, value);
    if (at + t < n) { sums[at + t] = add_saturated(carry, before(t)); }
    carry = add_saturated(carry, parts[255]);
    workgroupBarrier();
  }
  if (t == 0u) { sums[n] = carry; }
}

@compute @workgroup_size(256)
fn scan_add(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) t: u32) {
  let n = scan_length();
  let start = sums[wg.x];
  for (var k = 0u; k < 8u; k++) {
    let i = wg.x * BLOCK + k * 256u + t;
    if (i < n) { scanned[i] = add_saturated(scanned[i], start); }
  }
}

// -------------------------------------------------------------------------------- stable radix sort
//
// By eight bits: a histogram of each block of pairs, prefix sums of the table (digit, block), and a scatter.

fn digit_of(pair: vec2u) -> u32 { return (select(pair.x, pair.y, digit.word == 1u) >> digit.shift) & 255u; }

var<workgroup> histogram: array<atomic<u32>, 256>;
@compute @workgroup_size(256)
fn count_digits(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) t: u32) {
  let n = plan[9];
  atomicStore(&histogram[t], 0u);
  workgroupBarrier();
  for (var c = 0u; c < 8u; c++) {
    let i = wg.x * BLOCK + c * 256u + t;
    if (i < n) { atomicAdd(&histogram[digit_of(pairs[i])], 1u); }
  }
  workgroupBarrier();
  scanned[t * blocks(n) + wg.x] = atomicLoad(&histogram[t]);
}

// The rank of a pair among those with its digit is the count of bits below its own in a mask of 256 bits.
var<workgroup> masks: array<atomic<u32>, 2048>;
var<workgroup> starts: array<u32, 256>;
@compute @workgroup_size(256)
fn scatter(@builtin(workgroup_id) wg: vec3u, @builtin(local_invocation_index) t: u32) {
  let n = plan[9];
  starts[t] = scanned[t * blocks(n) + wg.x];
  for (var c = 0u; c < 8u; c++) {
    for (var k = 0u; k < 8u; k++) { atomicStore(&masks[k * 256u + t], 0u); }
    workgroupBarrier();
    let i = wg.x * BLOCK + c * 256u + t;
    var pair = vec2u(0u);
    var d = 0u;
    if (i < n) {
      pair = pairs[i];
      d = digit_of(pair);
      atomicOr(&masks[8u * d + t / 32u], 1u << (t % 32u));
    }
    workgroupBarrier();
    if (i < n) {
      var rank = countOneBits(atomicLoad(&masks[8u * d + t / 32u]) & ((1u << (t % 32u)) - 1u));
      for (var k = 0u; k < t / 32u; k++) { rank += countOneBits(atomicLoad(&masks[8u * d + k])); }
      pairs_out[starts[d] + rank] = pair;
    }
    workgroupBarrier();
    var count = 0u;
    for (var k = 0u; k < 8u; k++) { count += countOneBits(atomicLoad(&masks[8u * t + k])); }
    starts[t] += count;
    workgroupBarrier();
  }
}

// -------------------------------------------------------------------------------- tile lists

fn tile_of(pair: vec2u) -> u32 { return (pair.x >> 24u) | ((pair.y >> 24u) << 8u); }

// Work item of each tile: (unused, first pair, end, 0). The items of empty tiles stay 0.
@compute @workgroup_size(256)
fn find_lists(@builtin(global_invocation_id) id: vec3u) {
  let n = plan[9];
  let i = id.x;
  if (i >= n) { return; }
  let tile = tile_of(pairs[i]);
  if (tile == NO_TILE) { return; }
  if (i == 0u || tile_of(pairs[max(i, 1u) - 1u]) != tile) { work_out[4u * (tile + 1u) + 1u] = i; }
  if (i + 1u == n || tile_of(pairs[min(i + 1u, n - 1u)]) != tile) {
    work_out[4u * (tile + 1u) + 2u] = i + 1u;
  }
}
