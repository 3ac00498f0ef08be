//! Depth maps against the points of the model.
//!
//! A depth prior is larger where things are nearer (R14). So at the places where a view saw points, the rank
//! correlation of the map's values with the points' depths is near −1. For a map of distances it is near 1.

use std::collections::BTreeMap;

use glam::DVec3;
use rayon::prelude::*;
use use3d_capture::{Map, View};
use use3d_io_image::{image_info, is_cut_off, read_map};
use use3d_numerics::order::median;
use use3d_survey::{PointSight, PosedCamera, PosedImage, Survey, rank_correlation};

use crate::report::some;

/// The fewest places at which a map is compared with points, and the most.
const FEWEST: usize = 30;
const MOST: usize = 500;
/// Maps, evenly chosen, whose values are compared with points.
const COMPARED: usize = 16;
/// A median correlation above this is that of distances.
const DISTANCES: f64 = 0.3;

/// A point as a view sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthSight {
    /// Its place, as shares of the photograph's width and height.
    pub at: [f64; 2],
    /// Its distance along the optical axis, units of the model.
    pub depth: f64,
}

impl DepthSight {
    /// The rank correlation of a map of the whole photograph with the depths of points, where the map is
    /// known; `None` with too few points.
    pub fn correlation(sights: &[Self], map: &Map) -> Option<f64> {
        let (w, h) = (map.width(), map.height());
        let value = |sight: &Self| {
            let place =
                |share: f64, side: usize| ((share * side as f64) as usize).min(side.saturating_sub(1));
            let value = *map.data().get(place(sight.at[1], h) * w + place(sight.at[0], w))?;
            (value > 0.0).then_some((f64::from(value), sight.depth))
        };
        let (values, depths): (Vec<f64>, Vec<f64>) = sights.iter().filter_map(value).unzip();
        (values.len() >= FEWEST).then(|| rank_correlation(&values, &depths)).flatten()
    }
}

/// The points that each image saw, by its id, evenly chosen. Without tracks, the points that land in it.
pub fn depth_sights(survey: &Survey) -> BTreeMap<u32, Vec<DepthSight>> {
    let images: BTreeMap<u32, &PosedImage> = survey.images.iter().map(|image| (image.id, image)).collect();
    let mut seen = survey.tracked_sights();
    if seen.is_empty() {
        seen = survey.landing_sights(4 * MOST);
    }
    let of_image = |(id, list): (u32, Vec<PointSight>)| {
        let PosedCamera { pose, camera } = survey.posed(images.get(&id)?)?;
        let sides = [camera.width as f64, camera.height as f64];
        let sight = |seen: &PointSight| {
            let at = [seen.at[0] / sides[0], seen.at[1] / sides[1]];
            let position = DVec3::from_array(survey.points[seen.point].position);
            let depth = (pose.rotation * position + pose.translation).z;
            (at.iter().all(|s| (0.0..1.0).contains(s)) && depth > 0.0).then_some(DepthSight { at, depth })
        };
        Some((id, list.iter().step_by((list.len() / MOST).max(1)).filter_map(sight).collect()))
    };
    seen.into_iter().filter_map(of_image).collect()
}

/// Takes maps away from views: files that are no maps, and all maps if they are distances. Returns a sentence
/// on each kind.
pub(crate) fn leave_out(mut views: Vec<&mut View>, survey: &Survey) -> Vec<String> {
    views.retain(|view| view.depth_prior.is_some());
    if views.is_empty() {
        return Vec::new();
    }
    let sights = depth_sights(survey);
    let step = views.len().div_ceil(COMPARED);
    // `None` for a file that is no map.
    let looked = |(at, view): (usize, &&mut View)| {
        let path = view.depth_prior.as_ref()?;
        if at % step != 0 {
            let format = image_info(path).ok()?.format;
            return is_cut_off(path, format).is_ok_and(|cut_off| !cut_off).then_some(None);
        }
        let map = read_map(path).ok()?;
        Some(sights.get(&view.id).and_then(|sights| DepthSight::correlation(sights, &map)))
    };
    let looked: Vec<Option<Option<f64>>> = views.par_iter().enumerate().map(looked).collect();
    let mut faults = Vec::new();
    let mut damaged = Vec::new();
    for (view, _) in views.iter_mut().zip(&looked).filter(|(_, looked)| looked.is_none()) {
        view.depth_prior = None;
        damaged.push(view.name.as_str());
    }
    if !damaged.is_empty() {
        faults.push(format!(
            "the depth maps of these views cannot be read and are left out: {}; write them again",
            some(&damaged)
        ));
    }
    if median(looked.into_iter().flatten().flatten()).is_some_and(|median| median > DISTANCES) {
        faults.push(
            "the depth maps are larger where things are farther, so they are distances and are not used; write them so \
             that larger is nearer, such as 1 divided by the distance (docs/reference/captures.md)"
                .into(),
        );
        views.into_iter().for_each(|view| view.depth_prior = None);
    }
    faults
}
