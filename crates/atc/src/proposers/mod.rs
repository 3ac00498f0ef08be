//! Proposers: 2D underwater enhancers that process one photograph at a time.
//!
//! The result of a proposer is never a target. The extractor turns it into a transition, the calibrator
//! corrects it towards the paired data, and the consensus makes one scene operator of all views. A
//! calibrator is fitted for one proposer and records its name and digest; use with another proposer is an
//! error (R25).

pub mod fusion;

use serde::{Deserialize, Serialize};
use use3d_capture::Image;

use crate::error::AtcError;

pub use fusion::Fusion;

/// A deterministic function from a photograph to an enhanced version of it.
pub trait Proposer: Sync {
    /// A short fixed name, e.g. `fusion`.
    fn name(&self) -> &str;

    /// The identity of this proposer among those of the same name: the digest of its weights, or the
    /// version of its formula.
    fn digest(&self) -> String;

    /// An enhanced image of the same size, from which a transition is extracted; display range, not
    /// necessarily within `[0, 1]`. A network may process a smaller version, because transitions are smooth
    /// and do not depend on detail.
    fn propose(&self, image: &Image) -> Result<Image, AtcError>;

    /// An enhanced image of the same size at full detail, for display: the result of this enhancer alone,
    /// used in comparisons and to train scenes for comparison. By default it is the proposal.
    fn enhance(&self, image: &Image) -> Result<Image, AtcError> {
        self.propose(image)
    }

    /// Name and digest.
    fn id(&self) -> ProposerId {
        ProposerId { name: self.name().to_string(), digest: self.digest() }
    }
}

/// The proposer to which a calibrator belongs.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProposerId {
    /// [`Proposer::name`].
    pub name: String,
    /// [`Proposer::digest`]; empty if a calibrator does not record it.
    pub digest: String,
}

impl ProposerId {
    /// Returns an error unless `used` is this proposer. An empty digest on either side means that it was
    /// not recorded.
    pub fn require(&self, used: &ProposerId) -> Result<(), AtcError> {
        let unrecorded = self.digest.is_empty() || used.digest.is_empty();
        if self.name == used.name && (unrecorded || self.digest == used.digest) {
            return Ok(());
        }
        Err(AtcError::ProposerMismatch {
            calibrator_proposer: self.name.clone(),
            calibrator_digest: self.digest.clone(),
            proposer: used.name.clone(),
            digest: used.digest.clone(),
        })
    }
}
