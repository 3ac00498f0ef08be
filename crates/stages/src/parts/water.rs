//! A capture's water from its tracks, in the frame and unit of its COLMAP model, as a report for users and
//! scripts.
//!
//! Only training views are used, so that held-out views stay unseen.

use std::fmt;
use std::path::Path;

use serde::Serialize;
use use3d_capture::{Frame, World};
use use3d_import::Imported;
use use3d_numerics::math;
use use3d_numerics::order::Ascending;
use use3d_reconstruct::FoundWater;
use use3d_water::{ChannelWater, JERLOV, Measured, Verdict, Water, WaterParams, estimate_sizes, shows_air};

pub use super::judgement::Judgement;
use crate::parts::sights::CaptureSights;
pub use crate::parts::sights::SightsError;

/// Estimates the water of the capture that was imported into `folder`, in its normalised frame.
///
/// # Errors
/// Fails if an image cannot be read. Water that cannot be determined is no error: the verdicts report it.
pub fn from_tracks(
    folder: &Path,
    imported: &Imported,
    params: &WaterParams,
) -> Result<(Water, Judgement), SightsError> {
    let seen = CaptureSights::of_import(folder, imported)?;
    let positions: Vec<_> = imported.capture.points.iter().map(|p| p.position).collect();
    let views = imported.capture.views.len();
    let mut water = estimate_sizes(&seen.sizes, positions.len(), &positions, views, params);
    let untold = water.channels.iter().all(|c| c.verdict == Verdict::TooFewPoints);
    let judgement = if untold && shows_air(&seen.point_colors) {
        water.channels.iter_mut().for_each(|c| c.verdict = Verdict::NoWater);
        Judgement::Air
    } else {
        Judgement::of(&water)
    };
    Ok((water, judgement))
}

impl Judgement {
    fn of(water: &Water) -> Self {
        let dry = water.channels.iter().all(|c| c.verdict == Verdict::NoWater);
        match water {
            _ if water.sky => Self::Sky,
            _ if dry => Self::Dry,
            _ if lamps(water) => Self::Lamps,
            _ if known(water) => Self::Found,
            _ => Self::Unknown,
        }
    }
}

/// The names of the channels.
const CHANNELS: [&str; 3] = ["red", "green", "blue"];
/// Largest change of the optical depth of far points by two standard errors of an attenuation: a third of
/// their radiance.
const SMALL: f64 = 0.3;
/// Largest plausible 95th percentile of the points' radiance (display range) after only water is removed: a
/// little above white.
const BRIGHTEST: f64 = 1.3;

/// True if points would certainly (by two standard errors) be brighter than white without the loss over
/// distance. Light from the camera (lamps) falls off with the distance, and water can explain that only with
/// colours that no surface has.
fn lamps(water: &Water) -> bool {
    let surely = |c: usize| radiance(water, |p| p[c].value - 2.0 * p[c].error)[2];
    (0..3).any(|c| water.channels[c].verdict.usable() && surely(c) > BRIGHTEST)
}

/// 5th, 50th and 95th percentile of a quantity over the points; 0 if there are none.
fn radiance(water: &Water, of: impl Fn(&[Measured; 3]) -> f64) -> [f64; 3] {
    let all = Ascending::of(water.radiances.iter().flatten().map(of).filter(|v| v.is_finite()));
    [0.05, 0.5, 0.95].map(|share| all.at(share).unwrap_or(0.0))
}

/// True if a channel is known, or if its value matters little: its standard error hardly changes the radiance
/// of far points.
fn told(water: &Water, c: &ChannelWater) -> bool {
    let small = water.distances[2] * 2.0 * c.attenuation.error < SMALL;
    c.verdict.usable() || (c.verdict != Verdict::TooFewPoints && small)
}

/// True if every channel is known, and at least one of them has water. A channel whose colours do not change
/// with distance loses nothing. A loss that is equal in all channels (haze, or a camera that balances each
/// view) is as good a start as any: what far points have lost is lost in the photographs.
fn known(water: &Water) -> bool {
    let known = |c: &ChannelWater| told(water, c) || c.verdict == Verdict::NoWater;
    water.channels.iter().any(|c| c.verdict.usable()) && water.channels.iter().all(known)
}

