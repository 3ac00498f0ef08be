//! UCIQE, underwater colour image quality (Yang & Sowmya, IEEE TIP 2015), in the variant
//! `lab8_relvar_stretch`.
//!
//! `UCIQE = 0.4680 σ_c + 0.2745 con_l + 0.2576 μ_s`: spread of chroma, contrast of lightness, mean
//! saturation. The article does not define the scales, and implementations differ by two orders of
//! magnitude, so a value means nothing without its variant's name. This one follows the first author's public
//! code:
//!
//! ```text
//! L, a, b   CIELAB in 8 bits, L 255/100, a + 128, b + 128, divided by 255
//! C         √(a² + b²), with the offset of 128
//! σ_c       √ mean |1 − (mean C / C)²|
//! con_l     distance of the 1 % and the 99 % level of L on the scale [0, 1]
//! μ_s       mean of C / √(C² + L²)
//! ```
//!
//! Images are first quantised to 8 bits.

use rayon::prelude::*;
use use3d_capture::{Image, Image8};
use use3d_numerics::math;
use use3d_numerics::sums;

use crate::error::{MetricError, finite, large_enough};
use crate::lab::{LabTable, quantise};

/// The name of the variant.
pub const UCIQE_VARIANT: &str = "lab8_relvar_stretch";

/// A score and its three terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Uciqe {
    /// The weighted sum.
    pub score: f64,
    /// Spread of chroma, unweighted.
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
pub fn uciqe(image: &Image) -> Result<Uciqe, MetricError> {
    finite("the image", image)?;
    uciqe_of_8bit(&image.to_8bit())
}

/// UCIQE of an 8-bit image.
///
/// # Errors
/// The image has no pixels.
pub fn uciqe_of_8bit(image: &Image8) -> Result<Uciqe, MetricError> {
    large_enough("UCIQE", image, 1)?;
    let (chroma_spread, contrast, saturation) = terms(image);
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

/// Spread of chroma, contrast of lightness and mean saturation.
fn terms(image: &Image8) -> (f64, f64, f64) {
    let table = LabTable::new();
    // Stored as bytes: three per pixel instead of sixteen.
    let pixels = per_pixel(image, |rgb| quantise(table.lab(rgb)));
    let pixel = |i: usize| {
        let [l, a, b] = pixels[i].map(|v| f64::from(v) / 255.0);
        [l, (a * a + b * b).sqrt()]
    };
    let n = pixels.len();
    let count = n as f64;
    let [chroma, saturation] = sums::sums::<2>(n, |i, t| {
        let [l, c] = pixel(i);
        t[0] += c;
        let length = (c * c + l * l).sqrt();
        t[1] += if length > 0.0 { c / length } else { 0.0 };
    });
    let mean = chroma / count;
    let spread = sums::sum(n, |i| (1.0 - math::powi(mean / pixel(i)[1].max(1e-12), 2)).abs());
    let contrast = histogram_contrast((0..n).map(|i| pixel(i)[0]));
    ((spread / count).sqrt(), contrast, saturation / count)
}

/// The distance between the 1 % and 99 % levels of a histogram of 65536 bins over `[0, 1]`; 1 if the levels
/// coincide.
fn histogram_contrast(values: impl Iterator<Item = f64>) -> f64 {
    const TOP: usize = 65535;
    let (mut counts, mut n) = (vec![0u32; TOP + 1], 0u64);
    for v in values {
        counts[((v * TOP as f64 + 0.5) as usize).min(TOP)] += 1;
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_even_image_has_a_score_and_a_bad_one_is_an_error() {
        assert!(uciqe(&Image::filled(5, 4, 0.3)).unwrap().score.is_finite());
        assert!(uciqe(&Image::new(0, 0)).is_err());
        assert!(uciqe(&Image::filled(2, 2, f32::NAN)).is_err());
    }
}
