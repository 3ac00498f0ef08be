//! Everything that can go wrong in this crate, with what to do about it.

use use3d_numerics::range::OutOfRange;

use crate::extractor::Form;

/// An error of Appearance Transition Consensus.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum AtcError {
    /// An image that cannot be looked at.
    #[error("the {role} image is {width}x{height}; both sides must be at least 1 pixel")]
    EmptyImage {
        /// Source, target or proposal.
        role: &'static str,
        /// Width found.
        width: usize,
        /// Height found.
        height: usize,
    },
    /// A source with a NaN or an infinity in it.
    #[error("the source image has a value that is not finite; check how the image was made")]
    NonFiniteSource,
    /// An image of another size than the extractor's geometry.
    #[error("the image is {found_width}x{found_height}, but the extractor was set up for {width}x{height}")]
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
    /// Extractor settings out of range.
    #[error(transparent)]
    Setting(#[from] OutOfRange),
    /// The proposer failed.
    #[error("the proposer `{proposer}` failed: {message}")]
    Proposer {
        /// Its name.
        proposer: String,
        /// What it said.
        message: String,
    },
    /// A calibrator that was fitted for another proposer.
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
    /// Too few usable pairs.
    #[error(
        "{usable} usable pairs of {offered}; at least {needed} are needed to fit a calibrator{}",
        .first_problem.as_ref().map(|p| format!(" (first problem: {p})")).unwrap_or_default()
    )]
    TooFewPairs {
        /// Pairs that could be used.
        usable: usize,
        /// Pairs offered.
        offered: usize,
        /// Pairs needed.
        needed: usize,
        /// Why the first unusable pair could not be used.
        first_problem: Option<String>,
    },
    /// Training left the finite numbers.
    #[error("calibrator training diverged at step {step}: the loss is {loss}")]
    Diverged {
        /// Step, from 1.
        step: u64,
        /// Loss there.
        loss: f64,
    },
    /// The caller asked to stop.
    #[error("stopped on request")]
    Stopped,
    /// A file or set of tensors that does not hold what it should.
    #[error("{what}: {problem}")]
    Artifact {
        /// Which artifact, and which part of it.
        what: String,
        /// What was expected and found.
        problem: String,
    },
    /// No views to make targets from.
    #[error("there are no views to build targets from; the capture needs at least one training view")]
    NoViews,
    /// A view that cannot be used.
    #[error("view `{view}`: {problem}")]
    View {
        /// Its name.
        view: String,
        /// What is wrong.
        problem: String,
    },
    /// Targets and scene or calibrator do not belong together.
    #[error("the targets are for {targets}, but {found} was given; build the targets again for this scene")]
    TargetsMismatch {
        /// What the targets are for.
        targets: String,
        /// What was given.
        found: String,
    },
    /// Another device than the processor gave up.
    #[error("`{device}` failed: {problem}")]
    Device {
        /// Its name.
        device: String,
        /// What it said.
        problem: String,
    },
    /// Two parts of the method that use different local forms.
    #[error("the local operators are in {found} form, but {expected} form is needed")]
    Form {
        /// Form expected.
        expected: Form,
        /// Form found.
        found: Form,
    },
}

impl AtcError {
    /// An [`AtcError::Artifact`].
    pub(crate) fn artifact(what: impl Into<String>, problem: impl Into<String>) -> Self {
        Self::Artifact { what: what.into(), problem: problem.into() }
    }
}
