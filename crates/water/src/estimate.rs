//! From observations to the capture's water, with its errors and a verdict per channel.

use glam::DVec3;
use rayon::prelude::*;
use use3d_numerics::math;

use crate::blocks::blocks;
use crate::covariance::{Covariance, covariance};
use crate::formation::{ATTENUATION, BACKSCATTER, Channel, GAIN, Shared, VEIL, radiance, terms};
use crate::noise::{Noise, square};
use crate::observe::{Observation, Sights};
use crate::open::{Open, OpenWater};
use crate::solve::{CAUCHY, Fit, Prior, fit, loss};
use crate::verdict::{Verdict, judge};

/// The veil that is assumed beforehand, display range, and the width of its logarithm.
const VEIL_PRIOR: (f64, f64) = (0.35, 0.6);
/// The width where open water shows the veil: from black to white.
const VEIL_SEEN: f64 = 3.0;
/// Width of each component of the veil's relative slope.
const SLOPE_PRIOR: f64 = 1.0;
/// Noise, design effect and gains follow from the residuals this many times.
const ROUNDS: usize = 3;
/// A gain per view is kept where it takes away at least this share of the loss: exposure that changes does
/// more than this, and gains that are not there would take over part of what distance does.
const GAINS_EXPLAIN: f64 = 0.35;
/// Where gains without any water leave less than water without gains, this share is enough: exposure is then
/// what changes most, and water that is fitted without it takes over part of what exposure does.
const GAINS_EXPLAIN_FIRST: f64 = 0.15;
/// Starts are compared on about so many points.
const START_POINTS: usize = 1200;
/// More points than this tell nothing new.
const MOST_POINTS: usize = 6000;

/// What a user may say about the estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WaterParams {
    /// A point counts where its farthest view is this many times as far as its nearest one.
    pub distance_ratio: f64,
    /// Fewer such points than this and nothing is estimated.
    pub min_points: usize,
    /// Whether the veil may depend on the direction, to first order.
    pub directional_veil: bool,
    /// Whether open water says what the veil is.
    pub open_water: bool,
    /// Whether each view may have a gain of its own.
    pub gains: bool,
    /// Standard deviation of `ln(β_b/β_a)` around 0 that is assumed beforehand. Decides only where the data
    /// do not.
    pub ratio_width: f64,
}

impl Default for WaterParams {
    fn default() -> Self {
        Self {
            distance_ratio: 1.25,
            min_points: 150,
            directional_veil: true,
            open_water: true,
            gains: true,
            ratio_width: 0.5,
        }
    }
}

/// A value with its standard error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// The estimate.
    pub value: f64,
    /// One standard error, from the scatter over blocks of neighbouring points.
    pub error: f64,
}

/// One channel's water. Lengths are those of the observations' distances.
#[derive(Clone, Debug, PartialEq)]
pub struct ChannelWater {
    /// What can be relied on.
    pub verdict: Verdict,
    /// `β_a`, 1/length.
    pub attenuation: Measured,
    /// `β_b`, 1/length.
    pub backscatter: Measured,
    /// The veil in the mean direction of all observations, display range.
    pub veil: Measured,
    /// `c_m(d) = veil_constant + veil_slope · d` for unit world directions d.
    pub veil_constant: f64,
    /// See `veil_constant`.
    pub veil_slope: [f64; 3],
    /// Correlation of the errors of `ln β_b` and the veil.
    pub backscatter_veil_correlation: f64,
    /// How far the loss falls, per block, from no water to this one, over its own scatter: a t statistic.
    pub significance: f64,
    /// Share of the loss without water that water explains, 0 to 1.
    pub explained: f64,
    /// Share of the remaining loss that a gain per view takes away, 0 to 1; gains are kept where it is
    /// large.
    pub gains_explain: f64,
    /// Error of an observation of an even surface, and what an uneven one adds as a share of its unevenness.
    pub noise: [f64; 2],
    /// Points that were used.
    pub points: usize,
    /// Observations that were used.
    pub observations: usize,
}

/// A capture's water.
#[derive(Clone, Debug, PartialEq)]
pub struct Water {
    /// Red, green, blue.
    pub channels: [ChannelWater; 3],
    /// Gain of every view and channel, geometric mean 1; 1 for views without observations.
    pub gains: Vec<[f64; 3]>,
    /// Radiance without water of every point that was asked for and seen, and its standard error from the
    /// scatter of its views; `None` elsewhere.
    pub radiances: Vec<Option<[Measured; 3]>>,
    /// Points whose farthest view is at least `distance_ratio` times as far as the nearest.
    pub points: usize,
    /// Cells of open water that were looked at; 0 where there are too few to tell the veil.
    pub open: usize,
    /// 5th, 50th and 95th percentile of the distances.
    pub distances: [f64; 3],
    /// Whether the three attenuations are within a factor of 1.5, as lamps, exposure or a haze make them,
    /// and hardly water.
    pub grey: bool,
}

