//! The model against its own tracks, and the photographs against the model.
//!
//! A point `X` of the model was seen in view `v` at the pixel `x`. With the projection `π_v` of the model,
//! lens included,
//!
//! * the *error* of a sighting is `‖π_v(X) − x‖`, in pixels of the model's photographs; the error of a
//!   capture is the mean over points of their mean, as COLMAP stores it;
//! * a sighting is *in view* if `π_v(X)` exists and is not farther than a twentieth of a side outside;
//! * the *likeness* of a view compares its photograph with those of the other views (`shown.rs`). A model
//!   without tracks is compared at the points' projections, where hidden points lower the likeness;
//! * the *coverage* of a capture is the share of its points that at least three views saw, and the *angle* of
//!   a point is the largest between the rays of two of its views.
//!
//! Figures that a file states, such as COLMAP's stored error, are only compared with the measured ones.

use std::collections::BTreeMap;

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use serde::Serialize;
use use3d_capture::{Pose, View};
use use3d_import::Imported;
use use3d_io_image::{ImageError, read_image};
use use3d_numerics::math;
use use3d_numerics::order::median;
use use3d_survey::{PointSight, PosedCamera, PosedImage, Survey};

use crate::depth::{DepthAgreement, depth_maps};
use crate::shown::{Exchanged, FEWEST, MOST, Shown, exchanged, likeness, shown, zoom};

/// The mean of stated errors below which they are no measurements, pixels.
const NO_ERROR: f64 = 0.05;
/// Points farther than this many times the usual distance from the middle of all lie outside of the scene.
const OUTSIDE: f64 = 100.0;
/// A point this share of a side outside of a picture still counts as in view.
const MARGIN: f64 = 0.05;
/// Points whose place in the photographs is looked for, about.
const PLACES: usize = 5000;
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
    /// Its likeness to the other views of its points, −1 to 1; `None` if its pixels were not read, if it
    /// shares too few points with them, or if grain hides its details.
    pub likeness: Option<f64>,
    /// The standard deviation of its grain in a picture of about 640 pixels, as a share of white; `None` if
    /// its pixels were not read.
    pub grain: Option<f64>,
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
    /// True if the errors that the file states are too small to be measured ones.
    pub states_none: bool,
    /// Points far outside of the scene. They count in no figure.
    pub outside: usize,
    /// The zoom of the photographs against those of the model, if it is not 1.
    pub zoom: Option<f64>,
    /// The side on which red and blue are exchanged, if they are.
    pub exchanged: Option<Exchanged>,
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

    let positions: Vec<[f64; 3]> =
        survey.points.iter().step_by((survey.points.len() / PLACES).max(1)).map(|p| p.position).collect();
    let mut found = ModelAgreement {
        views: views
            .iter()
            .map(|view| ViewAgreement { name: view.name.to_string(), ..ViewAgreement::default() })
            .collect(),
        tracked,
        in_view: share_in_view(&positions, &cameras),
        ..ModelAgreement::default()
    };
    found.coverage = coverage(imported, &sights);
    if found.in_view.is_some_and(|share| share < 0.5) {
        found.instead = misreading(&positions, &cameras);
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
            Some(posed @ PosedCamera { camera, .. })
                if i.is_multiple_of(step) && sights[i].len() >= FEWEST =>
            {
                let size = [camera.width as f64, camera.height as f64];
                let projection = |sight: &PointSight| posed.pixel(survey.points[sight.point].position);
                Ok(Some(shown(&read_image(&views[i].image)?, &sights[i], size, projection)))
            }
            _ => Ok(None),
        }
    };
    let all: Vec<Option<Shown>> = (0..views.len()).into_par_iter().map(read).collect::<Result<_, _>>()?;
    for ((view, likeness), shown) in found.views.iter_mut().zip(likeness(&all, survey.points.len())).zip(&all)
    {
        (view.likeness, view.grain) = (likeness, shown.as_ref().map(Shown::grain));
    }
    // Without tracks, hidden points can make another zoom look better.
    found.zoom = tracked.then(|| zoom(&all, survey.points.len())).flatten();
    found.exchanged = exchanged(&all, &survey.points);
    Ok(found)
}

