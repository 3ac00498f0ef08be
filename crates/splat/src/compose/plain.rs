//! The compositor as plain scalar code: the reference for correct results, also used on machines without
//! vectors.
//!
//! For each pixel, over Gaussians by ascending depth, with `log₂ α` from [`Splat`](crate::project::Splat):
//!
//! ```text
//! α = min(0.999, opacity e^{-σ}),  skipped if α < 1/255;   T' = T (1 − α);  if T' ≤ 1e-4: stop, not added
//! w = T α;  T = T'
//! rgb = c_m + Σ w (c e^{-β_a s} − c_m e^{-β_b s}),   s = z |d(p)|
//! ```
//!
//! This is the sum of the paper's object, interval-medium and far-end terms, because the interval terms
//! telescope,
//! `Σ_i T_i (E_{i-1} − E_i) + T_{N+1} E_N = 1 − Σ w_i E_i`.
//!
//! The backward pass uses the loss per unit of weight
//! `v_i = Σ_c g_c (c_i E_a − c_m E_b)_c + g_clear·c_i + h_z z_i + h_w`:
//!
//! ```text
//! G_i = α ∂L/∂α = w_i v_i − α_i/(1 − α_i) Σ_{j>i} w_j v_j          (0 where α is clamped)
//! ```
//!
//! It runs from the farthest Gaussian to the nearest, so that `Σ_{j>i}` grows from zero (no cancellation)
//! and the transmittance is recovered by division (its reciprocal by three Newton steps). Each pixel needs
//! one running number and no list.
//!
//! The lane code performs the same operations in the same order, so both compute the same bits where
//! multiply-add is fused. Sums per Gaussian run over the cells of a tile, lane by lane, then over the lanes
//! by [`sum`], then over tiles.

use use3d_numerics::lanes::{SMALL_COEFFICIENTS, exp2, exp2_unclamped, sum};

use super::tile::{
    ALPHA_MAX, BackwardTile, CELLS, CHANNELS, EntrySink, ForwardCell, ForwardTile, LaneSums, Lanes,
    RATIO_MAX, RowTerms, STOP, TileInput, TileWater, place,
};
use crate::lists::TILE;
use crate::project::{EntryGradient, LOG2_255, Splat, SplatGradient};

/// The six exponentials of one Gaussian in one tile, as `factor · at`.
struct Decay {
    z: f32,
    /// The coefficients of the cubic in the deviation; `None` where deviations are not small.
    coefficients: Option<[f32; 4]>,
    /// The tile's factors, attenuation then backscatter; 1 where deviations are not small.
    factor: [f32; 6],
    /// `centre · z`.
    exponent: [f32; 6],
}

impl Decay {
    fn new(water: &TileWater, z: f32) -> Self {
        let exponent: [f32; 6] = std::array::from_fn(|q| water.centre[q] * z);
        let [k0, k1, k2, k3] = SMALL_COEFFICIENTS;
        let coefficients = (z <= water.near).then_some([k0, k1 * z, k2 * (z * z), k3 * (z * z * z)]);
        let factor = if coefficients.is_some() { exponent.map(exp2) } else { [1.0; 6] };
        Self { z, coefficients, factor, exponent }
    }

    /// `e^{-β s}` of quantity `q` at a pixel with this deviation, divided by the factor.
    #[inline(always)]
    fn at(&self, q: usize, deviation: f32) -> f32 {
        match self.coefficients {
            Some([k0, k1, k2, k3]) => k3.mul_add(deviation, k2).mul_add(deviation, k1).mul_add(deviation, k0),
            None => exp2(deviation.mul_add(self.z, self.exponent[q])),
        }
    }
}

/// Returns `log₂ α` before the clamp at a pixel column, and `t`.
#[inline(always)]
fn log2_alpha(splat: &Splat, row: RowTerms, x: f32) -> (f32, f32) {
    let t = x - row.peak;
    ((t * splat.steepness).mul_add(-t, row.power), t)
}

