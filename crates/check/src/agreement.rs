//! The model against its own tracks, and the photographs against the model.
//!
//! A point `X` of the model was seen in view `v` at the pixel `x`. With the projection `π_v` of the model,
//! lens included,
//!
//! * the *error* of a sighting is `‖π_v(X) − x‖`, in pixels of the model's photographs; the error of a
//!   capture is the mean over points of their mean, as COLMAP stores it;
//! * a sighting is *in view* if `π_v(X)` exists and is not farther than a twentieth of a side outside;
//! * the *likeness* of a view compares it with the other views of its points. The detail of a point in a
//!   view is the brightness of its pixel less the mean around it, in a picture of about 640 pixels. The
//!   likeness is the rank correlation (Spearman's ρ) between a view's details and the means of those in the
//!   other views. It is above 0.7 if a photograph belongs to its pose, and near 0 if another photograph is
//!   there, or the same one turned. Exposure and water hardly change the order of details. A model without
//!   tracks is compared at the points' projections, where hidden points lower the likeness;
//! * the *coverage* of a capture is the share of its points that at least three views saw, and the *angle* of
//!   a point is the largest between the rays of two of its views.
//!
//! Figures that a file states, such as COLMAP's stored error, are only compared with the measured ones.

use std::collections::BTreeMap;

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::Serialize;
use use3d_capture::{Image, Pose, View};
use use3d_import::Imported;
use use3d_io_image::{ImageError, read_image, shrunk};
use use3d_numerics::math;
use use3d_survey::{PointSight, PosedCamera, PosedImage, Survey, rank_correlation};

use crate::depth::{DepthAgreement, depth_maps};

/// The fewest sightings from which a view's figures are taken.
const FEWEST: usize = 30;
/// The most sightings of a view that are compared with its pixels; they are evenly chosen.
const MOST: usize = 1500;
/// The longer side of the pictures in which details are compared, pixels.
const SIDE: usize = 640;
/// Pixels on each side of a point that its brightness is compared with.
const AROUND: usize = 10;
/// A point this share of a side outside of a picture still counts as in view.
const MARGIN: f64 = 0.05;
/// Pixels and views that a run reads before its first stage, at most.
const PIXELS: usize = 60_000_000;
const VIEWS: usize = 24;

/// A view's agreement with the model.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ViewAgreement {
    /// Its name.
    pub name: String,
    /// The median error of its sightings, pixels of the model's photographs; `None` without tracks.
    pub error: Option<f64>,
    /// The share of its sightings whose point is in view; `None` without tracks.
    pub in_view: Option<f64>,
    /// Its likeness to the other views of its points, −1 to 1; `None` if its pixels were not read, or if it
    /// shares too few points with them.
    pub likeness: Option<f64>,
}

/// The overlap of views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ViewOverlap {
    /// The share of points that at least three views saw.
    pub share: f64,
    /// The median angle of points, degrees.
    pub angle: f64,
}

/// The agreement of a model with its tracks and photographs.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ModelAgreement {
    /// The views, in the order of the capture.
    pub views: Vec<ViewAgreement>,
    /// True if the model says which view saw which point.
    pub tracked: bool,
    /// The measured error, pixels of the model's photographs; `None` without tracks.
    pub error: Option<f64>,
    /// The error that the model's file states, pixels; `None` if it states none.
    pub stated: Option<f64>,
    /// The share of points that are in view of at least one photograph; `None` without points.
    pub in_view: Option<f64>,
    /// The overlap of the views; `None` if they see no point.
    pub coverage: Option<ViewOverlap>,
    /// The depth maps of views.
    pub depth: Vec<DepthAgreement>,
    /// Another meaning of the poses, by which most points would be in view; `None` if there is none, or if
    /// they are.
    pub instead: Option<&'static str>,
}

/// The views whose photographs are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PixelsRead {
    /// As many as can be read in seconds, evenly chosen.
    Few,
    /// All.
    All,
}

/// The exchange of axes by which nerfstudio makes z point up: `(x, y, z) → (x, z, −y)`.
const UPRIGHT: DMat3 = DMat3::from_cols(DVec3::X, DVec3::NEG_Z, DVec3::Y);

