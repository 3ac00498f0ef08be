//! Judges the models that were found, in words: the share of images with a place, the error, the groups.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use use3d_capture::{Intrinsics, Reach, reaches, shown};
use use3d_io_colmap::{Keypoint, Model, ModelCamera, ModelForm, ModelImage, Projection, read_model};

use crate::certainty::focal_errors;
use crate::error::PrepareError;
use crate::params::{LENS, Matching, PrepareParams};

/// A share of images with a place that is good, and one that is still usable.
const SHARES: (f64, f64) = (0.9, 2.0 / 3.0);
/// Focal lengths along x and y of a real lens differ by less than this factor.
const SQUARE: f64 = 1.2;
/// A mean reprojection error above which the lens model does not fit, pixels.
const ERROR: f64 = 1.5;
/// A standard error of a focal length above which the path does not determine it. It is 1.1 to 1.2 % on a
/// short path along a reef in which two versions of COLMAP found 316 and 1004 pixels, and 0.3 % at most on
/// seven sound swims.
const UNSURE: f64 = 0.007;
/// The focal lengths of usual lenses under water, as shares of the longer side of the images.
const USUAL: std::ops::Range<f64> = 0.55..1.6;
/// An angle of view, degrees, above which a lens without the fisheye's projection is rare under water.
const RARE: f64 = 100.0;

/// The grade of a preparation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Grade {
    /// Nine in ten images have a place, and the error is small.
    Good,
    /// Two thirds of the images have a place.
    Usable,
    /// Less.
    Poor,
}

/// The judgement of a preparation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraVerdict {
    /// The grade.
    pub grade: Grade,
    /// Number of images.
    pub images: usize,
    /// Images with a place in the model that is used.
    pub registered: usize,
    /// Images of each further group, without those that an earlier group has.
    pub groups: Vec<usize>,
    /// Points.
    pub points: usize,
    /// Mean reprojection error, pixels.
    pub error: f64,
    /// Mean number of images that see a point.
    pub track_length: f64,
    /// The share by which the largest uncertain focal length may be off, if every keypoint is off by a pixel.
    /// `None` for a lens that was given, and where it cannot be computed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focal_error: Option<f64>,
    /// The images without a place in the model that is used.
    pub missing: Vec<String>,
    /// The judgement in words, with the next steps.
    pub words: Vec<String>,
}

/// The first names of a list, and the number of the others.
pub(crate) fn some(names: &[String]) -> String {
    const SHOWN: usize = 6;
    let first: Vec<_> = names.iter().take(SHOWN).map(|name| shown(name)).collect();
    match names.len().saturating_sub(SHOWN) {
        0 => first.join(", "),
        more => format!("{} and {more} more", first.join(", ")),
    }
}

/// Reads the models below a folder, the one with the most images first.
pub(crate) fn models(folder: &Path) -> Result<Vec<Model>, PrepareError> {
    let entries = std::fs::read_dir(folder).map_err(PrepareError::read(folder))?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    paths.push(folder.to_path_buf());
    // Numbers in names have at most a few digits: `10` comes after `9`.
    paths.sort_by_key(|p| (p.as_os_str().len(), p.clone()));
    let mut found = Vec::new();
    for path in paths.into_iter().filter(|path| ModelForm::of(path).is_some()) {
        let model = read_model(&path)?;
        if !model.images.is_empty() {
            found.push(model);
        }
    }
    found.sort_by_key(|model| std::cmp::Reverse(model.images.len()));
    // Attempts of the mapper that a larger model covers are of no use.
    let mut placed: BTreeSet<String> = BTreeSet::new();
    found.retain(|model| {
        let names = model.images.iter().map(|image| image.name.to_string());
        let before = placed.len();
        placed.extend(names);
        placed.len() > before
    });
    Ok(found)
}

/// The choices behind a model, as they were carried out.
pub(crate) struct ModelContext<'a> {
    pub(crate) params: &'a PrepareParams,
    /// The pairing that was used.
    pub(crate) matching: Matching,
    /// True if images come from films.
    pub(crate) films: bool,
    /// The most features of an image.
    pub(crate) features: usize,
    /// The advice to take learned keypoints.
    pub(crate) advice: Option<String>,
    /// The least certain focal length of the model; `None` for a lens that was given.
    pub(crate) focal: Option<Focal>,
    /// The focal length that was found first, if a usual one was taken in its place.
    pub(crate) unusual: Option<f64>,
}

/// A focal length, pixels, with the share by which it may be off.
#[derive(Clone, Copy)]
pub(crate) struct Focal {
    pub(crate) length: f64,
    error: f64,
    /// True if many lenses have it.
    usual: bool,
}

impl Focal {
    fn is_unsure(&self) -> bool {
        self.error > UNSURE
    }

