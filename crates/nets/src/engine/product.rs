//! The matrix product that all networks use: `out[m, n] = bias[m] + Σ_k a[m, k] · b[k, n]`.
//!
//! `a` is a weight matrix, packed once into panels of [`ROWS`] rows (`[panel][k][row]`). `b` is never stored
//! as a whole: a closure fills panels of [`LANES`] columns (`[k][column]`) when they are needed. So a
//! convolution gathers its windows directly into the panel, and no unrolled copy of the picture exists. One
//! [`ROWS`] × [`LANES`] tile of the result stays in registers during the loop over `k`.
//!
//! Every element is one chain of fused multiply-adds, from 0 over `k` ascending, independent of the tiling.
//! It has the same bits for any number of threads, any block size, and any instruction set that has a fused
//! multiply-add. The bias is added at the end. [`plain`] is the scalar twin.

use fearless_simd::{Level, Simd, dispatch, f32x16, prelude::*};
use rayon::prelude::*;
use use3d_numerics::product::{Panel, is_wide, tile};

use super::activation::{self, Activation};

/// Rows of a panel of `a`.
pub(crate) const ROWS: usize = 8;
/// Columns of a panel of `b`: three vectors of 16.
pub(crate) const LANES: usize = 48;
const TILE: usize = ROWS * LANES;
/// Length of `k` for which a panel of `b` stays in the first-level cache. It does not change any bit.
const DEPTH: usize = 192;

/// A matrix `[rows, inner]` in panels of [`ROWS`] rows; the last panel is padded with zeros.
#[derive(Clone, Debug)]
pub(crate) struct Packed {
    pub(crate) rows: usize,
    inner: usize,
    panels: Vec<f32>,
}

impl Packed {
    /// Packs `value(row, k)`.
    pub(crate) fn new(rows: usize, inner: usize, value: impl Fn(usize, usize) -> f32) -> Self {
        let mut panels = vec![0.0; rows.next_multiple_of(ROWS) * inner];
        for (panel, values) in panels.chunks_exact_mut(ROWS * inner.max(1)).enumerate() {
            for (k, at_k) in values.chunks_exact_mut(ROWS).enumerate() {
                for (v, row) in at_k.iter_mut().zip(panel * ROWS..rows) {
                    *v = value(row, k);
                }
            }
        }
        Self { rows, inner, panels }
    }

    /// Packs a row-major matrix.
    pub(crate) fn from_row_major(rows: usize, inner: usize, values: &[f32]) -> Self {
        assert_eq!(values.len(), rows * inner);
        Self::new(rows, inner, |row, k| values[row * inner + k])
    }

    fn padded_rows(&self) -> usize {
        self.rows.next_multiple_of(ROWS)
    }
}

/// The operations on an element after its sum.
#[derive(Clone, Copy, Default)]
pub(crate) struct Finish<'a> {
    /// One value per row, or none.
    pub(crate) bias: Option<&'a [f32]>,
    /// A matrix of the shape of `out`, added to the sum with its bias, or none.
    pub(crate) addend: Option<&'a [f32]>,
    /// Applied to the sum with its bias and addend.
    pub(crate) activation: Activation,
    /// Add to the values in `out` instead of replacing them.
    pub(crate) accumulate: bool,
}

/// Adds `a · b` to one tile: `a` is `[k][ROWS]`, `b` is `[k][LANES]`, `tile` is `[ROWS][LANES]`.
pub(crate) fn multiply_tile(level: Level, a: &[f32], b: &[f32], tile: &mut [f32]) {
    dispatch!(level, simd => tile_of_level(simd, a, b, tile));
}

/// The registers hold a whole tile, or two rows of it at a time.
#[inline(always)]
fn tile_of_level<S: Simd>(simd: S, a: &[f32], b: &[f32], tile: &mut [f32]) {
    if is_wide::<S>() {
        tile_kernel::<_, ROWS>(simd, a, b, tile);
    } else {
        tile_kernel::<_, 2>(simd, a, b, tile);
    }
}

