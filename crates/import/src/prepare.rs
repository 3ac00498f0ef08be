//! Prepares the pixels of a capture: they are undistorted, resized and white-balanced, and written next to
//! the manifest. Files that need no change are copied.
//!
//! Views stream through a few worker threads, each of which holds one view. The number of workers is bounded
//! by the requested threads and by a memory budget, so memory does not grow with the folder's size. Outputs
//! do not depend on the number of workers.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use use3d_capture::{Capture, FileName, Map, Pixels, View};
use use3d_files::write_atomically;
use use3d_io_colmap::{Model, ModelCamera, ModelImage, write_model_binary};
use use3d_io_image::{
    image_size, read_pixels, read_pixels_with_alpha, write_exr_map, write_png_map, write_png_pixels,
};
use use3d_overlay::Overlay;
use use3d_survey::Survey;

use crate::error::ImportError;
use crate::geometry::Geometry;
use crate::import::{Imported, Plan, sparse_points};
use crate::load::{read_depth_at, read_mask_at, times_alpha};
use crate::originals::{Original, Originals, in_capture};
use crate::overlay::Overlays;
use crate::parallel::in_parallel;
use crate::params::WhiteBalance;
use crate::prepared::{IMAGES, MODEL, save};
use crate::white_balance;

/// Memory that the views in progress may use together, bytes.
const BUDGET: usize = 640 << 20;
/// Bytes that a view in progress needs per pixel of its file or its result: decoded, as planes, as floats,
/// and encoded.
const BYTES_PER_PIXEL: usize = 48;

/// Called after each view with the number of finished views and the total; `false` stops the work.
pub type Progress<'a> = &'a (dyn Fn(usize, usize) -> bool + Sync);

/// Writes the prepared capture into `out` and returns it in the form that [`crate::load_prepared`] will read.
///
/// `threads = 0` uses all cores. Each file is written completely or not at all, and the manifest is written
/// last; a folder that was interrupted has no manifest and can be prepared again.
pub fn prepare(
    imported: &Imported,
    out: &Path,
    threads: usize,
    progress: Progress<'_>,
) -> Result<Imported, ImportError> {
    std::fs::create_dir_all(out).map_err(ImportError::file(out))?;
    let views = &imported.capture.views;
    let workers = workers(imported, threads);
    let balanced = imported.white_balance == WhiteBalance::SetPercentile;
    let total = views.len() * if balanced { 2 } else { 1 };
    let done = AtomicUsize::new(0);
    let tick = || progress(done.fetch_add(1, Ordering::Relaxed) + 1, total);

    let paths: Vec<&Path> = views.iter().map(|v| v.image.as_path()).collect();
    let gains = balanced.then(|| white_balance::set_percentile_gains(&paths, workers, &tick)).transpose()?;
    let overlays = match imported.hide_overlay {
        true => Overlays::of(imported, workers)?,
        false => Overlays::default(),
    };
    let names = output_names(imported, gains.is_some())?;
    let prepared: Vec<View> = in_parallel(views.len(), workers, |i| {
        let overlay = overlays.view(i);
        let view = prepare_view(&views[i], &imported.plans[i], (&names[i], overlay), gains, out)?;
        if tick() { Ok(view) } else { Err(ImportError::Interrupted) }
    })?;

    let (model, cameras) = pinhole_model(imported, &names);
    write_model_binary(&out.join(MODEL), &model)?;
    let mut report = imported.report.clone();
    report.white_balance = gains.or(report.white_balance);
    report.overlay = overlays.report().or(report.overlay);
    let renamed: BTreeMap<&str, &FileName> = views.iter().map(|v| v.name.as_str()).zip(&names).collect();
    let mut originals = Originals::of(imported);
    originals.gains = gains.or(originals.gains);
    for original in &mut originals.photographs {
        if let Some(new) = renamed.get(original.name.as_str()) {
            original.name = FileName::clone(new);
        }
    }
    originals.write(out)?;
    for name in report.train.iter_mut().chain(&mut report.test) {
        if let Some(new) = renamed.get(name.as_str()) {
            *name = new.to_string();
        }
    }
    let capture = Capture {
        name: imported.capture.name.clone(),
        points: sparse_points(&model.points, &imported.capture.frame),
        views: prepared,
        split: imported.capture.split.clone(),
        frame: imported.capture.frame,
    };
    let world = imported.model.world.clone();
    save(out, &capture, &report, world.as_ref())?;
    let plan = |((plan, camera), view): ((&Plan, u32), &View)| Plan {
        geometry: Arc::new(Geometry::identity(view.camera.intrinsics)),
        alpha: plan.alpha && !changes(plan, gains),
        camera,
        file: view.name.clone(),
    };
    let plans = imported.plans.iter().zip(cameras).zip(&capture.views).map(plan).collect();
    let model = Survey { world, ..model.into_survey(out)? };
    let (image_folder, originals) = (IMAGES.to_string(), Some(originals));
    Ok(Imported::prepared((capture, report), plans, model, image_folder, originals))
}

