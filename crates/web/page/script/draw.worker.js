// Draws the scene on the processor, for browsers without a graphics card: their WebGL takes seconds a picture.
//
// It has the formulas of the shaders, and draws from front to back: a pixel that is full takes no more time.
// A picture is made of tiles of 16 x 16 pixels. In a tile the water in front of one Gaussian is that of the
// tile's middle; open water is interpolated between the tile's corners.

const SIDE = 16, FULL = 1e-3, LEAST = 1 / 255, STEPS = 2048, REACH = 2 * Math.log(255);
// exp(-q / 2) for q in [0, REACH].
const FALL = Float32Array.from({ length: STEPS + 2 }, (_, i) => Math.exp(-0.5 * i / STEPS * REACH));
let splats = null, newest = 0;

const FADES = 0.25;               // radians from the cone of the photographs until a Gaussian is gone

// Half floats as numbers: all 65,536 of them.
const HALVES = new Float32Array(65536).map((_, h) => {
  const exponent = (h >> 10) & 31, fraction = h & 1023, sign = h & 32768 ? -1 : 1;
  return sign * (exponent === 0 ? fraction * 2 ** -24 : exponent === 31 ? NaN : (1 + fraction / 1024) * 2 ** (exponent - 15));
});

// Gaussians as plain numbers; their axes are the columns of R S.
function decoded({ count, geometry, harmonics, degree, evidence }) {
  const floats = new Float32Array(geometry.buffer), words = new Uint16Array(geometry.buffer), signs = new Int16Array(geometry.buffer);
  const out = { count, degree, means: new Float32Array(3 * count), axes: new Float32Array(9 * count), opacities: new Float32Array(count), constants: new Float32Array(3 * count), grades: new Float32Array(6 * count), bytes: harmonics && new Int8Array(harmonics.buffer), scales: harmonics && new Uint16Array(harmonics.buffer), evidence: evidence && knownFrom(evidence, count) };
  for (let i = 0; i < count; i++) {
    const w = 24 * i;
    for (let a = 0; a < 3; a++) {
      out.means[3 * i + a] = floats[12 * i + a];
      out.constants[3 * i + a] = HALVES[words[w + 16 + a]];
    }
    for (let k = 0; k < 5; k++) out.grades[6 * i + k] = HALVES[words[w + 19 + k]];
    out.grades[6 * i + 5] = HALVES[words[w + 6]];
    out.opacities[i] = words[w + 15] / 65535;
    let [q, x, y, z] = [signs[w + 8], signs[w + 9], signs[w + 10], signs[w + 11]];
    const n = 1 / (Math.hypot(q, x, y, z) || 1), s = [0, 1, 2].map(k => Math.exp(words[w + 12 + k] * (24 / 65535) - 18));
    [q, x, y, z] = [q * n, x * n, y * n, z * n];
    out.axes.set([
      s[0] * (1 - 2 * (y * y + z * z)), s[0] * 2 * (x * y + q * z), s[0] * 2 * (x * z - q * y),
      s[1] * 2 * (x * y - q * z), s[1] * (1 - 2 * (x * x + z * z)), s[1] * 2 * (y * z + q * x),
      s[2] * 2 * (x * z + q * y), s[2] * 2 * (y * z - q * x), s[2] * (1 - 2 * (x * x + y * y)),
    ], 9 * i);
  }
  return out;
}

// Per Gaussian: the mean direction in which photographs saw it, the cosines at which it begins to fade and is
// gone, the greatest distance of the water in front of it, and the distance from which a loose one fades. The bytes are those of the shader.
function knownFrom(bytes, count) {
  const out = new Float32Array(7 * count);
  for (let i = 0; i < count; i++) {
    const [u, v, angle, far] = bytes.subarray(4 * i, 4 * i + 4), [x, y] = [u / 127.5 - 1, v / 127.5 - 1];
    let d = [x, y, 1 - Math.abs(x) - Math.abs(y)];
    if (d[2] < 0) d = [(1 - Math.abs(y)) * (x < 0 ? -1 : 1), (1 - Math.abs(x)) * (y < 0 ? -1 : 1), d[2]];
    const n = Math.hypot(...d), wide = (angle & 127) / 127 * Math.PI, limit = Math.exp(far / 18 - 7);
    out.set(far === 0 ? [0, 0, 0, 2, 2, 0, 0] : [d[0] / n, d[1] / n, d[2] / n, Math.cos(wide), wide + FADES > Math.PI ? -1.0001 : Math.cos(wide + FADES), limit, angle < 128 ? Infinity : 0.95 * limit], 7 * i);
  }
  return out;
}

