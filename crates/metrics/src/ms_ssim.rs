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
//! One pass computes everything. A task owns one channel of a strip of rows and blurs rows into a ring of
//! eleven. Once eleven rows are available, it computes the means and their derivatives and blurs those
//! back, all within the second-level cache. A level's share of the gradient needs only one factor per
//! channel, which is known when all levels are done. Tasks are cut by rows, never by threads, and their
//! sums are added in order, so the bits do not depend on the number of threads.

use fearless_simd::prelude::*;
use fearless_simd::{Level, Simd, dispatch, f32x16};
use rayon::prelude::*;
use use3d_capture::Image;
use use3d_numerics::math;

/// Level weights of the reconstruction loss (R12).
pub const RECONSTRUCTION_WEIGHTS: [f64; 3] = [0.6, 0.3, 0.1];

/// Level weights of the original paper.
#[cfg(test)]
pub(crate) const STANDARD_WEIGHTS: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];
/// Number of taps of the window.
pub const WINDOW: usize = 11;
const MARGIN: usize = WINDOW - 1;
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
const LANES: usize = 16;
/// Number of rows of the gradient that one task owns.
const STRIP: usize = 96;

/// The normalised Gaussian window, σ = 1.5.
pub fn window() -> [f32; WINDOW] {
    let raw: [f64; WINDOW] =
        std::array::from_fn(|i| math::exp(-math::powi(i as f64 - 5.0, 2) / (2.0 * 1.5 * 1.5)));
    let total: f64 = raw.iter().sum();
    raw.map(|v| (v / total) as f32)
}

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
    x: Vec<Image>,
    y: Vec<Image>,
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
        let weights = level_weights(weights, x.width(), x.height());
        gradient.resize(x.width(), x.height());
        if weights.is_empty() {
            gradient.data_mut().fill(0.0);
            return 1.0;
        }
        let deeper = weights.len() - 1;
        for (pyramid, finest) in [(&mut self.x, x), (&mut self.y, y)] {
            pyramid.resize_with(deeper.max(pyramid.len()), || Image::new(0, 0));
            for l in 0..deeper {
                let (above, below) = pyramid.split_at_mut(l);
                pool(above.last().unwrap_or(finest), offset, &mut below[0]);
            }
        }
        self.gradients.resize_with(deeper.max(self.gradients.len()), || Image::new(0, 0));

        // Forward and unscaled backward passes, level by level.
        let mut means = vec![[0.0f64; 3]; weights.len()];
        for l in 0..weights.len() {
            let (x, y) = if l == 0 { (x, y) } else { (&self.x[l - 1], &self.y[l - 1]) };
            let level = LevelPass { x, y, offset, last: l == deeper };
            let target = if l == 0 { &mut *gradient } else { &mut self.gradients[l - 1] };
            target.resize(x.width(), x.height());
            means[l] = level.run(target);
        }

        let per_channel: [f64; 3] = std::array::from_fn(|c| {
            means.iter().zip(&weights).map(|(m, w)| math::powf(m[c].max(0.0), *w)).product()
        });
        // d value / d mean of a level; a channel with a mean at or below 0 has value 0 and gradient 0.
        let factor = |l: usize, c: usize| -> f32 {
            let (x, mean) = (if l == 0 { x } else { &self.x[l - 1] }, means[l][c]);
            if per_channel[c] <= 0.0 {
                return 0.0;
            }
            let count = ((x.width() - MARGIN) * (x.height() - MARGIN)) as f64;
            (per_channel[c] * weights[l] / (mean * 3.0 * count)) as f32
        };
        for l in (0..weights.len()).rev() {
            let (finer, coarser) = self.gradients.split_at_mut(l);
            let coarser = (l < deeper).then(|| &coarser[0]);
            let target = if l == 0 { &mut *gradient } else { &mut finer[l - 1] };
            combine(target, std::array::from_fn(|c| factor(l, c)), coarser);
        }
        per_channel.iter().sum::<f64>() / 3.0
    }
}

