//! Inverse depth that agrees with a prior and varies little: two terms of 3D-UIR.
//!
//! ```text
//! q = A / D, 0 if D ≤ 1e-6                        inverse depth of a pixel: its opacity and expected depth
//! t = (p − med p) · mad q / mad p + med q         the prior in units of the inverse depth
//! L_prior = mean |q − t|                          over pixels with a finite, positive prior and D > 0
//! L_variation = mean |q(x+1, y) − q(x, y)| + mean |q(x, y+1) − q(x, y)|
//! ```
//!
//! `med` is the median and `mad` the mean absolute deviation from it, both over the same pixels. The fit of
//! scale and offset has no gradient. With fewer than 32 pixels, or a prior without deviation, `L_prior = 0`.

use use3d_capture::Map;

use super::depth::{FEWEST_PIXELS, known};
use super::{LossTerm, LossValue, Observation, Term, ViewGradients};
use crate::{DepthPrior, ReconstructParams};

/// The row of both terms.
pub(super) const TERM: LossTerm = LossTerm {
    values: &[
        LossValue { name: "inverse_depth_l1", weight: prior_weight },
        LossValue { name: "depth_variation", weight: variation_weight },
    ],
    term: || Box::new(InverseDepth::default()),
};

fn prior_weight(params: &ReconstructParams, _step: u64) -> f64 {
    if params.depth_prior == DepthPrior::Off { 0.0 } else { params.inverse_depth_weight }
}

/// The variation counts from the end of the warm-up on.
fn variation_weight(params: &ReconstructParams, step: u64) -> f64 {
    if step < params.warm_up() { 0.0 } else { params.variation_weight }
}

/// Below this depth nothing is hit.
const NEAREST: f32 = 1e-6;
/// The smallest mean deviation of a prior, as a share of its largest value.
const FLAT: f64 = 1e-9;

/// Both terms with their buffers.
#[derive(Clone, Debug, Default)]
pub(super) struct InverseDepth {
    inverse: Vec<f32>,
    sorted: Vec<f32>,
    /// Gradient with respect to the inverse depth.
    d_inverse: Vec<f32>,
}

/// The median and the mean absolute deviation from it. `values` are reordered.
fn spread(values: &mut [f32]) -> (f64, f64) {
    let middle = values.len() / 2;
    let (.., median, _) = values.select_nth_unstable_by(middle, f32::total_cmp);
    let median = f64::from(*median);
    let sum: f64 = values.iter().map(|v| (f64::from(*v) - median).abs()).sum();
    (median, sum / values.len() as f64)
}

impl InverseDepth {
    /// Starts a view.
    fn begin(&mut self, depth: &Map, accumulation: &Map) {
        let pixels = depth.data().iter().zip(accumulation.data());
        self.inverse.clear();
        self.inverse.extend(pixels.map(|(d, a)| if *d > NEAREST { a / d } else { 0.0 }));
        self.d_inverse.clear();
        self.d_inverse.resize(self.inverse.len(), 0.0);
    }

    /// Adds `weight` times the gradient of the distance from the prior; returns the distance.
    fn add_prior(&mut self, depth: &Map, prior: &Map, weight: f64) -> f64 {
        let Self { inverse, sorted, d_inverse } = self;
        let counts = || depth.data().iter().zip(prior.data()).map(|(d, p)| known(*d, *p));
        let mut of = |values: &[f32]| {
            sorted.clear();
            sorted.extend(values.iter().zip(counts()).filter(|(_, counts)| *counts).map(|(v, _)| *v));
            if sorted.len() < FEWEST_PIXELS { None } else { Some((sorted.len(), spread(sorted))) }
        };
        let (Some((n, (middle_q, spread_q))), Some((_, (middle_p, spread_p)))) =
            (of(inverse), of(prior.data()))
        else {
            return 0.0;
        };
        if spread_p <= FLAT * middle_p {
            return 0.0;
        }
        let (scale, each) = (spread_q / spread_p, weight / n as f64);
        let mut sum = 0.0;
        let pixels = inverse.iter().zip(prior.data()).zip(d_inverse).zip(counts());
        for (((q, p), d_q), _) in pixels.filter(|(_, counts)| *counts) {
            let error = f64::from(*q) - ((f64::from(*p) - middle_p) * scale + middle_q);
            sum += error.abs();
            if error != 0.0 {
                *d_q += (each * error.signum()) as f32;
            }
        }
        sum / n as f64
    }

    /// Adds `weight` times the gradient of the variation; returns the variation.
    fn add_variation(&mut self, width: usize, weight: f64) -> f64 {
        let Self { inverse, d_inverse, .. } = self;
        let height = inverse.len() / width.max(1);
        let mut total = 0.0;
        for (step, pairs) in
            [(1, width.saturating_sub(1) * height), (width, width * height.saturating_sub(1))]
        {
            let (mut sum, each) = (0.0, (weight / pairs.max(1) as f64) as f32);
            for i in 0..inverse.len().saturating_sub(step) {
                if step == 1 && i % width == width - 1 {
                    continue;
                }
                let difference = inverse[i + step] - inverse[i];
                sum += f64::from(difference.abs());
                if difference != 0.0 {
                    d_inverse[i + step] += each * difference.signum();
                    d_inverse[i] -= each * difference.signum();
                }
            }
            total += sum / pairs.max(1) as f64;
        }
        total
    }

    /// Writes the gradient with respect to the inverse depth over the depth, times a function of the inverse
    /// depth.
    fn write(&self, depth: &Map, times: impl Fn(f32) -> f32, out: &mut Map) {
        out.resize(depth.width(), depth.height());
        let pixels = depth.data().iter().zip(&self.inverse).zip(&self.d_inverse);
        for (out, ((d, q), g)) in out.data_mut().iter_mut().zip(pixels) {
            *out = if *d > NEAREST { g / d * times(*q) } else { 0.0 };
        }
    }
}

impl Term for InverseDepth {
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        self.begin(seen.depth, seen.accumulation);
        if let Some(prior) = seen.target.prior.as_ref().filter(|_| weights[0] > 0.0) {
            values[0] = Some(self.add_prior(seen.depth, prior, weights[0]));
        }
        if weights[1] > 0.0 {
            values[1] = Some(self.add_variation(seen.depth.width(), weights[1]));
        }
        gradients.depth.add(|out| self.write(seen.depth, |q| -q, out));
        gradients.accumulation.add(|out| self.write(seen.depth, |_| 1.0, out));
    }
}
