//! The colour of a view around a pixel: the mean under a Gaussian window, and the unevenness of the image
//! there.
//!
//! Two views of one point can be compared only if both average the same piece of surface. A surface piece
//! of radius ρ covers `f ρ / z` pixels at depth z. So the window's standard deviation is `σ = f ρ / z` in
//! every view, with ρ per point such that the farthest view's σ is [`NARROWEST`]. Lens and pixel have
//! already averaged by about [`LENS`]; the window only adds the missing part: `√(σ² − LENS)`. Without this,
//! far views average more of a surface than near ones, contrast falls with distance for a reason that is
//! not water, and attenuation comes out too strong.

use use3d_capture::{Image, Map};
use use3d_numerics::math;

/// Standard deviation of the window of a point's farthest view, lens included, pixels.
pub(crate) const NARROWEST: f64 = 1.6;
/// Standard deviation beyond which a near view is left out, pixels: its window would cover half the image.
pub(crate) const WIDEST: f64 = 12.0;
/// Variance of the averaging by lens and pixel along an axis: a blur of 1:2:1 pixels and the pixel's own
/// box, px².
const LENS: f64 = 0.5 + 1.0 / 12.0;
/// Radius of the window in standard deviations.
const REACH: f64 = 2.5;
/// Values at or beyond these are clipped by the camera, display range.
const CLIPPED: [f32; 2] = [1.5 / 255.0, 253.5 / 255.0];
/// A window with a larger share of clipped pixels is not used.
const CLIPPED_SHARE: f64 = 0.02;

/// The result of a window, per channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Patch {
    /// Mean under the window, display range; NaN where the camera clipped the channel.
    pub(crate) mean: [f64; 3],
    /// Standard deviation under the window.
    pub(crate) spread: [f64; 3],
}

/// Evaluates the window around `(x, y)` with a standard deviation of `sigma` pixels, lens included; `None`
/// if it leaves the image or the mask.
pub(crate) fn patch(image: &Image, mask: Option<&Map>, x: f64, y: f64, sigma: f64) -> Option<Patch> {
    let sigma = (sigma * sigma - LENS).max(0.25).sqrt();
    let radius = REACH * sigma;
    let (w, h) = (image.width() as f64, image.height() as f64);
    if !(x - radius >= 0.0 && y - radius >= 0.0 && x + radius <= w && y + radius <= h) {
        return None;
    }
    let (columns, x0) = window(x, radius, sigma, image.width());
    let (rows, y0) = window(y, radius, sigma, image.height());
    let (mut total, mut first, mut second, mut clipped) = (0.0, [0.0; 3], [0.0; 3], [0.0; 3]);
    for (j, wy) in rows.iter().enumerate() {
        for (i, wx) in columns.iter().enumerate() {
            let weight = wx * wy;
            if mask.is_some_and(|m| m.pixel(x0 + i, y0 + j)[0] < 0.5) {
                return None;
            }
            let pixel = image.pixel(x0 + i, y0 + j);
            total += weight;
            for c in 0..3 {
                let value = f64::from(pixel[c]);
                first[c] += weight * value;
                second[c] += weight * value * value;
                let bad = !(pixel[c] > CLIPPED[0] && pixel[c] < CLIPPED[1]);
                clipped[c] += if bad { weight } else { 0.0 };
            }
        }
    }
    let mean = first.map(|v| v / total);
    Some(Patch {
        spread: std::array::from_fn(|c| (second[c] / total - mean[c] * mean[c]).max(0.0).sqrt()),
        mean: std::array::from_fn(|c| if clipped[c] <= CLIPPED_SHARE * total { mean[c] } else { f64::NAN }),
    })
}

/// The weights of the pixels along one axis whose centres are within `radius`, and the index of the first
/// pixel.
fn window(center: f64, radius: f64, sigma: f64, side: usize) -> (Vec<f64>, usize) {
    let first = (center - radius).floor().max(0.0) as usize;
    let last = ((center + radius).ceil() as usize).min(side);
    let weight = |i: usize| {
        let u = (i as f64 + 0.5 - center) / sigma;
        math::exp(-0.5 * u * u)
    };
    ((first..last).map(weight).collect(), first)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(f: impl Fn(usize, usize) -> [f32; 3]) -> Image {
        let mut image = Image::new(40, 30);
        for y in 0..30 {
            for x in 0..40 {
                image.set_pixel(x, y, f(x, y));
            }
        }
        image
    }

    #[test]
    fn means_are_those_of_the_surface_and_clipped_channels_are_none() {
        // The mean of a ramp is the value at the window's centre, for any window, also between pixels.
        let ramp = image(|x, _| [0.1 + 0.015 * (x as f32 + 0.5), 0.5, 1.0]);
        let p = patch(&ramp, None, 20.3, 15.0, 3.0).unwrap();
        assert!((p.mean[0] - (0.1 + 0.015 * 20.3)).abs() < 1e-3, "{p:?}");
        assert!((p.mean[1] - 0.5).abs() < 1e-6 && p.spread[1] < 1e-3);
        assert!(p.mean[2].is_nan(), "white is clipped");
        assert!(p.spread[0] > 0.015, "a ramp is uneven");
    }

    #[test]
    fn windows_outside_the_image_or_the_mask_are_refused() {
        let grey = image(|_, _| [0.5; 3]);
        for (x, y) in [(1.0, 15.0), (39.5, 15.0), (20.0, 29.0), (f64::NAN, 3.0), (-5.0, 3.0)] {
            assert_eq!(patch(&grey, None, x, y, 3.0), None);
        }
        let mut mask = Map::filled(40, 30, 1.0);
        mask.set_pixel(21, 15, [0.0]);
        assert_eq!(patch(&grey, Some(&mask), 20.0, 15.0, 3.0), None);
        assert!(patch(&grey, Some(&mask), 8.0, 15.0, 2.0).is_some());
    }
}
