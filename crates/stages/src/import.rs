//! Converts a capture folder into a prepared capture: pinhole cameras, pixels at their size, a normalised
//! frame and a split.

use std::path::{Component, Path, PathBuf};

use use3d_import::{ImportError, ImportParams, Imported, import, prepare};
use use3d_io_colmap::ModelError;
use use3d_io_image::ImageError;
use use3d_workflow::content::Choice;
use use3d_workflow::{StageContext, StageError};

use crate::parts::files::{choice_sources, out_of_range, read, write, write_json};
use crate::parts::sights::{CaptureSights, SIGHTS, SightsError};

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_workflow::{Scope, Stage};

    use crate::planning::expected::of_import;

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("import", Scope::Scene, run)
            .about("read the photographs, and where the camera was for each")
            .promises(&["capture.json", "originals.json", "report.json", "images/"])
            .check(|p: &ImportParams| p.validate().map_err(out_of_range))
            .input("capture", "prepare")
            .or_external("capture")
            .select_by(|parameters, capture| {
                Ok(Choice { files: files(parameters, capture)?, made_from: choice_sources(capture) })
            })
            .expects(of_import)
            .cost(0, 1 << 30)
    }
}

/// The files of a capture folder that count in the key: those that the import would read, and no others in
/// the folder. Hidden files among the views are listed by name, because a folder's digest skips them.
fn files(params: &ImportParams, capture: &Path) -> Result<Vec<PathBuf>, ImportError> {
    let imported = import(capture, params)?;
    let views = imported.capture.views.iter();
    let read =
        || views.clone().flat_map(|v| [Some(&v.image), v.mask.as_ref(), v.depth_prior.as_ref()]).flatten();
    if use3d_import::is_prepared(capture) {
        let hidden = below(read(), capture, "").into_iter().filter(|file| has_hidden_part(file));
        return Ok([PathBuf::from(".")].into_iter().chain(hidden).collect()); // the whole folder, with its sights
    }
    let mut paths = imported.model_files.to_vec();
    let report = &imported.report;
    let masks = params.mask_dir.clone().unwrap_or_else(|| "masks".into());
    let folders = [Some(&report.image_folder), Some(&masks), report.depth_folder.as_ref()];
    // The files are listed one by one: other files of these folders, which the model does not name, are not
    // part of the capture.
    for folder in folders.into_iter().flatten() {
        paths.extend(below(read(), capture, folder));
    }
    paths.extend(["train_list.txt", "test_list.txt"].map(PathBuf::from));
    paths.retain(|p| capture.join(p).exists());
    Ok(paths)
}

/// Those of `files` that are below a folder of the capture, as paths relative to the capture.
fn below<'f>(files: impl Iterator<Item = &'f PathBuf>, capture: &Path, folder: &str) -> Vec<PathBuf> {
    let place = capture.join(folder);
    let Ok(real) = place.canonicalize() else { return Vec::new() };
    let capture_real = capture.canonicalize().ok();
    let name = |file: &PathBuf| {
        // The path itself shows it, unless it contains a step upwards.
        let plain = |rest: &&Path| rest.components().all(|part| matches!(part, Component::Normal(_)));
        for root in [&place, &real] {
            if let Some(rest) = file.strip_prefix(root).ok().filter(plain) {
                return Some(Path::new(folder).join(rest));
            }
        }
        // A file of another folder of the capture is listed there.
        if capture_real.as_ref().is_some_and(|root| file.strip_prefix(root).ok().filter(plain).is_some()) {
            return None;
        }
        let file = file.canonicalize().ok()?;
        Some(Path::new(folder).join(file.strip_prefix(&real).ok()?))
    };
    files.filter_map(name).collect()
}

/// True if a part of a relative path begins with a dot. Such files count only if they are named.
fn has_hidden_part(file: &Path) -> bool {
    file.iter().any(|part| part.to_string_lossy().starts_with('.') && part != ".")
}

fn run(context: &StageContext, params: &ImportParams) -> Result<(), StageError> {
    let imported = import(context.input("capture")?, params).map_err(StageError::bad_input)?;
    for (detail, line) in imported.report.lines() {
        if detail { context.detail(line) } else { context.say(line) }
    }
    imported.capture.validate().map_err(StageError::bad_input)?;
    let prepared = prepare(&imported, context.output(), context.threads(), &|done, total| {
        context.progress(done as u64, total as u64, "views");
        !context.cancelled()
    });
    context.alive()?;
    let prepared = prepared.map_err(|error| match error {
        // A failed write is not an error of the capture.
        ImportError::File { .. }
        | ImportError::Image(ImageError::Write { .. })
        | ImportError::Model(ModelError::Write { .. }) => StageError::failed(error),
        error => StageError::bad_input(error),
    })?;
    if let Some(overlay) = prepared.report.overlay.filter(|_| imported.report.overlay.is_none()) {
        context.say(overlay.note());
    }
    keep_sights(context, &imported, prepared.report.white_balance)?;
    write_json(&context.output().join("report.json"), &prepared.report)
}

/// Keeps the measurements of the water in the photographs at their full size, because scenes may be learnt at
/// another size. An import of an import keeps the measurements of the first one.
fn keep_sights(
    context: &StageContext,
    imported: &Imported,
    balance: Option<[f32; 3]>,
) -> Result<(), StageError> {
    let (before, after) = (context.input("capture")?.join(SIGHTS), context.output().join(SIGHTS));
    let bytes = if use3d_import::is_prepared(context.input("capture")?) && before.is_file() {
        read(&before)?
    } else {
        let seen = CaptureSights::of_files(imported, balance, || !context.cancelled());
        let seen = seen.map_err(|error| match error {
            SightsError::Stopped => StageError::Cancelled,
            error => StageError::bad_input(error),
        })?;
        seen.bytes().map_err(StageError::failed)?
    };
    write(&after, bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_views_count_one_by_one() {
        let dir = tempfile::tempdir().expect("folder");
        let images = dir.path().join("images/left");
        std::fs::create_dir_all(&images).expect("folder");
        for name in ["a.png", ".b.png"] {
            std::fs::write(images.join(name), name).expect("file");
        }
        let files = ["a.png", ".b.png"].map(|name| images.join(name));
        let named = below(files.iter(), dir.path(), "images");
        assert_eq!(named, ["images/left/a.png", "images/left/.b.png"].map(PathBuf::from));
        assert_eq!(named.iter().map(|f| has_hidden_part(f)).collect::<Vec<_>>(), [false, true]);
        assert_eq!(below(files.iter(), dir.path(), "masks"), Vec::<PathBuf>::new());
    }
}
