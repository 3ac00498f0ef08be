// The part of the water that depends on the camera's position: the shares of the anchors, and the table that
// grades an enhanced water. The part that depends on the pixel is in water.frag.glsl.

const QUERY_LIMIT = 1.5, WIDTH_FLOOR = 1e-4, TABLE_ROWS = 16, LOG_RATIO_BOUND = Math.log(4);

// 144 coefficients [c_m, backscatter, attenuation][band][RGB]: the coefficients of the K anchors with the
// highest affinity -|o - p|^2 / (2 sigma^2), mixed with their softmax. Camera positions are clamped to the
// cube that contains the anchors.
function aggregated(medium, eye) {
  if (!medium.centers) return medium.coefficients;
  const o = eye.map(v => clamp(v, -QUERY_LIMIT, QUERY_LIMIT));
  const scored = medium.centers.map((centre, k) => {
    const sigma = Math.max(Math.exp(medium.logWidths[k]), WIDTH_FLOOR), d = subtract(o, centre);
    return [k, -dot(d, d) / (2 * sigma * sigma)];
  });
  scored.sort((a, b) => b[1] - a[1] || a[0] - b[0]);
  const best = scored.slice(0, Math.max(1, medium.topK));
  const weights = best.map(([, affinity]) => Math.exp(affinity - best[0][1])), total = weights.reduce((a, b) => a + b, 0);
  const sum = new Float64Array(144);
  best.forEach(([k], i) => medium.coefficients[k].forEach((v, j) => { sum[j] += weights[i] / total * v; }));
  return sum;
}

// The decoder's six outputs at field coordinates u (x, y, z, guide), each in [-1, 1]. The decoder is a
// product of four linearly interpolated factors per rank, one hidden layer of SiLU units, and one linear
// layer.
function fieldOutputs(field, u) {
  const { resolution, rank, width } = field, z = new Float64Array(rank).fill(1);
  u.forEach((value, axis) => {
    const at = (value + 1) * 0.5 * (resolution - 1), node = Math.min(Math.floor(at), resolution - 2), t = at - node;
    for (let r = 0; r < rank; r++) {
      const low = field.factors[(axis * resolution + node) * rank + r], high = field.factors[(axis * resolution + node + 1) * rank + r];
      z[r] *= low + t * (high - low);
    }
  });
  const out = field.outputBias.slice();
  for (let unitIndex = 0; unitIndex < width; unitIndex++) {
    let pre = field.hiddenBias[unitIndex];
    for (let r = 0; r < rank; r++) pre += z[r] * field.hiddenWeight[unitIndex * rank + r];
    const hidden = pre / (1 + Math.exp(-pre));
    for (let o = 0; o < 6; o++) out[o] += hidden * field.outputWeight[o * width + unitIndex];
  }
  return out;
}

// The table of a camera position: gains and biases at sixteen guide values in [-1, 1], less their mean, times
// the strength.
function guideTable(field, eye, strength) {
  const place = eye.map((v, a) => clamp(2 * (v - field.low[a]) / (field.high[a] - field.low[a]) - 1, -1, 1));
  const rows = Array.from({ length: TABLE_ROWS }, (_, k) => fieldOutputs(field, [...place, 2 * k / (TABLE_ROWS - 1) - 1]));
  const mean = [0, 1, 2, 3, 4, 5].map(o => rows.reduce((sum, row) => sum + row[o], 0) / TABLE_ROWS);
  const centred = rows.map(row => row.map((v, o) => strength * (v - mean[o])));
  return {
    gains: new Float32Array(centred.flatMap(row => row.slice(0, 3).map(Math.exp))),
    biases: new Float32Array(centred.flatMap(row => row.slice(3, 6))),
    ratios: field.transport.map(t => Math.exp(strength * LOG_RATIO_BOUND * Math.tanh(t))),
  };
}
