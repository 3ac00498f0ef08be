//! Multi-scale structural similarity (Wang, Simoncelli & Bovik, 2003) with its exact gradient.
//!
//! Windows are 11-tap Gaussians of σ = 1.5, separable, over the *valid* region. For each level and channel
//! the measure is the spatial mean of
//!
//! ```text
//! cs = (2 σ_xy + C₂) / (σ_x² + σ_y² + C₂)
//! at the last level  ssim = cs (2 μ_x μ_y + C₁) / (μ_x² + μ_y² + C₁)
//! ```
//!
//! with population moments, `C₁ = 0.01²`, `C₂ = 0.03²`. Each mean passes through max(·, 0), is raised to
//! the level's weight, and the levels are multiplied; the value is the mean over channels. Between levels
//! the image is reduced to 2 × 2 means; an odd side is padded with one zero at both ends and the divisor
//! stays 4. A level whose smaller side is below 11 is dropped together with all later ones, and the
//! remaining weights are scaled to sum 1. An image with no level left has value 1 and no gradient.
//!
//! Variances of values far from zero cancel in f32, so images may be passed minus an offset (`x - offset`):
//! second moments do not change, and the offset is added back to the means. The remaining cancellation is
//! bounded by `|σ_xy| ≤ (σ_x² + σ_y²) / 2`.
//!
//! `windows.rs` computes the means of a level and their gradients in one pass. A level's share
//! of the gradient needs only one factor per channel, which is known when all levels are done. The images of
//! the finest level are a [`Pair`], so a caller may compute them from others where they are read, and it may
//! finish each row of the gradient while the row is in the cache.

use fearless_simd::{Level, Simd, dispatch};
use rayon::prelude::*;
use use3d_capture::Image;
use use3d_numerics::math;
use use3d_numerics::rows::{LANES, store};

use crate::windows::{MARGIN, Scale};
pub use crate::windows::{Pair, WINDOW, window};

/// Level weights of the reconstruction loss (R12).
pub const RECONSTRUCTION_WEIGHTS: [f64; 3] = [0.6, 0.3, 0.1];

/// Level weights of the original paper.
#[cfg(test)]
pub(crate) const STANDARD_WEIGHTS: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];

/// The weights of the levels that an image of this size has: unchanged if it has all levels, otherwise the
/// remaining ones, scaled to sum 1; empty if its smaller side is below 11.
pub fn level_weights(weights: &[f64], width: usize, height: usize) -> Vec<f64> {
    let mut side = width.min(height);
    let mut kept = Vec::new();
    for &w in weights {
        if side < WINDOW {
            break;
        }
        kept.push(w);
        side = side.div_ceil(2);
    }
    if kept.len() < weights.len() {
        let total: f64 = kept.iter().sum();
        kept.iter_mut().for_each(|w| *w /= total);
    }
    kept
}

/// The measure with its scratch images; reused for images of one size, it allocates nothing again.
#[derive(Clone, Debug, Default)]
pub struct MsSsim {
    /// The levels from 1 on of both images, and every level's gradient before scaling (that of level 0 is
    /// in the caller's image).
    coarse: Vec<[Image; 2]>,
    gradients: Vec<Image>,
}

impl MsSsim {
    /// Computes MS-SSIM and its gradient with respect to `x`. Both images are passed minus `offset`: the
    /// measure is that of `x + offset` and `y + offset`. `gradient` is resized and overwritten.
    pub fn value_and_gradient(
        &mut self,
        x: &Image,
        y: &Image,
        offset: f32,
        weights: &[f64],
        gradient: &mut Image,
    ) -> f64 {
        assert_eq!((x.width(), x.height()), (y.width(), y.height()), "MS-SSIM compares images of one size");
        self.of_pair(&[x, y], offset, weights, gradient, |_, _, _| ()).0
    }

