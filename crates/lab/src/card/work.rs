//! The smallest work of a step's kernels. The time that it needs at a card's highest rates is a kernel's
//! roofline; its share of the measured time shows how much can be gained.
//!
//! The smallest work of a kernel is to read and write every buffer once, plus the operations of its text (a
//! multiply-add counts as two, an exponential as one). It follows from the sizes of the last drawn view and
//! its pairs of pixel and Gaussian.

use use3d_gpu::measure::{Ceilings, ViewWork};

/// The smallest work of a kernel in one step of stage 1 with all features on: bytes and operations. `None`
/// for kernels of one workgroup, whose time is that of a launch.
pub(super) fn need(kernel: &str, work: &ViewWork) -> Option<[f64; 2]> {
    let ViewWork { gaussians, visible, entries, tested, live, pixels, tile_passes, .. } = *work;
    let (n, seen, e, p) = (gaussians as f64, visible as f64, entries as f64, pixels as f64);
    let (tested, live) = (tested as f64, live as f64);
    // The depth has four digits, and the tile's number as many as it needs.
    let (by_depth, by_tile) = (4.0, tile_passes as f64);
    // Three levels, each with a quarter of the pixels of the one before.
    let levels = 1.0 + 1.0 / 4.0 + 1.0 / 16.0;
    Some(match kernel {
        "unpack" => [26.0 * p, 6.0 * p],
        // Geometry of all Gaussians, colours of the visible ones; a splat, a key, a count.
        "project" => [104.0 * n + 192.0 * seen, 250.0 * n + 130.0 * seen],
        "sort: histogram" => [4.0 * (by_depth * n + by_tile * e), 0.0],
        "sort: scatter" => [16.0 * (by_depth * n + by_tile * e) - 4.0 * (n + e), 0.0],
        "reduce" => [8.0 * n, 0.0],
        "offsets" => [20.0 * n, 0.0],
        "emit" => [8.0 * n + 32.0 * seen + 8.0 * e, 60.0 * e],
        // Entry, owner and splat once per tile; water and sums of every pixel.
        "forward" => [56.0 * e + 100.0 * p, 10.0 * tested + 47.0 * live],
        "backward" => [104.0 * e + 68.0 * p, 10.0 * tested + 79.0 * live],
        // Owner and run of an entry; the records of long runs are few.
        "sums of long runs" => [12.0 * e, 0.0],
        // Values and both moments of twelve numbers, read and written; splat, run, statistics, the colour's
        // gradient; records.
        "update" => [384.0 * n + 48.0 * e, (11.0 * 12.0 + 300.0) * n + 12.0 * e],
        // Values and both moments of 48 numbers, read and written; the colour's gradient.
        "update of colours" => [1176.0 * n, (48.0 * 13.0 + 70.0) * n],
        "weigh" => [52.0 * p, 36.0 * p],
        "pool" => [24.0 * p * (1.0 + 1.0 / 4.0 + 1.0 / 4.0 + 1.0 / 16.0), 6.0 * p],
        // Two passes of eleven taps over four moments, the first with the margin of 26 × 16 for 16 × 16.
        "compare" => [60.0 * p * levels, 3.0 * (11.0 * (12.0 * 1.6 + 8.0) + 30.0) * p * levels],
        "blur_back" => [75.0 * p * levels, 3.0 * (11.0 * (6.0 * 1.6 + 6.0) + 12.0) * p * levels],
        "pull" => [64.0 * p, 36.0 * p],
        "depth_means" | "depth_deviations" => [8.0 * p, 10.0 * p],
        "depth_slopes" => [12.0 * p, 12.0 * p],
        // Basis, nine sums of sixteen bands, two softplus functions per channel; and backward.
        "look" => [36.0 * p, (60.0 + 288.0 + 6.0 * 25.0) * p],
        "gather" => [84.0 * p, (60.0 + 288.0 + 6.0 * 25.0) * p],
        _ => return None,
    })
}

/// Smallest time in seconds for these bytes and operations.
pub(super) fn least(ceilings: &Ceilings, [bytes, flops]: [f64; 2]) -> f64 {
    (bytes / ceilings.bytes).max(flops / ceilings.flops)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_time_is_that_of_the_slower_rate() {
        let ceilings = Ceilings { bytes: 100.0, flops: 1000.0, copied: 1 };
        assert_eq!((least(&ceilings, [200.0, 10.0]), least(&ceilings, [1.0, 3000.0])), (2.0, 3.0));
    }

    /// Tests the terms of a kernel's work that can be separated.
    #[test]
    fn needs_follow_from_sizes() {
        let none = ViewWork { tile_passes: 1, ..ViewWork::default() };
        assert_eq!(need("backward", &none), Some([0.0, 0.0]));
        let pairs = ViewWork { tested: 10, live: 2, ..none };
        assert_eq!(need("forward", &pairs), Some([0.0, 194.0]));
        let sorted = ViewWork { gaussians: 100, entries: 50, tile_passes: 2, ..none };
        assert_eq!(need("sort: histogram", &sorted), Some([2000.0, 0.0]));
        assert_eq!(need("tell", &sorted), None);
    }
}
