//! Converts a capture folder to a [`Capture`]: finds the model and the images, resolves names, replaces
//! lenses by pinholes, and chooses the frame and the split.
//!
//! Only the headers of the images are read. [`crate::prepare`] reads the pixels, and only if they must
//! change.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;
use use3d_capture::{
    Camera, Capture, CaptureError, FileName, Frame, Intrinsics, SparsePoint, View, masked, natural_order,
    stem,
};
use use3d_io_colmap::fits_single;
use use3d_io_image::{ColorUse, FileFormat, ImageError, PhotographInfo, whole_photograph_info};
use use3d_survey::{PosedImage, Survey, SurveyPoint, World};

use crate::copies;
use crate::depth;
use crate::error::ImportError;
use crate::folder::{DEPTH_DIRS, MASK_DIRS, SourceFolder, is_prepared};
use crate::geometry::{Geometry, is_whole_multiple, size_ratio};
use crate::layout::{FoundModel, find_extra, find_images, find_models};
use crate::metres;
use crate::normalise;
use crate::originals::Originals;
use crate::params::{ImportParams, WhiteBalance};
use crate::prepared;
use crate::report::{CameraReport, ImportReport};
use crate::split;
use crate::stray::strays;
use crate::undistort::LensFault;

/// An imported capture, with the changes that its pixels still need.
#[derive(Clone, Debug)]
pub struct Imported {
    /// The capture. Its cameras are those of the pixels after preparation.
    pub capture: Capture,
    /// The choices of the import.
    pub report: ImportReport,
    /// The changes to each view's file.
    pub(crate) plans: Vec<Plan>,
    /// The model that the capture came from, in its own frame, without the missing images.
    pub model: Survey,
    /// Files and folders, relative to the capture, whose content makes the model; empty for a prepared
    /// capture.
    pub model_files: Vec<PathBuf>,
    pub(crate) white_balance: WhiteBalance,
    /// True if a mask is to hide what lies over all photographs of a camera.
    pub(crate) hide_overlay: bool,
    /// The folder of the photographs, relative to the capture.
    pub(crate) image_folder: String,
    /// The photographs of the first import, for a capture that is already imported.
    pub(crate) originals: Option<Originals>,
}

/// A view whose file was found, until its plan is made.
struct Found {
    view: View,
    /// The id of its camera in the model.
    camera: u32,
    /// The file's name in the image folder.
    file: FileName,
}

/// The changes to one view's file.
#[derive(Clone, Debug)]
pub(crate) struct Plan {
    pub(crate) geometry: Arc<Geometry>,
    /// True if the file has an alpha channel.
    pub(crate) alpha: bool,
    /// The id of its camera in the model.
    pub(crate) camera: u32,
    /// The file's name in the image folder.
    pub(crate) file: FileName,
}

impl Imported {
    /// A prepared capture, whose pixels need nothing more.
    pub(crate) fn prepared(
        (capture, report): (Capture, ImportReport),
        plans: Vec<Plan>,
        model: Survey,
        image_folder: String,
        originals: Option<Originals>,
    ) -> Self {
        Self {
            capture,
            report,
            plans,
            model,
            model_files: Vec::new(),
            white_balance: WhiteBalance::None,
            hide_overlay: false,
            image_folder,
            originals,
        }
    }

    /// True if pixels must be resampled or balanced before the views can be loaded; [`crate::prepare`] does
    /// this.
    pub fn needs_preparation(&self) -> bool {
        self.white_balance != WhiteBalance::None || self.plans.iter().any(|p| p.geometry.resamples())
    }

    /// The same capture before its pixels are scaled and cropped: undistorted, at the size of its files.
    pub fn full_size(&self) -> Self {
        let mut shared: BTreeMap<*const Geometry, Arc<Geometry>> = BTreeMap::new();
        let mut full = self.clone();
        for (plan, view) in full.plans.iter_mut().zip(&mut full.capture.views) {
            let geometry = shared
                .entry(Arc::as_ptr(&plan.geometry))
                .or_insert_with(|| Arc::new(plan.geometry.full_size()));
            view.camera.intrinsics = geometry.intrinsics;
            plan.geometry = Arc::clone(geometry);
        }
        full
    }
}