    /// The same for a pair of images; `finish` receives every row of the gradient with its channel and row,
    /// and may change it. Returns the value, and the results of `finish` by channel and row.
    pub fn of_pair<P: Pair, T: Send>(
        &mut self,
        pair: &P,
        offset: f32,
        weights: &[f64],
        gradient: &mut Image,
        finish: impl Fn(usize, usize, &mut [f32]) -> T + Sync,
    ) -> (f64, Vec<T>) {
        let (w, h) = pair.size();
        let weights = level_weights(weights, w, h);
        gradient.resize(w, h);
        if weights.is_empty() {
            gradient.data_mut().fill(0.0);
            return (1.0, combine(gradient, [0.0; 3], None, finish));
        }
        let level = Level::new();
        let deeper = weights.len() - 1;
        self.coarse.resize_with(deeper.max(self.coarse.len()), Default::default);
        self.gradients.resize_with(deeper.max(self.gradients.len()), Image::default);
        let mut means = vec![[0.0f64; 3]; weights.len()];
        let mut windows = vec![((w - MARGIN) * (h - MARGIN)) as f64];
        means[0] = Scale { pair, offset, luminance: deeper == 0 }.means(level, gradient);
        for l in 0..deeper {
            let (finer, coarser) = self.coarse.split_at_mut(l);
            match finer.last() {
                None => pool(level, pair, offset, &mut coarser[0]),
                Some([x, y]) => pool(level, &[x, y], offset, &mut coarser[0]),
            }
            let [x, y] = &coarser[0];
            windows.push(((x.width() - MARGIN) * (x.height() - MARGIN)) as f64);
            let scale = Scale { pair: &[x, y], offset, luminance: l + 1 == deeper };
            means[l + 1] = scale.means(level, &mut self.gradients[l]);
        }

        let per_channel: [f64; 3] = std::array::from_fn(|c| {
            means.iter().zip(&weights).map(|(m, w)| math::powf(m[c].max(0.0), *w)).product()
        });
        // d value / d mean of a level; a channel with a mean at or below 0 has value 0 and gradient 0.
        let factors = |l: usize| -> [f32; 3] {
            std::array::from_fn(|c| match per_channel[c] {
                value if value <= 0.0 => 0.0,
                value => (value * weights[l] / (means[l][c] * 3.0 * windows[l])) as f32,
            })
        };
        for l in (1..=deeper).rev() {
            let (finer, coarser) = self.gradients.split_at_mut(l);
            let coarser = (l < deeper).then(|| &coarser[0]);
            combine(&mut finer[l - 1], factors(l), coarser, |_, _, _| ());
        }
        let coarser = (deeper > 0).then(|| &self.gradients[0]);
        (per_channel.iter().sum::<f64>() / 3.0, combine(gradient, factors(0), coarser, finish))
    }
}

/// Computes 2 × 2 means of both images; an odd side gets one zero (minus the offset) at both ends.
fn pool<P: Pair>(level: Level, pair: &P, offset: f32, coarse: &mut [Image; 2]) {
    let (w, h) = pair.size();
    let (cw, ch) = (w.div_ceil(2), h.div_ceil(2));
    coarse.iter_mut().for_each(|image| image.resize(cw, ch));
    let [x, y] = coarse;
    let fine = || -> [[Vec<f32>; 2]; 2] { Default::default() };
    (x.data_mut().par_chunks_mut(cw).zip(y.data_mut().par_chunks_mut(cw)).enumerate()).for_each_init(
        fine,
        |fine, (line, (x, y))| {
            let (channel, j) = (line / ch, line % ch);
            let rows = [0, 1].map(|k| (2 * j + k).checked_sub(h % 2));
            dispatch!(level, simd => {
                let [above, below] = &mut *fine;
                read_row(simd, pair, channel, rows[0], offset, above);
                read_row(simd, pair, channel, rows[1], offset, below);
                let [[above_x, above_y], [below_x, below_y]] = &*fine;
                halve(above_x, below_x, x);
                halve(above_y, below_y, y);
            });
        },
    );
}

/// Reads a row of both images, after one zero (minus the offset) if the row is odd; zeros if there is no row.
#[inline(always)]
fn read_row<S: Simd, P: Pair>(
    simd: S,
    pair: &P,
    channel: usize,
    row: Option<usize>,
    offset: f32,
    fine: &mut [Vec<f32>; 2],
) {
    let w = pair.size().0;
    let odd = w % 2;
    fine.iter_mut().for_each(|fine| fine.resize(w + odd, 0.0));
    let Some(row) = row else {
        fine.iter_mut().for_each(|fine| fine.fill(-offset));
        return;
    };
    fine.iter_mut().for_each(|fine| fine[..odd].fill(-offset));
    let row = pair.row(channel, row);
    for i in (0..w).step_by(LANES) {
        let [x, y] = P::read(simd, &row, i);
        store(x, &mut fine[0][odd..], i);
        store(y, &mut fine[1][odd..], i);
    }
}

