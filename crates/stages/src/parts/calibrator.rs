//! Reads a calibrator from any of its places: the artifact of `calibrate`, its file elsewhere, or the file
//! that the paper's authors released.

use std::path::Path;

use use3d_atc::calibrator::Calibrator;
use use3d_workflow::StageError;

use super::files::{CALIBRATOR, read};

/// Far more bytes than any calibrator has; a larger file must be something else.
const LARGEST_FILE: u64 = 1 << 30;

/// Reads a calibrator from its file, in this program's format or in the authors', or from the folder that
/// holds the file.
pub(crate) fn read_calibrator(path: &Path) -> Result<Calibrator, StageError> {
    let file = if path.is_dir() { path.join(CALIBRATOR) } else { path.to_path_buf() };
    let wrong = |problem: String| StageError::bad_input_message(format!("{}: {problem}", file.display()));
    let size = std::fs::metadata(&file).map_err(|e| StageError::io(&file, e))?.len();
    if size > LARGEST_FILE {
        return Err(wrong(format!("{size} bytes are more than any calibrator has; is this the right file?")));
    }
    let bytes = read(&file)?;
    if Calibrator::is_own_file(&bytes) {
        return Calibrator::from_bytes(&bytes).map_err(|e| wrong(e.to_string()));
    }
    released(&file, &wrong)
}

/// Reads the authors' `transition_calibrator.pth`, or the same tensors as safetensors.
fn released(file: &Path, wrong: &dyn Fn(String) -> StageError) -> Result<Calibrator, StageError> {
    use use3d_atc::calibrator::ReleasedConfig;
    use use3d_nets::Archive;

    /// A hundred times the number of values in the authors' file.
    const MOST_VALUES: usize = 10_000_000;
    let expected = "expected a calibrator of `use3d calibrate` or the authors' transition_calibrator.pth";
    let unneeded = |name: &str| name.contains("support_");
    let archive = Archive::read(file, "global_head.0.bias", &unneeded, MOST_VALUES)
        .map_err(|e| StageError::bad_input_message(format!("{e}; {expected}")))?;
    let mut config = ReleasedConfig::default();
    // A missing label is no error: the tensors' names and shapes are checked one by one anyway.
    if let Some(schema) = archive.labels.get("schema") {
        config.schema.clone_from(schema);
    }
    if let Some(version) = archive.labels.get("schema_version") {
        config.schema_version = version
            .parse()
            .map_err(|_| wrong(format!("its `schema_version` is `{version}`, expected a whole number")))?;
    }
    Calibrator::from_named_tensors(archive.tensors, &config).map_err(|e| wrong(format!("{e}; {expected}")))
}