/// Estimates the water from what `views` views show of `points` points and of open water.
///
/// Never fails: where the capture cannot tell, the verdicts say so and the values are those of no water. What
/// is not finite is left out. The result does not depend on the observations' order.
///
/// Even cells that would make a veil surely brighter than white are no water but a sky or a lit wall: the
/// estimate is then made without them.
pub fn estimate(
    sights: &Sights,
    points: usize,
    positions: &[DVec3],
    views: usize,
    params: &WaterParams,
) -> Water {
    let data = Data::new(sights, points, positions, views, params);
    let water = data.water(points, views, params);
    let brighter_than_white = |c: &ChannelWater| c.veil.value - 2.0 * c.veil.error > 1.0;
    if water.open > 0 && water.channels.iter().any(brighter_than_white) {
        return Data { open: vec![], ..data }.water(points, views, params);
    }
    water
}

/// What all channels share.
struct Data {
    /// Sorted so that the caller's order does not matter.
    observations: Vec<Observation>,
    open: Vec<OpenWater>,
    /// Indices of tracks that tell, by position.
    order: Vec<usize>,
    positions: Vec<DVec3>,
    /// Observation ranges of tracks.
    ranges: Vec<std::ops::Range<usize>>,
    unit: f64,
    center: DVec3,
    views: usize,
    telling: usize,
    percentiles: [f64; 3],
}

/// A channel as it was solved.
struct Solved {
    theta: Vec<f64>,
    noise: Noise,
}

impl Data {
    /// The fit of all channels.
    fn water(&self, points: usize, views: usize, params: &WaterParams) -> Water {
        let fits: Vec<(ChannelWater, Vec<f64>, Solved)> =
            (0..3).into_par_iter().map(|c| self.channel(c, params)).collect();
        let mut gains = vec![[1.0; 3]; views];
        for (c, (_, gain, _)) in fits.iter().enumerate() {
            for (view, g) in gain.iter().enumerate() {
                gains[view][c] = *g;
            }
        }
        let radiances = self.radiances(&fits, points);
        let channels: [ChannelWater; 3] = std::array::from_fn(|c| fits[c].0.clone());
        let grey = crate::verdict::grey(&channels);
        let open = self.open.len();
        Water { channels, gains, radiances, points: self.telling, open, distances: self.percentiles, grey }
    }