#[inline(always)]
fn tile_kernel<S: Simd, const R: usize>(simd: S, a: &[f32], b: &[f32], sums: &mut [f32]) {
    let (rows, _) = sums.as_chunks_mut::<LANES>();
    for first in (0..ROWS).step_by(R) {
        let mut sums = [[f32x16::splat(simd, 0.0); 3]; R];
        for r in 0..R {
            for v in 0..3 {
                sums[r][v] = f32x16::from_slice(simd, &rows[first + r][16 * v..16 * v + 16]);
            }
        }
        tile(simd, &Panel::<ROWS>::new(a, first), (b, LANES), 0, &mut sums);
        for r in 0..R {
            for v in 0..3 {
                sums[r][v].store_slice(&mut rows[first + r][16 * v..16 * v + 16]);
            }
        }
    }
}

/// Adds `a · b` to stacks of tiles, `[padded rows][LANES]` each, for `count` panels of `b` (`[inner][LANES]`
/// each).
pub(crate) fn multiply_panels(level: Level, a: &Packed, b: &[f32], tiles: &mut [f32], count: usize) {
    let height = a.padded_rows() * LANES;
    let stride = a.inner * LANES;
    for k in (0..a.inner).step_by(DEPTH) {
        let depth = DEPTH.min(a.inner - k);
        for (p, panel) in a.panels.chunks_exact(ROWS * a.inner).enumerate() {
            let panel = &panel[k * ROWS..(k + depth) * ROWS];
            for t in 0..count {
                let b = &b[t * stride + k * LANES..][..depth * LANES];
                multiply_tile(level, panel, b, &mut tiles[t * height + p * TILE..][..TILE]);
            }
        }
    }
}

/// Number of panels of columns per task, chosen so that the task's share of `b` fits the second-level cache.
fn panels_per_job(inner: usize) -> usize {
    (1usize << 18).div_ceil(inner.max(1) * LANES).clamp(1, 8)
}

/// `out[rows, columns] = finish(a · b)`; `fill(first_column, panel)` writes the panel `[inner][LANES]` of
/// columns `first_column..first_column + LANES` (those past the end are ignored, but must be finite or zero).
pub(crate) fn product(
    a: &Packed,
    columns: usize,
    finish: Finish<'_>,
    out: &mut [f32],
    fill: impl Fn(usize, &mut [f32]) + Sync,
) {
    assert_eq!(out.len(), a.rows * columns);
    if out.is_empty() {
        return;
    }
    let level = Level::new();
    let per_job = panels_per_job(a.inner);
    let mut pieces: Vec<Vec<&mut [f32]>> = Vec::new();
    pieces.resize_with(columns.div_ceil(per_job * LANES), || Vec::with_capacity(a.rows));
    for row in out.chunks_exact_mut(columns) {
        for (job, piece) in row.chunks_mut(per_job * LANES).enumerate() {
            pieces[job].push(piece);
        }
    }
    let (height, stride) = (a.padded_rows() * LANES, a.inner * LANES);
    pieces.into_par_iter().enumerate().for_each_init(
        || (vec![0.0; per_job * stride], vec![0.0; per_job * height]),
        |(b, tiles), (job, mut rows)| {
            let first = job * per_job * LANES;
            let count = rows[0].len().div_ceil(LANES);
            for (t, panel) in b.chunks_exact_mut(stride).take(count).enumerate() {
                fill(first + t * LANES, panel);
            }
            let tiles = &mut tiles[..count * height];
            tiles.fill(0.0);
            multiply_panels(level, a, b, tiles, count);
            for (r, row) in rows.iter_mut().enumerate() {
                let bias = finish.bias.map_or(0.0, |bias| bias[r]);
                for (t, piece) in row.chunks_mut(LANES).enumerate() {
                    let sums = &mut tiles[t * height + r * LANES..][..LANES];
                    if let Some(addend) = finish.addend {
                        let addend = &addend[r * columns + first + t * LANES..][..piece.len()];
                        sums.iter_mut().zip(addend).for_each(|(s, a)| *s += a);
                    }
                    activation::finish(level, finish.activation, bias, sums);
                    if finish.accumulate {
                        piece.iter_mut().zip(sums).for_each(|(o, s)| *o += *s);
                    } else {
                        piece.copy_from_slice(&sums[..piece.len()]);
                    }
                }
            }
        },
    );
}

