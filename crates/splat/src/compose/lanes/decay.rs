//! The water between the Gaussians of a batch and the pixels of a tile: `e^{-β_a s}` and `e^{-β_b s}`.
//!
//! There are three cases: no water, a small deviation from the tile's centre (a polynomial), and any
//! deviation (the full exponential). [`through`] chooses the case once per batch; the loops over items are
//! written once, for any [`Attenuate`].

use fearless_simd::{Simd, SimdBase, SimdFloat, f32x16};
use use3d_numerics::lanes::{SMALL_COEFFICIENTS, exp2_lanes};

use super::batch::EntryBatch;
use super::load;
use crate::compose::tile::{Lanes, TileWater};
use crate::lists::TILE;

/// One of the three ways to compute the water's decay.
pub(super) trait Attenuate<S: Simd> {
    /// True if there is water.
    const WATER: bool;

    /// The fraction of light left between entry `e` and the pixels of a cell whose exponents deviate by
    /// `deviation` from the tile's, divided by [`factor`](Self::factor): `e^{-β_a s}` of channel `q`, or
    /// `e^{-β_b s}` of channel `q − 3`.
    fn at(&self, simd: S, q: usize, e: usize, deviation: f32x16<S>) -> f32x16<S>;

    /// The part of the decay that is the same in the whole tile.
    fn factor(&self, q: usize, e: usize) -> f32;

    /// Channel `q` of the entry's colour, times the factor of attenuation.
    fn colored(&self, q: usize, e: usize) -> f32;
}

/// Work on the items of a batch, written for any [`Attenuate`].
pub(super) trait ThroughWater<S: Simd> {
    fn light<A: Attenuate<S>>(&mut self, simd: S, batch: &EntryBatch<'_, S>, decay: &A);
}

/// The depth at which batches are cut, so that [`through`] finds one case for each.
#[inline(always)]
pub(super) fn cut<const WATER: bool>(water: &TileWater) -> f32 {
    if WATER { water.near } else { f32::INFINITY }
}

/// Chooses the case for a batch, whose entries all lie on one side of the depth [`cut`].
#[inline(always)]
pub(super) fn through<S: Simd, const WATER: bool>(
    simd: S,
    water: &TileWater,
    batch: &EntryBatch<'_, S>,
    pass: &mut impl ThroughWater<S>,
) {
    if !WATER {
        return pass.light(simd, batch, &Dry);
    }
    let c = |v: f32| f32x16::splat(simd, v);
    let z = load(simd, &batch.z);
    let zero = [0.0; TILE];
    let (mut exponent, mut factor, mut colored) = ([zero; 6], [zero; 6], batch.color);
    if batch.z[0] > water.near {
        for q in 0..6 {
            (c(water.centre[q]) * z).store_array(&mut exponent[q]);
        }
        return pass.light(simd, batch, &Far { z: batch.z, exponent, color: batch.color });
    }
    for q in 0..6 {
        let lanes = exp2_lanes(simd, c(water.centre[q]) * z);
        lanes.store_array(&mut factor[q]);
        if q < 3 {
            (lanes * load(simd, &batch.color[q])).store_array(&mut colored[q]);
        }
    }
    let [_, k1, k2, k3] = SMALL_COEFFICIENTS;
    let cubic = [c(k1) * z, c(k2) * (z * z), c(k3) * (z * z * z)];
    let mut coefficients = [zero; 3];
    for (out, lanes) in coefficients.iter_mut().zip(cubic) {
        lanes.store_array(out);
    }
    pass.light(simd, batch, &Near { coefficients, factor, colored });
}

/// No water.
struct Dry;

/// The deviations times depth are small.
struct Near {
    /// The coefficients of the cubic in the deviation, without the first, which is 1.
    coefficients: [Lanes; 3],
    /// The decay at the tile's centre; times the colour.
    factor: [Lanes; 6],
    colored: [Lanes; 3],
}

/// The deviations times depth may be any number.
struct Far {
    z: Lanes,
    /// At the tile's centre.
    exponent: [Lanes; 6],
    color: [Lanes; 3],
}

impl<S: Simd> Attenuate<S> for Dry {
    const WATER: bool = false;

    #[inline(always)]
    fn at(&self, simd: S, _q: usize, _e: usize, _deviation: f32x16<S>) -> f32x16<S> {
        f32x16::splat(simd, 1.0)
    }

    #[inline(always)]
    fn factor(&self, _q: usize, _e: usize) -> f32 {
        1.0
    }

    #[inline(always)]
    fn colored(&self, _q: usize, _e: usize) -> f32 {
        1.0
    }
}

impl<S: Simd> Attenuate<S> for Near {
    const WATER: bool = true;

    #[inline(always)]
    fn at(&self, simd: S, _q: usize, e: usize, deviation: f32x16<S>) -> f32x16<S> {
        let c = |v: f32| f32x16::splat(simd, v);
        let [k1, k2, k3] = &self.coefficients;
        c(k3[e]).mul_add(deviation, c(k2[e])).mul_add(deviation, c(k1[e])).mul_add(deviation, c(1.0))
    }

    #[inline(always)]
    fn factor(&self, q: usize, e: usize) -> f32 {
        self.factor[q][e]
    }

    #[inline(always)]
    fn colored(&self, q: usize, e: usize) -> f32 {
        self.colored[q][e]
    }
}

impl<S: Simd> Attenuate<S> for Far {
    const WATER: bool = true;

    #[inline(always)]
    fn at(&self, simd: S, q: usize, e: usize, deviation: f32x16<S>) -> f32x16<S> {
        let c = |v: f32| f32x16::splat(simd, v);
        exp2_lanes(simd, deviation.mul_add(c(self.z[e]), c(self.exponent[q][e])))
    }

    #[inline(always)]
    fn factor(&self, _q: usize, _e: usize) -> f32 {
        1.0
    }

    #[inline(always)]
    fn colored(&self, q: usize, e: usize) -> f32 {
        self.color[q][e]
    }
}