/// The water that training may start from; `None` unless it was [found](Judgement::Found).
pub fn found_water(water: &Water, judgement: Judgement) -> Option<FoundWater> {
    if judgement != Judgement::Found {
        return None;
    }
    let of = |value: fn(&ChannelWater) -> f64| {
        water.channels.each_ref().map(|c| if told(water, c) { value(c) } else { 0.0 })
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

/// The report on a capture's water. Lengths are in units of its model, directions along the model's axes.
#[derive(Clone, Debug, Serialize)]
pub struct WaterReport {
    /// The fixed text `"3d-use water"`.
    pub format: &'static str,
    /// The version of the format, 1.
    pub version: u32,
    /// The capture's name.
    pub capture: String,
    /// The judgement: `found`, `no-water`, `lamps` or `not-known`.
    pub judgement: &'static str,
    /// The judgement as a sentence.
    pub told: String,
    /// Number of points seen from distances that differ by a quarter or more.
    pub points: usize,
    /// Number of cells of open water that the veil was measured in; 0 if none or too few were seen.
    pub open_water: usize,
    /// 5th, 50th and 95th percentile of the distances.
    pub distances: [f64; 3],
    /// True if the channels' attenuations are alike, as with lamps, changing exposure or haze.
    pub grey: bool,
    /// The channels red, green and blue.
    pub channels: Vec<ChannelReport>,
    /// Gain of every view if the exposure changes: name, R, G, B.
    pub gains: Vec<(String, [f64; 3])>,
    /// The same water per metre, if the capture's metres are known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub metric: Option<MetricWater>,
}

/// Water per metre.
#[derive(Clone, Debug, Serialize)]
pub struct MetricWater {
    /// Metres in one unit of the model.
    pub metres_per_unit: f64,
    /// The statement that the metres rest on.
    pub source: String,
    /// `β_a` of red, green and blue, 1/m.
    pub attenuation: [ValueReport; 3],
    /// `β_b` of red, green and blue, 1/m.
    pub backscatter: [ValueReport; 3],
    /// Jerlov's type with the most similar attenuation, and its attenuation, 1/m; none unless all channels
    /// are known.
    pub nearest: Option<(&'static str, [f64; 3])>,
}

impl MetricWater {
    fn new(world: &World, channels: &[ChannelReport]) -> Option<Self> {
        let per_metre = |v: ValueReport| ValueReport {
            value: v.value / world.metres_per_unit,
            error: v.error.map(|e| e / world.metres_per_unit),
        };
        let of = |value: fn(&ChannelReport) -> ValueReport| -> Option<[ValueReport; 3]> {
            let all: Vec<ValueReport> = channels.iter().map(|c| per_metre(value(c))).collect();
            all.try_into().ok()
        };
        let (attenuation, backscatter) = (of(|c| c.attenuation)?, of(|c| c.backscatter)?);
        let known = channels.iter().all(|c| c.usable) && attenuation.iter().all(|v| v.value > 0.0);
        let apart = |kind: &(&str, [f64; 3])| -> f64 {
            let pairs = kind.1.into_iter().zip(&attenuation);
            pairs.map(|(k, v)| math::ln(v.value / k)).map(|d| d * d).sum()
        };
        let nearest = JERLOV.into_iter().min_by(|a, b| apart(a).total_cmp(&apart(b)));
        Some(Self {
            metres_per_unit: world.metres_per_unit,
            source: world.source.clone(),
            attenuation,
            backscatter,
            nearest: nearest.filter(|_| known),
        })
    }
}

/// A value and its standard error; no error if nothing was estimated.
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
    /// True if the channel's values can be used.
    #[serde(skip)]
    usable: bool,
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
    /// True if the veil is assumed and not measured: the camera clipped this channel's open water to black.
    pub veil_assumed: bool,
    /// Correlation of the errors of `ln β_b` and `ln veil`.
    pub backscatter_veil_correlation: f64,
    /// The t statistic of this water against no water.
    pub significance: f64,
    /// Share of the change over distance that water explains.
    pub explained: f64,
    /// 5th, 50th and 95th percentile of the points' radiance without water, display range.
    pub radiance: [f64; 3],
    /// Number of points and number of observations that were used.
    pub used: [usize; 2],
}

/// The verdicts of all colours in one line, each verdict once: `red: found; green and blue: not observable`.
pub(crate) fn by_verdict(channels: &[ChannelReport]) -> String {
    let mut groups: Vec<(Vec<&str>, &str)> = Vec::new();
    for c in channels {
        match groups.iter_mut().find(|(_, told)| *told == c.told) {
            Some((names, _)) => names.push(c.channel),
            None => groups.push((vec![c.channel], &c.told)),
        }
    }
    let line = |(names, told): &(Vec<&str>, &str)| {
        let names = if names.len() == channels.len() { "all colours".into() } else { names.join(" and ") };
        format!("{names}: {}", told.replace(';', ","))
    };
    groups.iter().map(line).collect::<Vec<_>>().join("; ")
}

impl WaterReport {
    /// The report of `water`, estimated in the capture's normalised frame.
    pub fn new(imported: &Imported, water: &Water, judgement: Judgement) -> Self {
        let capture = &imported.capture;
        let frame = &capture.frame;
        let gains = (capture.views.iter().zip(&water.gains))
            .filter(|_| water.gains.iter().flatten().any(|g| *g != 1.0))
            .map(|(view, gains)| (view.name.to_string(), *gains))
            .collect();
        let channels: Vec<ChannelReport> = (water.channels.iter().zip(CHANNELS).enumerate())
            .map(|(c, (w, name))| channel(name, w, radiance(water, |p| p[c].value), frame))
            .collect();
        let world = imported.model.world.as_ref();
        Self {
            format: "3d-use water",
            version: 1,
            capture: capture.name.clone(),
            judgement: judgement.name(),
            told: judgement.to_string(),
            points: water.points,
            open_water: water.open,
            distances: water.distances.map(|s| s / frame.scale),
            grey: water.grey,
            metric: world.and_then(|world| MetricWater::new(world, &channels)),
            channels,
            gains,
        }
    }

    /// The attenuation of all channels with its standard errors, in words: per metre, with the backscatter,
    /// if the metres are known.
    pub fn attenuation(&self) -> String {
        let number = |v: Option<f64>| v.map_or_else(|| "–".to_string(), |v| format!("{v:.4}"));
        let listed = |values: &[ValueReport]| {
            let channel = |(name, v): (&str, &ValueReport)| {
                format!("{name} {} ± {}", number(Some(v.value)), number(v.error))
            };
            CHANNELS.into_iter().zip(values).map(channel).collect::<Vec<_>>().join(", ")
        };
        let Some(MetricWater { attenuation, backscatter, nearest, .. }) = &self.metric else {
            let values: Vec<ValueReport> = self.channels.iter().map(|c| c.attenuation).collect();
            return format!("attenuation {} per unit of the model", listed(&values));
        };
        let like = nearest.map(|(name, _)| format!("; Jerlov's water type {name} is the most similar"));
        let (attenuation, backscatter) = (listed(attenuation), listed(backscatter));
        let like = like.unwrap_or_default();
        format!("attenuation {attenuation} per metre, backscatter {backscatter} per metre{like}")
    }
}

fn channel(channel: &'static str, water: &ChannelWater, radiance: [f64; 3], frame: &Frame) -> ChannelReport {
    let told = |m: Measured, scale: f64| ValueReport {
        value: m.value * scale,
        error: m.error.is_finite().then_some(m.error * scale),
    };
    ChannelReport {
        channel,
        verdict: water.verdict.name(),
        usable: water.verdict.usable(),
        told: match water.veil_assumed && water.verdict.usable() {
            true => format!("{}; veil assumed, because open water is clipped to black", water.verdict),
            false => water.verdict.to_string(),
        },
        attenuation: told(water.attenuation, frame.scale),
        backscatter: told(water.backscatter, frame.scale),
        veil: told(water.veil, 1.0),
        veil_constant: water.veil_constant,
        veil_slope: frame.rotation.transpose().mul_vec3(water.veil_slope.into()).to_array(),
        veil_assumed: water.veil_assumed,
        backscatter_veil_correlation: water.backscatter_veil_correlation,
        significance: water.significance,
        explained: water.explained,
        radiance,
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
            write!(f, ", {near:.2} to {far:.2} units of the model away")?;
        }
        writeln!(f)?;
        if self.open_water > 0 {
            writeln!(f, "open water is visible in {} places; the veil is measured there", self.open_water)?;
        }
        writeln!(f, "{:6} {:>20} {:>20} {:>18}", "", "attenuation /unit", "backscatter /unit", "veil")?;
        for c in &self.channels {
            let cells = [c.attenuation, c.backscatter, c.veil].map(|v| v.to_string());
            writeln!(f, "{:6} {:>20} {:>20} {:>18}  {}", c.channel, cells[0], cells[1], cells[2], c.told)?;
        }
        if let Some(metric) = &self.metric {
            let MetricWater { metres_per_unit, source, attenuation, backscatter, nearest } = metric;
            writeln!(f, "per metre (1 unit is {metres_per_unit:.4} m, by {source}):")?;
            for (c, name) in CHANNELS.into_iter().enumerate() {
                let cells = [attenuation[c], backscatter[c]].map(|v| v.to_string());
                writeln!(f, "{name:6} {:>20} {:>20}", cells[0], cells[1])?;
            }
            if let Some((kind, [r, g, b])) = nearest {
                write!(f, "Jerlov's water type {kind} is the most similar: ")?;
                writeln!(f, "attenuation {r:.2}, {g:.2}, {b:.2} per metre")?;
            }
        }
        writeln!(f, "{}", self.told)?;
        if self.grey {
            write!(f, "all colours fade at the same rate: haze, lamps or exposure can cause that; ")?;
            writeln!(f, "clear water absorbs red first")?;
        }
        let values = |c: usize| self.gains.iter().map(move |(_, g)| g[c]);
        for (c, name) in CHANNELS.iter().enumerate().filter(|(c, _)| values(*c).any(|g| g != 1.0)) {
            let (low, high) = values(c).fold((f64::INFINITY, 0.0f64), |(l, h), g| (l.min(g), h.max(g)));
            writeln!(f, "exposure changes in {name}: gains {low:.2} to {high:.2}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn measured(value: f64, error: f64) -> Measured {
        Measured { value, error }
    }

    /// Points of `radiance` seen up to 4 units away, in water that attenuates by `attenuation` per unit.
    fn water(verdicts: [Verdict; 3], attenuation: [f64; 3], error: f64, radiance: f64) -> Water {
        let channel = |c: usize| ChannelWater {
            verdict: verdicts[c],
            attenuation: measured(attenuation[c], error),
            backscatter: measured(attenuation[c], error),
            veil: measured(0.3, 0.01),
            veil_constant: 0.3,
            veil_slope: [0.0; 3],
            veil_assumed: false,
            backscatter_veil_correlation: 0.0,
            backscatter_alone: 0.1,
            significance: 9.0,
            explained: 0.5,
            gains_explain: 0.0,
            noise: [0.01, 0.1],
            points: 200,
            observations: 900,
        };
        Water {
            channels: [0, 1, 2].map(channel),
            sky: false,
            significance: 9.0,
            explained: 0.5,
            gains: vec![[1.0; 3]; 2],
            radiances: vec![None, Some([measured(radiance, 0.01); 3]), Some([measured(0.2, 0.01); 3])],
            points: 200,
            open: 0,
            distances: [1.0, 2.0, 4.0],
            grey: false,
        }
    }

    fn taken(water: &Water) -> Option<FoundWater> {
        found_water(water, Judgement::of(water))
    }

    #[test]
    fn water_is_taken_where_it_is_known_and_lamps_and_air_are_not_taken_for_it() {
        let found = [Verdict::Found; 3];
        let start = taken(&water(found, [0.3, 0.29, 0.28], 0.01, 0.8)).expect("losses may be alike");
        assert_eq!(start.attenuation, [0.3, 0.29, 0.28]);
        // No surface is brighter than white.
        let lit = water(found, [0.9, 0.6, 0.6], 0.01, 1.7);
        assert!(Judgement::of(&lit) == Judgement::Lamps && taken(&lit).is_none());
        // An unknown channel is accepted if it is certainly small, and else refused.
        let vague = [Verdict::Found, Verdict::NotObservable, Verdict::NotObservable];
        let small = taken(&water(vague, [0.3, 0.02, 0.02], 0.01, 0.8)).expect("nearly nothing is lost");
        assert_eq!(small.attenuation, [0.3, 0.02, 0.02]);
        assert!(taken(&water(vague, [0.3, 0.2, 0.2], 0.1, 0.8)).is_none());
        // Next to a channel with loss, channels that may have none get their estimate, unless it is a guess.
        let red = [Verdict::VeilNotSeparable, Verdict::NoWater, Verdict::NoWater];
        for (error, others) in [(0.01, 0.1), (0.05, 0.0)] {
            let start = taken(&water(red, [0.3, 0.1, 0.1], error, 0.8)).expect("red");
            assert_eq!(start.attenuation, [0.3, others, others]);
        }
        let air = water([Verdict::NoWater; 3], [0.01; 3], 0.01, 0.8);
        assert!(Judgement::of(&air) == Judgement::Dry && taken(&air).is_none());
        let sky = Water { sky: true, ..water([Verdict::NoWater; 3], [0.3; 3], 0.01, 1.7) };
        assert!(Judgement::of(&sky) == Judgement::Sky && Judgement::of(&sky).no_water());
    }

    #[test]
    fn one_line_says_each_verdict_once() {
        let line = |verdicts| {
            let water = water(verdicts, [0.3; 3], 0.01, 0.8);
            let frame = Frame::IDENTITY;
            let channels: Vec<ChannelReport> = (["red", "green", "blue"].into_iter().zip(&water.channels))
                .map(|(name, c)| channel(name, c, [0.0, 0.5, 1.0], &frame))
                .collect();
            by_verdict(&channels)
        };
        assert_eq!(line([Verdict::Found; 3]), "all colours: found");
        let mixed = [Verdict::Found, Verdict::VeilNotSeparable, Verdict::VeilNotSeparable];
        assert_eq!(
            line(mixed),
            "red: found; green and blue: attenuation found, backscatter and veil cannot be separated"
        );
    }
}
