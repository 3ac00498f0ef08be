//! Tests whether targets need a calibrator.
//!
//! This is a file of its own, so that the code of the proposers is not part of the calibrator's key.

use use3d_workflow::AllParameters;

/// True if a calibrator corrects the proposals.
pub(crate) fn is_calibrated(all: &AllParameters) -> bool {
    all.get("targets").is_some_and(|targets| targets["calibrated"] == true)
}