/// Imports a capture folder: a model of COLMAP or another program with its images, or a folder that
/// [`crate::prepare`] wrote.
///
/// # Errors
/// Returns any problem that makes the capture unusable with these parameters. Missing images are no errors:
/// they are skipped and reported.
pub fn import(dir: &Path, params: &ImportParams) -> Result<Imported, ImportError> {
    params.validate()?;
    if !dir.is_dir() {
        let what = if dir.exists() {
            "this is a file; a capture is a folder with images and a model of COLMAP or another program; `use3d prepare` \
             makes one of a film"
        } else {
            "there is no such folder"
        };
        let source = std::io::Error::new(std::io::ErrorKind::NotFound, what);
        return Err(ImportError::File { path: dir.to_path_buf(), source });
    }
    if is_prepared(dir) {
        let mut imported = prepared::load_prepared(dir)?;
        if *params != ImportParams::default() {
            let note = "this capture is already imported; the parameters of that import are used, not the \
                 ones given now";
            imported.report.notes.push(note.into());
        }
        return Ok(imported);
    }

    let found = find_models(dir, params)?;
    let (chosen, others) = (&found[0], &found[1..]);
    let mut read = (chosen.format.read)(chosen)?;
    let bad_capture = |source| ImportError::Capture { path: dir.to_path_buf(), source };
    if read.survey.images.is_empty() {
        return Err(bad_capture(CaptureError::NoViews));
    }
    let mut report = ImportReport {
        name: capture_name(dir),
        model: chosen.relative.clone(),
        model_form: chosen.form.clone(),
        other_models: others.iter().map(FoundModel::counted).collect(),
        registered: read.survey.images.len(),
        normalised: params.normalise,
        ..ImportReport::default()
    };
    let stray = strays(&read.survey);
    let names = read.survey.images.iter().filter(|image| stray.contains(&image.id));
    report.stray = names.map(|image| image.name.to_string()).collect();
    read.survey.retain_images(|image| !stray.contains(&image.id));
    let frame = if params.normalise {
        // All registered images count, also those that are missing on this disk, because the frame is a
        // property of the model.
        normalise::frame(&read.survey.images.iter().map(PosedImage::pose).collect::<Vec<_>>())
    } else {
        Frame::IDENTITY
    };
    report.scale = frame.scale;

    let (folder, other_folders) = find_images(dir, params, &mut read)?;
    report.faults = metres::read(dir, &folder, &mut read.survey, &mut read.files)?;
    let (mut model, base) = (read.survey, SourceFolder::open_own(dir, &read.base));
    report.image_folder = folder.relative.clone();
    report.other_image_folders = other_folders;
    let masks = find_extra(dir, params.mask_dir.as_deref(), "mask_dir", &MASK_DIRS)?;
    let depths = find_extra(dir, params.depth_dir.as_deref(), "depth_dir", &DEPTH_DIRS)?;
    report.depth_folder = depths.as_ref().map(|d| d.relative.clone());

    let listed = folder.images();
    let marked = listed.iter().any(|name| masked(name).is_some());
    // Maps that the model names are distances.
    let file = |name: &FileName| base.as_ref().map_or(Ok(None), |base| base.file(name));
    let named = model.files.values().filter_map(|f| file(f.depth.as_ref()?).transpose());
    let distances: BTreeSet<PathBuf> = named.collect::<Result<_, _>>()?;

    // Resolves names to files; views are in the order of their names.
    let mut views = Vec::new();
    for image in &model.images {
        let name = image.name.clone();
        let Some((file, path)) = folder.named_image(&name)? else {
            report.missing.push(name.into());
            continue;
        };
        let view = View {
            id: image.id,
            image: path,
            mask: match model.files.get(&image.id).and_then(|f| f.mask.as_ref()).zip(base.as_ref()) {
                Some((mask, base)) if params.mask_dir.is_none() => base.file(mask)?,
                _ => match masks.as_ref().map(|m| m.mask(&name)).transpose()?.flatten() {
                    None if marked => folder.mask_beside(&file)?,
                    mask => mask,
                },
            },
            depth_prior: depths
                .as_ref()
                .map(|d| d.depth(&name))
                .transpose()?
                .flatten()
                .filter(|p| !distances.contains(p)),
            name,
            camera: Camera { intrinsics: PENDING, pose: frame.apply_pose(&image.pose()) },
        };
        views.push(Found { view, camera: image.camera, file });
    }
    views.sort_by(|a, b| natural_order(&a.view.name, &b.view.name));
    report.missing.sort();
    let used: BTreeSet<&PathBuf> = views.iter().map(|found| &found.view.image).collect();
    let photographs: BTreeSet<&str> = listed.iter().flat_map(|name| [name.as_str(), stem(name)]).collect();
    let is_mask = |name: &str| masked(name).is_some_and(|of| photographs.contains(of));
    report.extra = listed.iter().filter(|name| !is_mask(name)).cloned().collect();
    report.extra.retain(|name| !used.contains(&folder.path.join(name)) && !report.stray.contains(name));
    let beside = views.iter().filter(|v| v.view.mask.as_ref().is_some_and(|m| m.starts_with(&folder.path)));
    let beside = beside.count();
    if beside > 0 && masks.as_ref().is_none_or(|m| !m.path.starts_with(&folder.path)) {
        report.notes.push(format!("{beside} masks beside the photographs are used"));
    }
    if let Some(found) = masks.as_ref().filter(|m| params.mask_dir.is_none() && m.relative != MASK_DIRS[0]) {
        report.notes.push(format!("the masks in {}/ are used", found.relative));
    }
    let renamed =
        views.iter().map(|found| &found.view).filter(|v| !v.image.ends_with(v.name.as_str())).count();
    if renamed > 0 {
        report.notes.push(format!("{renamed} photographs have a different extension from that in the model"));
    }
    let infos = leave_out(&mut views, &model, &mut report)?;
    let kept: BTreeSet<u32> = views.iter().map(|found| found.view.id).collect();
    model.retain_images(|image| kept.contains(&image.id));
    report.notes.append(&mut model.notes);
    report.faults.append(&mut model.faults);
    // The true distances of a synthetic capture are no priors.
    if !report.depth_folder.as_ref().is_some_and(|folder| folder.starts_with("truth/")) {
        let maps = views.iter_mut().map(|found| &mut found.view).collect();
        report.faults.extend(depth::leave_out(maps, &model));
    }
    let metres = |w: &World| format!("1 unit of the model is {:.6} m ({})", w.metres_per_unit, w.source);
    report.notes.extend(model.world.as_ref().map(metres));

    report.notes.extend(pixel_notes(&infos));
    let unused = infos.iter().filter(|info| info.colors == ColorUse::AsStored).count();
    if unused > 0 {
        report.faults.push(format!(
            "the colour profiles of {unused} photographs cannot be used, so their colours may be wrong; convert them \
             (`magick mogrify -profile sRGB.icc`)"
        ));
    }
    report.exr = infos.iter().filter(|info| info.format == FileFormat::Exr).count();
    let plans = plan(&mut views, &infos, &model, params, &mut report)?;
    let views: Vec<View> = views.into_iter().map(|found| found.view).collect();
    for view in &views {
        let bad = |source| ImportError::Camera { name: view.name.clone(), source };
        view.camera.validate().map_err(bad)?;
    }

    let unusable: Vec<String> = report.unusable.keys().cloned().collect();
    let skipped = [report.missing.clone(), report.stray.clone(), unusable].concat();
    let copies = copies::groups(&views, &infos);
    let mut split = split::choose(dir, &views, &skipped, &read.held_out, &params.split)?;
    if split.counted {
        copies::keep_together(&mut split.split, &copies);
    }
    report.faults.extend(copies::fault(&copies, &views, split.counted));
    report.notes.extend(split.notes);
    report.split_rule = split.rule;
    let names = |indices: &[usize]| indices.iter().map(|&i| views[i].name.to_string()).collect();
    report.train = names(&split.split.train);
    report.test = names(&split.split.test);
    report.views = views.len();
    report.points = model.points.len();
    report.masks = views.iter().filter(|v| v.mask.is_some()).count();
    report.alpha_masks = plans.iter().filter(|p| p.alpha).count();
    if let Some(masks) = &masks {
        report_masks(&mut report, masks, &views)?;
    }
    let has_mask = |(view, plan): &(&View, &Plan)| view.mask.is_some() || plan.alpha;
    if report.masks + report.alpha_masks > 0 {
        let unmasked = views.iter().zip(&plans).filter(|pair| !has_mask(pair));
        report.unmasked = unmasked.map(|(view, _)| view.name.to_string()).collect();
    }
    report.depth_priors = views.iter().filter(|v| v.depth_prior.is_some()).count();

    let points = sparse_points(&model.points, &frame);
    let fits = |p: &SparsePoint| p.position.to_array().into_iter().all(fits_single);
    if let Some((point, of)) = points.iter().zip(&model.points).find(|(p, _)| !fits(p)) {
        let reason = format!(
            "point {} lies at {:?} after the scene is scaled by {:e}: too far for single precision; remove \
             it from the model, or set `normalise = false`",
            of.id, point.position, frame.scale
        );
        return Err(ImportError::Parameter { field: "normalise", reason });
    }
    let capture = Capture { name: report.name.clone(), views, split: split.split, points, frame };
    report.notes.extend(useless(&capture));
    capture.validate().map_err(bad_capture)?;
    let model_files = read.files;
    let (white_balance, image_folder) = (params.white_balance, folder.relative);
    Ok(Imported {
        capture,
        report,
        plans,
        model,
        model_files,
        white_balance,
        hide_overlay: params.hide_overlay,
        image_folder,
        originals: None,
    })
}

