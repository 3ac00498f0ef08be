//! The test for learning from proposals in stage 1, and the paths of the proposals.
//!
//! This is a file of its own, so that the code of the proposers is not part of stage 1's key.

use std::path::{Path, PathBuf};

use use3d_capture::View;

use use3d_workflow::AllParameters;

/// True if stage 1 learns from proposals.
pub(crate) fn asked_for(all: &AllParameters) -> bool {
    all.get("reconstruct").is_some_and(|r| r["images"] == "proposed")
}

/// The file of a view's proposal in the artifact of `propose`.
pub(crate) fn file(proposals: &Path, view: &View) -> PathBuf {
    proposals.join(format!("{}.png", view.flat_stem()))
}
