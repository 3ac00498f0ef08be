//! Reg-L1 and Reg-MS-SSIM in one computation: one pass before the structure measure and one after it.
//! [`Photometric`] names the same two with one level, and without the weight.
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
//! With a good fit, `W Î` is nearly 1 and `W I` is the ratio of target to prediction. So the
//! structure term measures relative error, and its variances would cancel in f32. Both are therefore
//! computed *minus one* without ever being near one: `W Î − 1 = −ε W` and `W I − 1 = W (I − Î) − ε W`. The
//! first also carries `W` to the last pass, which needs no other image.
//!
//! A mask multiplies prediction and target before anything else, so that a pixel that does not count adds
//! nothing to either term and has no gradient. The means of the loss stay over all pixels, so that a view
//! weighs by the share of its pixels that count. The reported squared error is a mean over the pixels that
//! count, weighted by the mask's square.

use fearless_simd::prelude::*;
use fearless_simd::{Level, Simd, dispatch, f32x16};
use rayon::prelude::*;
use use3d_capture::{Image, Map};
use use3d_metrics::ms_ssim::{MsSsim, RECONSTRUCTION_WEIGHTS};
use use3d_numerics::rows::{LANES, load, store};

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
/// Elements per task.
const BLOCK: usize = 1 << 14;

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
    /// `W Î − 1` and `W I − 1`.
    prediction: Image,
    target: Image,
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
            prediction: Image::new(0, 0),
            target: Image::new(0, 0),
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
        self.prediction.resize(w, h);
        self.target.resize(w, h);
        let (level, relative) = (Level::new(), self.relative);
        let n = w * h;
        let count = (3 * n) as f64;
        let mask = mask.map(Map::data);

        let blocks_per_plane = n.div_ceil(BLOCK);
        let inputs = prediction.data().chunks(n.max(1)).zip(target.data().chunks(n.max(1)));
        let outputs =
            self.prediction.data_mut().chunks_mut(n.max(1)).zip(self.target.data_mut().chunks_mut(n.max(1)));
        let tasks: Vec<_> = inputs
            .zip(outputs)
            .flat_map(|((p, t), (x, y))| {
                let inputs = p.chunks(BLOCK).zip(t.chunks(BLOCK));
                inputs.zip(x.chunks_mut(BLOCK).zip(y.chunks_mut(BLOCK)))
            })
            .collect();
        let partial: Vec<[f64; 2]> = tasks
            .into_par_iter()
            .enumerate()
            .map(|(task, ((p, t), (x, y)))| {
                let from = (task % blocks_per_plane) * BLOCK;
                let mask = mask.map(|m| &m[from..from + p.len()]);
                match relative {
                    true => dispatch!(level, simd => weigh::<_, true>(simd, p, t, mask, x, y)),
                    false => dispatch!(level, simd => weigh::<_, false>(simd, p, t, mask, x, y)),
                }
            })
            .collect();
        let reg_l1 = partial.iter().map(|s| s[0]).sum::<f64>() / count;
        let counted = mask
            .map_or(n as f64, |m| use3d_numerics::sums::sum(m.len(), |i| f64::from(m[i]) * f64::from(m[i])));
        let squared = partial.iter().map(|s| s[1]).sum::<f64>();
        let squared_error = if counted > 0.0 { squared / (3.0 * counted) } else { 0.0 };

        let offset = if relative { 1.0 } else { 0.0 };
        let similarity =
            self.measure.value_and_gradient(&self.prediction, &self.target, offset, &self.weights, gradient);
        let reg_ms_ssim = 1.0 - similarity;

        let [l1_weight, structure_weight] = self.shares;
        let absolute = (l1_weight / count) as f32;
        let structure = -structure_weight as f32;
        gradient
            .data_mut()
            .par_chunks_mut(n.max(1))
            .zip(self.prediction.data().par_chunks(n.max(1)).zip(self.target.data().par_chunks(n.max(1))))
            .for_each(|(g, (x, y))| {
                g.par_chunks_mut(BLOCK)
                    .zip(x.par_chunks(BLOCK).zip(y.par_chunks(BLOCK)))
                    .enumerate()
                    .for_each(|(block, (g, (x, y)))| {
                        let mask = mask.map(|m| &m[block * BLOCK..][..g.len()]);
                        let shares = [absolute, structure];
                        match relative {
                            true => {
                                dispatch!(level, simd => backward::<_, true>(simd, x, y, mask, shares, g));
                            }
                            false => {
                                dispatch!(level, simd => backward::<_, false>(simd, x, y, mask, shares, g));
                            }
                        }
                    });
            });
        let total = l1_weight * reg_l1 + structure_weight * reg_ms_ssim;
        self.squared_error = squared_error;
        PhotometricValue { total, reg_l1, reg_ms_ssim, squared_error }
    }
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

/// Computes `x = W Î − 1`, `y = W I − 1`, and the sums of `|W (Î − I)|` and of the squared error. Lanes
/// past the end add nothing. Without a weight, `x = Î` and `y = I`.
#[inline(always)]
fn weigh<S: Simd, const RELATIVE: bool>(
    simd: S,
    prediction: &[f32],
    target: &[f32],
    mask: Option<&[f32]>,
    x: &mut [f32],
    y: &mut [f32],
) -> [f64; 2] {
    let zero = f32x16::splat(simd, 0.0);
    let one = f32x16::splat(simd, 1.0);
    let (mut absolute, mut squared) = (zero, zero);
    for i in (0..prediction.len()).step_by(LANES) {
        let (mut p, mut t) = (load(simd, prediction, i), load(simd, target, i));
        if let Some(mask) = mask {
            let m = load(simd, mask, i);
            (p, t) = (p * m, t * m);
        }
        let off = if RELATIVE {
            let w = one / (p.max(zero) + EPSILON);
            let off = w * (t - p);
            let from_one = w * -EPSILON;
            store(from_one, x, i);
            store(off + from_one, y, i);
            off
        } else {
            store(p, x, i);
            store(t, y, i);
            t - p
        };
        absolute += off.abs();
        let e = p.max(zero).min(one) - t;
        squared = e.mul_add(e, squared);
    }
    [absolute, squared].map(|v| v.as_slice().iter().map(|&v| f64::from(v)).sum())
}

/// `g ← m W ((1 − λ)/N sign(Î − I) − λ g)`, where `W = −x / ε` or 1, and the sign is that of `x − y`.
#[inline(always)]
fn backward<S: Simd, const RELATIVE: bool>(
    simd: S,
    x: &[f32],
    y: &[f32],
    mask: Option<&[f32]>,
    [absolute, structure]: [f32; 2],
    g: &mut [f32],
) {
    let zero = f32x16::splat(simd, 0.0);
    let (plus, minus) = (f32x16::splat(simd, absolute), f32x16::splat(simd, -absolute));
    for i in (0..g.len()).step_by(LANES) {
        let (a, b) = (load(simd, x, i), load(simd, y, i));
        let mut w = if RELATIVE { a * (-1.0 / EPSILON) } else { f32x16::splat(simd, 1.0) };
        if let Some(mask) = mask {
            w *= load(simd, mask, i);
        }
        let sign = a.simd_gt(b).select(plus, a.simd_lt(b).select(minus, zero));
        let slope = load(simd, g, i).mul_add(structure, sign);
        store(w * slope, g, i);
    }
}
