//! A COLMAP folder becomes a prepared capture: pinhole cameras, pixels at their
//! size, a normalised frame, a split.

use std::path::{Path, PathBuf};

use serde_json::Value;
use use3d_build::content::Choice;
use use3d_build::{Scope, Stage, StageContext, StageError};
use use3d_import::{ImportError, ImportParams, import, prepare};
use use3d_io_colmap::ModelError;
use use3d_io_image::ImageError;

use super::common::{out_of_range, write_json};

pub(super) fn stage() -> Stage {
    Stage::new("import", Scope::Scene, run)
        .about("read a COLMAP folder: find model and images, undistort, resize, normalise, split")
        .made_of(&[], &["src/stages/import.rs"])
        .promises(&["capture.json", "report.json", "images/"])
        .check(|p: &ImportParams| p.validate().map_err(out_of_range))
        .external("capture", "capture")
        .select_by(|parameters, capture| {
            Ok(Choice { files: files(parameters, capture)?, made_from: looked_at(capture) })
        })
        .cost(0, 1 << 30)
}

/// What of a capture folder counts: the folders that the import would read, not everything beside them; and
/// the hidden files among the views', which folders do not count.
fn files(parameters: &Value, capture: &Path) -> Result<Vec<PathBuf>, String> {
    let params: ImportParams = serde_json::from_value(parameters.clone()).map_err(|e| e.to_string())?;
    let imported = import(capture, &params).map_err(|e| e.to_string())?;
    let views = &imported.capture.views;
    if use3d_import::is_prepared(capture) {
        let read = views.iter().flat_map(|v| [Some(&v.image), v.mask.as_ref(), v.depth_prior.as_ref()]);
        let mut paths = vec![PathBuf::from(".")];
        paths.extend(read.flatten().filter_map(|p| hidden(p, capture, "")));
        return Ok(paths);
    }
    let report = imported.report;
    let masks = params.mask_dir.unwrap_or_else(|| "masks".into());
    let mut paths = vec![PathBuf::from(report.model)];
    let folders = [Some(&report.image_folder), Some(&masks), report.depth_folder.as_ref()];
    for folder in folders.into_iter().flatten() {
        paths.push(PathBuf::from(folder));
        let read = views.iter().flat_map(|v| [Some(&v.image), v.mask.as_ref(), v.depth_prior.as_ref()]);
        paths.extend(read.flatten().filter_map(|p| hidden(p, capture, folder)));
    }
    paths.extend(["train_list.txt", "test_list.txt"].map(PathBuf::from));
    paths.retain(|p| capture.join(p).exists());
    Ok(paths)
}

/// More files and folders than these are not looked at one by one to see that nothing has changed.
const MOST_LOOKED_AT: usize = 4096;

/// What the choice of files is made from: all folders of the capture, whose times say whether a file came or
/// went, and the files that say which images there are, models and lists among them.
fn looked_at(capture: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in walkdir::WalkDir::new(capture).follow_links(true).sort_by_file_name() {
        // What cannot be looked at now may be seen later.
        let Ok(entry) = entry else { return Vec::new() };
        let tells = |path: &Path| {
            let extension = path.extension().map(|e| e.to_string_lossy().to_lowercase());
            extension.is_some_and(|e| ["bin", "txt", "json"].contains(&e.as_str()))
        };
        if entry.file_type().is_dir() || tells(entry.path()) {
            found.push(entry.path().strip_prefix(capture).unwrap_or(entry.path()).to_path_buf());
        }
        if found.len() > MOST_LOOKED_AT {
            return Vec::new();
        }
    }
    found
}

/// A file below a folder of the capture, relative to the capture, if a part of its name
/// in the folder begins with a dot.
fn hidden(file: &Path, capture: &Path, folder: &str) -> Option<PathBuf> {
    let dotted = |name: &Path| name.iter().any(|part| part.to_string_lossy().starts_with('.'));
    // As a rule the file's own name says it.
    if let Ok(name) = file.strip_prefix(capture.join(folder)) {
        return dotted(name).then(|| Path::new(folder).join(name));
    }
    let real = |path: &Path| path.canonicalize().ok();
    let name = real(file)?.strip_prefix(real(&capture.join(folder))?).ok()?.to_path_buf();
    dotted(&name).then(|| Path::new(folder).join(name))
}

fn run(context: &StageContext, params: &ImportParams) -> Result<(), StageError> {
    let imported = import(context.input("capture")?, params).map_err(StageError::bad_input)?;
    for line in imported.report.to_string().lines() {
        context.say(line);
    }
    imported.capture.validate().map_err(StageError::bad_input)?;
    let prepared = prepare(&imported, context.output(), context.threads(), &|done, total| {
        context.progress(done as u64, total as u64, "views");
        !context.cancelled()
    });
    if context.cancelled() {
        return Err(StageError::Cancelled);
    }
    let prepared = prepared.map_err(|error| match error {
        // What cannot be written is no fault of the capture.
        ImportError::File { .. } | ImportError::Image(ImageError::Write { .. }) => StageError::failed(error),
        ImportError::Model(ModelError::Write { .. }) => StageError::failed(error),
        error => StageError::bad_input(error),
    })?;
    write_json(&context.output().join("report.json"), &prepared.report)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hidden_files_of_views_count_one_by_one() {
        let dir = tempfile::tempdir().expect("folder");
        let images = dir.path().join("images/left");
        std::fs::create_dir_all(&images).expect("folder");
        for name in ["a.png", ".b.png"] {
            std::fs::write(images.join(name), name).expect("file");
        }
        let of = |name: &str| hidden(&images.join(name), dir.path(), "images");
        assert_eq!(of("a.png"), None);
        assert_eq!(of(".b.png"), Some(PathBuf::from("images/left/.b.png")));
        // The folders of a capture may be hidden themselves: they are named, and count.
        assert_eq!(hidden(&images.join("a.png"), dir.path(), "masks"), None);
    }
}
