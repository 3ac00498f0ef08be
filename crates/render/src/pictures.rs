//! The numbers of a mode as colours for display.

use use3d_capture::{Image, Map};
use use3d_numerics::order::Ascending;

use crate::modes::{Mode, Rendering};

/// A frame for display: colours unchanged, coefficients by their hue, depths by a colour map, opacity in
/// grey.
pub fn picture(mode: Mode, frame: &Rendering) -> Image {
    match frame {
        Rendering::Color(image) if matches!(mode, Mode::Backscatter | Mode::Attenuation) => {
            coefficient_picture(image)
        }
        Rendering::Color(image) => image.clone(),
        Rendering::Scalar(map) if mode == Mode::Depth => depth_picture(map),
        Rendering::Scalar(map) => spread(map),
    }
}

/// A map as a grey image.
pub(crate) fn spread(map: &Map) -> Image {
    let mut image = Image::new(map.width(), map.height());
    for plane in image.data_mut().chunks_exact_mut(map.pixels().max(1)) {
        plane.copy_from_slice(map.data());
    }
    image
}

/// A depth map for display: near is bright, far is deep blue, unknown (0) is black; scaled between the 2 %
/// and 98 % quantiles of its positive values.
pub fn depth_picture(depth: &Map) -> Image {
    let known = Ascending::of(depth.data().iter().copied().filter(|d| d.is_finite() && *d > 0.0));
    let mut image = Image::new(depth.width(), depth.height());
    let (Some(near), Some(far)) = (known.below(0.02), known.below(0.98)) else { return image };
    let far = far.max(near * 1.0001);
    // Inverse depth, because the eye judges distance by it.
    let scale = |d: f32| ((1.0 / d - 1.0 / far) / (1.0 / near - 1.0 / far)).clamp(0.0, 1.0);
    for y in 0..depth.height() {
        for x in 0..depth.width() {
            let [d] = depth.pixel(x, y);
            if d.is_finite() && d > 0.0 {
                image.set_pixel(x, y, ramp(scale(d)));
            }
        }
    }
    image
}

/// A colour map from dark blue over teal and sand to pale yellow; lightness rises evenly.
fn ramp(t: f32) -> [f32; 3] {
    const STOPS: [[f32; 3]; 5] =
        [[0.03, 0.05, 0.22], [0.06, 0.28, 0.47], [0.13, 0.55, 0.55], [0.62, 0.76, 0.45], [0.99, 0.95, 0.70]];
    let place = t.clamp(0.0, 1.0) * (STOPS.len() - 1) as f32;
    let i = (place as usize).min(STOPS.len() - 2);
    let f = place - i as f32;
    std::array::from_fn(|c| STOPS[i][c] * (1.0 - f) + STOPS[i + 1][c] * f)
}

/// Coefficients for display: divided by the largest value of the image, so that the hue shows which channel
/// the water absorbs.
pub fn coefficient_picture(map: &Image) -> Image {
    let most = map.data().iter().copied().filter(|v| v.is_finite()).fold(1e-6f32, f32::max);
    map.map(|v| v / most)
}
