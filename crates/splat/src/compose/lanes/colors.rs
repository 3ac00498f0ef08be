//! The gradient with respect to colours and water, with frozen geometry (stage 2).

use fearless_simd::{Simd, SimdBase, SimdFloat, f32x16};

use super::batch::{EntryBatch, Items, Pass, walk};
use super::decay::{Attenuate, ThroughWater, cut, through};
use super::front::Front;
use super::sums::sums;
use super::{accumulate, load};
use crate::compose::tile::{BackwardTile, EntrySink, ForwardTile, TileInput, TileWater};
use crate::project::SplatGradient;

/// See [`plain::backward_colors`](crate::compose::plain::backward_colors).
#[inline(always)]
pub(crate) fn backward_colors<S: Simd, const WATER: bool>(
    simd: S,
    input: &TileInput<'_>,
    water: &TileWater,
    tile: &mut BackwardTile,
    sink: &mut EntrySink<'_>,
) {
    let mut state = ForwardTile::new(input.filled_rows, input.filled_columns);
    let (front, colors) = (Front::new(input, &mut state), [Items::ZERO; 3]);
    let mut pass = ColorsBackward::<WATER> { water, front, tile, sink, colors };
    walk::<_, false, _>(simd, input, cut::<WATER>(water), &mut pass);
}

struct ColorsBackward<'a, 'b, const WATER: bool> {
    water: &'a TileWater,
    front: Front<'a>,
    tile: &'a mut BackwardTile,
    sink: &'a mut EntrySink<'b>,
    /// `w colors` is `∂L/∂c`.
    colors: [Items; 3],
}

impl<S: Simd, const WATER: bool> Pass<S> for ColorsBackward<'_, '_, WATER> {
    const RECORDS: bool = true;

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

impl<S: Simd, const WATER: bool> ThroughWater<S> for ColorsBackward<'_, '_, WATER> {
    #[inline(always)]
    fn light<A: Attenuate<S>>(&mut self, simd: S, batch: &EntryBatch<'_, S>, decay: &A) {
        let c = |v: f32| f32x16::splat(simd, v);
        let weights = &self.front.weights;
        for item in batch.items() {
            let e = item.entry;
            let w = weights.get(simd, item.number);
            let state = &mut self.tile.cells[item.cell];
            let wz = w * c(batch.z[e]);
            for q in 0..3 {
                let mut color = load(simd, &state.image[q]);
                if A::WATER {
                    let water = &self.water.cells[item.cell];
                    color *= decay.at(simd, q, e, load(simd, &water.attenuation[q]));
                    let veil = decay.at(simd, q + 3, e, load(simd, &water.backscatter[q]));
                    let veil = veil * c(decay.factor(q + 3, e));
                    let colored = color * c(decay.colored(q, e));
                    accumulate(simd, &mut state.object_moment[q], wz, colored);
                    let veiled = load(simd, &state.veiled[q]) * veil;
                    accumulate(simd, &mut state.veil_moment[q], wz, veiled);
                    accumulate(simd, &mut state.veil[q], w, veil);
                }
                self.colors[q].set(item.number, color);
            }
        }
        for e in 0..batch.len() {
            let mut lanes = [c(0.0); 3];
            for item in batch.items_of(e) {
                let w = weights.get(simd, item.number);
                for q in 0..3 {
                    lanes[q] = w.mul_add(self.colors[q].get(simd, item.number), lanes[q]);
                }
            }
            for q in 0..3 {
                lanes[q] *= c(decay.factor(q, e));
            }
            let [r, g, b, _] = sums(simd, [lanes[0], lanes[1], lanes[2], lanes[2]]);
            self.sink.put(batch.entries[e].0, SplatGradient::of_color([r, g, b]));
        }
    }
}
