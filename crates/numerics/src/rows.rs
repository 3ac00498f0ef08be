//! Rows of floats of any length, processed sixteen at a time: the last vector is filled with zeros when it is
//! read, and cut when it is written.

use fearless_simd::prelude::*;
use fearless_simd::{Simd, f32x16};

/// Floats per vector.
pub const LANES: usize = 16;

/// Loads lanes `i..i + 16` of a row, zeros beyond its end.
#[inline(always)]
pub fn load<S: Simd>(simd: S, row: &[f32], i: usize) -> f32x16<S> {
    if let Some(full) = row.get(i..i + LANES) {
        f32x16::from_slice(simd, full)
    } else {
        let mut padded = [0.0; LANES];
        padded[..row.len() - i].copy_from_slice(&row[i..]);
        f32x16::from_slice(simd, &padded)
    }
}

/// Stores lanes `i..i + 16` of a row, dropping those beyond its end.
#[inline(always)]
pub fn store<S: Simd>(value: f32x16<S>, row: &mut [f32], i: usize) {
    if let Some(full) = row.get_mut(i..i + LANES) {
        value.store_slice(full);
    } else {
        let rest = row.len() - i;
        row[i..].copy_from_slice(&value.as_slice()[..rest]);
    }
}

#[cfg(test)]
mod tests {
    use fearless_simd::{Level, dispatch};

    use super::*;

    #[test]
    fn a_row_of_any_length_comes_back() {
        for length in [1, 15, 16, 17, 40] {
            let from: Vec<f32> = (1..=length).map(|v| v as f32).collect();
            let mut to = vec![0.0; length];
            for i in (0..length).step_by(LANES) {
                let lanes = dispatch!(Level::new(), simd => {
                    let lanes = load(simd, &from, i);
                    store(lanes, &mut to, i);
                    lanes.to_array()
                });
                assert!(lanes.iter().skip(length - i).all(|v| *v == 0.0));
            }
            assert_eq!(from, to);
        }
    }
}
