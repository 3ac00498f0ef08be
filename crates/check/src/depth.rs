//! Depth maps against the points that their views saw.
//!
//! The rank correlation of a map with the depths of a view's points is near −1 for its own map. A map of
//! another view of the same scene can come near, but the view's own map, under another name, then fits the
//! points much better: its distance from −1 is less than half of that.

use std::collections::BTreeSet;
use std::path::PathBuf;

use rayon::prelude::*;
use serde::Serialize;
use use3d_import::{DepthSight, Imported, depth_sights};
use use3d_io_image::read_map;

use crate::agreement::Pixels;
use crate::report::{Finding, Severity};

/// The most views whose maps are compared with each other, before a run and in a check.
const VIEWS: [usize; 2] = [12, 60];
/// A map with fewer steps between near and far is coarse.
const STEPS: usize = 32;
/// The correlation above which a map does not show the distances of its view.
const UNLIKE: f64 = -0.3;
/// A map fits much worse than another one if its distance from −1 is more than this many times the other's,
/// and this much more.
const WORSE: (f64, f64) = (2.0, 0.02);

/// A view's depth map and the points that the view saw.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct DepthAgreement {
    /// The view's name.
    pub name: String,
    /// The number of different known values, at most 32.
    pub steps: usize,
    /// The rank correlation with the depths of the view's points; `None` with too few points.
    pub correlation: Option<f64>,
    /// The same for the map that fits the points best.
    pub best: Option<f64>,
}

/// The depth maps of a capture's views, evenly chosen.
pub(crate) fn depth_maps(imported: &Imported, pixels: Pixels) -> Vec<DepthAgreement> {
    let with = imported.capture.views.iter().filter(|view| view.depth_prior.is_some());
    let with: Vec<_> = with.collect();
    let most = match pixels {
        Pixels::None => return Vec::new(),
        Pixels::Few => VIEWS[0],
        Pixels::All => VIEWS[1],
    };
    if with.is_empty() {
        return Vec::new();
    }
    let sights = depth_sights(&imported.model);
    let chosen: Vec<_> = with.iter().step_by(with.len().div_ceil(most)).collect();
    let correlations = |path: &PathBuf| {
        let map = read_map(path).ok()?;
        let mut values = BTreeSet::new();
        for value in map.data().iter().filter(|v| **v > 0.0) {
            if values.insert(value.to_bits()) && values.len() >= STEPS {
                break;
            }
        }
        let of = |id: &u32| DepthSight::correlation(sights.get(id)?, &map);
        Some((values.len(), chosen.iter().map(|view| of(&view.id)).collect::<Vec<_>>()))
    };
    let maps: Vec<_> =
        chosen.par_iter().map(|view| view.depth_prior.as_ref().and_then(correlations)).collect();
    let view = |(i, own): (usize, &Option<(usize, Vec<Option<f64>>)>)| {
        let (steps, row) = own.as_ref()?;
        let best = maps.iter().flatten().filter_map(|(_, row)| row[i]).reduce(f64::min);
        Some(DepthAgreement { name: chosen[i].name.to_string(), steps: *steps, correlation: row[i], best })
    };
    maps.iter().enumerate().filter_map(view).collect()
}

/// The findings on depth maps.
pub(crate) fn findings(maps: &[DepthAgreement]) -> Vec<Finding> {
    let list = |those: &dyn Fn(&DepthAgreement) -> bool| -> Vec<String> {
        maps.iter().filter(|map| those(map)).map(|map| map.name.clone()).collect()
    };
    let mut found = Vec::new();
    let mut add = |severity, text: String, remedy: &str, views| {
        found.push(Finding { severity, subject: "depth", text, remedy: remedy.into(), views });
    };
    let is_other = |map: &DepthAgreement| {
        let Some((own, best)) = map.correlation.zip(map.best) else { return false };
        own > UNLIKE || 1.0 + own > WORSE.0 * (1.0 + best) + WORSE.1
    };
    let others = list(&is_other);
    if !others.is_empty() {
        let text = format!(
            "The depth maps of {} of {} views do not show the distances of their points: they belong to other photographs.",
            others.len(),
            maps.len()
        );
        let remedy =
            "give each map the name of its photograph, write them again, or remove the folder of depth maps";
        add(Severity::Serious, text, remedy, others);
    }
    let coarse = list(&|map| map.steps < STEPS);
    if !coarse.is_empty() {
        let text = format!(
            "The depth maps of {} of {} views have fewer than {STEPS} steps.",
            coarse.len(),
            maps.len()
        );
        let remedy = "write them with 16 bits, from the whole range of the network that made them";
        add(Severity::Minor, text, remedy, coarse);
    }
    found
}
