//! Estimates the capture's water from observations, with its errors and a verdict per channel.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use use3d_numerics::math;
use use3d_numerics::order::median;

use crate::channel::{Against, Work, dry};
use crate::data::Data;
use crate::formation::{Channel, Shared, radiance, square, terms};
use crate::noise::Noise;
use crate::observe::{Observation, Sights};
use crate::open::OpenWater;
use crate::params::WaterParams;
use crate::solve::CAUCHY;
use crate::verdict::{Verdict, judge, present};
use crate::water::{ChannelWater, Measured, Water};

/// Estimates the water from the observations in `views` views of `points` points and of open water.
///
/// This function never fails: if the capture has too little information, the verdicts report it and the
/// values are those of no water. Values that are not finite are left out. The result does not depend on the
/// observations' order.
///
/// Even cells that would make a veil clearly brighter than white show no water but a sky or a lit wall; the
/// estimate is then made without them.
pub fn estimate(
    sights: &Sights,
    points: usize,
    positions: &[DVec3],
    views: usize,
    params: &WaterParams,
) -> Water {
    let mut data = Data::new(sights, points, positions, views, params);
    let mut water = data.water(points, params);
    let brighter_than_white = |c: &ChannelWater| c.veil.value - 2.0 * c.veil.error > 1.0;
    if water.open > 0 && water.channels.iter().any(brighter_than_white) {
        let open = std::mem::take(&mut data.open);
        water = data.water(points, params);
        data.open = open;
    }
    if white(&water, &data) {
        water.sky = true;
        water.channels.iter_mut().for_each(|c| c.verdict = Verdict::NoWater);
    }
    water
}

/// A veil at least this bright in every channel is not that of water, display range: water that removes a
/// colour from surfaces also removes it from the veil, and red first.
const WHITE: f64 = 0.7;

/// True if the veil is nearly white in all channels, in the brighter of two directions: the mean direction,
/// and the mean direction of the even, far cells.
fn white(water: &Water, data: &Data) -> bool {
    let sum: DVec3 = data.open.iter().map(|o| o.direction).sum();
    let open = (!data.open.is_empty()).then(|| sum / data.open.len() as f64);
    water.channels.iter().all(|c| {
        let there = |d: DVec3| c.veil_constant + DVec3::from_array(c.veil_slope).dot(d);
        c.verdict.usable() && open.map_or(c.veil.value, |d| c.veil.value.max(there(d))) >= WHITE
    })
}

/// Like [`estimate`], with errors that include the change of the estimate with the images' size:
/// `σ² + (β(W) − β(W/2))²`, where `sights` are those at the images' own size W and at half of it. Two
/// halves of the points or views share the effects of sharpness, compression and keypoints; two sizes do
/// not.
pub fn estimate_sizes(
    sights: &[Sights; 2],
    points: usize,
    positions: &[DVec3],
    views: usize,
    params: &WaterParams,
) -> Water {
    let [mut water, half] = {
        let of = |sights| estimate(sights, points, positions, views, params);
        rayon::join(|| of(&sights[0]), || of(&sights[1])).into()
    };
    let [_, median, far] = water.distances;
    for (c, h) in water.channels.iter_mut().zip(&half.channels) {
        let known = |c: &ChannelWater| c.verdict.usable() || c.verdict == Verdict::NotObservable;
        if !known(c) || h.verdict == Verdict::TooFewPoints {
            continue;
        }
        let move_of = |m: &Measured, other: &Measured| math::hypot(m.error, m.value - other.value);
        let shift = (c.backscatter.value - h.backscatter.value) / c.backscatter.value;
        c.attenuation.error = move_of(&c.attenuation, &h.attenuation);
        c.backscatter.error = move_of(&c.backscatter, &h.backscatter);
        c.veil.error = move_of(&c.veil, &h.veil);
        c.backscatter_alone = math::hypot(c.backscatter_alone, shift);
        c.verdict = judge(c, true, median, far);
    }
    water.grey = crate::verdict::grey(&water.channels);
    water
}

/// A channel's solution.
struct Solved {
    theta: Vec<f64>,
    noise: Noise,
}

