//! The errors of a preparation: the file or step, the reason, and the next step for the user.

use std::path::{Path, PathBuf};

use use3d_io_colmap::ModelError;
use use3d_io_image::ImageError;

/// A preparation that cannot start or cannot be finished.
#[derive(Debug, thiserror::Error)]
pub enum PrepareError {
    /// An input that is not usable.
    #[error("{}: {reason}", path.display())]
    Input {
        /// The file or folder.
        path: PathBuf,
        /// The problem, and the remedy.
        reason: String,
    },
    /// A photograph that cannot be read.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// A program that is needed and not installed.
    #[error("{0}")]
    Program(String),
    /// A choice that does not fit the inputs or the programs.
    #[error("{flag}: {reason}")]
    Choice {
        /// The flag.
        flag: &'static str,
        /// The problem, and the remedy.
        reason: String,
    },
    /// A step of another program that failed.
    #[error("{step} failed: {reason}\nthe whole log: {}", log.display())]
    Step {
        /// The step.
        step: &'static str,
        /// The last lines of the program, and the remedy.
        reason: String,
        /// The log file.
        log: PathBuf,
    },
    /// No cameras were found.
    #[error("no cameras were found for these {images} images: {reason}\nthe whole log: {}", log.display())]
    NoCameras {
        /// The number of images.
        images: usize,
        /// The remedy.
        reason: String,
        /// The log file.
        log: PathBuf,
    },
    /// A model that cannot be read or written.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// Another process works on the same capture.
    #[error("{}: another `use3d` is preparing this capture; wait for it, or choose another --out", path.display())]
    Busy {
        /// The folder of the work.
        path: PathBuf,
    },
    /// A file that cannot be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The caller stopped the work; finished steps are kept.
    #[error("interrupted")]
    Interrupted,
}

impl PrepareError {
    pub(crate) fn file(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        |source| Self::File { path: path.to_path_buf(), source }
    }

    pub(crate) fn input(path: &Path, reason: impl Into<String>) -> Self {
        Self::Input { path: path.to_path_buf(), reason: reason.into() }
    }
}
