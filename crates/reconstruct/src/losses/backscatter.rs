//! A photograph without its backscatter is dark, and not below zero: SeaSplat's prior on backscatter, after the
//! dark-channel prior.
//!
//! ```text
//! r = I − c_m (1 − e^{−β_bs ẑ})
//! L = mean max(r, 0) + 1000 mean h(max(−r, 0))      h(x) = x² / 0.4 below 0.2, and x − 0.1 above
//! ```
//!
//! `I` is the photograph. [`DepthRange`] defines the normalised distance `ẑ`, which has no gradient here. So the
//! term moves the water alone. A mask multiplies `r`.

use rayon::prelude::*;
use use3d_capture::MediumMaps;
use use3d_numerics::math;
use use3d_numerics::sums::sum;
use use3d_splat::DepthRange;

use super::{LossTerm, LossValue, Observation, Term, ViewGradients};
use crate::ReconstructParams;

/// The row of the term.
pub(super) const TERM: LossTerm =
    LossTerm { values: &[LossValue { name: "backscatter", weight }], term: || Box::new(DarkRest) };

fn weight(params: &ReconstructParams, step: u64) -> f64 {
    if step < params.water_begins() { 0.0 } else { params.priors.backscatter }
}

/// The factor of values below zero.
const BELOW: f64 = 1000.0;
/// The value up to which their error is quadratic.
const SMOOTH: f64 = 0.2;

/// The term.
struct DarkRest;

/// The error of what is left of a pixel's channel, and its derivative.
fn error(rest: f64) -> (f64, f64) {
    match -rest {
        below if below <= 0.0 => (rest, if rest > 0.0 { 1.0 } else { 0.0 }),
        below if below < SMOOTH => (BELOW * below * below / (2.0 * SMOOTH), -BELOW * below / SMOOTH),
        below => (BELOW * (below - 0.5 * SMOOTH), -BELOW),
    }
}

impl DarkRest {
    fn evaluate(
        seen: &Observation<'_>,
        water: &MediumMaps,
        weight: f64,
        gradients: &mut ViewGradients,
    ) -> f64 {
        let (width, height) = (seen.depth.width(), seen.depth.height());
        let pixels = seen.depth.pixels().max(1);
        let range = DepthRange::of(seen.depth, seen.accumulation);
        let (color, backscatter) = (water.color.data(), water.backscatter.data());
        let photograph = seen.target.image.data();
        let count = photograph.len().max(1) as f64;
        let mask = seen.target.mask.as_ref().map(|mask| mask.data());
        // Distance, e^{−β ẑ}, and the error of the rest with its derivative.
        let at = |i: usize| {
            let p = i % pixels;
            let z = f64::from(range.at(seen.depth.data()[p], seen.accumulation.data()[p]));
            let kept = math::exp(-f64::from(backscatter[i]) * z);
            let counted = mask.map_or(1.0, |mask| f64::from(mask[p]));
            let (value, slope) =
                error(counted * (f64::from(photograph[i]) - f64::from(color[i]) * (1.0 - kept)));
            (z, kept, value, weight / count * counted * slope)
        };
        gradients.water_color.add(|g| {
            g.resize(width, height);
            g.data_mut().par_iter_mut().enumerate().for_each(|(i, g)| {
                let (_, kept, _, slope) = at(i);
                *g = (-slope * (1.0 - kept)) as f32;
            });
        });
        gradients.backscatter.add(|g| {
            g.resize(width, height);
            g.data_mut().par_iter_mut().enumerate().for_each(|(i, g)| {
                let (z, kept, _, slope) = at(i);
                *g = (-slope * f64::from(color[i]) * z * kept) as f32;
            });
        });
        sum(photograph.len(), |i| at(i).2) / count
    }
}

impl Term for DarkRest {
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        values[0] = seen.water.map(|water| Self::evaluate(seen, water, weights[0], gradients));
    }
}
