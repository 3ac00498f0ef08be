//! When stage 1 learns from proposals, and where they are.
//!
//! Apart from the stage that makes them, so that stage 1 is not made of the proposers' code.

use std::path::{Path, PathBuf};

use use3d_capture::View;

use use3d_build::AllParameters;

/// Whether stage 1 learns from proposals.
pub(super) fn asked_for(all: &AllParameters) -> bool {
    all.get("reconstruct").is_some_and(|r| r["images"] == "proposed")
}

/// A view's proposal in the artifact of `propose`.
pub(super) fn file(proposals: &Path, view: &View) -> PathBuf {
    proposals.join(format!("{}.png", view.flat_stem()))
}
