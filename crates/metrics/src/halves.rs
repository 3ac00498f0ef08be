//! Gains of an image that are fitted on its other half: exposure is corrected, and no pixel is scored with
//! a gain that was fitted to it.
//!
//! A camera that exposes and balances every view separately gives a held-out view a gain that no other view
//! contains. The gain per channel that fits the left half best (`g = Σ x y / Σ x²`) is applied to the right
//! half, and the other way round; both halves are scored as one image.

use use3d_capture::Image;
use use3d_numerics::sums;

use crate::error::{MetricError, comparable, same_size};
use crate::warp::Mask;

/// Multiplies each half of `x` by the gains per channel that bring the other half nearest to `y`, fitted on
/// its pixels that count. A half that is black, or in which no pixel counts, has a gain of 1.
///
/// # Errors
/// The images have different sizes, are narrower than two pixels or have values that are not finite, or the
/// mask has another size.
pub fn fitted_on_other_half(x: &Image, y: &Image, mask: Option<&Mask>) -> Result<Image, MetricError> {
    comparable("a gain per half", x, y, 2)?;
    if let Some(mask) = mask {
        same_size("the mask", x, mask)?;
    }
    let (width, middle) = (x.width(), x.width() / 2);
    let mut out = x.clone();
    for c in 0..3 {
        let (a, b) = (x.plane(c), y.plane(c));
        let gain = |right: bool| {
            let [xy, xx] = sums::sums::<2>(a.len(), |i, t| {
                let counts = mask.is_none_or(|m| m.data()[i] != 0);
                if counts && (i % width >= middle) == right {
                    let (a, b) = (f64::from(a[i]), f64::from(b[i]));
                    t[0] += a * b;
                    t[1] += a * a;
                }
            });
            if xx > 0.0 { (xy / xx) as f32 } else { 1.0 }
        };
        let [left, right] = [gain(false), gain(true)];
        for (i, v) in out.plane_mut(c).iter_mut().enumerate() {
            *v *= if i % width < middle { right } else { left };
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> Image {
        let mut image = Image::new(10, 6);
        for y in 0..6 {
            for x in 0..10 {
                image.set_pixel(x, y, [0.1 + 0.05 * x as f32, 0.3 + 0.04 * y as f32, 0.2]);
            }
        }
        image
    }

    #[test]
    fn exposure_and_balance_are_forgiven_and_what_is_wrong_in_one_half_is_not() {
        let truth = ramp();
        let mut dark = truth.clone();
        for (c, gain) in [0.5, 0.8, 1.3].into_iter().enumerate() {
            dark.plane_mut(c).iter_mut().for_each(|v| *v *= gain);
        }
        let fitted = fitted_on_other_half(&dark, &truth, None).unwrap();
        for (a, b) in fitted.data().iter().zip(truth.data()) {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
        // Only the left half is darker; a gain fitted on itself would hide it.
        let mut half = truth.clone();
        for y in 0..6 {
            for x in 0..5 {
                half.set_pixel(x, y, truth.pixel(x, y).map(|v| 0.5 * v));
            }
        }
        let fitted = fitted_on_other_half(&half, &truth, None).unwrap();
        assert!((fitted.pixel(1, 1)[2] - 0.1).abs() < 1e-6 && (fitted.pixel(8, 1)[2] - 0.4).abs() < 1e-6);
        // Pixels that do not count have no effect.
        let mut mask = Mask::filled(10, 6, 1);
        (0..6).for_each(|y| (0..5).for_each(|x| mask.set_pixel(x, y, [0])));
        let fitted = fitted_on_other_half(&half, &truth, Some(&mask)).unwrap();
        assert!((fitted.pixel(8, 1)[2] - 0.2).abs() < 1e-6);
    }

    #[test]
    fn wrong_sizes_are_refused_and_black_is_left_alone() {
        let image = ramp();
        assert!(fitted_on_other_half(&image, &Image::new(3, 3), None).is_err());
        assert!(fitted_on_other_half(&image, &image, Some(&Mask::new(3, 3))).is_err());
        let black = Image::new(10, 6);
        assert_eq!(fitted_on_other_half(&black, &image, None).unwrap(), black);
    }
}