// The harmonics of a direction, as in harmonics.glsl, into `y`.
function basis(x, v, z, y) {
  const xx = x * x, vv = v * v, zz = z * z;
  y[0] = 0.2820948;
  y[1] = -0.4886025 * v; y[2] = 0.4886025 * z; y[3] = -0.4886025 * x;
  y[4] = 1.0925484 * x * v; y[5] = -1.0925484 * v * z; y[6] = 0.31539157 * (2 * zz - xx - vv); y[7] = -1.0925484 * x * z; y[8] = 0.5462742 * (xx - vv);
  y[9] = -0.5900436 * v * (3 * xx - vv); y[10] = 2.8906114 * x * v * z; y[11] = -0.4570458 * v * (4 * zz - xx - vv); y[12] = 0.37317634 * z * (2 * zz - 3 * xx - 3 * vv);
  y[13] = -0.4570458 * x * (4 * zz - xx - vv); y[14] = 1.4453057 * z * (xx - vv); y[15] = -0.5900436 * x * (xx - 3 * vv);
}

// The Gaussians that a camera sees, near ones first: centre, inverse covariance, half width and height, colour,
// opacity, depth, and the greatest distance of the water.
const FIELDS = 14;
function projected({ camera, look }) {
  const { eye, lens: [fx, fy, cx, cy], width, height } = camera, [r, d, f] = camera.rotation, { count, means, axes, constants, grades, bytes, scales, evidence } = splats;
  const [mx, my] = [0.15 * width / fx, 0.15 * height / fy], [x0, x1, y0, y1] = [-(cx / fx + mx), (width - cx) / fx + mx, -(cy / fy + my), (height - cy) / fy + my];
  const out = new Float32Array(FIELDS * count), y = new Float64Array(16), last = (splats.degree + 1) ** 2, { strength, affine } = look, c = [0, 0, 0];
  let n = 0;
  for (let i = 0; i < count; i++) {
    const ax = means[3 * i] - eye[0], ay = means[3 * i + 1] - eye[1], az = means[3 * i + 2] - eye[2];
    const z = f[0] * ax + f[1] * ay + f[2] * az;
    let opacity = splats.opacities[i];
    if (!(z >= NEAR && z <= FAR)) continue;
    const px = (r[0] * ax + r[1] * ay + r[2] * az) / z, py = (d[0] * ax + d[1] * ay + d[2] * az) / z, away = Math.sqrt(ax * ax + ay * ay + az * az);
    let farthest = Infinity;
    if (evidence) {
      const e = 7 * i, seen = (evidence[e] * ax + evidence[e + 1] * ay + evidence[e + 2] * az) / away, t = Math.min(1, Math.max(0, (seen - evidence[e + 4]) / Math.max(evidence[e + 3] - evidence[e + 4], 1e-6)));
      opacity *= t * t * (3 - 2 * t);
      if (away > evidence[e + 6]) { const u = Math.min(1, (away - evidence[e + 6]) / (0.35 * evidence[e + 5])); opacity *= 1 - u * u * (3 - 2 * u); }
      farthest = evidence[e + 5];
    }
    if (opacity < LEAST) continue;
    const sx = Math.min(Math.max(px, x0), x1), sy = Math.min(Math.max(py, y0), y1), jx = fx / z, jy = fy / z;
    const ux = jx * (r[0] - sx * f[0]), uy = jx * (r[1] - sx * f[1]), uz = jx * (r[2] - sx * f[2]);
    const vx = jy * (d[0] - sy * f[0]), vy = jy * (d[1] - sy * f[1]), vz = jy * (d[2] - sy * f[2]);
    let aa = 0, bb = 0, ab = 0, cross = 0, a0 = 0, b0 = 0, a1 = 0, b1 = 0;
    for (let k = 0; k < 3; k++) {
      const j = 9 * i + 3 * k, a = ux * axes[j] + uy * axes[j + 1] + uz * axes[j + 2], b = vx * axes[j] + vy * axes[j + 1] + vz * axes[j + 2];
      aa += a * a; bb += b * b; ab += a * b;
      if (k > 0) cross += (a0 * b - b0 * a) ** 2;
      if (k > 1) cross += (a1 * b - b1 * a) ** 2;
      if (k === 0) { a0 = a; b0 = b; } else { a1 = a; b1 = b; }
    }
    const det = cross + 0.3 * (aa + bb) + 0.09, reach = 2 * Math.log(255 * opacity) + 1e-6, wide = Math.sqrt(reach * (aa + 0.3)), high = Math.sqrt(reach * (bb + 0.3));
    const gx = fx * px + cx, gy = fy * py + cy;
    if (gx + wide < 0 || gx - wide > width || gy + high < 0 || gy - high > height) continue;
    basis(ax / away, ay / away, az / away, y);
    c[0] = 0.5 + y[0] * constants[3 * i]; c[1] = 0.5 + y[0] * constants[3 * i + 1]; c[2] = 0.5 + y[0] * constants[3 * i + 2];
    if (last > 1) {
      const scale = HALVES[scales[24 * i + 23]] / 127;
      for (let b = 1, j = 48 * i; b < last; b++, j += 3) { const w = y[b] * scale; c[0] += w * bytes[j]; c[1] += w * bytes[j + 1]; c[2] += w * bytes[j + 2]; }
    }
    for (let k = 0; k < 3; k++) c[k] = Math.max(c[k], 0);
    if (affine) {
      const [p, q, s] = c;
      for (let k = 0; k < 3; k++) c[k] = Math.exp(strength * grades[6 * i + k]) * (c[k] + affine[4 * k] * p + affine[4 * k + 1] * q + affine[4 * k + 2] * s + affine[4 * k + 3]) + strength * grades[6 * i + 3 + k];
    }
    out.set([gx, gy, (bb + 0.3) / det, -ab / det, (aa + 0.3) / det, wide, high, c[0], c[1], c[2], opacity, z, farthest, reach], FIELDS * n);
    depths[n] = z;
    seen[n] = n++;
  }
  return { out, order: farthestFirst(n).reverse() };
}

