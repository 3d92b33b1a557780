// The order of triangles and splats for WebGL, from the farthest to the nearest.

// Fills `order` with `items`, indices of `depths`, the farthest first. Depths are positive floats: their bits
// are in the same order.
export function sortFarToNear(depths, items, order) {
  const n = items.length, bits = new Uint32Array(depths.buffer, depths.byteOffset, depths.length);
  let low = 0xffffffff, high = 0;
  for (let i = 0; i < n; i++) {
    const b = bits[items[i]];
    if (b < low) low = b;
    if (b > high) high = b;
  }
  const BUCKETS = 1 << 18, shift = Math.max(0, 32 - Math.clz32(Math.max(0, high - low)) - 18);
  const ends = new Uint32Array(BUCKETS + 1);
  for (let i = 0; i < n; i++) ends[BUCKETS - ((bits[items[i]] - low) >>> shift)]++;
  for (let i = 1; i <= BUCKETS; i++) ends[i] += ends[i - 1];
  for (let i = n - 1; i >= 0; i--) order[--ends[BUCKETS - ((bits[items[i]] - low) >>> shift)]] = items[i];
  return order;
}

// The same for any depths, and sorted to the last bit; of equal depths, the first of `items` comes first.
export function sortFarToNearExactly(depths, items, order) {
  const n = items.length, bits = new Uint32Array(depths.buffer, depths.byteOffset, depths.length);
  const keys = new Uint32Array(depths.length), other = new Uint32Array(n), BITS = 11, DIGITS = 1 << BITS;
  for (let i = 0; i < keys.length; i++) {
    const b = depths[i] === 0 ? 0 : bits[i]; // -0 and 0 are one depth
    keys[i] = b >>> 31 ? b : ~(b | 0x80000000);
  }
  let from = items, to = order;
  for (let shift = 0; shift < 32; shift += BITS) {
    const ends = new Uint32Array(DIGITS + 1);
    for (let i = 0; i < n; i++) ends[((keys[from[i]] >>> shift) & (DIGITS - 1)) + 1]++;
    for (let i = 1; i < DIGITS; i++) ends[i] += ends[i - 1];
    for (let i = 0; i < n; i++) to[ends[(keys[from[i]] >>> shift) & (DIGITS - 1)]++] = from[i];
    [from, to] = [to, to === order ? other : order];
  }
  return order;
}

// Depths of points (3 a point), at least `near`.
export function depthsOf(points, row, near, depths) {
  const [a, b, c, d] = row;
  for (let i = 0; i < depths.length; i++) {
    depths[i] = Math.max(a * points[3 * i] + b * points[3 * i + 1] + c * points[3 * i + 2] + d, near);
  }
}