    /// True if the path does not determine it, and few lenses have it.
    pub(crate) fn is_doubtful(&self) -> bool {
        self.is_unsure() && !self.usual
    }
}

/// The least certain focal length of a model.
pub(crate) fn least_certain(model: &Model) -> Option<Focal> {
    let errors = focal_errors(model);
    let focal = |camera: &ModelCamera| {
        let [fx, fy] = camera.lens()?.focal;
        let length = (fx * fy).sqrt();
        let usual = USUAL.contains(&(length / camera.width.max(camera.height) as f64));
        Some(Focal { length, error: *errors.get(&camera.id)?, usual })
    };
    model.cameras.iter().filter_map(focal).max_by(|a, b| a.error.total_cmp(&b.error))
}

/// The mean reprojection error of a model, pixels.
fn mean_error(model: &Model) -> f64 {
    let sum: f64 = model.points.iter().map(|p| p.error.max(0.0)).sum();
    sum / model.points.len().max(1) as f64
}

/// True if a model has as many images as another one, and hardly a larger error.
pub(crate) fn fits_as_well(model: &Model, other: &Model) -> bool {
    model.images.len() >= other.images.len() && mean_error(model) <= 1.25 * mean_error(other) + 0.1
}

/// Judges models that are sorted by size. `names` are the images.
pub(crate) fn judge(models: &[Model], names: &[String], context: &ModelContext<'_>) -> Option<CameraVerdict> {
    let used = models.first()?;
    let mut placed: BTreeSet<&str> = used.images.iter().map(|i| i.name.as_str()).collect();
    let missing: Vec<String> = names.iter().filter(|n| !placed.contains(n.as_str())).cloned().collect();
    let registered = names.len() - missing.len();
    let mut groups = Vec::new();
    for model in &models[1..] {
        let more: BTreeSet<&str> =
            model.images.iter().map(|i| i.name.as_str()).filter(|n| !placed.contains(n)).collect();
        if !more.is_empty() {
            groups.push(more.len());
            placed.extend(more);
        }
    }
    let points = used.points.len();
    let error = mean_error(used);
    let sightings: usize = used.points.iter().map(|p| p.track.len()).sum();
    let track_length = sightings as f64 / points.max(1) as f64;
    let share = registered as f64 / names.len().max(1) as f64;
    let odd = used.cameras.iter().filter_map(|camera| camera.lens()).find_map(|lens| {
        let [fx, fy] = lens.focal;
        (fx / fy).max(fy / fx).ge(&SQUARE).then_some(fx / fy)
    });
    // A lens that was given is taken as it is.
    let given = !context.params.calibration.is_empty();
    let wide = if given { None } else { too_wide(used) };
    let unsure = context.focal.filter(|focal| focal.is_unsure() || context.unusual.is_some());
    let rare = if given || wide.is_some() || unsure.is_some() { None } else { rare_angle(used) };
    let grade = match share {
        _ if odd.is_some() => Grade::Poor,
        s if s >= SHARES.1 && (wide.is_some() || unsure.is_some()) => Grade::Usable,
        s if s >= SHARES.0 && error <= ERROR => Grade::Good,
        s if s >= SHARES.1 => Grade::Usable,
        _ => Grade::Poor,
    };
    let mut words = vec![format!(
        "{registered} of {} images have a place ({:.0} %): it is known where the camera was. The cameras fit the images to \
         {error:.2} pixels, below 1 is good, and {points} points are each seen in {track_length:.1} images.",
        names.len(),
        100.0 * share
    )];
    if !missing.is_empty() {
        words.push(format!("No place was found for {}.", some(&missing)));
    }
    if !groups.is_empty() {
        let list: Vec<String> = groups.iter().map(usize::to_string).collect();
        words.push(format!(
            "{} images are not used: they form {} of their own, which shows too little of what the largest group shows.",
            list.join(" and "),
            if groups.len() == 1 { "a group".into() } else { format!("{} groups", groups.len()) }
        ));
    }
    if let Some(ratio) = odd {
        words.push(format!(
            "The focal lengths along the width and the height differ by a factor of {ratio:.2}, which no lens has, so the \
             cameras are wrong: take a simpler lens model (--lens RADIAL), or more and sharper images."
        ));
    }
    let give_lens = give_lens(used);
    if let Some(Focal { length, .. }) = unsure {
        words.push(match context.unusual {
            Some(first) => format!(
                "The camera hardly turned, so its lens cannot be measured well. A focal length of {first:.0} pixels was \
                 found, which is unlikely for a real lens, and a usual one of {length:.0} pixels is used in its place. \
                 {give_lens}"
            ),
            None => format!(
                "The camera hardly turned, so its lens cannot be measured well. A focal length of {length:.0} pixels was \
                 found, and the shape of the scene may be a little wrong. {give_lens}"
            ),
        });
    }
    if let Some(reach) = wide {
        words.push(format!(
            "By this result the camera sees {:.0}° from left to right, and a side of the images has no points. So the lens \
             is probably wrong, as it can be after a swim along one line. {give_lens} `use3d check` shows the empty side.",
            reach.angle
        ));
    }
    if let Some(angle) = rare {
        words.push(format!(
            "By this result the camera sees {angle:.0}° from left to right. Few cameras see that much under water, and a short path \
             along the scene can give a wrong lens with a small error. If yours sees less, this lens is wrong. {give_lens}"
        ));
    }
    if share < SHARES.0 {
        words.push(format!(
            "To give more images a place, try one after another (options stand at the end of the command): {}.",
            remedies(context).join("; ")
        ));
    }
    if share < SHARES.1 {
        words.push(
            "More than a third of the images is missing, so parts of the scene will be missing too. If none of this \
             helps, film again: slowly, sideways, with a fixed zoom, and with things in view that do not move."
                .into(),
        );
    }
    if error > ERROR {
        words.push(format!(
            "The error is above {ERROR} pixels, so the lens model {} does not fit well: try another --lens, and switch \
             off zoom and stabilisation in the camera.",
            context.params.lens
        ));
    }
    let (images, focal_error) = (names.len(), context.focal.map(|focal| focal.error));
    Some(CameraVerdict {
        grade,
        images,
        registered,
        groups,
        points,
        error,
        track_length,
        focal_error,
        missing,
        words,
    })
}