/// Leaves out the views whose photographs cannot be read or were turned by a quarter, and reports them. The
/// properties of the other files are returned.
fn leave_out(
    views: &mut Vec<Found>,
    model: &Survey,
    report: &mut ImportReport,
) -> Result<Vec<PhotographInfo>, ImportError> {
    let mut heads: Vec<_> = views.par_iter().map(|found| whole_photograph_info(&found.view.image)).collect();
    // A file that the system does not give may be there later.
    if let Some(at) = heads.iter().position(|head| matches!(head, Err(ImageError::Open { .. }))) {
        heads.swap_remove(at)?;
        return Ok(Vec::new());
    }
    let (mut infos, mut first) = (Vec::new(), None);
    let mut heads = heads.into_iter();
    views.retain(|found| {
        let path = &found.view.image;
        let usable = heads.next().map_or(Err(ImportError::Interrupted), |head| {
            let info = head?;
            turned(model, found.camera, path, &info).map_or(Ok(info), Err)
        });
        let error = match usable {
            Ok(info) => {
                infos.push(info);
                return true;
            }
            Err(error) => error,
        };
        let (text, place) = (error.to_string(), format!("{}: ", path.display()));
        let reason = text.strip_prefix(&place).unwrap_or(&text).to_string();
        report.unusable.insert(found.view.name.to_string(), reason);
        first.get_or_insert(error);
        false
    });
    match first.filter(|_| views.is_empty()) {
        Some(error) => Err(error),
        None => Ok(infos),
    }
}

