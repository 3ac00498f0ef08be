//! The gradient of a tile, from the farthest Gaussian to the nearest.

use fearless_simd::{Simd, SimdBase, SimdFloat, SimdMask, f32x16, i32x16};
use use3d_numerics::lanes::exp2_unclamped_lanes;

use super::decay::{Attenuate, ThroughWater, through};
use super::entries::{Entry, Pass, walk};
use super::sums::finish;
use super::{accumulate, load, select};
use crate::compose::tile::{ALPHA_MAX, BackwardTile, ColumnSums, Lanes, NEVER, Sink, TileInput, TileWater};
use crate::lists::{Span, TILE};
use crate::project::LOG2_255;

/// See [`plain::backward`](crate::compose::plain::backward).
#[inline(always)]
pub(crate) fn backward<S: Simd, const WATER: bool, const EXTRAS: bool>(
    simd: S,
    input: &TileInput<'_>,
    water: &TileWater,
    tile: &mut BackwardTile,
    s_gradient: f32,
    sink: &mut Sink<'_>,
) {
    let (columns, rows) = (load(simd, input.columns), load(simd, input.rows));
    let origin = [input.columns[TILE / 2], input.rows[TILE / 2]];
    let offset = columns - f32x16::splat(simd, origin[0]);
    let eta: Lanes = (rows - f32x16::splat(simd, origin[1])).to_array();
    // A row takes part only in entries before the farthest stop of its pixels.
    let mut stops = [0; TILE];
    for (stop, row) in stops.iter_mut().zip(&tile.rows[..input.filled_rows]) {
        *stop = row.stop.iter().copied().max().unwrap_or(NEVER);
    }
    let stops = i32x16::load_array_ref(simd, &stops);
    let heights = input.rows;
    let mut pass =
        Backward::<_, WATER, EXTRAS> { water, tile, s_gradient, sink, origin, offset, eta, heights, stops };
    walk::<_, true, _>(simd, input, &mut pass);
}

struct Backward<'a, 'b, S: Simd, const WATER: bool, const EXTRAS: bool> {
    water: &'a TileWater,
    tile: &'a mut BackwardTile,
    s_gradient: f32,
    sink: &'a mut Sink<'b>,
    /// The pixel of the tile about which sums are taken, the columns measured from it, and the rows.
    origin: [f32; 2],
    offset: f32x16<S>,
    eta: Lanes,
    /// Pixel centres of the rows.
    heights: &'a Lanes,
    /// The farthest stop of each row.
    stops: i32x16<S>,
}

impl<S: Simd, const WATER: bool, const EXTRAS: bool> Pass<S> for Backward<'_, '_, S, WATER, EXTRAS> {
    const RECORDS: bool = true;

    #[inline(always)]
    fn open(&self, simd: S, k: usize) -> u32 {
        self.stops.simd_gt(i32x16::splat(simd, k as i32)).to_bitmask() as u32
    }

    #[inline(always)]
    fn meet(&mut self, simd: S, entry: &Entry<'_, S>) {
        let sums = through::<_, WATER, _>(simd, self.water, [1.0; 3], entry, self);
        self.sink.put(entry.span, finish(simd, entry.splat, self.origin, self.offset, sums));
    }

    #[inline(always)]
    fn miss(&mut self, span: &Span) {
        self.sink.put(span, [0.0; 12]);
    }
}

impl<S: Simd, const WATER: bool, const EXTRAS: bool> ThroughWater<S> for Backward<'_, '_, S, WATER, EXTRAS> {
    type Out = ColumnSums<f32x16<S>>;

    #[inline(always)]
    fn rows<A: Attenuate<S>>(&mut self, simd: S, entry: &Entry<'_, S>, decay: &A) -> ColumnSums<f32x16<S>> {
        let c = |v: f32| f32x16::splat(simd, v);
        let (splat, water) = (entry.splat, self.water);
        let (steepness, z) = (c(splat.steepness), c(splat.z));
        let (kappa, inverse) = splat.conic_terms();
        let (kappa, s_gradient) = (c(kappa), c(self.s_gradient));
        let mut sums = ColumnSums::zeros(c(0.0));
        for r in entry.rows() {
            let row = &mut self.tile.rows[r];
            let (power, t) = entry.log2_alpha(simd, steepness, r);
            let stops = i32x16::load_array_ref(simd, &row.stop);
            let live = power.simd_ge(c(-LOG2_255)) & stops.simd_gt(i32x16::splat(simd, entry.k as i32));
            let raw = exp2_unclamped_lanes(simd, power);
            let alpha = select(live, raw.min(c(ALPHA_MAX)), c(0.0));
            let over = c(1.0) / (c(1.0) - alpha);
            let transmittance = load(simd, &row.transmittance) * over;
            transmittance.store_array(&mut row.transmittance);
            let w = transmittance * alpha;
            let mut v =
                if EXTRAS { load(simd, &row.depth).mul_add(z, load(simd, &row.weight)) } else { c(0.0) };
            let mut slope = c(0.0);
            let wz = w * z;
            for q in 0..3 {
                let g = load(simd, &row.image[q]);
                if A::WATER {
                    let attenuation = load(simd, &water.rows[r].attenuation[q]);
                    let backscatter = load(simd, &water.rows[r].backscatter[q]);
                    let object = g * decay.at::<false>(simd, q, attenuation);
                    let veil = decay.at::<false>(simd, q + 3, backscatter);
                    let colored = object * c(splat.color[q]);
                    let veiled = load(simd, &row.veiled[q]) * veil;
                    v = (v + colored) + veiled;
                    slope = (attenuation + c(water.centre[q])).mul_add(colored, slope);
                    slope = (backscatter + c(water.centre[q + 3])).mul_add(veiled, slope);
                    let mut color = object;
                    if EXTRAS {
                        let clear = load(simd, &row.clear[q]);
                        color += clear;
                        v = clear.mul_add(c(splat.color[q]), v);
                    }
                    sums.color[q] = w.mul_add(color, sums.color[q]);
                    accumulate(simd, &mut row.object_moment[q], wz, colored);
                    accumulate(simd, &mut row.veil_moment[q], wz, veiled);
                    accumulate(simd, &mut row.veil[q], w, veil);
                } else {
                    let color = if EXTRAS { g + load(simd, &row.clear[q]) } else { g };
                    v = color.mul_add(c(splat.color[q]), v);
                    sums.color[q] = w.mul_add(color, sums.color[q]);
                }
            }
            slope *= s_gradient;
            if EXTRAS {
                slope = load(simd, &row.depth).mul_add(c(std::f32::consts::LOG2_E), slope);
            }
            if EXTRAS || WATER {
                sums.z = w.mul_add(slope, sums.z);
            }
            let wv = w * v;
            let behind = load(simd, &row.behind);
            let g = (alpha * over).mul_add(behind, wv);
            (behind - wv).store_array(&mut row.behind);
            let g = select(raw.simd_le(c(ALPHA_MAX)), g, c(0.0));
            let height = c(self.eta[r]);
            sums.weight += g;
            sums.eta = g.mul_add(height, sums.eta);
            sums.eta_eta = g.mul_add(height * height, sums.eta_eta);
            let size = g.abs();
            sums.screen[0] = size.mul_add(t.abs(), sums.screen[0]);
            let dy_term = (self.heights[r] - splat.y) * inverse;
            sums.screen[1] = size.mul_add(t.mul_add(kappa, c(dy_term)).abs(), sums.screen[1]);
        }
        sums
    }
}