/// The advice for a lens that the images do not determine.
fn give_lens(model: &Model) -> String {
    let (width, height) = model.cameras.first().map_or((0.0, 0.0), |c| (c.width as f64, c.height as f64));
    // A film of 35 mm is 36 mm wide, and a flat port enlarges as water refracts.
    let in_air = width.max(height) / 36.0;
    format!(
        "If you do not know the lens, go on. If you know it, add it to the command, with a number in place of F: --lens \
         SIMPLE_PINHOLE --calibration F,{},{}. The number is the focal length for 35 mm film, in millimetres, times \
         {in_air:.1}, or behind a flat port times {:.1}.",
        width / 2.0,
        height / 2.0,
        1.33 * in_air
    )
}

/// The cameras whose angle of view follows from the focal length alone, with their numbers.
fn perspective(model: &Model) -> impl Iterator<Item = (u32, Intrinsics)> {
    model.cameras.iter().filter_map(|camera| {
        let lens = camera.lens().filter(|lens| lens.projection == Projection::Perspective)?;
        let ([fx, fy], [cx, cy]) = (lens.focal, lens.principal);
        Some((camera.id, Intrinsics { width: camera.width, height: camera.height, fx, fy, cx, cy }))
    })
}

/// The widest angle of view, degrees, if it is rare.
fn rare_angle(model: &Model) -> Option<f64> {
    perspective(model).map(|(_, camera)| camera.angle()).filter(|angle| *angle > RARE).max_by(f64::total_cmp)
}

/// The reach of the camera with the largest bare share, among those whose lens is probably too wide.
fn too_wide(model: &Model) -> Option<Reach> {
    let (ids, cameras): (Vec<u32>, Vec<Intrinsics>) = perspective(model).unzip();
    let camera_of = |image: &ModelImage| ids.iter().position(|id| *id == image.camera);
    let seen: Vec<(&ModelImage, usize)> =
        model.images.iter().filter_map(|image| Some((image, camera_of(image)?))).collect();
    let of_view: Vec<usize> = seen.iter().map(|(_, camera)| *camera).collect();
    let sightings = seen.iter().enumerate().flat_map(|(view, (image, _))| {
        image.keypoints.iter().filter(|k| k.point != Keypoint::NONE).map(move |k| (view, [k.x, k.y]))
    });
    let found: Vec<Reach> =
        reaches(&cameras, &of_view, sightings).into_iter().filter(Reach::is_too_wide).collect();
    Reach::worst(&found).cloned()
}

/// The changes of choices that give more images a place.
pub(crate) fn remedies(context: &ModelContext<'_>) -> Vec<String> {
    let &ModelContext { params, matching, films, features, ref advice, .. } = context;
    let mut remedies: Vec<String> = advice.iter().cloned().collect();
    if params.lens != LENS {
        remedies.push(format!("take the usual lens model (leave out --lens {})", params.lens));
    }
    if matching == Matching::Sequential {
        remedies.push("compare every image with every other one (--matching exhaustive)".into());
    }
    if features < 8000 {
        remedies
            .push(format!("look for more details in each image (--features {})", (features * 2).min(8000)));
    }
    if films {
        remedies.push(format!("use more frames of the film (--frames {})", params.frames * 2));
    } else {
        remedies.push("add photographs in between".into());
    }
    if params.lens != "OPENCV_FISHEYE" {
        remedies.push("for a very wide lens, --lens OPENCV_FISHEYE".into());
    }
    remedies
}

