//! Composes a tile.

use fearless_simd::{Simd, SimdBase, f32x16};

use super::decay::{Attenuate, ThroughWater, through};
use super::entries::{Entry, Pass, walk};
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
    walk::<_, false, _>(simd, input, &mut pass);
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
    fn meet(&mut self, simd: S, entry: &Entry<'_, S>) {
        through::<_, WATER, _>(simd, self.water, entry.splat.color, entry, self);
    }
}

impl<S: Simd, const WATER: bool, const LAYERS: bool> ThroughWater<S> for Forward<'_, WATER, LAYERS> {
    type Out = ();

    #[inline(always)]
    fn rows<A: Attenuate<S>>(&mut self, simd: S, entry: &Entry<'_, S>, decay: &A) {
        let c = |v: f32| f32x16::splat(simd, v);
        let splat = entry.splat;
        let (steepness, z) = (c(splat.steepness), c(splat.z));
        for r in entry.rows() {
            let (power, _) = entry.log2_alpha(simd, steepness, r);
            let w = self.front.weights(simd, power, r, entry.k);
            let row = &mut self.front.tile.rows[r];
            accumulate(simd, &mut row.depth, w, z);
            (load(simd, &row.accumulation) + w).store_array(&mut row.accumulation);
            for q in 0..3 {
                if A::WATER {
                    let water = &self.water.rows[r];
                    let object = decay.at::<true>(simd, q, load(simd, &water.attenuation[q]));
                    let veil = decay.at::<false>(simd, q + 3, load(simd, &water.backscatter[q]));
                    accumulate(simd, &mut row.object[q], w, object);
                    accumulate(simd, &mut row.veil[q], w, veil);
                } else {
                    accumulate(simd, &mut row.object[q], w, c(splat.color[q]));
                }
                if LAYERS {
                    accumulate(simd, &mut row.clear[q], w, c(splat.color[q]));
                }
            }
            if LAYERS {
                let last = select(w.simd_gt(c(0.0)), z, load(simd, &row.last));
                last.store_array(&mut row.last);
            }
        }
    }
}
