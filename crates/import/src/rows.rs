//! Matrices as rows of numbers, the form of every JSON file of a capture.

use glam::DMat3;

/// Row-major entries.
pub(crate) fn row_major(m: &DMat3) -> [f64; 9] {
    m.transpose().to_cols_array()
}

/// A matrix from its row-major entries.
pub(crate) fn from_row_major(m: &[f64; 9]) -> DMat3 {
    DMat3::from_cols_array(m).transpose()
}
