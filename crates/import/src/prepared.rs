//! A prepared capture on disk: `capture.json`, `originals.json`, `images/`, `masks/`, `depth/`, and a pinhole
//! COLMAP model in `sparse/0`.
//!
//! The folder is itself a capture that other tools can read. `capture.json` holds the views with their
//! cameras in the normalised frame, the frame, the split and the import's report. Numbers are written so that
//! reading them restores the same bits. Rotations are row-major. The points are those of the model,
//! transformed by the frame. `capture.json` is written last: a folder without it was not finished.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use glam::DVec3;
use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, Capture, FileName, Frame, Intrinsics, Pose, Split, View};
use use3d_io_colmap::read_model;
use use3d_survey::{Survey, World};

use crate::error::ImportError;
use crate::folder::{FORMAT, MANIFEST, SourceFolder};
use crate::geometry::Geometry;
use crate::import::{Imported, Plan, capture_name, sparse_points};
use crate::originals::Originals;
use crate::report::ImportReport;
use crate::rows::{from_row_major, row_major};

const VERSION: u32 = 1;
/// The folder of the model.
pub(crate) const MODEL: &str = "sparse/0";
/// The folder of the images.
pub(crate) const IMAGES: &str = "images";

#[derive(Serialize, Deserialize)]
struct Manifest {
    format: String,
    version: u32,
    /// Read from older folders and no longer written: the same capture under another name is the same
    /// capture.
    #[serde(skip_serializing, default)]
    name: String,
    frame: FrameEntry,
    /// The model's world, where it is known.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    world: Option<World>,
    views: Vec<ViewEntry>,
    train: Vec<usize>,
    test: Vec<usize>,
    report: ImportReport,
}

#[derive(Serialize, Deserialize)]
struct FrameEntry {
    scale: f64,
    rotation: [f64; 9],
    translation: [f64; 3],
}

#[derive(Serialize, Deserialize)]
struct ViewEntry {
    name: FileName,
    id: u32,
    image: FileName,
    mask: Option<FileName>,
    depth_prior: Option<FileName>,
    #[serde(flatten)]
    intrinsics: Intrinsics,
    rotation: [f64; 9],
    translation: [f64; 3],
}

/// Writes the manifest; paths in the capture must be below `dir`.
pub(crate) fn save(
    dir: &Path,
    capture: &Capture,
    report: &ImportReport,
    world: Option<&World>,
) -> Result<(), ImportError> {
    let path = dir.join(MANIFEST);
    let bad = |reason: String| ImportError::Prepared { path: path.clone(), reason };
    let relative = |p: &PathBuf| {
        let below = p.strip_prefix(dir).ok().and_then(Path::to_str);
        let below = below.ok_or_else(|| bad(format!("{} is not below it", p.display())))?;
        FileName::new(below).map_err(|e| bad(e.to_string()))
    };
    let entry = |v: &View| {
        let Camera { intrinsics, pose } = v.camera;
        Ok(ViewEntry {
            name: v.name.clone(),
            id: v.id,
            image: relative(&v.image)?,
            mask: v.mask.as_ref().map(relative).transpose()?,
            depth_prior: v.depth_prior.as_ref().map(relative).transpose()?,
            intrinsics,
            rotation: row_major(&pose.rotation),
            translation: pose.translation.to_array(),
        })
    };
    let manifest = Manifest {
        format: FORMAT.into(),
        version: VERSION,
        name: String::new(),
        frame: FrameEntry {
            scale: capture.frame.scale,
            rotation: row_major(&capture.frame.rotation),
            translation: capture.frame.translation.to_array(),
        },
        world: world.cloned(),
        views: capture.views.iter().map(entry).collect::<Result<_, ImportError>>()?,
        train: capture.split.train.clone(),
        test: capture.split.test.clone(),
        report: report.clone(),
    };
    use3d_files::write_atomically(&path, |w| {
        serde_json::to_writer_pretty(&mut *w, &manifest)?;
        std::io::Write::write_all(w, b"\n")
    })
    .map_err(ImportError::file(&path))
}

/// Reads the manifest of a prepared capture.
fn manifest(dir: &Path) -> Result<Manifest, ImportError> {
    let path = dir.join(MANIFEST);
    let bytes = std::fs::read(&path).map_err(ImportError::file(&path))?;
    let bad = |reason: String| ImportError::Prepared { path: path.clone(), reason };
    let manifest: Manifest = serde_json::from_slice(&bytes).map_err(|e| bad(e.to_string()))?;
    if manifest.format != FORMAT || manifest.version != VERSION {
        return Err(bad(format!(
            "it is {:?} version {}; expected {FORMAT:?} version {VERSION}",
            manifest.format, manifest.version
        )));
    }
    Ok(manifest)
}

/// The size of a prepared capture.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Extent {
    /// Width and height of every view, in the capture's order.
    pub sizes: Vec<(usize, usize)>,
    /// Indices of the training views.
    pub train: Vec<usize>,
    /// Number of sparse points.
    pub points: usize,
}