impl Originals {
    /// The photographs of an import. Before [`prepare`] they have the names of the model's images; an import
    /// of a prepared capture keeps those of the first import. A file that two images of the model name stands
    /// there once.
    pub fn of(imported: &Imported) -> Self {
        if let Some(first) = &imported.originals {
            return first.clone();
        }
        let Capture { views, split, .. } = &imported.capture;
        let mut files = BTreeSet::new();
        let new = |index: usize| {
            let (view, plan) = (&views[index], &imported.plans[index]);
            files.insert(&plan.file).then(|| Original {
                name: view.name.clone(),
                file: in_capture(&imported.image_folder, &plan.file),
                relative: plan.file.clone(),
                width: plan.geometry.file.0,
                height: plan.geometry.file.1,
                lens: plan.geometry.lens,
                pose: view.camera.pose,
                camera: view.camera.intrinsics,
                train: split.train.contains(&index),
                held_out: split.test.contains(&index),
                mask: view.mask.is_some() || plan.alpha,
            })
        };
        Self {
            image_folder: imported.image_folder.clone(),
            gains: None,
            photographs: (0..views.len()).filter_map(new).collect(),
            missing: imported.report.missing.clone(),
        }
    }
}

fn changes(plan: &Plan, gains: Option<[f32; 3]>) -> bool {
    plan.geometry.resamples() || gains.is_some()
}

/// The number of workers that the cores and the memory budget allow.
fn workers(imported: &Imported, threads: usize) -> usize {
    let cores =
        if threads > 0 { threads } else { std::thread::available_parallelism().map_or(1, usize::from) };
    let pixels = |p: &Plan| {
        (p.geometry.file.0 * p.geometry.file.1)
            .max(p.geometry.intrinsics.width * p.geometry.intrinsics.height)
    };
    let largest = imported.plans.iter().map(pixels).max().unwrap_or(1).max(1);
    cores.min(BUDGET / (largest * BYTES_PER_PIXEL)).max(1)
}

/// File names of the results: PNG if pixels change, else the source's extension. Equal stems are made
/// distinct, also after folders are flattened (`left/1.png` and `left_1.png`).
fn output_names(imported: &Imported, balanced: bool) -> Result<Vec<FileName>, ImportError> {
    let mut taken = BTreeSet::new();
    let views = imported.capture.views.iter().zip(&imported.plans);
    views
        .map(|(view, plan)| {
            let own = view.image.extension().and_then(|e| e.to_str()).unwrap_or("png");
            let extension = if plan.geometry.resamples() || balanced { "png" } else { own };
            let mut name = view.name.with_extension(extension)?;
            if taken.contains(&name.flat_stem()) {
                name = FileName::new(&format!("{}.{extension}", view.name))?;
            }
            while !taken.insert(name.flat_stem()) {
                name = FileName::new(&format!("{}_.{extension}", name.stem()))?;
            }
            Ok(name.of_image()?)
        })
        .collect()
}

fn copy(from: &Path, to: &Path) -> Result<(), ImportError> {
    let mut file = std::fs::File::open(from).map_err(ImportError::file(from))?;
    write_atomically(to, |w| std::io::copy(&mut file, w)).map_err(ImportError::file(to))?;
    Ok(())
}

/// Copies a file to `out/folder`, with the view's stem as its name.
fn copy_beside(from: &Path, out: &Path, folder: &str, name: &FileName) -> Result<PathBuf, ImportError> {
    let extension = from.extension().and_then(|e| e.to_str()).unwrap_or("png");
    let to = name.with_extension(extension)?.below(&out.join(folder));
    copy(from, &to)?;
    Ok(to)
}

/// Writes a view's mask and returns its path.
fn write_mask(mask: &Map, out: &Path, name: &FileName) -> Result<PathBuf, ImportError> {
    let path = name.with_extension("png")?.below(&out.join("masks"));
    write_png_map(&path, mask)?;
    Ok(path)
}

/// A view's pixels, mask and depth prior in the form that the training loop uses.
#[derive(Clone, Debug, PartialEq)]
pub struct PreparedView {
    /// Colours, at the view's size.
    pub pixels: Pixels,
    /// Weights in `[0, 1]`: the mask file times the alpha channel; `None` if there is neither.
    pub mask: Option<Map>,
    /// The depth prior.
    pub depth_prior: Option<Map>,
}

impl Imported {
    /// Decodes and resamples one view in memory (without white balance, which depends on the whole set).
    pub fn view(&self, index: usize) -> Result<PreparedView, ImportError> {
        let (view, plan) = (&self.capture.views[index], &self.plans[index]);
        resample(view, plan, [1.0; 3], None)
    }
}

/// The error for a file that has changed since it was imported.
fn changed(view: &View, plan: &Plan) -> ImportError {
    let (width, height) = plan.geometry.file;
    let found = image_size(&view.image).unwrap_or((0, 0));
    let expected = format!("but it was {width} x {height} when it was imported; import again");
    ImportError::Size { path: view.image.clone(), found, expected }
}

