//! The gradient of a tile, from the farthest Gaussian to the nearest.
//!
//! A batch has three loops: [`weights`](Backward::weights) and [`light`](ThroughWater::light) over all items,
//! and [`sums`](Backward::sums) over the items of each entry.

use fearless_simd::{Simd, SimdBase, SimdFloat, SimdMask, f32x16, i32x16};
use use3d_numerics::lanes::exp2_unclamped_lanes;

use super::batch::{EntryBatch, Items, Pass, walk};
use super::decay::{Attenuate, ThroughWater, cut, through};
use super::sums::finish;
use super::{accumulate, load, select};
use crate::compose::tile::{
    ALPHA_MAX, BackwardTile, CELLS, EntrySink, LaneSums, NEVER, RATIO_MAX, TileInput, TileWater,
};
use crate::project::LOG2_255;

/// See [`plain::backward`](crate::compose::plain::backward).
#[inline(always)]
pub(crate) fn backward<S: Simd, const WATER: bool, const EXTRAS: bool>(
    simd: S,
    input: &TileInput<'_>,
    water: &TileWater,
    tile: &mut BackwardTile,
    s_gradient: f32,
    sink: &mut EntrySink<'_>,
) {
    // A cell takes part only in entries before the farthest stop of its pixels.
    let mut stops = [0; CELLS];
    for (stop, cell) in stops.iter_mut().zip(&tile.cells) {
        *stop = cell.stop.iter().copied().max().unwrap_or(NEVER);
    }
    let stops = i32x16::load_array_ref(simd, &stops);
    let (weights, pulls, slopes) = (Items::ZERO, Items::ZERO, Items::ZERO);
    let colors = [Items::ZERO; 3];
    let mut pass =
        Backward::<_, WATER, EXTRAS> { water, tile, s_gradient, sink, stops, weights, pulls, slopes, colors };
    walk::<_, true, _>(simd, input, cut::<WATER>(water), &mut pass);
}

struct Backward<'a, 'b, S: Simd, const WATER: bool, const EXTRAS: bool> {
    water: &'a TileWater,
    tile: &'a mut BackwardTile,
    s_gradient: f32,
    sink: &'a mut EntrySink<'b>,
    /// The farthest stop of each cell.
    stops: i32x16<S>,
    /// The weights `w`.
    weights: Items,
    /// First `α / (1 − α)`, then `G = α ∂L/∂α`.
    pulls: Items,
    /// `w slopes` is `∂L/∂z / ln 2`, and `w colors` is `∂L/∂c`.
    slopes: Items,
    colors: [Items; 3],
}

impl<S: Simd, const WATER: bool, const EXTRAS: bool> Pass<S> for Backward<'_, '_, S, WATER, EXTRAS> {
    const RECORDS: bool = true;

    #[inline(always)]
    fn open(&self, simd: S, k: usize) -> u32 {
        self.stops.simd_gt(i32x16::splat(simd, k as i32)).to_bitmask() as u32
    }

    #[inline(always)]
    fn batch(&mut self, simd: S, batch: &EntryBatch<'_, S>) {
        self.weights(simd, batch);
        through::<_, WATER>(simd, self.water, batch, self);
    }
}

impl<S: Simd, const WATER: bool, const EXTRAS: bool> Backward<'_, '_, S, WATER, EXTRAS> {
    /// Undoes the entries: computes their weights, and the transmittances before them.
    #[inline(always)]
    fn weights(&mut self, simd: S, batch: &EntryBatch<'_, S>) {
        let c = |v: f32| f32x16::splat(simd, v);
        for item in batch.items() {
            let state = &mut self.tile.cells[item.cell];
            let power = batch.log2_alpha(simd, item);
            let k = i32x16::splat(simd, batch.places[item.entry]);
            let live = power.simd_ge(c(-LOG2_255)) & i32x16::load_array_ref(simd, &state.stop).simd_gt(k);
            let alpha = select(live, exp2_unclamped_lanes(simd, power).min(c(ALPHA_MAX)), c(0.0));
            let over = c(1.0) / (c(1.0) - alpha);
            let transmittance = load(simd, &state.transmittance) * over;
            transmittance.store_array(&mut state.transmittance);
            self.weights.set(item.number, transmittance * alpha);
            self.pulls.set(item.number, alpha * over);
        }
    }