/// Tests a capture's model against its tracks and its photographs.
///
/// # Errors
/// A photograph that cannot be read.
pub(crate) fn agreement(imported: &Imported, pixels: PixelsRead) -> Result<ModelAgreement, ImageError> {
    let survey = &imported.model;
    let images: BTreeMap<u32, &PosedImage> = survey.images.iter().map(|image| (image.id, image)).collect();
    let mut of_image = survey.tracked_sights();
    let tracked = !of_image.is_empty();
    if !tracked {
        of_image = survey.landing_sights(4 * MOST);
    }
    let views = &imported.capture.views;
    let posed = |view: &View| images.get(&view.id).and_then(|image| survey.posed(image));
    let cameras: Vec<Option<PosedCamera<'_>>> = views.iter().map(posed).collect();
    let sights: Vec<Vec<PointSight>> =
        views.iter().map(|view| of_image.remove(&view.id).unwrap_or_default()).collect();

    let mut found = ModelAgreement {
        views: views
            .iter()
            .map(|view| ViewAgreement { name: view.name.to_string(), ..ViewAgreement::default() })
            .collect(),
        tracked,
        in_view: share_in_view(survey, &cameras),
        ..ModelAgreement::default()
    };
    found.coverage = coverage(imported, &sights);
    if found.in_view.is_some_and(|share| share < 0.5) {
        found.instead = misreading(survey, &cameras);
    }
    found.depth = depth_maps(imported, pixels);
    if tracked {
        found.errors(survey, &sights, &cameras);
    }
    let large = cameras.iter().flatten().map(|c| c.camera.width * c.camera.height).max().unwrap_or(1);
    let step = match pixels {
        PixelsRead::Few => (views.len() * large).div_ceil(PIXELS).max(views.len().div_ceil(VIEWS)).max(1),
        PixelsRead::All => 1,
    };
    let read = |i: usize| -> Result<Option<Shown>, ImageError> {
        match &cameras[i] {
            Some(PosedCamera { camera, .. }) if i.is_multiple_of(step) && sights[i].len() >= FEWEST => {
                let size = [camera.width as f64, camera.height as f64];
                Ok(Some(shown(&read_image(&views[i].image)?, &sights[i], size)))
            }
            _ => Ok(None),
        }
    };
    let all: Vec<Option<Shown>> = (0..views.len()).into_par_iter().map(read).collect::<Result<_, _>>()?;
    found.likeness(&all, survey.points.len());
    Ok(found)
}

