//! The scene's targets: one global operator, and one local operator per Gaussian. All training views
//! contribute to them.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_atc::consensus::{Preview, Recorder, TargetsParams, targets_from_records};
use use3d_atc::progress::LoopPosition;
use use3d_capture::View;
use use3d_io_image::{write_png, write_png_map};
use use3d_splat::Rasterizer;
use use3d_workflow::{Figure, Scope, Stage, StageContext, StageError};

use super::calibrated::is_calibrated;
use super::captured::capture;
use super::common::{folder, go_on, write, write_json};
use super::kept_water::KeptWaterChoice;
use super::names::{CALIBRATED, TARGETS};
use super::proposals::asked_for;
use super::proposer::ProposerChoice;
use super::scenes::scene;
use super::starts::Starts;
use crate::engines::{self, EngineChoice};

/// The pictures that transitions start from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub(super) enum Source {
    /// The photographs, as in the paper.
    Photographs,
    /// Stage 1's renders with part of the water taken away; the photographs where all of it is kept.
    #[default]
    Renders,
    /// Stage 1's renders without water, to measure colour: `enhanced-clear` is then the result.
    Clear,
}

/// Parameters of the targets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Params {
    /// The proposer. `auto` is the one that the calibrator was fitted for (another one is refused), or
    /// without a calibrator as in `pairs`.
    pub(super) proposer: ProposerChoice,
    /// The pictures that transitions start from.
    pub(super) source: Source,
    /// The share of the water in renders that transitions start from, which the enhanced scene then keeps:
    /// `"auto"`, one number from 0 to 1, or three (red, green, blue). For `source = "renders"`.
    pub(super) kept_water: KeptWaterChoice,
    /// Correct the proposals with a calibrator that was fitted to pairs of images. On as soon as the pipeline
    /// names pairs, a calibrator or a parameter of its fit.
    pub(super) calibrated: bool,
    /// Parameters of the consensus.
    pub(super) consensus: TargetsParams,
    /// Number of views shown side by side: captured (or clear), proposal, calibrated on its own, consensus.
    pub(super) previews: usize,
    /// The engine that lifts views to the Gaussians: `cpu`; `auto` (a graphics card that passed its check,
    /// else the processor); `gpu`; `gpu:NAME`.
    #[schemars(with = "String")]
    pub(super) engine: EngineChoice,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            proposer: ProposerChoice::Auto,
            source: Source::default(),
            kept_water: KeptWaterChoice::default(),
            calibrated: false,
            consensus: TargetsParams::default(),
            previews: 4,
            engine: EngineChoice::Cpu,
        }
    }
}

impl Params {
    /// The problem of parameters that contradict each other, and the setting that solves it.
    pub(super) fn conflict(&self) -> Option<(&'static str, &'static str)> {
        if self.source != Source::Renders && self.kept_water != KeptWaterChoice::default() {
            let problem = "`kept_water` is the share of the water in renders; add `source = \"renders\"`";
            return Some((problem, "--set targets.source=renders"));
        }
        None
    }
}

/// The largest difference between two classes of arithmetic: a Gaussian at the edge of the visible region may
/// be visible in only one of them.
const FIGURES: [Figure; 1] = [Figure { file: "report.json", at: "/supported", within: 20.0 }];

pub(super) fn stage() -> Stage {
    Stage::new("targets", Scope::Scene, run)
        .about("appearance transition consensus: scene-global and Gaussian-local targets")
        .made_of(&[], &["src/stages/targets.rs"])
        .promises(&[TARGETS, "report.json"])
        .when(|all| !asked_for(all))
        .input("import", "import")
        .input("scene", "reconstruct")
        .input("calibrator", "calibrate")
        .or_external("calibrator")
        .only_when(is_calibrated)
        .optional_external("models", "models")
        .select(super::weights::files_of_proposer)
        .seeded()
        .check(|p: &Params| p.kept_water.check())
        .check(|p: &Params| engines::check(&p.engine))
        .computes_on(|p: &Params| engines::class(&p.engine))
        .without_effect(&["engine"])
        .agrees_across_classes(&FIGURES)
        .cost(0, 2 << 30)
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let scene = scene(context, "scene")?;
    let views: Vec<&View> = capture.training_views().collect();
    let mut starts = Starts::open(context, params, &scene, &views)?;
    let total = 2 * views.len() as u64;
    let mut recorder = Recorder::default();
    let mut records = Vec::with_capacity(views.len());
    for (i, view) in views.iter().enumerate() {
        context.alive()?;
        context.progress_with(i as u64, total, "views", "proposals and transitions");
        let input = starts.view(view)?;
        records.push(recorder.record(&input, starts.proposals(), &starts.calibrator)?);
    }
    let consensus = TargetsParams { seed: context.seed(), ..params.consensus.clone() };
    let (mut lift, chosen) = engines::lift(&scene.gaussians, &params.engine).map_err(StageError::failed)?;
    chosen.into_iter().for_each(|chosen| context.say(chosen));
    let built = targets_from_records(
        &mut lift,
        &records,
        starts.shown(),
        starts.proposer.clone(),
        &starts.calibrator,
        &consensus,
        &mut |progress| {
            if let LoopPosition::Lift { index, .. } = progress {
                let done = (views.len() + index) as u64;
                context.progress_with(done, total, "views", "lifting to the Gaussians");
            }
            go_on(context)
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
    write(&context.output().join(TARGETS), targets.to_bytes()?)?;
    write_json(&context.output().join("report.json"), &report)?;
    write_json(&context.output().join(CALIBRATED), &starts.calibrator.provenance)?;

    let shown = params.previews.min(views.len());
    if shown > 0 {
        let (sheets, support) = (context.output().join("previews"), context.output().join("support"));
        folder(&sheets)?;
        folder(&support)?;
        let mut rasterizer = Rasterizer::new();
        for k in 0..shown {
            context.alive()?;
            let i = k * views.len() / shown;
            let input = starts.view(views[i])?;
            let (gaussians, record, proposals) = (&scene.gaussians, &records[i], starts.proposals());
            let calibrator = &starts.calibrator;
            let preview =
                Preview::new(gaussians, &input, record, proposals, calibrator, &targets, &mut rasterizer)?;
            let name = format!("{}.png", views[i].flat_stem());
            write_png(&sheets.join(&name), &preview.sheet())?;
            write_png_map(&support.join(&name), &preview.support)?;
        }
    }
    Ok(())
}
