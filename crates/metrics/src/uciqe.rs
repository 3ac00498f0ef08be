//! UCIQE, underwater colour image quality (Yang & Sowmya, IEEE TIP 2015), in the variants that are in
//! public use.
//!
//! `UCIQE = 0.4680 σ_c + 0.2745 con_l + 0.2576 μ_s`: spread of chroma, contrast of lightness, mean
//! saturation. The article does not define the scales, and implementations differ by two orders of
//! magnitude, so a value means nothing without its variant's name:
//!
//! | variant | CIELAB | σ_c | con_l | μ_s |
//! | --- | --- | --- | --- | --- |
//! | `lab8_relvar_hist` | 8 bit / 255 | relative | 1-99 %, histogram over the image's range | C/√(C²+L²) |
//! | `lab8_relvar_stretch` (default) | 8 bit / 255 | relative | 1-99 % on the scale [0, 1] | C/√(C²+L²) |
//! | `lab8_std_sorted` | 8 bit / 255 | standard deviation | sorted percentiles | C/L |
//! | `hsv` | HSV | standard deviation of hue | means of the top and bottom 1 % of V | mean S |
//! | `cielab_unit` | L/100, C/100 | standard deviation | percentiles | C/√(C²+L²) |
//! | `cielab_255` | / 255 | standard deviation | percentiles | C/L |
//! | `cielab_raw` | unchanged | standard deviation | percentiles | C/L |
//!
//! "8 bit" stores `L 255/100`, `a + 128`, `b + 128`; the offset of 128 stays in C = √(a² + b²), as in the
//! first author's public code, which the default follows. "Relative" is `√ mean |1 - (mean C / C)²|`.
//! Images are first quantised to 8 bits.

use rayon::prelude::*;
use use3d_capture::{Image, Image8};
use use3d_numerics::math;
use use3d_numerics::sums;

use crate::error::{MetricError, finite, large_enough};
use crate::lab::{LabTable, quantise};

/// The implementation that is reproduced.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum UciqeVariant {
    /// Relative chroma spread, contrast on the histogram between the image's own extremes.
    Lab8RelvarHist,
    /// Relative chroma spread, contrast on the scale [0, 1]: the variant that reproduces published tables.
    #[default]
    Lab8RelvarStretch,
    /// Standard deviation, sorted percentiles, C/L.
    Lab8StdSorted,
    /// Hue, saturation and value.
    Hsv,
    /// CIELAB divided by 100.
    CielabUnit,
    /// CIELAB divided by 255.
    Cielab255,
    /// CIELAB unchanged.
    CielabRaw,
}

impl UciqeVariant {
    /// Every variant.
    pub const ALL: [Self; 7] = [
        Self::Lab8RelvarHist,
        Self::Lab8RelvarStretch,
        Self::Lab8StdSorted,
        Self::Hsv,
        Self::CielabUnit,
        Self::Cielab255,
        Self::CielabRaw,
    ];

    /// Its name in tables and parameters.
    pub fn name(self) -> &'static str {
        match self {
            Self::Lab8RelvarHist => "lab8_relvar_hist",
            Self::Lab8RelvarStretch => "lab8_relvar_stretch",
            Self::Lab8StdSorted => "lab8_std_sorted",
            Self::Hsv => "hsv",
            Self::CielabUnit => "cielab_unit",
            Self::Cielab255 => "cielab_255",
            Self::CielabRaw => "cielab_raw",
        }
    }
}

/// A score and its three terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Uciqe {
    /// The weighted sum.
    pub score: f64,
    /// Spread of chroma (of hue in the HSV variant), unweighted.
    pub chroma_spread: f64,
    /// Contrast of lightness, unweighted.
    pub contrast: f64,
    /// Mean saturation, unweighted.
    pub saturation: f64,
}

/// UCIQE of a display-range image; it is quantised to 8 bits first.
///
/// # Errors
/// The image has no pixels, or values that are not finite.
pub fn uciqe(image: &Image, variant: UciqeVariant) -> Result<Uciqe, MetricError> {
    finite("the image", image)?;
    uciqe_of_8bit(&image.to_8bit(), variant)
}

