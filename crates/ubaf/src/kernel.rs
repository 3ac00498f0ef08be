//! Code and decoder over tiles of Gaussians, in sixteen lanes: `raw = W₂ silu(W₁ z + b₁) + b₂`,
//! `z = f_x ⊙ f_y ⊙ f_z ⊙ f_γ`.
//!
//! A tile is 256 Gaussians. Its codes are gathered one Gaussian at a time (the rank is the vector) and
//! transposed. In the forward pass, all hidden units run over sixteen Gaussians whose codes and outputs
//! stay in registers. In the backward pass, each hidden unit runs over the whole tile with its weight
//! gradients in registers. The backward pass computes codes and hidden units again: reading them back from
//! memory takes longer. Lane sums are f32 over a block of 2048 Gaussians, then f64.
//!
//! Ranks are padded with zero factors to 8 or 16; a zero code entry has no effect.

use fearless_simd::{Level, Simd, dispatch, f32x16, prelude::*};

use crate::OUTPUTS;
use crate::field::{Field, Shape};
use crate::guide::locate;
use crate::sites::LANES;
use use3d_numerics::functions;

/// Gaussians per tile.
pub(crate) const TILE: usize = 256;
/// Six planes of decoder outputs of a tile.
pub(crate) type TileOutputs = [[f32; TILE]; OUTPUTS];

/// A field's weights in the order in which the kernels read them.
#[derive(Clone, Debug, Default)]
pub(crate) struct PackedField {
    shape: Shape,
    rank: usize,
    /// `[4][G][padded rank]`.
    factors: Vec<f32>,
    /// For each hidden unit: `padded rank` weights, bias, six output weights.
    units: Vec<f32>,
    output_bias: [f32; OUTPUTS],
}

/// The inputs of one lookup besides the weights: the first `len` entries of each slice, padded to whole
/// lanes.
#[derive(Clone, Copy)]
pub(crate) struct Lookups<'a> {
    /// Lower nodes on x, y, z.
    pub(crate) nodes: &'a [[u8; 3]],
    /// Fractions on x, y, z.
    pub(crate) fractions: &'a [[f32; 3]],
    /// Guide coordinate.
    pub(crate) gamma: &'a [f32],
}

/// Sums of parameter derivatives over one block.
#[derive(Clone, Debug, Default)]
pub(crate) struct Accumulator {
    factors: Vec<f32>,
    /// For each hidden unit, sixteen lanes each: `padded rank` weights, bias, six output weights.
    units: Vec<f32>,
}

impl PackedField {
    /// Copies a field's weights; allocates only when the shape grows.
    pub(crate) fn pack(&mut self, field: &Field) {
        let shape = field.shape();
        let rank = if shape.rank <= 8 { 8 } else { 16 };
        (self.shape, self.rank) = (shape, rank);
        let p = &field.parameters;
        self.factors.clear();
        for row in p[shape.factors()].chunks_exact(shape.rank) {
            self.factors.extend_from_slice(row);
            self.factors.resize(self.factors.len() + rank - shape.rank, 0.0);
        }
        self.units.clear();
        let (w1, b1, w2) = (&p[shape.hidden_weight()], &p[shape.hidden_bias()], &p[shape.output_weight()]);
        for unit in 0..shape.width {
            self.units.extend_from_slice(&w1[unit * shape.rank..(unit + 1) * shape.rank]);
            self.units.resize(self.units.len() + rank - shape.rank, 0.0);
            self.units.push(b1[unit]);
            self.units.extend((0..OUTPUTS).map(|o| w2[o * shape.width + unit]));
        }
        self.output_bias.copy_from_slice(&p[shape.output_bias()]);
    }

    /// Computes the decoder's raw outputs for one tile of lookups.
    pub(crate) fn forward(&self, level: Level, lookups: Lookups<'_>, out: &mut TileOutputs) {
        match self.rank {
            8 => dispatch!(level, simd => forward_tile::<_, 8>(simd, self, lookups, out)),
            _ => dispatch!(level, simd => forward_tile::<_, 16>(simd, self, lookups, out)),
        }
    }

