// Vectors of three numbers as arrays; rotations as three rows [right, down, forward] in world coordinates
// (COLMAP's camera axes). Quaternions [w, x, y, z] interpolate between two rotations.

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const along = (a, d, s) => [a[0] + s * d[0], a[1] + s * d[1], a[2] + s * d[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = a => Math.hypot(a[0], a[1], a[2]);
const unit = (a, otherwise = [0, 0, 1]) => { const n = norm(a); return n > 1e-12 ? scaled(a, 1 / n) : otherwise; };
const clamp = (v, low, high) => Math.min(high, Math.max(low, v));
const mix = (a, b, t) => a + t * (b - a);

// Turns `v` by `angle` about the unit vector `axis` (Rodrigues).
function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), k = dot(axis, v) * (1 - c), w = cross(axis, v);
  return [0, 1, 2].map(i => c * v[i] + s * w[i] + k * axis[i]);
}

// Makes the rows orthonormal again, forward first, because errors of small steps add up.
function orthonormal([, down, forward]) {
  const f = unit(forward), r = unit(cross(down, f), [1, 0, 0]);
  return [r, cross(f, r), f];
}

// The rotation that looks along `forward` with `up` upwards in the picture.
function looking(forward, up) {
  const f = unit(forward);
  let right = cross(f, up);
  if (norm(right) < 1e-6) right = cross(f, Math.abs(f[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0]);
  right = unit(right);
  return [right, cross(f, right), f];
}

function quaternionOf(m) {
  const [[a, b, c], [d, e, f], [g, h, i]] = m, t = a + e + i;
  let q;
  if (t > 0) q = [1 + t, h - f, c - g, d - b];
  else if (a > e && a > i) q = [h - f, 1 + a - e - i, b + d, c + g];
  else if (e > i) q = [c - g, b + d, 1 - a + e - i, f + h];
  else q = [d - b, c + g, f + h, 1 - a - e + i];
  const n = Math.hypot(...q);
  return q.map(v => v / n);
}

function rotationOf([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}

// Interpolates from rotation `a` to `b` on the shortest arc, at constant speed.
function slerp(a, b, t) {
  const p = quaternionOf(a);
  let q = quaternionOf(b), cosine = p.reduce((sum, v, i) => sum + v * q[i], 0);
  if (cosine < 0) { q = q.map(v => -v); cosine = -cosine; }
  const angle = Math.acos(Math.min(1, cosine));
  const [u, v] = angle < 1e-4 ? [1 - t, t] : [Math.sin((1 - t) * angle) / Math.sin(angle), Math.sin(t * angle) / Math.sin(angle)];
  const mixed = p.map((x, i) => u * x + v * q[i]), n = Math.hypot(...mixed);
  return rotationOf(mixed.map(x => x / n));
}
