//! Proposers: 2D underwater enhancers that look at one photograph at a time.
//!
//! What a proposer yields is never a target. The extractor turns it into a transition, the calibrator
//! corrects that towards what paired data say, and the consensus makes one scene operator of all views. A
//! calibrator is fitted for one proposer and records its name and digest; another proposer with it is an
//! error (R25).
//!
//! [`scene`] is another kind: it starts from what stage 1 knows of a view, not from a photograph, so it is
//! not behind the trait.

pub mod fusion;
pub mod scene;

use serde::{Deserialize, Serialize};
use use3d_capture::Image;

use crate::error::AtcError;

pub use fusion::Fusion;
pub use scene::{SceneFindings, SceneProposer, SceneSurvey, SceneView};

/// A deterministic function from a photograph to an enhanced version of it.
pub trait Proposer: Sync {
    /// A short fixed name, e.g. `fusion`.
    fn name(&self) -> &str;

    /// What makes this proposer give other results than one of the same name: the digest of its weights, or
    /// the version of its formula.
    fn digest(&self) -> String;

    /// An enhanced image of the same size, for a transition to be extracted from; display range, not
    /// necessarily within `[0, 1]`. A network may look at a smaller version: transitions are smooth,
    /// detail does not matter to them.
    fn propose(&self, image: &Image) -> Result<Image, AtcError>;

    /// An enhanced image of the same size at full detail, to be looked at: what this enhancer gives on its
    /// own, which is what a comparison shows and what scenes for comparison are learnt from. The same as
    /// a proposal unless the enhancer says otherwise.
    fn enhance(&self, image: &Image) -> Result<Image, AtcError> {
        self.propose(image)
    }

    /// Name and digest.
    fn id(&self) -> ProposerId {
        ProposerId { name: self.name().to_string(), digest: self.digest() }
    }
}

/// Which proposer a calibrator belongs to.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProposerId {
    /// [`Proposer::name`].
    pub name: String,
    /// [`Proposer::digest`]; empty where a calibrator does not record it.
    pub digest: String,
}

impl ProposerId {
    /// An error unless `used` is this proposer. An empty digest on either side means that it was not
    /// recorded.
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
