//! The parameters of single training views on the device, with Adam's moments: see
//! `use3d_reconstruct::ViewParameters`.

use use3d_reconstruct::ViewParameters;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::device::Gpu;

/// The parameters of all training views; no rows if no view has any.
#[derive(Debug)]
pub(crate) struct PerView {
    /// Numbers of a row.
    width: usize,
    /// Three runs of views × width numbers: values, first and second moments.
    pub(crate) state: Array<f32>,
    /// Number of Adam's steps of each view.
    pub(crate) steps: Vec<u64>,
}

impl PerView {
    /// Copies a state's parameters to the device, where they are called `what`.
    pub(crate) fn new(gpu: &Gpu, what: &'static str, from: &ViewParameters) -> Result<Self, EngineError> {
        let values = [&from.values[..], &from.first, &from.second].concat();
        Ok(Self { width: from.width, state: Array::from(gpu, what, &values)?, steps: from.steps.clone() })
    }

    /// Reverts the count of a view's step that was not done and will be requested again.
    pub(crate) fn undo(&mut self, row: usize) {
        if let Some(steps) = self.steps.get_mut(row) {
            *steps = steps.saturating_sub(1);
        }
    }

    /// Copies the parameters back.
    pub(crate) fn read(&self, gpu: &Gpu) -> Result<ViewParameters, EngineError> {
        let run = self.width * self.steps.len();
        let values = self.state.read(gpu, 3 * run)?;
        let part = |k: usize| values[run * k..run * (k + 1)].to_vec();
        Ok(ViewParameters {
            width: self.width,
            values: part(0),
            first: part(1),
            second: part(2),
            steps: self.steps.clone(),
        })
    }
}
