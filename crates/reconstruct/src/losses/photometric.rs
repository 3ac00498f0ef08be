//! Reg-L1 and Reg-MS-SSIM in one computation: the structure measure reads the weighed images, and its
//! gradient becomes that of the loss, row by row. [`Photometric`] names the same two with one level, and
//! without the weight.
//!
//! ```text
//! W = 1 / (sg(Î) + ε),  ε = 1e-3                      per pixel and channel, no gradient
//! Reg-L1 = mean |W (Î − I)|                            (R13)
//! Reg-MS-SSIM = 1 − MS-SSIM(W I, W Î)                   (R12)
//! L = (1 − λ) Reg-L1 + λ Reg-MS-SSIM
//! ```
//!
//! `reg-ssim` has one level in place of three, as in WaterSplatting. `ssim` also has `W = 1`, as in 3DGS.
//!
//! With a good fit, `W Î` is nearly 1 and `W I` is the ratio of target to prediction. So the structure term
//! measures relative error, and its variances would cancel in f32. Both are therefore computed *minus one*
//! without ever being near one: `W Î − 1 = −ε W` and `W I − 1 = W (I − Î) − ε W`. Neither is stored: they are
//! computed where they are read.
//!
//! A mask multiplies prediction and target before anything else, so that a pixel that does not count adds
//! nothing to either term and has no gradient. The means of the loss stay over all pixels, so that a view
//! weighs by the share of its pixels that count. The reported squared error is a mean over the pixels that
//! count, weighted by the mask's square.

use fearless_simd::prelude::*;
use fearless_simd::{Level, Simd, dispatch, f32x16};
use use3d_capture::{Image, Map};
use use3d_metrics::ms_ssim::{MsSsim, Pair, RECONSTRUCTION_WEIGHTS};
use use3d_numerics::rows::{LANES, load, store};
use use3d_numerics::sums::sum;

use super::{LossTerm, LossValue, Observation, Term, ViewGradients};
use crate::{Photometric, ReconstructParams};

/// The rows of the photometric values, one for each [`Photometric`].
pub(super) const TERM: LossTerm = LossTerm {
    values: &[
        LossValue { name: "reg_l1", weight: |params, step| absolute(params, Photometric::RegMsSsim, step) },
        LossValue {
            name: "reg_ms_ssim",
            weight: |params, step| structure(params, Photometric::RegMsSsim, step),
        },
    ],
    term: || Box::new(PhotometricLoss::new(0.0)),
};
pub(super) const ONE_LEVEL: LossTerm = LossTerm {
    values: &[
        LossValue {
            name: "relative_l1",
            weight: |params, step| absolute(params, Photometric::RegSsim, step),
        },
        LossValue {
            name: "relative_ssim",
            weight: |params, step| structure(params, Photometric::RegSsim, step),
        },
    ],
    term: || Box::new(PhotometricLoss::of(Photometric::RegSsim, 0.0)),
};
pub(super) const PLAIN: LossTerm = LossTerm {
    values: &[
        LossValue { name: "plain_l1", weight: |params, step| absolute(params, Photometric::Ssim, step) },
        LossValue { name: "plain_ssim", weight: |params, step| structure(params, Photometric::Ssim, step) },
    ],
    term: || Box::new(PhotometricLoss::of(Photometric::Ssim, 0.0)),
};

fn absolute(params: &ReconstructParams, of: Photometric, step: u64) -> f64 {
    if chosen(params, step) == of { 1.0 - params.structure_weight } else { 0.0 }
}

fn structure(params: &ReconstructParams, of: Photometric, step: u64) -> f64 {
    if chosen(params, step) == of { params.structure_weight } else { 0.0 }
}

/// The comparison of a step: that of the images themselves while errors are not relative.
fn chosen(params: &ReconstructParams, step: u64) -> Photometric {
    let plain = (step as f64) < params.plain_until * params.course() as f64;
    if plain { Photometric::Ssim } else { params.photometric }
}

/// `ε` of the weight.
const EPSILON: f32 = 1e-3;
/// The offset of images without a weight, which keeps their variances from cancelling.
const CENTER: f32 = 0.5;

