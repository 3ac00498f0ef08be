//! sRGB to CIELAB under D65.
//!
//! `Y = M g⁻¹(rgb)`, `f(t) = t^{1/3}` above `(6/29)³` and `t/(3 (6/29)²) + 4/29` below, `L = 116 f(Y/Y_n) -
//! 16`, `a = 500 (f(X/X_n) - f(Y/Y_n))`, `b = 200 (f(Y/Y_n) - f(Z/Z_n))`; g is sRGB's transfer function (IEC
//! 61966-2-1). The white point is the matrix's own image of white, so that greys have exactly no chroma.

use std::sync::LazyLock;

use rayon::prelude::*;
use use3d_capture::{Image, Map};
use use3d_numerics::math;

use crate::error::{MetricError, comparable};

/// Linear sRGB to XYZ.
const TO_XYZ: [[f64; 3]; 3] =
    [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]];
/// D65: the sums of the rows above.
const WHITE: [f64; 3] = [0.950456, 1.0, 1.088754];

/// The smallest argument of the cube root, (6/29)³.
const KNEE: f64 = 216.0 / 24389.0;

/// Pixels of one task.
const PIXELS: usize = 1024;

/// The largest display value that sRGB's curve decodes by a line.
const LINE: f64 = 0.04045;

fn decode(v: f64) -> f64 {
    if v <= LINE { v / 12.92 } else { math::powf((v + 0.055) / 1.055, 2.4) }
}

/// One step of Halley's iteration towards the cube root of `t`, from `y`.
#[inline]
fn halley(y: f64, t: f64) -> f64 {
    let cube = y * y * y;
    y * (cube + 2.0 * t) / (2.0 * cube + t)
}

/// The two curves of a colour, by tables. Powers and cube roots of the library take most of the time of a
/// score; these have the same 13 digits.
struct Curves {
    /// The power of sRGB's curve over each interval as a cubic: both ends have its value and its slope.
    powers: Vec<[f64; 4]>,
    /// Cube roots at the middle of each interval.
    roots: Vec<f64>,
}

static CURVES: LazyLock<Curves> = LazyLock::new(Curves::new);

impl Curves {
    /// Number of intervals over `[0, 1]`.
    const INTERVALS: usize = 4096;

    fn new() -> Self {
        let step = 1.0 / Self::INTERVALS as f64;
        let power = |i: usize| math::powf((i as f64 * step + 0.055) / 1.055, 2.4);
        // The slope times the interval's length.
        let slope = |i: usize| step * 2.4 / 1.055 * math::powf((i as f64 * step + 0.055) / 1.055, 1.4);
        let cubic = |i: usize| {
            let (a, b, m, n) = (power(i), power(i + 1), slope(i), slope(i + 1));
            [a, m, 3.0 * (b - a) - 2.0 * m - n, 2.0 * (a - b) + m + n]
        };
        Self {
            powers: (0..=Self::INTERVALS).map(cubic).collect(),
            roots: (0..=Self::INTERVALS).map(|i| math::cbrt((i as f64 + 0.5) * step)).collect(),
        }
    }

    /// [`decode`] of a value in `[0, 1]`.
    #[inline]
    fn decode(&self, v: f64) -> f64 {
        if v <= LINE {
            return v / 12.92;
        }
        let x = v * Self::INTERVALS as f64;
        let [a, b, c, d] = self.powers[(x as usize).min(Self::INTERVALS)];
        let u = x - (x as usize) as f64;
        a + u * (b + u * (c + u * d))
    }

    /// The cube root of a value from the knee to about 1: two steps of Halley's iteration.
    #[inline]
    fn cube_root(&self, t: f64) -> f64 {
        let near = self.roots[((t * Self::INTERVALS as f64) as usize).min(Self::INTERVALS)];
        halley(halley(near, t), t)
    }
}

fn lab_of_linear(rgb: [f64; 3], cube_root: impl Fn(f64) -> f64) -> [f64; 3] {
    let f = |i: usize| {
        let t = (TO_XYZ[i][0] * rgb[0] + TO_XYZ[i][1] * rgb[1] + TO_XYZ[i][2] * rgb[2]) / WHITE[i];
        if t > KNEE { cube_root(t) } else { (24389.0 / 27.0 * t + 16.0) / 116.0 }
    };
    let (x, y, z) = (f(0), f(1), f(2));
    [116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)]
}

/// CIELAB of display values (clamped to `[0, 1]`): L in `[0, 100]`.
pub fn lab_of_srgb(rgb: [f32; 3]) -> [f64; 3] {
    let curves = &*CURVES;
    lab_of_linear(rgb.map(|v| curves.decode(f64::from(v.clamp(0.0, 1.0)))), |t| curves.cube_root(t))
}

/// Computes a difference of CIELAB colours per pixel of two display-range images (clamped to `[0, 1]`). It is
/// zero at pixels that do not count.
///
/// # Errors
/// The images have different sizes, no pixels, or values that are not finite.
pub(crate) fn difference_of_lab(
    metric: &'static str,
    x: &Image,
    y: &Image,
    difference: impl Fn([f64; 3], [f64; 3]) -> f64 + Sync,
    counts: impl Fn(usize) -> bool + Sync,
) -> Result<Map, MetricError> {
    comparable(metric, x, y, 1)?;
    let mut map = Map::new(x.width(), x.height());
    let planes = [x, y].map(|image| [0, 1, 2].map(|c| image.plane(c)));
    // Not by rows: an image of chosen pixels is a single row.
    map.data_mut().par_chunks_mut(PIXELS).enumerate().for_each(|(part, out)| {
        for (p, out) in (part * PIXELS..).zip(out) {
            if counts(p) {
                let [x, y] = planes.map(|planes| lab_of_srgb(planes.map(|plane| plane[p])));
                *out = difference(x, y) as f32;
            }
        }
    });
    Ok(map)
}

