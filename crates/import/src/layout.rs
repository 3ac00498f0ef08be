//! The places of models, images, masks and depth priors in a capture folder.

use std::path::{Path, PathBuf};

use use3d_io_colmap::{ModelError, ModelForm, form_of};
use use3d_survey::Survey;

use crate::error::ImportError;
use crate::folder::{DEPTH_DIRS, IMAGE_DIRS, SourceFolder, any_has, is_prepared, names_in, subfolders};
use crate::formats::{FORMATS, Format, ReadModel};
use crate::labels;
use crate::params::ImportParams;

/// A model that was found.
#[derive(Clone, Debug)]
pub(crate) struct FoundModel {
    pub(crate) format: &'static Format,
    /// Its folder or file relative to the capture, `.` for the capture itself.
    pub(crate) relative: String,
    pub(crate) path: PathBuf,
    /// The form it is stored in, as reports say it.
    pub(crate) form: String,
    /// The number of its images, where the format can be counted without reading it; else 0.
    pub(crate) images: u64,
}

impl FoundModel {
    /// Its place and its number of images, as reports print them.
    pub(crate) fn counted(&self) -> String {
        match self.images {
            0 => format!("{} ({})", self.relative, self.format.name),
            images => format!("{} ({images} images)", self.relative),
        }
    }
}

/// All models of a capture. The chosen one comes first: the one that lists the most images, or the earlier
/// place if several list the same number.
pub(crate) fn find_models(root: &Path, params: &ImportParams) -> Result<Vec<FoundModel>, ImportError> {
    if let Some(place) = &params.model_dir {
        for format in &FORMATS {
            if let Some(found) = (format.at)(root, place)? {
                return Ok(vec![found]);
            }
        }
        let path = root.join(place);
        if let Err(error @ ModelError::Incomplete { .. }) = form_of(&path) {
            return Err(error.into());
        }
        let reason = format!(
            "it names {}, which is no model of COLMAP, Metashape (.xml), nerfstudio (transforms.json), OpenSfM \
             (reconstruction.json) or RealityScan (.csv, .xmp); correct `model_dir`, or leave it out",
            path.display()
        );
        return Err(ImportError::Parameter { field: "model_dir", reason });
    }
    // The formats' own order: what lies beside the first one is reported as not used.
    let mut found = Vec::new();
    for format in &FORMATS {
        found.extend((format.find)(root)?);
    }
    if found.is_empty() {
        found.extend(FORMATS.iter().filter_map(|format| (format.search)(root)));
    }
    if !found.is_empty() {
        return Ok(found);
    }
    // A folder that cannot be listed seems empty, and a model in it is not found.
    for place in std::iter::once(".").chain(colmap_places(root).iter().map(String::as_str)) {
        let folder = if place == "." { root.to_path_buf() } else { root.join(place) };
        if folder.is_dir() {
            std::fs::read_dir(&folder).map_err(ImportError::folder(&folder))?;
        }
    }
    // A model that lacks a file is what is meant, whatever else there is.
    let incomplete = colmap_places(root).iter().map(|p| root.join(p)).find_map(|dir| {
        let error = form_of(&dir).err()?;
        matches!(error, ModelError::Incomplete { .. }).then_some(error)
    });
    if let Some(error) = incomplete {
        return Err(error.into());
    }
    let looked = "sparse/0, sparse, colmap/sparse/0, sparse/*, colmap/sparse/*, colmap and the folder itself";
    let hint = instead_of_a_model(root);
    Err(ImportError::NoModel { path: root.to_path_buf(), looked: looked.into(), hint })
}

/// The folders of a capture that COLMAP's models may lie in.
fn colmap_places(root: &Path) -> Vec<String> {
    let mut places: Vec<String> = ["sparse/0", "sparse", "colmap/sparse/0"].map(String::from).to_vec();
    for parent in ["sparse", "colmap/sparse"] {
        places.extend(subfolders(&root.join(parent)).into_iter().map(|name| format!("{parent}/{name}")));
    }
    places.extend(["colmap/sparse", "colmap", "."].map(String::from));
    places
}

/// COLMAP's models in a capture, the largest first.
pub(crate) fn find_colmap(root: &Path) -> Result<Vec<FoundModel>, ImportError> {
    let mut found: Vec<FoundModel> = Vec::new();
    for relative in &colmap_places(root) {
        if found.iter().all(|f| f.relative != *relative) {
            found.extend((FORMATS[0].at)(root, relative)?);
        }
    }
    // A stable sort keeps the order of places among equals.
    found.sort_by_key(|f| std::cmp::Reverse(f.images));
    Ok(found)
}

