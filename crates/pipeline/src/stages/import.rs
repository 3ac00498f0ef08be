//! A COLMAP folder becomes a prepared capture: pinhole cameras, pixels at their size, a normalised frame, a split.

use std::path::{Path, PathBuf};

use serde_json::Value;
use use3d_io_colmap::{ImportError, ImportParams, ModelError, import, prepare};
use use3d_io_image::ImageError;

use super::common::write_json;
use crate::engine::{Scope, Stage, StageContext, StageError};

pub(super) fn stage() -> Stage {
    Stage::new("import", Scope::Scene, run)
        .about("read a COLMAP folder: find model and images, undistort, resize, normalise, split")
        .made_of(&["use3d-io-colmap", "use3d-io-image"], &["src/stages/import.rs"])
        .check(|p: &ImportParams| p.validate().map_err(|e| (String::new(), e.to_string())))
        .external("capture", "capture")
        .select(files)
        .cost(0, 1 << 30)
}

/// What of a capture folder counts: the folders that the import would read, not everything beside them.
fn files(parameters: &Value, capture: &Path) -> Result<Vec<PathBuf>, String> {
    let params: ImportParams = serde_json::from_value(parameters.clone()).map_err(|e| e.to_string())?;
    if use3d_io_colmap::is_prepared(capture) {
        return Ok(vec![PathBuf::from(".")]);
    }
    let report = import(capture, &params).map_err(|e| e.to_string())?.report;
    let mut paths = vec![PathBuf::from(report.model), PathBuf::from(report.image_folder)];
    let masks = params.mask_dir.unwrap_or_else(|| "masks".into());
    paths.extend([Some(masks), report.depth_folder].into_iter().flatten().map(PathBuf::from));
    paths.extend(["train_list.txt", "test_list.txt"].map(PathBuf::from));
    paths.retain(|p| capture.join(p).exists());
    Ok(paths)
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