/// Computes 2 × 2 means; an odd side gets one zero (minus the offset) at both ends.
fn pool(fine: &Image, offset: f32, coarse: &mut Image) {
    let (w, h) = (fine.width(), fine.height());
    let (cw, ch) = (w.div_ceil(2), h.div_ceil(2));
    coarse.resize(cw, ch);
    coarse.data_mut().par_chunks_mut(cw).enumerate().for_each(|(line, out)| {
        let (plane, j) = (fine.plane(line / ch), line % ch);
        let row = |k: usize| -> Option<&[f32]> {
            let y = (2 * j + k).checked_sub(h % 2)?;
            plane.get(y * w..(y + 1) * w)
        };
        let rows = [row(0), row(1)];
        if let ([Some(a), Some(b)], 0) = (rows, w % 2) {
            for ((o, a), b) in out.iter_mut().zip(a.chunks_exact(2)).zip(b.chunks_exact(2)) {
                *o = ((a[0] + a[1]) + (b[0] + b[1])) * 0.25;
            }
            return;
        }
        let at = |row: Option<&[f32]>, i: usize, k: usize| -> f32 {
            let x = (2 * i + k).checked_sub(w % 2);
            row.zip(x).and_then(|(row, x)| row.get(x).copied()).unwrap_or(-offset)
        };
        for (i, o) in out.iter_mut().enumerate() {
            *o = ((at(rows[0], i, 0) + at(rows[0], i, 1)) + (at(rows[1], i, 0) + at(rows[1], i, 1))) * 0.25;
        }
    });
}

/// `fine ← factor · fine + poolᵀ(coarse)`, per channel.
fn combine(fine: &mut Image, factors: [f32; 3], coarse: Option<&Image>) {
    let (w, h) = (fine.width(), fine.height());
    fine.data_mut().par_chunks_mut(w).enumerate().for_each(|(line, out)| {
        let (c, j) = (line / h, line % h);
        let factor = factors[c];
        let Some(coarse) = coarse else {
            out.iter_mut().for_each(|o| *o *= factor);
            return;
        };
        let above = coarse.row(c, (j + h % 2) / 2);
        let odd = w % 2;
        if odd == 0 {
            for (o, a) in out.chunks_exact_mut(2).zip(above) {
                let a = 0.25 * a;
                o[0] = factor * o[0] + a;
                o[1] = factor * o[1] + a;
            }
        } else {
            for (i, o) in out.iter_mut().enumerate() {
                *o = factor * *o + 0.25 * above[(i + odd) / 2];
            }
        }
    });
}

/// One level of both images.
struct LevelPass<'a> {
    x: &'a Image,
    y: &'a Image,
    offset: f32,
    /// True if luminance counts.
    last: bool,
}

/// The rows of one task, each padded to whole vectors and the window's reach.
struct Rows {
    stride: usize,
    /// x, y, x² + y², x y of one input row.
    products: [Vec<f32>; 4],
    /// The products of eleven rows, blurred along rows.
    blurred: [Vec<f32>; 4],
    /// Derivatives of one valid row with respect to the mean of x, of x² + y², of x y; 16 zeros in front.
    derivatives: [Vec<f32>; 3],
    /// The derivatives of eleven rows, blurred back along rows.
    spread: [Vec<f32>; 3],
}

impl Rows {
    fn new(width: usize) -> Self {
        let stride = width.next_multiple_of(LANES) + 2 * LANES;
        let rows = |n: usize| vec![0.0; n * stride];
        Self {
            stride,
            products: std::array::from_fn(|_| rows(1)),
            blurred: std::array::from_fn(|_| rows(WINDOW)),
            derivatives: std::array::from_fn(|_| rows(1)),
            spread: std::array::from_fn(|_| rows(WINDOW)),
        }
    }
}

