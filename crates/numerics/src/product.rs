//! The inner loop of every dense matrix product: one tile of the result, held in registers.
//!
//! ```text
//! sums[r][c] += Σ_k left[r, k] · right[k, c]        r < R rows,  c < 16 V columns
//! ```
//!
//! Every element is one chain of fused multiply-adds over ascending `k`, which starts from the value in
//! `sums`. So the size of a tile, the order of tiles, the packing and the number of threads change no bit,
//! and the plain loop over [`f32::mul_add`] is the twin of every product made of tiles. (Without fused
//! multiply-add in the processor the two differ by rounding.)
//!
//! The loops around the tile are in the crates of their products, and only these loops differ: networks copy
//! windows of pictures into the right factor, the calibrator reads transposed matrices through strides, the
//! network of the water keeps a block of pixels in the first-level cache. The choice of `R` and `V` is also
//! made there, by the number of registers and the layout of the left factor.

use fearless_simd::prelude::*;
use fearless_simd::{Simd, f32x16};

/// Numbers in a vector; the width of a tile is a multiple of it.
pub const LANES: usize = 16;

/// Returns true if one register holds [`LANES`] numbers, so that there are 32 such registers (AVX-512).
/// Otherwise a vector needs several registers and the tile must be smaller. Known when compiled.
#[inline(always)]
pub const fn is_wide<S: Simd>() -> bool {
    <S::f32s as SimdBase<S>>::LEN == LANES
}

/// The left factor of a tile.
pub trait Left {
    /// The factor of row `r` in term `k`.
    fn at(&self, r: usize, k: usize) -> f32;
}

/// Rows in the layout of a row-major matrix.
pub struct Rows<'a, const R: usize>([&'a [f32]; R]);

impl<'a, const R: usize> Rows<'a, R> {
    /// `R` rows that begin `stride` numbers apart, of `terms` terms each.
    #[inline(always)]
    pub fn new(values: &'a [f32], stride: usize, terms: usize) -> Self {
        // With slices of one length, the tile's loop has no bounds checks.
        let mut rows = [values; R];
        for (r, row) in rows.iter_mut().enumerate() {
            *row = &values[r * stride..][..terms];
        }
        Self(rows)
    }
}

impl<const R: usize> Left for Rows<'_, R> {
    #[inline(always)]
    fn at(&self, r: usize, k: usize) -> f32 {
        self.0[r][k]
    }
}

/// Rows packed side by side, `[term][N]`; the tile's first row is row `first` of them.
pub struct Panel<'a, const N: usize> {
    terms: &'a [[f32; N]],
    first: usize,
}

impl<'a, const N: usize> Panel<'a, N> {
    /// The rows of `values`, `[term][N]`, from `first` on.
    #[inline(always)]
    pub fn new(values: &'a [f32], first: usize) -> Self {
        Self { terms: values.as_chunks().0, first }
    }
}

impl<const N: usize> Left for Panel<'_, N> {
    #[inline(always)]
    fn at(&self, r: usize, k: usize) -> f32 {
        self.terms[k][self.first + r]
    }
}

/// Adds to `sums` the products of `left` with the columns of `right` from `start` on. `right` has rows of
/// `width` numbers, one for each term.
#[inline(always)]
pub fn tile<S: Simd, const R: usize, const V: usize>(
    simd: S,
    left: &impl Left,
    (right, width): (&[f32], usize),
    start: usize,
    sums: &mut [[f32x16<S>; V]; R],
) {
    for (k, right) in right.chunks_exact(width).enumerate() {
        // These are loops because `array::from_fn` and `map` are calls to which the enabled instruction set
        // does not apply.
        let mut x = [f32x16::splat(simd, 0.0); V];
        for v in 0..V {
            x[v] = f32x16::from_slice(simd, &right[start + v * LANES..][..LANES]);
        }
        for r in 0..R {
            for v in 0..V {
                sums[r][v] = x[v].mul_add(left.at(r, k), sums[r][v]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};
    use crate::test_support::fuses;
    use fearless_simd::{Level, dispatch};

    const TERMS: usize = 137;
    const WIDTH: usize = 96;

    #[inline(always)]
    fn run<S: Simd, const R: usize, const V: usize>(
        simd: S,
        left: &impl Left,
        right: &[f32],
        start: usize,
    ) -> Vec<f32> {
        let mut sums = [[f32x16::splat(simd, 0.25); V]; R];
        tile(simd, left, (right, WIDTH), start, &mut sums);
        sums.as_flattened().iter().flat_map(|v| v.to_array()).collect()
    }

    /// Wherever multiply-add is fused, every tile shape and both packings give the plain loop's bits.
    #[test]
    fn tiles_of_every_shape_are_plain_chains() {
        let stream = Stream::new(5, Purpose::new("tiles"), 0);
        let left: Vec<f32> = (0..8 * TERMS).map(|i| stream.normal(i as u64) as f32).collect();
        let right: Vec<f32> = (0..TERMS * WIDTH).map(|i| stream.normal(5000 + i as u64) as f32).collect();
        let packed: Vec<f32> = (0..8 * TERMS).map(|i| left[i % 8 * TERMS + i / 8]).collect();
        let plain = |first: usize, rows: usize, start: usize, columns: usize| -> Vec<f32> {
            let element = |r: usize, c: usize| {
                (0..TERMS)
                    .fold(0.25, |sum, k| left[(first + r) * TERMS + k].mul_add(right[k * WIDTH + c], sum))
            };
            (0..rows)
                .flat_map(|r| (start..start + columns).map(move |c| (r, c)))
                .map(|(r, c)| element(r, c))
                .collect()
        };
        let is_fused = fuses();
        let check = |found: Vec<f32>, expected: Vec<f32>, what: &str| {
            assert_eq!(found.len(), expected.len(), "{what}");
            for (f, e) in found.iter().zip(&expected) {
                assert!(
                    if is_fused { f.to_bits() == e.to_bits() } else { (f - e).abs() < 1e-4 },
                    "{what}: {f} for {e}"
                );
            }
        };
        let level = Level::new();
        let rows = Rows::<4>::new(&left[TERMS..], TERMS, TERMS);
        check(
            dispatch!(level, simd => run::<_, 4, 1>(simd, &rows, &right, 16)),
            plain(1, 4, 16, 16),
            "4 rows by 16",
        );
        check(
            dispatch!(level, simd => run::<_, 4, 2>(simd, &rows, &right, 64)),
            plain(1, 4, 64, 32),
            "4 rows by 32",
        );
        let panel = Panel::<8>::new(&packed, 0);
        check(
            dispatch!(level, simd => run::<_, 8, 3>(simd, &panel, &right, 0)),
            plain(0, 8, 0, 48),
            "8 rows by 48",
        );
        let panel = Panel::<8>::new(&packed, 6);
        check(
            dispatch!(level, simd => run::<_, 2, 3>(simd, &panel, &right, 48)),
            plain(6, 2, 48, 48),
            "2 rows by 48",
        );
    }
}