// The water at the corners of the tiles: nine numbers each, and the length of the ray at depth 1.
function cornersOf({ camera, water }, columns, rows) {
  const out = new Float32Array(10 * (columns + 1) * (rows + 1)), { lens: [fx, fy, cx, cy] } = camera, [r, d, f] = camera.rotation, y = new Float64Array(16), q = new Float64Array(9);
  for (let j = 0, o = 0; j <= rows; j++) for (let i = 0; i <= columns; i++, o += 10) {
    const sx = (SIDE * i - cx) / fx, sy = (SIDE * j - cy) / fy, length = Math.sqrt(1 + sx * sx + sy * sy);
    out[o + 9] = length;
    if (!water) continue;
    const ray = [0, 1, 2].map(k => (sx * r[k] + sy * d[k] + f[k]) / length);
    if (water.cube) { for (let k = 0; k < 9; k++) q[k] = ofCube(water, ray, k); } else {
      basis(...ray, y);
      for (let k = 0; k < 9; k++) {
        let raw = 0;
        for (let b = 0; b < water.bands; b++) raw += y[b] * water.harmonic[48 * Math.floor(k / 3) + 3 * b + k % 3];
        q[k] = k < 3 ? Math.max(raw + 0.5, 0) : Math.max(raw, 0) + Math.log(1 + Math.exp(-Math.abs(raw)));
      }
    }
    if (water.grade) graded(q, water.grade);
    for (let k = 0; k < 9; k++) out[o + k] = k < 3 ? q[k] : water.amount * q[k];
  }
  return out;
}
function graded(q, { guide, affine, gains, biases, ratios, kept }) {
  const c = [q[0], q[1], q[2]], gamma = Math.tanh(c.reduce((sum, v, k) => sum + guide[k] * Math.sign(v) * Math.log(1 + Math.abs(v)), guide[3]));
  const at = (gamma + 1) * 7.5, row = Math.floor(Math.min(at, 14)), t = at - row, between = (table, k) => table[3 * row + k] * (1 - t) + table[3 * row + 3 + k] * t;
  for (let k = 0; k < 3; k++) {
    q[k] = between(gains, k) * (c[k] + affine[4 * k] * c[0] + affine[4 * k + 1] * c[1] + affine[4 * k + 2] * c[2] + affine[4 * k + 3]) + between(biases, k);
    q[3 + k] *= kept[k] * ratios[0];
    q[6 + k] *= kept[k] * ratios[1];
  }
}
// One of the nine numbers of a baked water in a direction: the nearest pixel of its cube.
function ofCube({ cube, side }, [x, y, z], k) {
  const [a, b, c] = [Math.abs(x), Math.abs(y), Math.abs(z)];
  const [face, s, t, m] = a >= b && a >= c ? (x > 0 ? [0, -z, -y, a] : [1, z, -y, a]) : b >= c ? (y > 0 ? [2, x, z, b] : [3, x, -z, b]) : z > 0 ? [4, x, -y, c] : [5, -x, -y, c];
  const pixel = v => Math.min(side - 1, Math.floor((v / m + 1) / 2 * side));
  return HALVES[cube[4 * (((6 * Math.floor(k / 3) + face) * side + pixel(t)) * side + pixel(s)) + k % 3]];
}

