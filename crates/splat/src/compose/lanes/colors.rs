//! The gradient with respect to colours and water, with frozen geometry (stage 2).

use fearless_simd::{Simd, SimdBase, SimdFloat, f32x16};

use super::decay::{Attenuate, ThroughWater, through};
use super::entries::{Entry, Pass, walk};
use super::front::Front;
use super::sums::sums;
use super::{accumulate, load};
use crate::compose::tile::{BackwardTile, ForwardTile, Sink, TileInput, TileWater};
use crate::lists::Span;
use crate::project::SplatGradient;

/// See [`plain::backward_colors`](crate::compose::plain::backward_colors).
#[inline(always)]
pub(crate) fn backward_colors<S: Simd, const WATER: bool>(
    simd: S,
    input: &TileInput<'_>,
    water: &TileWater,
    tile: &mut BackwardTile,
    sink: &mut Sink<'_>,
) {
    let mut state = ForwardTile::new(input.filled_rows, input.filled_columns);
    let mut pass = ColorsBackward::<WATER> { water, front: Front::new(input, &mut state), tile, sink };
    walk::<_, false, _>(simd, input, &mut pass);
}

struct ColorsBackward<'a, 'b, const WATER: bool> {
    water: &'a TileWater,
    front: Front<'a>,
    tile: &'a mut BackwardTile,
    sink: &'a mut Sink<'b>,
}

impl<S: Simd, const WATER: bool> Pass<S> for ColorsBackward<'_, '_, WATER> {
    const RECORDS: bool = true;

    #[inline(always)]
    fn open(&self, _simd: S, _k: usize) -> u32 {
        self.front.alive
    }

    #[inline(always)]
    fn meet(&mut self, simd: S, entry: &Entry<'_, S>) {
        let [r, g, b] = through::<_, WATER, _>(simd, self.water, [1.0; 3], entry, self);
        let [r, g, b, _] = sums(simd, [r, g, b, b]);
        self.sink.put(entry.span, SplatGradient::of_color([r, g, b]));
    }

    #[inline(always)]
    fn miss(&mut self, span: &Span) {
        self.sink.put(span, [0.0; 12]);
    }
}

impl<S: Simd, const WATER: bool> ThroughWater<S> for ColorsBackward<'_, '_, WATER> {
    type Out = [f32x16<S>; 3];

    #[inline(always)]
    fn rows<A: Attenuate<S>>(&mut self, simd: S, entry: &Entry<'_, S>, decay: &A) -> [f32x16<S>; 3] {
        let c = |v: f32| f32x16::splat(simd, v);
        let splat = entry.splat;
        let (steepness, z) = (c(splat.steepness), c(splat.z));
        let mut lanes = [c(0.0); 3];
        for r in entry.rows() {
            let (power, _) = entry.log2_alpha(simd, steepness, r);
            let w = self.front.weights(simd, power, r, entry.k);
            let row = &mut self.tile.rows[r];
            let wz = w * z;
            for q in 0..3 {
                let g = load(simd, &row.image[q]);
                if A::WATER {
                    let water = &self.water.rows[r];
                    let object = g * decay.at::<false>(simd, q, load(simd, &water.attenuation[q]));
                    let veil = decay.at::<false>(simd, q + 3, load(simd, &water.backscatter[q]));
                    lanes[q] = w.mul_add(object, lanes[q]);
                    accumulate(simd, &mut row.object_moment[q], wz, object * c(splat.color[q]));
                    let veiled = load(simd, &row.veiled[q]) * veil;
                    accumulate(simd, &mut row.veil_moment[q], wz, veiled);
                    accumulate(simd, &mut row.veil[q], w, veil);
                } else {
                    lanes[q] = w.mul_add(g, lanes[q]);
                }
            }
        }
        lanes
    }
}
