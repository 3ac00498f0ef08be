//! The fit of one channel: its starts, its assumptions, the decision on gains per view, and the share of
//! the loss that water explains.
//!
//! The loss has more than one minimum. With `ln B` as parameter, its gradient vanishes where B does: a veil
//! that became black once would stay black. Every channel is therefore fitted from several veils, and the
//! lowest cost wins.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use use3d_numerics::math;
use use3d_numerics::order::median;

use crate::blocks::order;
use crate::covariance::{Covariance, covariance};
use crate::data::Data;
use crate::formation::{ATTENUATION, BACKSCATTER, Channel, GAIN, VEIL, square};
use crate::noise::Noise;
use crate::open::Open;
use crate::params::WaterParams;
use crate::solve::{CAUCHY, ChannelFit, Prior, fit, loss};
use crate::verdict::Verdict;
use crate::water::{ChannelWater, Measured};

/// The veil that is assumed beforehand, display range, and the width of its logarithm.
const VEIL_PRIOR: (f64, f64) = (0.35, 0.6);
/// The width if open water shows the veil: from black to white.
const VEIL_SEEN: f64 = 3.0;
/// Veils from which every fit starts besides its first guess: nearly black, dark, middle.
const VEIL_STARTS: [f64; 3] = [0.0003, 0.05, 0.3];
/// Width of each component of the veil's relative slope over directions.
const SLOPE_PRIOR: f64 = 1.0;
/// Width of each component of a channel's slope around the slope that all channels share.
const SLOPE_ALIKE: f64 = 0.1;
/// A veil that the camera clipped to black: its share of green's veil, and the width of its logarithm.
const VEIL_CLIPPED: (f64, f64) = (0.07, 0.4);
/// The width of such a veil's logarithm during the fit: tracks do not measure it and would pull it to zero.
const VEIL_HELD: f64 = 0.02;
/// The width of `ln β_b/β_a` in a channel whose veil is assumed.
const RATIO_CLIPPED: f64 = 0.05;
/// Number of times that noise, design effect and gains are computed from the residuals.
const ROUNDS: usize = 3;
/// A gain per view is kept if it removes at least this share of the loss. Changing exposure removes more
/// than this; gains that are not real would absorb part of the effect of distance.
const GAINS_EXPLAIN: f64 = 0.35;
/// This smaller share is enough if gains without any water leave less loss than water without gains.
/// Exposure is then the larger effect, and water fitted without gains absorbs part of it.
const GAINS_EXPLAIN_FIRST: f64 = 0.15;
/// Width of the log-gains before the residuals are known.
const GAIN_PRIOR: f64 = 0.1;
/// Costs that differ by a smaller share than this belong to the same minimum.
const ALIKE: f64 = 1e-5;
/// Approximate number of points on which starts are compared.
const START_POINTS: usize = 1200;
/// Largest number of points used; more points add no information.
const MOST_POINTS: usize = 6000;

/// One channel during its fit.
pub(crate) struct Work {
    channel: Channel,
    points: usize,
    block: Vec<usize>,
    count: usize,
    prior: Prior,
    pub(crate) noise: Noise,
    pub(crate) best: ChannelFit,
    pub(crate) errors: Covariance,
    /// The share of the loss that gains remove.
    gains_explain: f64,
    /// True if the veil is assumed, because the camera clipped it.
    pub(crate) assumed: bool,
}

