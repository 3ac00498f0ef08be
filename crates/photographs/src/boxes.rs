//! Means over square windows, and the guided filter that is made of them.
//!
//! ```text
//! mean_r(x)(p) = Σ x(q) / count over the pixels q of the image with |q − p| ≤ r along both axes
//! ```
//!
//! Windows end at the edge of the image. Running sums are in f64, so a window costs the same at any radius.

use rayon::prelude::*;

/// The mean over windows of radius `radius` (pixels) of one plane of `width` columns, in place. Rows are
/// summed first, then columns.
pub(crate) fn mean(plane: &mut [f32], width: usize, radius: usize) {
    if radius == 0 || width == 0 || plane.is_empty() {
        return;
    }
    let height = plane.len() / width;
    let mut line = vec![0.0f32; width];
    for row in plane.chunks_exact_mut(width) {
        line.copy_from_slice(row);
        let mut sum: f64 = line.iter().take(radius).map(|v| f64::from(*v)).sum();
        for (x, v) in row.iter_mut().enumerate() {
            if let Some(next) = line.get(x + radius) {
                sum += f64::from(*next);
            }
            if x > radius {
                sum -= f64::from(line[x - radius - 1]);
            }
            let count = (x + radius + 1).min(width) - x.saturating_sub(radius);
            *v = (sum / count as f64) as f32;
        }
    }
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

/// [`mean`] of every plane of `data`.
pub(crate) fn means(data: &mut [f32], width: usize, height: usize, radius: usize) {
    data.par_chunks_mut((width * height).max(1)).for_each(|plane| mean(plane, width, radius));
}

/// An affine map of three values to three values for every pixel: planes `3 i + j` are the slopes `A_ij`,
/// planes `9 + i` are the constants `b_i`.
pub(crate) const AFFINE: usize = 12;

/// The guided filter with a colour guide (K. He, J. Sun and X. Tang, "Guided Image Filtering", IEEE TPAMI
/// 35(6), 2013), with weights: in every window the affine map `q ≈ A I + b` of least squares
///
/// ```text
/// Σ w |A I + b − q|² + ε Σ w |A − A₀|²,     A₀ = prior · identity
/// ```
///
/// and then the means of `A` and `b` over the windows of a pixel. `guide` (I) and `values` (q) have three
/// planes each, `weights` (w) one plane, ≥ 0. Returns the [`AFFINE`] planes. Where all weights of a window
/// are 0, `A = A₀` and `b = 0`.
pub(crate) fn guided(
    (width, height): (usize, usize),
    guide: [&[f32]; 3],
    values: [&[f32]; 3],
    weights: &[f32],
    (radius, epsilon, prior): (usize, f32, f32),
) -> Vec<f32> {
    let n = width * height;
    // Weight, w I, w q, w I I (six), w I q (nine).
    let mut moments = vec![0.0f32; 22 * n];
    moments.par_chunks_mut(n.max(1)).enumerate().for_each(|(k, plane)| {
        let fill = |plane: &mut [f32], f: &(dyn Fn(usize) -> f32 + Sync)| {
            plane.iter_mut().enumerate().for_each(|(p, v)| *v = weights[p] * f(p));
        };
        match k {
            0 => plane.copy_from_slice(weights),
            1..=3 => fill(plane, &|p| guide[k - 1][p]),
            4..=6 => fill(plane, &|p| values[k - 4][p]),
            7..=12 => {
                let (i, j) = PAIRS[k - 7];
                fill(plane, &|p| guide[i][p] * guide[j][p]);
            }
            _ => {
                let (i, j) = ((k - 13) / 3, (k - 13) % 3);
                fill(plane, &|p| values[i][p] * guide[j][p]);
            }
        }
        mean(plane, width, radius);
    });
    let mut out = vec![0.0f32; AFFINE * n];
    let rows = rows_of(&mut out, width, n);
    rows.into_par_iter().enumerate().for_each(|(y, mut planes)| {
        for x in 0..width {
            let at = |k: usize| moments[k * n + y * width + x];
            let map = fit(&at, epsilon, prior);
            planes.iter_mut().zip(map).for_each(|(plane, v)| plane[x] = v);
        }
    });
    means(&mut out, width, height, radius);
    out
}

/// The entries of a symmetric matrix: of rows and columns (0,0), (0,1), (0,2), (1,1), (1,2), (2,2).
const PAIRS: [(usize, usize); 6] = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)];

