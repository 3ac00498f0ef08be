//! Stage 1: reconstructs the scene with its water.

use serde::{Deserialize, Serialize};
use use3d_capture::{Capture, View};
use use3d_chart::column;
use use3d_import::{ImportError, Originals, load_depth_prior, load_mask, load_pixels};
use use3d_io_image::write_png;
use use3d_metrics::{Score, likeness_in_words};
use use3d_reconstruct::{
    DepthPrior, Evaluation, Exposure, Images, Known, LoadedView, Medium, MediumPrior, ReconstructError,
    ReconstructParams, growth, memory_need, most_gaussians, reconstruct,
};
use use3d_scene::{Origin, Scene};
use use3d_water::WaterParams;
use use3d_workflow::{Figure, StageContext, StageError};

use crate::engines;
use crate::parts::captured::{capture, imported, write_cameras};
use crate::parts::contact_sheet::sheet;
use crate::parts::curves::stage_1;
use crate::parts::files::{CHOICES, CONTACT, EVALUATION, WATER, proposal_of, write, write_json};
use crate::parts::watch::Watch;
use crate::parts::water::{Judgement, WaterReport, by_verdict, found_water, from_tracks};

/// The file with the training views' gains.
const EXPOSURES: &str = "exposures.json";

/// The largest difference between two trainings in two classes of arithmetic: the scenes differ, but they are
/// equally good.
const FIGURES: [Figure; 2] = [
    Figure { file: EVALUATION, at: "/held_out/psnr/value", within: 0.25 },
    Figure { file: EVALUATION, at: "/held_out/ssim/value", within: 0.01 },
];

/// `choices.json`: the choices that the parameters left open and the run made, as text.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Choices {
    /// The depth prior in force.
    pub depth_prior: String,
    /// The start of the water.
    pub water: String,
}

/// `evaluation.json`.
#[derive(Serialize)]
struct HeldOut<'a> {
    /// The images that the scene was learnt from, and is compared with here.
    learnt_from: Images,
    /// Scores against those images; none if no view is held out.
    held_out: &'a Option<Evaluation>,
}

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_workflow::{Scope, Stage};

    use crate::parts::files::out_of_range;
    use crate::planning::expected::of_training;
    use crate::planning::memory::{PROGRAM, extent, size};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("reconstruct", Scope::Scene, run)
            .about("learn the 3D scene and its water from the photographs")
            .promises(&["scene.json", "gaussians.ply", "training.jsonl"])
            .delivers("scene")
            .check(|p: &ReconstructParams| p.validate().map_err(out_of_range))
            .check(engines::check)
            .computes_on("engine", engines::asked::<ReconstructParams>, engines::class::<ReconstructParams>)
            .input("import", "import")
            .optional_input("proposals", "propose")
            .optional_input("depth", "depth")
            .seeded()
            .resumable(&["iterations"])
            .without_effect(&["checkpoint_steps", "checkpoint_minutes", "engine"])
            .agrees_across_classes(&FIGURES)
            .usually_costs(3.0, 0.0194)
            .expects(|all, named, inputs| {
                of_training((all.of::<ReconstructParams>()?.updates(), 1.0), (all, named), inputs)
            })
            .cost(0, 4 << 30)
            .memory(|p: &ReconstructParams, inputs| {
                Some(PROGRAM + memory_need(&size(&extent(inputs)?), p).likely)
            })
    }
}

/// Loads a view's files at the size of its camera. The pixels are those of `pixels`, another image of the
/// same view.
fn load(view: &View, pixels: &View) -> Result<LoadedView, ImportError> {
    let mask = load_mask(view)?;
    Ok(LoadedView { pixels: load_pixels(pixels)?, mask, depth_prior: load_depth_prior(view)? })
}

