//! The robust fit of one channel: Cauchy's loss by reweighting, with Levenberg-Marquardt steps over the
//! shared parameters.
//!
//! The fit minimises `Σ (c²/2) ln(1 + (r/σ_i)²/c²) + ½ Σ (θ − prior)²/width²`. With fixed weights
//! `w_i = 1/(σ_i² + r_i²/c²)`, `½ Σ w r²` touches the loss from above, so every step that lowers it also
//! lowers the loss. A fit begins with a wider loss, two or three times c, and then narrows it, so that
//! outliers of the start do not decide the result.

use rayon::prelude::*;
use use3d_numerics::math;

use crate::formation::{ATTENUATION, BACKSCATTER, Channel, GAIN, VEIL, all_terms, normal, residuals, square};
use crate::open::{self, Open};
use use3d_numerics::cholesky::Factor;

/// Cauchy's constant: 95 % efficiency on normal errors.
pub(crate) const CAUCHY: f64 = 2.385;
/// Bounds of `ln β` per median distance; beyond them nothing changes any more.
const BETA_BOUNDS: [f64; 2] = [-9.0, 4.0];
/// Largest number of steps in one round.
const STEPS: usize = 40;
/// A step that lowers the cost by a smaller share than this is the last one.
const SETTLED: f64 = 1e-7;

/// Width of the slope of log-gains over the views' mean distances, per median distance. Gains that fall
/// with distance look like correspondingly stronger water; a camera has little reason to change its gain in
/// this way.
const TREND: f64 = 0.03;

/// The smallest veil in any direction that was seen, relative to the mean direction's: light is never
/// negative.
const DARKEST: f64 = 0.02;
/// Width of the penalty on veils below [`DARKEST`]: a soft bound, so that the fit stays smooth.
const NEGATIVE: f64 = 0.004;

/// The prior knowledge, as normal distributions (mean, width), and the choice of free parameters.
#[derive(Clone, Debug)]
pub(crate) struct Prior {
    /// `ln β_a` per median distance: any water through which something can be seen.
    pub(crate) attenuation: (f64, f64),
    /// `ln β_b − ln β_a`.
    pub(crate) ratio: (f64, f64),
    /// `ln B_0`.
    pub(crate) veil: (f64, f64),
    /// The components of `g`, and the width of each; a width of 0 fixes them.
    pub(crate) slope: ([f64; 3], f64),
    /// Directions, minus the mean direction, in which the veil must not be negative.
    pub(crate) seen: Vec<[f64; 3]>,
    /// Width of `γ`; a width of 0 fixes the gains at 0.
    pub(crate) gain: f64,
    /// Coefficients over the views that compute the slope of γ over a view's mean distance. This slope is
    /// assumed to be 0 within [`TREND`]; without coefficients nothing is assumed.
    pub(crate) trend: Vec<f64>,
    /// Open water: `g_v B(d)` in the directions in which it was seen.
    pub(crate) open: Open,
    /// True if water is fitted; otherwise only gains are.
    pub(crate) water: bool,
    /// Number of observations per independent one. Assumptions about the water weigh more by this factor.
    pub(crate) strength: f64,
}

impl Prior {
    /// True if parameter `k` is fitted.
    pub(crate) fn free(&self, k: usize) -> bool {
        match k {
            _ if k >= GAIN => self.gain > 0.0,
            _ if k > VEIL => self.water && self.slope.1 > 0.0,
            _ => self.water,
        }
    }

    /// The penalty at `theta`.
    fn value(&self, theta: &[f64]) -> f64 {
        let mut sum = 0.0;
        self.terms(theta, |_, off, width| sum += 0.5 * square(off / width));
        sum
    }

