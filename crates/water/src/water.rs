//! A capture's water, as the estimate returns it.

use crate::verdict::Verdict;

/// A value with its standard error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// The estimate.
    pub value: f64,
    /// One standard error, from the scatter over blocks of neighbouring points.
    pub error: f64,
}

/// The water of one channel. Lengths have the unit of the observations' distances.
#[derive(Clone, Debug, PartialEq)]
pub struct ChannelWater {
    /// The reliability of the result.
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
    /// True if the veil is assumed and not measured: the camera clipped this channel's open water to black.
    pub veil_assumed: bool,
    /// Correlation of the errors of `ln β_b` and the veil.
    pub backscatter_veil_correlation: f64,
    /// Relative error of `β_b` without any assumption about `β_b/β_a`.
    pub backscatter_alone: f64,
    /// A t statistic: the fall of the loss per block from no water to this water, divided by its own
    /// scatter. If gains of the views are kept, both fits have them.
    pub significance: f64,
    /// Share of the loss without water that water explains, 0 to 1.
    pub explained: f64,
    /// Share of the remaining loss that a gain per view removes, 0 to 1; gains are kept if it is large.
    pub gains_explain: f64,
    /// Error of an observation of an even surface, and the error that an uneven surface adds, as a share of
    /// its unevenness.
    pub noise: [f64; 2],
    /// Number of points used.
    pub points: usize,
    /// Number of observations used.
    pub observations: usize,
}

/// A capture's water.
#[derive(Clone, Debug, PartialEq)]
pub struct Water {
    /// Red, green, blue.
    pub channels: [ChannelWater; 3],
    /// True if the fit found not water but a sky or a haze in air: a veil that is nearly white in all
    /// channels.
    pub sky: bool,
    /// The t statistic of all channels together.
    pub significance: f64,
    /// Share of the loss of all channels that water explains, 0 to 1.
    pub explained: f64,
    /// Gain of every view and channel, geometric mean 1; 1 for views without observations.
    pub gains: Vec<[f64; 3]>,
    /// Radiance without water of every point that was seen, and its standard error from the scatter of its
    /// views; `None` for other points.
    pub radiances: Vec<Option<[Measured; 3]>>,
    /// Number of points whose farthest view is at least `distance_ratio` times as far away as the nearest.
    pub points: usize,
    /// Number of cells of open water used; 0 if there are too few to measure the veil.
    pub open: usize,
    /// 5th, 50th and 95th percentile of the distances.
    pub distances: [f64; 3],
    /// True if the three attenuations are within a factor of 1.5. Lamps, exposure or a haze cause this;
    /// water hardly does.
    pub grey: bool,
}