/// Fills a panel with columns of the row-major matrix `[inner, columns]`.
pub(crate) fn fill_from_rows(values: &[f32], columns: usize, first: usize, panel: &mut [f32]) {
    let (panel, _) = panel.as_chunks_mut::<LANES>();
    if first + LANES <= columns {
        for (at_k, row) in panel.iter_mut().zip(values.chunks_exact(columns)) {
            at_k.copy_from_slice(&row[first..first + LANES]);
        }
    } else {
        for (at_k, row) in panel.iter_mut().zip(values.chunks_exact(columns)) {
            let rest = columns - first;
            at_k[..rest].copy_from_slice(&row[first..]);
            at_k[rest..].fill(0.0);
        }
    }
}

/// The scalar twin of [`product`] for a whole `b`, row-major `[inner, columns]`, without activation.
#[cfg(test)]
pub(crate) fn plain(
    a: &[f32],
    b: &[f32],
    bias: &[f32],
    rows: usize,
    inner: usize,
    columns: usize,
) -> Vec<f32> {
    let mut out = vec![0.0; rows * columns];
    for m in 0..rows {
        for n in 0..columns {
            let mut sum = 0.0f32;
            for k in 0..inner {
                sum = a[m * inner + k].mul_add(b[k * columns + n], sum);
            }
            out[m * columns + n] = sum + bias[m];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::noise;

    #[test]
    fn every_tiling_and_thread_count_gives_the_bits_of_the_scalar_twin() {
        for (rows, inner, columns) in
            [(1, 1, 1), (7, 5, 47), (8, 192, 48), (9, 193, 49), (20, 700, 401), (3, 2000, 97)]
        {
            let a = noise(1, rows * inner);
            let b = noise(2, inner * columns);
            let bias = noise(3, rows);
            let expected = plain(&a, &b, &bias, rows, inner, columns);
            let packed = Packed::from_row_major(rows, inner, &a);
            for threads in [1, 2, 5] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let mut out = vec![f32::NAN; rows * columns];
                let finish = Finish { bias: Some(&bias), ..Finish::default() };
                pool.install(|| {
                    product(&packed, columns, finish, &mut out, |first, panel| {
                        fill_from_rows(&b, columns, first, panel);
                    });
                });
                assert_eq!(out, expected, "{rows} × {inner} × {columns}, {threads} threads");
            }
        }
    }

    #[test]
    fn narrow_registers_give_the_same_bits_as_wide_ones() {
        let (a, b) = (noise(4, 300 * ROWS), noise(5, 300 * LANES));
        let mut expected = vec![0.5; TILE];
        multiply_tile(Level::new(), &a, &b, &mut expected);
        let mut narrow = vec![0.5; TILE];
        dispatch!(Level::new(), simd => tile_kernel::<_, 2>(simd, &a, &b, &mut narrow));
        assert_eq!(narrow, expected);
    }

    #[test]
    fn accumulation_adds_to_what_is_there() {
        let (a, b) = (noise(6, 10 * 30), noise(7, 30 * 60));
        let packed = Packed::from_row_major(10, 30, &a);
        let fresh = plain(&a, &b, &[0.0; 10], 10, 30, 60);
        let mut out = vec![1.0; 600];
        let finish = Finish { accumulate: true, ..Finish::default() };
        product(&packed, 60, finish, &mut out, |first, panel| fill_from_rows(&b, 60, first, panel));
        assert!(out.iter().zip(&fresh).all(|(o, f)| *o == 1.0 + f));
    }
}