fn resample(
    view: &View,
    plan: &Plan,
    gains: [f32; 3],
    overlay: Option<&Overlay>,
) -> Result<PreparedView, ImportError> {
    let geometry = &plan.geometry;
    let (pixels, alpha) = read_pixels_with_alpha(&view.image)?;
    if pixels.size() != geometry.file {
        return Err(changed(view, plan));
    }
    let result =
        if geometry.resamples() || gains != [1.0; 3] { geometry.pixels(&pixels, gains) } else { pixels };
    let mask = times_alpha(own_mask(view, geometry.file, overlay)?, alpha);
    let depth = view.depth_prior.as_ref().map(|path| read_depth_at(path, geometry.file)).transpose()?;
    Ok(PreparedView {
        pixels: result,
        mask: mask.map(|m| geometry.mask(&m)),
        depth_prior: depth.map(|d| geometry.depth(&d)),
    })
}

/// The mask file of a view times that of its overlay, at the size of its photograph.
fn own_mask(
    view: &View,
    size: (usize, usize),
    overlay: Option<&Overlay>,
) -> Result<Option<Map>, ImportError> {
    let mask = view.mask.as_ref().map(|path| read_mask_at(path, size, &view.image)).transpose()?;
    Ok(times_alpha(mask, overlay.map(|overlay| overlay.mask(size.0, size.1))))
}

/// Writes one view's files and returns a view with their paths.
fn prepare_view(
    view: &View,
    plan: &Plan,
    (name, overlay): (&FileName, Option<&Overlay>),
    gains: Option<[f32; 3]>,
    out: &Path,
) -> Result<View, ImportError> {
    let image = name.below(&out.join(IMAGES));
    let mut result = View { name: name.clone(), image, mask: None, depth_prior: None, ..view.clone() };
    if !changes(plan, gains) {
        // The file is decoded all the same: so a damaged file is reported now, with its own name, and not
        // hours later in a stage that reads it.
        if read_pixels(&view.image)?.size() != plan.geometry.file {
            return Err(changed(view, plan));
        }
        let file = plan.geometry.file;
        let mask = own_mask(view, file, overlay)?;
        view.depth_prior.as_ref().map(|path| read_depth_at(path, file)).transpose()?;
        copy(&view.image, &result.image)?;
        result.mask = match (mask, &view.mask) {
            (Some(mask), _) if overlay.is_some() => Some(write_mask(&mask, out, name)?),
            (_, Some(from)) => Some(copy_beside(from, out, "masks", name)?),
            _ => None,
        };
        let depth = view.depth_prior.as_ref().map(|from| copy_beside(from, out, "depth", name));
        result.depth_prior = depth.transpose()?;
        return Ok(result);
    }
    let ready = resample(view, plan, gains.unwrap_or([1.0; 3]), overlay)?;
    write_png_pixels(&result.image, &ready.pixels)?;
    result.mask = ready.mask.as_ref().map(|mask| write_mask(mask, out, name)).transpose()?;
    if let Some(depth) = &ready.depth_prior {
        let path = name.with_extension("exr")?.below(&out.join("depth"));
        write_exr_map(&path, depth, "Z")?;
        result.depth_prior = Some(path);
    }
    Ok(result)
}

/// The model of the prepared images, with pinhole cameras, new names and keypoints moved with the pixels; and
/// each view's camera id.
fn pinhole_model(imported: &Imported, names: &[FileName]) -> (Model, Vec<u32>) {
    let mut model = Model { points: imported.model.points.clone(), ..Model::default() };
    let mut next = imported.model.cameras.iter().map(|c| c.id).max().unwrap_or(0);
    let mut ids = Vec::with_capacity(names.len());
    for (view, plan) in imported.capture.views.iter().zip(&imported.plans) {
        let wanted = ModelCamera::pinhole(plan.camera, &view.camera.intrinsics);
        let same = |c: &&ModelCamera| ModelCamera { id: c.id, ..wanted.clone() } == **c;
        // A camera whose files have several sizes becomes several cameras.
        let taken = model.cameras.iter().any(|c| c.id == wanted.id && !same(&c));
        let id = match taken.then(|| model.cameras.iter().find(same)) {
            Some(Some(camera)) => camera.id,
            Some(None) => {
                next = next.wrapping_add(1);
                next
            }
            None => wanted.id,
        };
        if model.cameras.iter().all(|c| c.id != id) {
            model.cameras.push(ModelCamera { id, ..wanted });
        }
        ids.push(id);
    }
    let by_id: BTreeMap<u32, usize> =
        imported.capture.views.iter().enumerate().map(|(i, v)| (v.id, i)).collect();
    for image in &imported.model.images {
        let Some(&i) = by_id.get(&image.id) else { continue };
        let mut image = ModelImage { name: names[i].clone(), camera: ids[i], ..image.clone() };
        for keypoint in &mut image.keypoints {
            // A keypoint that the lens cannot have seen stays in the list, so that the indices in the tracks
            // remain valid.
            let moved = imported.plans[i].geometry.point(keypoint.x, keypoint.y);
            (keypoint.x, keypoint.y) = moved.unwrap_or((f64::NAN, f64::NAN));
        }
        model.images.push(image);
    }
    (model, ids)
}