/// Composes a tile. `water` is read only if `WATER`.
pub(crate) fn forward<const WATER: bool, const LAYERS: bool>(
    input: &TileInput<'_>,
    water: &TileWater,
    tile: &mut ForwardTile,
) {
    for k in 0..input.list.len() {
        let splat = input.entry(k).1;
        let decay = WATER.then(|| Decay::new(water, splat.z));
        for r in 0..input.filled_rows {
            let terms = splat.row(input.rows[r]);
            for (column, &x) in input.columns.iter().enumerate() {
                let (cell, l) = place(r, column);
                let (row, water) = (&mut tile.cells[cell], &water.cells[cell]);
                let Some(w) = weight(splat, terms, x, row, l, k) else { continue };
                row.depth[l] = w.mul_add(splat.z, row.depth[l]);
                row.accumulation[l] += w;
                for c in 0..3 {
                    if let Some(decay) = &decay {
                        let object = decay.at(c, water.attenuation[c][l]);
                        let veil = decay.at(c + 3, water.backscatter[c][l]);
                        let colored = w * (decay.factor[c] * splat.color[c]);
                        row.object[c][l] = colored.mul_add(object, row.object[c][l]);
                        row.veil[c][l] = (w * decay.factor[c + 3]).mul_add(veil, row.veil[c][l]);
                    } else {
                        row.object[c][l] = w.mul_add(splat.color[c], row.object[c][l]);
                    }
                    if LAYERS {
                        row.clear[c][l] = w.mul_add(splat.color[c], row.clear[c][l]);
                    }
                }
                if LAYERS {
                    row.last[l] = splat.z;
                }
            }
        }
    }
}

/// Computes the gradient of a tile: writes one record per entry to `sink`, and the medium's sums to `tile`.
/// `s_gradient` is 1, or 0 if distances are constants in the medium's terms (R2).
pub(crate) fn backward<const WATER: bool, const EXTRAS: bool>(
    input: &TileInput<'_>,
    water: &TileWater,
    tile: &mut BackwardTile,
    s_gradient: f32,
    sink: &mut EntrySink<'_>,
) {
    let centre = &water.centre;
    for k in (0..input.list.len()).rev() {
        let (at, splat) = input.entry(k);
        let decay = WATER.then(|| Decay::new(water, splat.z));
        let (kappa, inverse) = splat.conic_terms();
        let mut sums = LaneSums::zeros([0.0f32; TILE]);
        for r in 0..input.filled_rows {
            let terms = splat.row(input.rows[r]);
            let dy = terms.dy;
            for (column, &x) in input.columns.iter().enumerate() {
                let (cell, l) = place(r, column);
                let (row, water) = (&mut tile.cells[cell], &water.cells[cell]);
                let (power, t) = log2_alpha(splat, terms, x);
                let live = power >= -LOG2_255 && row.stop[l] > k as i32;
                if !live {
                    continue;
                }
                let alpha = exp2_unclamped(power).min(ALPHA_MAX);
                let over = 1.0 / (1.0 - alpha);
                let transmittance = row.transmittance[l] * over;
                let w = transmittance * alpha;
                row.transmittance[l] = transmittance;
                let mut v = if EXTRAS { row.depth[l].mul_add(splat.z, row.weight[l]) } else { 0.0 };
                let mut slope = 0.0f32;
                let wz = w * splat.z;
                for c in 0..3 {
                    let g = row.image[c][l];
                    if let Some(decay) = &decay {
                        let object = g * decay.at(c, water.attenuation[c][l]);
                        let veil = decay.at(c + 3, water.backscatter[c][l]) * decay.factor[c + 3];
                        let colored = object * (decay.factor[c] * splat.color[c]);
                        let veiled = row.veiled[c][l] * veil;
                        v = (v + colored) + veiled;
                        let a = water.attenuation[c][l] + centre[c];
                        let b = water.backscatter[c][l] + centre[c + 3];
                        slope = a.mul_add(colored, slope);
                        slope = b.mul_add(veiled, slope);
                        let mut color = object;
                        if EXTRAS {
                            color = object.mul_add(decay.factor[c], row.clear[c][l]);
                            v = row.clear[c][l].mul_add(splat.color[c], v);
                        }
                        sums.color[c][l] = w.mul_add(color, sums.color[c][l]);
                        row.object_moment[c][l] = wz.mul_add(colored, row.object_moment[c][l]);
                        row.veil_moment[c][l] = wz.mul_add(veiled, row.veil_moment[c][l]);
                        row.veil[c][l] = w.mul_add(veil, row.veil[c][l]);
                    } else {
                        let color = if EXTRAS { g + row.clear[c][l] } else { g };
                        v = color.mul_add(splat.color[c], v);
                        sums.color[c][l] = w.mul_add(color, sums.color[c][l]);
                    }
                }
                slope *= s_gradient;
                if EXTRAS {
                    slope = row.depth[l].mul_add(std::f32::consts::LOG2_E, slope);
                }
                sums.z[l] = w.mul_add(slope, sums.z[l]);
                let wv = w * v;
                let ratio = alpha * over;
                let g = ratio.mul_add(row.behind[l], wv);
                row.behind[l] -= wv;
                let g = if ratio < RATIO_MAX { g } else { 0.0 };
                let (g_t, g_dy) = (g * t, g * dy);
                sums.weight[l] += g;
                sums.t[l] += g_t;
                sums.dy[l] += g_dy;
                sums.t_t[l] = g_t.mul_add(t, sums.t_t[l]);
                sums.t_dy[l] = g_t.mul_add(dy, sums.t_dy[l]);
                sums.dy_dy[l] = g_dy.mul_add(dy, sums.dy_dy[l]);
                sums.screen[0][l] += g_t.abs();
                let slope = t.mul_add(kappa, dy * inverse).abs();
                sums.screen[1][l] = g.abs().mul_add(slope, sums.screen[1][l]);
            }
        }
        if let Some(decay) = &decay
            && !EXTRAS
        {
            for (lanes, factor) in sums.color.iter_mut().zip(decay.factor) {
                lanes.iter_mut().for_each(|v| *v *= factor);
            }
        }
        sink.put(at, finish(&sums));
    }
}

