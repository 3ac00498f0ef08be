//! The scene's targets: one global operator and one local operator per Gaussian, agreed by all training views.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_atc::AtcError;
use use3d_atc::consensus::{Preview, Proposals, Recorder, TargetsParams, ViewInput, targets_from_records};
use use3d_atc::progress::Progress;
use use3d_capture::{Capture, View};
use use3d_io_colmap::load_pixels;
use use3d_io_image::{write_png, write_png_map};
use use3d_splat::Rasterizer;

use super::calibrator::read_calibrator;
use super::captured::capture;
use super::common::{folder, write_json};
use super::names::TARGETS;
use super::proposals::asked_for;
use super::proposer::{ProposerChoice, of_calibrator};
use super::scenes::scene;
use crate::engine::{Scope, Stage, StageContext, StageError};

/// Parameters of the targets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Params {
    /// The 2D enhancer that proposes: `auto` is the one that the calibrator was fitted for, another one is refused.
    pub(super) proposer: ProposerChoice,
    /// The consensus.
    pub(super) consensus: TargetsParams,
    /// Views shown side by side: captured, proposal, calibrated on its own, consensus.
    pub(super) previews: usize,
}

impl Default for Params {
    fn default() -> Self {
        Self { proposer: ProposerChoice::Auto, consensus: TargetsParams::default(), previews: 4 }
    }
}

pub(super) fn stage() -> Stage {
    Stage::new("targets", Scope::Scene, run)
        .about("appearance transition consensus: scene-global and Gaussian-local targets")
        .made_of(&[], &["src/stages/targets.rs"])
        .when(|all| !asked_for(all))
        .input("import", "import")
        .input("scene", "reconstruct")
        .input("calibrator", "calibrate")
        .or_external("calibrator")
        .optional_external("models", "models")
        .select(super::weights::files_of_proposer)
        .seeded()
        .cost(0, 2 << 30)
}

/// A captured view for the consensus.
fn input(view: &View) -> Result<ViewInput, AtcError> {
    let pixels = load_pixels(view)
        .map_err(|e| AtcError::View { view: view.name.to_string(), problem: e.to_string() })?;
    Ok(ViewInput {
        name: view.name.to_string(),
        camera: view.camera,
        image: pixels.to_image(),
        proposal: None,
    })
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture: Capture = capture(context)?;
    let scene = scene(context, "scene")?;
    let calibrator = read_calibrator(context.input("calibrator")?)?;
    let proposer =
        of_calibrator(params.proposer, &calibrator.proposer.name, context.optional_input("models"))
            .map_err(StageError::bad_input_message)?;
    calibrator.proposer.require(&proposer.id()).map_err(StageError::bad_input)?;

    let views: Vec<&View> = capture.training_views().collect();
    let total = 2 * views.len() as u64;
    let mut recorder = Recorder::new();
    let mut records = Vec::with_capacity(views.len());
    for (i, view) in views.iter().enumerate() {
        context.alive()?;
        context.progress_with(i as u64, total, "views", "proposals and transitions");
        records.push(recorder.record(&input(view)?, Proposals::From(proposer.as_ref()), &calibrator)?);
    }
    let consensus = TargetsParams { seed: context.seed(), ..params.consensus.clone() };
    let built = targets_from_records(
        &scene.gaussians,
        &records,
        proposer.id(),
        &calibrator,
        &consensus,
        &mut |progress| {
            if let Progress::Lift { index, .. } = progress {
                context.progress_with(
                    (views.len() + index) as u64,
                    total,
                    "views",
                    "lifting to the Gaussians",
                );
            }
            if context.cancelled() {
                std::ops::ControlFlow::Break(())
            } else {
                std::ops::ControlFlow::Continue(())
            }
        },
    );
    context.alive()?;
    let (targets, report) = built?;
    context.say(format_args!(
        "consensus of {} views: dispersion {:.4}, {} of {} Gaussians supported",
        report.views.len(),
        report.dispersion,
        report.supported,
        report.gaussians
    ));
    if let Some(order) = &report.order {
        context.say(format_args!(
            "another order of the views moves {:.1} % of {} supported Gaussians by less than 0.1 interquartile units (95th percentile {:.3})",
            100.0 * order.within_tenth, order.compared, order.percentile_95
        ));
    }
    let path = context.output().join(TARGETS);
    std::fs::write(&path, targets.to_bytes()?).map_err(|e| StageError::io(&path, e))?;
    write_json(&context.output().join("report.json"), &report)?;

    let shown = params.previews.min(views.len());
    if shown > 0 {
        let (sheets, support) = (context.output().join("previews"), context.output().join("support"));
        folder(&sheets)?;
        folder(&support)?;
        let mut rasterizer = Rasterizer::new();
        for k in 0..shown {
            context.alive()?;
            let i = k * views.len() / shown;
            let preview = Preview::new(
                &scene.gaussians,
                &input(views[i])?,
                &records[i],
                proposer.as_ref(),
                &calibrator,
                &targets,
                &mut rasterizer,
            )?;
            let name = format!("{}.png", views[i].flat_stem());
            write_png(&sheets.join(&name), &preview.sheet())?;
            write_png_map(&support.join(&name), &preview.support)?;
        }
    }
    Ok(())
}
