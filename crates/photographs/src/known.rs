//! The scene's knowledge of a photograph, pixel by pixel.
//!
//! Colours of the scene are only right where the scene shows the surface that the photograph shows. Two
//! signs decide, over regions and never over single pixels (radius `n`, [`REGION`] of the width):
//!
//! ```text
//! f(x) = x − mean_m(x)                                    detail of the luma, m = [`DETAIL`] of the width
//! c    = mean_n(f(P) f(R)) / √((mean_n f(P)² + s²)(mean_n f(R)² + s²))        agreement of structure
//! d    = exp(−(mean_n |P − R| / [`NEAR`])²)                                   nearness of colour
//! k    = mean_n( ramp((max(c, d s² / (mean_n f(P)² + s²)) − 0.25) / 0.35) · ramp(d / 0.4) )
//! ```
//!
//! `P` is the photograph, `R` the stage-1 render, both in display range, `s` the noise of a photograph, and
//! `ramp` clamps to `[0, 1]`. A place without structure is known where its colour is. The result is
//! multiplied by the coverage, the share in `[0, 1]` by which training views saw the surface.

use use3d_capture::{Image, Map};
use use3d_numerics::lanes::exp;

use crate::boxes::mean;
use crate::structure::Structure;

/// Radius of a region, as a share of the width.
pub(crate) const REGION: f64 = 0.03;
/// Radius of the mean that is taken from the luma, as a share of the width.
pub(crate) const DETAIL: f64 = 0.012;
/// Noise of a photograph, display range.
const NOISE: f32 = 4.0 / 255.0;
/// Difference of colours at which two flat places are no longer the same, display range.
const NEAR: f32 = 0.12;
/// Rec. 709 weights of the luma.
const LUMA: [f32; 3] = [0.2126, 0.7152, 0.0722];

/// A share of the width as a radius in pixels, at least `least`.
pub(crate) fn radius(width: usize, share: f64, least: usize) -> usize {
    ((share * width as f64) as usize).max(least)
}

/// The luma of an image.
pub(crate) fn luma(image: &Image) -> Vec<f32> {
    let [r, g, b] = image.planes();
    let mix = |((r, g), b): ((&f32, &f32), &f32)| LUMA[0] * r + LUMA[1] * g + LUMA[2] * b;
    r.iter().zip(g).zip(b).map(mix).collect()
}

/// The scene's knowledge of each pixel of a photograph, `[0, 1]`, smooth. `coverage` has the same size.
pub(crate) fn known(
    photograph: &Image,
    render: &Image,
    structure: &Structure,
    coverage: Option<&Map>,
) -> Vec<f32> {
    let (w, n) = (photograph.width(), photograph.pixels());
    let (region, noise) = (radius(w, REGION, 3), NOISE * NOISE);
    let difference = |i: usize| {
        let apart = |c: usize| (photograph.data()[c * n + i] - render.data()[c * n + i]).abs();
        (apart(0) + apart(1) + apart(2)) / 3.0
    };
    let mut differences: Vec<f32> = (0..n).map(difference).collect();
    mean(&mut differences, w, region);
    let ramp = |x: f32| x.clamp(0.0, 1.0);
    let mut out: Vec<f32> = (0..n)
        .map(|i| {
            let (pp, rr, pr) = structure.at(i);
            let agreement = pr / ((pp + noise) * (rr + noise)).sqrt();
            let apart = differences[i] / NEAR;
            let near = exp(-apart * apart);
            ramp((agreement.max(near * noise / (pp + noise)) - 0.25) / 0.35) * ramp(near / 0.4)
        })
        .collect();
    mean(&mut out, w, region);
    if let Some(coverage) = coverage {
        out.iter_mut().zip(coverage.data()).for_each(|(k, c)| *k *= c);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The knowledge of a photograph from its own structure.
    fn known(photograph: &Image, render: &Image, coverage: Option<&Map>) -> Vec<f32> {
        super::known(photograph, render, &Structure::of(photograph, render), coverage)
    }

    /// Bricks with a colour; `shift` moves them.
    fn bricks(w: usize, h: usize, shift: usize) -> Image {
        let mut image = Image::new(w, h);
        for y in 0..h {
            for x in 0..w {
                let v = if ((x + shift) / 5 + y / 4).is_multiple_of(2) { 0.35 } else { 0.6 };
                image.set_pixel(x, y, [v, 0.9 * v, 0.8 * v]);
            }
        }
        image
    }

    #[test]
    fn the_same_structure_is_known_and_another_is_not() {
        let (w, h) = (160, 120);
        let photograph = bricks(w, h, 0);
        let same = known(&photograph, &photograph, None);
        assert!(same.iter().all(|k| *k > 0.99));
        // A render in a little other light is known, too.
        let lit = photograph.map(|v| 0.9 * v + 0.02);
        assert!(known(&photograph, &lit, None).iter().all(|k| *k > 0.9));
        // The right half shows other bricks.
        let (other, mut half) = (bricks(w, h, 5), photograph.clone());
        for y in 0..h {
            for x in w / 2..w {
                half.set_pixel(x, y, other.pixel(x, y));
            }
        }
        let share = known(&photograph, &half, None);
        assert!(
            share[60 * w + 20] > 0.9 && share[60 * w + 140] < 0.1,
            "{} {}",
            share[60 * w + 20],
            share[60 * w + 140]
        );
        let covered = Map::filled(w, h, 0.5);
        assert!(known(&photograph, &photograph, Some(&covered)).iter().all(|k| (*k - 0.5).abs() < 0.01));
    }

    #[test]
    fn flat_places_are_known_by_their_colour() {
        let (w, h) = (80, 60);
        let flat = Image::filled(w, h, 0.3);
        assert!(known(&flat, &flat.map(|v| v + 0.02), None).iter().all(|k| *k > 0.9));
        assert!(known(&flat, &flat.map(|v| v + 0.3), None).iter().all(|k| *k < 0.05));
    }
}
