//! Histograms of the channels of many images, and the gains that follow from them.
//!
//! Bins are counted in integers, so the gains do not depend on the order of the images.

use use3d_capture::Pixels;

const BINS: usize = 1 << 16;

/// Counts of the values of R, G and B, on a scale of 16 bits.
#[derive(Clone, Debug)]
pub struct ChannelHistogram(Vec<u64>);

impl Default for ChannelHistogram {
    fn default() -> Self {
        Self(vec![0; 3 * BINS])
    }
}

impl ChannelHistogram {
    /// Adds the values of an image.
    pub fn count(&mut self, pixels: &Pixels) {
        for (c, bins) in self.0.chunks_exact_mut(BINS).enumerate() {
            match pixels {
                Pixels::Eight(p) => p.plane(c).iter().for_each(|&v| bins[usize::from(v) * 257] += 1),
                Pixels::Sixteen(p) => p.plane(c).iter().for_each(|&v| bins[usize::from(v)] += 1),
            }
        }
    }

    /// Adds the counts of another histogram.
    pub fn add(&mut self, other: &Self) {
        self.0.iter_mut().zip(&other.0).for_each(|(t, n)| *t += n);
    }

    /// Gains for R, G, B: one over the smallest value that at least this share of the samples do not exceed.
    /// A channel without any light is left unchanged.
    pub fn gains(&self, quantile: f64) -> [f32; 3] {
        std::array::from_fn(|c| gain(&self.0[c * BINS..(c + 1) * BINS], quantile))
    }
}

fn gain(bins: &[u64], quantile: f64) -> f32 {
    let samples: u64 = bins.iter().sum();
    let wanted = (samples as f64 * quantile).ceil() as u64;
    let mut below = 0;
    for (value, count) in bins.iter().enumerate() {
        below += count;
        if below >= wanted {
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
        assert!((gain(&bins, 0.998) - 65535.0 / 32768.0).abs() < 1e-6);
        bins[60000] = 3;
        assert!((gain(&bins, 0.998) - 65535.0 / 60000.0).abs() < 1e-6);
        assert_eq!(gain(&vec![0; BINS], 0.998), 1.0);
    }
}
