//! A photograph without its backscatter is dark, and not below zero: SeaSplat's prior on backscatter, after
//! the dark-channel prior.
//!
//! ```text
//! r = I − c_m (1 − e^{−β_bs ẑ})
//! L = mean max(r, 0) + 1000 mean h(max(−r, 0))      h(x) = x² / 0.4 below 0.2, and x − 0.1 above
//! ```
//!
//! `I` is the photograph. [`DepthRange`] defines the normalised distance `ẑ`, which has no gradient here. So
//! the term moves the water alone. A mask multiplies `r`.

use rayon::prelude::*;
use use3d_capture::{Image, MediumMaps};
use use3d_numerics::math;
use use3d_splat::DepthRange;

use super::{LossTerm, LossValue, Observation, Term, ViewGradients};
use crate::ReconstructParams;

/// The row of the term.
pub(super) const TERM: LossTerm = LossTerm {
    values: &[LossValue { name: "backscatter_prior", weight }],
    term: || Box::<DarkRest>::default(),
};

fn weight(params: &ReconstructParams, step: u64) -> f64 {
    if params.has_water(step) { params.priors.backscatter } else { 0.0 }
}

/// The factor of values below zero.
const BELOW: f64 = 1000.0;
/// The value up to which their error is quadratic.
const SMOOTH: f64 = 0.2;

/// Elements per task.
const BLOCK: usize = 1 << 13;

/// The term, with the gradients of its last view.
#[derive(Default)]
struct DarkRest {
    color: Image,
    backscatter: Image,
}

/// The error of what is left of a pixel's channel, and its derivative.
fn error(rest: f64) -> (f64, f64) {
    match -rest {
        below if below <= 0.0 => (rest, if rest > 0.0 { 1.0 } else { 0.0 }),
        below if below < SMOOTH => (BELOW * below * below / (2.0 * SMOOTH), -BELOW * below / SMOOTH),
        below => (BELOW * (below - 0.5 * SMOOTH), -BELOW),
    }
}

impl DarkRest {
    /// Returns the loss, and computes `weight` times its gradients with respect to colour and coefficient of
    /// the water.
    fn evaluate(&mut self, seen: &Observation<'_>, water: &MediumMaps, weight: f64) -> f64 {
        let (width, height, pixels) = (seen.depth.width(), seen.depth.height(), seen.depth.pixels());
        self.color.resize(width, height);
        self.backscatter.resize(width, height);
        let range = DepthRange::of(seen.depth, seen.accumulation);
        let (depth, accumulation) = (seen.depth.data(), seen.accumulation.data());
        let (color, backscatter) = (water.color.data(), water.backscatter.data());
        let photograph = seen.target.image.data();
        let count = photograph.len().max(1) as f64;
        let mask = seen.target.mask.as_ref().map(|mask| mask.data());
        let colors = self.color.data_mut().par_chunks_mut(BLOCK);
        let sums: Vec<f64> = colors
            .zip(self.backscatter.data_mut().par_chunks_mut(BLOCK))
            .enumerate()
            .map(|(block, (d_color, d_backscatter))| {
                let mut sum = 0.0;
                for (k, (d_color, d_backscatter)) in d_color.iter_mut().zip(d_backscatter).enumerate() {
                    let i = block * BLOCK + k;
                    let p = i % pixels;
                    let z = f64::from(range.at(depth[p], accumulation[p]));
                    let kept = math::exp(-f64::from(backscatter[i]) * z);
                    let counted = mask.map_or(1.0, |mask| f64::from(mask[p]));
                    let far = f64::from(color[i]);
                    let (value, slope) = error(counted * (f64::from(photograph[i]) - far * (1.0 - kept)));
                    let slope = -weight / count * counted * slope;
                    *d_color = (slope * (1.0 - kept)) as f32;
                    *d_backscatter = (slope * far * z * kept) as f32;
                    sum += value;
                }
                sum
            })
            .collect();
        sums.iter().sum::<f64>() / count
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
        let Some(water) = seen.water else { return };
        values[0] = Some(Self::evaluate(self, seen, water, weights[0]));
        gradients.water_color.add(|g| g.clone_from(&self.color));
        gradients.backscatter.add(|g| g.clone_from(&self.backscatter));
    }
}
