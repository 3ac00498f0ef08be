//! The errors of work that a user asked for, by the party that can help: the user, the program, or time.

use std::fmt::Display;

use use3d_cluster::ClusterError;
use use3d_prepare::PrepareError;
use use3d_workflow::place::PlaceError;

/// The reason why work ended early. Messages name file, field, expectation and next step.
#[derive(Debug, thiserror::Error)]
pub enum WorkError {
    /// Wrong usage or bad input.
    #[error("{0}")]
    Input(String),
    /// A failure of the program's own work.
    #[error("{0}")]
    Failed(String),
    /// Interrupted; the work so far is kept.
    #[error("interrupted; the work done so far is kept: run the same command to continue")]
    Interrupted,
    /// Ended at the time limit; the same command continues.
    #[error("time limit reached; the work done so far is kept: run the same command to continue")]
    OutOfTime,
    /// Interrupted in work that keeps no partial result.
    #[error("interrupted; nothing was kept: the same command starts from the beginning")]
    Stopped,
}

impl WorkError {
    /// Bad input, from any error with a message.
    pub fn input(error: impl Display) -> Self {
        Self::Input(error.to_string())
    }

    /// A failure of the program's own work, from any error with a message.
    pub fn failed(error: impl Display) -> Self {
        Self::Failed(error.to_string())
    }
}

/// A place refused before any work is bad input; a failed write is [`WorkError::failed`].
impl From<PlaceError> for WorkError {
    fn from(error: PlaceError) -> Self {
        Self::input(error)
    }
}

/// A submission that cannot be planned is bad input; one that cannot be written or sent is
/// [`WorkError::failed`].
impl From<ClusterError> for WorkError {
    fn from(error: ClusterError) -> Self {
        Self::input(error)
    }
}

impl From<PrepareError> for WorkError {
    fn from(error: PrepareError) -> Self {
        match error {
            PrepareError::Interrupted => Self::Interrupted,
            PrepareError::Step { .. } | PrepareError::NoCameras { .. } => Self::failed(error),
            _ => Self::input(error),
        }
    }
}
