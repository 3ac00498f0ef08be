//! The calibrator's description of a source image: 18 numbers for the image and 6 for each cell.
//!
//! Image: channel means and population standard deviations; the 0.1, 0.5 and 0.9 quantiles of each channel
//! (linear interpolation, all channels of one quantile together); mean, standard deviation (≥ 10⁻⁵) and
//! skewness of the luminance of `softplus(50 v) / 50`. Cell: adaptive means, then standard deviations
//! `√max(E f² − (E f)², 10⁻⁵)`, of `f = (ln(Y + 10⁻⁴), (ℓ_r − ℓ_g)/√2, (ℓ_r + ℓ_g − 2 ℓ_b)/√6)` with
//! `ℓ = ln(max(v, 0) + 10⁻⁴)` and `Y` the luminance of `max(v, 0)`. Both use the image at the extractor's
//! working resolution, unclamped.

use rayon::prelude::*;
use use3d_capture::Image;
use use3d_numerics::math;
use use3d_numerics::order::Ascending;
use use3d_numerics::sums::sums;

use super::global::LUMINANCE;
use super::pooling::Pooling;

/// Length of the image descriptor.
pub const GLOBAL_DESCRIPTOR: usize = 18;
/// Length of a cell descriptor.
pub const LOCAL_DESCRIPTOR: usize = 6;

/// The conditions of the calibrator that come from the source image.
#[derive(Clone, Debug, PartialEq)]
pub struct Descriptors {
    /// The image's 18 numbers.
    pub global: [f64; GLOBAL_DESCRIPTOR],
    /// Six numbers per cell, row-major over the grid.
    pub local: Vec<[f64; LOCAL_DESCRIPTOR]>,
}

pub(super) fn describe(image: &Image, cells: &Pooling) -> Descriptors {
    Descriptors { global: describe_image(image), local: describe_cells(image, cells) }
}

fn describe_image(image: &Image) -> [f64; GLOBAL_DESCRIPTOR] {
    let n = image.pixels();
    let count = n as f64;
    let planes = image.planes();
    let mut out = [0.0; GLOBAL_DESCRIPTOR];
    let means = sums::<3>(n, |p, t| {
        for c in 0..3 {
            t[c] += f64::from(planes[c][p]);
        }
    })
    .map(|s| s / count);
    let variances = sums::<3>(n, |p, t| {
        for c in 0..3 {
            t[c] += math::powi(f64::from(planes[c][p]) - means[c], 2);
        }
    })
    .map(|s| s / count);
    for c in 0..3 {
        out[c] = means[c];
        out[3 + c] = variances[c].sqrt();
    }
    let quantiles: Vec<[f64; 3]> = planes.par_iter().map(|plane| quantiles_of(plane)).collect();
    for (c, values) in quantiles.iter().enumerate() {
        for (q, &v) in values.iter().enumerate() {
            out[6 + 3 * q + c] = v;
        }
    }
    // softplus(50 v) / 50 is max(v, 0) with a rounded corner; this form does not overflow for large v.
    let softplus = |v: f64| (50.0 * v).max(0.0) / 50.0 + math::ln_1p(math::exp(-(50.0 * v).abs())) / 50.0;
    let luminance: Vec<f64> = (0..n)
        .into_par_iter()
        .map(|p| (0..3).map(|c| LUMINANCE[c] * softplus(f64::from(planes[c][p]))).sum())
        .collect();
    let [sum] = sums::<1>(n, |p, t| t[0] += luminance[p]);
    let mean = sum / count;
    let [square, cube] = sums::<2>(n, |p, t| {
        let d = luminance[p] - mean;
        t[0] += d * d;
        t[1] += d * d * d;
    });
    let deviation = (square / count).sqrt().max(1e-5);
    out[15] = mean;
    out[16] = deviation;
    out[17] = cube / count / math::powi(deviation, 3);
    out
}

/// The 0.1, 0.5 and 0.9 quantiles.
fn quantiles_of(values: &[f32]) -> [f64; 3] {
    let values = Ascending::of(values.iter().copied());
    [0.1, 0.5, 0.9].map(|share| values.interpolated(share).unwrap_or(0.0))
}

fn describe_cells(image: &Image, cells: &Pooling) -> Vec<[f64; LOCAL_DESCRIPTOR]> {
    let n = image.pixels();
    let planes = image.planes();
    // Six planes: the three features, then their squares.
    let pixels: Vec<[f64; 3]> = (0..n)
        .into_par_iter()
        .map(|p| {
            let v: [f64; 3] = std::array::from_fn(|c| f64::from(planes[c][p]).max(0.0));
            let l = v.map(|v| math::ln(v + 1e-4));
            let luminance = LUMINANCE[0] * v[0] + LUMINANCE[1] * v[1] + LUMINANCE[2] * v[2];
            [
                math::ln(luminance + 1e-4),
                (l[0] - l[1]) / 2f64.sqrt(),
                (l[0] + l[1] - 2.0 * l[2]) / 6f64.sqrt(),
            ]
        })
        .collect();
    let mut features = vec![0.0; 6 * n];
    for (plane, out) in features.chunks_exact_mut(n).enumerate() {
        for (o, f) in out.iter_mut().zip(&pixels) {
            *o = if plane < 3 { f[plane] } else { f[plane - 3] * f[plane - 3] };
        }
    }
    let (columns, rows) = (cells.x.len(), cells.y.len());
    let mut pooled = vec![0.0; 6 * columns * rows];
    cells.forward(6, &features, &mut pooled, &mut Vec::new());
    let at = |cell: usize, plane: usize| pooled[(cell / columns * 6 + plane) * columns + cell % columns];
    (0..columns * rows)
        .map(|cell| {
            std::array::from_fn(|k| {
                if k < 3 {
                    at(cell, k)
                } else {
                    (at(cell, k) - math::powi(at(cell, k - 3), 2)).max(1e-5).sqrt()
                }
            })
        })
        .collect()
}
