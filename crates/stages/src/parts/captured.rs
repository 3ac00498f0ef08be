//! The capture that a stage works on, and the cameras that a scene keeps of it.

use std::path::Path;

use use3d_capture::{Camera, Capture};
use use3d_import::{Imported, camera_list};
use use3d_workflow::{StageContext, StageError};

use super::files::{CAMERAS, write_json};

/// Loads what the import stage prepared: the capture with the tracks of its points.
pub(crate) fn imported(context: &StageContext) -> Result<Imported, StageError> {
    use3d_import::load_prepared(context.input("import")?).map_err(StageError::bad_input)
}

/// Loads the capture that the import stage prepared, and checks it.
pub(crate) fn capture(context: &StageContext) -> Result<Capture, StageError> {
    let capture = imported(context)?.capture;
    capture.validate().map_err(StageError::bad_input)?;
    Ok(capture)
}

/// Writes the training cameras beside a scene, as a list in COLMAP's frame for `use3d render --cameras`.
pub(crate) fn write_cameras(out: &Path, capture: &Capture) -> Result<(), StageError> {
    let in_colmap = |camera: &Camera| Camera { pose: capture.frame.invert_pose(&camera.pose), ..*camera };
    let cameras = camera_list(capture.training_views().map(|view| (&*view.name, in_colmap(&view.camera))));
    write_json(&out.join(CAMERAS), &cameras)
}
