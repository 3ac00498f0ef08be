//! How the loops of this crate say where they are, and how a caller asks them to stop.

use std::ops::ControlFlow;

use crate::error::AtcError;

/// Where a loop is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Progress<'a> {
    /// About to look at a pair of photographs.
    Pair {
        /// Its index, from 0.
        index: usize,
        /// Its name.
        name: &'a str,
    },
    /// Finished a training step of the calibrator.
    Step {
        /// The step, from 1.
        step: u64,
        /// Steps in all.
        steps: u64,
        /// Loss of this step, interquartile units.
        loss: f64,
    },
    /// About to extract the transition of a view.
    View {
        /// Its index, from 0.
        index: usize,
        /// Its name.
        name: &'a str,
    },
    /// About to lift the local operators of a view to the Gaussians.
    Lift {
        /// Its index, from 0.
        index: usize,
        /// Views in all.
        views: usize,
    },
}

/// Called at every [`Progress`]; `Break` stops the loop with [`AtcError::Stopped`].
pub type Watch<'a> = dyn FnMut(Progress<'_>) -> ControlFlow<()> + 'a;

/// A watch that never stops anything.
pub fn unwatched(_: Progress<'_>) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

pub(crate) fn report(watch: &mut Watch<'_>, progress: Progress<'_>) -> Result<(), AtcError> {
    match watch(progress) {
        ControlFlow::Continue(()) => Ok(()),
        ControlFlow::Break(()) => Err(AtcError::Stopped),
    }
}
