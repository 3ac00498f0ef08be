//! The kernels that were compiled for a device.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};

/// A kernel's text, compiled for a device.
#[derive(Clone, Debug)]
pub(crate) struct CompiledText {
    pub(crate) pipeline: wgpu::ComputePipeline,
    pub(crate) layout: wgpu::BindGroupLayout,
}

/// The kernels that were compiled for a device, by their texts: every engine, picture and adjoint on it uses
/// them again.
#[derive(Debug, Default)]
pub(crate) struct CompiledKernels {
    texts: Mutex<HashMap<String, CompiledText>>,
    /// The name of each, and the seconds that its compilation took.
    times: Mutex<Vec<(&'static str, f64)>>,
}

impl CompiledKernels {
    /// The names of the kernels, and the seconds that the compilation of each took.
    pub(crate) fn times(&self) -> Vec<(&'static str, f64)> {
        self.times.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The number of texts that are compiled.
    #[cfg(test)]
    pub(crate) fn texts(&self) -> usize {
        self.texts.lock().unwrap_or_else(PoisonError::into_inner).len()
    }

    pub(crate) fn find(&self, text: &str) -> Option<CompiledText> {
        self.texts.lock().unwrap_or_else(PoisonError::into_inner).get(text).cloned()
    }

    pub(crate) fn keep(&self, text: String, compiled: CompiledText, name: &'static str, seconds: f64) {
        self.texts.lock().unwrap_or_else(PoisonError::into_inner).insert(text, compiled);
        self.times.lock().unwrap_or_else(PoisonError::into_inner).push((name, seconds));
    }

    pub(crate) fn forget<'t>(&self, texts: impl Iterator<Item = &'t String>) {
        let mut kept = self.texts.lock().unwrap_or_else(PoisonError::into_inner);
        texts.for_each(|text| drop(kept.remove(text)));
    }
}