/// Adds the lanes and returns the sums as a record.
fn finish(sums: &LaneSums<Lanes>) -> EntryGradient {
    let LaneSums { weight, t, dy, t_t, t_dy, dy_dy, z, color, screen } = sums;
    let (color, screen) = (color.map(|c| sum(&c)), screen.map(|v| sum(&v)));
    let [weight, t, dy, t_t, t_dy, dy_dy, z] = [weight, t, dy, t_t, t_dy, dy_dy, z].map(sum);
    SplatGradient { weight, t, dy, t_t, t_dy, dy_dy, z, color, screen }.record()
}

/// Stage 2: computes the gradient with respect to colours and the medium, front to back, without geometry.
pub(crate) fn backward_colors<const WATER: bool>(
    input: &TileInput<'_>,
    water: &TileWater,
    tile: &mut BackwardTile,
    sink: &mut EntrySink<'_>,
) {
    let mut forward = ForwardTile::new(input.filled_rows, input.filled_columns);
    for k in 0..input.list.len() {
        let (at, splat) = input.entry(k);
        let decay = WATER.then(|| Decay::new(water, splat.z));
        let mut lanes = [[0.0f32; TILE]; 3];
        for r in 0..input.filled_rows {
            let terms = splat.row(input.rows[r]);
            for (column, &x) in input.columns.iter().enumerate() {
                let (cell, l) = place(r, column);
                let (row, water) = (&mut tile.cells[cell], &water.cells[cell]);
                let Some(w) = weight(splat, terms, x, &mut forward.cells[cell], l, k) else { continue };
                let wz = w * splat.z;
                for c in 0..3 {
                    let g = row.image[c][l];
                    if let Some(decay) = &decay {
                        let object = g * decay.at(c, water.attenuation[c][l]);
                        let veil = decay.at(c + 3, water.backscatter[c][l]) * decay.factor[c + 3];
                        let colored = object * (decay.factor[c] * splat.color[c]);
                        lanes[c][l] = w.mul_add(object, lanes[c][l]);
                        row.object_moment[c][l] = wz.mul_add(colored, row.object_moment[c][l]);
                        row.veil_moment[c][l] = wz.mul_add(row.veiled[c][l] * veil, row.veil_moment[c][l]);
                        row.veil[c][l] = w.mul_add(veil, row.veil[c][l]);
                    } else {
                        lanes[c][l] = w.mul_add(g, lanes[c][l]);
                    }
                }
            }
        }
        let factor = decay.map_or([1.0; 6], |decay| decay.factor);
        for (lanes, factor) in lanes.iter_mut().zip(factor) {
            lanes.iter_mut().for_each(|v| *v *= factor);
        }
        sink.put(at, SplatGradient::of_color(std::array::from_fn(|c| sum(&lanes[c]))));
    }
}

