//! UIQM, underwater image quality without a reference (Panetta, Gao & Agaian, IEEE JOE 2016), as its widely
//! copied Python port computes it.
//!
//! `UIQM = 0.0282 UICM + 0.2953 UISM + 3.5753 UIConM`: colourfulness, sharpness, contrast, on values 0 to
//! 255. Published tables use the port, so its peculiarities are kept on purpose:
//!
//! * UICM: the trimmed means of R-G and (R+G)/2-B leave out `⌈0.1 n⌉ + 1` smallest and `⌊0.1 n⌋` largest
//!   values but divide by `n - ⌈0.1 n⌉ - ⌊0.1 n⌋`; the variances are about these means over *all* values;
//! * UISM: per channel, Sobel magnitude rescaled to a maximum of 255, times the channel; EME of its 10 × 10
//!   blocks (blocks whose minimum or maximum is 0 count 0), weights .299, .587, .144 (the last a misprint of
//!   .114);
//! * UIConM: `-mean r ln r` over 10 × 10 blocks, r = (max - min)/(max + min) over all channels, 0 where r is
//!   0 or undefined.

use rayon::prelude::*;
use use3d_capture::{Image, Image8};
use use3d_numerics::math;

use crate::error::{MetricError, finite, large_enough};

/// A score and its three terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Uiqm {
    /// The weighted sum.
    pub score: f64,
    /// UICM, unweighted.
    pub colorfulness: f64,
    /// UISM, unweighted.
    pub sharpness: f64,
    /// UIConM, unweighted.
    pub contrast: f64,
}

const BLOCK: usize = 10;

/// UIQM of a display-range image; it is quantised to 8 bits first.
///
/// # Errors
/// The image has a side below 10 pixels, or values that are not finite.
pub fn uiqm(image: &Image) -> Result<Uiqm, MetricError> {
    finite("the image", image)?;
    uiqm_of_8bit(&image.to_8bit())
}

/// UIQM of an 8-bit image.
///
/// # Errors
/// The image has a side below 10 pixels.
pub fn uiqm_of_8bit(image: &Image8) -> Result<Uiqm, MetricError> {
    large_enough("UIQM", image, BLOCK)?;
    let (colorfulness, sharpness, contrast) = (colorfulness(image), sharpness(image), contrast(image));
    let score = 0.0282 * colorfulness + 0.2953 * sharpness + 3.5753 * contrast;
    Ok(Uiqm { score, colorfulness, sharpness, contrast })
}

fn colorfulness(image: &Image8) -> f64 {
    let [r, g, b] = image.planes();
    // Both opponent values are integers or half-integers, so histograms of doubled values are exact.
    const OFFSET: i32 = 510;
    let mut counts = [vec![0u64; 1021], vec![0u64; 1021]];
    for p in 0..image.pixels() {
        let (r, g, b) = (i32::from(r[p]), i32::from(g[p]), i32::from(b[p]));
        counts[0][(2 * (r - g) + OFFSET) as usize] += 1;
        counts[1][(r + g - 2 * b + OFFSET) as usize] += 1;
    }
    let n = image.pixels() as u64;
    let value = |bin: usize| f64::from(bin as i32 - OFFSET) / 2.0;
    let [(mean_rg, var_rg), (mean_yb, var_yb)] = counts.map(|counts| {
        let (low, high) = (n.div_ceil(10), n / 10);
        let (start, end) = (low + 1, n - high);
        let (mut sum, mut seen) = (0.0, 0u64);
        for (bin, &count) in counts.iter().enumerate() {
            let kept = (seen + count).min(end).saturating_sub(seen.max(start));
            sum += kept as f64 * value(bin);
            seen += count;
        }
        let mean = sum / (n - low - high) as f64;
        let square: f64 = counts
            .iter()
            .enumerate()
            .map(|(bin, &count)| count as f64 * math::powi(value(bin) - mean, 2))
            .sum();
        (mean, square / n as f64)
    });
    -0.0268 * math::hypot(mean_rg, mean_yb) + 0.1586 * (var_rg + var_yb).sqrt()
}

/// Squared Sobel magnitude of some rows of a plane, half-sample symmetric at the plane's borders. The
/// values are integers, at most 2 · 1020².
fn sobel_squared(plane: &[u8], width: usize, height: usize, rows: std::ops::Range<usize>) -> Vec<i32> {
    let mut out = vec![0i32; rows.len() * width];
    for (line, y) in out.chunks_mut(width).zip(rows) {
        let row = |y: usize| &plane[y * width..(y + 1) * width];
        let (above, here, below) = (row(y.saturating_sub(1)), row(y), row((y + 1).min(height - 1)));
        let at = |row: &[u8], x: usize| i32::from(row[x]);
        let magnitude = |l: usize, x: usize, r: usize| {
            let dx = (at(above, r) + 2 * at(here, r) + at(below, r))
                - (at(above, l) + 2 * at(here, l) + at(below, l));
            let dy = (at(below, l) + 2 * at(below, x) + at(below, r))
                - (at(above, l) + 2 * at(above, x) + at(above, r));
            dx * dx + dy * dy
        };
        line[0] = magnitude(0, 0, 1.min(width - 1));
        line[width - 1] = magnitude(width.saturating_sub(2), width - 1, width - 1);
        for x in 1..width.saturating_sub(1) {
            line[x] = magnitude(x - 1, x, x + 1);
        }
    }
    out
}