    /// Adds the tile's parameter gradients to `sums` and writes `∂L/∂γ`, from `∂L/∂raw` (zero in padding
    /// lanes).
    pub(crate) fn backward(
        &self,
        level: Level,
        lookups: Lookups<'_>,
        d_out: &TileOutputs,
        sums: &mut Accumulator,
        d_gamma: &mut [f32; TILE],
    ) {
        match self.rank {
            8 => dispatch!(level, simd => backward_tile::<_, 8>(simd, self, lookups, d_out, sums, d_gamma)),
            _ => dispatch!(level, simd => backward_tile::<_, 16>(simd, self, lookups, d_out, sums, d_gamma)),
        }
    }
}

impl Accumulator {
    /// Sets the sums to zero, in the size of the packed field.
    pub(crate) fn clear(&mut self, packed: &PackedField) {
        self.factors.clear();
        self.factors.resize(packed.factors.len(), 0.0);
        self.units.clear();
        self.units.resize(packed.units.len() * LANES, 0.0);
    }

    /// Adds the sums to a flat gradient. The output bias is left out, because its gradient is exactly zero
    /// (see `field`).
    pub(crate) fn add_to(&self, packed: &PackedField, gradient: &mut [f64]) {
        let (shape, rank) = (packed.shape, packed.rank);
        for (g, s) in
            gradient[shape.factors()].chunks_exact_mut(shape.rank).zip(self.factors.chunks_exact(rank))
        {
            for (g, &s) in g.iter_mut().zip(s) {
                *g += f64::from(s);
            }
        }
        let [w1, b1, w2] =
            [shape.hidden_weight(), shape.hidden_bias(), shape.output_weight()].map(|r| r.start);
        let record = rank + 1 + OUTPUTS;
        for (unit, sums) in self.units.chunks_exact(record * LANES).enumerate() {
            let total =
                |i: usize| -> f64 { sums[i * LANES..(i + 1) * LANES].iter().map(|&v| f64::from(v)).sum() };
            for r in 0..shape.rank {
                gradient[w1 + unit * shape.rank + r] += total(r);
            }
            gradient[b1 + unit] += total(rank);
            for o in 0..OUTPUTS {
                gradient[w2 + o * shape.width + unit] += total(rank + 1 + o);
            }
        }
    }
}

/// The four factor vectors of lookup `i`, linearly interpolated.
#[inline(always)]
fn factor_rows<const P: usize>(
    table: &[[f32; P]],
    resolution: usize,
    at: &[(usize, f32); 4],
) -> [[f32; P]; 4] {
    // Loops are used here and below, because `array::from_fn` is a call that is not compiled for the
    // instruction set.
    let mut rows = [[0.0; P]; 4];
    for (axis, row) in rows.iter_mut().enumerate() {
        let (node, t) = at[axis];
        let (low, high) = (&table[axis * resolution + node], &table[axis * resolution + node + 1]);
        for r in 0..P {
            row[r] = low[r] + t * (high[r] - low[r]);
        }
    }
    rows
}

#[inline(always)]
fn location(lookups: Lookups<'_>, i: usize, resolution: usize) -> [(usize, f32); 4] {
    let (n, f) = (lookups.nodes[i], lookups.fractions[i]);
    let guide = locate(lookups.gamma[i], resolution);
    [(n[0].into(), f[0]), (n[1].into(), f[1]), (n[2].into(), f[2]), guide]
}

