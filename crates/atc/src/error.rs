//! All errors of this crate, each with the next step for the user.

use use3d_numerics::range::OutOfRange;

/// An error of Appearance Transition Consensus.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AtcError {
    /// An image without pixels.
    #[error("the {role} image is {width}x{height}; both sides must be at least 1 pixel; check the file")]
    EmptyImage {
        /// Source, target or proposal.
        role: &'static str,
        /// Width found.
        width: usize,
        /// Height found.
        height: usize,
    },
    /// A source image has a NaN or an infinity.
    #[error("the source image has a value that is not finite; check how the image was made")]
    NonFiniteSource,
    /// An image has another size than the extractor's geometry.
    #[error(
        "the image is {found_width}x{found_height}, but the extractor was set up for {width}x{height}; scale the image"
    )]
    Size {
        /// Width found.
        found_width: usize,
        /// Height found.
        found_height: usize,
        /// Width expected.
        width: usize,
        /// Height expected.
        height: usize,
    },
    /// Extractor settings are out of range.
    #[error(transparent)]
    Setting(#[from] OutOfRange),
    /// The proposer failed.
    #[error("the proposer `{proposer}` failed: {message}")]
    Proposer {
        /// Its name.
        proposer: String,
        /// Its error message.
        message: String,
    },
    /// A calibrator was fitted for another proposer.
    #[error(
        "the calibrator was fitted for the proposer `{calibrator_proposer}` ({calibrator_digest}), but `{proposer}` ({digest}) is in use; use the proposer that the calibrator records, or fit a calibrator for this one"
    )]
    ProposerMismatch {
        /// Proposer that the calibrator records.
        calibrator_proposer: String,
        /// Its digest.
        calibrator_digest: String,
        /// Proposer in use.
        proposer: String,
        /// Its digest.
        digest: String,
    },
    /// There are too few usable pairs.
    #[error(
        "{usable} usable pairs of {offered}; at least {needed} are needed to fit a calibrator{}",
        .first_problem.as_ref().map(|p| format!(" (first problem: {p})")).unwrap_or_default()
    )]
    TooFewPairs {
        /// Number of usable pairs.
        usable: usize,
        /// Number of pairs offered.
        offered: usize,
        /// Number of pairs needed.
        needed: usize,
        /// The reason why the first unusable pair could not be used.
        first_problem: Option<String>,
    },
    /// Training reached a number that is not finite.
    #[error("calibrator training diverged at step {step}: the loss is {loss}; lower `learning_rate`")]
    Diverged {
        /// Step, from 1.
        step: u64,
        /// Loss at this step.
        loss: f64,
    },
    /// The caller requested a stop.
    #[error("stopped on request")]
    Stopped,
    /// A file or a set of tensors has unexpected contents.
    #[error("{what}: {problem}")]
    Artifact {
        /// The artifact, and the part of it.
        what: String,
        /// The expected and the found contents.
        problem: String,
    },
    /// There are no views to make targets from.
    #[error("there are no views to build targets from; the capture needs at least one training view")]
    NoViews,
    /// A view cannot be used.
    #[error("view `{view}`: {problem}")]
    View {
        /// Its name.
        view: String,
        /// The error in the view.
        problem: String,
    },
    /// Targets do not belong to the scene or to the calibrator.
    #[error("the targets are for {targets}, but {found} was given; build the targets again for this scene")]
    TargetsMismatch {
        /// The scene or calibrator of the targets.
        targets: String,
        /// The scene or calibrator that was given.
        found: String,
    },
    /// A device other than the processor failed.
    #[error("`{device}` failed: {problem}")]
    Device {
        /// Its name.
        device: String,
        /// Its error message.
        problem: String,
    },
    /// The local operators are in log form, but those of the released calibrator are linear.
    #[error(
        "the local operators are in log form, but linear form is needed: set `extractor.form` to \"linear\""
    )]
    Form,
}

impl AtcError {
    /// An [`AtcError::Artifact`].
    pub(crate) fn artifact(what: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Artifact { what: what.into(), problem: problem.into() }
    }
}