#[cfg(test)]
mod tests {
    use use3d_io_colmap::{LensModel, ModelCamera};

    use super::*;

    /// Judges four images of 320x180 pixels by one camera, each with a point at every place of `seen`.
    fn judged(
        calibration: &[f64],
        lens: LensModel,
        parameters: &[f64],
        seen: impl Iterator<Item = [f64; 2]>,
    ) -> CameraVerdict {
        let names: Vec<String> = (0..4).map(|i| format!("f_{i}.jpg")).collect();
        let keypoints: Vec<Keypoint> =
            seen.zip(0..).map(|([x, y], point)| Keypoint { x, y, point }).collect();
        let image = |(i, name): (usize, &String)| {
            let name = use3d_capture::FileName::new(name).unwrap();
            let image = ModelImage::at(i as u32, name, 7, &use3d_capture::Pose::IDENTITY);
            ModelImage { keypoints: keypoints.clone(), ..image }
        };
        let images = names.iter().enumerate().map(image).collect();
        let parameters = parameters.to_vec();
        let camera = ModelCamera { id: 7, model: lens, width: 320, height: 180, parameters };
        let model = Model { cameras: vec![camera], images, points: Vec::new() };
        let params = PrepareParams { calibration: calibration.to_vec(), ..PrepareParams::default() };
        let matching = Matching::Exhaustive;
        let context = ModelContext {
            params: &params,
            matching,
            films: false,
            features: 3000,
            advice: None,
            focal: None,
            unusual: None,
        };
        judge(&[model], &names, &context).unwrap()
    }

    #[test]
    fn a_lens_that_no_camera_has_makes_the_cameras_poor() {
        let of = |fy: f64| {
            let parameters = [254.0, fy, 160.0, 90.0, 0.1, 0.0, 0.0, 0.0];
            judged(&[], LensModel::OpenCv, &parameters, std::iter::empty())
        };
        assert_eq!(of(250.0).grade, Grade::Good);
        for fy in [148.7, 400.0] {
            let verdict = of(fy);
            assert_eq!(verdict.grade, Grade::Poor);
            assert!(verdict.words[1].contains("--lens RADIAL"), "{:?}", verdict.words);
        }
    }

    #[test]
    fn a_wide_lens_with_a_bare_side_makes_the_cameras_usable_at_best() {
        // Points everywhere in the left `width` pixels.
        let left = |width: usize| {
            let rows = (0..18).map(|row| 10.0 * f64::from(row) + 5.0);
            rows.flat_map(move |y| (0..width).step_by(2).map(move |x| [x as f64, y]))
        };
        let pinhole = |focal: f64| [focal, 160.0, 90.0];
        let wrong = judged(&[], LensModel::SimplePinhole, &pinhole(108.0), left(192));
        assert_eq!(wrong.grade, Grade::Usable);
        assert!(wrong.words[1].contains("sees 112°") && wrong.words[1].contains("--calibration F,160,90"));
        let fisheye = [108.0, 108.0, 160.0, 90.0, 0.0, 0.0, 0.0, 0.0];
        for (verdict, why) in [
            (judged(&pinhole(108.0), LensModel::SimplePinhole, &pinhole(108.0), left(192)), "a given lens"),
            (judged(&[], LensModel::SimplePinhole, &pinhole(304.0), left(192)), "a usual lens"),
            (judged(&[], LensModel::SimplePinhole, &pinhole(140.0), left(320)), "no bare side"),
            (judged(&[], LensModel::OpenCvFisheye, &fisheye, left(192)), "a fisheye"),
        ] {
            assert_eq!((verdict.grade, verdict.words.len()), (Grade::Good, 1), "{why}");
        }
        // A wrong lens can have points everywhere and a small error.
        let rare = judged(&[], LensModel::SimplePinhole, &pinhole(108.0), left(320));
        assert_eq!((rare.grade, rare.words.len()), (Grade::Good, 2), "no bare side, and a rare angle");
        assert!(rare.words[1].contains("sees 112°") && rare.words[1].contains("--calibration F,160,90"));
    }

    #[test]
    fn more_features_are_advised_only_where_few_were_looked_for() {
        let params = PrepareParams::default();
        for (features, advice) in
            [(3000, Some("--features 6000")), (5000, Some("--features 8000")), (8192, None)]
        {
            let context = ModelContext {
                params: &params,
                matching: Matching::Sequential,
                films: true,
                features,
                advice: None,
                focal: None,
                unusual: None,
            };
            let words = remedies(&context).join("; ");
            assert_eq!(words.contains("--features"), advice.is_some(), "{words}");
            assert!(advice.is_none_or(|advice| words.contains(advice)), "{words}");
        }
    }
}
