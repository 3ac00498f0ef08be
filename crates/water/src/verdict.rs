//! What can be relied on.

use std::fmt;

use crate::estimate::ChannelWater;

/// What the capture tells about one channel's water.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Attenuation, backscatter and veil are all known.
    Found,
    /// Attenuation is known. Backscatter and veil are known only together (a weak veil far off looks like a
    /// strong one near by): `β_b` leans on the assumption that it is of the size of `β_a`.
    VeilNotSeparable,
    /// Distance changes nothing that water would explain.
    NoWater,
    /// Distance changes something, but attenuation cannot be told from the rest.
    NotObservable,
    /// Too few points were seen from different distances.
    TooFewPoints,
}

impl Verdict {
    /// One word for files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Found => "found",
            Self::VeilNotSeparable => "veil-not-separable",
            Self::NoWater => "no-water",
            Self::NotObservable => "not-observable",
            Self::TooFewPoints => "too-few-points",
        }
    }

    /// Whether the attenuation can be used.
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

/// Least t statistic of water against none.
const SIGNIFICANT: f64 = 3.0;
/// Least share of the loss that water must explain.
const EXPLAINED: f64 = 0.03;
/// Largest relative error of an attenuation that counts as known.
const KNOWN: f64 = 0.35;
/// Largest relative error of `β_b`, nothing assumed about its size, with which it counts as told apart from
/// the veil.
const APART: f64 = 0.2;
/// An optical depth (`β_a` times the distance of the far points) below this is what differences in sharpness
/// alone can show.
const THINNEST: f64 = 0.06;

/// An optical depth of the median distance beyond this leaves less than a hundredth of a point's light: what
/// was fitted is not what is seen.
const THICKEST: f64 = 5.0;

/// True if there is water at all.
pub(crate) fn present(significance: f64, explained: f64) -> bool {
    significance >= SIGNIFICANT && explained >= EXPLAINED
}

/// The verdict on a channel of a capture with water (`wet`), at the median distance and that of the far
/// points.
pub(crate) fn judge(water: &ChannelWater, wet: bool, median: f64, far: f64) -> Verdict {
    let attenuation = water.attenuation;
    let known = attenuation.error <= KNOWN * attenuation.value;
    if !wet || attenuation.value * far < THINNEST {
        Verdict::NoWater
    } else if !(known && attenuation.value * median < THICKEST) {
        Verdict::NotObservable
    } else if water.backscatter_alone <= APART {
        Verdict::Found
    } else {
        Verdict::VeilNotSeparable
    }
}

/// Largest over smallest attenuation of a grey loss. In none of Jerlov's ten types of water are red, green
/// and blue within 1.6.
const GREY: f64 = 1.5;

/// Whether the attenuations are alike.
pub(crate) fn grey(channels: &[ChannelWater; 3]) -> bool {
    if !channels.iter().all(|c| c.verdict.usable()) {
        return false;
    }
    let by = |f: fn(f64, f64) -> f64, start: f64| channels.iter().map(|c| c.attenuation.value).fold(start, f);
    by(f64::max, 0.0) < GREY * by(f64::min, f64::INFINITY)
}
