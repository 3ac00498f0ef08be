//! White balance of a whole set of images (R27): each channel is divided by its 99.8 % quantile across all
//! images, in display values.

use std::path::Path;

use use3d_io_image::{ChannelHistogram, read_pixels};

use crate::error::ImportError;
use crate::parallel::in_parallel;

const QUANTILE: f64 = 0.998;

/// Gains for R, G, B, each at least 1 (an image set cannot be darkened by its own quantile).
pub(crate) fn set_percentile_gains(
    paths: &[&Path],
    workers: usize,
    tick: &(dyn Fn() -> bool + Sync),
) -> Result<[f32; 3], ImportError> {
    // Each worker counts every `workers`-th image in its own histogram; integer sums commute.
    let partial = in_parallel(workers.min(paths.len()), workers, |worker| {
        let mut histogram = ChannelHistogram::default();
        for path in paths.iter().skip(worker).step_by(workers) {
            histogram.count(&read_pixels(path)?);
            if !tick() {
                return Err(ImportError::Interrupted);
            }
        }
        Ok(histogram)
    })?;
    let mut total = ChannelHistogram::default();
    partial.iter().for_each(|part| total.add(part));
    Ok(total.gains(QUANTILE))
}
