//! Robust location and scale of every column of a sample: median and interquartile range (R18, R19).
//!
//! For an even count the median is the lower one. The quartiles are interpolated linearly between order
//! statistics. The range has a floor, so that division by the range of a constant column is harmless. It is
//! 10⁻³ for conditions, and `calibrate.scale_floor` for the scales of errors.

use use3d_numerics::order::Ascending;

/// Smallest interquartile range of a condition that is stored.
pub const RANGE_FLOOR: f64 = 1e-3;
/// Floor of the range where it is used in normalised conditions and errors.
pub const CONDITION_FLOOR: f64 = 1e-5;
/// Floor of the range where it is used in the losses of stage 2 and in the Cauchy factor of the consensus.
pub const SCALE_FLOOR: f64 = 1e-4;

/// Median and interquartile range of each column.
#[derive(Clone, Debug, PartialEq)]
pub struct Statistics {
    /// Lower median per column.
    pub median: Vec<f32>,
    /// Interquartile range per column, at least its floor.
    pub range: Vec<f32>,
}

impl Statistics {
    /// Medians 0, ranges 1.
    pub fn neutral(columns: usize) -> Self {
        Self { median: vec![0.0; columns], range: vec![1.0; columns] }
    }

    /// The statistics of rows of `columns` numbers each (at least one row), with ranges of at least `floor`.
    pub fn of(rows: &[f32], columns: usize, floor: f64) -> Self {
        let mut out = Self::neutral(columns);
        for c in 0..columns {
            let column = Ascending::of(rows.chunks_exact(columns).map(|row| row[c]));
            let quartile = |share: f64| column.interpolated(share).unwrap_or(0.0);
            out.median[c] = column.below(0.5).unwrap_or(0.0);
            out.range[c] = (quartile(0.75) - quartile(0.25)).max(floor) as f32;
        }
        out
    }

    /// Normalises rows of raw conditions in place: `(c − median) / max(range, 10⁻⁵)`.
    pub(super) fn normalise(&self, rows: &mut [f32]) {
        for row in rows.chunks_exact_mut(self.median.len()) {
            for ((v, m), r) in row.iter_mut().zip(&self.median).zip(&self.range) {
                *v = (*v - m) / r.max(CONDITION_FLOOR as f32);
            }
        }
    }
}