/// The share of points that are in view of any photograph; `None` without points.
fn share_in_view(survey: &Survey, cameras: &[Option<PosedCamera<'_>>]) -> Option<f64> {
    let step = (survey.points.len() / 5000).max(1);
    let chosen: Vec<[f64; 3]> = survey.points.iter().step_by(step).map(|p| p.position).collect();
    let seen = |p: &&[f64; 3]| cameras.iter().flatten().any(|camera| camera.sees(**p, MARGIN));
    let count = chosen.par_iter().filter(seen).count();
    (!chosen.is_empty()).then(|| count as f64 / chosen.len() as f64)
}

/// The meaning of the poses by which half of the points are in view, if theirs is another one.
fn misreading(survey: &Survey, cameras: &[Option<PosedCamera<'_>>]) -> Option<&'static str> {
    let (flip, upright) = (DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z), UPRIGHT);
    let (one, both) = (DMat3::IDENTITY, flip * upright);
    let backward = "if the poses led from the world to the camera";
    // The words; true for the way back; and the changes of axes after and before it.
    let readings = [
        ("if y and z of the cameras' axes had the other sign", false, flip, one),
        ("if the poses led from the camera to the world", true, one, one),
        (backward, true, flip, flip),
        (backward, true, both, both),
        (backward, true, one, flip),
        (backward, true, upright, both),
    ];
    let seen = |(_, inverse, after, before): &(&str, bool, DMat3, DMat3)| {
        let reading = |pose: Pose| {
            let (rotation, translation) = match inverse {
                true => (pose.rotation.transpose(), pose.center()),
                false => (pose.rotation, pose.translation),
            };
            Pose { rotation: *after * rotation * *before, translation: *after * translation }
        };
        let moved = cameras.iter().map(|c| c.map(|c| PosedCamera { pose: reading(c.pose), ..c }));
        share_in_view(survey, &moved.collect::<Vec<_>>()).unwrap_or(0.0)
    };
    let shares = readings.map(|reading| (reading.0, seen(&reading)));
    shares
        .into_iter()
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .filter(|(_, share)| *share > 0.5)
        .map(|(words, _)| words)
}

/// The overlap of the views; `None` if they see no point.
fn coverage(imported: &Imported, sights: &[Vec<PointSight>]) -> Option<ViewOverlap> {
    let capture = &imported.capture;
    let mut views_of: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (view, sights) in sights.iter().enumerate() {
        for sight in sights {
            views_of.entry(sight.point).or_default().push(view);
        }
    }
    let thrice = views_of.values().filter(|views| views.len() >= 3).count();
    let mut angles: Vec<f64> = Vec::new();
    for (point, views) in views_of.iter().step_by((views_of.len() / MOST).max(1)) {
        let Some(point) = capture.points.get(*point) else { continue };
        let rays: Vec<DVec3> = views
            .iter()
            .filter_map(|v| (capture.views[*v].camera.pose.center() - point.position).try_normalize())
            .collect();
        let pairs =
            rays.iter().enumerate().flat_map(|(i, a)| rays[i + 1..].iter().map(move |b| a.angle_between(*b)));
        angles.push(pairs.fold(0.0, f64::max).to_degrees());
    }
    angles.sort_unstable_by(f64::total_cmp);
    let angle = *angles.get(angles.len() / 2)?;
    Some(ViewOverlap { share: thrice as f64 / views_of.len() as f64, angle })
}

impl ModelAgreement {
    fn likeness(&mut self, all: &[Option<Shown>], points: usize) {
        let mut sums = vec![(0.0, 0usize); points];
        for (point, detail) in all.iter().flatten().flatten() {
            sums[*point].0 += detail;
            sums[*point].1 += 1;
        }
        for (view, shown) in self.views.iter_mut().zip(all) {
            let (mut own, mut others) = (Vec::new(), Vec::new());
            for (point, detail) in shown.iter().flatten() {
                let (sum, count) = sums[*point];
                if count > 1 {
                    own.push(*detail);
                    others.push((sum - detail) / (count - 1) as f64);
                }
            }
            if own.len() >= FEWEST {
                view.likeness = rank_correlation(&own, &others);
            }
        }
    }

    fn errors(&mut self, survey: &Survey, sights: &[Vec<PointSight>], cameras: &[Option<PosedCamera<'_>>]) {
        let mut of_point = vec![(0.0, 0usize); survey.points.len()];
        for ((view, sights), camera) in self.views.iter_mut().zip(sights).zip(cameras) {
            let Some(camera) = camera else { continue };
            let (mut errors, mut inside) = (Vec::with_capacity(sights.len()), 0usize);
            for sight in sights {
                let position = survey.points[sight.point].position;
                let at = camera.pixel(position);
                let error = at.map_or(f64::INFINITY, |[x, y]| math::hypot(x - sight.at[0], y - sight.at[1]));
                inside += usize::from(camera.sees(position, MARGIN));
                errors.push(error);
                if error.is_finite() {
                    of_point[sight.point].0 += error;
                    of_point[sight.point].1 += 1;
                }
            }
            if sights.len() >= FEWEST {
                view.in_view = Some(inside as f64 / sights.len() as f64);
                errors.sort_unstable_by(f64::total_cmp);
                view.error = Some(errors[errors.len() / 2]);
            }
        }
        let measured: Vec<(f64, f64)> = survey
            .points
            .iter()
            .zip(&of_point)
            .filter(|(_, (_, count))| *count > 0)
            .map(|(point, (sum, count))| (sum / *count as f64, point.error))
            .collect();
        let mean =
            |values: Vec<f64>| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        self.error = mean(measured.iter().map(|(error, _)| *error).collect());
        self.stated = mean(measured.iter().map(|(_, stated)| *stated).filter(|e| *e >= 0.0).collect());
    }
}

/// The points that a photograph saw, with the detail at each.
type Shown = Vec<(usize, f64)>;

/// Reads a photograph at its sights; `size` is that of the model's photograph, pixels.
fn shown(image: &Image, sights: &[PointSight], size: [f64; 2]) -> Shown {
    let small = shrunk(image, SIDE);
    let (w, h) = (small.width(), small.height());
    let scale = [w as f64 / size[0], h as f64 / size[1]];
    let mean = |x: usize, y: usize, r: usize| {
        let (mut sum, mut count) = ([0.0; 3], 0.0);
        for v in y.saturating_sub(r)..(y + r + 1).min(h) {
            for u in x.saturating_sub(r)..(x + r + 1).min(w) {
                let pixel = small.pixel(u, v);
                (0..3).for_each(|c| sum[c] += f64::from(pixel[c]));
                count += 1.0;
            }
        }
        luma(sum.map(|s: f64| s / count))
    };
    let detail = |sight: &PointSight| {
        let [x, y] = [0, 1].map(|i| (sight.at[i] * scale[i]).floor());
        let inside = x >= 1.0 && y >= 1.0 && x + 2.0 <= w as f64 && y + 2.0 <= h as f64;
        let (x, y) = (x as usize, y as usize);
        inside.then(|| (sight.point, mean(x, y, 1) - mean(x, y, AROUND)))
    };
    sights.iter().step_by((sights.len() / MOST).max(1)).filter_map(detail).collect()
}

fn luma(c: [f64; 3]) -> f64 {
    0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]
}
