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

use crate::agreement::PixelsRead;

/// The most views whose maps are compared with each other, before a run and in a check.
const VIEWS: [usize; 2] = [12, 60];
/// A map with fewer steps between near and far is coarse.
pub(crate) const STEPS: usize = 32;
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

/// A map's number of values, and its correlation with the points of each view.
type Steps = (usize, Vec<Option<f64>>);

impl DepthAgreement {
    /// True if the map is that of another view.
    pub(crate) fn is_other(&self) -> bool {
        let Some((own, best)) = self.correlation.zip(self.best) else { return false };
        own > UNLIKE || 1.0 + own > WORSE.0 * (1.0 + best) + WORSE.1
    }

    /// True if the map has few steps between near and far.
    pub(crate) fn is_coarse(&self) -> bool {
        self.steps < STEPS
    }
}

/// The depth maps of a capture's views, evenly chosen.
pub(crate) fn depth_maps(imported: &Imported, pixels: PixelsRead) -> Vec<DepthAgreement> {
    let with = imported.capture.views.iter().filter(|view| view.depth_prior.is_some());
    let with: Vec<_> = with.collect();
    let most = match pixels {
        PixelsRead::Few => VIEWS[0],
        PixelsRead::All => VIEWS[1],
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
    let view = |(i, own): (usize, &Option<Steps>)| {
        let (steps, row) = own.as_ref()?;
        let best = maps.iter().flatten().filter_map(|(_, row)| row[i]).reduce(f64::min);
        Some(DepthAgreement { name: chosen[i].name.to_string(), steps: *steps, correlation: row[i], best })
    };
    maps.iter().enumerate().filter_map(view).collect()
}