impl Work {
    /// Fits channel `c` without the other channels; `open` is true if its open water is used. `None` if too
    /// few points carry information.
    pub(crate) fn alone(data: &Data, c: usize, params: &WaterParams, open: bool) -> Option<Self> {
        let (channel, points) = data.select(c, data.order.len().div_ceil(MOST_POINTS).max(1));
        if data.telling < params.min_points || points.len() < params.min_points {
            return None;
        }
        let mut prior = Prior {
            attenuation: (math::ln(0.5), 2.0),
            // The width must be positive, for any value of the parameter.
            ratio: (0.0, params.ratio_width.max(1e-3)),
            veil: (math::ln(VEIL_PRIOR.0), VEIL_PRIOR.1),
            slope: ([0.0; 3], 0.0),
            seen: Vec::new(),
            gain: 0.0,
            trend: Vec::new(),
            open: Open::default(),
            water: true,
            strength: 1.0,
        };
        let (start, noise) = start(data, c, &prior);
        // Then everything that may vary is fitted on all points; noise and the gains' width follow from the
        // residuals.
        prior.slope.1 = if params.directional_veil { SLOPE_PRIOR } else { 0.0 };
        if open && !data.open.is_empty() {
            prior.open = Open::new(&data.open, c, data.center);
            prior.veil.1 = VEIL_SEEN;
        }
        let cells = prior.open.cells.iter().map(|cell| cell.1);
        prior.seen = outermost(&channel.direction.iter().copied().chain(cells));
        let (block, count) = (points.iter().map(|p| data.block[*p]).collect::<Vec<_>>(), data.blocks);
        let best = fit(&channel, &noise.sigmas(&channel), &prior, &start, &[2.0, 1.0]);
        let errors = covariance(&channel, &noise.sigmas(&channel), &best, &prior, &block, count);
        let mut work = Self {
            points: points.len(),
            channel,
            block,
            count,
            prior,
            noise,
            best,
            errors,
            gains_explain: 0.0,
            assumed: false,
        };
        work.settle(1);
        work.other_veils(data, c);
        work.settle(ROUNDS - 1);
        Some(work)
    }

    fn sigmas(&self) -> Vec<f64> {
        self.noise.sigmas(&self.channel)
    }

    /// Fits again with the noise and design effect that the residuals show.
    fn settle(&mut self, rounds: usize) {
        for _ in 0..rounds {
            self.noise = self.noise.estimate(&self.channel, &self.best);
            self.prior.strength = self.errors.design_effect;
            let sigmas = self.sigmas();
            self.best = fit(&self.channel, &sigmas, &self.prior, &self.best.theta, &[1.0]);
            self.errors =
                covariance(&self.channel, &sigmas, &self.best, &self.prior, &self.block, self.count);
        }
    }

    /// Fits a part of the points from other veils, and continues from the lowest cost.
    fn other_veils(&mut self, data: &Data, c: usize) {
        let (channel, _) = data.select(c, data.order.len().div_ceil(START_POINTS).max(1));
        let sigmas = self.noise.sigmas(&channel);
        let veils = std::iter::once(self.best.theta[VEIL]).chain(VEIL_STARTS.map(math::ln));
        let fits: Vec<ChannelFit> = veils
            .collect::<Vec<_>>()
            .par_iter()
            .map(|veil| {
                let mut theta = self.best.theta.clone();
                if *veil != theta[VEIL] {
                    theta[VEIL + 1..GAIN].fill(0.0);
                }
                theta[VEIL] = *veil;
                fit(&channel, &sigmas, &self.prior, &theta, &[1.0])
            })
            .collect();
        // The first fit with the lowest cost is taken; if the costs are alike, the fit of all points stays.
        let lowest = fits.iter().fold(f64::INFINITY, |m, f| m.min(f.cost));
        if fits[0].cost > lowest + ALIKE * lowest.abs() {
            let best = fits.into_iter().find(|f| f.cost <= lowest);
            self.best.theta = best.map_or_else(|| self.best.theta.clone(), |f| f.theta);
        }
    }

    /// The veil's slope, and the inverse of its covariance; `None` if it is unknown.
    pub(crate) fn slope(&self) -> Option<(DVec3, DMat3)> {
        if self.prior.slope.1 <= 0.0 {
            return None;
        }
        let precision = DMat3::from_cols_array(&self.errors.slope).inverse();
        let slope = DVec3::from_slice(&self.best.theta[VEIL + 1..GAIN]);
        (precision.is_finite() && precision.determinant() > 0.0).then_some((slope, precision))
    }

