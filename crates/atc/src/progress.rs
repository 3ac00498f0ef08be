//! The progress reports of this crate's loops, and the way in which a caller stops them.

use std::ops::ControlFlow;

use crate::error::AtcError;

/// The position of a loop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LoopPosition<'a> {
    /// The loop is about to process a pair of photographs.
    Pair {
        /// Its index, from 0.
        index: usize,
        /// Its name.
        name: &'a str,
    },
    /// The loop finished a training step of the calibrator.
    Step {
        /// The step, from 1.
        step: u64,
        /// Total number of steps.
        steps: u64,
        /// Loss of this step, interquartile units.
        loss: f64,
    },
    /// The loop is about to lift the local operators of a view to the Gaussians.
    Lift {
        /// Its index, from 0.
        index: usize,
        /// Total number of views.
        views: usize,
    },
}

/// A function that is called at every [`LoopPosition`]; `Break` stops the loop with [`AtcError::Stopped`].
pub type ProgressCallback<'a> = dyn FnMut(LoopPosition<'_>) -> ControlFlow<()> + 'a;

/// A watch that never stops the loop.
pub fn unwatched(_: LoopPosition<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

pub(crate) fn report(watch: &mut ProgressCallback<'_>, progress: LoopPosition<'_>) -> Result<(), AtcError> {
    if watch(progress).is_break() { Err(AtcError::Stopped) } else { Ok(()) }
}
