//! The capture that a stage works on.

use use3d_capture::Capture;

use use3d_build::{StageContext, StageError};

/// Loads the capture that the import stage prepared, and checks it.
pub(super) fn capture(context: &StageContext) -> Result<Capture, StageError> {
    let imported = use3d_import::load_prepared(context.input("import")?).map_err(StageError::bad_input)?;
    imported.capture.validate().map_err(StageError::bad_input)?;
    Ok(imported.capture)
}