/// The error of a photograph whose sides are exchanged against its camera's.
fn turned(model: &Survey, camera: u32, path: &Path, info: &PhotographInfo) -> Option<ImportError> {
    let camera = model.camera(camera)?;
    let (size, found) = ((camera.width, camera.height), (info.width, info.height));
    if size_ratio(size, found).is_some() || size_ratio((size.1, size.0), found).is_none() {
        return None;
    }
    let cause = match info.orientation > 4 {
        true => "the model has it as its EXIF data turn it: turn its pixels (`magick mogrify -auto-orient`)",
        false => {
            "it was turned by 90 degrees after the model was made: replace it by the file that is not turned"
        }
    };
    let expected = format!("and camera {} of the model is {} x {}; {cause}", camera.id, size.0, size.1);
    Some(ImportError::Size { path: path.to_path_buf(), found, expected })
}

/// Says what files state about their pixels: colours that are converted, and turns that are not applied.
fn pixel_notes(infos: &[PhotographInfo]) -> Vec<String> {
    let mut spaces: BTreeMap<&str, usize> = BTreeMap::new();
    for info in infos {
        if let ColorUse::Converted(name) = &info.colors {
            *spaces.entry(name).or_default() += 1;
        }
    }
    let mut notes: Vec<String> = spaces
        .into_iter()
        .map(|(name, count)| format!("the colours of {count} photographs are converted from {name} to sRGB"))
        .collect();
    let turned = infos.iter().filter(|info| info.orientation != 1).count();
    if turned > 0 {
        notes.push(format!("EXIF data ask to turn {turned} photographs; they are used as they are stored"));
    }
    notes
}

/// Names the files of the mask folder that are masks of no photograph. A photograph without a camera may have
/// a mask.
fn report_masks(report: &mut ImportReport, folder: &SourceFolder, views: &[View]) -> Result<(), ImportError> {
    let mut known: BTreeSet<PathBuf> = views.iter().filter_map(|v| v.mask.clone()).collect();
    for name in report.extra.iter().chain(&report.missing).filter_map(|name| FileName::new(name).ok()) {
        known.extend(folder.mask(&name)?);
    }
    report.mask_folder = Some(folder.relative.clone());
    report.stray_masks = folder.masks();
    report.stray_masks.retain(|name| !known.contains(&folder.path.join(name)));
    Ok(())
}

