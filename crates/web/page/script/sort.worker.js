// Sorts Gaussians by depth along the optical axis, farthest first, in a thread of its own.
//
// Positive floats have the order of their bits. Depths lie in [0.01, 1e4]. The 24 bits above the lowest four,
// counted from the bits of 0.01, separate them to one part in half a million. Two counting passes sort 12
// bits each. Both read their items in the order in memory, and write to one place per bucket, which fits the
// processor's caches.
'use strict';
const NEAR = 0.01, FAR = 1e4, BUCKETS = 4096;
const LOWEST = new Uint32Array(new Float32Array([NEAR]).buffer)[0];
const low = new Uint32Array(BUCKETS), high = new Uint32Array(BUCKETS);
let centres = new Float32Array(0), depths, bits, seen, halfKeys, halfSeen;

function reserve(n) {
  depths = new Float32Array(n);
  bits = new Uint32Array(depths.buffer);
  [seen, halfKeys, halfSeen] = [new Uint32Array(n), new Uint16Array(n), new Uint32Array(n)];
}

// The first `count` items of `seen`, by their `depths`.
function farthestFirst(count) {
  low.fill(0);
  high.fill(0);
  for (let k = 0; k < count; k++) {
    const key = Math.max(0, bits[k] - LOWEST) >>> 4;
    bits[k] = key;
    low[key & 4095]++;
    high[key >>> 12]++;
  }
  // First place of each bucket; the far end comes first.
  for (let b = BUCKETS - 1, at = 0; b >= 0; b--) { const size = low[b]; low[b] = at; at += size; }
  for (let b = BUCKETS - 1, at = 0; b >= 0; b--) { const size = high[b]; high[b] = at; at += size; }
  for (let k = 0; k < count; k++) {
    const key = bits[k], to = low[key & 4095]++;
    halfKeys[to] = key >>> 12;
    halfSeen[to] = seen[k];
  }
  const out = new Uint32Array(count);
  for (let k = 0; k < count; k++) out[high[halfKeys[k]]++] = halfSeen[k];
  return out;
}

function order(forward, offset) {
  const n = centres.length / 3, [fx, fy, fz] = forward;
  let count = 0;
  for (let i = 0, j = 0; i < n; i++, j += 3) {
    const z = fx * centres[j] + fy * centres[j + 1] + fz * centres[j + 2] - offset;
    if (!(z >= NEAR && z <= FAR)) continue;
    depths[count] = z;
    seen[count++] = i;
  }
  return farthestFirst(count);
}

onmessage = ({ data }) => {
  if (data.scene) {
    splats = decoded(data.scene);
    reserve(splats.count);
  } else if (data.halves) {
    if (!data.floats) newest = data.id;
    drawn(data);
  } else if (data.centres) {
    centres = data.centres;
    reserve(centres.length / 3);
  } else {
    const started = performance.now(), sorted = order(data.forward, data.offset);
    postMessage({ id: data.id, sorted, milliseconds: performance.now() - started }, [sorted.buffer]);
  }
};