#[inline(always)]
fn halve(above: &[f32], below: &[f32], out: &mut [f32]) {
    for ((o, a), b) in out.iter_mut().zip(above.as_chunks::<2>().0).zip(below.as_chunks::<2>().0) {
        *o = ((a[0] + a[1]) + (b[0] + b[1])) * 0.25;
    }
}

/// `fine ← factor · fine + poolᵀ(coarse)`, per channel, and `finish` for each row.
fn combine<T: Send>(
    fine: &mut Image,
    factors: [f32; 3],
    coarse: Option<&Image>,
    finish: impl Fn(usize, usize, &mut [f32]) -> T + Sync,
) -> Vec<T> {
    let (w, h) = (fine.width(), fine.height());
    let odd = w % 2;
    (fine.data_mut().par_chunks_mut(w.max(1)).enumerate())
        .map(|(line, out)| {
            let (c, j) = (line / h, line % h);
            let factor = factors[c];
            match coarse.map(|coarse| coarse.row(c, (j + h % 2) / 2)) {
                None => out.iter_mut().for_each(|o| *o *= factor),
                Some(above) => {
                    let (first, pairs) = out.split_at_mut(odd);
                    first.iter_mut().for_each(|o| *o = factor * *o + 0.25 * above[0]);
                    for (o, a) in pairs.as_chunks_mut::<2>().0.iter_mut().zip(&above[odd..]) {
                        let a = 0.25 * a;
                        *o = [factor * o[0] + a, factor * o[1] + a];
                    }
                }
            }
            finish(c, j, out)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use use3d_numerics::random::{Purpose, Stream};

    use super::*;

    /// The definition, pixel by pixel in f64.
    fn plain(x: &Image, y: &Image, weights: &[f64]) -> f64 {
        let weights = level_weights(weights, x.width(), x.height());
        let taps = window().map(f64::from);
        let mut total = 0.0;
        for c in 0..3 {
            let plane = |image: &Image| image.plane(c).iter().map(|&v| f64::from(v)).collect::<Vec<_>>();
            let (mut a, mut b, mut w, mut h) = (plane(x), plane(y), x.width(), x.height());
            let mut value = 1.0;
            for (l, weight) in weights.iter().enumerate() {
                let (mut sum, mut count) = (0.0, 0.0);
                for j in 0..h - MARGIN {
                    for i in 0..w - MARGIN {
                        let mut m = [0.0f64; 5];
                        for v in 0..WINDOW {
                            for u in 0..WINDOW {
                                let (p, t) = ((j + v) * w + i + u, taps[v] * taps[u]);
                                for (m, q) in
                                    m.iter_mut().zip([a[p], b[p], a[p] * a[p], b[p] * b[p], a[p] * b[p]])
                                {
                                    *m += t * q;
                                }
                            }
                        }
                        let (c1, c2) = (1e-4, 9e-4);
                        let spread = m[2] - m[0] * m[0] + m[3] - m[1] * m[1];
                        let cs = (2.0 * (m[4] - m[0] * m[1]) + c2) / (spread + c2);
                        let luminance = (2.0 * m[0] * m[1] + c1) / (m[0] * m[0] + m[1] * m[1] + c1);
                        sum += if l + 1 == weights.len() { cs * luminance } else { cs };
                        count += 1.0;
                    }
                }
                value *= math::powf((sum / count).max(0.0), *weight);
                let (cw, ch) = (w.div_ceil(2), h.div_ceil(2));
                let pooled = |p: &[f64]| -> Vec<f64> {
                    let at = |i: usize, j: usize| {
                        let (i, j) = (i.checked_sub(w % 2), j.checked_sub(h % 2));
                        match (i, j) {
                            (Some(i), Some(j)) if i < w && j < h => p[j * w + i],
                            _ => 0.0,
                        }
                    };
                    let of = |i: usize, j: usize| {
                        at(2 * i, 2 * j)
                            + at(2 * i + 1, 2 * j)
                            + at(2 * i, 2 * j + 1)
                            + at(2 * i + 1, 2 * j + 1)
                    };
                    (0..cw * ch).map(|k| of(k % cw, k / cw) / 4.0).collect()
                };
                (a, b) = (pooled(&a), pooled(&b));
                (w, h) = (cw, ch);
            }
            total += value / 3.0;
        }
        total
    }

    fn pair(seed: u64, w: usize, h: usize) -> (Image, Image) {
        let stream = Stream::new(seed, Purpose::new("ms-ssim images"), 0);
        let base: Vec<f32> = (0..3 * w * h)
            .map(|i| {
                let (x, y) = ((i % w) as f32, ((i / w) % h) as f32);
                0.5 + 0.3 * math::sin(x * 0.21 + (i / (w * h)) as f32) * math::cos(y * 0.17)
            })
            .collect();
        let noisy = base.iter().enumerate().map(|(i, v)| v + 0.05 * stream.normal(i as u64) as f32).collect();
        (Image::from_planes(w, h, base).unwrap(), Image::from_planes(w, h, noisy).unwrap())
    }

    #[test]
    fn the_value_is_that_of_the_definition() {
        for (w, h, weights) in [
            (64, 48, &RECONSTRUCTION_WEIGHTS[..]),
            (61, 47, &RECONSTRUCTION_WEIGHTS[..]),
            (11, 130, &RECONSTRUCTION_WEIGHTS[..]),
            (33, 12, &STANDARD_WEIGHTS[..]),
            (175, 99, &RECONSTRUCTION_WEIGHTS[..]),
        ] {
            let (x, y) = pair(1, w, h);
            let exact = plain(&x, &y, weights);
            let (xs, ys) = (x.map(|v| v - 0.5), y.map(|v| v - 0.5));
            let mut gradient = Image::new(1, 1);
            let shifted = MsSsim::default().value_and_gradient(&xs, &ys, 0.5, weights, &mut gradient);
            assert!((shifted - exact).abs() < 1e-5, "{w}x{h}: {shifted} against {exact}");
        }
    }

    #[test]
    fn the_gradient_agrees_with_finite_differences_of_the_definition() {
        for (seed, w, h) in [(2, 27, 31), (3, 48, 26), (4, 45, 45), (5, 171, 24), (6, 24, 205)] {
            let (x, y) = pair(seed, w, h);
            let stream = Stream::new(seed, Purpose::new("ms-ssim probes"), 0);
            let mut gradient = Image::new(1, 1);
            MsSsim::default().value_and_gradient(
                &x.map(|v| v - 0.5),
                &y.map(|v| v - 0.5),
                0.5,
                &RECONSTRUCTION_WEIGHTS,
                &mut gradient,
            );
            let scale = gradient.data().iter().fold(0.0f32, |m, g| m.max(g.abs()));
            for probe in 0..12u64 {
                let at = stream.below(probe, 3 * w * h);
                let moved = |by: f32| {
                    let mut image = x.clone();
                    image.data_mut()[at] += by;
                    plain(&image, &y, &RECONSTRUCTION_WEIGHTS)
                };
                let numeric = (moved(1e-3) - moved(-1e-3)) / 2e-3;
                let error = (numeric - f64::from(gradient.data()[at])).abs();
                assert!(
                    error < 2e-3 * f64::from(scale),
                    "pixel {at}: {numeric} against {}",
                    gradient.data()[at]
                );
            }
        }
    }

    #[test]
    fn the_same_bits_on_any_number_of_threads() {
        let (x, y) = pair(5, 150, 230);
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut gradient = Image::new(1, 1);
                let value =
                    MsSsim::default().value_and_gradient(&x, &y, 0.0, &RECONSTRUCTION_WEIGHTS, &mut gradient);
                (value.to_bits(), gradient)
            })
        };
        let one = run(1);
        assert!(one == run(2) && one == run(7));
    }

    #[test]
    fn unrelated_and_tiny_images_have_no_gradient_and_no_nan() {
        let (x, _) = pair(6, 40, 40);
        // A negative picture has structure of the opposite sign, so the value is 0.
        let y = x.map(|v| 1.0 - v);
        let mut gradient = Image::new(1, 1);
        let mut measure = MsSsim::default();
        assert_eq!(measure.value_and_gradient(&x, &y, 0.0, &RECONSTRUCTION_WEIGHTS, &mut gradient), 0.0);
        assert!(gradient.data().iter().all(|&g| g == 0.0));
        let (x, y) = pair(6, 10, 40);
        assert_eq!(measure.value_and_gradient(&x, &y, 0.0, &RECONSTRUCTION_WEIGHTS, &mut gradient), 1.0);
        assert!(gradient.data().len() == 1200 && gradient.data().iter().all(|&g| g == 0.0));
        let (x, _) = pair(6, 40, 40);
        let centred = x.map(|v| v - 0.5);
        let same = measure.value_and_gradient(&centred, &centred, 0.5, &STANDARD_WEIGHTS, &mut gradient);
        assert!((same - 1.0).abs() < 1e-6);
    }
}
