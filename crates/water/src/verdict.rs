//! The reliability of an estimate.

use std::fmt;

use crate::water::ChannelWater;

/// The knowledge of one channel's water that the capture allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Attenuation, backscatter and veil are all known.
    Found,
    /// Attenuation is known. Backscatter and veil are known only together (a weak veil far away looks like
    /// a strong one near by): `β_b` relies on the assumption that it is about as large as `β_a`.
    VeilNotSeparable,
    /// Brightness does not change with distance in a way that water would explain.
    NoWater,
    /// Brightness changes with distance, but attenuation cannot be separated from other causes.
    NotObservable,
    /// Too few points were seen from different distances.
    TooFewPoints,
}

impl Verdict {
    /// The verdict as one word for files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Found => "found",
            Self::VeilNotSeparable => "veil-not-separable",
            Self::NoWater => "no-water",
            Self::NotObservable => "not-observable",
            Self::TooFewPoints => "too-few-points",
        }
    }

    /// True if the attenuation can be used.
    pub fn usable(self) -> bool {
        matches!(self, Self::Found | Self::VeilNotSeparable)
    }
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Found => "found",
            Self::VeilNotSeparable => "attenuation found; backscatter and veil cannot be separated",
            Self::NoWater => "no sign of water",
            Self::NotObservable => "not observable",
            Self::TooFewPoints => "not observable: too few points are seen from different distances",
        })
    }
}

/// Smallest t statistic of water against no water.
const SIGNIFICANT: f64 = 3.0;
/// Smallest share of the loss that water must explain.
const EXPLAINED: f64 = 0.03;
/// Largest relative error of an attenuation that counts as known.
const KNOWN: f64 = 0.35;
/// Largest relative error of `β_b`, without assumptions about its size, at which it counts as separated
/// from the veil.
const APART: f64 = 0.2;
/// Differences in sharpness alone can cause an optical depth (`β_a` times the distance of the far points)
/// below this value.
const THINNEST: f64 = 0.06;

/// An optical depth of the median distance above this value leaves less than a hundredth of a point's
/// light, so the fit does not describe what is visible.
const THICKEST: f64 = 5.0;

/// True if there is any water.
pub(crate) fn present(significance: f64, explained: f64) -> bool {
    significance >= SIGNIFICANT && explained >= EXPLAINED
}

/// The verdict on a channel of a capture with water (`wet`); `median` and `far` are the median distance and
/// the distance of the far points.
pub(crate) fn judge(water: &ChannelWater, wet: bool, median: f64, far: f64) -> Verdict {
    let attenuation = water.attenuation;
    let known = attenuation.error <= KNOWN * attenuation.value;
    if !wet || attenuation.value * far < THINNEST {
        Verdict::NoWater
    } else if !(known && attenuation.value * median < THICKEST) {
        Verdict::NotObservable
    } else if water.backscatter_alone <= APART && !water.veil_assumed {
        Verdict::Found
    } else {
        Verdict::VeilNotSeparable
    }
}

/// Ratio of the largest to the smallest attenuation below which the loss of light is grey. In all ten of
/// Jerlov's types of water, red, green and blue differ by more than a factor of 1.6.
const GREY: f64 = 1.5;

/// True if the attenuations are alike.
pub(crate) fn grey(channels: &[ChannelWater; 3]) -> bool {
    if !channels.iter().all(|c| c.verdict.usable()) {
        return false;
    }
    let by = |f: fn(f64, f64) -> f64, start: f64| channels.iter().map(|c| c.attenuation.value).fold(start, f);
    by(f64::max, 0.0) < GREY * by(f64::min, f64::INFINITY)
}
