//! When targets need a calibrator.
//!
//! Apart from what proposes, so that the calibrator is not made of the proposers' code.

use use3d_build::AllParameters;

/// Whether targets start from photographs, whose transitions a calibrator corrects.
pub(super) fn is_calibrated(all: &AllParameters) -> bool {
    all.get("targets").is_none_or(|targets| targets["proposer"] != "scene")
}