/// The mean over all pixels.
pub(crate) fn mean(map: &Map) -> f64 {
    let n = map.pixels();
    use3d_numerics::sums::sum(n, |i| f64::from(map.data()[i])) / n as f64
}

/// The mean over all pixels of the colour difference of 1976, `√(ΔL² + Δa² + Δb²)`, of two display-range
/// images (clamped to `[0, 1]`). It weighs saturated colours far more than CIEDE2000 does, and is used in
/// older work.
///
/// # Errors
/// The images have different sizes, no pixels, or values that are not finite.
pub fn mean_cie1976(x: &Image, y: &Image) -> Result<f64, MetricError> {
    let distance =
        |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum::<f64>().sqrt();
    difference_of_lab("ΔE of 1976", x, y, distance, |_| true).map(|map| mean(&map))
}

/// Computes CIELAB of 8-bit pixels by tables: the decoded value of each code, and start values of cube
/// roots.
pub(crate) struct LabTable {
    decoded: [f64; 256],
    roots: Vec<f32>,
}

impl LabTable {
    /// Number of intervals of the table of cube roots over `[0, 1]`.
    const INTERVALS: usize = 16384;

    pub(crate) fn new() -> Self {
        let middle = |i: usize| math::cbrt((i as f64 + 0.5) / Self::INTERVALS as f64) as f32;
        Self {
            decoded: std::array::from_fn(|i| decode(i as f64 / 255.0)),
            roots: (0..=Self::INTERVALS).map(middle).collect(),
        }
    }

    /// One step of Halley's iteration from the table. Above the knee the start value is wrong by at most
    /// 0.12 %, the result by 2e-9.
    #[inline]
    fn cube_root(&self, t: f64) -> f64 {
        let index = ((t * Self::INTERVALS as f64) as usize).min(Self::INTERVALS);
        halley(f64::from(self.roots[index]), t)
    }

    #[inline]
    pub(crate) fn lab(&self, rgb: [u8; 3]) -> [f64; 3] {
        lab_of_linear(rgb.map(|v| self.decoded[v as usize]), |t| self.cube_root(t))
    }
}

/// 8-bit CIELAB as image libraries store it: `L 255/100`, `a + 128`, `b + 128`, rounded (to even) and
/// clamped.
#[inline]
pub(crate) fn quantise(lab: [f64; 3]) -> [u8; 3] {
    [lab[0] * 2.55, lab[1] + 128.0, lab[2] + 128.0].map(|v| v.round_ties_even().clamp(0.0, 255.0) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curves_are_the_power_and_the_cube_root() {
        for i in 0..=100_000 {
            let v = f64::from(i) / 100_000.0;
            let (found, exact) = (CURVES.decode(v), decode(v));
            assert!((found - exact).abs() <= 1e-13 * exact, "{v}: {found} {exact}");
            let (found, exact) = (CURVES.cube_root(v), math::cbrt(v));
            assert!(v < KNEE || (found - exact).abs() <= 1e-15, "{v}: {found} {exact}");
        }
    }

    #[test]
    fn known_colours() {
        let close = |rgb: [f32; 3], lab: [f64; 3]| {
            let found = lab_of_srgb(rgb);
            for (a, b) in found.iter().zip(lab) {
                assert!((a - b).abs() < 0.02, "{rgb:?}: {found:?}");
            }
        };
        close([0.0; 3], [0.0; 3]);
        close([1.0; 3], [100.0, 0.0, 0.0]);
        close([1.0, 0.0, 0.0], [53.24, 80.09, 67.20]);
        close([0.0, 0.0, 1.0], [32.30, 79.19, -107.86]);
    }

    #[test]
    fn the_difference_of_1976_is_the_distance() {
        let white = Image::filled(2, 2, 1.0);
        let mut red = Image::new(2, 2);
        red.plane_mut(0).fill(1.0);
        // The colours above differ by L 46.76, a 80.09, b 67.20.
        let expected = [46.76_f64, 80.09, 67.20].map(|v| v * v).iter().sum::<f64>().sqrt();
        assert!((mean_cie1976(&red, &white).unwrap() - expected).abs() < 0.03);
        assert_eq!(mean_cie1976(&red, &red).unwrap(), 0.0);
        assert!(mean_cie1976(&red, &Image::new(1, 2)).is_err());
    }

    #[test]
    fn the_tables_agree_with_the_formula() {
        let table = LabTable::new();
        for i in 0..20_000u32 {
            let bits = i.wrapping_mul(2_654_435_761);
            let rgb = [bits as u8, (bits >> 8) as u8, (bits >> 16) as u8];
            let exact = lab_of_srgb(rgb.map(|v| f32::from(v) / 255.0));
            for (a, b) in table.lab(rgb).iter().zip(exact) {
                // The formula's display value is rounded to f32.
                assert!((a - b).abs() < 5e-5, "{rgb:?}: {a} {b}");
            }
        }
    }
}