/// The depth prior in force with the reason (R14), in a sentence for experts and in one for divers.
fn prior_in_force(params: &ReconstructParams, capture: &Capture, made: bool) -> (String, String) {
    let total = capture.training_views().count();
    let with = capture.training_views().filter(|view| view.depth_prior.is_some()).count();
    let none = "depth prior: none, the depth term is off";
    let networks =
        "the weights of Depth Anything V2 are not in the models folder (`use3d models` names the files)";
    let maps = "pictures of distances (depth maps)";
    let without = format!("no {maps}: going on without, they are optional");
    let by_network = format!("{maps}: those of the network Depth Anything V2 are used");
    match (params.depth_prior, made, with) {
        (DepthPrior::Off, ..) => (format!("{none} (depth_prior = \"off\")"), without),
        _ if !params.uses_priors() => (format!("{none} (depth_weight = 0)"), without),
        (DepthPrior::Auto, true, _) => {
            ("depth prior: Depth Anything V2, since the capture has no depth folder".into(), by_network)
        }
        (_, true, _) => ("depth prior: Depth Anything V2, as depth_prior requires".into(), by_network),
        (DepthPrior::Auto, false, 0) => (
            format!(
                "{none}: the capture has no depth files for its training views (depth/ with the photographs' stems), and {networks}"
            ),
            without,
        ),
        (_, false, 0) => {
            let missing = format!(
                "{none}, although depth_prior requires files: the capture has no depth folder, or none of its \
                 files has the stem of a training view; choose `auto` to make them with Depth Anything V2, or \
                 `off` to train without"
            );
            (missing.clone(), missing)
        }
        (_, false, with) => (
            format!("depth prior: the capture's own files, {with} of {total} training views"),
            format!("{maps}: those of the capture are used"),
        ),
    }
}

/// The water that a training starts from.
#[derive(Default)]
struct Start {
    /// The water and the views' gains, as far as the tracks give them.
    known: Known,
    /// True if the tracks show that there is no water.
    dry: bool,
    /// The sentence that was reported.
    said: String,
    /// The attenuation from the tracks with its standard errors, as words; empty without an estimate.
    attenuation: String,
}

/// The water and the views' gains estimated from the capture's tracks. They are reported and written next to
/// the scene.
fn known_from_tracks(context: &StageContext) -> Result<Start, StageError> {
    let folder = context.input("import")?;
    let imported = imported(context)?;
    let (water, judgement) =
        from_tracks(folder, &imported, &WaterParams::default()).map_err(StageError::bad_input)?;
    // The report has no capture name: the name of an import's folder is not part of its content.
    let report = WaterReport { capture: "capture".into(), ..WaterReport::new(&imported, &water, judgement) };
    write_json(&context.output().join(WATER), &report)?;
    context.log(report.to_string().trim_end());
    context.detail(format!("water from tracks: {}", by_verdict(&report.channels)));
    let so = match judgement.no_water() {
        true => "; the water is off (medium = \"none\")",
        false if judgement == Judgement::Found => "",
        false => " (medium_prior = \"off\")",
    };
    let said = format!("{judgement}{so}");
    context.detail(&said);
    context.say(judgement.in_short());
    let found = found_water(&water, judgement);
    let known = Known { water: found, gains: water.gains };
    Ok(Start { known, dry: judgement.no_water(), said, attenuation: report.attenuation() })
}

/// `exposures.json`: the gain of every training view, learnt with the scene. Renders show the scene without
/// the gains.
#[derive(Serialize)]
struct Exposures<'a> {
    format: &'static str,
    version: u32,
    views: Vec<ViewExposure<'a>>,
}

/// One view's gain for red, green and blue. The geometric mean of the gains over the views is 1.
#[derive(Serialize)]
struct ViewExposure<'a> {
    view: &'a str,
    gain: [f32; 3],
}

