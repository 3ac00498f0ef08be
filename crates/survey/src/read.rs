//! The ground that readers of files share: files of bounded size, and errors that each name the file, the
//! field, the expectation and the next step.

use std::io::Read;
use std::path::{Path, PathBuf};

use glam::DMat3;
use use3d_capture::shown;

/// A file of a photogrammetry program that cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
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
        /// The element, frame, field, line, vertex or record.
        place: String,
        /// The fault, the expectation, and the next step.
        reason: String,
    },
}

impl ReadError {
    /// A fault at a place of a file. Both texts may quote the file, so control characters are made visible.
    pub fn broken(path: &Path, place: impl Into<String>, reason: impl Into<String>) -> Self {
        let (place, reason) = (shown(&place.into()).into_owned(), shown(&reason.into()).into_owned());
        Self::Broken { path: path.to_path_buf(), place, reason }
    }
}

/// Reads a whole file of at most `most` bytes. `remedy` is the next step for a larger one.
///
/// # Errors
/// A file that cannot be read, or is larger.
pub fn read_at_most(path: &Path, most: u64, remedy: &str) -> Result<Vec<u8>, ReadError> {
    let open = |source| ReadError::Open { path: path.to_path_buf(), source };
    let length = std::fs::metadata(path).map_err(open)?.len();
    if length > most {
        let reason = format!("it has {length} bytes; expected at most {most}: {remedy}");
        return Err(ReadError::broken(path, "file", reason));
    }
    std::fs::read(path).map_err(open)
}

/// The first bytes of a file, at most `most`; `None` if it cannot be read.
pub fn first_bytes(path: &Path, most: u64) -> Option<Vec<u8>> {
    let mut head = Vec::new();
    std::fs::File::open(path).ok()?.take(most).read_to_end(&mut head).ok()?;
    Some(head)
}

/// A path or label of a photograph as a name: without a drive, leading separators, and parts that lead up.
pub fn tidy_name(text: &str) -> String {
    let parts = text.split(['/', '\\']);
    let kept = parts.filter(|p| !p.is_empty() && *p != "." && *p != ".." && !p.ends_with(':'));
    kept.collect::<Vec<_>>().join("/")
}

/// The last row of a matrix may be off by this: some writers invert matrices to get their poses.
const LAST_ROW: f64 = 1e-6;

/// The reason why a matrix is no rotation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RotationFault {
    /// The largest entry of `R Rᵀ − 1`, absolute; may be NaN.
    NotOrthonormal(f64),
    /// The determinant is −1.
    Mirrored,
}

/// Checks that a matrix is a rotation, up to `tolerance` in every entry of `R Rᵀ`.
///
/// # Errors
/// The reason why it is none.
pub fn check_rotation(rotation: &DMat3, tolerance: f64) -> Result<(), RotationFault> {
    let gram = *rotation * rotation.transpose() - DMat3::IDENTITY;
    // A plain maximum would pass over NaN.
    let worse = |most: f64, v: f64| {
        if most.is_nan() {
            most
        } else if v.is_nan() {
            v
        } else {
            most.max(v.abs())
        }
    };
    let off = gram.to_cols_array().into_iter().fold(0.0, worse);
    if off.is_nan() || off > tolerance {
        return Err(RotationFault::NotOrthonormal(off));
    }
    if rotation.determinant() < 0.0 { Err(RotationFault::Mirrored) } else { Ok(()) }
}

/// True if these numbers are the last row of a pose or a similarity: 0 0 0 1, up to rounding. In a transposed
/// matrix, the translation is there.
pub fn is_last_row(row: &[f64]) -> bool {
    let expected = [0.0, 0.0, 0.0, 1.0];
    row.len() == expected.len() && row.iter().zip(expected).all(|(a, b)| (a - b).abs() <= LAST_ROW)
}

#[cfg(test)]
mod tests {
    use glam::DVec3;

    use super::*;

    #[test]
    fn scales_mirrors_and_nan_are_no_rotations() {
        let turn = DMat3::from_axis_angle(DVec3::new(1.0, 2.0, 3.0).normalize(), 0.7);
        assert_eq!(check_rotation(&turn, 1e-9), Ok(()));
        assert!(
            matches!(check_rotation(&(turn * 1.1), 1e-3), Err(RotationFault::NotOrthonormal(off)) if off > 0.2)
        );
        let mirrored = turn * DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
        assert_eq!(check_rotation(&mirrored, 1e-9), Err(RotationFault::Mirrored));
        // The first entries are not finite, the last ones are.
        let mut broken = DMat3::IDENTITY;
        broken.x_axis.x = f64::NAN;
        assert!(
            matches!(check_rotation(&broken, 1e-3), Err(RotationFault::NotOrthonormal(off)) if off.is_nan())
        );
    }

    #[test]
    fn the_last_row_may_be_rounded_and_holds_no_translation() {
        assert!(is_last_row(&[0.0, -1e-9, 0.0, 1.0 + 1e-9]));
        for bad in
            [&[0.0, 0.0, 0.2, 1.0][..], &[0.0, 0.0, 0.0, 2.0], &[f64::NAN, 0.0, 0.0, 1.0], &[0.0, 0.0, 1.0]]
        {
            assert!(!is_last_row(bad), "{bad:?}");
        }
    }

    #[test]
    fn a_larger_file_is_refused_before_it_is_read() {
        let file = std::env::temp_dir().join(format!("use3d-survey-{}", std::process::id()));
        std::fs::write(&file, b"12345").unwrap();
        assert_eq!(read_at_most(&file, 5, "cut it").unwrap(), b"12345");
        let error = read_at_most(&file, 4, "cut it").unwrap_err().to_string();
        assert!(error.ends_with("it has 5 bytes; expected at most 4: cut it"), "{error}");
        std::fs::remove_file(&file).unwrap();
        assert!(read_at_most(&file, 5, "cut it").unwrap_err().to_string().contains("cannot be read"));
    }
}
