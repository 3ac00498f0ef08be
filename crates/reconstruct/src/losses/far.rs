//! Absolute error that counts more the farther away it is: SeaSplat's depth-weighted reconstruction loss.
//!
//! ```text
//! L = mean |ẑ (Î − I)|
//! ```
//!
//! [`DepthRange`] defines the normalised distance `ẑ`, which has no gradient here. A mask multiplies both
//! images.

use rayon::prelude::*;
use use3d_capture::Image;
use use3d_numerics::sums::sum;
use use3d_splat::DepthRange;

use super::{LossTerm, LossValue, Observation, Term, ViewGradients};

/// The row of the term.
pub(super) const TERM: LossTerm = LossTerm {
    values: &[LossValue { name: "far_l1", weight: |params, _| params.priors.far }],
    term: || Box::new(FarError),
};

/// The term.
struct FarError;

impl FarError {
    /// Returns the loss; overwrites `gradient` with `weight` times its gradient with respect to the image.
    fn evaluate(seen: &Observation<'_>, weight: f64, gradient: &mut Image) -> f64 {
        let (image, target) = (seen.image.data(), seen.target.image.data());
        let pixels = seen.depth.pixels().max(1);
        let count = image.len().max(1) as f64;
        let range = DepthRange::of(seen.depth, seen.accumulation);
        let mask = seen.target.mask.as_ref().map(|mask| mask.data());
        let share = |i: usize| {
            let at = i % pixels;
            range.at(seen.depth.data()[at], seen.accumulation.data()[at]) * mask.map_or(1.0, |mask| mask[at])
        };
        let step = (weight / count) as f32;
        gradient.resize(seen.depth.width(), seen.depth.height());
        gradient.data_mut().par_iter_mut().enumerate().for_each(|(i, g)| {
            let error = image[i] - target[i];
            *g = if error == 0.0 { 0.0 } else { step * share(i) * error.signum() };
        });
        sum(image.len(), |i| f64::from(share(i) * (image[i] - target[i]).abs())) / count
    }
}

impl Term for FarError {
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        values[0] = Some(gradients.image.add(|g| Self::evaluate(seen, weights[0], g)));
    }
}
