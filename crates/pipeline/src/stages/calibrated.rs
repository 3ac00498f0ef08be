//! If targets need a calibrator.
//!
//! Apart from what proposes, so that the calibrator is not made of the proposers' code.

use use3d_build::AllParameters;

/// True if a calibrator corrects the proposals.
pub(super) fn is_calibrated(all: &AllParameters) -> bool {
    all.get("targets").is_some_and(|targets| targets["calibrated"] == true)
}