/// The values of one evaluation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PhotometricValue {
    /// `(1 − λ) Reg-L1 + λ Reg-MS-SSIM`.
    pub total: f64,
    /// Reg-L1.
    pub reg_l1: f64,
    /// Reg-MS-SSIM.
    pub reg_ms_ssim: f64,
    /// Mean squared error of the prediction clamped to `[0, 1]` over the pixels that count, for a PSNR; 0
    /// if no pixel counts.
    pub squared_error: f64,
}

/// The loss with its scratch images.
#[derive(Clone, Debug)]
pub struct PhotometricLoss {
    /// Weights of Reg-L1 and of Reg-MS-SSIM.
    shares: [f64; 2],
    /// True if errors count relative to the rendered light: W.
    relative: bool,
    /// Weights of the structure measure's levels.
    pub(super) weights: Vec<f64>,
    measure: MsSsim,
    squared_error: f64,
}

impl PhotometricLoss {
    /// The loss with structure weight `lambda` and the method's three levels.
    pub fn new(lambda: f64) -> Self {
        Self::of(Photometric::RegMsSsim, lambda)
    }

    /// A loss with structure weight `lambda`.
    pub fn of(which: Photometric, lambda: f64) -> Self {
        let levels = if which == Photometric::RegMsSsim { &RECONSTRUCTION_WEIGHTS[..] } else { &[1.0] };
        Self {
            shares: [1.0 - lambda, lambda],
            relative: which != Photometric::Ssim,
            weights: levels.to_vec(),
            measure: MsSsim::default(),
            squared_error: 0.0,
        }
    }

    /// Returns the value and computes the gradient with respect to `prediction`. The images (and the mask,
    /// weights in `[0, 1]`) have one size.
    pub fn evaluate(
        &mut self,
        prediction: &Image,
        target: &Image,
        mask: Option<&Map>,
        gradient: &mut Image,
    ) -> PhotometricValue {
        let (w, h) = (prediction.width(), prediction.height());
        assert_eq!((w, h), (target.width(), target.height()), "the loss compares images of one size");
        let count = (3 * w * h) as f64;
        let [l1_weight, structure_weight] = self.shares;
        let absolute = (l1_weight / count) as f32;
        let structure = -structure_weight as f32;
        let shares = [absolute, structure];
        let (levels, measure) = (&self.weights, &mut self.measure);
        let (similarity, sums) = match self.relative {
            true => weighed::<true>(measure, levels, [prediction, target], mask, shares, gradient),
            false => weighed::<false>(measure, levels, [prediction, target], mask, shares, gradient),
        };
        let [reg_l1, squared] = [0, 1].map(|of| sums.iter().map(|sum| sum[of]).sum::<f64>());
        let reg_l1 = reg_l1 / count;
        let square = |m: &Map| sum(m.pixels(), |i| f64::from(m.data()[i]) * f64::from(m.data()[i]));
        let counted = mask.map_or((w * h) as f64, square);
        let squared_error = if counted > 0.0 { squared / (3.0 * counted) } else { 0.0 };
        let reg_ms_ssim = 1.0 - similarity;
        let total = l1_weight * reg_l1 + structure_weight * reg_ms_ssim;
        self.squared_error = squared_error;
        PhotometricValue { total, reg_l1, reg_ms_ssim, squared_error }
    }
}

/// The structure measure of the weighed images, the loss's gradient, and the [sums](Weighed::finish) of each
/// row.
fn weighed<const RELATIVE: bool>(
    measure: &mut MsSsim,
    levels: &[f64],
    images: [&Image; 2],
    mask: Option<&Map>,
    shares: [f32; 2],
    gradient: &mut Image,
) -> (f64, Vec<[f64; 2]>) {
    let pair = Weighed::<'_, RELATIVE> { images, mask };
    let offset = if RELATIVE { 1.0 } else { CENTER };
    let level = Level::new();
    measure.of_pair(
        &pair,
        offset,
        levels,
        gradient,
        |channel, row, gradient| dispatch!(level, simd => pair.finish(simd, channel, row, shares, gradient)),
    )
}

