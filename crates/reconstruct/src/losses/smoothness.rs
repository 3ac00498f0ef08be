//! Smoothness of depth except at edges, as in SeaSplat, 3D-UIR and MarineSTD-GS.
//!
//! ```text
//! L = mean |D(x+1, y) − D(x, y)| W_x  +  mean |D(x, y+1) − D(x, y)| W_y        W = e^{−|Δ g|}
//! by the prior:  W = q e^{−|Δ q|} + (1 − q) e^{−|Δ g|}
//! ```
//!
//! | symbol | meaning |
//! |---|---|
//! | D | expected depth; a pair of pixels with an empty one adds 0 |
//! | g | mean of the photograph's channels |
//! | q | depth prior by its largest value, 1 is nearest, at the first pixel of the pair; 0 is unknown |
//! | Δ | difference between the two pixels of the pair |
//!
//! SeaSplat's term is `L / (z_max − z_min)`, of depths that are [normalised](DepthRange) in each view.
//!
//! The second form is MarineSTD-GS's: near pixels have the edges of the prior, and far ones those of the
//! photograph. A view without a prior has the first form.

use rayon::prelude::*;
use use3d_capture::{Image, Map};
use use3d_numerics::math;
use use3d_splat::DepthRange;

use super::{LossTerm, LossValue, Observation, Term, ViewGradients};
use crate::ReconstructParams;

/// The rows of the smoothness terms: with the photograph's edges, with those of the prior, and of normalised
/// depths.
pub(super) const TERM: LossTerm = LossTerm {
    values: &[LossValue {
        name: "depth_smoothness",
        weight: |params, step| weight(params, step, [false; 2]),
    }],
    term: || Box::new(DepthSmoothness { by_prior: false, normalised: false }),
};
pub(super) const BY_PRIOR: LossTerm = LossTerm {
    values: &[LossValue {
        name: "adaptive_smoothness",
        weight: |params, step| weight(params, step, [true, false]),
    }],
    term: || Box::new(DepthSmoothness { by_prior: true, normalised: false }),
};
pub(super) const NORMALISED: LossTerm = LossTerm {
    values: &[LossValue {
        name: "normalised_smoothness",
        weight: |params, step| weight(params, step, [false, true]),
    }],
    term: || Box::new(DepthSmoothness { by_prior: false, normalised: true }),
};

fn weight(params: &ReconstructParams, step: u64, form: [bool; 2]) -> f64 {
    let chosen = [params.smoothness_by_prior, params.smoothness_normalised];
    let off = params.smoothness_weight == 0.0 || chosen != form;
    // A ceiling changes every depth at once, so the term waits for the scene to recover.
    let ceiling = |back| params.density_work(step - back, 0).ceiling.is_some();
    if off || (1..=params.smoothness_pause.min(step)).any(ceiling) { 0.0 } else { params.smoothness_weight }
}

/// The smoothness term.
#[derive(Clone, Copy, Debug)]
pub(super) struct DepthSmoothness {
    /// True if near pixels have the edges of the prior.
    pub(super) by_prior: bool,
    /// True if depths are normalised in each view.
    pub(super) normalised: bool,
}

/// The images whose edges count.
#[derive(Clone, Copy)]
struct Edges<'a> {
    photograph: &'a Image,
    /// The prior, and one by its largest value.
    prior: Option<(&'a Map, f32)>,
}

impl Edges<'_> {
    /// W of a pair of pixels, the first one at `a`.
    fn weight(&self, a: usize, b: usize) -> f32 {
        let light = |i: usize| (0..3).map(|c| self.photograph.plane(c)[i]).sum::<f32>() / 3.0;
        let of_light = math::exp(-(light(a) - light(b)).abs());
        let Some((prior, scale)) = self.prior else { return of_light };
        let near = |i: usize| Some(prior.data()[i]).filter(|q| counts(*q)).map_or(0.0, |q| scale * q);
        let q = near(a);
        q * math::exp(-(q - near(b)).abs()) + (1.0 - q) * of_light
    }
}

fn counts(value: f32) -> bool {
    value > 0.0 && value < f32::INFINITY
}

impl DepthSmoothness {
    /// Returns the loss; overwrites `gradient` with `weight` times its gradient with respect to `depth`.
    pub(super) fn evaluate(
        self,
        depth: &Map,
        photograph: &Image,
        prior: Option<&Map>,
        weight: f64,
        gradient: &mut Map,
    ) -> f64 {
        let (w, h) = (depth.width(), depth.height());
        let (across, down) = (1.0 / ((w - 1) * h).max(1) as f64, 1.0 / (w * (h - 1)).max(1) as f64);
        let prior = prior.filter(|_| self.by_prior).and_then(|prior| {
            let most = prior.data().iter().copied().filter(|q| counts(*q)).fold(0.0, f32::max);
            (most > 0.0).then(|| (prior, 1.0 / most))
        });
        let (edges, z) = (Edges { photograph, prior }, depth.data());
        // The weighted step of a pair, and the sign of its gradient at the second pixel.
        let pair = |a: usize, b: usize, share: f64| match counts(z[a]) && counts(z[b]) {
            true => (share * f64::from(edges.weight(a, b)), f64::from(z[b] - z[a])),
            false => (0.0, 0.0),
        };
        let slope = |(weight, step): (f64, f64)| if step == 0.0 { 0.0 } else { weight * step.signum() };
        gradient.resize(w, h);
        let rows: Vec<f64> = (gradient.data_mut().par_chunks_mut(w).enumerate())
            .map(|(y, row)| {
                let mut sum = 0.0;
                for (x, out) in row.iter_mut().enumerate() {
                    let i = y * w + x;
                    let mut total = 0.0;
                    if x > 0 {
                        total += slope(pair(i - 1, i, across));
                    }
                    if y > 0 {
                        total += slope(pair(i - w, i, down));
                    }
                    if x + 1 < w {
                        let next = pair(i, i + 1, across);
                        sum += next.0 * next.1.abs();
                        total -= slope(next);
                    }
                    if y + 1 < h {
                        let next = pair(i, i + w, down);
                        sum += next.0 * next.1.abs();
                        total -= slope(next);
                    }
                    *out = (weight * total) as f32;
                }
                sum
            })
            .collect();
        rows.iter().sum()
    }
}

impl Term for DepthSmoothness {
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        let (photograph, prior) = (&seen.target.image, seen.target.prior.as_ref());
        let value = gradients.depth.add(|g| {
            let value = DepthSmoothness::evaluate(*self, seen.depth, photograph, prior, weights[0], g);
            match self.normalised {
                true => DepthRange::of(seen.depth, seen.accumulation).per_extent(value, weights[0], g),
                false => value,
            }
        });
        values[0] = Some(value);
    }
}