/// Splits planes into rows: item `y` holds row `y` of every plane.
pub(crate) fn rows_of(data: &mut [f32], width: usize, pixels: usize) -> Vec<Vec<&mut [f32]>> {
    let mut rows: Vec<Vec<&mut [f32]>> = Vec::new();
    for plane in data.chunks_exact_mut(pixels.max(1)) {
        for (y, row) in plane.chunks_exact_mut(width.max(1)).enumerate() {
            match rows.get_mut(y) {
                Some(list) => list.push(row),
                None => rows.push(vec![row]),
            }
        }
    }
    rows
}

/// The affine map of one window from its means: see [`guided`].
fn fit(at: &impl Fn(usize) -> f32, epsilon: f32, prior: f32) -> [f32; AFFINE] {
    let mut map = [0.0; AFFINE];
    (0..3).for_each(|i| map[4 * i] = prior);
    let weight = at(0);
    if weight < 1e-9 {
        return map;
    }
    let w = f64::from(weight);
    let mean_i: [f64; 3] = std::array::from_fn(|j| f64::from(at(1 + j)) / w);
    let mean_q: [f64; 3] = std::array::from_fn(|i| f64::from(at(4 + i)) / w);
    let mut c = [[0.0f64; 3]; 3];
    for (k, (i, j)) in PAIRS.into_iter().enumerate() {
        let v = f64::from(at(7 + k)) / w - mean_i[i] * mean_i[j];
        (c[i][j], c[j][i]) = (v, v);
    }
    (0..3).for_each(|i| c[i][i] = c[i][i].max(0.0) + f64::from(epsilon));
    let inverse = symmetric_inverse(&c);
    for i in 0..3 {
        let k: [f64; 3] = std::array::from_fn(|j| {
            let own = if i == j { f64::from(epsilon * prior) } else { 0.0 };
            f64::from(at(13 + 3 * i + j)) / w - mean_q[i] * mean_i[j] + own
        });
        let row: [f64; 3] = std::array::from_fn(|j| (0..3).map(|l| k[l] * inverse[l][j]).sum());
        (0..3).for_each(|j| map[3 * i + j] = row[j] as f32);
        map[9 + i] = (mean_q[i] - (0..3).map(|j| row[j] * mean_i[j]).sum::<f64>()) as f32;
    }
    map
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
    fn an_affine_map_is_found_and_the_prior_stands_where_nothing_is_known() {
        let (w, h) = (24, 20);
        let n = w * h;
        let guide: Vec<Vec<f32>> = (0..3).map(|k| noise(n, 10 + k)).collect();
        let a = [[0.9, 0.2, -0.1], [0.0, 1.1, 0.3], [-0.2, 0.1, 0.7]];
        let b = [0.05, -0.02, 0.1];
        let values: Vec<Vec<f32>> = (0..3)
            .map(|i| (0..n).map(|p| b[i] + (0..3).map(|j| a[i][j] * guide[j][p]).sum::<f32>()).collect())
            .collect();
        let planes = |v: &'_ [Vec<f32>]| -> [Vec<f32>; 3] { [v[0].clone(), v[1].clone(), v[2].clone()] };
        let (g, q) = (planes(&guide), planes(&values));
        let weights: Vec<f32> = noise(n, 30);
        let map = guided((w, h), [&g[0], &g[1], &g[2]], [&q[0], &q[1], &q[2]], &weights, (4, 1e-9, 1.0));
        for p in 0..n {
            for i in 0..3 {
                for j in 0..3 {
                    assert!((map[(3 * i + j) * n + p] - a[i][j]).abs() < 1e-3);
                }
                assert!((map[(9 + i) * n + p] - b[i]).abs() < 1e-3);
            }
        }
        let none = vec![0.0; n];
        let map = guided((w, h), [&g[0], &g[1], &g[2]], [&q[0], &q[1], &q[2]], &none, (4, 1e-3, 0.5));
        for p in 0..n {
            let at: Vec<f32> = (0..AFFINE).map(|k| map[k * n + p]).collect();
            assert_eq!(at, [0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.0]);
        }
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
