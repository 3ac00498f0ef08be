//! Photographs on the device.

use std::collections::VecDeque;

use use3d_reconstruct::TrainingView;
use use3d_training::EngineError;

use super::stored::StoredView;
use crate::device::Gpu;

/// The views, and those that are on the device.
#[derive(Debug, Default)]
pub(super) struct Targets {
    pub(super) views: Vec<TrainingView>,
    kept: VecDeque<(usize, StoredView)>,
    bytes: usize,
}

impl Targets {
    /// Puts a view on the device if it is not there yet; returns its place, valid until the next call.
    pub(super) fn place(&mut self, gpu: &Gpu, view: usize) -> Result<usize, EngineError> {
        if let Some(at) = self.kept.iter().position(|(of, _)| *of == view) {
            return Ok(at);
        }
        let stored = StoredView::new(gpu, &self.views[view])?;
        self.bytes += stored.size();
        // The oldest are dropped to make room for new ones.
        while self.bytes > gpu.view_bytes()
            && let Some((_, old)) = self.kept.pop_front()
        {
            self.bytes -= old.size();
            gpu.forget_bindings();
        }
        self.kept.push_back((view, stored));
        Ok(self.kept.len() - 1)
    }

    /// A view on the device.
    pub(super) fn at(&self, place: usize) -> &StoredView {
        &self.kept[place].1
    }

    /// Number of bytes on the device.
    pub(super) fn size(&self) -> usize {
        self.bytes
    }
}