    fn new(sights: &Sights, points: usize, positions: &[DVec3], views: usize, params: &WaterParams) -> Self {
        let finite = |o: &&Observation| {
            o.point < points.min(positions.len())
                && o.view < views
                && o.distance.is_finite()
                && o.distance > 0.0
                && o.direction.is_finite()
        };
        let mut sorted: Vec<Observation> = sights.points.iter().filter(finite).copied().collect();
        sorted.sort_by_key(|o| (o.point, o.view));
        sorted.dedup_by_key(|o| (o.point, o.view));
        let mut ranges = vec![0..0; points];
        let mut first = 0;
        while first < sorted.len() {
            let point = sorted[first].point;
            let count = sorted[first..].iter().take_while(|o| o.point == point).count();
            ranges[point] = first..first + count;
            first += count;
        }
        let ratio = |range: &std::ops::Range<usize>| {
            let all = sorted[range.clone()].iter().map(|o| o.distance);
            let (near, far) = all.fold((f64::INFINITY, 0.0f64), |(n, f), s| (n.min(s), f.max(s)));
            far / near
        };
        let tells = |p: &usize| ranges[*p].len() >= 3 && ratio(&ranges[*p]) >= params.distance_ratio;
        let telling = (0..points).filter(tells).count();
        // Points over a smaller range tell less, but cost little and steady the gains.
        let mut order: Vec<usize> =
            (0..points).filter(|p| ranges[*p].len() >= 3 && ratio(&ranges[*p]) >= 1.1).collect();
        order.sort_by(|a, b| {
            let (a, b) = (positions[*a], positions[*b]);
            a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)).then(a.z.total_cmp(&b.z))
        });
        let used: Vec<&Observation> = order.iter().flat_map(|p| &sorted[ranges[*p].clone()]).collect();
        let mut distances: Vec<f64> = used.iter().map(|o| o.distance).collect();
        distances.sort_by(f64::total_cmp);
        let at = |q: f64| distances.get((q * distances.len() as f64) as usize).copied().unwrap_or(1.0);
        let percentiles = [at(0.05), at(0.5), at(0.95)];
        let sum: DVec3 = used.iter().map(|o| o.direction).sum();
        let center = sum / (used.len().max(1) as f64);
        let open = if params.open_water { Open::usable(&sights.open, views) } else { vec![] };
        Self {
            order,
            open,
            positions: positions.to_vec(),
            ranges,
            unit: percentiles[1],
            center,
            views,
            telling,
            percentiles,
            observations: sorted,
        }
    }

    /// A channel's observations of every `step`-th point that tells, and those points.
    fn select(&self, c: usize, step: usize) -> (Channel, Vec<usize>) {
        let mut channel = Channel { start: vec![0], views: self.views, ..Channel::default() };
        let mut points = Vec::new();
        for &p in self.order.iter().step_by(step) {
            let usable: Vec<&Observation> = self.observations[self.ranges[p].clone()]
                .iter()
                .filter(|o| o.value[c].is_finite() && o.spread[c].is_finite())
                .collect();
            if usable.len() < 2 {
                continue;
            }
            for o in usable {
                channel.view.push(o.view);
                channel.distance.push(o.distance / self.unit);
                channel.direction.push((o.direction - self.center).to_array());
                channel.value.push(o.value[c]);
                channel.spread.push(o.spread[c]);
            }
            channel.start.push(channel.value.len());
            points.push(p);
        }
        (channel, points)
    }

    fn channel(&self, c: usize, params: &WaterParams) -> (ChannelWater, Vec<f64>, Solved) {
        let (channel, points) = self.select(c, self.order.len().div_ceil(MOST_POINTS).max(1));
        let none = || vec![1.0; self.views];
        if self.telling < params.min_points || points.len() < params.min_points {
            let water = ChannelWater::none(Verdict::TooFewPoints, points.len(), channel.value.len());
            return (water, none(), Solved { theta: dry(self.views), noise: Noise::START });
        }
        let mut prior = Prior {
            attenuation: (math::ln(0.5), 2.0),
            // Whatever was given, a width is positive.
            ratio: (0.0, params.ratio_width.max(1e-3)),
            veil: (math::ln(VEIL_PRIOR.0), VEIL_PRIOR.1),
            slope: 0.0,
            gain: 0.0,
            trend: Vec::new(),
            open: Open::default(),
            water: true,
            strength: 1.0,
        };
        let (start, mut noise) = self.start(c, &prior);
        // Then everything that may vary, on all points; noise and the gains' width follow from the residuals.
        prior.slope = if params.directional_veil { SLOPE_PRIOR } else { 0.0 };
        if !self.open.is_empty() {
            prior.open = Open::new(&self.open, c, self.center);
            prior.veil.1 = VEIL_SEEN;
        }
        let positions: Vec<DVec3> = points.iter().map(|p| self.positions[*p]).collect();
        let (block, count) = blocks(&positions);
        let mut best = fit(&channel, &noise.sigmas(&channel), &prior, &start, &[2.0, 1.0]);
        let mut errors = covariance(&channel, &noise.sigmas(&channel), &best, &prior, &block, count);
        for _ in 0..ROUNDS {
            noise = noise.estimate(&channel, &best.theta, &best.weights, &best.residuals);
            prior.strength = errors.design_effect;
            let sigmas = noise.sigmas(&channel);
            best = fit(&channel, &sigmas, &prior, &best.theta, &[1.0]);
            errors = covariance(&channel, &sigmas, &best, &prior, &block, count);
        }
        let mut gains_explain = 0.0;
        if params.gains {
            let sigmas = noise.sigmas(&channel);
            let (freed, share) = self.free_gains(&channel, &sigmas, &best, &prior);
            gains_explain = share;
            if share >= GAINS_EXPLAIN
                || (share >= GAINS_EXPLAIN_FIRST && self.exposure_first(&channel, &sigmas, &best, &freed.0))
            {
                (prior, best) = (freed.0, freed.1);
                for _ in 0..ROUNDS {
                    noise = noise.estimate(&channel, &best.theta, &best.weights, &best.residuals);
                    prior.gain = gain_width(&channel, &best, &prior);
                    best = fit(&channel, &noise.sigmas(&channel), &prior, &best.theta, &[1.0]);
                    center_gains(&mut best.theta);
                }
                errors = covariance(&channel, &noise.sigmas(&channel), &best, &prior, &block, count);
            }
        }
        let sigmas = noise.sigmas(&channel);
        let bare = Prior { water: false, ..prior };
        let without = fit(&channel, &sigmas, &bare, &dry(self.views), &[2.0, 1.0]);
        let (significance, explained) = against(&channel, &sigmas, &best, &without, &block, count);
        let mut water =
            self.describe(&channel, points.len(), &best, &errors, [significance, explained], noise);
        water.gains_explain = gains_explain;
        let gains = best.theta[GAIN..].iter().map(|g| math::exp(*g)).collect();
        (water, gains, Solved { theta: best.theta, noise })
    }

    /// The same fit with gains, and the share of the loss that they take away.
    fn free_gains(
        &self,
        channel: &Channel,
        sigmas: &[f64],
        best: &Fit,
        prior: &Prior,
    ) -> ((Prior, Fit), f64) {
        let prior = Prior { gain: 0.1, trend: trend(channel), ..prior.clone() };
        let mut freed = fit(channel, sigmas, &prior, &best.theta, &[1.0]);
        center_gains(&mut freed.theta);
        let (held, free) = (total(best, sigmas), total(&freed, sigmas));
        ((prior, freed), if held > 0.0 { 1.0 - free / held } else { 0.0 })
    }

    /// Whether gains without water leave less than `best`, water without gains.
    fn exposure_first(&self, channel: &Channel, sigmas: &[f64], best: &Fit, freed: &Prior) -> bool {
        let prior = Prior { water: false, ..freed.clone() };
        total(&fit(channel, sigmas, &prior, &dry(self.views), &[2.0, 1.0]), sigmas) < total(best, sigmas)
    }

    /// The best of several starts on a part of the points.
    fn start(&self, c: usize, prior: &Prior) -> (Vec<f64>, Noise) {
        let (channel, _) = self.select(c, self.order.len().div_ceil(START_POINTS).max(1));
        let mut values = channel.value.clone();
        values.sort_by(f64::total_cmp);
        let middle = values.get(values.len() / 2).copied().unwrap_or(0.4);
        let starts = [(0.1, 0.1), (0.4, 0.4), (1.2, 1.2), (0.3, 1.2), (1.2, 0.3)];
        let fits: Vec<Fit> = starts
            .par_iter()
            .map(|(a, b): &(f64, f64)| {
                let mut theta = vec![0.0; channel.parameters()];
                (theta[ATTENUATION], theta[BACKSCATTER], theta[VEIL]) =
                    (math::ln(*a), math::ln(*b), math::ln(middle.max(0.02)));
                fit(&channel, &Noise::START.sigmas(&channel), prior, &theta, &[3.0, 1.0])
            })
            .collect();
        // The first of the lowest.
        let best = fits.into_iter().reduce(|a, b| if b.cost < a.cost { b } else { a });
        match best {
            Some(best) => {
                let noise = Noise::START.estimate(&channel, &best.theta, &best.weights, &best.residuals);
                (best.theta, noise)
            }
            None => (vec![0.0; channel.parameters()], Noise::START),
        }
    }

    fn describe(
        &self,
        channel: &Channel,
        points: usize,
        best: &Fit,
        covariance: &Covariance,
        [significance, explained]: [f64; 2],
        noise: Noise,
    ) -> ChannelWater {
        let theta = &best.theta;
        let (a, b) = (math::exp(theta[ATTENUATION]) / self.unit, math::exp(theta[BACKSCATTER]) / self.unit);
        let veil = math::exp(theta[VEIL]);
        let slope: [f64; 3] = std::array::from_fn(|k| veil * theta[VEIL + 1 + k]);
        let relative = covariance.errors;
        ChannelWater {
            verdict: judge(theta, covariance, significance, explained, a * self.percentiles[2]),
            attenuation: Measured { value: a, error: a * relative[ATTENUATION] },
            backscatter: Measured { value: b, error: b * relative[BACKSCATTER] },
            veil: Measured { value: veil, error: veil * relative[VEIL] },
            veil_constant: veil - DVec3::from_array(slope).dot(self.center),
            veil_slope: slope,
            backscatter_veil_correlation: covariance.backscatter_veil,
            significance,
            explained,
            gains_explain: 0.0,
            noise: [noise.floor, noise.share],
            points,
            observations: channel.value.len(),
        }
    }

    /// The radiance of every point that was seen at all.
    fn radiances(
        &self,
        fits: &[(ChannelWater, Vec<f64>, Solved)],
        points: usize,
    ) -> Vec<Option<[Measured; 3]>> {
        (0..points)
            .into_par_iter()
            .map(|p| {
                let seen = &self.observations[self.ranges[p].clone()];
                let mut out = [Measured { value: 0.0, error: 0.0 }; 3];
                for (c, (_, _, solved)) in fits.iter().enumerate() {
                    out[c] = self.radiance(seen, c, solved)?;
                }
                Some(out)
            })
            .collect()
    }

    /// One channel's radiance of one point: Cauchy-weighted over its views, from the median of what each view
    /// says alone.
    fn radiance(&self, seen: &[Observation], c: usize, solved: &Solved) -> Option<Measured> {
        let usable: Vec<&Observation> = seen.iter().filter(|o| o.value[c].is_finite()).collect();
        let mut channel = Channel { views: self.views, ..Channel::default() };
        for o in &usable {
            channel.view.push(o.view);
            channel.distance.push(o.distance / self.unit);
            channel.direction.push((o.direction - self.center).to_array());
        }
        let shared = Shared::new(&solved.theta);
        let rows: Vec<(f64, f64, f64)> = (usable.iter().enumerate())
            .map(|(i, o)| {
                let t = terms(&channel, &shared, i);
                (solved.noise.sigma(o.spread[c]), t.left, o.value[c] - t.added)
            })
            .collect();
        let mut alone: Vec<f64> = rows.iter().map(|(_, a, y)| y / a).filter(|v| v.is_finite()).collect();
        alone.sort_by(f64::total_cmp);
        let mut value = alone.get(alone.len() / 2).copied()?.max(0.0);
        let mut below = 0.0;
        for _ in 0..8 {
            let weighted =
                rows.iter().map(|&(s, a, y)| (1.0 / (s * s + square((y - a * value) / CAUCHY)), a, y));
            (value, below) = radiance(weighted);
        }
        (below > 0.0).then(|| Measured { value, error: below.sqrt().recip() })
    }
}