/// The size of a prepared capture, from its manifest alone. No picture and no model is opened, so that a plan
/// over many scenes is quick.
///
/// # Errors
/// Fails if the manifest is missing or has another format.
pub fn prepared_extent(dir: &Path) -> Result<Extent, ImportError> {
    let manifest = manifest(dir)?;
    Ok(Extent {
        sizes: manifest.views.iter().map(|v| (v.intrinsics.width, v.intrinsics.height)).collect(),
        train: manifest.train,
        points: manifest.report.points,
    })
}

/// The world of a prepared capture, from its manifest alone; `None` if its metres are not known.
///
/// # Errors
/// Fails if the manifest is missing or has another format.
pub fn prepared_world(dir: &Path) -> Result<Option<World>, ImportError> {
    Ok(manifest(dir)?.world)
}

/// The name of an image in the image folder; `None` if it lies elsewhere.
fn in_images(image: &FileName) -> Option<FileName> {
    let (folder, name) = image.split_once('/')?;
    FileName::new(name).ok().filter(|_| folder == IMAGES)
}

/// Reads a prepared capture exactly as it was: the same cameras, points and split to the last bit.
pub fn load_prepared(dir: &Path) -> Result<Imported, ImportError> {
    let path = dir.join(MANIFEST);
    let bad = |reason: String| ImportError::Prepared { path: path.clone(), reason };
    let manifest = manifest(dir)?;
    let folder = SourceFolder::open(dir, ".").ok_or_else(|| bad("its folder is gone".into()))?;
    let file = |name: &FileName| {
        // Paths are kept as given, not as resolved, so that a relative folder stays relative.
        match folder.file(name)? {
            Some(_) => Ok(name.below(dir)),
            None => Err(bad(format!("the file {name} is missing"))),
        }
    };
    let mut views = Vec::with_capacity(manifest.views.len());
    let mut plans = Vec::with_capacity(manifest.views.len());
    // Results are named after views: two views with the same name would overwrite each other's results.
    let mut results: BTreeMap<String, &FileName> = BTreeMap::new();
    let model = read_model(&dir.join(MODEL))?;
    let cameras: BTreeMap<u32, u32> = model.images.iter().map(|i| (i.id, i.camera)).collect();
    for v in &manifest.views {
        v.name.clone().of_image().map_err(|e| bad(e.to_string()))?;
        if let Some(first) = results.insert(v.name.flat_stem(), &v.name) {
            return Err(bad(format!("the results of its views {first} and {} would have one name", v.name)));
        }
        let intrinsics = v.intrinsics;
        let pose =
            Pose { rotation: from_row_major(&v.rotation), translation: DVec3::from_array(v.translation) };
        let camera = Camera { intrinsics, pose };
        camera.validate().map_err(|source| ImportError::Camera { name: v.name.clone(), source })?;
        let view = View {
            name: v.name.clone(),
            id: v.id,
            image: file(&v.image)?,
            mask: v.mask.as_ref().map(file).transpose()?,
            depth_prior: v.depth_prior.as_ref().map(file).transpose()?,
            camera,
        };
        let alpha = use3d_io_image::image_info(&view.image)?.alpha;
        let id = cameras.get(&v.id).copied();
        let camera = id.ok_or_else(|| bad(format!("the model has no image {}", v.id)))?;
        let file = in_images(&v.image).unwrap_or_else(|| v.image.clone());
        plans.push(Plan { geometry: Arc::new(Geometry::identity(intrinsics)), alpha, camera, file });
        views.push(view);
    }
    let sorted =
        |list: &[usize]| list.windows(2).all(|w| w[0] < w[1]) && list.last().is_none_or(|&i| i < views.len());
    if !sorted(&manifest.train) || !sorted(&manifest.test) {
        return Err(bad("its split names views that are not there".into()));
    }
    let FrameEntry { scale, rotation, translation } = &manifest.frame;
    let frame = Frame {
        scale: *scale,
        rotation: from_row_major(rotation),
        translation: DVec3::from_array(*translation),
    };
    if !(scale.is_finite() && *scale > 0.0 && frame.rotation.is_finite() && frame.translation.is_finite()) {
        return Err(bad("its frame is not a similarity".into()));
    }
    let points = sparse_points(&model.points, &frame);
    let model = Survey { world: manifest.world, ..model.into_survey(&dir.join(MODEL))? };
    model.check(&path, "import the capture again")?;
    let split = Split { train: manifest.train, test: manifest.test };
    let name = if manifest.name.is_empty() { capture_name(dir) } else { manifest.name };
    let mut report = manifest.report;
    report.name.clone_from(&name);
    let capture = Capture { name, views, split, points, frame };
    capture.validate().map_err(|source| ImportError::Capture { path: dir.to_path_buf(), source })?;
    let originals = Originals::read(dir)?;
    if let Some(originals) = &originals {
        originals.check_views(&capture.views, dir)?;
    }
    // Without that file the pictures of this folder are the photographs.
    let all = manifest.views.iter().all(|v| in_images(&v.image).is_some());
    if !all {
        plans.iter_mut().zip(&manifest.views).for_each(|(plan, v)| plan.file = v.image.clone());
    }
    let image_folder = if all { IMAGES } else { "." }.to_string();
    Ok(Imported::prepared((capture, report), plans, model, image_folder, originals))
}