impl LevelPass<'_> {
    /// Returns the means of the three channels; computes the gradient of the *sums*.
    fn run(&self, gradient: &mut Image) -> [f64; 3] {
        let (w, h) = (self.x.width(), self.x.height());
        let level = Level::new();
        let taps = window();
        let strips = h.div_ceil(STRIP);
        let tasks: Vec<&mut [f32]> =
            gradient.data_mut().chunks_mut(w * h).flat_map(|plane| plane.chunks_mut(w * STRIP)).collect();
        let sums: Vec<f64> = tasks
            .into_par_iter()
            .enumerate()
            .map_init(
                || Rows::new(w),
                |rows, (task, out)| {
                    dispatch!(level, simd => self.strip(simd, &taps, task / strips, task % strips, rows, out))
                },
            )
            .collect();
        let count = ((w - MARGIN) * (h - MARGIN)) as f64;
        std::array::from_fn(|c| sums[c * strips..(c + 1) * strips].iter().sum::<f64>() / count)
    }

    /// Computes the gradient rows `strip * STRIP ..` of one channel, and the sum over the valid rows that
    /// start there.
    #[inline(always)]
    fn strip<S: Simd>(
        &self,
        simd: S,
        taps: &[f32; WINDOW],
        channel: usize,
        strip: usize,
        rows: &mut Rows,
        out: &mut [f32],
    ) -> f64 {
        let (w, h) = (self.x.width(), self.x.height());
        let valid = h - MARGIN;
        let first = strip * STRIP;
        let end = (first + STRIP).min(h);
        let start = first.saturating_sub(MARGIN);
        let mut next_input = start;
        let mut sum = 0.0;
        for row in start..end {
            if row < valid {
                while next_input < row + WINDOW {
                    self.blur_row(simd, taps, channel, next_input, rows);
                    next_input += 1;
                }
                let row_sum = self.valid_row(simd, taps, row, rows);
                if row >= first {
                    sum += row_sum;
                }
            }
            if row >= first {
                let line = &mut out[(row - first) * w..][..w];
                self.gradient_row(simd, taps, channel, row, rows, line);
            }
        }
        sum
    }

    /// Computes the products of an input row and blurs them along the row into the ring.
    #[inline(always)]
    fn blur_row<S: Simd>(&self, simd: S, taps: &[f32; WINDOW], channel: usize, row: usize, rows: &mut Rows) {
        let w = self.x.width();
        let (x, y) = (self.x.row(channel, row), self.y.row(channel, row));
        let [px, py, ps, pm] = &mut rows.products;
        px[..w].copy_from_slice(x);
        py[..w].copy_from_slice(y);
        for i in (0..w).step_by(LANES) {
            let (a, b) = (at(simd, px, i), at(simd, py, i));
            a.mul_add(a, b * b).store_slice(&mut ps[i..i + LANES]);
            (a * b).store_slice(&mut pm[i..i + LANES]);
        }
        let slot = (row % WINDOW) * rows.stride;
        for (product, ring) in rows.products.iter().zip(&mut rows.blurred) {
            for i in (0..w - MARGIN).step_by(LANES) {
                let mut sum = at(simd, product, i) * taps[0];
                for k in 1..WINDOW {
                    sum = at(simd, product, i + k).mul_add(taps[k], sum);
                }
                sum.store_slice(&mut ring[slot + i..][..LANES]);
            }
        }
    }

    /// Returns the sum over one valid row; blurs its derivatives back along the row into the ring.
    #[inline(always)]
    fn valid_row<S: Simd>(&self, simd: S, taps: &[f32; WINDOW], row: usize, rows: &mut Rows) -> f64 {
        let w = self.x.width();
        let columns = w - MARGIN;
        let zero = f32x16::splat(simd, 0.0);
        let one = f32x16::splat(simd, 1.0);
        let slots: [usize; WINDOW] = std::array::from_fn(|k| ((row + k) % WINDOW) * rows.stride);
        let mut sum = zero;
        for i in (0..columns).step_by(LANES) {
            let mut m = [zero; 4];
            for k in 0..WINDOW {
                for q in 0..4 {
                    m[q] = at(simd, &rows.blurred[q], slots[k] + i).mul_add(taps[k], m[q]);
                }
            }
            let [mean_x, mean_y, square, product] = m;
            let spread = (square - mean_x * mean_x - mean_y * mean_y).max(zero);
            let twice = (product - mean_x * mean_y) * 2.0;
            let covariance = twice.max(zero - spread).min(spread);
            let inverse = one / (spread + C2);
            let cs = (covariance + C2) * inverse;
            let mut value = cs;
            // d cs / d mean_x, d square, d product.
            let mut d_mean = (mean_x * cs - mean_y) * inverse * 2.0;
            let mut d_square = zero - cs * inverse;
            let mut d_product = inverse * 2.0;
            if self.last {
                let (full_x, full_y) = (mean_x + self.offset, mean_y + self.offset);
                let below = one / (full_x.mul_add(full_x, full_y * full_y) + C1);
                let luminance = (full_x * full_y * 2.0 + C1) * below;
                value = luminance * cs;
                d_mean = d_mean * luminance + cs * (full_y - full_x * luminance) * below * 2.0;
                d_square *= luminance;
                d_product *= luminance;
            }
            if i + LANES > columns {
                let inside = f32x16::from_fn(simd, |lane| if i + lane < columns { 1.0 } else { 0.0 });
                value *= inside;
                d_mean *= inside;
                d_square *= inside;
                d_product *= inside;
            }
            sum += value;
            for (q, d) in [d_mean, d_square, d_product].into_iter().enumerate() {
                d.store_slice(&mut rows.derivatives[q][LANES + i..][..LANES]);
            }
        }
        let slot = (row % WINDOW) * rows.stride;
        for (derivative, ring) in rows.derivatives.iter().zip(&mut rows.spread) {
            for i in (0..w).step_by(LANES) {
                let mut spread = at(simd, derivative, LANES + i) * taps[0];
                for k in 1..WINDOW {
                    spread = at(simd, derivative, LANES + i - k).mul_add(taps[k], spread);
                }
                spread.store_slice(&mut ring[slot + i..][..LANES]);
            }
        }
        f64::from(sum.as_slice().iter().sum::<f32>())
    }

    /// Computes one row of the gradient from the ring of derivatives.
    #[inline(always)]
    fn gradient_row<S: Simd>(
        &self,
        simd: S,
        taps: &[f32; WINDOW],
        channel: usize,
        row: usize,
        rows: &mut Rows,
        out: &mut [f32],
    ) {
        let w = self.x.width();
        let valid = self.x.height() - MARGIN;
        let zero = f32x16::splat(simd, 0.0);
        let (x, y) = (self.x.row(channel, row), self.y.row(channel, row));
        let [px, py, ..] = &mut rows.products;
        px[..w].copy_from_slice(x);
        py[..w].copy_from_slice(y);
        for i in (0..w).step_by(LANES) {
            let mut sums = [zero; 3];
            for k in 0..WINDOW {
                // The valid row that reads this row with tap k.
                let Some(from) = row.checked_sub(k) else { break };
                if from >= valid {
                    continue;
                }
                let slot = (from % WINDOW) * rows.stride;
                for q in 0..3 {
                    sums[q] = at(simd, &rows.spread[q], slot + i).mul_add(taps[k], sums[q]);
                }
            }
            let (a, b) = (at(simd, px, i), at(simd, py, i));
            let gradient = (a * 2.0).mul_add(sums[1], b.mul_add(sums[2], sums[0]));
            match out.get_mut(i..i + LANES) {
                Some(full) => gradient.store_slice(full),
                None => {
                    let rest = w - i;
                    out[i..].copy_from_slice(&gradient.as_slice()[..rest]);
                }
            }
        }
    }
}

#[inline(always)]
fn at<S: Simd>(simd: S, values: &[f32], i: usize) -> f32x16<S> {
    f32x16::from_slice(simd, &values[i..i + LANES])
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
        for (seed, w, h) in [(2, 27, 31), (3, 48, 26), (4, 45, 45)] {
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
