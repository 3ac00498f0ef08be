//! Composes a tile.

use fearless_simd::{Simd, SimdBase, f32x16};

use super::batch::{EntryBatch, Pass, walk};
use super::decay::{Attenuate, ThroughWater, cut, through};
use super::front::Front;
use super::{accumulate, load, select};
use crate::compose::tile::{ForwardTile, TileInput, TileWater};

/// See [`plain::forward`](crate::compose::plain::forward).
#[inline(always)]
pub(crate) fn forward<S: Simd, const WATER: bool, const LAYERS: bool>(
    simd: S,
    input: &TileInput<'_>,
    water: &TileWater,
    tile: &mut ForwardTile,
) {
    let mut pass = Forward::<WATER, LAYERS> { water, front: Front::new(input, tile) };
    walk::<_, false, _>(simd, input, cut::<WATER>(water), &mut pass);
}

struct Forward<'a, const WATER: bool, const LAYERS: bool> {
    water: &'a TileWater,
    front: Front<'a>,
}

impl<S: Simd, const WATER: bool, const LAYERS: bool> Pass<S> for Forward<'_, WATER, LAYERS> {
    const RECORDS: bool = false;

    #[inline(always)]
    fn open(&self, _simd: S, _k: usize) -> u32 {
        self.front.alive
    }

    #[inline(always)]
    fn batch(&mut self, simd: S, batch: &EntryBatch<'_, S>) {
        self.front.apply(simd, batch);
        through::<_, WATER>(simd, self.water, batch, self);
    }
}

impl<S: Simd, const WATER: bool, const LAYERS: bool> ThroughWater<S> for Forward<'_, WATER, LAYERS> {
    #[inline(always)]
    fn light<A: Attenuate<S>>(&mut self, simd: S, batch: &EntryBatch<'_, S>, decay: &A) {
        let c = |v: f32| f32x16::splat(simd, v);
        for item in batch.items() {
            let e = item.entry;
            let (w, z) = (self.front.weights.get(simd, item.number), c(batch.z[e]));
            let state = &mut self.front.tile.cells[item.cell];
            accumulate(simd, &mut state.depth, w, z);
            (load(simd, &state.accumulation) + w).store_array(&mut state.accumulation);
            for q in 0..3 {
                let color = c(batch.color[q][e]);
                if A::WATER {
                    let water = &self.water.cells[item.cell];
                    let object = decay.at(simd, q, e, load(simd, &water.attenuation[q]));
                    let veil = decay.at(simd, q + 3, e, load(simd, &water.backscatter[q]));
                    accumulate(simd, &mut state.object[q], w * c(decay.colored(q, e)), object);
                    accumulate(simd, &mut state.veil[q], w * c(decay.factor(q + 3, e)), veil);
                } else {
                    accumulate(simd, &mut state.object[q], w, color);
                }
                if LAYERS {
                    accumulate(simd, &mut state.clear[q], w, color);
                }
            }
            if LAYERS {
                let last = select(w.simd_gt(c(0.0)), z, load(simd, &state.last));
                last.store_array(&mut state.last);
            }
        }
    }
}
