//! CIEDE2000 colour difference (CIE 142-2001; Sharma, Wu & Dalal, *Color Research and Application* 2005),
//! k_L = k_C = k_H = 1.
//!
//! With `C̄` the mean chroma, `G = (1 - √(C̄⁷/(C̄⁷ + 25⁷)))/2`, `a' = (1 + G) a`, chroma and hue of (a', b),
//! their differences and means:
//!
//! ```text
//! ΔE₀₀² = (ΔL'/S_L)² + (ΔC'/S_C)² + (ΔH'/S_H)² + R_T (ΔC'/S_C)(ΔH'/S_H)
//! ```

use use3d_capture::{Image, Map};
use use3d_numerics::math;

use crate::error::MetricError;
use crate::lab::{difference_of_lab, mean};

/// CIEDE2000 of two CIELAB colours.
pub fn delta_e_of_lab(first: [f64; 3], second: [f64; 3]) -> f64 {
    let pow7 = |v: f64| math::powi(v, 7);
    let share = |c: f64| (pow7(c) / (pow7(c) + pow7(25.0))).sqrt();
    let mean_chroma = 0.5 * (math::hypot(first[1], first[2]) + math::hypot(second[1], second[2]));
    let stretch = 1.0 + 0.5 * (1.0 - share(mean_chroma));
    let polar = |[_, a, b]: [f64; 3]| {
        let a = stretch * a;
        let hue = if a == 0.0 && b == 0.0 { 0.0 } else { math::atan2(b, a).to_degrees().rem_euclid(360.0) };
        (math::hypot(a, b), hue)
    };
    let ((c1, h1), (c2, h2)) = (polar(first), polar(second));
    let colored = c1 * c2 != 0.0;
    let turn = match h2 - h1 {
        _ if !colored => 0.0,
        d if d > 180.0 => d - 360.0,
        d if d < -180.0 => d + 360.0,
        d => d,
    };
    let (delta_l, delta_c) = (second[0] - first[0], c2 - c1);
    let delta_h = 2.0 * (c1 * c2).sqrt() * math::sin((0.5 * turn).to_radians());
    let (l, c) = (0.5 * (first[0] + second[0]), 0.5 * (c1 + c2));
    let hue = match h1 + h2 {
        sum if !colored => sum,
        sum if (h1 - h2).abs() <= 180.0 => 0.5 * sum,
        sum if sum < 360.0 => 0.5 * (sum + 360.0),
        sum => 0.5 * (sum - 360.0),
    };
    let cos = |degrees: f64| math::cos(degrees.to_radians());
    let t = 1.0 - 0.17 * cos(hue - 30.0) + 0.24 * cos(2.0 * hue) + 0.32 * cos(3.0 * hue + 6.0)
        - 0.20 * cos(4.0 * hue - 63.0);
    let from_50 = math::powi(l - 50.0, 2);
    let s_l = 1.0 + 0.015 * from_50 / (20.0 + from_50).sqrt();
    let (s_c, s_h) = (1.0 + 0.045 * c, 1.0 + 0.015 * c * t);
    let rotation = 60.0 * math::exp(-math::powi((hue - 275.0) / 25.0, 2));
    let r_t = -2.0 * share(c) * math::sin(rotation.to_radians());
    let (x, y, z) = (delta_l / s_l, delta_c / s_c, delta_h / s_h);
    (x * x + y * y + z * z + r_t * y * z).max(0.0).sqrt()
}

/// CIEDE2000 per pixel of two display-range images (clamped to `[0, 1]`).
///
/// # Errors
/// The images have different sizes, no pixels, or values that are not finite.
pub fn ciede2000(x: &Image, y: &Image) -> Result<Map, MetricError> {
    difference_of_lab("CIEDE2000", x, y, delta_e_of_lab, |_| true)
}

/// The mean of [`ciede2000`] over all pixels.
///
/// # Errors
/// See [`ciede2000`].
pub fn mean_ciede2000(x: &Image, y: &Image) -> Result<f64, MetricError> {
    ciede2000(x, y).map(|map| mean(&map))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pairs from the table of the cited article, chosen for the corner cases of hue and rotation.
    #[test]
    fn published_test_pairs() {
        let pairs: [([f64; 3], [f64; 3], f64); 12] = [
            ([50.0, 2.6772, -79.7751], [50.0, 0.0, -82.7485], 2.0425),
            ([50.0, 3.1571, -77.2803], [50.0, 0.0, -82.7485], 2.8615),
            ([50.0, -1.3802, -84.2814], [50.0, 0.0, -82.7485], 1.0000),
            ([50.0, 0.0, 0.0], [50.0, -1.0, 2.0], 2.3669),
            ([50.0, 2.4900, -0.0010], [50.0, -2.4900, 0.0009], 7.1792),
            ([50.0, 2.4900, -0.0010], [50.0, -2.4900, 0.0011], 7.2195),
            ([50.0, 2.5, 0.0], [50.0, 0.0, -2.5], 4.3065),
            ([50.0, 2.5, 0.0], [73.0, 25.0, -18.0], 27.1492),
            ([50.0, 2.5, 0.0], [61.0, -5.0, 29.0], 22.8977),
            ([60.2574, -34.0099, 36.2677], [60.4626, -34.1751, 39.4387], 1.2644),
            ([22.7233, 20.0904, -46.6940], [23.0331, 14.9730, -42.5619], 2.0373),
            ([2.0776, 0.0795, -1.1350], [0.9033, -0.0636, -0.5514], 0.9082),
        ];
        for (a, b, expected) in pairs {
            let (there, back) = (delta_e_of_lab(a, b), delta_e_of_lab(b, a));
            assert!((there - expected).abs() < 6e-5, "{a:?} {b:?}: {there}, published {expected}");
            assert!((there - back).abs() < 1e-9);
        }
    }

    #[test]
    fn maps_and_means() {
        let x = Image::filled(4, 3, 0.5);
        assert_eq!(mean_ciede2000(&x, &x).unwrap(), 0.0);
        let mut y = x.clone();
        y.set_pixel(1, 1, [0.9, 0.1, 0.1]);
        let map = ciede2000(&x, &y).unwrap();
        assert!(map.pixel(1, 1)[0] > 20.0 && map.pixel(0, 0)[0] == 0.0);
        let mean = mean_ciede2000(&x, &y).unwrap();
        assert!((mean - f64::from(map.pixel(1, 1)[0]) / 12.0).abs() < 1e-9);
        assert!(ciede2000(&x, &Image::new(3, 4)).is_err());
    }
}
