//! What can go wrong in stage 2.

use use3d_atc::AtcError;
use use3d_numerics::range::OutOfRange;
use use3d_training::{CheckpointError, EngineError, NonFinite};
use use3d_ubaf::FieldError;

/// An error of stage 2.
#[derive(Debug, thiserror::Error)]
pub enum EnhanceError {
    /// A parameter outside its range.
    #[error("enhance: {0}")]
    Parameter(OutOfRange),
    /// Sizes of the field that are not supported.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// Nothing to learn from.
    #[error("there are no training views to enhance the scene from; check the capture's split")]
    NoViews,
    /// A scene without Gaussians.
    #[error("the scene has no Gaussians, so there is nothing to enhance; reconstruct it first")]
    EmptyScene,
    /// Guidance of another kind than the objective asks for.
    #[error("the objective `{objective}` needs {needed}; give it or choose another objective")]
    Guidance {
        /// The objective.
        objective: &'static str,
        /// What is missing.
        needed: &'static str,
    },
    /// The targets or the extractor refused.
    #[error(transparent)]
    Transition(#[from] AtcError),
    /// A pseudo-label that cannot be used.
    #[error("pseudo-label of view `{view}`: {problem}")]
    Label {
        /// The view's name.
        view: String,
        /// What is wrong.
        problem: String,
    },
    /// Numbers left the finite range.
    #[error(transparent)]
    NonFinite(#[from] NonFinite),
    /// The engine failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A checkpoint could not be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The observer asked to stop; the checkpoint is written.
    #[error("stopped at step {step} of {steps}{}", if *saved { "; run again to resume" } else { "" })]
    Interrupted {
        /// Steps done.
        step: u64,
        /// Steps in all.
        steps: u64,
        /// Whether a checkpoint holds the state.
        saved: bool,
    },
}
