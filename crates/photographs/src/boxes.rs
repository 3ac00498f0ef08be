//! Means over square windows, and the guided filter that is made of them.
//!
//! ```text
//! mean_r(x)(p) = Σ x(q) / count over the pixels q of the image with |q − p| ≤ r along both axes
//! ```
//!
//! Windows end at the edge of the image. Running sums are in f64, so a window costs the same at any radius.

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

/// The mean over windows of radius `radius` (pixels) of one plane of `width` columns, in place. Rows are
/// summed first, then columns.
pub(crate) fn mean(plane: &mut [f32], width: usize, radius: usize) {
    dispatch!(Level::new(), _simd => mean_of(plane, width, radius));
}

#[inline(always)]
fn mean_of(plane: &mut [f32], width: usize, radius: usize) {
    if radius == 0 || width == 0 || plane.is_empty() {
        return;
    }
    let height = plane.len() / width;
    // Sums of eight rows at once do not wait for each other.
    let mut rows = plane.chunks_exact_mut(8 * width);
    rows.by_ref().for_each(|rows| along_rows::<8>(rows, width, radius));
    rows.into_remainder().chunks_exact_mut(width).for_each(|row| along_rows::<1>(row, width, radius));
    let source = plane.to_vec();
    let row = |y: usize| &source[y * width..(y + 1) * width];
    let mut sums = vec![0.0f64; width];
    for y in 0..radius.min(height) {
        sums.iter_mut().zip(row(y)).for_each(|(s, v)| *s += f64::from(*v));
    }
    for (y, out) in plane.chunks_exact_mut(width).enumerate() {
        if y + radius < height {
            sums.iter_mut().zip(row(y + radius)).for_each(|(s, v)| *s += f64::from(*v));
        }
        if y > radius {
            sums.iter_mut().zip(row(y - radius - 1)).for_each(|(s, v)| *s -= f64::from(*v));
        }
        let count = (y + radius + 1).min(height) - y.saturating_sub(radius);
        let share = 1.0 / count as f64;
        out.iter_mut().zip(&sums).for_each(|(v, s)| *v = (s * share) as f32);
    }
}

/// Means along `N` rows.
#[inline(always)]
fn along_rows<const N: usize>(rows: &mut [f32], width: usize, radius: usize) {
    // Rows side by side: the values of a column follow each other.
    let mut source = vec![[0.0f32; N]; width];
    for (k, row) in rows.chunks_exact(width).enumerate() {
        source.iter_mut().zip(row).for_each(|(column, v)| column[k] = *v);
    }
    let column = |x: usize| source[x].map(f64::from);
    let mut sums = [0.0f64; N];
    let add = |sums: &mut [f64; N], x: usize| sums.iter_mut().zip(column(x)).for_each(|(s, v)| *s += v);
    (0..radius.min(width)).for_each(|x| add(&mut sums, x));
    for x in 0..width {
        if x + radius < width {
            add(&mut sums, x + radius);
        }
        if x > radius {
            sums.iter_mut().zip(column(x - radius - 1)).for_each(|(s, v)| *s -= v);
        }
        let count = (x + radius + 1).min(width) - x.saturating_sub(radius);
        let share = 1.0 / count as f64;
        (0..N).for_each(|k| rows[k * width + x] = (sums[k] * share) as f32);
    }
}

/// [`mean`] of every plane of `data`.
pub(crate) fn means(data: &mut [f32], width: usize, height: usize, radius: usize) {
    data.par_chunks_mut((width * height).max(1)).for_each(|plane| mean(plane, width, radius));
}

/// The guided filter with a colour guide (K. He, J. Sun and X. Tang, "Guided Image Filtering", IEEE TPAMI
/// 35(6), 2013), with weights: in every window the affine map `q ≈ a · I + b` of least squares
///
/// ```text
/// Σ w (a · I + b − q)² + ε Σ w |a|²
/// ```
///
/// then the means of `a` and `b` over the windows of a pixel, and `a · I + b` there. Where all weights of a
/// window are 0, `a = 0` and `b = 0`. What depends on the guide alone is computed once.
pub(crate) struct Guide<'a> {
    guide: [&'a [f32]; 3],
    weights: &'a [f32],
    size: (usize, usize),
    radius: usize,
    /// Means of `w`, then weighted means of the guide: four planes.
    means: Vec<f32>,
    /// The inverse of the guide's covariance plus `ε`: six planes, as [`PAIRS`].
    inverse: Vec<f32>,
}