/// Other coordinates of the points, in words.
type PointAxes = (&'static str, fn([f64; 3]) -> [f64; 3]);
const POINT_AXES: [PointAxes; 4] = [
    ("if y and z of the points were exchanged", |[x, y, z]| [x, z, y]),
    ("if the points were turned by a quarter about x", |[x, y, z]| [x, -z, y]),
    ("if the points were turned back by a quarter about x", |[x, y, z]| [x, z, -y]),
    ("if the points were turned by half a turn about x", |[x, y, z]| [x, -y, -z]),
];

/// The share of positions that are in view of any photograph; `None` without any.
fn share_in_view(positions: &[[f64; 3]], cameras: &[Option<PosedCamera<'_>>]) -> Option<f64> {
    let seen = |p: &&[f64; 3]| cameras.iter().flatten().any(|camera| camera.sees(**p, MARGIN));
    let count = positions.par_iter().filter(seen).count();
    (!positions.is_empty()).then(|| count as f64 / positions.len() as f64)
}

/// The meaning of the poses by which half of the points are in view, if theirs is another one.
fn misreading(positions: &[[f64; 3]], cameras: &[Option<PosedCamera<'_>>]) -> Option<&'static str> {
    let (flip, upright) = (DMat3::from_cols(DVec3::X, DVec3::NEG_Y, DVec3::NEG_Z), UPRIGHT);
    let (one, both) = (DMat3::IDENTITY, flip * upright);
    let backward = "if the poses were inverted (from the world to the camera)";
    // The words; true for the way back; and the changes of axes after and before it.
    let readings = [
        (
            "if the y and z axes of the cameras were flipped (OpenCV's in place of OpenGL's, or the other way round)",
            false,
            flip,
            one,
        ),
        ("if the poses were inverted (from the camera to the world)", true, one, one),
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
        share_in_view(positions, &moved.collect::<Vec<_>>()).unwrap_or(0.0)
    };
    let mut shares = readings.map(|reading| (reading.0, seen(&reading))).to_vec();
    for (words, axes) in POINT_AXES {
        let turned: Vec<[f64; 3]> = positions.iter().map(|position| axes(*position)).collect();
        shares.push((words, share_in_view(&turned, cameras).unwrap_or(0.0)));
    }
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
    let angle = median(angles)?;
    Some(ViewOverlap { share: thrice as f64 / views_of.len() as f64, angle })
}

impl ModelAgreement {
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
                view.error = median(errors);
            }
        }
        let far = outside(survey);
        self.outside = far.iter().filter(|far| **far).count();
        let measured: Vec<(f64, f64)> = survey
            .points
            .iter()
            .zip(&of_point)
            .zip(&far)
            .filter(|((_, (_, count)), far)| *count > 0 && !**far)
            .map(|((point, (sum, count)), _)| (sum / *count as f64, point.error))
            .collect();
        let mean =
            |values: Vec<f64>| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
        self.error = mean(measured.iter().map(|(error, _)| *error).collect());
        let stated = mean(measured.iter().map(|(_, stated)| *stated).filter(|e| *e >= 0.0).collect());
        self.states_none = stated.is_some_and(|stated| stated < NO_ERROR);
        self.stated = stated.filter(|stated| *stated >= NO_ERROR);
    }
}

/// For each point, if it lies far outside of the scene.
fn outside(survey: &Survey) -> Vec<bool> {
    let middle = [0, 1, 2].map(|axis| median(survey.points.iter().map(|p| p.position[axis])).unwrap_or(0.0));
    let middle = DVec3::from_array(middle);
    let distance = |position: [f64; 3]| DVec3::from_array(position).distance(middle);
    let usual = median(survey.points.iter().map(|p| distance(p.position))).unwrap_or(0.0);
    survey.points.iter().map(|p| distance(p.position) > OUTSIDE * usual).collect()
}
