//! The linear splat and its adjoint.

use fearless_simd::{Simd, SimdBase, SimdFloat, f32x16};

use super::entries::{Entry, Pass, walk};
use super::front::Front;
use super::sums::sums;
use super::{accumulate, load};
use crate::compose::tile::{CHANNELS, ForwardTile, Lanes, Sink, TileInput};
use crate::lists::{Span, TILE};

/// See [`plain::splat`](crate::compose::plain::splat); the first `C` channels.
#[inline(always)]
pub(crate) fn splat<S: Simd, const C: usize>(
    simd: S,
    input: &TileInput<'_>,
    values: impl Fn(u32) -> [f32; CHANNELS],
    forward: &mut ForwardTile,
    out: &mut [[Lanes; CHANNELS]; TILE],
) {
    let mut pass = Splatting::<_, C> { values, front: Front::new(input, forward), out };
    walk::<_, false, _>(simd, input, &mut pass);
}

struct Splatting<'a, F, const C: usize> {
    values: F,
    front: Front<'a>,
    out: &'a mut [[Lanes; CHANNELS]; TILE],
}

impl<S: Simd, F: Fn(u32) -> [f32; CHANNELS], const C: usize> Pass<S> for Splatting<'_, F, C> {
    const RECORDS: bool = false;

    #[inline(always)]
    fn open(&self, _simd: S, _k: usize) -> u32 {
        self.front.alive
    }

    #[inline(always)]
    fn meet(&mut self, simd: S, entry: &Entry<'_, S>) {
        let values = (self.values)(entry.splat.index);
        let steepness = f32x16::splat(simd, entry.splat.steepness);
        for r in entry.rows() {
            let (power, _) = entry.log2_alpha(simd, steepness, r);
            let w = self.front.weights(simd, power, r, entry.k);
            for (lanes, v) in self.out[r][..C].iter_mut().zip(values) {
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
    maps: &[[Lanes; CHANNELS]; TILE],
    forward: &mut ForwardTile,
    sink: &mut Sink<'_>,
) {
    let mut pass = Adjoint::<C> { maps, front: Front::new(input, forward), sink };
    walk::<_, false, _>(simd, input, &mut pass);
}

struct Adjoint<'a, 'b, const C: usize> {
    maps: &'a [[Lanes; CHANNELS]; TILE],
    front: Front<'a>,
    sink: &'a mut Sink<'b>,
}

impl<S: Simd, const C: usize> Pass<S> for Adjoint<'_, '_, C> {
    const RECORDS: bool = true;

    #[inline(always)]
    fn open(&self, _simd: S, _k: usize) -> u32 {
        self.front.alive
    }

    #[inline(always)]
    fn meet(&mut self, simd: S, entry: &Entry<'_, S>) {
        let steepness = f32x16::splat(simd, entry.splat.steepness);
        let mut lanes = [f32x16::splat(simd, 0.0); CHANNELS];
        for r in entry.rows() {
            let (power, _) = entry.log2_alpha(simd, steepness, r);
            let w = self.front.weights(simd, power, r, entry.k);
            for (lanes, map) in lanes[..C].iter_mut().zip(&self.maps[r]) {
                *lanes = w.mul_add(load(simd, map), *lanes);
            }
        }
        let [a, b, c, d, e, f, g, h] = lanes;
        let mut out = [0.0; 12];
        out[..4].copy_from_slice(&sums(simd, [a, b, c, d]));
        out[4..8].copy_from_slice(&sums(simd, [e, f, g, h]));
        self.sink.put(entry.span, out);
    }

    #[inline(always)]
    fn miss(&mut self, span: &Span) {
        self.sink.put(span, [0.0; 12]);
    }
}
