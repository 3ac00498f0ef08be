//! Measurements of a device that need its kernels: its highest rates, times by its clock, and the work of a
//! view.
//!
//! [`ceilings`] runs two kernels: one copies, one multiplies and adds. [`Gpu::timed`] reads the clock around
//! every dispatch or pass, and [`Gpu::read_times`] gives the sums. [`crate::Stage1::last_view`] counts the
//! [`ViewWork`] of a step. A benchmark combines them; no training uses them.

use std::collections::BTreeMap;
use std::time::Instant;

use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::Gpu;
use crate::kernel::{Access, Kernel, ROWS, Spec, bound, submit};
pub use crate::profile::{KernelTime, Timed};
use crate::rows::Float4;
pub use crate::stage1::ViewWork;

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
        parts: vec![include_str!("measure/copy.wgsl")],
    }
}

fn multiply() -> Spec {
    Spec {
        name: "multiply",
        threads: THREADS,
        bindings: vec![(Access::Uniform, "rounds", "vec4<u32>"), (Access::Write, "sums", ROWS)],
        constants: vec![],
        parts: vec![include_str!("measure/multiply.wgsl")],
    }
}

/// The highest rates that a device reached.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ceilings {
    /// Bytes per second, read and written together.
    pub bytes: f64,
    /// Operations in single precision per second.
    pub flops: f64,
    /// Number of bytes copied at once.
    pub copied: u64,
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

/// Measures the highest rates of a device with buffers of `bytes`; a measurement takes at least `least`
/// seconds.
pub fn ceilings(gpu: &Gpu, bytes: u64, least: f64) -> Result<Ceilings, EngineError> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::tests::validate;
    use crate::test_support::software;

    #[test]
    fn the_kernels_are_valid() {
        [copy(), multiply()].iter().for_each(validate);
    }

    #[test]
    fn ceilings_are_found() {
        let Some(gpu) = software() else { return };
        let found = ceilings(&gpu, 1 << 20, 1e-4).unwrap();
        assert!(
            found.bytes > 1e6 && found.bytes < 1e14 && found.flops > 1e6 && found.flops < 1e16,
            "{found:?}"
        );
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
}
