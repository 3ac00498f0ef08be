//! Stage 1: the scene with its water.

use use3d_capture::View;
use use3d_io_colmap::{load_depth_prior, load_mask, load_pixels};
use use3d_io_image::write_png;
use use3d_reconstruct::{Images, LoadedView, ReconstructError, ReconstructParams, growth, reconstruct};
use use3d_scene::Origin;

use super::common::{Watch, capture, write_json, write_text};
use super::contact::sheet;
use super::propose;
use crate::engine::{Scope, Stage, StageContext, StageError};

/// The contact sheet.
pub(super) const CONTACT: &str = "contact.png";

pub(super) fn stage() -> Stage {
    let stage = Stage::new("reconstruct", Scope::Scene, run)
        .about("stage 1: reconstruct the scene with its water")
        .made_of(
            &["use3d-reconstruct", "use3d-io-colmap"],
            &["src/stages/reconstruct.rs", "src/stages/contact.rs"],
        )
        .check(|p: &ReconstructParams| p.validate().map_err(|e| (String::new(), e)))
        .input("import", "import")
        .optional_input("proposals", "propose");
    let stage = if cfg!(feature = "nets") { stage.optional_input("depth", "depth") } else { stage };
    stage.seeded().resumable(&["iterations"]).cost(0, 4 << 30)
}

/// A view's files, at the size of its camera; its pixels are those of `pixels`, another image of the same view.
fn load(view: &View, pixels: &View) -> Result<LoadedView, String> {
    let mask = load_mask(view).map_err(|e| e.to_string())?;
    Ok(LoadedView {
        pixels: load_pixels(pixels).map_err(|e| e.to_string())?,
        alpha: None,
        mask,
        depth_prior: load_depth_prior(view).map_err(|e| e.to_string())?,
    })
}

fn run(context: &StageContext, params: &ReconstructParams) -> Result<(), StageError> {
    let mut capture = capture(context)?;
    if let Some(depth) = context.optional_input("depth") {
        for view in &mut capture.views {
            let file = depth.join(format!("{}.png", view.flat_stem()));
            view.depth_prior = file.is_file().then_some(file);
        }
    }
    // The pipeline's seed moves all of them; a seed of the stage's own is an offset from the default.
    let params = ReconstructParams {
        seed: params.seed.wrapping_add(context.seed()).wrapping_sub(42),
        ..params.clone()
    };
    // Masks and priors are the photographs' in any case.
    let mut learnt_from = capture.clone();
    if params.images == Images::Proposed {
        let proposals = context.input("proposals")?;
        learnt_from.views.iter_mut().for_each(|view| view.image = propose::file(proposals, view));
    }
    let load = |view: &View| {
        let pixels = learnt_from.views.iter().find(|v| v.name == view.name);
        load(view, pixels.unwrap_or(view))
    };
    let outcome = reconstruct(&capture, &load, &params, context.checkpoints(), &mut Watch::new(context));
    let outcome = match outcome {
        Err(ReconstructError::Interrupted { .. }) => return Err(StageError::Cancelled),
        other => other?,
    };
    if let Some(evaluation) = &outcome.evaluation {
        context.say(format_args!(
            "held-out views: {:.2} dB, SSIM {:.4}, {} Gaussians",
            evaluation.psnr,
            evaluation.ssim,
            outcome.scene.gaussians.len()
        ));
    }
    // Times are told, not stored: the artifact is the same on every machine.
    context.profile(&(outcome.profile.table() + &growth(&outcome.growth)));
    let out = context.output();
    outcome.scene.save(out)?;
    Origin::of(&capture).write(out)?;
    if let Some(sheet) = sheet(&learnt_from, &outcome.scene)? {
        write_png(&out.join(CONTACT), &sheet)?;
    }
    write_text(&out.join("training.jsonl"), &outcome.log_lines())?;
    write_text(&out.join("training.svg"), &outcome.plot())?;
    write_json(&out.join("evaluation.json"), &outcome.evaluation)
}
