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
    #[error("no camera positions were found for these {images} images: {reason}\nthe whole log: {}", log.display())]
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
    /// A folder in the place of the work that must not be used.
    #[error(
        "{}: {reason}; the work needs a folder of this name, so move this one away, and run the same command again",
        path.display()
    )]
    Foreign {
        /// The folder.
        path: PathBuf,
        /// The problem.
        reason: String,
    },
    /// A file that cannot be opened or read.
    #[error("{}: cannot be read ({source}); check that it is there and may be read", path.display())]
    Read {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file that cannot be written or removed.
    #[error("{}: cannot be written ({source}); check that the folder is writable and has space", path.display())]
    Write {
        /// The file or folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file that cannot be copied. The system does not say which of the two files is the reason.
    #[error(
        "{} cannot be copied to {} ({source}); check that the file may be read, and that the other folder is \
         writable and has space",
        from.display(),
        to.display()
    )]
    Copy {
        /// The file that exists.
        from: PathBuf,
        /// Its copy.
        to: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A program that cannot be started.
    #[error("{}: cannot be started ({source}); check that the program is there and may be started", path.display())]
    Run {
        /// The program.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The caller stopped the work; finished steps are kept.
    #[error("interrupted")]
    Interrupted,
}

impl PrepareError {
    pub(crate) fn read(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        |source| Self::Read { path: path.to_path_buf(), source }
    }

    pub(crate) fn write(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        |source| Self::Write { path: path.to_path_buf(), source }
    }

    pub(crate) fn run(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        |source| Self::Run { path: path.to_path_buf(), source }
    }

    /// The error of a walk through the folder `root`.
    pub(crate) fn walk(root: &Path, error: &walkdir::Error) -> Self {
        let path = error.path().unwrap_or(root);
        match error.io_error().map(std::io::Error::kind) {
            // The same words as in `use3d_import`, because neither crate uses the other.
            Some(std::io::ErrorKind::PermissionDenied) => Self::input(
                path,
                "you have no right to read this folder; change its rights (chmod), or ask its owner",
            ),
            Some(kind) => Self::read(path)(kind.into()),
            None => Self::input(path, error.to_string()),
        }
    }

    pub(crate) fn input(path: &Path, reason: impl Into<String>) -> Self {
        Self::Input { path: path.to_path_buf(), reason: reason.into() }
    }
}
