//! Structural similarity (Wang, Bovik, Sheikh & Simoncelli, 2004) over RGB.
//!
//! ```text
//! SSIM = (2 μ_x μ_y + C₁)(2 σ_xy + C₂) / ((μ_x² + μ_y² + C₁)(σ_x² + σ_y² + C₂))
//! ```
//!
//! per pixel and channel, with moments under a Gaussian window of 11 taps, σ 1.5, population variances,
//! *valid* windows only (the map is smaller than the image by 10 per side pair), `C₁ = 0.01²`,
//! `C₂ = 0.03²`. The measure is the mean over map and channels.
//!
//! Both factors are computed as one minus the missing part, `1 - (μ_x - μ_y)²/…` and
//! `1 - (σ_x² + σ_y² - 2 σ_xy)/…`, so that rounding does not bring a value above 1.
//!
//! The window is separable: four products (x, y, x² + y², x y) are blurred along rows into a ring of eleven
//! rows and then down columns. Values are centred on zero first, which does not change second moments and
//! removes most of their cancellation in f32.

use rayon::prelude::*;
use use3d_capture::{Image, Map};

use crate::consistency::{mean_where, whole_windows};
use crate::error::{MetricError, comparable, same_size};
use crate::mask::counted;
use crate::ms_ssim::{WINDOW, window};
use crate::warp::Mask;

const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// The offset that is subtracted from the values.
const CENTER: f32 = 0.5;
/// Number of map rows that one task computes.
const STRIP: usize = 64;

/// SSIM in `[-1, 1]`, over the windows in which all pixels are in the mask (over all windows without a
/// mask).
///
/// # Errors
/// The images have different sizes, a side below 11 pixels or values that are not finite, or the mask has
/// another size or no whole window.
pub fn ssim(x: &Image, y: &Image, mask: Option<&Mask>) -> Result<f64, MetricError> {
    comparable("SSIM", x, y, WINDOW)?;
    if let Some(mask) = mask {
        same_size("the mask", x, mask)?;
        let (map, whole) = (ssim_map(x, y)?, whole_windows(mask));
        return match mean_where(&map, |i| whole[i]).value {
            Some(value) => Ok(value),
            None if counted(mask) == 0 => Err(MetricError::NothingCounts),
            None => Err(MetricError::NoWindow { measure: "SSIM", side: WINDOW }),
        };
    }
    let (columns, rows) = (x.width() + 1 - WINDOW, x.height() + 1 - WINDOW);
    let strips = rows.div_ceil(STRIP);
    let sums: Vec<f64> = (0..3 * strips)
        .into_par_iter()
        .map(|task| {
            let mut sum = 0.0;
            strip(x, y, task / strips, task % strips, |_, values| {
                sum += values.iter().map(|&v| f64::from(v)).sum::<f64>();
            });
            sum
        })
        .collect();
    // Rounding may exceed 1 slightly.
    Ok((sums.iter().sum::<f64>() / (3 * columns * rows) as f64).clamp(-1.0, 1.0))
}

/// SSIM per window, averaged over channels: element (x, y) belongs to the window centred at image pixel (x +
/// 5, y + 5).
///
/// # Errors
/// See [`ssim`].
pub fn ssim_map(x: &Image, y: &Image) -> Result<Map, MetricError> {
    comparable("SSIM", x, y, WINDOW)?;
    let (columns, rows) = (x.width() + 1 - WINDOW, x.height() + 1 - WINDOW);
    let mut map = Map::new(columns, rows);
    map.data_mut().par_chunks_mut(columns * STRIP).enumerate().for_each(|(s, out)| {
        for channel in 0..3 {
            strip(x, y, channel, s, |row, values| {
                for (o, v) in out[row * columns..(row + 1) * columns].iter_mut().zip(values) {
                    *o += v / 3.0;
                }
            });
        }
    });
    Ok(map)
}

/// Computes the map rows of one strip of one channel and passes each, with its index within the strip, to
/// `take`.
fn strip(x: &Image, y: &Image, channel: usize, strip: usize, mut take: impl FnMut(usize, &[f32])) {
    let (width, columns) = (x.width(), x.width() + 1 - WINDOW);
    let rows = x.height() + 1 - WINDOW;
    let taps = window();
    let mut products: [Vec<f32>; 4] = std::array::from_fn(|_| vec![0.0; width]);
    let mut ring: Vec<[Vec<f32>; 4]> =
        (0..WINDOW).map(|_| std::array::from_fn(|_| vec![0.0; columns])).collect();
    let mut moments: [Vec<f32>; 4] = std::array::from_fn(|_| vec![0.0; columns]);
    let mut values = vec![0.0; columns];
    let first = strip * STRIP;
    let mut next = first;
    for row in first..(first + STRIP).min(rows) {
        while next < row + WINDOW {
            let (a, b) = (x.row(channel, next), y.row(channel, next));
            for i in 0..width {
                let (a, b) = (a[i] - CENTER, b[i] - CENTER);
                products[0][i] = a;
                products[1][i] = b;
                products[2][i] = a * a + b * b;
                products[3][i] = a * b;
            }
            for (product, out) in products.iter().zip(&mut ring[next % WINDOW]) {
                blur_along(product, &taps, out);
            }
            next += 1;
        }
        for (q, moment) in moments.iter_mut().enumerate() {
            moment.fill(0.0);
            for (k, tap) in taps.iter().enumerate() {
                let blurred = &ring[(row + k) % WINDOW][q];
                for (m, v) in moment.iter_mut().zip(blurred) {
                    *m += tap * v;
                }
            }
        }
        let [mean_x, mean_y, square, product] = &moments;
        for i in 0..columns {
            let (mx, my) = (mean_x[i], mean_y[i]);
            let spread = (square[i] - mx * mx - my * my).max(0.0);
            let covariance = 2.0 * (product[i] - mx * my);
            let (fx, fy) = (mx + CENTER, my + CENTER);
            let luminance = 1.0 - (mx - my) * (mx - my) / (fx * fx + fy * fy + C1);
            values[i] = luminance * (1.0 - (spread - covariance).max(0.0) / (spread + C2));
        }
        take(row - first, &values);
    }
}

