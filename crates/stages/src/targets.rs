//! The scene's targets: one global operator, and one local operator per Gaussian. All training views
//! contribute to them.

use use3d_atc::consensus::{Preview, Recorder, TargetsParams, targets_from_records};
use use3d_atc::progress::LoopPosition;
use use3d_capture::View;
use use3d_io_image::{write_png, write_png_map};
use use3d_splat::Rasterizer;
use use3d_workflow::{Figure, StageContext, StageError};

use crate::engines;
use crate::parts::captured::capture;
use crate::parts::files::{CALIBRATED, TARGETS, folder, go_on, write, write_json};
use crate::parts::scene::scene;
use crate::parts::target_params::Params;
use crate::parts::transition_sources::TransitionSources;

/// The largest difference between two classes of arithmetic: a Gaussian at the edge of the visible region may
/// be visible in only one of them.
const FIGURES: [Figure; 1] = [Figure { file: "report.json", at: "/supported", within: 20.0 }];

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_workflow::{AllParameters, Lacking, Named, Scope, Stage};

    use crate::pairs::PairsParams;
    use crate::parts::calibrator::read_calibrator;
    use crate::parts::proposer::{ProposerChoice, of_calibrator};
    use crate::parts::weights::{files_of_proposer, proposer_files};
    use crate::planning::memory::{PROGRAM, gaussians, largest, networks};
    use crate::planning::requirements::{lacking, nu2net, unfound, weights};
    use crate::planning::{is_calibrated, learns_from_proposals};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("targets", Scope::Scene, run)
            .about("find the correction of colours on which all photographs agree")
            .promises(&[TARGETS, "report.json"])
            .delivers("targets")
            .when(|all| !learns_from_proposals(all))
            .input("import", "import")
            .input("scene", "reconstruct")
            .input("calibrator", "calibrate")
            .or_external("calibrator")
            .only_when(is_calibrated)
            .optional_external("models", "models")
            .select(|p: &Params, models| files_of_proposer(p.proposer, models))
            .requires(|all, named, _| missing(all, named).into_iter().collect())
            .seeded()
            .check(|p: &Params| p.kept_water.check())
            .computes_on("engine", |p: &Params| engines::asked(&p.engine), |p| engines::class(&p.engine))
            .without_effect(&["engine"])
            .agrees_across_classes(&FIGURES)
            .usually_costs(1.5, 0.0)
            .cost(0, 2 << 30)
            .memory(|_: &Params, inputs| {
                let network = networks(inputs, proposer_files, 0);
                Some(PROGRAM + 135 * largest(inputs)? + 700 * gaussians(inputs)? + network)
            })
    }

    /// Checks that the calibrator of the targets was fitted for the requested proposer.
    fn missing(all: &AllParameters, named: &Named) -> Option<Lacking> {
        let own = all.of::<Params>()?;
        let choice = own.proposer;
        if named.has("calibrator") {
            if let Some(problem) = unfound(named, "calibrator") {
                return Some(lacking("the calibrator", problem, ""));
            }
            let calibrator = match read_calibrator(named.path("calibrator")?) {
                Ok(calibrator) => calibrator,
                Err(error) => return Some(lacking("a calibrator that can be read", error.to_string(), "")),
            };
            let models = named.path("models").filter(|dir| dir.is_dir());
            if calibrator.proposer.name == "nu2net"
                && matches!(choice, ProposerChoice::Auto | ProposerChoice::Nu2net)
                && let Some(missing) = nu2net(all, named, "targets")
            {
                // A calibrator works only with the enhancer that it was fitted for.
                return Some(Lacking { without: String::new(), ..missing });
            }
            let opened = of_calibrator(choice, &calibrator.proposer.name, models)
                .map_err(|e| e.to_string())
                .and_then(|p| calibrator.proposer.require(&p.id()).map_err(|e| e.to_string()));
            return opened.err().map(|problem| lacking("a calibrator for the proposer in use", problem, ""));
        }
        if let Some((problem, without)) = own.conflict() {
            return Some(lacking("parameters of the targets that go together", problem, without));
        }
        if !is_calibrated(all) {
            return None;
        }
        let fitted = match all.of::<PairsParams>()?.proposer {
            ProposerChoice::Auto if nu2net(all, named, "pairs").is_some() => ProposerChoice::Fusion,
            ProposerChoice::Auto => ProposerChoice::Nu2net,
            other => other,
        };
        if choice == ProposerChoice::Nu2net && nu2net(all, named, "targets").is_some() {
            return weights(all, named, ("targets", choice));
        }
        if choice == ProposerChoice::Auto || choice == fitted {
            return None;
        }
        let [fitted, asked] = [fitted, choice].map(ProposerChoice::name);
        let remedy = format!(
            "the calibrator is fitted for `pairs.proposer`, which is `{fitted}` here, and `targets.proposer` is `{asked}`; give both the same"
        );
        let without = format!("--set targets.proposer={fitted}");
        Some(lacking("a calibrator for the proposer in use", remedy, without))
    }
}

/// A dispersion below this means that the views agree well.
const WELL: f64 = 0.3;

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let scene = scene(context, "scene")?;
    let views: Vec<&View> = capture.training_views().collect();
    let mut starts = TransitionSources::open(context, params, &scene, &views)?;
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
    context.detail(format_args!(
        "consensus of {} views: dispersion {:.4}, {} of {} Gaussians supported",
        report.views.len(),
        report.dispersion,
        report.supported,
        report.gaussians
    ));
    let well = if report.dispersion < WELL { "well" } else { "only in part" };
    context.say(format_args!(
        "{} photographs agree {well} on the colours of the scene ({:.2}; below {WELL} is good)",
        report.views.len(),
        report.dispersion
    ));
    if let Some(order) = &report.order {
        context.detail(format_args!(
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
