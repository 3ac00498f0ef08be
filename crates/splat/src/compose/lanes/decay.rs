//! The water between one Gaussian and the pixels of a tile: `e^{-β_a s}` and `e^{-β_b s}`.
//!
//! There are three cases: no water, a small deviation from the tile's centre (a polynomial), and any
//! deviation (the full exponential). [`through`] chooses the case once per Gaussian; the loops over rows
//! are written once, for any [`Attenuate`].

use fearless_simd::{Simd, SimdBase, SimdFloat, f32x16};
use use3d_numerics::lanes::{SMALL_COEFFICIENTS, exp2_lanes};

use super::entries::Entry;
use super::load;
use crate::compose::tile::{Lanes, TileWater};
use crate::lists::TILE;

/// One of the three ways to compute the water's decay.
pub(super) trait Attenuate<S: Simd> {
    /// True if there is water.
    const WATER: bool;

    /// The fraction of light left at a row of pixels whose exponents deviate by `deviation` from the
    /// tile's: `e^{-β_a s}` of channel `q`, or `e^{-β_b s}` of channel `q − 3`. It is multiplied by the
    /// scale of the decay if `SCALED`.
    fn at<const SCALED: bool>(&self, simd: S, q: usize, deviation: f32x16<S>) -> f32x16<S>;
}

/// Work on the rows that a Gaussian meets, written for any [`Attenuate`].
pub(super) trait ThroughWater<S: Simd> {
    type Out;

    fn rows<A: Attenuate<S>>(&mut self, simd: S, entry: &Entry<'_, S>, decay: &A) -> Self::Out;
}

/// Chooses the case for one Gaussian; `scale` is the factor that [`Attenuate::at`] may multiply by.
#[inline(always)]
pub(super) fn through<S: Simd, const WATER: bool, P: ThroughWater<S>>(
    simd: S,
    water: &TileWater,
    scale: [f32; 3],
    entry: &Entry<'_, S>,
    pass: &mut P,
) -> P::Out {
    if !WATER {
        return pass.rows(simd, entry, &Dry);
    }
    let z = entry.splat.z;
    let decay = Decay::new(simd, water, z, scale);
    if z <= water.near { pass.rows(simd, entry, &Near(decay)) } else { pass.rows(simd, entry, &Far(decay)) }
}

/// No water.
struct Dry;

/// The deviations times depth are small.
struct Near<S: Simd>(Decay<S>);

/// The deviations times depth may be any number.
struct Far<S: Simd>(Decay<S>);

impl<S: Simd> Attenuate<S> for Dry {
    const WATER: bool = false;

    #[inline(always)]
    fn at<const SCALED: bool>(&self, simd: S, _q: usize, _deviation: f32x16<S>) -> f32x16<S> {
        f32x16::splat(simd, 1.0)
    }
}

impl<S: Simd> Attenuate<S> for Near<S> {
    const WATER: bool = true;

    #[inline(always)]
    fn at<const SCALED: bool>(&self, simd: S, q: usize, deviation: f32x16<S>) -> f32x16<S> {
        let c = |v: f32| f32x16::splat(simd, v);
        let x = deviation * self.0.z;
        let k = &self.0.coefficients;
        c(k[3][q]).mul_add(x, c(k[2][q])).mul_add(x, c(k[1][q])).mul_add(x, c(k[0][q]))
    }
}

impl<S: Simd> Attenuate<S> for Far<S> {
    const WATER: bool = true;

    #[inline(always)]
    fn at<const SCALED: bool>(&self, simd: S, q: usize, deviation: f32x16<S>) -> f32x16<S> {
        let c = |v: f32| f32x16::splat(simd, v);
        let e = exp2_lanes(simd, deviation.mul_add(self.0.z, c(self.0.exponent[q])));
        if SCALED { e * c(self.0.scale[q]) } else { e }
    }
}

/// The exponentials of one Gaussian in one tile; see the scalar `Decay`. The quantities are attenuation
/// rgb, then backscatter rgb.
struct Decay<S: Simd> {
    z: f32x16<S>,
    /// `factor · scale · q_j`; unused in the full exponential.
    coefficients: [Lanes; 4],
    exponent: Lanes,
    scale: Lanes,
}

impl<S: Simd> Decay<S> {
    #[inline(always)]
    fn new(simd: S, water: &TileWater, z: f32, color: [f32; 3]) -> Self {
        let mut scale = [1.0; TILE];
        scale[..3].copy_from_slice(&color);
        let depth = f32x16::splat(simd, z);
        let exponent = load(simd, &water.centre) * depth;
        let factor = exp2_lanes(simd, exponent) * load(simd, &scale);
        let [_, q1, q2, q3] = SMALL_COEFFICIENTS;
        let coefficients = [
            factor.to_array(),
            (factor * f32x16::splat(simd, q1)).to_array(),
            (factor * f32x16::splat(simd, q2)).to_array(),
            (factor * f32x16::splat(simd, q3)).to_array(),
        ];
        Self { z: depth, coefficients, exponent: exponent.to_array(), scale }
    }
}
