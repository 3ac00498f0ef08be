//! A capture's water from its tracks, in the frame and unit of its COLMAP model, for people and for scripts.
//!
//! Only training views are looked at, so that held-out views stay unseen.

use std::fmt;

use serde::Serialize;
use use3d_capture::Frame;
use use3d_io_colmap::{ImportError, Imported, load_mask, load_pixels};
use use3d_reconstruct::FoundWater;
use use3d_water::{ChannelWater, Measured, ObserveError, Verdict, Water, WaterParams, estimate, observe};

/// Why a capture's tracks could not be looked up.
#[derive(Debug, thiserror::Error)]
pub enum TracksError {
    /// An image or mask cannot be read.
    #[error(transparent)]
    Import(#[from] ImportError),
    /// Tracks and views do not belong together.
    #[error(transparent)]
    Observe(#[from] ObserveError),
}

/// Estimates the water of a prepared capture, in its normalised frame.
///
/// # Errors
/// An image that cannot be read. A capture that cannot tell is no error: the verdicts say so.
pub fn from_tracks(imported: &Imported, params: &WaterParams) -> Result<Water, TracksError> {
    let capture = &imported.capture;
    let tracks = imported.tracks();
    let cameras: Vec<_> = capture.views.iter().map(|v| v.camera).collect();
    let observations = observe::<TracksError>(&cameras, &tracks, |view| {
        if capture.split.train.binary_search(&view).is_err() {
            return Ok(None);
        }
        let view = &capture.views[view];
        Ok(Some((load_pixels(view)?.to_image(), load_mask(view)?)))
    })?;
    let positions: Vec<_> = tracks.iter().map(|t| t.position).collect();
    Ok(estimate(&observations, tracks.len(), &positions, cameras.len(), params))
}

/// What training may start from; `None` where a channel is not known, or where the channels lose alike, as with lamps, exposure
/// or haze in air. A channel on which distance shows no water loses nothing, if another channel does.
pub fn found_water(water: &Water) -> Option<FoundWater> {
    let known = |c: &ChannelWater| c.verdict.usable() || c.verdict == Verdict::NoWater;
    let any = water.channels.iter().any(|c| c.verdict.usable());
    if water.grey || !any || !water.channels.iter().all(known) {
        return None;
    }
    let of = |value: fn(&ChannelWater) -> f64| {
        water.channels.each_ref().map(|c| if c.verdict.usable() { value(c) } else { 0.0 })
    };
    let radiances = water.radiances.iter();
    Some(FoundWater {
        attenuation: of(|c| c.attenuation.value),
        backscatter: of(|c| c.backscatter.value),
        veil: of(|c| c.veil_constant),
        veil_slope: water.channels.each_ref().map(|c| c.veil_slope),
        radiances: radiances.map(|point| point.map(|p| p.map(|m| (m.value, m.error)))).collect(),
    })
}

/// What is told about a capture's water. Lengths are COLMAP units, directions COLMAP's axes.
#[derive(Clone, Debug, Serialize)]
pub struct WaterReport {
    /// `"3d-use water"`.
    pub format: &'static str,
    /// 1.
    pub version: u32,
    /// The capture's name.
    pub capture: String,
    /// Points seen from distances that differ by a quarter and more.
    pub points: usize,
    /// 5th, 50th and 95th percentile of the distances.
    pub distances: [f64; 3],
    /// Whether the channels' attenuations are alike, as lamps, exposure or a haze make them.
    pub grey: bool,
    /// Red, green, blue.
    pub channels: Vec<ChannelReport>,
    /// Gain of every view where exposure changes: name, R, G, B.
    pub gains: Vec<(String, [f64; 3])>,
}

/// A value and its standard error; no error where nothing was estimated.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ValueReport {
    /// The estimate.
    pub value: f64,
    /// Its standard error.
    pub error: Option<f64>,
}

/// One channel.
#[derive(Clone, Debug, Serialize)]
pub struct ChannelReport {
    /// `red`, `green` or `blue`.
    pub channel: &'static str,
    /// `found`, `veil-not-separable`, `no-water`, `not-observable` or `too-few-points`.
    pub verdict: &'static str,
    /// The verdict as a sentence.
    pub told: String,
    /// `β_a`, 1/unit.
    pub attenuation: ValueReport,
    /// `β_b`, 1/unit.
    pub backscatter: ValueReport,
    /// The veil in the mean direction of all observations, display range.
    pub veil: ValueReport,
    /// `c_m(d) = veil_constant + veil_slope · d` for unit directions d.
    pub veil_constant: f64,
    /// See `veil_constant`.
    pub veil_slope: [f64; 3],
    /// Correlation of the errors of `ln β_b` and `ln veil`.
    pub backscatter_veil_correlation: f64,
    /// t statistic of this water against none.
    pub significance: f64,
    /// Share of what distance changes that water explains.
    pub explained: f64,
    /// Points and observations that were used.
    pub used: [usize; 2],
}

impl WaterReport {
    /// The report of `water`, estimated in the capture's normalised frame.
    pub fn new(imported: &Imported, water: &Water) -> Self {
        let capture = &imported.capture;
        let frame = &capture.frame;
        let names = ["red", "green", "blue"];
        let gains = (capture.views.iter().zip(&water.gains))
            .filter(|_| water.gains.iter().flatten().any(|g| *g != 1.0))
            .map(|(view, gains)| (view.name.to_string(), *gains))
            .collect();
        Self {
            format: "3d-use water",
            version: 1,
            capture: capture.name.clone(),
            points: water.points,
            distances: water.distances.map(|s| s / frame.scale),
            grey: water.grey,
            channels: water.channels.iter().zip(names).map(|(w, name)| channel(name, w, frame)).collect(),
            gains,
        }
    }
}

fn channel(channel: &'static str, water: &ChannelWater, frame: &Frame) -> ChannelReport {
    let told = |m: Measured, scale: f64| ValueReport {
        value: m.value * scale,
        error: m.error.is_finite().then_some(m.error * scale),
    };
    ChannelReport {
        channel,
        verdict: water.verdict.name(),
        told: water.verdict.to_string(),
        attenuation: told(water.attenuation, frame.scale),
        backscatter: told(water.backscatter, frame.scale),
        veil: told(water.veil, 1.0),
        veil_constant: water.veil_constant,
        veil_slope: frame.rotation.transpose().mul_vec3(water.veil_slope.into()).to_array(),
        backscatter_veil_correlation: water.backscatter_veil_correlation,
        significance: water.significance,
        explained: water.explained,
        used: [water.points, water.observations],
    }
}

impl fmt::Display for ValueReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.error {
            Some(error) => write!(f, "{:.4} ± {error:.4}", self.value),
            None => f.write_str("–"),
        }
    }
}

