//! The errors of stage 2.

use use3d_atc::AtcError;
use use3d_numerics::range::OutOfRange;
use use3d_training::{CheckpointError, EngineError, NonFinite};
use use3d_ubaf::FieldError;

/// An error of stage 2.
#[derive(Debug, thiserror::Error)]
pub enum EnhanceError {
    /// A parameter is outside its range.
    #[error("enhance: {0}")]
    Parameter(OutOfRange),
    /// The sizes of the field are not supported.
    #[error(transparent)]
    Field(#[from] FieldError),
    /// There is nothing to learn from.
    #[error("there are no training views to enhance the scene from; check the capture's split")]
    NoViews,
    /// The scene has no Gaussians.
    #[error("the scene has no Gaussians, so there is nothing to enhance; reconstruct it first")]
    EmptyScene,
    /// The guidance is of another kind than the objective requires.
    #[error("the objective `{objective}` needs {needed}; give it or choose another objective")]
    Guidance {
        /// The objective.
        objective: &'static str,
        /// The missing guidance.
        needed: &'static str,
    },
    /// The targets or the extractor returned an error.
    #[error(transparent)]
    Transition(#[from] AtcError),
    /// A pseudo-label cannot be used.
    #[error("pseudo-label of view `{view}`: {problem}")]
    Label {
        /// The view's name.
        view: String,
        /// The error in the label, or of its source.
        problem: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A number is not finite.
    #[error(transparent)]
    NonFinite(#[from] NonFinite),
    /// The engine failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// A checkpoint could not be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The observer requested a stop; the checkpoint is written.
    #[error("stopped at step {step} of {steps}{}", if *saved { "; run again to resume" } else { "" })]
    Interrupted {
        /// Number of steps done.
        step: u64,
        /// Total number of steps.
        steps: u64,
        /// True if a checkpoint holds the state.
        saved: bool,
    },
}