// The picture as floats, RGBA per pixel; alpha is the sum of the weights. `from` and `to` limit its columns.
// `pause` is awaited now and then; if it returns false, the picture is no longer wanted.
async function painted(request, pause) {
  const { camera: { width, height }, look, water, from, to } = request, columns = Math.ceil(width / SIDE), rows = Math.ceil(height / SIDE);
  const { out: g, order } = projected(request), corners = cornersOf(request, columns, rows), first = Math.floor(from / SIDE), end = Math.ceil(to / SIDE);
  // Lists of the Gaussians of each tile, near ones first.
  const boxes = new Int16Array(4 * order.length), starts = new Int32Array(columns * rows + 1);
  for (let k = 0; k < order.length; k++) {
    const o = FIELDS * order[k], box = [Math.max(first, Math.floor((g[o] - g[o + 5]) / SIDE)), Math.min(end - 1, Math.floor((g[o] + g[o + 5]) / SIDE)), Math.max(0, Math.floor((g[o + 1] - g[o + 6]) / SIDE)), Math.min(rows - 1, Math.floor((g[o + 1] + g[o + 6]) / SIDE))];
    boxes.set(box, 4 * k);
    for (let j = box[2]; j <= box[3]; j++) for (let i = box[0]; i <= box[1]; i++) starts[j * columns + i + 1]++;
  }
  for (let t = 0; t < columns * rows; t++) starts[t + 1] += starts[t];
  const entries = new Int32Array(starts[columns * rows]), next = starts.slice();
  for (let k = 0; k < order.length; k++)
    for (let j = boxes[4 * k + 2]; j <= boxes[4 * k + 3]; j++) for (let i = boxes[4 * k]; i <= boxes[4 * k + 1]; i++) entries[next[j * columns + i]++] = order[k];

  const out = new Float32Array(4 * width * height), rest = new Float32Array(SIDE * SIDE), sum = new Float32Array(3 * SIDE * SIDE), w = new Float64Array(10);
  for (let j = 0; j < rows; j++) {
    if (pause && !(await pause())) return null;
    for (let i = first; i < end; i++) paint(i, j);
  }
  return out;

  function paint(i, j) {
    const left = SIDE * i, top = SIDE * j, wide = Math.min(SIDE, width - left), high = Math.min(SIDE, height - top), c = 10 * (j * (columns + 1) + i), below = 10 * (columns + 1), t = j * columns + i;
    for (let k = 0; k < 10; k++) w[k] = (corners[c + k] + corners[c + 10 + k] + corners[c + below + k] + corners[c + below + 10 + k]) / 4;
    rest.fill(1);
    sum.fill(0);
    let open = wide * high;
    for (let e = starts[t]; e < starts[t + 1] && open > 0; e++) {
      const o = FIELDS * entries[e], gx = g[o] - left - 0.5, gy = g[o + 1] - top - 0.5, A = g[o + 2], B = g[o + 3], C = g[o + 4], opacity = g[o + 10], depth = g[o + 11], reach = g[o + 13];
      let red = look.objects * g[o + 7], green = look.objects * g[o + 8], blue = look.objects * g[o + 9];
      if (look.depth) { red = green = blue = depth; } else if (water) {
        const s = Math.min(depth * w[9], g[o + 12]);
        red = red * Math.exp(-s * w[6]) + look.veil * w[0] * (1 - Math.exp(-s * w[3]));
        green = green * Math.exp(-s * w[7]) + look.veil * w[1] * (1 - Math.exp(-s * w[4]));
        blue = blue * Math.exp(-s * w[8]) + look.veil * w[2] * (1 - Math.exp(-s * w[5]));
      }
      const y0 = Math.max(0, Math.ceil(gy - g[o + 6])), y1 = Math.min(high - 1, Math.floor(gy + g[o + 6]));
      for (let y = y0; y <= y1; y++) {
        const dy = y - gy, middle = gx - B * dy / A, within = (B * B - A * C) * dy * dy + A * reach;
        if (within <= 0) continue;
        const half = Math.sqrt(within) / A, x1 = Math.min(wide - 1, Math.floor(middle + half));
        for (let x = Math.max(0, Math.ceil(middle - half)), p = SIDE * y + x; x <= x1; x++, p++) {
          const clear = rest[p];
          if (clear < FULL) continue;
          const dx = x - gx, q = A * dx * dx + (2 * B * dx + C * dy) * dy, alpha = Math.min(0.999, opacity * FALL[q * (STEPS / REACH) + 0.5 | 0]), weight = alpha * clear;
          sum[3 * p] += weight * red; sum[3 * p + 1] += weight * green; sum[3 * p + 2] += weight * blue;
          rest[p] = clear - weight;
          if (rest[p] < FULL) open--;
        }
      }
    }
    const veil = water ? look.veil * water.amount : 0;
    for (let y = 0; y < high; y++) for (let x = 0; x < wide; x++) {
      const p = SIDE * y + x, to = 4 * ((top + y) * width + left + x), u = (x + 0.5) / SIDE, v = (y + 0.5) / SIDE, share = veil * rest[p];
      for (let k = 0; k < 3; k++) {
        const behind = share > 0 ? (corners[c + k] * (1 - u) + corners[c + 10 + k] * u) * (1 - v) + (corners[c + below + k] * (1 - u) + corners[c + below + 10 + k] * u) * v : 0;
        out[to + k] = sum[3 * p + k] + share * behind;
      }
      out[to + 3] = 1 - rest[p];
      if (look.depth) for (let k = 0; k < 3; k++) out[to + k] /= Math.max(out[to + 3], 1e-6);
    }
  }
}

