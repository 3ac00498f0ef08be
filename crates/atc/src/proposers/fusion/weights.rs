//! The weight of each pixel of an input.
//!
//! Three maps are added: *contrast*, the absolute Laplacian of the luminance, so that edges and texture
//! count; *saliency*, the distance of the blurred colour from the mean colour in luminance and two opponent
//! axes, so that objects stand out of the water; *saturation*, the spread of the channels around the
//! luminance.

use rayon::prelude::*;
use use3d_capture::{Image, Map};
use use3d_numerics::math;
use use3d_numerics::sums::sums;

use super::pyramid::blur;

/// Luminance, red against green, and yellow against blue.
fn opponent(image: &Image) -> Image {
    let [r, g, b] = image.planes();
    let mut out = Image::new(image.width(), image.height());
    for p in 0..image.pixels() {
        let (r, g, b) = (r[p], g[p], b[p]);
        out.plane_mut(0)[p] = 0.299 * r + 0.587 * g + 0.114 * b;
        out.plane_mut(1)[p] = r - g;
        out.plane_mut(2)[p] = 0.5 * (r + g) - b;
    }
    out
}

/// The sum of the three maps, ≥ 0.
pub(super) fn weights(image: &Image) -> Map {
    let (w, h) = (image.width(), image.height());
    let opponent = opponent(image);
    let smooth = blur(&opponent);
    let count = image.pixels().max(1) as f64;
    let mean = sums::<3>(image.pixels(), |p, t| {
        for c in 0..3 {
            t[c] += f64::from(smooth.plane(c)[p]);
        }
    })
    .map(|s| (s / count) as f32);
    let mut out = Map::new(w, h);
    out.data_mut().par_chunks_mut(w).enumerate().for_each(|(y, row)| {
        let line = |y: usize| opponent.row(0, y);
        let (above, here, below) = (line(y.saturating_sub(1)), line(y), line((y + 1).min(h - 1)));
        for (x, o) in row.iter_mut().enumerate() {
            let (left, right) = (x.saturating_sub(1), (x + 1).min(w - 1));
            let contrast = (above[x] + below[x] + here[left] + here[right] - 4.0 * here[x]).abs();
            let colour = image.pixel(x, y);
            let (mut saliency, mut saturation) = (0.0, 0.0);
            for c in 0..3 {
                saliency += math::powi(smooth.row(c, y)[x] - mean[c], 2);
                saturation += math::powi(colour[c] - here[x], 2) / 3.0;
            }
            *o = contrast + saliency.sqrt() + saturation.sqrt();
        }
    });
    out
}
