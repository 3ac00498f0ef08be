//! The expected error of an observation: `σ² = σ_0² + κ² t²`, with t the unevenness of the surface piece in
//! that view.
//!
//! The model is a regression with errors on both sides: near and far views of a point are both uncertain.
//! It is unbiased only if their errors have the right *ratio*. If a keypoint is off by a fraction of a
//! pixel, or a surface is seen at a slant, the mean of a textured piece changes. The change is a share of
//! the piece's unevenness, and it looks smaller through more water. If all errors were treated as equal,
//! the larger errors of near views would be read as signal, and attenuation would come out too strong.
//!
//! Both numbers are computed from the residuals: medians of absolute residuals (divided by
//! `√(1 − leverage)`, because each point's radiance was fitted to few observations) in classes of equal
//! counts of t, then a line through their squares.

use crate::formation::{Channel, Shared, square, terms};
use crate::solve::ChannelFit;
use use3d_numerics::order::median;

/// `σ_0` and `κ`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Noise {
    pub(crate) floor: f64,
    pub(crate) share: f64,
}

/// Number of classes of unevenness.
const CLASSES: usize = 16;
/// Standard deviation over median absolute deviation of a normal distribution.
const NORMAL: f64 = 1.4826;
/// The smallest error of any camera: half a step of 8 bits.
const FLOOR: f64 = 0.5 / 255.0;

impl Noise {
    /// The values before any residuals are known.
    pub(crate) const START: Self = Self { floor: 0.01, share: 0.15 };

    pub(crate) fn sigma(&self, spread: f64) -> f64 {
        (square(self.floor) + square(self.share * spread)).sqrt()
    }

    pub(crate) fn sigmas(&self, channel: &Channel) -> Vec<f64> {
        channel.spread.iter().map(|t| self.sigma(*t)).collect()
    }

    /// Computes the values from the residuals of a fit; keeps the old values if there are
    /// too few residuals.
    pub(crate) fn estimate(self, channel: &Channel, fit: &ChannelFit) -> Self {
        let (weights, residuals) = (&fit.weights, &fit.residuals);
        // Pairs of (unevenness, absolute residual / √(1 − leverage)).
        let mut pairs: Vec<(f64, f64)> = Vec::with_capacity(residuals.len());
        let shared = Shared::new(&fit.theta);
        for p in 0..channel.points() {
            let range = channel.of_point(p);
            let left: Vec<f64> = range.clone().map(|i| terms(channel, &shared, i).left).collect();
            let below: f64 = range.clone().zip(&left).map(|(i, a)| weights[i] * a * a).sum();
            for (i, a) in range.zip(&left) {
                let free = 1.0 - weights[i] * a * a / below;
                if free > 0.1 {
                    pairs.push((channel.spread[i], residuals[i].abs() / free.sqrt()));
                }
            }
        }
        if pairs.len() < 8 * CLASSES {
            return self;
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        // Weighted least squares of the variance over t²; the weights make relative errors equal.
        let (mut s, mut sx, mut sy, mut sxx, mut sxy) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for class in pairs.chunks(pairs.len().div_ceil(CLASSES)) {
            let x = square(class[class.len() / 2].0);
            let off = median(class.iter().map(|p| p.1)).unwrap_or(0.0);
            let y = square(NORMAL * off).max(FLOOR * FLOOR);
            let w = 1.0 / (y * y);
            (s, sx, sy, sxx, sxy) = (s + w, sx + w * x, sy + w * y, sxx + w * x * x, sxy + w * x * y);
        }
        let determinant = s * sxx - sx * sx;
        let (mut floor, mut share) = (sy / s, 0.0);
        if determinant > 1e-12 * s * sxx {
            share = ((s * sxy - sx * sy) / determinant).max(0.0);
            floor = (sy - share * sx) / s;
        }
        if floor <= FLOOR * FLOOR {
            floor = FLOOR * FLOOR;
            share = if sxx > 0.0 { ((sxy - floor * sx) / sxx).max(0.0) } else { 0.0 };
        }
        Self { floor: floor.sqrt(), share: share.sqrt() }
    }
}
