//! The proposals of all views as images, for the comparison that enhances every photograph and then
//! reconstructs a scene from the enhanced images.
//!
//! It runs only if stage 1 learns from proposals (`reconstruct.images = "proposed"`); such a scene needs no
//! second stage.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_import::load_pixels;
use use3d_io_image::write_png;
use use3d_workflow::{Scope, Stage, StageContext, StageError};

use super::captured::capture;
use super::proposals::{asked_for, file};
use super::proposer::{ProposerChoice, open};

/// Parameters of the proposals.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Params {
    /// The proposer; `auto` as in `pairs`.
    pub(super) proposer: ProposerChoice,
}

pub(super) fn stage() -> Stage {
    Stage::new("propose", Scope::Scene, run)
        .about("enhance every photograph on its own, to reconstruct from")
        .made_of(&[], &["src/stages/propose.rs"])
        .input("import", "import")
        .optional_external("models", "models")
        .select(super::weights::files_of_proposer)
        .when(asked_for)
        .cost(0, 4 << 30)
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let proposer = open(params.proposer, context.optional_input("models"), &mut |line| context.log(line))
        .map_err(StageError::message)?;
    for (i, view) in capture.views.iter().enumerate() {
        context.alive()?;
        context.progress_with(i as u64, capture.views.len() as u64, "views", &view.name);
        let proposal = proposer.enhance(&load_pixels(view)?.to_image())?;
        write_png(&file(context.output(), view), &proposal)?;
    }
    Ok(())
}