/// Returns the reasons why no training can learn from a capture whose numbers are all valid.
fn useless(capture: &Capture) -> Vec<String> {
    let mut notes = Vec::new();
    if let Some((first, others)) = capture.views.split_first() {
        let at = first.camera.pose.center();
        let near = 1e-9 * (1.0 + at.abs().max_element());
        if !others.is_empty() && others.iter().all(|v| v.camera.pose.center().distance(at) <= near) {
            notes.push(
                "all views have the same camera position, so no depth can be estimated and no other view will \
                 be right; check the poses of the model"
                    .into(),
            );
        }
        let is_ahead =
            |view: &View, p: DVec3| (view.camera.pose.rotation * p + view.camera.pose.translation).z > 0.0;
        let seen = capture.points.iter().any(|p| capture.views.iter().any(|v| is_ahead(v, p.position)));
        if !capture.points.is_empty() && !seen {
            notes.push(
                "all sparse points lie behind all cameras, so their positions are useless; check the viewing \
                 directions of the poses of the model"
                    .into(),
            );
        }
    }
    notes
}

/// The intrinsics of a view until [`plan`] sets those of its camera and file size.
const PENDING: Intrinsics = Intrinsics { width: 0, height: 0, fx: 0.0, fy: 0.0, cx: 0.0, cy: 0.0 };

/// Makes one geometry per camera and file size, and sets the views' intrinsics.
fn plan(
    views: &mut [Found],
    infos: &[PhotographInfo],
    model: &Survey,
    params: &ImportParams,
    report: &mut ImportReport,
) -> Result<Vec<Plan>, ImportError> {
    let mut groups: BTreeMap<(u32, usize, usize), Vec<usize>> = BTreeMap::new();
    for (i, (found, info)) in views.iter().zip(infos).enumerate() {
        groups.entry((found.camera, info.width, info.height)).or_default().push(i);
    }
    let built: Vec<Geometry> = groups
        .par_iter()
        .map(|(&(id, width, height), members)| {
            let camera =
                model.camera(id).ok_or(ImportError::Lens { camera: id, reason: LensFault::Absent })?;
            Geometry::new(camera, (width, height), &views[members[0]].view.image, params)
        })
        .collect::<Result<_, _>>()?;
    // A table of positions is useful if a camera took several images, and only a few tables may be kept at
    // the same time.
    let few = built.iter().filter(|g| g.undistortion.is_some()).count() <= 4;
    let mut plans = vec![None; views.len()];
    for ((&(id, width, height), members), mut geometry) in groups.iter().zip(built) {
        let shared = few && members.len() > 1;
        if let Some(undistortion) = geometry.undistortion.as_mut().and_then(Arc::get_mut).filter(|_| shared) {
            undistortion.keep_table();
        }
        let camera = model.camera(id);
        report.cameras.push(CameraReport {
            id,
            model: camera.map_or_else(String::new, |c| c.model.clone()),
            views: members.len(),
            model_size: camera.map_or([0, 0], |c| [c.width, c.height]),
            file_size: [width, height],
            undistorted_size: geometry.undistortion.as_ref().map(|u| [u.pinhole.width, u.pinhole.height]),
            size: [geometry.intrinsics.width, geometry.intrinsics.height],
        });
        if let Some(camera) = camera.filter(|c| !is_whole_multiple((c.width, c.height), (width, height))) {
            report.notes.push(format!(
                "{} photographs of camera {id} have {width} x {height} pixels, and the model has them with {} x {}; \
                 the lens is scaled to them",
                members.len(),
                camera.width,
                camera.height
            ));
        }
        let geometry = Arc::new(geometry);
        for &i in members {
            views[i].view.camera.intrinsics = geometry.intrinsics;
            let (alpha, file) = (infos[i].alpha, views[i].file.clone());
            plans[i] = Some(Plan { geometry: Arc::clone(&geometry), alpha, camera: id, file });
        }
    }
    Ok(plans.into_iter().flatten().collect())
}

/// The model's points in the capture's frame.
pub(crate) fn sparse_points(points: &[SurveyPoint], frame: &Frame) -> Vec<SparsePoint> {
    let point = |p: &SurveyPoint| SparsePoint {
        position: frame.apply(DVec3::from_array(p.position)),
        color: p.color,
        error: if p.error.is_finite() { p.error } else { -1.0 },
        track_length: p.track.len() as u32,
    };
    points.iter().map(point).collect()
}

/// The name of a capture: its folder's own name, also for `.` and similar paths.
pub fn capture_name(dir: &Path) -> String {
    let real = dir.canonicalize().unwrap_or_else(|_| dir.to_path_buf());
    real.file_name().map_or_else(|| "capture".into(), |n| n.to_string_lossy().into_owned())
}
