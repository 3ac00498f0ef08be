//! The linear splat and its adjoint.

use fearless_simd::{Simd, SimdBase, SimdFloat, f32x16};

use super::batch::{ENTRIES, EntryBatch, Pass, walk};
use super::front::Front;
use super::sums::sums;
use super::{accumulate, load};
use crate::compose::tile::{CELLS, CHANNELS, EntrySink, ForwardTile, Lanes, TileInput};
use crate::project::EntryGradient;

/// See [`plain::splat`](crate::compose::plain::splat); the first `C` channels.
#[inline(always)]
pub(crate) fn splat<S: Simd, const C: usize>(
    simd: S,
    input: &TileInput<'_>,
    values: impl Fn(u32) -> [f32; CHANNELS],
    forward: &mut ForwardTile,
    out: &mut [[Lanes; CHANNELS]; CELLS],
) {
    let mut pass = Splatting::<_, C> { values, front: Front::new(input, forward), out };
    walk::<_, false, _>(simd, input, f32::INFINITY, &mut pass);
}

struct Splatting<'a, F, const C: usize> {
    values: F,
    front: Front<'a>,
    out: &'a mut [[Lanes; CHANNELS]; CELLS],
}

impl<S: Simd, F: Fn(u32) -> [f32; CHANNELS], const C: usize> Pass<S> for Splatting<'_, F, C> {
    const RECORDS: bool = false;

    #[inline(always)]
    fn open(&self, _simd: S, _k: usize) -> u32 {
        self.front.alive
    }

    #[inline(always)]
    fn batch(&mut self, simd: S, batch: &EntryBatch<'_, S>) {
        self.front.apply(simd, batch);
        let mut values = [[0.0; CHANNELS]; ENTRIES];
        for (out, (_, splat)) in values.iter_mut().zip(&batch.entries[..batch.len()]) {
            *out = (self.values)(splat.index);
        }
        for item in batch.items() {
            let w = self.front.weights.get(simd, item.number);
            for (lanes, v) in self.out[item.cell][..C].iter_mut().zip(values[item.entry]) {
                accumulate(simd, lanes, w, f32x16::splat(simd, v));
            }
        }
    }
}

/// See [`plain::splat_adjoint`](crate::compose::plain::splat_adjoint); the first `C` channels.
#[inline(always)]
pub(crate) fn splat_adjoint<S: Simd, const C: usize>(
    simd: S,
    input: &TileInput<'_>,
    maps: &[[Lanes; CHANNELS]; CELLS],
    forward: &mut ForwardTile,
    sink: &mut EntrySink<'_>,
) {
    let mut pass = Adjoint::<C> { maps, front: Front::new(input, forward), sink };
    walk::<_, false, _>(simd, input, f32::INFINITY, &mut pass);
}

struct Adjoint<'a, 'b, const C: usize> {
    maps: &'a [[Lanes; CHANNELS]; CELLS],
    front: Front<'a>,
    sink: &'a mut EntrySink<'b>,
}

impl<S: Simd, const C: usize> Pass<S> for Adjoint<'_, '_, C> {
    const RECORDS: bool = true;

    #[inline(always)]
    fn open(&self, _simd: S, _k: usize) -> u32 {
        self.front.alive
    }

    #[inline(always)]
    fn batch(&mut self, simd: S, batch: &EntryBatch<'_, S>) {
        self.front.apply(simd, batch);
        for e in 0..batch.len() {
            let mut lanes = [f32x16::splat(simd, 0.0); CHANNELS];
            for item in batch.items_of(e) {
                let w = self.front.weights.get(simd, item.number);
                for (lanes, map) in lanes[..C].iter_mut().zip(&self.maps[item.cell]) {
                    *lanes = w.mul_add(load(simd, map), *lanes);
                }
            }
            let [a, b, c, d, e4, f, g, h] = lanes;
            let mut out = EntryGradient::default();
            out[..4].copy_from_slice(&sums(simd, [a, b, c, d]));
            out[4..8].copy_from_slice(&sums(simd, [e4, f, g, h]));
            self.sink.put(batch.entries[e].0, out);
        }
    }
}