impl Data {
    /// Fits all channels.
    fn water(&self, points: usize, params: &WaterParams) -> Water {
        let clipped: [bool; 3] = std::array::from_fn(|c| clipped(&self.open, c));
        let mut works: Vec<Option<Work>> =
            (0..3).into_par_iter().map(|c| Work::alone(self, c, params, !clipped[c])).collect();
        let slopes = works.iter().zip(clipped).filter(|(_, clipped)| !clipped);
        let slope = common(slopes.filter_map(|(work, _)| work.as_ref()?.slope()));
        works.par_iter_mut().zip(clipped).filter(|(_, clipped)| !clipped).for_each(|(work, _)| {
            if let (Some(work), Some(slope)) = (work, slope) {
                work.share_slope(slope);
            }
        });
        // A veil that the camera clipped to black is dark relative to green's, or relative to blue's where
        // green is black too.
        let seen = [1, 2, 0].into_iter().filter(|c| !clipped[*c]);
        let green = seen.filter_map(|c| works[c].as_ref()).map(Work::veil).next();
        works.par_iter_mut().zip(clipped).filter(|(_, clipped)| *clipped).for_each(|(work, _)| {
            if let (Some(work), Some(green)) = (work, green) {
                work.assume_veil(green);
            }
        });
        let comparisons: Vec<Option<Against>> =
            works.par_iter_mut().map(|work| work.as_mut().map(|work| work.gains(params))).collect();
        // There is one body of water, so all channels together decide whether there is any.
        let [significance, explained] =
            Against::sum(comparisons.iter().flatten()).map_or([0.0; 2], |all| all.significance_and_share());
        let mut gains = vec![[1.0; 3]; self.views];
        let mut solved = Vec::with_capacity(3);
        let mut channels = [0, 1, 2].map(|_| ChannelWater::none(Verdict::TooFewPoints));
        for (c, (work, comparison)) in works.into_iter().zip(comparisons).enumerate() {
            let (Some(work), Some(comparison)) = (work, comparison) else {
                solved.push(Solved { theta: dry(self.views), noise: Noise::START });
                continue;
            };
            channels[c] = work.describe(self, &comparison);
            for (gain, log) in gains.iter_mut().zip(&work.best.theta[crate::formation::GAIN..]) {
                gain[c] = math::exp(*log);
            }
            solved.push(Solved { theta: work.best.theta, noise: work.noise });
        }
        let wet = present(significance, explained);
        let [_, median, far] = self.percentiles;
        for channel in channels.iter_mut().filter(|c| c.verdict != Verdict::TooFewPoints) {
            channel.verdict = judge(channel, wet, median, far);
        }
        Water {
            sky: false,
            significance,
            explained,
            gains,
            radiances: self.radiances(&solved, points),
            points: self.telling,
            open: self.open.len(),
            distances: self.percentiles,
            grey: crate::verdict::grey(&channels),
            channels,
        }
    }

    /// The radiance of every point that was seen.
    fn radiances(&self, fits: &[Solved], points: usize) -> Vec<Option<[Measured; 3]>> {
        (0..points)
            .into_par_iter()
            .map(|p| {
                let seen = &self.observations[self.ranges[p].clone()];
                let mut out = [Measured { value: 0.0, error: 0.0 }; 3];
                for (c, solved) in fits.iter().enumerate() {
                    out[c] = self.radiance(seen, c, solved)?;
                }
                Some(out)
            })
            .collect()
    }

    /// One channel's radiance of one point: a Cauchy-weighted mean over its views, started from the median
    /// of the values of each view alone.
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
        let alone = rows.iter().map(|(_, a, y)| y / a).filter(|v| v.is_finite());
        let mut value = median(alone)?.max(0.0);
        let mut below = 0.0;
        for _ in 0..8 {
            let weighted =
                rows.iter().map(|&(s, a, y)| (1.0 / (s * s + square((y - a * value) / CAUCHY)), a, y));
            (value, below) = radiance(weighted);
        }
        (below > 0.0).then(|| Measured { value, error: below.sqrt().recip() })
    }
}

/// Values at or below this are clipped by the camera, display range.
const BLACK: f64 = 2.0 / 255.0;

/// True if the camera clipped a channel's open water to black in over half of the cells.
fn clipped(open: &[OpenWater], c: usize) -> bool {
    !open.is_empty() && 2 * open.iter().filter(|o| o.value[c] <= BLACK).count() > open.len()
}

/// The mean of the slopes, each weighted by the inverse of its covariance.
fn common(slopes: impl Iterator<Item = (DVec3, DMat3)>) -> Option<DVec3> {
    let (mut weight, mut sum) = (DMat3::ZERO, DVec3::ZERO);
    for (slope, precision) in slopes {
        weight += precision;
        sum += precision * slope;
    }
    let slope = weight.inverse() * sum;
    slope.is_finite().then_some(slope)
}

impl ChannelWater {
    fn none(verdict: Verdict) -> Self {
        let zero = Measured { value: 0.0, error: f64::INFINITY };
        Self {
            verdict,
            attenuation: zero,
            backscatter: zero,
            veil: zero,
            veil_constant: 0.0,
            veil_slope: [0.0; 3],
            veil_assumed: false,
            backscatter_veil_correlation: 0.0,
            backscatter_alone: f64::INFINITY,
            significance: 0.0,
            explained: 0.0,
            gains_explain: 0.0,
            noise: [Noise::START.floor, Noise::START.share],
            points: 0,
            observations: 0,
        }
    }
}