/// Valid correlation of a row with the window.
#[inline]
fn blur_along(row: &[f32], taps: &[f32; WINDOW], out: &mut [f32]) {
    let n = out.len();
    for (o, v) in out.iter_mut().zip(row) {
        *o = taps[0] * v;
    }
    for (k, tap) in taps.iter().enumerate().skip(1) {
        for (o, v) in out.iter_mut().zip(&row[k..k + n]) {
            *o += tap * v;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::math;
    use use3d_numerics::random::{Purpose, Stream};

    /// The definition, in f64, window by window.
    fn plain(x: &Image, y: &Image) -> f64 {
        let taps: Vec<f64> = (0..11).map(|i| math::exp(-math::powi(i as f64 - 5.0, 2) / 4.5)).collect();
        let total: f64 = taps.iter().sum();
        let mut sum = 0.0;
        let (columns, rows) = (x.width() - 10, x.height() - 10);
        for c in 0..3 {
            for j in 0..rows {
                for i in 0..columns {
                    let mut m = [0.0; 5];
                    for v in 0..11 {
                        for u in 0..11 {
                            let w = taps[u] * taps[v] / (total * total);
                            let a = f64::from(x.row(c, j + v)[i + u]);
                            let b = f64::from(y.row(c, j + v)[i + u]);
                            for (m, value) in m.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                                *m += w * value;
                            }
                        }
                    }
                    let [a, b, aa, bb, ab] = m;
                    let (va, vb, cov) = (aa - a * a, bb - b * b, ab - a * b);
                    sum += (2.0 * a * b + 1e-4) * (2.0 * cov + 9e-4)
                        / ((a * a + b * b + 1e-4) * (va + vb + 9e-4));
                }
            }
        }
        sum / (3 * columns * rows) as f64
    }

    fn noise(width: usize, height: usize, seed: u64) -> Image {
        let stream = Stream::new(seed, Purpose::new("ssim test"), 0);
        let data = (0..3 * width * height).map(|i| stream.uniform(i as u64) as f32).collect();
        Image::from_planes(width, height, data).unwrap()
    }

    #[test]
    fn the_fast_form_is_the_definition_for_any_number_of_threads() {
        for (width, height) in [(11, 11), (12, 90), (37, 75)] {
            let x = noise(width, height, 1);
            let n = noise(width, height, 2);
            let mut y = x.clone();
            for (v, n) in y.data_mut().iter_mut().zip(n.data()) {
                *v = 0.7 * *v + 0.3 * n;
            }
            let expected = plain(&x, &y);
            let with = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| ssim(&x, &y, None).unwrap())
            };
            let fast = with(1);
            assert!((fast - expected).abs() < 2e-6, "{fast} {expected}");
            assert_eq!(fast, with(3));
            let map = ssim_map(&x, &y).unwrap();
            let mean = map.data().iter().map(|&v| f64::from(v)).sum::<f64>() / map.pixels() as f64;
            assert!((mean - fast).abs() < 1e-6);
            assert!((ssim(&x, &x, None).unwrap() - 1.0).abs() < 1e-6);
        }
        assert!(matches!(
            ssim(&noise(10, 40, 1), &noise(10, 40, 2), None),
            Err(MetricError::TooSmall { .. })
        ));
    }

    #[test]
    fn no_value_exceeds_one_and_masked_windows_do_not_count() {
        // Nearly equal images, for which rounding once gave 1.0000000017.
        for seed in 0..6 {
            let x = noise(64, 48, seed);
            let y = x.map(|v| v + 1e-7);
            let map = ssim_map(&x, &y).unwrap();
            assert!(map.data().iter().all(|v| *v <= 1.0 + f32::EPSILON));
            assert!(ssim(&x, &x, None).unwrap() <= 1.0 && ssim(&x, &y, None).unwrap() <= 1.0);
        }
        let (x, mut y) = (noise(40, 30, 1), noise(40, 30, 1));
        y.data_mut().iter_mut().for_each(|v| *v *= 0.9);
        let inner = ssim(&x, &y, None).unwrap();
        let mut mask = Mask::filled(40, 30, 1);
        for row in 0..30 {
            for column in 0..15 {
                mask.set_pixel(column, row, [0]);
                y.set_pixel(column, row, [0.0, 1.0, 0.0]);
            }
        }
        assert!(ssim(&x, &y, None).unwrap() < 0.8 * inner);
        assert!((ssim(&x, &y, Some(&mask)).unwrap() - inner).abs() < 0.02);
        assert_eq!(ssim(&x, &y, Some(&Mask::new(40, 30))), Err(MetricError::NothingCounts));
        let mut specks = Mask::new(40, 30);
        specks.set_pixel(3, 3, [1]);
        assert!(matches!(ssim(&x, &y, Some(&specks)), Err(MetricError::NoWindow { .. })));
    }
}