/// The mean over whole blocks of `f(value shared by the row of blocks, block's columns, block's rows)`, in
/// a fixed order.
fn mean_over_blocks<R>(
    width: usize,
    height: usize,
    share: impl Fn(std::ops::Range<usize>) -> R + Sync,
    f: impl Fn(&R, std::ops::Range<usize>, std::ops::Range<usize>) -> f64 + Sync,
) -> f64 {
    let (columns, rows) = (width / BLOCK, height / BLOCK);
    let sums: Vec<f64> = (0..rows)
        .into_par_iter()
        .map(|j| {
            let ys = j * BLOCK..(j + 1) * BLOCK;
            let shared = share(ys.clone());
            (0..columns).map(|i| f(&shared, i * BLOCK..(i + 1) * BLOCK, ys.clone())).sum()
        })
        .collect();
    sums.iter().sum::<f64>() / (columns * rows) as f64
}

fn sharpness(image: &Image8) -> f64 {
    let (width, height) = (image.width(), image.height());
    let eme = [0, 1, 2].map(|c| {
        let plane = image.plane(c);
        // Edges are stored for one row of blocks only: those of a whole plane would need four times the
        // memory of the picture.
        let edges = |ys| sobel_squared(plane, width, height, ys);
        // (max/min) of 255 √e/√e_max · v needs neither the common factor nor the roots: it compares e v²
        // and halves the logarithm.
        2.0 * mean_over_blocks(width, height, edges, |edges, xs, ys| {
            let (mut low, mut high) = (u64::MAX, 0u64);
            for (line, y) in ys.enumerate() {
                for x in xs.clone() {
                    let v = u64::from(plane[y * width + x]);
                    let e = edges[line * width + x] as u64 * v * v;
                    low = low.min(e);
                    high = high.max(e);
                }
            }
            if low == 0 { 0.0 } else { 0.5 * math::ln(high as f64 / low as f64) }
        })
    });
    0.299 * eme[0] + 0.587 * eme[1] + 0.144 * eme[2]
}

fn contrast(image: &Image8) -> f64 {
    let width = image.width();
    let planes = image.planes();
    let nothing = |_| ();
    -mean_over_blocks(width, image.height(), nothing, |(), xs, ys| {
        let (mut low, mut high) = (u8::MAX, 0u8);
        for y in ys {
            for plane in planes {
                for &v in &plane[y * width + xs.start..y * width + xs.end] {
                    low = low.min(v);
                    high = high.max(v);
                }
            }
        }
        let (low, high) = (f64::from(low), f64::from(high));
        if high > low {
            let r = (high - low) / (high + low);
            r * math::ln(r)
        } else {
            0.0
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The trimmed mean as the port computes it.
    fn plain_trimmed_mean(mut values: Vec<f64>) -> f64 {
        values.sort_by(f64::total_cmp);
        let n = values.len();
        let (low, high) = ((0.1 * n as f64).ceil() as usize, (0.1 * n as f64).floor() as usize);
        values[low + 1..n - high].iter().sum::<f64>() / (n - low - high) as f64
    }

    #[test]
    fn the_histogram_form_of_the_trimmed_mean_is_the_sorted_one() {
        let (width, height) = (13, 11);
        let data: Vec<u8> = (0..3 * width * height).map(|i| ((i * 7919 + i * i * 31) % 256) as u8).collect();
        let image = Image8::from_planes(width, height, data).unwrap();
        let [r, g, b] = image.planes();
        let f = |v: u8| f64::from(v);
        let opponents: [Vec<f64>; 2] = [
            (0..image.pixels()).map(|p| f(r[p]) - f(g[p])).collect(),
            (0..image.pixels()).map(|p| (f(r[p]) + f(g[p])) / 2.0 - f(b[p])).collect(),
        ];
        let [(rg, v1), (yb, v2)] = opponents.map(|values| {
            let mean = plain_trimmed_mean(values.clone());
            let n = values.len() as f64;
            (mean, values.iter().map(|v| math::powi(v - mean, 2)).sum::<f64>() / n)
        });
        let expected = -0.0268 * math::hypot(rg, yb) + 0.1586 * (v1 + v2).sqrt();
        assert!((colorfulness(&image) - expected).abs() < 1e-12);
    }

    #[test]
    fn flat_images_have_a_score_and_small_ones_an_error() {
        let flat = uiqm(&Image::filled(20, 20, 0.5)).unwrap();
        assert_eq!((flat.sharpness, flat.contrast), (0.0, 0.0));
        assert!(matches!(uiqm(&Image::new(9, 40)), Err(MetricError::TooSmall { .. })));
    }
}
