//! The knowledge of several stages about when they run and what they need. No byte of a result follows from
//! this folder or from the module `definition` of a stage, so neither is part of a key.

pub(crate) mod expected;
pub(crate) mod memory;
pub(crate) mod requirements;

use use3d_reconstruct::{Images, ReconstructParams};
use use3d_workflow::{AllParameters, Named};

use crate::parts::target_params;

/// True if stage 1 learns from proposals. Such a scene needs no second stage.
pub(crate) fn learns_from_proposals(all: &AllParameters) -> bool {
    all.of::<ReconstructParams>().is_some_and(|p| p.images == Images::Proposed)
}

/// True if a calibrator corrects the proposals.
pub(crate) fn is_calibrated(all: &AllParameters) -> bool {
    all.of::<target_params::Params>().is_some_and(|p| p.calibrated)
}

/// True if a calibrator is needed and none is given.
pub(crate) fn learns_a_calibrator(all: &AllParameters, named: &Named) -> bool {
    is_calibrated(all) && !named.has("calibrator")
}
