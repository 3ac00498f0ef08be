//! The width of the subgroups with which a device really runs kernels.
//!
//! Many drivers report only a range. Without an extension that no kernel uses here, a kernel runs with one
//! width, which a small kernel reads. A kernel for another width notices it itself, and its results fail the
//! check.

use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::{AdapterChoice, DeviceError, Gpu, take_first};
use crate::kernel::{Access, Kernel, Spec, U32S, bound, submit};

/// Threads of a workgroup: as many as the backward pass has with two pixels per thread.
const THREADS: u32 = 128;
/// Number of workgroups.
const GROUPS: usize = 8;

/// The kernel that reads widths.
pub(crate) fn widths() -> Spec {
    Spec {
        name: "widths of subgroups",
        threads: THREADS,
        bindings: vec![(Access::Write, "widths", U32S)],
        constants: vec![],
        parts: vec![include_str!("subgroups.wgsl")],
    }
}

/// Returns the width with which the threads of several workgroups run; `None` if they differ.
pub(crate) fn width(gpu: &Gpu) -> Result<Option<u32>, EngineError> {
    let kernel = Kernel::new(gpu, &widths())?;
    let found = Array::<u32>::new(gpu, "widths", GROUPS * THREADS as usize)?;
    submit(gpu, "widths", |pass| kernel.record_groups(pass, GROUPS, bound![found]))?;
    let found = found.read(gpu, GROUPS * THREADS as usize)?;
    Ok(found.first().copied().filter(|first| found.iter().all(|width| width == first)))
}

impl Gpu {
    /// Opens the first adapter that can be opened. A candidate has this number (`#0`), PCI address, UUID or
    /// name, or has it as a part of its name; without a name, all that are not software are candidates.
    pub fn open(name: Option<&str>) -> Result<Self, DeviceError> {
        take_first(name, Self::of, DeviceError::Several)
    }

    /// Opens an adapter, and chooses the kernels for the width of its subgroups.
    pub(crate) fn of(choice: &AdapterChoice) -> Result<Self, DeviceError> {
        let mut gpu = Self::opened(choice)?;
        let has = gpu.device.features().contains(wgpu::Features::SUBGROUP);
        let range = gpu.adapter.subgroup;
        // A driver reports a range in most cases; a kernel finds the width. If that fails, the others are
        // portable.
        gpu.width = match range {
            _ if !has => None,
            [least, most] if least == most => Some(least),
            _ => width(&gpu).ok().flatten(),
        };
        // Software adapters use the portable variant, whose bits do not depend on the vector width.
        if !gpu.adapter.is_software()
            && let Some(variant) = gpu.subgroups()
        {
            gpu.variant = variant;
        }
        Ok(gpu)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_width_is_the_one_that_the_driver_reports() {
        let Some(gpu) = crate::test_support::software() else { return };
        let [least, most] = gpu.adapter.subgroup;
        let found = width(&gpu).unwrap();
        assert!(least == most && found == Some(least), "{found:?} of {least} to {most}");
    }
}
