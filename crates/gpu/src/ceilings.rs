//! Measures the highest rates of a card, and counts the smallest work of a step's kernels. The resulting
//! time is a kernel's roofline; its share of the measured time shows how much can be gained.
//!
//! Two kernels measure the highest rates: one copies, one multiplies and adds. The smallest work of a
//! kernel is to read and write every buffer once, plus the operations of its text (a multiply-add counts as
//! two, an exponential as one). It follows from the sizes of the last drawn view and its pairs of pixel and
//! Gaussian.

use std::collections::BTreeMap;
use std::time::Instant;

use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::Gpu;
use crate::kernel::{Access, Kernel, ROWS, Spec, bound, submit};
use crate::profile::Timed;
use crate::rows::Float4;
use crate::stage1::ViewWork;

/// Threads of a workgroup.
const THREADS: u32 = 256;
/// Number of threads that multiply, and operations of each in a round: sixteen multiply-adds of four.
const MULTIPLIERS: usize = 1 << 18;
const PER_ROUND: f64 = 16.0 * 4.0 * 2.0;
/// Number of repeated measurements; the best counts.
const TIMES: usize = 3;
/// Number of rows below which a copy is not halved any more.
const FEWEST_ROWS: usize = 1 << 12;

fn copy() -> Spec {
    Spec {
        name: "copy",
        threads: THREADS,
        bindings: vec![(Access::Read, "origin", ROWS), (Access::Write, "copied", ROWS)],
        constants: vec![],
        parts: vec![include_str!("ceilings/copy.wgsl")],
    }
}

fn multiply() -> Spec {
    Spec {
        name: "multiply",
        threads: THREADS,
        bindings: vec![(Access::Uniform, "rounds", "vec4<u32>"), (Access::Write, "sums", ROWS)],
        constants: vec![],
        parts: vec![include_str!("ceilings/multiply.wgsl")],
    }
}

/// The highest rates that a device reached.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Ceilings {
    /// Bytes per second, read and written together.
    pub(crate) bytes: f64,
    /// Operations in single precision per second.
    pub(crate) flops: f64,
    /// Number of bytes copied at once.
    pub(crate) copied: u64,
}

/// Measures the seconds of some dispatches, by the device's clock if it has one.
fn seconds(gpu: &Gpu, record: impl FnOnce(&mut wgpu::ComputePass<'_>)) -> Result<f64, EngineError> {
    gpu.wait()?;
    gpu.read_times(&mut BTreeMap::new())?;
    let started = Instant::now();
    submit(gpu, "ceiling", record)?;
    gpu.wait()?;
    let waited = started.elapsed().as_secs_f64();
    let mut times = BTreeMap::new();
    gpu.read_times(&mut times)?;
    let own: f64 = times.values().map(|time| time.seconds).sum();
    Ok(if own > 0.0 { own } else { waited })
}

/// Returns the best rate of work whose size is doubled until it takes `least` seconds or reaches `most`.
fn best(
    least: f64,
    most: u32,
    mut run: impl FnMut(u32) -> Result<(f64, f64), EngineError>,
) -> Result<f64, EngineError> {
    let mut size = 1;
    while size < most && run(size)?.1 < least {
        size *= 2;
    }
    let mut rate = 0.0f64;
    for _ in 0..TIMES {
        let (work, time) = run(size)?;
        rate = rate.max(work / time.max(f64::MIN_POSITIVE));
    }
    Ok(rate)
}

/// Makes two buffers of `rows` rows; the number is halved repeatedly if memory does not suffice.
fn pair(gpu: &Gpu, mut rows: usize) -> Result<[Array<Float4>; 2], EngineError> {
    loop {
        let both =
            Array::new(gpu, "rows", rows).and_then(|from| Ok([from, Array::new(gpu, "copied rows", rows)?]));
        match both {
            Err(EngineError::OutOfMemory { .. }) if rows > FEWEST_ROWS => rows /= 2,
            both => return both,
        }
    }
}

/// Measures a device with buffers of `bytes`; a measurement takes at least `least` seconds.
pub(crate) fn measure(gpu: &Gpu, bytes: u64, least: f64) -> Result<Ceilings, EngineError> {
    let gpu = &gpu.clone().timed(Timed::Dispatches);
    let (copy, multiply) = (Kernel::new(gpu, &copy())?, Kernel::new(gpu, &multiply())?);
    let rows = (bytes.min(gpu.longest()) as usize / size_of::<Float4>()).max(1);
    let [from, to] = pair(gpu, rows)?;
    let (rows, copied) = (from.capacity(), from.size() as u64);
    // The number of dispatches is limited by the clock's places.
    let bytes = best(least, 1024, |size| {
        let time = seconds(gpu, |pass| (0..size).for_each(|_| copy.record(pass, rows, bound![from, to])))?;
        Ok((2.0 * (rows * size_of::<Float4>()) as f64 * f64::from(size), time))
    })?;
    let (rounds, sums) = (Array::uniform(gpu, "rounds")?, Array::<Float4>::new(gpu, "sums", MULTIPLIERS)?);
    let flops = best(least, 1 << 20, |size| {
        rounds.write(gpu, 0, &[[size, 0.999f32.to_bits(), 0.001f32.to_bits(), 0]]);
        let time = seconds(gpu, |pass| multiply.record(pass, MULTIPLIERS, bound![rounds, sums]))?;
        Ok((PER_ROUND * MULTIPLIERS as f64 * f64::from(size), time))
    })?;
    Ok(Ceilings { bytes, flops, copied })
}

/// The smallest work of a kernel in one step of stage 1 with all features on: bytes and operations. `None`
/// for kernels of one workgroup, whose time is that of a launch.
pub(crate) fn need(kernel: &str, work: &ViewWork) -> Option<[f64; 2]> {
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

impl Ceilings {
    /// Smallest time in seconds for these bytes and operations.
    pub(crate) fn least(&self, [bytes, flops]: [f64; 2]) -> f64 {
        (bytes / self.bytes).max(flops / self.flops)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::tests::validate;
    use crate::testing::software;

    #[test]
    fn the_kernels_are_valid() {
        [copy(), multiply()].iter().for_each(validate);
    }

    #[test]
    fn ceilings_are_found_and_least_times_follow() {
        let Some(gpu) = software() else { return };
        let found = measure(&gpu, 1 << 20, 1e-4).unwrap();
        assert!(
            found.bytes > 1e6 && found.bytes < 1e14 && found.flops > 1e6 && found.flops < 1e16,
            "{found:?}"
        );
        let ceilings = Ceilings { bytes: 100.0, flops: 1000.0, copied: 1 };
        assert_eq!((ceilings.least([200.0, 10.0]), ceilings.least([1.0, 3000.0])), (2.0, 3.0));
    }

    #[test]
    fn a_copy_that_does_not_fit_is_halved() {
        let Some(gpu) = software() else { return };
        gpu.run_out_of_memory();
        let [from, to] = pair(&gpu, 1 << 16).unwrap();
        assert_eq!((from.capacity(), to.capacity()), (1 << 15, 1 << 15));
        gpu.run_out_of_memory();
        assert!(pair(&gpu, FEWEST_ROWS).is_err());
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
