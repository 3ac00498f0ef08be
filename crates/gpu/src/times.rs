//! Reads the clock of a device.

use std::collections::BTreeMap;
use std::sync::PoisonError;

use use3d_training::EngineError;

use crate::buffer::fetch;
use crate::device::Gpu;
use crate::profile::KernelTime;

impl Gpu {
    /// Adds the kernels' times since the last call to `times`, after all submitted work is done. Does
    /// nothing if the device has no clock.
    pub fn read_times(&self, times: &mut BTreeMap<&'static str, KernelTime>) -> Result<(), EngineError> {
        let Some(clock) = &self.clock else { return Ok(()) };
        let names = std::mem::take(&mut *clock.names.lock().unwrap_or_else(PoisonError::into_inner));
        if names.is_empty() {
            return Ok(());
        }
        let mut ticks = vec![[0u64; 2]; names.len()];
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.resolve_query_set(&clock.set, 0..2 * names.len() as u32, &clock.resolved, 0);
        self.submit(encoder);
        fetch(self, &mut [(&clock.resolved, bytemuck::cast_slice_mut(&mut ticks))])?;
        let tick = f64::from(self.queue.get_timestamp_period()) * 1e-9;
        for (name, [began, ended]) in names.into_iter().zip(ticks) {
            let time = times.entry(name).or_default();
            time.dispatches += 1;
            time.seconds += ended.saturating_sub(began) as f64 * tick;
        }
        Ok(())
    }
}
