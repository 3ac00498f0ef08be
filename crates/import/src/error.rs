//! The errors of a capture: the file, the place in it, what was expected, what to do next.

use std::path::{Path, PathBuf};

use use3d_capture::{CameraError, CaptureError, FileName, NameError};
use use3d_io_colmap::ModelError;
use use3d_io_image::ImageError;
use use3d_numerics::range::OutOfRange;
use use3d_survey::ReadError;

use crate::undistort::LensFault;

/// A capture that cannot be imported, prepared or loaded.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// An error in the model.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// An error in a file of another program, or in a table beside the photographs.
    #[error(transparent)]
    Survey(#[from] ReadError),
    /// An error in an image, a mask or a depth prior.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// An error in the capture as a whole.
    #[error("{}: {source}", path.display())]
    Capture {
        /// The capture's folder.
        path: PathBuf,
        /// The problem.
        source: CaptureError,
    },
    /// No model in any of the usual places.
    #[error(
        "{}: no camera positions found: {hint} (looked in {looked})",
        path.display()
    )]
    NoModel {
        /// The capture's folder.
        path: PathBuf,
        /// The places that were searched.
        looked: String,
        /// The remedy, which depends on the folder's content.
        hint: String,
    },
    /// No image folder, or no folder that holds any of the model's images.
    #[error("{}: {reason} (looked in {looked})", path.display())]
    NoImages {
        /// The capture's folder.
        path: PathBuf,
        /// The missing part, and the remedy.
        reason: String,
        /// The places that were searched.
        looked: String,
    },
    /// A name in the model that leads out of the image folder.
    #[error("the model names an image {name}, which {reason}; images must lie inside {}", folder.display())]
    Name {
        /// The name.
        name: FileName,
        /// The reason for the refusal.
        reason: String,
        /// The folder.
        folder: PathBuf,
    },
    /// A file of a capture whose name is not accepted.
    #[error("{}: {source}, and export the cameras again", path.display())]
    FileName {
        /// The file.
        path: PathBuf,
        /// The problem, and the remedy.
        source: NameError,
    },
    /// A result that cannot be named after its image.
    #[error("an image's result: {0}")]
    ResultName(#[from] NameError),
    /// A file whose size does not fit its camera.
    #[error("{}: the file is {} x {} pixels, {expected}", path.display(), found.0, found.1)]
    Size {
        /// The file.
        path: PathBuf,
        /// Its size.
        found: (usize, usize),
        /// The expected size, and the remedy.
        expected: String,
    },
    /// A lens whose images cannot be undistorted.
    #[error(
        "camera {camera} of the model: {reason}; calibrate it again, or undistort the images with COLMAP"
    )]
    Lens {
        /// The camera's id in the model.
        camera: u32,
        /// The problem.
        reason: LensFault,
    },
    /// A view whose camera is not usable.
    #[error("image {name}: {source}")]
    Camera {
        /// The image.
        name: FileName,
        /// The problem.
        source: CameraError,
    },
    /// A parameter outside its range.
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
    /// A parameter that does not fit the capture.
    #[error("parameter `{field}`: {reason}")]
    Parameter {
        /// Its name.
        field: &'static str,
        /// The problem, and the expected value.
        reason: String,
    },
    /// A list that cannot be read: of cameras, or one of names that does not fit the capture.
    #[error("{}: {reason}", path.display())]
    List {
        /// The list.
        path: PathBuf,
        /// The problem, and the expected form or the remedy.
        reason: String,
    },
    /// A prepared capture that cannot be read back.
    #[error("{}: {reason}; import the capture again", path.display())]
    Prepared {
        /// The file.
        path: PathBuf,
        /// The problem.
        reason: String,
    },
    /// A file that cannot be read or written.
    #[error("{}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The caller stopped the work.
    #[error("the import was interrupted")]
    Interrupted,
}

impl ImportError {
    pub(crate) fn file_name(path: &Path) -> impl Fn(NameError) -> Self + '_ {
        |source| Self::FileName { path: path.to_path_buf(), source }
    }

    /// The error of a folder that cannot be listed.
    pub(crate) fn folder(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        |source| {
            // The same words as in `use3d_prepare`, because neither crate uses the other.
            let words = "you have no right to read this folder; change its rights (chmod), or ask its owner";
            let source = match source.kind() {
                kind @ std::io::ErrorKind::PermissionDenied => std::io::Error::new(kind, words),
                _ => source,
            };
            Self::File { path: path.to_path_buf(), source }
        }
    }

    pub(crate) fn file(path: &Path) -> impl Fn(std::io::Error) -> Self + '_ {
        |source| Self::File { path: path.to_path_buf(), source }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_without_the_right_to_read_it_is_said_in_words() {
        let of = |kind: std::io::ErrorKind| ImportError::folder(Path::new("dive"))(kind.into()).to_string();
        let said = of(std::io::ErrorKind::PermissionDenied);
        let expected =
            "dive: you have no right to read this folder; change its rights (chmod), or ask its owner";
        assert_eq!(said, expected);
        assert!(!of(std::io::ErrorKind::NotADirectory).contains("chmod"));
    }
}
