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
//! multiply-add is fused. Sums per Gaussian run over the rows of a pixel column, then over columns by
//! [`sum`], then over tiles.

use use3d_numerics::lanes::{SMALL_COEFFICIENTS, exp2, exp2_unclamped, sum};

use super::tile::{
    ALPHA_MAX, BackwardTile, CHANNELS, ColumnSums, ForwardRow, ForwardTile, Lanes, RowTerms, STOP, Sink,
    TileInput, TileWater, moments,
};
use crate::lists::TILE;
use crate::project::{EntryGradient, LOG2_255, Splat, SplatGradient};

/// The six exponentials of one Gaussian in one tile.
struct Decay {
    z: f32,
    /// The tile's factors, attenuation then backscatter; `None` where deviations are not small.
    factor: Option<[f32; 6]>,
    /// `centre · z`.
    exponent: [f32; 6],
}

impl Decay {
    fn new(water: &TileWater, z: f32) -> Self {
        let exponent = std::array::from_fn(|q| water.centre[q] * z);
        let factor = (z <= water.near).then(|| exponent.map(exp2));
        Self { z, factor, exponent }
    }

    /// `scale · e^{-β s}` of quantity `q` at a pixel with this deviation.
    #[inline(always)]
    fn at(&self, q: usize, deviation: f32, scale: f32) -> f32 {
        match self.factor {
            Some(factor) => {
                let x = deviation * self.z;
                let k = SMALL_COEFFICIENTS.map(|v| (factor[q] * scale) * v);
                k[3].mul_add(x, k[2]).mul_add(x, k[1]).mul_add(x, k[0])
            }
            None => exp2(deviation.mul_add(self.z, self.exponent[q])) * scale,
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
            let (terms, row, water) = (splat.row(input.rows[r]), &mut tile.rows[r], &water.rows[r]);
            for l in 0..TILE {
                let Some(w) = weight(splat, terms, input.columns[l], row, l, k) else { continue };
                row.depth[l] = w.mul_add(splat.z, row.depth[l]);
                row.accumulation[l] += w;
                for c in 0..3 {
                    if let Some(decay) = &decay {
                        let object = decay.at(c, water.attenuation[c][l], splat.color[c]);
                        let veil = decay.at(c + 3, water.backscatter[c][l], 1.0);
                        row.object[c][l] = w.mul_add(object, row.object[c][l]);
                        row.veil[c][l] = w.mul_add(veil, row.veil[c][l]);
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
    sink: &mut Sink<'_>,
) {
    let origin = [input.columns[TILE / 2], input.rows[TILE / 2]];
    let offset: Lanes = input.columns.map(|x| x - origin[0]);
    let centre = &water.centre;
    for k in (0..input.list.len()).rev() {
        let (span, splat) = input.entry(k);
        let decay = WATER.then(|| Decay::new(water, splat.z));
        let (kappa, inverse) = splat.conic_terms();
        let mut sums = ColumnSums::zeros([0.0f32; TILE]);
        for r in 0..input.filled_rows {
            let (terms, row, water) = (splat.row(input.rows[r]), &mut tile.rows[r], &water.rows[r]);
            let eta = input.rows[r] - origin[1];
            let dy_term = terms.dy * inverse;
            for l in 0..TILE {
                let (power, t) = log2_alpha(splat, terms, input.columns[l]);
                let live = power >= -LOG2_255 && row.stop[l] > k as i32;
                if !live {
                    continue;
                }
                let raw = exp2_unclamped(power);
                let alpha = raw.min(ALPHA_MAX);
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
                        let object = g * decay.at(c, water.attenuation[c][l], 1.0);
                        let veil = decay.at(c + 3, water.backscatter[c][l], 1.0);
                        let colored = object * splat.color[c];
                        let veiled = row.veiled[c][l] * veil;
                        v = (v + colored) + veiled;
                        let a = water.attenuation[c][l] + centre[c];
                        let b = water.backscatter[c][l] + centre[c + 3];
                        slope = a.mul_add(colored, slope);
                        slope = b.mul_add(veiled, slope);
                        let mut color = object;
                        if EXTRAS {
                            color += row.clear[c][l];
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
                let g = if raw <= ALPHA_MAX { g } else { 0.0 };
                sums.weight[l] += g;
                sums.eta[l] = g.mul_add(eta, sums.eta[l]);
                sums.eta_eta[l] = g.mul_add(eta * eta, sums.eta_eta[l]);
                sums.screen[0][l] = g.abs().mul_add(t.abs(), sums.screen[0][l]);
                sums.screen[1][l] = g.abs().mul_add(t.mul_add(kappa, dy_term).abs(), sums.screen[1][l]);
            }
        }
        sink.put(span, finish(splat, origin, &offset, &sums));
    }
}

/// Sums over the columns and returns the sums as a record.
pub(crate) fn finish(
    splat: &Splat,
    origin: [f32; 2],
    offset: &Lanes,
    sums: &ColumnSums<Lanes>,
) -> EntryGradient {
    let weighted = |a: &Lanes| -> Lanes { std::array::from_fn(|l| a[l] * offset[l]) };
    let x0 = weighted(&sums.weight);
    let in_tile = [
        sum(&sums.weight),
        sum(&x0),
        sum(&weighted(&x0)),
        sum(&sums.eta),
        sum(&weighted(&sums.eta)),
        sum(&sums.eta_eta),
    ];
    let [s0, t, y, tt, ty, yy] = moments(splat, origin, in_tile);
    let (z, color, screen) = (sum(&sums.z), sums.color.map(|c| sum(&c)), sums.screen.map(|v| sum(&v)));
    SplatGradient { weight: s0, t, dy: y, t_t: tt, t_dy: ty, dy_dy: yy, z, color, screen }.record()
}

/// Stage 2: computes the gradient with respect to colours and the medium, front to back, without geometry.
pub(crate) fn backward_colors<const WATER: bool>(
    input: &TileInput<'_>,
    water: &TileWater,
    tile: &mut BackwardTile,
    sink: &mut Sink<'_>,
) {
    let mut forward = ForwardTile::new(input.filled_rows, input.filled_columns);
    for k in 0..input.list.len() {
        let (span, splat) = input.entry(k);
        let decay = WATER.then(|| Decay::new(water, splat.z));
        let mut lanes = [[0.0f32; TILE]; 3];
        for r in 0..input.filled_rows {
            let (terms, row, water) = (splat.row(input.rows[r]), &mut tile.rows[r], &water.rows[r]);
            let state = &mut forward.rows[r];
            for l in 0..TILE {
                let Some(w) = weight(splat, terms, input.columns[l], state, l, k) else { continue };
                let wz = w * splat.z;
                for c in 0..3 {
                    let g = row.image[c][l];
                    if let Some(decay) = &decay {
                        let object = g * decay.at(c, water.attenuation[c][l], 1.0);
                        let veil = decay.at(c + 3, water.backscatter[c][l], 1.0);
                        lanes[c][l] = w.mul_add(object, lanes[c][l]);
                        row.object_moment[c][l] =
                            wz.mul_add(object * splat.color[c], row.object_moment[c][l]);
                        row.veil_moment[c][l] = wz.mul_add(row.veiled[c][l] * veil, row.veil_moment[c][l]);
                        row.veil[c][l] = w.mul_add(veil, row.veil[c][l]);
                    } else {
                        lanes[c][l] = w.mul_add(g, lanes[c][l]);
                    }
                }
            }
        }
        sink.put(span, SplatGradient::of_color(std::array::from_fn(|c| sum(&lanes[c]))));
    }
}

/// One step of the transmittance: returns the weight of this Gaussian at lane `l`, or `None` if it does not
/// contribute.
#[inline(always)]
pub(super) fn weight(
    splat: &Splat,
    terms: RowTerms,
    x: f32,
    row: &mut ForwardRow,
    l: usize,
    k: usize,
) -> Option<f32> {
    let (power, _) = log2_alpha(splat, terms, x);
    let live = power >= row.threshold[l];
    if !live {
        return None;
    }
    let alpha = exp2_unclamped(power).min(ALPHA_MAX);
    let w = row.transmittance[l] * alpha;
    let rest = row.transmittance[l] * (1.0 - alpha);
    if rest <= STOP {
        row.threshold[l] = f32::INFINITY;
        row.stop[l] = k as i32;
        return None;
    }
    row.transmittance[l] = rest;
    Some(w)
}

/// The linear splat of up to [`CHANNELS`] channels: `out[row][channel] += Σ w values`.
pub(crate) fn splat(
    input: &TileInput<'_>,
    values: impl Fn(u32) -> [f32; CHANNELS],
    forward: &mut ForwardTile,
    out: &mut [[Lanes; CHANNELS]; TILE],
) {
    for k in 0..input.list.len() {
        let splat = input.entry(k).1;
        let values = values(splat.index);
        for r in 0..input.filled_rows {
            let (terms, state) = (splat.row(input.rows[r]), &mut forward.rows[r]);
            for l in 0..TILE {
                if let Some(w) = weight(splat, terms, input.columns[l], state, l, k) {
                    for c in 0..CHANNELS {
                        out[r][c][l] = w.mul_add(values[c], out[r][c][l]);
                    }
                }
            }
        }
    }
}

/// The adjoint of [`splat`]: the first [`CHANNELS`] entries of each record are `Σ_p w maps`.
pub(crate) fn splat_adjoint(
    input: &TileInput<'_>,
    maps: &[[Lanes; CHANNELS]; TILE],
    forward: &mut ForwardTile,
    sink: &mut Sink<'_>,
) {
    for k in 0..input.list.len() {
        let (span, splat) = input.entry(k);
        let mut lanes = [[0.0f32; TILE]; CHANNELS];
        for r in 0..input.filled_rows {
            let (terms, state) = (splat.row(input.rows[r]), &mut forward.rows[r]);
            for l in 0..TILE {
                if let Some(w) = weight(splat, terms, input.columns[l], state, l, k) {
                    for c in 0..CHANNELS {
                        lanes[c][l] = w.mul_add(maps[r][c][l], lanes[c][l]);
                    }
                }
            }
        }
        let mut sums = [0.0; 12];
        for c in 0..CHANNELS {
            sums[c] = sum(&lanes[c]);
        }
        sink.put(span, sums);
    }
}