/// Codes of a tile, one plane per rank.
#[inline(always)]
fn codes<S: Simd, const P: usize>(simd: S, packed: &PackedField, lookups: Lookups<'_>) -> [[f32; TILE]; P] {
    let table = packed.factors.as_chunks::<P>().0;
    let mut z = [[0.0; TILE]; P];
    for start in (0..lookups.gamma.len()).step_by(LANES) {
        let mut rows = [[0.0; P]; LANES];
        for (i, row) in rows.iter_mut().enumerate() {
            let at = location(lookups, start + i, packed.shape.resolution);
            let [x, y, w, g] = factor_rows(table, packed.shape.resolution, &at);
            for r in 0..P {
                row[r] = x[r] * y[r] * w[r] * g[r];
            }
        }
        // Each pass moves the lowest bit of the index (lookup, rank) to the top; `log₂ P` passes make it
        // (rank, lookup).
        let mut v = [f32x16::splat(simd, 0.0); P];
        for (r, row) in rows.as_flattened().chunks_exact(LANES).enumerate() {
            v[r] = f32x16::from_slice(simd, row);
        }
        for _ in 0..P.ilog2() {
            let old = v;
            for r in 0..P / 2 {
                v[r] = old[2 * r].unzip_low(old[2 * r + 1]);
                v[r + P / 2] = old[2 * r].unzip_high(old[2 * r + 1]);
            }
        }
        for r in 0..P {
            v[r].store_slice(&mut z[r][start..start + LANES]);
        }
    }
    z
}

/// Reads sixteen lookups of every plane.
#[inline(always)]
fn lanes_at<S: Simd, const P: usize>(simd: S, planes: &[[f32; TILE]; P], at: usize) -> [f32x16<S>; P] {
    let mut lanes = [f32x16::splat(simd, 0.0); P];
    for r in 0..P {
        lanes[r] = f32x16::from_slice(simd, &planes[r][at..at + LANES]);
    }
    lanes
}

/// The pre-activation of one hidden unit.
#[inline(always)]
fn activation<S: Simd, const P: usize>(simd: S, unit: &[f32], z: &[f32x16<S>; P]) -> f32x16<S> {
    let mut pre = f32x16::splat(simd, unit[P]);
    for r in 0..P {
        pre = z[r].mul_add(f32x16::splat(simd, unit[r]), pre);
    }
    pre
}

#[inline(always)]
fn forward_tile<S: Simd, const P: usize>(
    simd: S,
    packed: &PackedField,
    lookups: Lookups<'_>,
    out: &mut TileOutputs,
) {
    let z = codes::<_, P>(simd, packed, lookups);
    for at in (0..lookups.gamma.len()).step_by(LANES) {
        let z = lanes_at(simd, &z, at);
        let mut sums = [f32x16::splat(simd, 0.0); OUTPUTS];
        for o in 0..OUTPUTS {
            sums[o] = f32x16::splat(simd, packed.output_bias[o]);
        }
        for unit in packed.units.chunks_exact(P + 1 + OUTPUTS) {
            let pre = activation(simd, unit, &z);
            let hidden = pre * functions::logistic(simd, pre);
            for o in 0..OUTPUTS {
                sums[o] = hidden.mul_add(f32x16::splat(simd, unit[P + 1 + o]), sums[o]);
            }
        }
        for o in 0..OUTPUTS {
            sums[o].store_slice(&mut out[o][at..at + LANES]);
        }
    }
}

/// One plane of a tile.
type Plane = [f32; TILE];

#[inline(always)]
fn backward_tile<S: Simd, const P: usize>(
    simd: S,
    packed: &PackedField,
    lookups: Lookups<'_>,
    d_out: &TileOutputs,
    sums: &mut Accumulator,
    d_gamma: &mut Plane,
) {
    let z = codes::<_, P>(simd, packed, lookups);
    let count = lookups.gamma.len();
    let mut d_z = [[0.0f32; TILE]; P];
    let record = P + 1 + OUTPUTS;
    let whole = packed.shape.width / UNITS * UNITS;
    let (units, rest) = packed.units.split_at(whole * record);
    let (unit_sums, rest_sums) = sums.units.split_at_mut(whole * record * LANES);
    let pass = BackwardInputs { z: &z, d_out, count };
    let groups = units.chunks_exact(UNITS * record).zip(unit_sums.chunks_exact_mut(UNITS * record * LANES));
    for (units, sums) in groups {
        units_backward::<S, P, UNITS>(simd, &pass, units, sums, &mut d_z);
    }
    let singles = rest.chunks_exact(record).zip(rest_sums.chunks_exact_mut(record * LANES));
    for (unit, sums) in singles {
        units_backward::<S, P, 1>(simd, &pass, unit, sums, &mut d_z);
    }
    codes_backward(simd, packed, lookups, &d_z, &mut sums.factors, d_gamma);
}

