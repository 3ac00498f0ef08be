//! Peak signal-to-noise ratio, plain and after fitting the exposure.
//!
//! `PSNR = -10 log₁₀ mean (x - y)²` over the pixels that count and all channels, values clipped to
//! `[0, 1]`, range 1. Equal images have no finite PSNR: this is an error ([`MetricError::Equal`]), never a
//! large number. [`decibels`] is the only function that converts an error to a PSNR, in training too.
//!
//! Scenes with unknown absolute brightness (a clear image seen through unknown water) are compared after
//! the gain that fits best in the least-squares sense: `g = Σ x y / Σ x²`, one for all channels or one per
//! channel.

use use3d_capture::Image;
use use3d_numerics::math;
use use3d_numerics::sums;

use crate::error::{MetricError, comparable, same_size};
use crate::mask::counted;
use crate::warp::Mask;

/// The number of gains that are fitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExposureFit {
    /// One gain for the whole image: exposure.
    Global,
    /// One gain per channel: exposure and white balance.
    PerChannel,
}

/// PSNR from which a difference is hard to see, and below which pictures are not recognised, dB.
pub const LIKENESS: [f64; 2] = [30.0, 22.0];

/// The mean PSNR of pictures of held-out views in the words of a diver; `on` says which pixels were compared.
pub fn likeness_in_words(psnr: f64, on: &str) -> String {
    let word = match psnr {
        good if good >= LIKENESS[0] => "like the photographs",
        middling if middling >= LIKENESS[1] => "recognisable, details are missing",
        _ => "not like the photographs",
    };
    format!(
        "likeness to the photographs that were kept back: {psnr:.1} dB{on} (PSNR; from {} on, a difference is hard to \
         see): {word}",
        LIKENESS[0]
    )
}

/// PSNR in dB over the pixels of the mask (all pixels without a mask).
///
/// # Errors
/// The images have different sizes, no pixels or values that are not finite, or the mask has another size
/// or no pixel; [`MetricError::Equal`] for images without a difference.
pub fn psnr(x: &Image, y: &Image, mask: Option<&Mask>) -> Result<f64, MetricError> {
    comparable("PSNR", x, y, 1)?;
    let count = match mask {
        None => x.pixels(),
        Some(mask) => {
            same_size("the mask", x, mask)?;
            counted(mask)
        }
    };
    if count == 0 {
        return Err(MetricError::NothingCounts);
    }
    decibels(square_error(x, y, [1.0; 3], mask) / (3 * count) as f64)
}

/// `Σ (clip(g x) - clip(y))²` over the pixels of the mask.
fn square_error(x: &Image, y: &Image, gain: [f64; 3], mask: Option<&Mask>) -> f64 {
    let clip = |v: f64| v.clamp(0.0, 1.0);
    (0..3)
        .map(|c| {
            let (a, b) = (x.plane(c), y.plane(c));
            sums::sum(a.len(), |i| {
                if mask.is_some_and(|m| m.data()[i] == 0) {
                    return 0.0;
                }
                let d = clip(gain[c] * f64::from(a[i])) - clip(f64::from(b[i]));
                d * d
            })
        })
        .sum()
}

/// The PSNR of a mean square error of values in `[0, 1]`, dB.
///
/// # Errors
/// [`MetricError::Equal`] if the error is zero or not finite.
pub fn decibels(mean_square: f64) -> Result<f64, MetricError> {
    if mean_square > 0.0 && mean_square.is_finite() {
        Ok(-10.0 * math::log10(mean_square))
    } else {
        Err(MetricError::Equal)
    }
}

/// The gains g that minimise `Σ (g x - y)²`; 1 where x is black.
///
/// # Errors
/// The images have different sizes, no pixels or values that are not finite.
pub fn exposure_gain(x: &Image, y: &Image, fit: ExposureFit) -> Result<[f64; 3], MetricError> {
    comparable("PSNR", x, y, 1)?;
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

/// PSNR of `gain · x` against `y` after [`exposure_gain`], and the gains.
///
/// # Errors
/// See [`psnr`].
pub fn psnr_exposure_fitted(x: &Image, y: &Image, fit: ExposureFit) -> Result<(f64, [f64; 3]), MetricError> {
    let gain = exposure_gain(x, y, fit)?;
    Ok((decibels(square_error(x, y, gain, None) / (3 * x.pixels()) as f64)?, gain))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_known_error_and_a_known_gain() {
        let x = Image::filled(40, 30, 0.5);
        let y = Image::filled(40, 30, 0.4);
        assert!((psnr(&x, &y, None).unwrap() - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&x, &x, None), Err(MetricError::Equal));
        // 0.8 x equals y to the last bit.
        assert_eq!(psnr_exposure_fitted(&x, &y, ExposureFit::Global), Err(MetricError::Equal));
        let mut tinted = y;
        tinted.plane_mut(2)[0] = 0.41;
        let (fitted, gain) = psnr_exposure_fitted(&x, &tinted, ExposureFit::Global).unwrap();
        assert!(fitted > 60.0 && (gain[0] - 0.8).abs() < 1e-4);
        tinted.plane_mut(2).fill(0.25);
        let gain = exposure_gain(&x, &tinted, ExposureFit::PerChannel).unwrap();
        assert!((gain[0] - 0.8).abs() < 1e-6 && (gain[2] - 0.5).abs() < 1e-6);
        assert_eq!(exposure_gain(&Image::new(2, 2), &x, ExposureFit::Global).ok(), None);
        assert_eq!(exposure_gain(&Image::new(40, 30), &x, ExposureFit::Global).unwrap(), [1.0; 3]);
        // Values beyond the display range are clipped.
        assert_eq!(psnr(&Image::filled(3, 3, 1.7), &Image::filled(3, 3, 1.0), None), Err(MetricError::Equal));
    }

    #[test]
    fn what_is_masked_neither_adds_an_error_nor_hides_one() {
        let x = Image::filled(8, 4, 0.5);
        let mut y = Image::filled(8, 4, 0.4);
        let mut mask = Mask::filled(8, 4, 1);
        for i in 0..16 {
            mask.data_mut()[i] = 0;
            (0..3).for_each(|c| y.plane_mut(c)[i] = 0.9);
        }
        assert!((psnr(&x, &y, Some(&mask)).unwrap() - 20.0).abs() < 1e-5);
        assert!(psnr(&x, &y, None).unwrap() < 12.0);
        assert_eq!(psnr(&x, &y, Some(&Mask::new(8, 4))), Err(MetricError::NothingCounts));
        assert!(psnr(&x, &y, Some(&Mask::new(4, 8))).is_err());
        assert_eq!(decibels(f64::NAN), Err(MetricError::Equal));
    }
}
