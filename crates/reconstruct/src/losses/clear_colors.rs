//! Clear colours are moderate, and grey in the mean: SeaSplat's priors on saturation and on a grey world.
//!
//! ```text
//! saturation = mean (max(−J, 0) + max(J − 0.7, 0))²
//! grey world = ⅓ Σ_c (mean J_c − ½)²
//! ```
//!
//! `J` is the clear image. Means run over all pixels of the view.

use rayon::prelude::*;
use use3d_capture::Image;
use use3d_numerics::sums::sum;

use super::{LossTerm, LossValue, Observation, Term, ViewGradients};
use crate::ReconstructParams;

/// The row of both values.
pub(super) const TERM: LossTerm = LossTerm {
    values: &[
        LossValue {
            name: "saturation_prior",
            weight: |params, step| after(params, step, params.priors.saturation),
        },
        LossValue {
            name: "grey_world_prior",
            weight: |params, step| after(params, step, params.priors.grey_world),
        },
    ],
    term: || Box::new(ClearColors),
};

fn after(params: &ReconstructParams, step: u64, weight: f64) -> f64 {
    if params.has_water(step) { weight } else { 0.0 }
}

/// The clear colour up to which nothing is too bright.
const BRIGHT: f32 = 0.7;

/// Both terms.
struct ClearColors;

/// The part of a colour outside the range, with its sign.
fn outside(value: f32) -> f32 {
    value.min(0.0) + (value - BRIGHT).max(0.0)
}

impl ClearColors {
    /// Returns both values; overwrites `gradient` with that of their weighted sum.
    fn evaluate(clear: &Image, weights: &[f64], gradient: &mut Image) -> [f64; 2] {
        gradient.resize(clear.width(), clear.height());
        let pixels = clear.pixels().max(1);
        let count = (3 * pixels) as f64;
        let mut values = [0.0; 2];
        let planes = clear.data().chunks_exact(pixels).zip(gradient.data_mut().chunks_exact_mut(pixels));
        for (plane, gradient) in planes {
            let off = sum(pixels, |i| f64::from(plane[i])) / pixels as f64 - 0.5;
            values[0] += sum(pixels, |i| f64::from(outside(plane[i]) * outside(plane[i]))) / count;
            values[1] += off * off / 3.0;
            let scale = (2.0 * weights[0] / count) as f32;
            let grey = (2.0 * weights[1] * off / count) as f32;
            gradient.par_iter_mut().zip(plane).for_each(|(g, v)| *g = scale * outside(*v) + grey);
        }
        values
    }
}

impl Term for ClearColors {
    fn reads_clear(&self) -> bool {
        true
    }

    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        let Some(clear) = seen.clear else { return };
        let found = gradients.clear.add(|g| Self::evaluate(clear, weights, g));
        for (value, (found, weight)) in values.iter_mut().zip(found.into_iter().zip(weights)) {
            *value = (*weight > 0.0).then_some(found);
        }
    }
}
