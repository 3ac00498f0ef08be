//! Peak signal-to-noise ratio, plain and after fitting the exposure.
//!
//! `PSNR = -10 log₁₀ mean (x - y)²` over all pixels and channels, values clipped to `[0, 1]`, range 1.
//!
//! Scenes whose absolute brightness is not determined (a clear image seen through unknown water) are compared after the gain
//! that fits best in the least-squares sense: `g = Σ x y / Σ x²`, one for all channels or one per channel.

use use3d_capture::Image;
use use3d_numerics::math;
use use3d_numerics::sums;

use crate::error::{MetricError, finite, large_enough, same_size};

/// How many gains are fitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExposureFit {
    /// One gain for the whole image: exposure.
    Global,
    /// One gain per channel: exposure and white balance.
    PerChannel,
}

fn check(x: &Image, y: &Image) -> Result<(), MetricError> {
    same_size("the second image", x, y)?;
    large_enough("PSNR", x, 1)?;
    finite("the first image", x)?;
    finite("the second image", y)
}

/// Mean square error of values clipped to `[0, 1]`.
///
/// # Errors
/// Images of different sizes, without pixels, or with values that are not finite.
pub fn mean_square_error(x: &Image, y: &Image) -> Result<f64, MetricError> {
    check(x, y)?;
    Ok(square_error(x, y, [1.0; 3]) / (3 * x.pixels()) as f64)
}

/// `Σ (clip(g x) - clip(y))²`.
fn square_error(x: &Image, y: &Image, gain: [f64; 3]) -> f64 {
    let clip = |v: f64| v.clamp(0.0, 1.0);
    (0..3)
        .map(|c| {
            let (a, b) = (x.plane(c), y.plane(c));
            sums::sum(a.len(), |i| {
                let d = clip(gain[c] * f64::from(a[i])) - clip(f64::from(b[i]));
                d * d
            })
        })
        .sum()
}

fn decibels(mean_square: f64) -> f64 {
    -10.0 * math::log10(mean_square)
}

/// PSNR in dB; infinite for equal images.
///
/// # Errors
/// As [`mean_square_error`].
pub fn psnr(x: &Image, y: &Image) -> Result<f64, MetricError> {
    Ok(decibels(mean_square_error(x, y)?))
}

/// The gains g that minimise `Σ (g x - y)²`; 1 where x is black.
///
/// # Errors
/// As [`mean_square_error`].
pub fn exposure_gain(x: &Image, y: &Image, fit: ExposureFit) -> Result<[f64; 3], MetricError> {
    check(x, y)?;
    let mut totals = [[0.0; 2]; 3];
    for (c, total) in totals.iter_mut().enumerate() {
        let (a, b) = (x.plane(c), y.plane(c));
        *total = sums::sums::<2>(a.len(), |i, t| {
            let (a, b) = (f64::from(a[i]), f64::from(b[i]));
            t[0] += a * b;
            t[1] += a * a;
        });
    }
    if fit == ExposureFit::Global {
        let all = [0, 1].map(|k| totals.iter().map(|t| t[k]).sum::<f64>());
        totals = [all; 3];
    }
    Ok(totals.map(|[xy, xx]| if xx > 0.0 { xy / xx } else { 1.0 }))
}

/// PSNR of `gain · x` against `y` after [`exposure_gain`], with the gains.
///
/// # Errors
/// As [`mean_square_error`].
pub fn psnr_exposure_fitted(x: &Image, y: &Image, fit: ExposureFit) -> Result<(f64, [f64; 3]), MetricError> {
    let gain = exposure_gain(x, y, fit)?;
    Ok((decibels(square_error(x, y, gain) / (3 * x.pixels()) as f64), gain))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_known_error_and_a_known_gain() {
        let x = Image::filled(40, 30, 0.5);
        let y = Image::filled(40, 30, 0.4);
        assert!((psnr(&x, &y).unwrap() - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&x, &x).unwrap(), f64::INFINITY);
        let (fitted, gain) = psnr_exposure_fitted(&x, &y, ExposureFit::Global).unwrap();
        assert!(fitted > 120.0 && (gain[0] - 0.8).abs() < 1e-6);
        let mut tinted = y;
        tinted.plane_mut(2).fill(0.25);
        let gain = exposure_gain(&x, &tinted, ExposureFit::PerChannel).unwrap();
        assert!((gain[0] - 0.8).abs() < 1e-6 && (gain[2] - 0.5).abs() < 1e-6);
        assert_eq!(exposure_gain(&Image::new(2, 2), &x, ExposureFit::Global).ok(), None);
        assert_eq!(exposure_gain(&Image::new(40, 30), &x, ExposureFit::Global).unwrap(), [1.0; 3]);
        // Values beyond the display range count as clipped.
        assert_eq!(psnr(&Image::filled(3, 3, 1.7), &Image::filled(3, 3, 1.0)).unwrap(), f64::INFINITY);
    }
}