/// The entries of a symmetric matrix: of rows and columns (0,0), (0,1), (0,2), (1,1), (1,2), (2,2).
const PAIRS: [(usize, usize); 6] = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];
/// The least weight of a window that has a map.
const LEAST: f32 = 1e-9;

impl<'a> Guide<'a> {
    /// A guide of three planes with one plane of weights, ≥ 0. `radius` in pixels; `epsilon` is `ε`.
    pub(crate) fn new(
        size: (usize, usize),
        guide: [&'a [f32]; 3],
        weights: &'a [f32],
        (radius, epsilon): (usize, f32),
    ) -> Self {
        let n = size.0 * size.1;
        let mut means = vec![0.0f32; 4 * n];
        let mut inverse = vec![0.0f32; 6 * n];
        let all = means.par_chunks_mut(n.max(1)).chain(inverse.par_chunks_mut(n.max(1)));
        all.enumerate().for_each(|(k, plane)| {
            let factor = |p: usize| match k {
                0 => 1.0,
                1..=3 => guide[k - 1][p],
                _ => guide[PAIRS[k - 4].0][p] * guide[PAIRS[k - 4].1][p],
            };
            plane.iter_mut().enumerate().for_each(|(p, v)| *v = weights[p] * factor(p));
            mean(plane, size.0, radius);
        });
        for p in 0..n {
            let weight = f64::from(means[p].max(LEAST));
            let centre: [f64; 3] = std::array::from_fn(|k| f64::from(means[(1 + k) * n + p]) / weight);
            let mut c = [[0.0f64; 3]; 3];
            for (k, (i, j)) in PAIRS.into_iter().enumerate() {
                let v = f64::from(inverse[k * n + p]) / weight - centre[i] * centre[j];
                (c[i][j], c[j][i]) = (v, v);
            }
            (0..3).for_each(|i| c[i][i] = c[i][i].max(0.0) + f64::from(epsilon));
            let c = symmetric_inverse(&c);
            PAIRS.into_iter().enumerate().for_each(|(k, (i, j))| inverse[k * n + p] = c[i][j] as f32);
            (0..3).for_each(|k| means[(1 + k) * n + p] = centre[k] as f32);
        }
        Self { guide, weights, size, radius, means, inverse }
    }

    /// The filter on one plane, in place.
    pub(crate) fn smooth(&self, values: &mut [f32]) {
        dispatch!(Level::new(), _simd => self.smooth_plane(values));
    }

    #[inline(always)]
    fn smooth_plane(&self, values: &mut [f32]) {
        let n = values.len();
        let mut map = vec![0.0f32; 4 * n];
        for (j, plane) in map.chunks_exact_mut(n.max(1)).enumerate() {
            let weighted = |p: usize| self.weights[p] * values[p];
            match j {
                3 => plane.iter_mut().enumerate().for_each(|(p, v)| *v = weighted(p)),
                _ => plane.iter_mut().enumerate().for_each(|(p, v)| *v = weighted(p) * self.guide[j][p]),
            }
            mean_of(plane, self.size.0, self.radius);
        }
        for p in 0..n {
            let fit = self.fit(p, std::array::from_fn(|k| map[k * n + p]));
            (0..4).for_each(|k| map[k * n + p] = fit[k]);
        }
        map.chunks_exact_mut(n.max(1)).for_each(|plane| mean_of(plane, self.size.0, self.radius));
        for (p, value) in values.iter_mut().enumerate() {
            let sum: f32 = (0..3).map(|j| map[j * n + p] * self.guide[j][p]).sum();
            *value = sum + map[3 * n + p];
        }
    }

    /// `a` and `b` of the window of pixel `p`, from the means of `w q I` and `w q`.
    #[inline(always)]
    fn fit(&self, p: usize, moments: [f32; 4]) -> [f32; 4] {
        let n = self.weights.len();
        let weight = self.means[p];
        if weight < LEAST {
            return [0.0; 4];
        }
        let [x, y, z, q] = moments.map(|v| f64::from(v) / f64::from(weight));
        let centre: [f64; 3] = std::array::from_fn(|j| f64::from(self.means[(1 + j) * n + p]));
        let k = [x - q * centre[0], y - q * centre[1], z - q * centre[2]];
        let c: [f64; 6] = std::array::from_fn(|e| f64::from(self.inverse[e * n + p]));
        let a = [
            c[0] * k[0] + c[1] * k[1] + c[2] * k[2],
            c[1] * k[0] + c[3] * k[1] + c[4] * k[2],
            c[2] * k[0] + c[4] * k[1] + c[5] * k[2],
        ];
        let b = q - a[0] * centre[0] - a[1] * centre[1] - a[2] * centre[2];
        [a[0] as f32, a[1] as f32, a[2] as f32, b as f32]
    }
}

/// The inverse of a symmetric positive definite matrix.
pub(crate) fn symmetric_inverse(c: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let cofactor = |i: usize, j: usize| {
        let (a, b) = ((i + 1) % 3, (i + 2) % 3);
        let (d, e) = ((j + 1) % 3, (j + 2) % 3);
        c[a][d] * c[b][e] - c[a][e] * c[b][d]
    };
    let determinant: f64 = (0..3).map(|j| c[0][j] * cofactor(0, j)).sum();
    let scale = 1.0 / determinant;
    std::array::from_fn(|i| std::array::from_fn(|j| cofactor(j, i) * scale))
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::random::{Purpose, Stream};

    fn noise(n: usize, seed: u64) -> Vec<f32> {
        let draw = Stream::new(seed, Purpose::new("boxes"), 0);
        (0..n).map(|i| draw.uniform(i as u64) as f32).collect()
    }

    #[test]
    fn a_window_is_the_mean_of_its_pixels() {
        let (w, h) = (13, 9);
        let source = noise(w * h, 1);
        for radius in [0usize, 1, 3, 8, 40] {
            let mut fast = source.clone();
            mean(&mut fast, w, radius);
            for y in 0..h {
                for x in 0..w {
                    let (mut sum, mut count) = (0.0f64, 0.0);
                    for v in y.saturating_sub(radius)..(y + radius + 1).min(h) {
                        for u in x.saturating_sub(radius)..(x + radius + 1).min(w) {
                            (sum, count) = (sum + f64::from(source[v * w + u]), count + 1.0);
                        }
                    }
                    let slow = sum / count;
                    assert!((f64::from(fast[y * w + x]) - slow).abs() < 1e-6, "{radius} {x} {y}");
                }
            }
        }
    }

    #[test]
    fn an_affine_map_of_the_guide_is_found_and_nothing_stands_where_nothing_weighs() {
        let (w, h) = (24, 20);
        let n = w * h;
        let guide: Vec<Vec<f32>> = (0..3).map(|k| noise(n, 10 + k)).collect();
        let guide = [&guide[0][..], &guide[1], &guide[2]];
        let (a, b) = ([0.9, 0.2, -0.1], 0.05);
        let values: Vec<f32> = (0..n).map(|p| b + (0..3).map(|j| a[j] * guide[j][p]).sum::<f32>()).collect();
        let weights = noise(n, 30);
        let mut found = values.clone();
        Guide::new((w, h), guide, &weights, (4, 1e-9)).smooth(&mut found);
        assert!(found.iter().zip(&values).all(|(f, v)| (f - v).abs() < 1e-3));
        // A strong ridge leaves the mean over windows of windows.
        let mut flat = values.clone();
        let one = vec![1.0; n];
        Guide::new((w, h), guide, &one, (4, 1e6)).smooth(&mut flat);
        let mut twice = values.clone();
        (0..2).for_each(|_| mean(&mut twice, w, 4));
        assert!(flat.iter().zip(&twice).all(|(f, v)| (f - v).abs() < 1e-4));
        let none = vec![0.0; n];
        let mut nothing = values;
        Guide::new((w, h), guide, &none, (4, 1e-3)).smooth(&mut nothing);
        assert!(nothing.iter().all(|v| *v == 0.0));
    }

    #[test]
    fn an_inverse_undoes_its_matrix() {
        let c = [[2.0, 0.3, -0.4], [0.3, 1.5, 0.2], [-0.4, 0.2, 1.1]];
        let inverse = symmetric_inverse(&c);
        for i in 0..3 {
            for j in 0..3 {
                let v: f64 = (0..3).map(|k| c[i][k] * inverse[k][j]).sum();
                assert!((v - if i == j { 1.0 } else { 0.0 }).abs() < 1e-12);
            }
        }
    }
}