    /// Fits again with the slope that the channels share.
    pub(crate) fn share_slope(&mut self, slope: DVec3) {
        self.prior.slope = (slope.to_array(), SLOPE_ALIKE);
        self.best.theta[VEIL + 1..GAIN].copy_from_slice(&slope.to_array());
        self.settle(ROUNDS);
    }

    /// Fits again with an assumed veil: a share of green's, with `β_b` close to `β_a`.
    pub(crate) fn assume_veil(&mut self, green: f64) {
        let veil = math::ln(VEIL_CLIPPED.0 * green);
        self.prior.veil = (veil, VEIL_HELD);
        self.prior.ratio = (0.0, RATIO_CLIPPED);
        self.prior.slope = ([0.0; 3], 0.0);
        self.prior.seen = Vec::new();
        self.prior.open = Open::default();
        let theta = &mut self.best.theta;
        theta[VEIL] = veil;
        theta[VEIL + 1..GAIN].fill(0.0);
        theta[BACKSCATTER] = theta[ATTENUATION];
        self.assumed = true;
        self.settle(ROUNDS);
    }

    /// The veil in the mean direction.
    pub(crate) fn veil(&self) -> f64 {
        math::exp(self.best.theta[VEIL])
    }

    /// Fits gains of the views and keeps them if they explain enough. Returns the loss that water explains
    /// beyond gains.
    pub(crate) fn gains(&mut self, params: &WaterParams) -> Against {
        let sigmas = self.sigmas();
        let gain = if params.gains { GAIN_PRIOR } else { 0.0 };
        let trend = trend(&self.channel);
        let bare = Prior { water: false, ..self.prior.clone() };
        let without = fit(&self.channel, &sigmas, &bare, &dry(self.channel.views), &[2.0, 1.0]);
        if !params.gains {
            return self.against(&sigmas, &self.best, &without);
        }
        let bare = Prior { water: false, gain, ..self.prior.clone() };
        let exposed = fit(&self.channel, &sigmas, &bare, &without.theta, &[1.0]);
        let prior = Prior { gain, trend, ..self.prior.clone() };
        let mut freed = fit(&self.channel, &sigmas, &prior, &self.best.theta, &[1.0]);
        center_gains(&mut freed.theta);
        let (held, free) = (total(&self.best, &sigmas), total(&freed, &sigmas));
        let share = if held > 0.0 { 1.0 - free / held } else { 0.0 };
        self.gains_explain = share;
        let exposure_first = total(&exposed, &sigmas) < held;
        if share < GAINS_EXPLAIN && !(share >= GAINS_EXPLAIN_FIRST && exposure_first) {
            return self.against(&sigmas, &self.best, &without);
        }
        (self.prior, self.best) = (prior, freed);
        for _ in 0..ROUNDS {
            self.noise = self.noise.estimate(&self.channel, &self.best);
            self.prior.gain = gain_width(&self.channel, &self.best, &self.prior);
            self.best = fit(&self.channel, &self.sigmas(), &self.prior, &self.best.theta, &[1.0]);
            center_gains(&mut self.best.theta);
        }
        let sigmas = self.sigmas();
        self.errors = covariance(&self.channel, &sigmas, &self.best, &self.prior, &self.block, self.count);
        let bare = Prior { gain: self.prior.gain.max(GAIN_PRIOR), ..bare };
        let without = fit(&self.channel, &sigmas, &bare, &exposed.theta, &[1.0]);
        self.against(&sigmas, &self.best, &without)
    }

    fn against(&self, sigmas: &[f64], with: &ChannelFit, without: &ChannelFit) -> Against {
        let (mut gains, mut total) = (vec![0.0; self.count], 0.0);
        for p in 0..self.channel.points() {
            for i in self.channel.of_point(p) {
                let dry = loss(without.residuals[i], sigmas[i], CAUCHY);
                gains[self.block[p]] += dry - loss(with.residuals[i], sigmas[i], CAUCHY);
                total += dry;
            }
        }
        Against { gains, total }
    }

