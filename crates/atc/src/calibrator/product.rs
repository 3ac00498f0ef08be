//! Small dense matrix products for the two heads.
//!
//! `C += A B` with `C` row-major and `A`, `B` read through strides, so that transposes cost nothing. `B` is
//! packed in tiles of 16 columns and `A` in tiles of 6 rows. Each element of `C` is one chain of fused
//! multiply-adds over the inner index in ascending order. So the result is the same for any tiling, any
//! number of threads and any instruction set that has fused multiply-add.

use fearless_simd::{Level, Simd, dispatch, f32x16, prelude::*};
use rayon::prelude::*;
use use3d_numerics::product::{LANES, Panel, tile};

/// Rows of a tile: with 16 columns, six 512-bit or twelve 256-bit accumulators.
const TILE_ROWS: usize = 6;
const TILE_COLUMNS: usize = LANES;
/// Inner indices per pass, so that the packed `B` stays in the second-level cache.
const INNER: usize = 512;

/// A matrix read through strides: element `(i, j)` is `data[i * row_stride + j * column_stride]`.
#[derive(Clone, Copy)]
pub(super) struct Matrix<'a> {
    data: &'a [f32],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// A row-major matrix with `columns` columns.
    pub(super) fn new(data: &'a [f32], columns: usize) -> Self {
        Self { data, rows: data.len() / columns, columns, row_stride: columns, column_stride: 1 }
    }

    /// The transpose.
    pub(super) fn transposed(self) -> Self {
        Self {
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
            ..self
        }
    }

    #[inline(always)]
    fn at(&self, i: usize, j: usize) -> f32 {
        self.data[i * self.row_stride + j * self.column_stride]
    }
}

/// `c += a b`. `packed` is working memory.
pub(super) fn accumulate(a: Matrix<'_>, b: Matrix<'_>, c: &mut [f32], packed: &mut Vec<f32>) {
    let (inner, columns) = (a.columns, b.columns);
    let level = Level::new();
    assert_eq!(inner, b.rows, "inner sizes differ");
    assert_eq!(c.len(), a.rows * columns, "wrong output size");
    for first in (0..inner).step_by(INNER) {
        let depth = INNER.min(inner - first);
        packed.resize(columns.div_ceil(TILE_COLUMNS) * depth * TILE_COLUMNS, 0.0);
        packed.par_chunks_mut(depth * TILE_COLUMNS).enumerate().for_each(|(tile, out)| {
            let left = tile * TILE_COLUMNS;
            for (k, row) in out.chunks_exact_mut(TILE_COLUMNS).enumerate() {
                for (j, v) in row.iter_mut().enumerate() {
                    *v = if left + j < columns { b.at(first + k, left + j) } else { 0.0 };
                }
            }
        });
        let packed = &*packed;
        c.par_chunks_mut(columns * TILE_ROWS).with_min_len(4).enumerate().for_each(|(tile, rows)| {
            let mut left = [0.0; INNER * TILE_ROWS];
            let count = rows.len() / columns;
            for (k, column) in left.chunks_exact_mut(TILE_ROWS).take(depth).enumerate() {
                for (i, v) in column.iter_mut().take(count).enumerate() {
                    *v = a.at(tile * TILE_ROWS + i, first + k);
                }
            }
            let left = &left[..depth * TILE_ROWS];
            dispatch!(level, simd => band(simd, left, packed, depth, rows, columns));
        });
    }
}

/// Multiplies one band of up to six rows of `c` with every packed tile.
#[inline(always)]
fn band<S: Simd>(simd: S, left: &[f32], packed: &[f32], depth: usize, rows: &mut [f32], columns: usize) {
    for (index, right) in packed.chunks_exact(depth * TILE_COLUMNS).enumerate() {
        let (from, to) = (index * TILE_COLUMNS, ((index + 1) * TILE_COLUMNS).min(columns));
        let mut sums = [[f32x16::splat(simd, 0.0)]; TILE_ROWS];
        for (sum, row) in sums.iter_mut().zip(rows.chunks_exact(columns)) {
            let mut padded = [0.0; TILE_COLUMNS];
            padded[..to - from].copy_from_slice(&row[from..to]);
            sum[0] = f32x16::from_slice(simd, &padded);
        }
        tile(simd, &Panel::<TILE_ROWS>::new(left, 0), (right, TILE_COLUMNS), 0, &mut sums);
        for (sum, row) in sums.iter().zip(rows.chunks_exact_mut(columns)) {
            row[from..to].copy_from_slice(&sum[0].as_slice()[..to - from]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::math;

    /// The scalar twin: the same chain of operations per element.
    fn plain(a: Matrix<'_>, b: Matrix<'_>, c: &mut [f32]) {
        for i in 0..a.rows {
            for j in 0..b.columns {
                for k in 0..a.columns {
                    c[i * b.columns + j] = a.at(i, k).mul_add(b.at(k, j), c[i * b.columns + j]);
                }
            }
        }
    }

    #[test]
    fn tiles_give_the_bits_of_the_plain_loop() {
        let noise = |n: usize, k: usize| -> Vec<f32> { (0..n).map(|i| math::sin((i * k) as f32)).collect() };
        for (m, n, k) in [(1, 1, 1), (7, 12, 30), (13, 17, 600), (64, 33, 1100), (5, 6, 256)] {
            let (a, b) = (noise(m * k, 7), noise(k * n, 13));
            let start = noise(m * n, 3);
            let (mut fast, mut slow, mut packed) = (start.clone(), start, Vec::new());
            let (matrix_a, matrix_b) = (Matrix::new(&a, k), Matrix::new(&b, n));
            accumulate(matrix_a, matrix_b, &mut fast, &mut packed);
            plain(matrix_a, matrix_b, &mut slow);
            assert_eq!(fast, slow, "{m}x{k} times {k}x{n}");
            // The product through a transpose: bᵀ aᵀ = (a b)ᵀ.
            let (mut fast, mut slow) = (vec![0.0; m * n], vec![0.0; m * n]);
            accumulate(matrix_b.transposed(), matrix_a.transposed(), &mut fast, &mut packed);
            plain(matrix_b.transposed(), matrix_a.transposed(), &mut slow);
            assert_eq!(fast, slow);
        }
    }
}