// Nearest and farthest depth that a picture of depths shows: its 2 % and 98 % quantiles.
function rangeOf(picture) {
  const known = [];
  for (let p = 0; p < picture.length; p += 4 * 37) if (picture[p + 3] > 0.02) known.push(picture[p]);
  known.sort((a, b) => a - b);
  const at = share => known[Math.floor(share * (known.length - 1))] ?? 1;
  return [at(0.02), Math.max(at(0.98), 1.0001 * at(0.02))];
}

// The floats of the columns of a half, as bytes for the screen.
function shown(picture, { look, from, to, camera: { width, height } }, bytes) {
  const [near, far] = look.depth ? rangeOf(picture) : [];
  for (let y = 0; y < height; y++) for (let x = from, p = 4 * (y * width + from); x < to; x++, p += 4) {
    if (look.depth) {
      const z = picture[p], at = 4 * Math.min(1, Math.max(0, (1 / z - 1 / far) / Math.max(1 / near - 1 / far, 1e-9))), k = Math.floor(Math.min(at, 3));
      for (let c = 0; c < 3; c++) bytes[p + c] = picture[p + 3] > 0 ? 255 * (RAMP[k][c] + (at - k) * (RAMP[k + 1][c] - RAMP[k][c])) : 0;
    } else for (let c = 0; c < 3; c++) bytes[p + c] = 255 * look.gains[c] * picture[p + c];
    bytes[p + 3] = 255;
  }
}
const RAMP = [[0.03, 0.05, 0.22], [0.06, 0.28, 0.47], [0.13, 0.55, 0.55], [0.62, 0.76, 0.45], [0.99, 0.95, 0.70]];

// Lets newer requests arrive while a picture is drawn.
const pauses = new MessageChannel();
const breath = () => new Promise(done => { pauses.port1.onmessage = done; pauses.port2.postMessage(0); });

async function drawn({ id, halves, floats }) {
  const started = performance.now(), { camera: { width, height } } = halves[0], bytes = floats ? null : new Uint8ClampedArray(4 * width * height);
  let last = started;
  const pause = async () => {
    if (floats || performance.now() - last < 30) return true;
    await breath();
    last = performance.now();
    return newest === id;
  };
  for (const half of halves) {
    const picture = await painted(half, pause);
    if (!picture) { postMessage({ id, dropped: true }); return; }
    if (floats) { postMessage({ id, picture }, [picture.buffer]); return; }
    shown(picture, half, bytes);
  }
  postMessage({ id, bytes, width, height, milliseconds: performance.now() - started }, [bytes.buffer]);
}