    /// The result for this channel's water.
    pub(crate) fn describe(&self, data: &Data, against: &Against) -> ChannelWater {
        let theta = &self.best.theta;
        let (a, b) = (math::exp(theta[ATTENUATION]) / data.unit, math::exp(theta[BACKSCATTER]) / data.unit);
        let veil = self.veil();
        let slope: [f64; 3] = std::array::from_fn(|k| veil * theta[VEIL + 1 + k]);
        let mut relative = self.errors.errors;
        if self.assumed {
            relative[VEIL] = VEIL_CLIPPED.1;
        }
        let [significance, explained] = against.significance_and_share();
        ChannelWater {
            verdict: Verdict::NoWater,
            attenuation: Measured { value: a, error: a * relative[ATTENUATION] },
            backscatter: Measured { value: b, error: b * relative[BACKSCATTER] },
            veil: Measured { value: veil, error: veil * relative[VEIL] },
            veil_constant: veil - DVec3::from_array(slope).dot(data.center),
            veil_slope: slope,
            veil_assumed: self.assumed,
            backscatter_veil_correlation: self.errors.backscatter_veil,
            backscatter_alone: self.errors.backscatter_alone,
            significance,
            explained,
            gains_explain: self.gains_explain,
            noise: [self.noise.floor, self.noise.share],
            points: self.points,
            observations: self.channel.value.len(),
        }
    }
}

/// The loss without water minus the loss with it.
#[derive(Clone, Debug)]
pub(crate) struct Against {
    /// The difference in each block.
    gains: Vec<f64>,
    /// The loss without water.
    total: f64,
}

impl Against {
    /// The sum over all channels.
    pub(crate) fn sum<'a>(all: impl Iterator<Item = &'a Self>) -> Option<Self> {
        all.cloned().reduce(|mut sum, other| {
            sum.gains.iter_mut().zip(other.gains).for_each(|(a, b)| *a += b);
            Self { total: sum.total + other.total, ..sum }
        })
    }

    /// The t statistic over blocks of the fall in loss due to water, and the share of the loss that water
    /// explains.
    pub(crate) fn significance_and_share(&self) -> [f64; 2] {
        let n = self.gains.len() as f64;
        let mean = self.gains.iter().sum::<f64>() / n;
        let variance = self.gains.iter().map(|g| square(g - mean)).sum::<f64>() / (n - 1.0).max(1.0);
        let t = if n > 1.0 && variance > 0.0 { mean / (variance / n).sqrt() } else { 0.0 };
        [t, if self.total > 0.0 { (mean * n / self.total).clamp(0.0, 1.0) } else { 0.0 }]
    }
}

/// Returns the best of several starts on a part of the points.
fn start(data: &Data, c: usize, prior: &Prior) -> (Vec<f64>, Noise) {
    let (channel, _) = data.select(c, data.order.len().div_ceil(START_POINTS).max(1));
    let middle = median(channel.value.iter().copied()).unwrap_or(0.4);
    let starts = [(0.1, 0.1), (0.4, 0.4), (1.2, 1.2), (0.3, 1.2), (1.2, 0.3)];
    let fits: Vec<ChannelFit> = starts
        .par_iter()
        .map(|(a, b): &(f64, f64)| {
            let mut theta = vec![0.0; channel.parameters()];
            (theta[ATTENUATION], theta[BACKSCATTER], theta[VEIL]) =
                (math::ln(*a), math::ln(*b), math::ln(middle.max(0.02)));
            fit(&channel, &Noise::START.sigmas(&channel), prior, &theta, &[3.0, 1.0])
        })
        .collect();
    // Among equal costs, the first.
    let best = fits.into_iter().reduce(|a, b| if b.cost < a.cost { b } else { a });
    match best {
        Some(best) => {
            let noise = Noise::START.estimate(&channel, &best);
            (best.theta, noise)
        }
        None => (vec![0.0; channel.parameters()], Noise::START),
    }
}