    /// Sums over the items of each entry, and stores its record.
    #[inline(always)]
    fn sums<A: Attenuate<S>>(&mut self, simd: S, batch: &EntryBatch<'_, S>, decay: &A) {
        let c = |v: f32| f32x16::splat(simd, v);
        for e in 0..batch.len() {
            let (at, splat) = batch.entries[e];
            let (kappa, inverse) = splat.conic_terms();
            let (kappa, inverse) = (c(kappa), c(inverse));
            let mut sums = LaneSums::zeros(c(0.0));
            for item in batch.items_of(e) {
                let g = self.pulls.get(simd, item.number);
                let [t, dy] = batch.offsets(simd, item);
                let (g_t, g_dy) = (g * t, g * dy);
                sums.weight += g;
                sums.t += g_t;
                sums.dy += g_dy;
                sums.t_t = g_t.mul_add(t, sums.t_t);
                sums.t_dy = g_t.mul_add(dy, sums.t_dy);
                sums.dy_dy = g_dy.mul_add(dy, sums.dy_dy);
                sums.screen[0] += g_t.abs();
                let slope = t.mul_add(kappa, dy * inverse).abs();
                sums.screen[1] = g.abs().mul_add(slope, sums.screen[1]);
                let w = self.weights.get(simd, item.number);
                if EXTRAS || WATER {
                    sums.z = w.mul_add(self.slopes.get(simd, item.number), sums.z);
                }
                for q in 0..3 {
                    sums.color[q] = w.mul_add(self.colors[q].get(simd, item.number), sums.color[q]);
                }
            }
            if A::WATER && !EXTRAS {
                for q in 0..3 {
                    sums.color[q] *= c(decay.factor(q, e));
                }
            }
            self.sink.put(at, finish(sums));
        }
    }
}

impl<S: Simd, const WATER: bool, const EXTRAS: bool> ThroughWater<S> for Backward<'_, '_, S, WATER, EXTRAS> {
    /// Computes the pulls, the gradients of colours and depth, and the sums of the water's gradient.
    #[inline(always)]
    fn light<A: Attenuate<S>>(&mut self, simd: S, batch: &EntryBatch<'_, S>, decay: &A) {
        let c = |v: f32| f32x16::splat(simd, v);
        let water = self.water;
        let s_gradient = c(self.s_gradient);
        for item in batch.items() {
            let e = item.entry;
            let state = &mut self.tile.cells[item.cell];
            let z = c(batch.z[e]);
            let (w, ratio) = (self.weights.get(simd, item.number), self.pulls.get(simd, item.number));
            let mut v =
                if EXTRAS { load(simd, &state.depth).mul_add(z, load(simd, &state.weight)) } else { c(0.0) };
            let mut slope = c(0.0);
            let wz = w * z;
            for q in 0..3 {
                let g = load(simd, &state.image[q]);
                let mut color = if EXTRAS { g + load(simd, &state.clear[q]) } else { g };
                if A::WATER {
                    let attenuation = load(simd, &water.cells[item.cell].attenuation[q]);
                    let backscatter = load(simd, &water.cells[item.cell].backscatter[q]);
                    let object = g * decay.at(simd, q, e, attenuation);
                    let veil = decay.at(simd, q + 3, e, backscatter) * c(decay.factor(q + 3, e));
                    let colored = object * c(decay.colored(q, e));
                    let veiled = load(simd, &state.veiled[q]) * veil;
                    v = (v + colored) + veiled;
                    slope = (attenuation + c(water.centre[q])).mul_add(colored, slope);
                    slope = (backscatter + c(water.centre[q + 3])).mul_add(veiled, slope);
                    color = object;
                    if EXTRAS {
                        let clear = load(simd, &state.clear[q]);
                        color = object.mul_add(c(decay.factor(q, e)), clear);
                        v = clear.mul_add(c(batch.color[q][e]), v);
                    }
                    accumulate(simd, &mut state.object_moment[q], wz, colored);
                    accumulate(simd, &mut state.veil_moment[q], wz, veiled);
                    accumulate(simd, &mut state.veil[q], w, veil);
                } else {
                    v = color.mul_add(c(batch.color[q][e]), v);
                }
                self.colors[q].set(item.number, color);
            }
            if A::WATER {
                slope *= s_gradient;
            }
            if EXTRAS {
                slope = load(simd, &state.depth).mul_add(c(std::f32::consts::LOG2_E), slope);
            }
            if EXTRAS || WATER {
                self.slopes.set(item.number, slope);
            }
            let wv = w * v;
            let behind = load(simd, &state.behind);
            let g = ratio.mul_add(behind, wv);
            (behind - wv).store_array(&mut state.behind);
            self.pulls.set(item.number, select(ratio.simd_lt(c(RATIO_MAX)), g, c(0.0)));
        }
        self.sums(simd, batch, decay);
    }
}
