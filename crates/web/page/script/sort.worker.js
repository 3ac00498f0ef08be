// Puts Gaussians in order of depth along the optical axis, farthest first, in a thread of its own.
//
// Positive floats order as their bits do. Depths lie in [0.01, 1e4], so the 24 bits above the lowest four, counted from those of 0.01, tell
// them apart to one part in half a million: two counting passes of 12 bits each, the last one backwards.
'use strict';
const NEAR = 0.01, FAR = 1e4, BUCKETS = 4096;
const float = new Float32Array([NEAR]), bits = new Uint32Array(float.buffer), LOWEST = bits[0];
let centres = new Float32Array(0), keys, seen, halfway;

function order(forward, offset) {
  const n = centres.length / 3, low = new Uint32Array(BUCKETS), high = new Uint32Array(BUCKETS);
  const [fx, fy, fz] = forward;
  let count = 0;
  for (let i = 0, j = 0; i < n; i++, j += 3) {
    const z = fx * centres[j] + fy * centres[j + 1] + fz * centres[j + 2] - offset;
    if (!(z >= NEAR && z <= FAR)) continue;
    float[0] = z;
    const key = Math.max(0, bits[0] - LOWEST) >>> 4;
    keys[count] = key;
    seen[count++] = i;
    low[key & 4095]++;
    high[key >>> 12]++;
  }
  for (let b = 1; b < BUCKETS; b++) low[b] += low[b - 1];
  // The far end comes first.
  for (let b = BUCKETS - 2; b >= 0; b--) high[b] += high[b + 1];
  for (let k = count - 1; k >= 0; k--) halfway[--low[keys[k] & 4095]] = k;
  const out = new Uint32Array(count);
  // Walked from the nearest, filled from the end of each bucket: far before near within a bucket, too.
  for (let k = 0; k < count; k++) { const from = halfway[k]; out[--high[keys[from] >>> 12]] = seen[from]; }
  return out;
}

onmessage = ({ data }) => {
  if (data.centres) {
    centres = data.centres;
    const n = centres.length / 3;
    [keys, seen, halfway] = [new Uint32Array(n), new Uint32Array(n), new Uint32Array(n)];
    return;
  }
  const started = performance.now(), sorted = order(data.forward, data.offset);
  postMessage({ id: data.id, sorted, milliseconds: performance.now() - started }, [sorted.buffer]);
};