/// One step of the transmittance: returns the weight of this Gaussian at lane `l`, or `None` if it does not
/// contribute.
#[inline(always)]
pub(super) fn weight(
    splat: &Splat,
    terms: RowTerms,
    x: f32,
    row: &mut ForwardCell,
    l: usize,
    k: usize,
) -> Option<f32> {
    let (power, _) = log2_alpha(splat, terms, x);
    let live = power >= -LOG2_255 && row.transmittance[l] > 0.0;
    if !live {
        return None;
    }
    let alpha = exp2_unclamped(power).min(ALPHA_MAX);
    let w = row.transmittance[l] * alpha;
    let rest = row.transmittance[l] * (1.0 - alpha);
    if rest <= STOP {
        row.transmittance[l] = -row.transmittance[l];
        row.stop[l] = k as i32;
        return None;
    }
    row.transmittance[l] = rest;
    Some(w)
}

/// The linear splat of up to [`CHANNELS`] channels: `out[cell][channel] += Σ w values`.
pub(crate) fn splat(
    input: &TileInput<'_>,
    values: impl Fn(u32) -> [f32; CHANNELS],
    forward: &mut ForwardTile,
    out: &mut [[Lanes; CHANNELS]; CELLS],
) {
    for k in 0..input.list.len() {
        let splat = input.entry(k).1;
        let values = values(splat.index);
        for r in 0..input.filled_rows {
            let terms = splat.row(input.rows[r]);
            for (column, &x) in input.columns.iter().enumerate() {
                let (cell, l) = place(r, column);
                if let Some(w) = weight(splat, terms, x, &mut forward.cells[cell], l, k) {
                    for c in 0..CHANNELS {
                        out[cell][c][l] = w.mul_add(values[c], out[cell][c][l]);
                    }
                }
            }
        }
    }
}

/// The adjoint of [`splat`]: the first [`CHANNELS`] entries of each record are `Σ_p w maps`.
pub(crate) fn splat_adjoint(
    input: &TileInput<'_>,
    maps: &[[Lanes; CHANNELS]; CELLS],
    forward: &mut ForwardTile,
    sink: &mut EntrySink<'_>,
) {
    for k in 0..input.list.len() {
        let (at, splat) = input.entry(k);
        let mut lanes = [[0.0f32; TILE]; CHANNELS];
        for r in 0..input.filled_rows {
            let terms = splat.row(input.rows[r]);
            for (column, &x) in input.columns.iter().enumerate() {
                let (cell, l) = place(r, column);
                if let Some(w) = weight(splat, terms, x, &mut forward.cells[cell], l, k) {
                    for c in 0..CHANNELS {
                        lanes[c][l] = w.mul_add(maps[cell][c][l], lanes[c][l]);
                    }
                }
            }
        }
        let mut sums = EntryGradient::default();
        for c in 0..CHANNELS {
            sums[c] = sum(&lanes[c]);
        }
        sink.put(at, sums);
    }
}