/// UCIQE of an 8-bit image.
///
/// # Errors
/// The image has no pixels.
pub fn uciqe_of_8bit(image: &Image8, variant: UciqeVariant) -> Result<Uciqe, MetricError> {
    large_enough("UCIQE", image, 1)?;
    let (chroma_spread, contrast, saturation) = match variant {
        UciqeVariant::Hsv => of_hsv(image),
        _ => of_lab(image, variant),
    };
    let score = 0.4680 * chroma_spread + 0.2745 * contrast + 0.2576 * saturation;
    Ok(Uciqe { score, chroma_spread, contrast, saturation })
}

/// Number of pixels that one task converts.
const BLOCK: usize = 8192;

/// The value of every pixel, computed in blocks.
fn per_pixel<T: Send + Copy + Default>(image: &Image8, f: impl Fn([u8; 3]) -> T + Sync) -> Vec<T> {
    let [r, g, b] = image.planes();
    let mut out = vec![T::default(); image.pixels()];
    out.par_chunks_mut(BLOCK).enumerate().for_each(|(k, chunk)| {
        for (i, o) in chunk.iter_mut().enumerate() {
            let p = k * BLOCK + i;
            *o = f([r[p], g[p], b[p]]);
        }
    });
    out
}

fn of_lab(image: &Image8, variant: UciqeVariant) -> (f64, f64, f64) {
    let table = LabTable::new();
    let length = |a: f64, b: f64| (a * a + b * b).sqrt();
    let (per_l, per_c) = match variant {
        UciqeVariant::CielabUnit => (0.01, 0.01),
        UciqeVariant::Cielab255 => (1.0 / 255.0, 1.0 / 255.0),
        UciqeVariant::CielabRaw => (1.0, 1.0),
        _ => {
            // Stored as bytes: three per pixel instead of sixteen.
            let pixels = per_pixel(image, |rgb| quantise(table.lab(rgb)));
            let scaled = |i: usize| {
                let [l, a, b] = pixels[i].map(|v| f64::from(v) / 255.0);
                [l, length(a, b)]
            };
            return of_levels(pixels.len(), scaled, variant);
        }
    };
    let pixels = per_pixel(image, |rgb| {
        let [l, a, b] = table.lab(rgb);
        [l * per_l, length(a, b) * per_c]
    });
    of_levels(pixels.len(), |i| pixels[i], variant)
}

/// The three terms of `n` pixels, from the lightness and chroma of each in the variant's scale.
fn of_levels(n: usize, pixel: impl Fn(usize) -> [f64; 2] + Sync, variant: UciqeVariant) -> (f64, f64, f64) {
    let count = n as f64;
    let relative = matches!(variant, UciqeVariant::Lab8RelvarHist | UciqeVariant::Lab8RelvarStretch);
    let normalised = relative || variant == UciqeVariant::CielabUnit;
    let [chroma, saturation] = sums::sums::<2>(n, |i, t| {
        let [l, c] = pixel(i);
        t[0] += c;
        let length = if normalised { (c * c + l * l).sqrt() } else { l };
        t[1] += if length > 0.0 { c / length } else { 0.0 };
    });
    let mean = chroma / count;
    let spread = sums::sum(n, |i| {
        let c = pixel(i)[1];
        if relative { (1.0 - math::powi(mean / c.max(1e-12), 2)).abs() } else { math::powi(c - mean, 2) }
    });
    let lightness = (0..n).map(|i| pixel(i)[0]);
    let contrast = match variant {
        UciqeVariant::Lab8RelvarStretch => histogram_contrast(lightness, 0.0, 1.0),
        UciqeVariant::Lab8RelvarHist => {
            let (low, high) = extremes(lightness.clone());
            histogram_contrast(lightness, low, high)
        }
        _ => percentile_contrast(lightness.collect()),
    };
    ((spread / count).sqrt(), contrast, saturation / count)
}

fn extremes(values: impl Iterator<Item = f64>) -> (f64, f64) {
    values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
}