impl fmt::Display for WaterReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [near, _, far] = self.distances;
        write!(f, "water of {}: {} points seen from different distances", self.capture, self.points)?;
        if self.points > 0 {
            write!(f, ", {near:.2} to {far:.2} COLMAP units away")?;
        }
        writeln!(f)?;
        writeln!(f, "{:6} {:>20} {:>20} {:>18}", "", "attenuation /unit", "backscatter /unit", "veil")?;
        for c in &self.channels {
            let cells = [c.attenuation, c.backscatter, c.veil].map(|v| v.to_string());
            writeln!(f, "{:6} {:>20} {:>20} {:>18}  {}", c.channel, cells[0], cells[1], cells[2], c.told)?;
        }
        if self.grey {
            writeln!(
                f,
                "the channels lose alike: a haze, lamps or exposure do that; clear water takes red first"
            )?;
        }
        let values = |c: usize| self.gains.iter().map(move |(_, g)| g[c]);
        for (c, name) in
            ["red", "green", "blue"].iter().enumerate().filter(|(c, _)| values(*c).any(|g| g != 1.0))
        {
            let (low, high) = values(c).fold((f64::INFINITY, 0.0f64), |(l, h), g| (l.min(g), h.max(g)));
            writeln!(f, "exposure changes in {name}: gains {low:.2} to {high:.2}")?;
        }
        Ok(())
    }
}