/// The loss of a fit.
fn total(fit: &Fit, sigmas: &[f64]) -> f64 {
    fit.residuals.iter().zip(sigmas).map(|(r, s)| loss(*r, *s, CAUCHY)).sum()
}

/// Parameters of no water.
fn dry(views: usize) -> Vec<f64> {
    let mut theta = vec![0.0; GAIN + views];
    (theta[ATTENUATION], theta[BACKSCATTER]) = (f64::NEG_INFINITY, f64::NEG_INFINITY);
    theta
}

/// Coefficients over the views of the least-squares slope over the views' mean distances; empty where all are
/// as far.
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

/// Standard deviation of the gains that the data show (one step of expectation and maximisation).
fn gain_width(channel: &Channel, best: &Fit, prior: &Prior) -> f64 {
    let gains = &best.theta[GAIN..];
    // What a view's own data say about its gain, without the others: an upper bound of its precision.
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

/// Moves the gains' mean into the veil: the geometric mean of the gains is 1, and radiances take the rest.
fn center_gains(theta: &mut [f64]) {
    let views = theta.len() - GAIN;
    let mean = theta[GAIN..].iter().sum::<f64>() / views.max(1) as f64;
    theta[GAIN..].iter_mut().for_each(|g| *g -= mean);
    theta[VEIL] += mean;
}

/// The t statistic over blocks of how far water lowers the loss, and the share of the loss that it explains.
fn against(
    channel: &Channel,
    sigmas: &[f64],
    with: &Fit,
    without: &Fit,
    block: &[usize],
    count: usize,
) -> (f64, f64) {
    let (mut gains, mut total) = (vec![0.0; count], 0.0);
    for p in 0..channel.points() {
        for i in channel.of_point(p) {
            let dry = loss(without.residuals[i], sigmas[i], CAUCHY);
            gains[block[p]] += dry - loss(with.residuals[i], sigmas[i], CAUCHY);
            total += dry;
        }
    }
    let n = count as f64;
    let mean = gains.iter().sum::<f64>() / n;
    let variance = gains.iter().map(|g| square(g - mean)).sum::<f64>() / (n - 1.0).max(1.0);
    let t = if count > 1 && variance > 0.0 { mean / (variance / n).sqrt() } else { 0.0 };
    (t, if total > 0.0 { (mean * n / total).clamp(0.0, 1.0) } else { 0.0 })
}

impl ChannelWater {
    fn none(verdict: Verdict, points: usize, observations: usize) -> Self {
        let zero = Measured { value: 0.0, error: f64::INFINITY };
        Self {
            verdict,
            attenuation: zero,
            backscatter: zero,
            veil: zero,
            veil_constant: 0.0,
            veil_slope: [0.0; 3],
            backscatter_veil_correlation: 0.0,
            significance: 0.0,
            explained: 0.0,
            gains_explain: 0.0,
            noise: [Noise::START.floor, Noise::START.share],
            points,
            observations,
        }
    }
}
