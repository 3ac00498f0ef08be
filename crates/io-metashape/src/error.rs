//! Errors of an export. Each names the file, the field, the expectation and the next step.

use std::path::{Path, PathBuf};

use use3d_capture::shown;
use use3d_survey::{PlyError, SurveyError};

/// An export of Metashape that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum MetashapeError {
    /// A file cannot be opened or read.
    #[error("{}: cannot be read ({source}); check that the file is there and may be read", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A file that is no cameras file, or that does not hold what it should.
    #[error("{}: {place}: {reason}", path.display())]
    Broken {
        /// The file.
        path: PathBuf,
        /// The element or attribute.
        place: String,
        /// The fault, the expectation, and the next step.
        reason: String,
    },
    /// A survey that is not usable as a whole.
    #[error("{}: {source}; check the project in Metashape and export the cameras again", path.display())]
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
}

impl MetashapeError {
    pub(crate) fn broken(path: &Path, place: impl Into<String>, reason: impl Into<String>) -> Self {
        // Labels come from outside, and so may hold control characters.
        let (place, reason) = (shown(&place.into()).into_owned(), shown(&reason.into()).into_owned());
        Self::Broken { path: path.to_path_buf(), place, reason }
    }
}
