//! White balance of a whole set of images (R27): each channel is divided by its 99.8 % quantile across all
//! images, in display values.
//!
//! Histograms of 65 536 bins are counted in integers, so the gains do not depend on the order of the images.

use std::path::Path;

use use3d_capture::Pixels;
use use3d_io_image::read_pixels;

use crate::error::ImportError;
use crate::prepare::in_parallel;

const BINS: usize = 1 << 16;
const QUANTILE: f64 = 0.998;

/// Gains for R, G, B, each at least 1 (an image set cannot be darkened by its own quantile).
pub(crate) fn set_percentile_gains(
    paths: &[&Path],
    workers: usize,
    tick: &(dyn Fn() -> bool + Sync),
) -> Result<[f32; 3], ImportError> {
    // Each worker counts every `workers`-th image in its own histogram; integer sums commute.
    let partial = in_parallel(workers.min(paths.len()), workers, |worker| {
        let mut histogram = vec![0u64; 3 * BINS];
        for path in paths.iter().skip(worker).step_by(workers) {
            count(&read_pixels(path)?, &mut histogram);
            if !tick() {
                return Err(ImportError::Interrupted);
            }
        }
        Ok(histogram)
    })?;
    let mut total = vec![0u64; 3 * BINS];
    for histogram in partial {
        total.iter_mut().zip(histogram).for_each(|(t, h)| *t += h);
    }
    Ok(std::array::from_fn(|c| gain(&total[c * BINS..(c + 1) * BINS])))
}

fn count(pixels: &Pixels, histogram: &mut [u64]) {
    for (c, bins) in histogram.chunks_exact_mut(BINS).enumerate() {
        match pixels {
            Pixels::Eight(p) => p.plane(c).iter().for_each(|&v| bins[usize::from(v) * 257] += 1),
            Pixels::Sixteen(p) => p.plane(c).iter().for_each(|&v| bins[usize::from(v)] += 1),
        }
    }
}

/// One over the smallest value that at least 99.8 % of the samples do not exceed.
fn gain(bins: &[u64]) -> f32 {
    let samples: u64 = bins.iter().sum();
    let wanted = (samples as f64 * QUANTILE).ceil() as u64;
    let mut below = 0;
    for (value, count) in bins.iter().enumerate() {
        below += count;
        if below >= wanted {
            // A channel without any light is left unchanged.
            return if value == 0 { 1.0 } else { ((BINS - 1) as f64 / value as f64) as f32 };
        }
    }
    1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_quantile_is_taken_over_the_whole_set() {
        let mut bins = vec![0u64; BINS];
        bins[32768] = 998;
        bins[60000] = 2;
        assert!((gain(&bins) - 65535.0 / 32768.0).abs() < 1e-6);
        bins[60000] = 3;
        assert!((gain(&bins) - 65535.0 / 60000.0).abs() < 1e-6);
        assert_eq!(gain(&vec![0; BINS]), 1.0);
    }
}
