//! The proposals of all views as images, for the comparison that enhances every photograph and then
//! reconstructs a scene from the enhanced images.
//!
//! It runs only if stage 1 learns from proposals (`reconstruct.images = "proposed"`); such a scene needs no
//! second stage.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_import::load_pixels;
use use3d_io_image::write_png;
use use3d_workflow::{StageContext, StageError};

use crate::parts::captured::capture;
use crate::parts::files::proposal_of;
use crate::parts::proposer::{ProposerChoice, open};

/// Parameters of the proposals.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Params {
    /// The proposer; `auto` as in `pairs`.
    pub(crate) proposer: ProposerChoice,
}

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_workflow::{Scope, Stage};

    use crate::parts::weights::{files_of_proposer, proposer_files};
    use crate::planning::learns_from_proposals;
    use crate::planning::memory::{NETWORK_PER_PIXEL, PROGRAM, largest, networks};
    use crate::planning::requirements::weights;

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("propose", Scope::Scene, run)
            .about("correct every photograph on its own, to learn the scene from them")
            .input("import", "import")
            .optional_external("models", "models")
            .select(|p: &Params, models| files_of_proposer(p.proposer, models))
            .when(learns_from_proposals)
            .requires(|all, named, _| {
                let own = all.of::<Params>().map_or_else(Default::default, |p| p.proposer);
                weights(all, named, ("propose", own)).into_iter().collect()
            })
            .cost(0, 4 << 30)
            .memory(|_: &Params, inputs| {
                let pixels = largest(inputs)?;
                Some(PROGRAM + 120 * pixels + networks(inputs, proposer_files, NETWORK_PER_PIXEL * pixels))
            })
    }
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let proposer = open(params.proposer, context.optional_input("models"), &mut |line| context.log(line))?;
    for (i, view) in capture.views.iter().enumerate() {
        context.alive()?;
        context.progress_with(i as u64, capture.views.len() as u64, "views", &view.name);
        let proposal = proposer.enhance(&load_pixels(view)?.to_image())?;
        write_png(&proposal_of(context.output(), view), &proposal)?;
    }
    Ok(())
}
