//! Errors of a `transforms.json`. Each names the file, the field, the expectation and the next step.

use std::path::{Path, PathBuf};

use use3d_capture::shown;
use use3d_survey::{PlyError, SurveyError};

/// A `transforms.json` that cannot be used, or a survey that cannot be written as one.
#[derive(Debug, thiserror::Error)]
pub enum NerfstudioError {
    /// A file cannot be opened or read.
    #[error("{}: cannot be read ({source}); check that the file is there and may be read", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file that does not hold what it should.
    #[error("{}: {place}: {reason}", path.display())]
    Broken {
        /// The file.
        path: PathBuf,
        /// The frame or field.
        place: String,
        /// The fault, the expectation, and the next step.
        reason: String,
    },
    /// A survey that is not usable as a whole.
    #[error("{}: {source}; write the file again with ns-process-data", path.display())]
    Survey {
        /// The file.
        path: PathBuf,
        /// The record.
        source: SurveyError,
    },
    /// A file of points that is not one, or is cut short.
    #[error("{}: {source}", path.display())]
    Points {
        /// The file.
        path: PathBuf,
        /// The place in it.
        source: PlyError,
    },
    /// A lens that the format does not have.
    #[error("camera {camera}: {reason}; undistort the images first")]
    Lens {
        /// The camera's id.
        camera: u32,
        /// The part of the lens that has no field.
        reason: &'static str,
    },
}

impl NerfstudioError {
    pub(crate) fn broken(path: &Path, place: impl Into<String>, reason: impl Into<String>) -> Self {
        // Names come from outside, and so may hold control characters.
        let (place, reason) = (shown(&place.into()).into_owned(), shown(&reason.into()).into_owned());
        Self::Broken { path: path.to_path_buf(), place, reason }
    }
}