/// The distance between the 1 % and 99 % levels of a histogram of 65536 bins over `[low, high]`, as a share
/// of that range; 1 if the levels coincide.
fn histogram_contrast(values: impl Iterator<Item = f64>, low: f64, high: f64) -> f64 {
    const TOP: usize = 65535;
    if high <= low {
        return 1.0;
    }
    let (mut counts, mut n) = (vec![0u32; TOP + 1], 0u64);
    for v in values {
        counts[(((v - low) / (high - low) * TOP as f64 + 0.5) as usize).min(TOP)] += 1;
        n += 1;
    }
    let mut shares = counts.iter().scan(0u64, |below, &count| {
        *below += u64::from(count);
        Some(*below as f64 / n as f64)
    });
    match (shares.clone().position(|share| share > 0.01), shares.position(|share| share >= 0.99)) {
        (Some(a), Some(b)) if a != b => (b as f64 - a as f64) / TOP as f64,
        _ => 1.0,
    }
}

/// The order statistic at index `⌊0.99 n⌋` minus that at `⌊0.01 n⌋`.
fn percentile_contrast(mut values: Vec<f64>) -> f64 {
    let n = values.len();
    let (_, &mut low, above) = values.select_nth_unstable_by(n / 100, f64::total_cmp);
    // The second order statistic is selected among the values above the first.
    match (n * 99 / 100).checked_sub(n / 100 + 1) {
        Some(rest) if rest < above.len() => *above.select_nth_unstable_by(rest, f64::total_cmp).1 - low,
        _ => 0.0,
    }
}

/// Hue, saturation, value in `[0, 1]`.
fn hsv([r, g, b]: [f64; 3]) -> [f64; 3] {
    let (high, low) = (r.max(g).max(b), r.min(g).min(b));
    let range = high - low;
    if range <= 0.0 {
        return [0.0, 0.0, high];
    }
    let sector = if high == r {
        ((g - b) / range).rem_euclid(6.0)
    } else if high == g {
        (b - r) / range + 2.0
    } else {
        (r - g) / range + 4.0
    };
    [sector / 6.0, range / high, high]
}

fn of_hsv(image: &Image8) -> (f64, f64, f64) {
    let pixels = per_pixel(image, |rgb| hsv(rgb.map(|v| f64::from(v) / 255.0)));
    let n = pixels.len();
    let count = n as f64;
    let [hue, saturation] = sums::sums::<2>(n, |i, t| {
        t[0] += pixels[i][0];
        t[1] += pixels[i][1];
    });
    let mean = hue / count;
    let spread = sums::sum(n, |i| math::powi(pixels[i][0] - mean, 2));
    let mut values: Vec<f64> = pixels.iter().map(|p| p[2]).collect();
    values.sort_unstable_by(f64::total_cmp);
    let tail = (n / 100).max(1);
    let average = |list: &[f64]| list.iter().sum::<f64>() / list.len() as f64;
    let contrast = average(&values[n - tail..]) - average(&values[..tail]);
    ((spread / count).sqrt(), contrast, saturation / count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_round_trip_and_bad_images_are_errors() {
        for variant in UciqeVariant::ALL {
            let named = UciqeVariant::ALL.into_iter().filter(|v| v.name() == variant.name());
            assert_eq!(named.collect::<Vec<_>>(), [variant]);
            assert!(uciqe(&Image::filled(5, 4, 0.3), variant).unwrap().score.is_finite(), "{variant:?}");
            assert!(uciqe(&Image::new(0, 0), variant).is_err());
            assert!(uciqe(&Image::filled(2, 2, f32::NAN), variant).is_err());
        }
        assert_eq!(UciqeVariant::default().name(), "lab8_relvar_stretch");
    }

    #[test]
    fn order_statistics_and_hues() {
        let values: Vec<f64> = (0..250).rev().map(f64::from).collect();
        assert_eq!(percentile_contrast(values), 247.0 - 2.0);
        assert_eq!(percentile_contrast(vec![3.0]), 0.0);
        assert_eq!(hsv([0.5, 0.25, 0.25]), [0.0, 0.5, 0.5]);
        assert!((hsv([0.25, 0.25, 0.5])[0] - 2.0 / 3.0).abs() < 1e-12);
    }
}