/// Refuses a folder in which an import with default parameters would find no model. Only the existence of
/// files is checked.
///
/// # Errors
/// Returns the places that were searched, and a remedy that depends on the folder's content.
pub fn check_layout(root: &Path) -> Result<(), ImportError> {
    find_models(root, &ImportParams::default()).map(|_| ())
}

/// True if a folder, or its image folder, has photographs.
fn holds_pictures(root: &Path, names: &[String]) -> bool {
    const PHOTOGRAPHS: [&str; 5] = ["png", "jpg", "jpeg", "tif", "tiff"];
    any_has(names, &PHOTOGRAPHS) || IMAGE_DIRS.iter().any(|name| root.join(name).is_dir())
}

/// A model in the folder above.
fn model_above(root: &Path) -> Option<PathBuf> {
    let parent = root.canonicalize().ok()?.parent()?.to_path_buf();
    has_usual_model(&parent).then_some(parent)
}

fn has_usual_model(folder: &Path) -> bool {
    ["sparse/0", "sparse", "colmap/sparse/0"].iter().any(|d| ModelForm::of(&folder.join(d)).is_some())
}

/// True if these are the names of a scene's files.
fn is_scene(names: &[String]) -> bool {
    ["scene.json", "gaussians.ply"].iter().all(|file| names.iter().any(|name| name == file))
}

/// True if `use3d run` wrote a folder with these names in it: it keeps a numbered record of each run. A
/// folder of photographs may hold the results of its own run.
fn is_results(root: &Path, names: &[String]) -> bool {
    if holds_pictures(root, names) {
        return false;
    }
    let records = names_in(&root.join("runs"), std::fs::FileType::is_file);
    let numbered = |name: &str| name.len() >= 4 && name.bytes().all(|b| b.is_ascii_digit());
    records.iter().any(|record| record.strip_suffix(".json").is_some_and(numbered))
}

/// True if a folder has no sign of a model: no model here, above or in its folders, no project of another
/// program, no scene, and no results of a run.
pub fn holds_no_model(root: &Path) -> bool {
    let names = names_in(root, |_| true);
    let project = FORMATS[1..].iter().any(|format| (format.instead)(&names).is_some());
    let made = is_scene(&names) || is_results(root, &names) || is_prepared(root);
    if project || made || model_above(root).is_some() {
        return false;
    }
    let inside = subfolders(root).iter().any(|name| has_usual_model(&root.join(name)));
    !inside && matches!(check_layout(root), Err(ImportError::NoModel { .. }))
}

/// The remedy for a folder without a model, depending on its content.
fn instead_of_a_model(root: &Path) -> String {
    let names = names_in(root, |_| true);
    // A message names this many entries of a list.
    const SHOWN: usize = 3;
    if let Some(parent) = model_above(root) {
        return format!("the parent folder contains a model: did you mean {}?", parent.display());
    }
    if is_scene(&names) {
        return "this is a scene; give the capture that it was made from".into();
    }
    if is_results(root, &names) {
        return "these are the results of a run; give the capture that they were made from".into();
    }
    if let Some(hint) = FORMATS.iter().rev().find_map(|format| (format.instead)(&names)) {
        return hint.into();
    }
    let holding = subfolders(root).into_iter().filter(|name| has_usual_model(&root.join(name)));
    let holding: Vec<String> = holding.take(SHOWN + 1).collect();
    if let Some(first) = holding.first() {
        let more = if holding.len() > SHOWN { ", …" } else { "" };
        let shown = holding[..holding.len().min(SHOWN)].join(", ");
        return format!(
            "folders in it have one ({shown}{more}): give one of them, such as {}, or name them all in a pipeline \
             file (docs/reference/pipeline-file.md)",
            root.join(first).display()
        );
    }
    if holds_pictures(root, &names) {
        return format!(
            "it has pictures and no model: `use3d prepare {} --out CAPTURE_DIR` finds the cameras with COLMAP, and \
             `use3d run` does so first; or name the model's folder with `--set model_dir=DIR` \
             (`--set import.model_dir=DIR` in `use3d run`)",
            root.display()
        );
    }
    if names.is_empty() {
        return "the folder is empty; give a folder with photographs, or a film".into();
    }
    let set = "name its folder with `--set model_dir=DIR` (`--set import.model_dir=DIR` in `use3d run`)";
    format!("{set}, or run COLMAP on the images first")
}

