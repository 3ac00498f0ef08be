//! `fusion`: a classical underwater enhancer without weights.
//!
//! It follows the ideas of C. O. Ancuti, C. Ancuti, C. De Vleeschouwer and P. Bekaert, "Color Balance and
//! Fusion for Underwater Image Enhancement", IEEE Transactions on Image Processing 27(1), 2018:
//!
//! 1. white balance, after red (and in turbid water blue) was compensated from green (`white_balance`);
//! 2. two inputs made from it: one brought to a middle brightness by a gamma curve, one sharpened;
//! 3. a weight map for each input, from contrast, saliency and saturation (`weights`), normalised to sum 1
//!    per pixel;
//! 4. the Laplacian pyramids of the inputs blended with the Gaussian pyramids of the weights (`pyramid`),
//!    which leaves no halos where the weights change quickly.
//!
//! Differences from the article: opponent colours instead of CIELab in the saliency map; bounded grey-world
//! gains; a plain unsharp mask; and a final stretch of the range, one curve for all channels, that removes
//! the veil of hazy frames. The proposer is deterministic. Known limits: it has no distances, so far water
//! is treated like near sand.

mod pyramid;
mod weights;
mod white_balance;

use rayon::prelude::*;
use use3d_capture::{Image, Map};
use use3d_numerics::math;
use use3d_numerics::sums::sums;

use super::Proposer;
use crate::error::AtcError;

/// Target of the mean luminance for the first input's gamma curve: bright frames gain contrast, dark ones
/// light.
const MEAN_LUMINANCE: f64 = 0.42;
/// Bounds of the curve's exponent.
const GAMMA: (f64, f64) = (0.7, 1.35);
/// Strength of the second input's sharpening.
const SHARPENING: f32 = 0.8;
/// Added to every weight before normalisation, so that no input is excluded.
const WEIGHT_FLOOR: f32 = 0.1;
/// Shares of the luminance that the final stretch may clip, dark and bright.
const CLIPPED: [f64; 2] = [0.005, 0.005];
/// Largest slope of the final stretch.
const LARGEST_STRETCH: f32 = 1.6;

/// The classical enhancer. It has no parameters.
#[derive(Clone, Copy, Debug, Default)]
pub struct Fusion;

impl Proposer for Fusion {
    fn name(&self) -> &str {
        "fusion"
    }

    /// The version of the formula; it is raised when a constant or a step changes.
    fn digest(&self) -> String {
        "1".into()
    }

    fn propose(&self, image: &Image) -> Result<Image, AtcError> {
        if image.width() == 0 || image.height() == 0 {
            return Err(AtcError::EmptyImage {
                role: "proposer's",
                width: image.width(),
                height: image.height(),
            });
        }
        if !image.data().iter().all(|v| v.is_finite()) {
            return Err(AtcError::Proposer {
                proposer: self.name().into(),
                message: "the image has a value that is not finite".into(),
            });
        }
        Ok(enhance(&with_all(image, |v| v.clamp(0.0, 1.0))))
    }
}

/// A copy of the image with `f` applied to every value.
fn with_all(image: &Image, f: impl Fn(f32) -> f32 + Sync) -> Image {
    let mut out = image.clone();
    out.data_mut().par_iter_mut().with_min_len(4096).for_each(|v| *v = f(*v));
    out
}

fn enhance(image: &Image) -> Image {
    let balanced = white_balance::balance(image);
    let gamma = gamma(&balanced);
    let inputs = [with_all(&balanced, |v| math::powf(v, gamma)), sharpen(&balanced)];
    let mut maps = inputs.each_ref().map(weights::weights);
    normalise(&mut maps);

    let levels = pyramid::levels(image.width(), image.height());
    let mut sum: Vec<Image> = Vec::new();
    for (input, map) in inputs.into_iter().zip(maps) {
        let input = pyramid::gaussian(input, levels);
        if sum.is_empty() {
            sum = input.iter().map(|l| Image::new(l.width(), l.height())).collect();
        }
        pyramid::add_laplacian(&mut sum, &input, &pyramid::gaussian(map, levels));
    }
    stretch(&pyramid::collapse(sum))
}

/// The exponent that brings the mean luminance to [`MEAN_LUMINANCE`], bounded.
fn gamma(image: &Image) -> f32 {
    let [r, g, b] = image.planes();
    let [sum] = sums::<1>(image.pixels(), |p, t| {
        t[0] += f64::from(0.299 * r[p] + 0.587 * g[p] + 0.114 * b[p]);
    });
    let mean = (sum / image.pixels() as f64).clamp(1e-3, 0.95);
    (math::ln(MEAN_LUMINANCE) / math::ln(mean)).clamp(GAMMA.0, GAMMA.1) as f32
}

