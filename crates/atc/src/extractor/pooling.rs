//! Adaptive mean pooling and its exact adjoint.
//!
//! Bin `k` of `n` over an axis of length `L` covers the indices `⌊k L / n⌋ … ⌈(k + 1) L / n⌉ − 1`. Bins
//! overlap by one index where `L / n` is not an integer, and repeat indices where `n > L`.

use std::ops::Range;

use rayon::prelude::*;

/// The bins of one axis.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Bins {
    start: Vec<usize>,
    end: Vec<usize>,
    /// The bins that cover each index of the axis.
    pub(crate) covering: Vec<Range<usize>>,
}

impl Bins {
    /// `n` bins over a length of `length` (both at least 1).
    pub(crate) fn new(length: usize, n: usize) -> Self {
        let start: Vec<usize> = (0..n).map(|k| k * length / n).collect();
        let end: Vec<usize> = (0..n).map(|k| ((k + 1) * length).div_ceil(n)).collect();
        let covering = (0..length)
            .map(|i| end.partition_point(|&e| e <= i)..start.partition_point(|&s| s <= i))
            .collect();
        Self { start, end, covering }
    }

    /// Number of bins.
    pub(crate) fn len(&self) -> usize {
        self.start.len()
    }

    /// The axis's length.
    pub(crate) fn length(&self) -> usize {
        self.covering.len()
    }

    fn size(&self, k: usize) -> usize {
        self.end[k] - self.start[k]
    }
}

/// Pools images with `P` planes: from `[P][h][w]` to `[rows][P][columns]`, so that a band of pooled rows is
/// contiguous.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Pooling {
    /// Bins along x.
    pub(crate) x: Bins,
    /// Bins along y.
    pub(crate) y: Bins,
}

impl Pooling {
    /// Pools from a size of `(width, height)` to `(columns, rows)`.
    pub(crate) fn new(size: (usize, usize), to: (usize, usize)) -> Self {
        Self { x: Bins::new(size.0, to.0), y: Bins::new(size.1, to.1) }
    }

    /// Computes the means over the bins, accumulated in f64. `column_sums` is working memory.
    pub(crate) fn forward<T: Copy + Into<f64> + Sync>(
        &self,
        planes: usize,
        image: &[T],
        pooled: &mut [f64],
        column_sums: &mut Vec<f64>,
    ) {
        let (w, h, columns) = (self.x.length(), self.y.length(), self.x.len());
        debug_assert_eq!(image.len(), planes * w * h);
        column_sums.resize(planes * self.y.len() * w, 0.0);
        pooled.par_chunks_mut(columns).zip(column_sums.par_chunks_mut(w)).enumerate().for_each(
            |(index, (out, sums))| {
                let (k, plane) = (index / planes, index % planes);
                sums.fill(0.0);
                for y in self.y.start[k]..self.y.end[k] {
                    let row = &image[(plane * h + y) * w..][..w];
                    crate::vectorized::vectorized!(add_row(sums, row));
                }
                for (c, o) in out.iter_mut().enumerate() {
                    let sum: f64 = sums[self.x.start[c]..self.x.end[c]].iter().sum();
                    *o = sum / (self.x.size(c) * self.y.size(k)) as f64;
                }
            },
        );
    }

    /// First half of the adjoint: the gradient of each pooled row (`[rows][P][columns]`) is divided by its
    /// bins' sizes and spread over the columns, `[rows][P][w]`. In the second half, the adjoint at an image
    /// row is the sum of the spread rows that cover it.
    pub(crate) fn spread(&self, planes: usize, d_pooled: &[f64], wide: &mut [f32]) {
        let (w, columns) = (self.x.length(), self.x.len());
        wide.par_chunks_mut(w).zip(d_pooled.par_chunks(columns)).enumerate().for_each(
            |(index, (wide, row))| {
                let k = index / planes;
                wide.fill(0.0);
                for (c, &g) in row.iter().enumerate() {
                    let share = (g / (self.x.size(c) * self.y.size(k)) as f64) as f32;
                    for v in &mut wide[self.x.start[c]..self.x.end[c]] {
                        *v += share;
                    }
                }
            },
        );
    }
}

#[inline(always)]
fn add_row<T: Copy + Into<f64>>(sums: &mut [f64], row: &[T]) {
    for (s, &v) in sums.iter_mut().zip(row) {
        *s += v.into();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::math;

    #[test]
    fn bins_are_those_of_adaptive_pooling() {
        let bins = Bins::new(10, 4);
        assert_eq!((bins.start.clone(), bins.end.clone()), (vec![0, 2, 5, 7], vec![3, 5, 8, 10]));
        assert_eq!(bins.covering[2], 0..2);
        let repeat = Bins::new(3, 7);
        assert_eq!(repeat.start, [0, 0, 0, 1, 1, 2, 2]);
        assert_eq!(repeat.end, [1, 1, 2, 2, 3, 3, 3]);
        for bins in [Bins::new(10, 4), Bins::new(3, 7), Bins::new(35, 16), Bins::new(8, 8)] {
            for (i, covering) in bins.covering.iter().enumerate() {
                for k in 0..bins.len() {
                    let covers = bins.start[k] <= i && i < bins.end[k];
                    assert_eq!(covers, covering.contains(&k));
                }
            }
        }
    }

    #[test]
    fn the_adjoint_is_the_transpose() {
        for (size, to) in [((19, 11), (8, 16)), ((5, 4), (16, 16)), ((24, 16), (8, 8))] {
            let pooling = Pooling::new(size, to);
            let (w, h) = size;
            let image: Vec<f32> = (0..w * h).map(|i| math::sin((i * 37 % 101) as f32)).collect();
            let d_pooled: Vec<f64> = (0..to.0 * to.1).map(|i| math::cos((i * 53 % 97) as f64)).collect();
            let (mut pooled, mut scratch) = (vec![0.0; to.0 * to.1], Vec::new());
            pooling.forward(1, &image, &mut pooled, &mut scratch);
            let mut wide = vec![0.0f32; to.1 * w];
            pooling.spread(1, &d_pooled, &mut wide);
            let forward: f64 = pooled.iter().zip(&d_pooled).map(|(a, b)| a * b).sum();
            let mut backward = 0.0;
            for y in 0..h {
                for k in pooling.y.covering[y].clone() {
                    for x in 0..w {
                        backward += f64::from(wide[k * w + x]) * f64::from(image[y * w + x]);
                    }
                }
            }
            assert!((forward - backward).abs() < 1e-5, "{forward} against {backward}");
        }
    }
}
