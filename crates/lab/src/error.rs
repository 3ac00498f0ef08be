//! The errors of measurements.

use std::fmt::Display;

use use3d_workflow::place::PlaceError;

/// The reason why a measurement ended early.
#[derive(Debug, thiserror::Error)]
pub enum LabError {
    /// Bad input, found before any work is done.
    #[error("{0}")]
    Input(String),
    /// A failure of the work.
    #[error("{0}")]
    Failed(String),
    /// A signal; the work so far is kept.
    #[error("interrupted")]
    Interrupted,
}

impl LabError {
    /// Bad input, from any error with a message.
    pub(crate) fn input(error: impl Display) -> Self {
        Self::Input(error.to_string())
    }

    /// A failure, from any error with a message.
    pub(crate) fn failed(error: impl Display) -> Self {
        Self::Failed(error.to_string())
    }
}

/// A place is refused before any work, or cannot be written.
impl From<PlaceError> for LabError {
    fn from(error: PlaceError) -> Self {
        Self::Input(error.to_string())
    }
}