    /// Calls `term` with (derivatives of the deviation with respect to parameters, deviation, width).
    fn terms(&self, theta: &[f64], mut term: impl FnMut(&[(usize, f64)], f64, f64)) {
        if self.water {
            let narrowed = self.strength.max(1.0).sqrt().recip();
            let mut term = |c: &[(usize, f64)], off: f64, width: f64| term(c, off, width * narrowed);
            let (a, b) = (theta[ATTENUATION], theta[BACKSCATTER]);
            term(&[(ATTENUATION, 1.0)], a - self.attenuation.0, self.attenuation.1);
            term(&[(BACKSCATTER, 1.0), (ATTENUATION, -1.0)], b - a - self.ratio.0, self.ratio.1);
            term(&[(VEIL, 1.0)], theta[VEIL] - self.veil.0, self.veil.1);
            if self.slope.1 > 0.0 {
                for k in 0..3 {
                    term(&[(VEIL + 1 + k, 1.0)], theta[VEIL + 1 + k] - self.slope.0[k], self.slope.1);
                }
                for d in &self.seen {
                    let veil = 1.0 + (0..3).map(|k| theta[VEIL + 1 + k] * d[k]).sum::<f64>();
                    if veil < DARKEST {
                        let derivatives: [_; 3] = std::array::from_fn(|k| (VEIL + 1 + k, d[k]));
                        term(&derivatives, veil - DARKEST, NEGATIVE);
                    }
                }
            }
            let constant = math::exp(theta[VEIL]);
            for (view, d, value, weight) in &self.open.cells {
                let gain = math::exp(theta[GAIN + view]);
                let slope: f64 = (0..3).map(|k| theta[VEIL + 1 + k] * d[k]).sum();
                let (level, seen) = (gain * constant, gain * constant * (1.0 + slope));
                let width = open::WIDTH / weight.sqrt();
                let mut coefficients = [(VEIL, seen); 5];
                for k in 0..3 {
                    coefficients[1 + k] = (VEIL + 1 + k, level * d[k]);
                }
                coefficients[4] = (GAIN + view, seen);
                let last = if self.gain > 0.0 { 5 } else { 4 };
                term(&coefficients[..last], seen - value, width);
            }
        }
        if self.gain > 0.0 {
            for k in GAIN..theta.len() {
                term(&[(k, 1.0)], theta[k], self.gain);
            }
            let slope: Vec<(usize, f64)> =
                self.trend.iter().enumerate().map(|(v, c)| (GAIN + v, *c)).collect();
            if !slope.is_empty() {
                let narrowed = self.strength.max(1.0).sqrt().recip();
                term(&slope, slope.iter().map(|(k, c)| c * theta[*k]).sum(), TREND * narrowed);
            }
        }
    }

    /// Adds the penalty's gradient and curvature.
    pub(crate) fn add(&self, theta: &[f64], gradient: &mut [f64], matrix: &mut [f64]) {
        let n = theta.len();
        self.terms(theta, |coefficients, off, width| {
            let weight = 1.0 / (width * width);
            for &(i, ci) in coefficients {
                gradient[i] += weight * off * ci;
                for &(j, cj) in coefficients {
                    matrix[i * n + j] += weight * ci * cj;
                }
            }
        });
    }
}

/// A fitted channel.
#[derive(Clone, Debug)]
pub(crate) struct ChannelFit {
    /// The shared parameters.
    pub(crate) theta: Vec<f64>,
    /// Loss plus penalty.
    pub(crate) cost: f64,
    /// The weight of every observation.
    pub(crate) weights: Vec<f64>,
    /// The residual of every observation.
    pub(crate) residuals: Vec<f64>,
}

/// The loss of one observation.
pub(crate) fn loss(residual: f64, sigma: f64, c: f64) -> f64 {
    let u = residual / (sigma * c);
    0.5 * c * c * math::ln_1p(u * u)
}

fn weights(residuals: &[f64], sigmas: &[f64], c: f64) -> Vec<f64> {
    residuals.iter().zip(sigmas).map(|(r, s)| 1.0 / (s * s + square(r / c))).collect()
}

/// Fits from `theta`. `sigmas` are the expected errors of the observations; `rounds` are the loss's widths
/// divided by [`CAUCHY`], widest first.
pub(crate) fn fit(
    channel: &Channel,
    sigmas: &[f64],
    prior: &Prior,
    theta: &[f64],
    rounds: &[f64],
) -> ChannelFit {
    let n = channel.parameters();
    let mut theta = theta.to_vec();
    let plain: Vec<f64> = sigmas.iter().map(|s| 1.0 / (s * s)).collect();
    let mut terms = all_terms(channel, &theta);
    let mut r = residuals(channel, &terms, &plain);
    let mut w;
    for round in rounds {
        let c = CAUCHY * round;
        let total = |r: &[f64], theta: &[f64]| {
            let each = r.par_iter().zip(sigmas).with_min_len(1024).map(|(r, s)| loss(*r, *s, c));
            each.collect::<Vec<f64>>().iter().sum::<f64>() + prior.value(theta)
        };
        let mut cost = total(&r, &theta);
        let mut damping = 1e-3;
        for _ in 0..STEPS {
            w = weights(&r, sigmas, c);
            // The cost at fixed weights; the radiance takes its optimum under these weights before the step
            // is judged.
            let held = |r: &[f64], theta: &[f64]| {
                0.5 * r.iter().zip(&w).map(|(r, w)| w * r * r).sum::<f64>() + prior.value(theta)
            };
            let start = held(&residuals(channel, &terms, &w), &theta);
            let mut system = normal(channel, &terms, &w, prior.gain > 0.0, |_, _, _| ());
            prior.add(&theta, &mut system.gradient, &mut system.matrix);
            let mut stepped = false;
            for _ in 0..12 {
                let Some(next) = step(&system.gradient, &system.matrix, n, prior, damping, &theta) else {
                    damping *= 8.0;
                    continue;
                };
                let next_terms = all_terms(channel, &next);
                let next_r = residuals(channel, &next_terms, &w);
                if held(&next_r, &next) <= start {
                    (theta, terms, r) = (next, next_terms, next_r);
                    damping = (damping / 6.0).max(1e-9);
                    stepped = true;
                    break;
                }
                damping *= 8.0;
            }
            let next = total(&r, &theta);
            let settled = cost - next <= SETTLED * cost.abs();
            cost = next;
            if !stepped || settled {
                break;
            }
        }
    }
    let c = CAUCHY * rounds.last().copied().unwrap_or(1.0);
    w = weights(&r, sigmas, c);
    let cost = r.iter().zip(sigmas).map(|(r, s)| loss(*r, *s, c)).sum::<f64>() + prior.value(&theta);
    ChannelFit { theta, cost, weights: w, residuals: r }
}