/// The outermost directions along each of 64 even directions; a linear veil has its minimum at one of them.
fn outermost(directions: &(impl Iterator<Item = [f64; 3]> + Clone)) -> Vec<[f64; 3]> {
    const ALONG: usize = 64;
    // The 64 directions form a spiral over the sphere with the golden angle.
    let along = (0..ALONG).map(|i| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / ALONG as f64;
        let (sin, cos) = math::sin_cos(2.399_963_229_728_653 * i as f64);
        let r = (1.0 - z * z).sqrt();
        DVec3::new(r * cos, r * sin, z)
    });
    let farthest = |axis: DVec3| {
        let reach = |d: &[f64; 3]| axis.dot(DVec3::from_array(*d));
        // Ties are broken by coordinates, so that the order of the views does not matter.
        directions.clone().reduce(|a, b| {
            let further = reach(&b).total_cmp(&reach(&a)).then_with(|| order(&b, &a));
            if further.is_gt() { b } else { a }
        })
    };
    let mut found: Vec<[f64; 3]> = along.filter_map(farthest).collect();
    found.sort_by(order);
    found.dedup();
    found
}

/// The loss of a fit.
fn total(fit: &ChannelFit, sigmas: &[f64]) -> f64 {
    fit.residuals.iter().zip(sigmas).map(|(r, s)| loss(*r, *s, CAUCHY)).sum()
}

/// The parameters of no water.
pub(crate) fn dry(views: usize) -> Vec<f64> {
    let mut theta = vec![0.0; GAIN + views];
    (theta[ATTENUATION], theta[BACKSCATTER]) = (f64::NEG_INFINITY, f64::NEG_INFINITY);
    theta
}

/// Coefficients over the views that give the least-squares slope of the gains over the views' mean
/// distances; empty if all views are equally far.
fn trend(channel: &Channel) -> Vec<f64> {
    let mut sums = vec![(0.0, 0.0); channel.views];
    for (view, distance) in channel.view.iter().zip(&channel.distance) {
        sums[*view].0 += distance;
        sums[*view].1 += 1.0;
    }
    let means: Vec<Option<f64>> = sums.iter().map(|(sum, n)| (*n > 0.0).then(|| sum / n)).collect();
    let seen: Vec<f64> = means.iter().flatten().copied().collect();
    let middle = seen.iter().sum::<f64>() / seen.len().max(1) as f64;
    let spread: f64 = seen.iter().map(|m| square(m - middle)).sum();
    if spread <= 1e-6 * seen.len() as f64 {
        return Vec::new();
    }
    means.iter().map(|mean| mean.map_or(0.0, |mean| (mean - middle) / spread)).collect()
}

/// The standard deviation of the gains that the data show (one step of expectation and maximisation).
fn gain_width(channel: &Channel, best: &ChannelFit, prior: &Prior) -> f64 {
    let gains = &best.theta[GAIN..];
    // The data of a single view alone give an upper bound of the precision of its gain.
    let mut precision = vec![0.0; gains.len()];
    for (i, view) in channel.view.iter().enumerate() {
        let m = channel.value[i] - best.residuals[i];
        precision[*view] += best.weights[i] * m * m;
    }
    let (mut sum, mut count) = (0.0, 0.0);
    for (g, p) in gains.iter().zip(&precision).filter(|(_, p)| **p > 0.0) {
        sum += g * g + 1.0 / (p + square(prior.gain).recip());
        count += 1.0;
    }
    if count > 0.0 { (sum / count).sqrt().clamp(1e-3, 0.3) } else { 1e-3 }
}

/// Moves the gains' mean into the veil, so that the geometric mean of the gains is 1; the radiances absorb
/// the rest.
fn center_gains(theta: &mut [f64]) {
    let views = theta.len() - GAIN;
    let mean = theta[GAIN..].iter().sum::<f64>() / views.max(1) as f64;
    theta[GAIN..].iter_mut().for_each(|g| *g -= mean);
    theta[VEIL] += mean;
}
