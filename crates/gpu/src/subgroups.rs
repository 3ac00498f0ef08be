//! The width of the subgroups with which a device really runs kernels.
//!
//! Many drivers report only a range. Without an extension that no kernel uses here, a kernel runs with one
//! width, which a small kernel reads. A kernel for another width notices it itself, and its results fail the
//! check.

use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::Gpu;
use crate::kernel::{Access, Grid, Kernel, Spec, U32S, bound, submit};

/// Threads of a workgroup: as many as the backward pass has with two pixels per thread.
const THREADS: u32 = 128;
/// Number of workgroups.
const GROUPS: usize = 8;

fn widths() -> Spec {
    Spec {
        name: "widths of subgroups",
        threads: THREADS,
        bindings: vec![(Access::Write, "widths", U32S)],
        constants: vec![],
        parts: vec![include_str!("subgroups.wgsl")],
    }
}

/// The text of the kernel that reads widths.
pub(crate) fn specs() -> Vec<Spec> {
    vec![widths()]
}

/// Returns the width with which the threads of several workgroups run; `None` if they differ.
pub(crate) fn width(gpu: &Gpu) -> Result<Option<u32>, EngineError> {
    let kernel = Kernel::new(gpu, &widths())?;
    let found = Array::<u32>::new(gpu, "widths", GROUPS * THREADS as usize)?;
    submit(gpu, "widths", |pass| kernel.dispatch(pass, Grid::groups(GROUPS), bound![found]))?;
    let found = found.read(gpu, GROUPS * THREADS as usize)?;
    Ok(found.first().copied().filter(|first| found.iter().all(|width| width == first)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_width_is_the_one_that_the_driver_reports() {
        let Some(gpu) = crate::testing::software() else { return };
        let [least, most] = gpu.adapter().subgroup;
        let found = width(&gpu).unwrap();
        assert!(least == most && found == Some(least), "{found:?} of {least} to {most}");
    }
}