/// Number of hidden units in one backward pass: their shared inputs are read once, and their sums fit the
/// registers.
const UNITS: usize = 4;

/// The inputs of the backward passes of all hidden units of a tile.
struct BackwardInputs<'a, const P: usize> {
    z: &'a [Plane; P],
    d_out: &'a TileOutputs,
    count: usize,
}

/// The backward pass of `U` hidden units over the whole tile. It consists of three products with few operands
/// each, so that sixteen registers suffice.
#[inline(always)]
fn units_backward<S: Simd, const P: usize, const U: usize>(
    simd: S,
    pass: &BackwardInputs<'_, P>,
    units: &[f32],
    sums: &mut [f32],
    d_z: &mut [Plane; P],
) {
    let record = P + 1 + OUTPUTS;
    let (one, zero) = (f32x16::splat(simd, 1.0), f32x16::splat(simd, 0.0));
    let (mut hidden, mut d_pre) = ([[0.0f32; TILE]; U], [[0.0f32; TILE]; U]);
    for at in (0..pass.count).step_by(LANES) {
        let mut pre = [zero; U];
        for u in 0..U {
            pre[u] = f32x16::splat(simd, units[u * record + P]);
        }
        for r in 0..P {
            let z = f32x16::from_slice(simd, &pass.z[r][at..at + LANES]);
            for u in 0..U {
                pre[u] = z.mul_add(f32x16::splat(simd, units[u * record + r]), pre[u]);
            }
        }
        for u in 0..U {
            let s = functions::logistic(simd, pre[u]);
            (pre[u] * s).store_slice(&mut hidden[u][at..at + LANES]);
            // silu' = s (1 + pre (1 - s)).
            pre[u] = s * pre[u].mul_add(one - s, one);
        }
        let mut d_hidden = [zero; U];
        for o in 0..OUTPUTS {
            let d = f32x16::from_slice(simd, &pass.d_out[o][at..at + LANES]);
            for u in 0..U {
                let weight = f32x16::splat(simd, units[u * record + P + 1 + o]);
                d_hidden[u] = d.mul_add(weight, d_hidden[u]);
            }
        }
        for u in 0..U {
            d_hidden[u] *= pre[u];
            d_hidden[u].store_slice(&mut d_pre[u][at..at + LANES]);
        }
        for r in 0..P {
            let mut d_code = f32x16::from_slice(simd, &d_z[r][at..at + LANES]);
            for u in 0..U {
                d_code = d_hidden[u].mul_add(f32x16::splat(simd, units[u * record + r]), d_code);
            }
            d_code.store_slice(&mut d_z[r][at..at + LANES]);
        }
    }
    // Weight gradients are products of two planes, summed lane by lane, for a pair of units and a pair of
    // planes at a time.
    for (u, sums) in sums.chunks_mut(2 * record * LANES).enumerate() {
        let (d_pre, hidden) = (&d_pre[2 * u..U.min(2 * u + 2)], &hidden[2 * u..U.min(2 * u + 2)]);
        for r in (0..P).step_by(2) {
            products(simd, d_pre, [&pass.z[r], &pass.z[r + 1]], pass.count, record, r, sums);
        }
        for o in (0..OUTPUTS).step_by(2) {
            let planes = [&pass.d_out[o], &pass.d_out[o + 1]];
            products(simd, hidden, planes, pass.count, record, P + 1 + o, sums);
        }
        for (u, d_pre) in d_pre.iter().enumerate() {
            let mut d_bias = zero;
            for at in (0..pass.count).step_by(LANES) {
                d_bias += f32x16::from_slice(simd, &d_pre[at..at + LANES]);
            }
            add(simd, d_bias, &mut sums[(u * record + P) * LANES..][..LANES]);
        }
    }
}