impl Term for PhotometricLoss {
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        self.shares = [weights[0], weights[1]];
        let (target, mask) = (&seen.target.image, seen.target.mask.as_ref());
        let value = gradients.image.add(|g| PhotometricLoss::evaluate(self, seen.image, target, mask, g));
        values.copy_from_slice(&[Some(value.reg_l1), Some(value.reg_ms_ssim)]);
    }

    fn squared_error(&self) -> Option<f64> {
        Some(self.squared_error)
    }
}

/// Prediction and target as the structure measure reads them: `x = W Î − 1` and `y = W I − 1`. Without a
/// weight, `x = Î − ½` and `y = I − ½`.
struct Weighed<'a, const RELATIVE: bool> {
    images: [&'a Image; 2],
    mask: Option<&'a Map>,
}

impl<const RELATIVE: bool> Weighed<'_, RELATIVE> {
    /// `g ← m W ((1 − λ)/N sign(Î − I) − λ g)` for a row; returns the sums of `|W (Î − I)|` and of the
    /// squared error over the row.
    #[inline(always)]
    fn finish<S: Simd>(
        &self,
        simd: S,
        channel: usize,
        row: usize,
        [absolute, structure]: [f32; 2],
        g: &mut [f32],
    ) -> [f64; 2] {
        let (zero, one) = (f32x16::splat(simd, 0.0), f32x16::splat(simd, 1.0));
        let (plus, minus) = (f32x16::splat(simd, absolute), f32x16::splat(simd, -absolute));
        let (mut far, mut squared) = (zero, zero);
        let row = self.row(channel, row);
        for i in (0..g.len()).step_by(LANES) {
            let [p, t, mut w] = weighed_lanes::<_, RELATIVE>(simd, &row, i);
            far += (w * (t - p)).abs();
            let error = p.max(zero).min(one) - t;
            squared = error.mul_add(error, squared);
            if let Some(mask) = row.1 {
                w *= load(simd, mask, i);
            }
            let sign = p.simd_gt(t).select(plus, p.simd_lt(t).select(minus, zero));
            let slope = load(simd, g, i).mul_add(structure, sign);
            store(w * slope, g, i);
        }
        [far, squared].map(|sums| sums.as_slice().iter().map(|v| f64::from(*v)).sum())
    }
}

/// Sixteen pixels of prediction, target and weight; zeros and a finite weight beyond the end of the row.
#[inline(always)]
fn weighed_lanes<S: Simd, const RELATIVE: bool>(
    simd: S,
    ([p, t], mask): &([&[f32]; 2], Option<&[f32]>),
    from: usize,
) -> [f32x16<S>; 3] {
    let (mut p, mut t) = (load(simd, p, from), load(simd, t, from));
    if let Some(mask) = mask {
        let m = load(simd, mask, from);
        (p, t) = (p * m, t * m);
    }
    let one = f32x16::splat(simd, 1.0);
    [p, t, if RELATIVE { one / (p.max(f32x16::splat(simd, 0.0)) + EPSILON) } else { one }]
}

impl<const RELATIVE: bool> Pair for Weighed<'_, RELATIVE> {
    type Row<'a>
        = ([&'a [f32]; 2], Option<&'a [f32]>)
    where
        Self: 'a;

    fn size(&self) -> (usize, usize) {
        (self.images[0].width(), self.images[0].height())
    }

    #[inline(always)]
    fn row(&self, channel: usize, row: usize) -> Self::Row<'_> {
        let [p, t] = self.images;
        ([p.row(channel, row), t.row(channel, row)], self.mask.map(|mask| mask.row(0, row)))
    }

    #[inline(always)]
    fn read<'a, S: Simd>(simd: S, row: &Self::Row<'a>, from: usize) -> [f32x16<S>; 2]
    where
        Self: 'a,
    {
        let [p, t, w] = weighed_lanes::<_, RELATIVE>(simd, row, from);
        if !RELATIVE {
            return [p - CENTER, t - CENTER];
        }
        let from_one = w * -EPSILON;
        [from_one, w.mul_add(t - p, from_one)]
    }
}