/// The image folder: the one that the parameters name, or the one that holds most of the model's images. The
/// names of the other folders are returned too.
pub(crate) fn find_images(
    root: &Path,
    params: &ImportParams,
    model: &mut ReadModel,
) -> Result<(SourceFolder, Vec<String>), ImportError> {
    let fail = |reason: &str, looked: String| {
        Err(ImportError::NoImages { path: root.to_path_buf(), reason: reason.into(), looked })
    };
    let usual = || model.image_dirs.iter().map(String::as_str).collect();
    let names: Vec<&str> = params.image_dir.as_deref().map_or_else(usual, |dir| vec![dir]);
    let looked = names.join(", ");
    let folders: Vec<SourceFolder> = names.iter().filter_map(|n| SourceFolder::open_own(root, n)).collect();
    let set = "`--set image_dir=DIR` (`--set import.image_dir=DIR` in `use3d run`)";
    if let (true, Some(dir)) = (folders.is_empty(), &params.image_dir) {
        let reason =
            format!("the folder {} is not there; correct it, or leave it out", root.join(dir).display());
        return Err(ImportError::Parameter { field: "image_dir", reason });
    }
    if folders.is_empty() {
        return fail(&format!("there is no image folder; name yours with {set}"), looked);
    }
    for folder in &folders {
        std::fs::read_dir(&folder.path).map_err(ImportError::folder(&root.join(&folder.relative)))?;
    }
    let (mut most, mut best) = (0, None);
    for folder in &folders {
        let count = match model.labels {
            true => labels::count(&model.survey, folder),
            false => count_named(&model.survey, folder)?,
        };
        if count > most {
            (most, best) = (count, Some(folder));
        }
    }
    // Names may differ a little from those of the files.
    let likely = |folder: &&SourceFolder| labels::likely(&model.survey, folder);
    let best = best.or_else(|| folders.iter().rev().max_by_key(likely).filter(|f| likely(f) > 0));
    let Some(folder) = best else {
        let wanted = model.survey.images.first().map_or("", |i| i.name.as_str());
        let remedy = match folders.iter().find_map(|f| unread(&f.path)) {
            Some(format) => {
                format!("its {format} images are not read: convert them to PNG under the same names")
            }
            None => format!("name the right one with {set}"),
        };
        let why = format!("none of the model's images ({wanted:?}, …) is in the image folder; {remedy}");
        return fail(&why, looked);
    };
    // The capture's folder itself is above the others.
    let others = folders.iter().filter(|f| f.path != folder.path && f.relative != ".");
    let others = others.map(|f| f.relative.clone()).collect();
    match model.labels {
        true => labels::resolve(&mut model.survey, folder)?,
        false => labels::rename(&mut model.survey, folder)?,
    }
    Ok((folder.clone(), others))
}

/// The number of a survey's images that a folder holds under their own names.
fn count_named(survey: &Survey, folder: &SourceFolder) -> Result<usize, ImportError> {
    let mut count = 0;
    for image in &survey.images {
        count += usize::from(folder.image(&image.name)?.is_some());
    }
    Ok(count)
}

/// The format of images that are in a folder and cannot be read.
fn unread(dir: &Path) -> Option<String> {
    const NOT_READ: [&str; 16] = [
        "webp", "heic", "heif", "avif", "jxl", "bmp", "gif", "dng", "cr2", "cr3", "nef", "arw", "orf", "raf",
        "rw2", "gpr",
    ];
    let entries = walkdir::WalkDir::new(dir).sort_by_file_name().into_iter().filter_map(Result::ok);
    entries
        .filter_map(|e| e.path().extension().map(|x| x.to_string_lossy().to_lowercase()))
        .find(|extension| NOT_READ.contains(&extension.as_str()))
        .map(|extension| extension.to_uppercase())
}

/// The mask or depth folder: the one that the parameters name (an error if it does not exist), or the first
/// default folder that exists, in large or small letters.
pub(crate) fn find_extra(
    root: &Path,
    asked: Option<&str>,
    field: &'static str,
    defaults: &[&str],
) -> Result<Option<SourceFolder>, ImportError> {
    let Some(dir) = asked else {
        // The exact name comes before others.
        let names = subfolders(root);
        let alike = |dir: &&str| names.iter().find(|name| name.eq_ignore_ascii_case(dir));
        let exact = defaults.iter().find(|dir| names.iter().any(|name| name == *dir)).copied();
        let chosen = exact.or_else(|| defaults.iter().find_map(alike).map(String::as_str));
        return Ok(chosen.and_then(|dir| SourceFolder::open_own(root, dir)));
    };
    let found = SourceFolder::open_own(root, dir).ok_or_else(|| {
        let reason = format!("there is no folder {}", root.join(dir).display());
        ImportError::Parameter { field, reason }
    });
    found.map(Some)
}

/// True if a capture folder has a folder of depth priors: the one that the parameters name, or one of the
/// usual names.
pub fn has_depth_folder(capture: &Path, params: &ImportParams) -> bool {
    let asked = params.depth_dir.as_deref().filter(|_| !is_prepared(capture));
    match find_extra(capture, asked, "depth_dir", &DEPTH_DIRS) {
        Ok(found) => found.is_some(),
        // If a named folder does not exist, the import refuses it later.
        Err(_) => true,
    }
}