fn run(context: &StageContext, params: &ReconstructParams) -> Result<(), StageError> {
    let mut capture = capture(context)?;
    if let Some(depth) = context.optional_input("depth") {
        for view in &mut capture.views {
            let file = depth.join(format!("{}.png", view.flat_stem()));
            view.depth_prior = file.is_file().then_some(file);
        }
    }
    let (prior, in_short) = prior_in_force(params, &capture, context.optional_input("depth").is_some());
    context.detail(&prior);
    context.say(in_short);
    let mut params = ReconstructParams { seed: context.seed(), ..params.clone() };
    // Masks and depth priors always belong to the photographs.
    let mut learnt_from = capture.clone();
    if params.images == Images::Proposed {
        let folder = context.input("proposals")?;
        learnt_from.views.iter_mut().for_each(|view| view.image = proposal_of(folder, view));
    }
    let load = |view: &View| {
        let pixels = learnt_from.views.iter().find(|v| v.name == view.name);
        Ok(load(view, pixels.unwrap_or(view))?)
    };
    let need = memory_need(&(&capture).into(), &params);
    let lower = "lower `reconstruct.max_gaussians`, or `import.size` for smaller images";
    context.needs_memory(need.start, need.most, lower)?;
    let Start { known, dry, said: told, attenuation } = if params.asks_tracks() {
        known_from_tracks(context)?
    } else {
        let learnt = params.medium != Medium::None;
        let said = if learnt { "learnt from the first step on" } else { "none" };
        Start { said: said.into(), ..Start::default() }
    };
    if dry {
        (params.medium, params.medium_prior) = (Medium::None, MediumPrior::Off);
    }
    let watch = &mut Watch(context);
    let outcome = {
        // The engine is dropped at the end of this block: the drawing and writing below needs no moments,
        // views or buffers.
        let (mut engine, chosen) =
            engines::stage1(&params, most_gaussians(&capture, &params)).map_err(StageError::failed)?;
        chosen.into_iter().for_each(|chosen| context.say(chosen));
        reconstruct(&capture, &known, &load, &params, engine.as_mut(), context.checkpoints(), watch)
    };
    let outcome = outcome.map_err(|error| match error {
        ReconstructError::Interrupted { .. } => StageError::Cancelled,
        ReconstructError::NonFinite(_) | ReconstructError::Checkpoint(_) | ReconstructError::Engine(_) => {
            StageError::failed(error)
        }
        // Every other error is caused by the capture or the parameters.
        _ => StageError::bad_input(error),
    })?;
    if let Some(evaluation) = &outcome.evaluation {
        let against = match params.images {
            Images::Captured => "",
            Images::Proposed => " against the 2D enhancer's images, not the photographs",
        };
        let text = |score: &Score, unit: &str, decimals: usize| match score.value() {
            Some(value) => format!("{value:.decimals$}{unit}"),
            None => format!("none ({})", score.reason().unwrap_or_default()),
        };
        let (psnr, ssim) = (text(&evaluation.psnr, " dB", 2), text(&evaluation.ssim, "", 4));
        let count = outcome.scene.gaussians.len();
        context.detail(format_args!("held-out views{against}: PSNR {psnr}, SSIM {ssim}, {count} Gaussians"));
        if let Some(psnr) = evaluation.psnr.value() {
            context.say(likeness_in_words(psnr, ""));
        }
        if let Some(fitted) = &evaluation.fitted {
            let (psnr, ssim) = (text(&fitted.psnr, " dB", 2), text(&fitted.ssim, "", 4));
            context.detail(format_args!(
                "held-out views{against}, after gains fitted on the other half of each view: PSNR {psnr}, SSIM {ssim}"
            ));
        }
    }
    // Times are printed, not stored, so that the artifact is the same on every machine.
    context.profile(&(outcome.profile.table() + &growth(&outcome.growth)));
    let out = context.output();
    outcome.scene.save(out)?;
    let depth_prior = prior.trim_start_matches("depth prior: ").to_string();
    let water = told.trim_start_matches("water from tracks: ").to_string();
    let with_errors = if attenuation.is_empty() { water.clone() } else { format!("{water}; {attenuation}") };
    write_json(&out.join(CHOICES), &Choices { depth_prior, water })?;
    if params.exposure == Exposure::PerView {
        let views = outcome.exposures.iter().map(|(view, gain)| ViewExposure { view, gain: *gain }).collect();
        let exposures = Exposures { format: "3d-use exposures", version: 1, views };
        write_json(&out.join(EXPOSURES), &exposures)?;
    }
    Origin { water: Some(with_errors), ..Origin::of(&capture) }.write(out)?;
    let world = use3d_import::prepared_world(context.input("import")?).map_err(StageError::bad_input)?;
    if let Some(world) = world {
        Scene::set_world(out, &world)?;
    }
    Originals::hand_on(context.input("import")?, out).map_err(StageError::bad_input)?;
    write_cameras(out, &capture)?;
    if let Some(sheet) = sheet(&learnt_from, &outcome.scene)? {
        write_png(&out.join(CONTACT), &sheet)?;
    }
    write(&out.join("training.jsonl"), outcome.log_lines())?;
    let curves = stage_1(&outcome.log_lines()).map(|(plot, _)| plot);
    write(&out.join("training.svg"), column(&curves))?;
    write_json(&out.join(EVALUATION), &HeldOut { learnt_from: params.images, held_out: &outcome.evaluation })
}