/// The rows and columns `free` of a matrix with `n` columns.
pub(crate) fn submatrix(matrix: &[f64], n: usize, free: &[usize]) -> Vec<f64> {
    free.iter().flat_map(|&i| free.iter().map(move |&j| matrix[i * n + j])).collect()
}

/// Computes a damped step; `None` if the damped system is not positive definite.
fn step(
    gradient: &[f64],
    matrix: &[f64],
    n: usize,
    prior: &Prior,
    damping: f64,
    theta: &[f64],
) -> Option<Vec<f64>> {
    let free: Vec<usize> = (0..n).filter(|&k| prior.free(k)).collect();
    let m = free.len();
    let mut small = submatrix(matrix, n, &free);
    for (a, &i) in free.iter().enumerate() {
        small[a * m + a] += damping * matrix[i * n + i].max(1e-12);
    }
    let rhs: Vec<f64> = free.iter().map(|&i| -gradient[i]).collect();
    let delta = Factor::new(small, m)?.solve(&rhs);
    let mut next = theta.to_vec();
    for (&i, d) in free.iter().zip(&delta) {
        if !d.is_finite() {
            return None;
        }
        next[i] += d.clamp(-1.5, 1.5);
    }
    for k in [ATTENUATION, BACKSCATTER].into_iter().filter(|&k| prior.free(k)) {
        next[k] = next[k].clamp(BETA_BOUNDS[0], BETA_BOUNDS[1]);
    }
    Some(next)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::open::OpenWater;

    /// Compares every term's derivative, with open water and gains, with differences of its value.
    #[test]
    fn the_penalty_changes_as_its_gradient_says() {
        let cell = |i: usize| OpenWater {
            view: i % 3,
            direction: glam::DVec3::new(0.1 * (i % 7) as f64, 1.0, 0.05 * i as f64).normalize(),
            value: [0.3 + 0.02 * (i % 5) as f64; 3],
        };
        let cells: Vec<OpenWater> = (0..30).map(cell).collect();
        let prior = Prior {
            attenuation: (-0.7, 2.0),
            ratio: (0.0, 0.5),
            veil: (-1.0, 3.0),
            slope: ([0.2, 0.0, -0.1], 1.0),
            seen: vec![[-2.2, 0.9, -1.0], [0.3, 0.1, 0.2]],
            gain: 0.1,
            trend: vec![0.5, 0.1, -0.6],
            open: Open::new(&cells, 0, glam::DVec3::new(0.1, 0.8, 0.2)),
            water: true,
            strength: 7.0,
        };
        let theta = [-0.5, -0.9, -1.3, 0.3, -0.2, 0.4, 0.05, -0.1, 0.02];
        let (mut gradient, mut matrix) = (vec![0.0; 9], vec![0.0; 81]);
        prior.add(&theta, &mut gradient, &mut matrix);
        for k in 0..9 {
            let at = |step: f64| {
                let mut moved = theta;
                moved[k] += step;
                prior.value(&moved)
            };
            let difference = (at(1e-5) - at(-1e-5)) / 2e-5;
            let scale = gradient.iter().fold(1.0f64, |m, g| m.max(g.abs()));
            assert!((difference - gradient[k]).abs() < 1e-6 * scale, "{k}: {difference}, {}", gradient[k]);
            for j in 0..9 {
                assert!((matrix[9 * k + j] - matrix[9 * j + k]).abs() < 1e-9 * matrix[9 * k + k].max(1.0));
            }
        }
    }
}