fn sharpen(image: &Image) -> Image {
    let soft = pyramid::expand(&pyramid::reduce(&pyramid::blur(image)), image.width(), image.height());
    let mut out = image.clone();
    for (v, s) in out.data_mut().iter_mut().zip(soft.data()) {
        *v = (*v + SHARPENING * (*v - s)).clamp(0.0, 1.0);
    }
    out
}

fn normalise(maps: &mut [Map; 2]) {
    let [one, two] = maps;
    for (a, b) in one.data_mut().iter_mut().zip(two.data_mut()) {
        let total = *a + *b + 2.0 * WEIGHT_FLOOR;
        *a = (*a + WEIGHT_FLOOR) / total;
        *b = (*b + WEIGHT_FLOOR) / total;
    }
}

/// Applies one straight line to all channels, from the luminance's dark and bright quantiles to 0 and 1,
/// with a bounded slope.
fn stretch(image: &Image) -> Image {
    let [r, g, b] = image.planes();
    let mut light: Vec<f32> =
        (0..image.pixels()).map(|p| 0.299 * r[p] + 0.587 * g[p] + 0.114 * b[p]).collect();
    light.par_sort_unstable_by(f32::total_cmp);
    let last = (light.len() - 1) as f64;
    let low = light[(CLIPPED[0] * last) as usize].max(0.0);
    let high = light[((1.0 - CLIPPED[1]) * last).ceil() as usize].min(1.0);
    let slope = (1.0 / (high - low).max(1e-3)).clamp(1.0, LARGEST_STRETCH);
    // The dark end moves to 0 only as far as the bounded slope brings the bright end to 1.
    let offset = (1.0 - slope * high).clamp(-slope * low, 0.0);
    with_all(image, |v| (slope * v + offset).clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn murky(width: usize, height: usize) -> Image {
        let mut image = Image::new(width, height);
        for y in 0..height {
            for x in 0..width {
                let v = 0.5 + 0.2 * math::sin((x * 7 + y * 3) as f32 * 0.1);
                image.set_pixel(x, y, [0.2 * v, 0.6 * v + 0.05, 0.7 * v + 0.1]);
            }
        }
        image
    }

    #[test]
    fn it_reduces_the_cast_raises_the_contrast_and_stays_in_range() {
        let image = murky(120, 80);
        let out = Fusion.propose(&image).unwrap();
        assert!(out.data().iter().all(|v| (0.0..=1.0).contains(v)));
        let mean = |i: &Image, c: usize| i.plane(c).iter().sum::<f32>() / i.pixels() as f32;
        let cast = |i: &Image| mean(i, 2) / mean(i, 0);
        assert!(cast(&out) < 0.6 * cast(&image), "{} against {}", cast(&out), cast(&image));
        let deviation = |i: &Image| {
            let m = mean(i, 1);
            (i.plane(1).iter().map(|v| math::powi(v - m, 2)).sum::<f32>() / i.pixels() as f32).sqrt()
        };
        assert!(deviation(&out) > deviation(&image));
    }

    #[test]
    fn golden_enhanced_photographs() {
        for case in use3d_golden::Part::math("fusion").cases() {
            let (width, height, planes) = case.planes("in.image");
            let out = Fusion.propose(&Image::from_planes(width, height, planes).unwrap()).unwrap();
            let (expected, tolerance) = (case.f64("out.enhanced"), case.tolerance("out.enhanced"));
            for (k, (v, e)) in out.to_interleaved().iter().zip(&expected).enumerate() {
                let apart = (f64::from(*v) - e).abs();
                assert!(apart <= tolerance, "{} {k}: {v} and {e}, {apart:e}", case.name());
            }
        }
    }

    #[test]
    fn any_size_works_and_the_bits_do_not_depend_on_threads() {
        for (w, h) in [(1, 1), (2, 3), (9, 200), (333, 222)] {
            let image = murky(w, h);
            let run = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| Fusion.propose(&image).unwrap())
            };
            let one = run(1);
            assert_eq!((one.width(), one.height()), (w, h));
            assert_eq!(one, run(3));
        }
        assert!(Fusion.propose(&Image::new(0, 0)).is_err());
        assert!(Fusion.propose(&Image::filled(4, 4, f32::NAN)).is_err());
    }
}
