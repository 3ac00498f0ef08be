//! The errors of an image file, with the file's name, what was expected, and what to do next.

use std::error::Error;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

/// The file formats that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileFormat {
    /// Portable Network Graphics, 1 to 16 bits.
    Png,
    /// JPEG, 8 bits.
    Jpeg,
    /// TIFF, 8 or 16 bits or floating point.
    Tiff,
    /// OpenEXR, half, float or integer channels.
    Exr,
    /// One NumPy array.
    Npy,
}

impl fmt::Display for FileFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Png => "PNG",
            Self::Jpeg => "JPEG",
            Self::Tiff => "TIFF",
            Self::Exr => "EXR",
            Self::Npy => "NPY",
        })
    }
}

/// An image file that cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    /// The file cannot be opened or read.
    #[error("{}: cannot be read ({source}); check that the file is there and may be read", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// The first bytes belong to no known format.
    #[error(
        "{}: its first bytes are those of neither PNG, JPEG, TIFF, EXR nor NPY; convert it to one of these",
        path.display()
    )]
    UnknownFormat {
        /// The file.
        path: PathBuf,
    },
    /// The file is empty, as after an interrupted copy.
    #[error("{}: the file is empty; copy it or write it again", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// The header announces a size beyond the limits; no memory was allocated for it.
    #[error("{}: the {format} header announces {width}x{height} pixels, {why}", path.display())]
    Size {
        /// The file.
        path: PathBuf,
        /// Its format.
        format: FileFormat,
        /// Announced width.
        width: u64,
        /// Announced height.
        height: u64,
        /// The reason for the refusal, and the remedy.
        why: String,
    },
    /// The file is damaged or truncated, or a variant that is not supported.
    #[error(
        "{}: the {format} file is damaged or of an unsupported kind: {reason}; write it again, or convert it to 8- or 16-bit PNG",
        path.display()
    )]
    Decode {
        /// The file.
        path: PathBuf,
        /// Its format.
        format: FileFormat,
        /// The decoder's error.
        reason: String,
    },
    /// A valid file with the wrong kind of contents.
    #[error("{}: expected {expected}, found {found}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// The expected contents.
        expected: String,
        /// The contents that were found.
        found: String,
    },
    /// The file cannot be written; the old content is untouched.
    #[error("{}: cannot be written ({reason}); check that the folder is there, writable and has space", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's or the encoder's error.
        reason: String,
    },
}

/// The error of a file whose bytes are not those of its format.
pub(crate) fn damaged(reason: impl Into<Box<dyn Error + Send + Sync>>) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, reason)
}

impl ImageError {
    pub(crate) fn decode(path: &Path, format: FileFormat, reason: impl fmt::Display) -> Self {
        Self::Decode { path: path.to_path_buf(), format, reason: reason.to_string() }
    }

    pub(crate) fn write(path: &Path, reason: impl fmt::Display) -> Self {
        Self::Write { path: path.to_path_buf(), reason: reason.to_string() }
    }
}
