//! The time that kernels take: the device's clock is read before and after every dispatch, if the device
//! supports it.

use std::sync::{Mutex, PoisonError};

/// Number of times that one reading holds: two per dispatch.
const PLACES: u32 = 4096;

/// Time of a kernel over some steps.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct KernelTime {
    /// Number of dispatches.
    pub dispatches: u64,
    /// Total time in seconds.
    pub seconds: f64,
}

/// Times that were recorded and not yet read.
#[derive(Debug)]
pub(crate) struct Clock {
    pub(crate) set: wgpu::QuerySet,
    pub(crate) resolved: wgpu::Buffer,
    /// The kernel or pass of every pair of places.
    pub(crate) names: Mutex<Vec<&'static str>>,
    timed: Timed,
}

/// The unit of work before and after which a clock is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Timed {
    /// Every dispatch; this keeps the dispatches of a pass separate.
    Dispatches,
    /// Every pass of steps; this costs the steps nothing.
    Passes,
}

impl Timed {
    /// The features that this kind of clock needs.
    pub(crate) fn features(self) -> wgpu::Features {
        match self {
            Self::Dispatches => features(),
            Self::Passes => wgpu::Features::TIMESTAMP_QUERY,
        }
    }
}

/// The features that a clock of dispatches needs.
pub(crate) fn features() -> wgpu::Features {
    wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::TIMESTAMP_QUERY_INSIDE_PASSES
}

impl Clock {
    /// A clock of a device that has the features for it.
    pub(crate) fn new(device: &wgpu::Device, timed: Timed) -> Self {
        let (label, ty, count) = (Some("times"), wgpu::QueryType::Timestamp, PLACES);
        Self {
            set: device.create_query_set(&wgpu::QuerySetDescriptor { label, ty, count }),
            resolved: device.create_buffer(&wgpu::BufferDescriptor {
                label,
                size: 8 * u64::from(PLACES),
                usage: wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC,
                mapped_at_creation: false,
            }),
            names: Mutex::default(),
            timed,
        }
    }

    /// Records the time before a dispatch; returns the argument for [`Clock::after`].
    pub(crate) fn before(&self, pass: &mut wgpu::ComputePass<'_>, name: &'static str) -> Option<u32> {
        let place = self.place(Timed::Dispatches, name)?;
        pass.write_timestamp(&self.set, place);
        Some(place + 1)
    }

    /// Reserves a pair of places for the times around a kernel or a pass.
    fn place(&self, timed: Timed, name: &'static str) -> Option<u32> {
        let mut names = self.names.lock().unwrap_or_else(PoisonError::into_inner);
        let place = 2 * names.len() as u32;
        if self.timed != timed || place + 1 >= PLACES {
            return None; // the clock was not read for long: the rest is not timed
        }
        names.push(name);
        Some(place)
    }

    /// The places for the times at which a pass begins and ends.
    pub(crate) fn around(&self, name: &'static str) -> Option<wgpu::ComputePassTimestampWrites<'_>> {
        let place = self.place(Timed::Passes, name)?;
        Some(wgpu::ComputePassTimestampWrites {
            query_set: &self.set,
            beginning_of_pass_write_index: Some(place),
            end_of_pass_write_index: Some(place + 1),
        })
    }

    /// Records the time after a dispatch.
    pub(crate) fn after(&self, pass: &mut wgpu::ComputePass<'_>, place: Option<u32>) {
        if let Some(place) = place {
            pass.write_timestamp(&self.set, place);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::test_support::software;
    use crate::twins::LossCase;

    #[test]
    fn every_dispatch_is_timed_once() {
        let Some(gpu) = software() else { return };
        let gpu = gpu.timed(Timed::Dispatches);
        assert!(gpu.clock.is_some(), "the software adapter has a clock");
        let case = LossCase { width: 61, height: 47, seed: 1, mask: true, prior: true, gains: true };
        crate::twins::losses(&gpu, &case).unwrap();
        let mut times = BTreeMap::new();
        gpu.read_times(&mut times).unwrap();
        assert_eq!(times["weigh"].dispatches, 1);
        assert_eq!(times["compare"].dispatches, 3, "three levels of 61 × 47");
        assert!(times.values().all(|time| time.seconds >= 0.0 && time.seconds < 60.0));
        let before = times.clone();
        gpu.read_times(&mut times).unwrap();
        assert_eq!(times, before);
    }
}
