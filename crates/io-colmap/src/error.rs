//! The errors of a model: the file, the place in it, what was expected, what to do next.

use std::path::{Path, PathBuf};

use crate::lens::LensModel;

/// A COLMAP model that cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The folder holds no model.
    #[error(
        "{}: no COLMAP model here; expected cameras, images and points3D, all as .bin or all as .txt",
        path.display()
    )]
    NotFound {
        /// The folder.
        path: PathBuf,
    },
    /// The folder holds some of a model's files.
    #[error(
        "{}: the COLMAP model here lacks {missing}; copy it from where the model was made, or export the model again",
        path.display()
    )]
    Incomplete {
        /// The folder.
        path: PathBuf,
        /// The files that are missing.
        missing: String,
    },
    /// A camera model that is not supported.
    #[error("{}: {place}: {reason}", path.display())]
    UnknownLens {
        /// The file.
        path: PathBuf,
        /// The record or line.
        place: String,
        /// The name of the camera model, and the remedy.
        reason: String,
    },
    /// A file cannot be opened or read.
    #[error("{}: cannot be read ({source}); check that the file is there and may be read", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A file with invalid content.
    #[error("{}: {place}: {reason}; export the model again with COLMAP", path.display())]
    Broken {
        /// The file, or the model's folder if several files are concerned.
        path: PathBuf,
        /// The record, line or byte.
        place: String,
        /// The problem.
        reason: String,
    },
    /// A file that ends before the data that it announces.
    #[error(
        "{}: {place}: the file is cut off: {reason}; copy it again, or export the model again with COLMAP",
        path.display()
    )]
    CutOff {
        /// The file.
        path: PathBuf,
        /// The record and the byte.
        place: String,
        /// The missing data.
        reason: String,
    },
    /// A file cannot be written; the old content is untouched.
    #[error("{}: cannot be written ({source}); check that the folder is writable and has space", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
}

impl ModelError {
    pub(crate) fn broken(path: &Path, place: String, reason: String) -> Self {
        Self::Broken { path: path.to_path_buf(), place, reason }
    }

    /// The error for a camera model that is not one of the lenses.
    pub(crate) fn unknown_lens(path: &Path, place: String, shown: &str, id: i32) -> Self {
        let (panorama, of_panoramas) = LensModel::PANORAMA;
        let known: Vec<&str> = LensModel::ALL.iter().map(|m| m.name()).collect();
        let (named, hint) = if id == of_panoramas || shown == panorama {
            let named = if shown == panorama { shown.to_string() } else { format!("{panorama} ({shown})") };
            (
                named,
                "a panorama has rays in all directions: cut it into perspective images before you run COLMAP",
            )
        } else {
            let hint = "the file may be damaged, or of a COLMAP after 4.2: export the model again, or run `colmap image_undistorter`";
            (shown.to_string(), hint)
        };
        let reason =
            format!("the camera model {named} is not supported; {hint}. Supported are {}", known.join(", "));
        Self::UnknownLens { path: path.to_path_buf(), place, reason }
    }
}
