//! Pixels that look like open water are transparent: SeaSplat's prior on the background.
//!
//! ```text
//! L = mean of A over the pixels with |C − c_m| < 0.2 √3
//! ```
//!
//! `A` is the accumulated weight and `C` the colour of the image. Before there is water, `c_m` is the
//! background, and its light `c_m (1 − A)` is no part of `C`. The choice of pixels has no gradient.

use use3d_capture::{Formation, Map, MediumMaps};
use use3d_numerics::sums::sums;

use super::{LossTerm, LossValue, Observation, Term, ViewGradients};

/// The row of the term.
pub(super) const TERM: LossTerm = LossTerm {
    values: &[LossValue { name: "background_prior", weight: |params, _| params.priors.background }],
    term: || Box::new(Background),
};

/// The square of the distance between colours that look alike.
const ALIKE: f32 = 0.2 * 0.2 * 3.0;

/// The term.
struct Background;

impl Background {
    /// Returns the loss; overwrites `gradient` with `weight` times its gradient with respect to
    /// accumulation.
    fn evaluate(seen: &Observation<'_>, water: &MediumMaps, weight: f64, gradient: &mut Map) -> f64 {
        let pixels = seen.accumulation.pixels();
        let (image, far, accumulation) = (seen.image.data(), water.color.data(), seen.accumulation.data());
        let behind = water.formation == Formation::PerGaussian;
        let open = |i: usize| {
            let distance = |c: usize| {
                let (color, far) = (image[c * pixels + i], far[c * pixels + i]);
                let light = if behind { far * (1.0 - accumulation[i]) } else { 0.0 };
                (color - light - far) * (color - light - far)
            };
            distance(0) + distance(1) + distance(2) < ALIKE
        };
        let [count, total] = sums::<2>(pixels, |i, sums| {
            if open(i) {
                sums[0] += 1.0;
                sums[1] += f64::from(accumulation[i]);
            }
        });
        let each = (weight / count.max(1.0)) as f32;
        gradient.resize(seen.depth.width(), seen.depth.height());
        for (i, g) in gradient.data_mut().iter_mut().enumerate() {
            *g = if open(i) { each } else { 0.0 };
        }
        total / count.max(1.0)
    }
}

impl Term for Background {
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        let Some(water) = seen.water else { return };
        values[0] = Some(gradients.accumulation.add(|g| Self::evaluate(seen, water, weights[0], g)));
    }
}