/// Adds `Σ_lookups row ⊙ column`, lane by lane, for one or two rows and two columns, to the record at
/// `place` and the next one.
#[inline(always)]
fn products<S: Simd>(
    simd: S,
    rows: &[Plane],
    columns: [&Plane; 2],
    count: usize,
    record: usize,
    place: usize,
    sums: &mut [f32],
) {
    let zero = f32x16::splat(simd, 0.0);
    let mut total = [[zero; 2]; 2];
    let (first, second) = (&rows[0], &rows[rows.len() - 1]);
    for at in (0..count).step_by(LANES) {
        let load = |plane: &Plane| f32x16::from_slice(simd, &plane[at..at + LANES]);
        let (a, b, c, d) = (load(first), load(second), load(columns[0]), load(columns[1]));
        total[0][0] = c.mul_add(a, total[0][0]);
        total[0][1] = d.mul_add(a, total[0][1]);
        total[1][0] = c.mul_add(b, total[1][0]);
        total[1][1] = d.mul_add(b, total[1][1]);
    }
    for (row, total) in total.iter().enumerate().take(rows.len()) {
        for (column, &total) in total.iter().enumerate() {
            add(simd, total, &mut sums[(row * record + place + column) * LANES..][..LANES]);
        }
    }
}

#[inline(always)]
fn add<S: Simd>(simd: S, d: f32x16<S>, sum: &mut [f32]) {
    (f32x16::from_slice(simd, sum) + d).store_slice(sum);
}

/// `∂L/∂factors` and `∂L/∂γ` from `∂L/∂z`.
#[inline(always)]
fn codes_backward<S: Simd, const P: usize>(
    simd: S,
    packed: &PackedField,
    lookups: Lookups<'_>,
    d_z: &[[f32; TILE]; P],
    d_factors: &mut [f32],
    d_gamma: &mut [f32; TILE],
) {
    let resolution = packed.shape.resolution;
    let table = packed.factors.as_chunks::<P>().0;
    let d_table = d_factors.as_chunks_mut::<P>().0;
    let slope = 0.5 * (resolution - 1) as f32;
    let mut rows = [[0.0; P]; LANES];
    for i in 0..lookups.gamma.len() {
        if i % LANES == 0 {
            // The passes of `codes`, backward.
            let mut v = lanes_at(simd, d_z, i);
            for _ in 0..P.ilog2() {
                let old = v;
                for r in 0..P / 2 {
                    v[2 * r] = old[r].zip_low(old[r + P / 2]);
                    v[2 * r + 1] = old[r].zip_high(old[r + P / 2]);
                }
            }
            for (row, v) in rows.as_flattened_mut().chunks_exact_mut(LANES).zip(v) {
                v.store_slice(row);
            }
        }
        let at = location(lookups, i, resolution);
        let [x, y, w, g] = factor_rows(table, resolution, &at);
        let d = rows[i % LANES];
        let (mut dx, mut dy, mut dw, mut dg) = ([0.0; P], [0.0; P], [0.0; P], [0.0; P]);
        for r in 0..P {
            let (xy, wg) = (d[r] * (x[r] * y[r]), d[r] * (w[r] * g[r]));
            (dx[r], dy[r], dw[r], dg[r]) = (y[r] * wg, x[r] * wg, xy * g[r], xy * w[r]);
        }
        let (node, _) = at[3];
        let (low, high) = (&table[3 * resolution + node], &table[3 * resolution + node + 1]);
        let mut rise = 0.0;
        for r in 0..P {
            rise += dg[r] * (high[r] - low[r]);
        }
        d_gamma[i] = slope * rise;
        for (axis, d) in [dx, dy, dw, dg].iter().enumerate() {
            let (node, t) = at[axis];
            let row = axis * resolution + node;
            for r in 0..P {
                d_table[row][r] += (1.0 - t) * d[r];
                d_table[row + 1][r] += t * d[r];
            }
        }
    }
}
