//! Held-out views scored: stage 1 against the photographs, every appearance for itself, and neighbouring views for consistency.
//!
//! Rendered images are scored as they are rendered (f32, clamped to the display range), not from files; the `render` stage shows
//! the same images, and both are functions of the same artifacts. Where the capture is synthetic and has its truth beside it,
//! appearances, depth and water are also measured against that ([`crate::truth`]).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_atc::proposers::Proposer;
use use3d_capture::{Capture, Image, Map, View};
use use3d_io_colmap::load_pixels;
use use3d_io_image::write_png;

use super::common::{capture, scene, write_json};
use super::proposer::{ProposerChoice, open};
use crate::engine::{Scope, Stage, StageContext, StageError};
use crate::rendering::{Frame, Mode, SceneRenderer};
use crate::scores::{Method, MethodScores, PairScores, SceneScores, Scores, ViewScores};
use crate::scoring::{Judges, Pairing};
use crate::strip::{Seen, Strip, choose, sheet};
use crate::truth::{Truth, files};

/// The scores' file in its artifact.
pub const SCORES: &str = "scores.json";
/// The consistency strip, and what it shows.
pub const STRIP: (&str, &str) = ("strip.png", "strip.json");

/// Parameters of the evaluation.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Params {
    /// The proposer of the reference row; `auto` as in `pairs`.
    pub(super) proposer: ProposerChoice,
}

pub(super) fn stage() -> Stage {
    Stage::new("evaluate", Scope::Scene, run)
        .about("score the held-out views")
        .made_of(
            PARTS,
            &[
                "src/stages/evaluate.rs",
                "src/stages/proposer.rs",
                "src/rendering.rs",
                "src/scoring.rs",
                "src/scores.rs",
                "src/strip.rs",
                "src/truth.rs",
            ],
        )
        .input("import", "import")
        .input("scene", "reconstruct")
        .optional_input("proposals", "propose")
        .optional_input("enhanced", "enhance")
        .optional_external("models", "models")
        .select(|_, models| Ok(super::judge_files(models)))
        .optional_external("truth", "capture")
        .select(|_, capture| files(capture).map_err(|e| e.to_string()))
        .cost(0, 4 << 30)
}

#[cfg(feature = "nets")]
const PARTS: &[&str] = &["use3d-enhance", "use3d-metrics", "use3d-io-colmap", "use3d-synth", "use3d-nets"];
#[cfg(not(feature = "nets"))]
const PARTS: &[&str] = &["use3d-enhance", "use3d-metrics", "use3d-io-colmap", "use3d-synth"];

/// One held-out view in all its appearances.
struct Appearances {
    images: Vec<(Method, Image)>,
    depth: Map,
    /// Attenuation and backscatter of every ray, where the scene has water.
    water: Option<[Image; 2]>,
}

/// Means of an image's channels.
fn channel_means(image: &Image) -> [f64; 3] {
    image.planes().map(|plane| plane.iter().map(|v| f64::from(*v)).sum::<f64>() / plane.len().max(1) as f64)
}

fn look(
    view: &View,
    renderer: &mut SceneRenderer<'_>,
    proposer: &dyn Proposer,
    learnt: Method,
) -> Result<Appearances, StageError> {
    let captured = load_pixels(view)?.to_image();
    let mut modes = vec![Mode::Reconstruction, Mode::Depth, Mode::Attenuation, Mode::Backscatter];
    if learnt == Method::Reconstruction {
        modes.push(Mode::Clear);
    }
    if renderer.is_enhanced() {
        modes.push(Mode::Enhanced);
    }
    let proposal = proposer.propose(&captured)?;
    let mut images = vec![(Method::Captured, captured), (Method::Proposal, proposal)];
    let mut depth = Map::new(0, 0);
    let mut water = Vec::new();
    for (mode, frame) in modes.iter().zip(renderer.render(&view.camera, &modes)) {
        match (mode, frame) {
            (Mode::Reconstruction, Frame::Color(image)) => images.push((learnt, image)),
            (Mode::Clear, Frame::Color(image)) => images.push((Method::Clear, image)),
            (Mode::Enhanced, Frame::Color(image)) => images.push((Method::Enhanced, image)),
            (Mode::Depth, Frame::Scalar(map)) => depth = map,
            (Mode::Attenuation | Mode::Backscatter, Frame::Color(image)) => water.push(image),
            _ => {}
        }
    }
    Ok(Appearances { images, depth, water: water.try_into().ok() })
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let role = if context.optional_input("enhanced").is_some() { "enhanced" } else { "scene" };
    let scene = scene(context, role)?;
    // What the scene shows as it was learnt: photographs, or proposals.
    let learnt = match context.optional_input("proposals") {
        Some(_) => Method::EnhanceThenReconstruct,
        None => Method::Reconstruction,
    };
    let models = context.optional_input("models");
    let proposer = open(params.proposer, models, &mut |line| context.log(line))
        .map_err(StageError::bad_input_message)?;
    let judges = Judges::open(models);
    let mut renderer = SceneRenderer::new(&scene, 1.0)?;
    let views: Vec<&View> = capture.test_views().collect();
    if views.is_empty() {
        context.say("no view is held out (split.every = 0): nothing to score");
    }

    let size = views.first().map_or((0, 0), |v| (v.camera.intrinsics.width, v.camera.intrinsics.height));
    let truth = match context.optional_input("truth") {
        Some(folder) if !views.is_empty() => Truth::open(folder, size)?,
        _ => None,
    };
    let scale = capture.frame.scale;
    let mut water = [[0.0; 3]; 2];

    let mut per_view: Vec<(Method, Vec<ViewScores>)> = Vec::new();
    let mut per_pair: Vec<(Method, Vec<PairScores>)> = Vec::new();
    let mut previous: Option<Appearances> = None;
    for (i, view) in views.iter().enumerate() {
        context.alive()?;
        context.progress_with(i as u64, views.len() as u64, "views", &view.name);
        let now = look(view, &mut renderer, proposer.as_ref(), learnt)?;
        let captured = &now.images[0].1;
        let true_view = truth.as_ref().map(|t| t.view(view.stem())).transpose()?.flatten();
        for (method, image) in &now.images {
            let mut scores: Scores = judges.alone(image);
            if *method != Method::Captured {
                scores.extend(judges.against(image, captured));
            }
            if let Some(truth) = &true_view {
                if *method == learnt {
                    scores.insert("depth_error".into(), truth.depth_error(&now.depth, scale));
                }
                // The water is still in stage 1's images.
                if *method != Method::Reconstruction {
                    scores.extend(truth.scores(image));
                }
            }
            entry(&mut per_view, *method).push(ViewScores { view: view.name.clone(), scores });
        }
        for (sum, map) in water.iter_mut().zip(now.water.iter().flatten()) {
            let means = channel_means(map);
            (0..3).for_each(|c| sum[c] += means[c] / views.len() as f64);
        }
        if let Some(before) = &previous {
            let earlier = views[i - 1];
            let pairing = Pairing::new(
                &judges,
                (&before.images[0].1, captured),
                (&earlier.camera, &view.camera),
                (&before.depth, &now.depth),
            );
            for ((method, first), (_, second)) in before.images.iter().zip(&now.images) {
                entry(&mut per_pair, *method).push(PairScores {
                    first: earlier.name.clone(),
                    second: view.name.clone(),
                    scores: pairing.scores(&judges, first, second),
                });
            }
        }
        previous = Some(now);
    }
    strip(context, &capture, &mut renderer, proposer.as_ref(), learnt)?;
    let methods = per_view.into_iter().map(|(method, views)| {
        let pairs = per_pair
            .iter_mut()
            .find(|(m, _)| *m == method)
            .map(|(_, p)| std::mem::take(p))
            .unwrap_or_default();
        MethodScores::new(method, views, pairs)
    });
    let scores = SceneScores {
        training_views: capture.split.train.len(),
        held_out_views: views.len(),
        size,
        gaussians: scene.gaussians.len(),
        water: truth.filter(|_| !scene.medium.is_none()).map(|truth| truth.water(water[0], water[1], scale)),
        methods: methods.collect(),
    };
    write_json(&context.output().join(SCORES), &scores)
}

/// The same spot in three neighbouring views: captured, proposed view by view, and as the scene shows it.
fn strip(
    context: &StageContext,
    capture: &Capture,
    renderer: &mut SceneRenderer<'_>,
    proposer: &dyn Proposer,
    learnt: Method,
) -> Result<(), StageError> {
    context.alive()?;
    let held_out = &capture.split.test;
    let middle = held_out.get(held_out.len() / 2).copied().unwrap_or(capture.views.len() / 2);
    let first = middle.saturating_sub(1).min(capture.views.len().saturating_sub(3));
    let views: Vec<&View> = capture.views.iter().skip(first).take(3).collect();
    let looks: Vec<Appearances> =
        views.iter().map(|view| look(view, renderer, proposer, learnt)).collect::<Result<_, _>>()?;
    let seen = views.iter().zip(&looks).map(|(view, look)| Seen {
        camera: &view.camera,
        depth: &look.depth,
        photograph: &look.images[0].1,
    });
    let Some((side, corners)) = choose(&seen.collect::<Vec<_>>()) else {
        context.log("no spot is seen by three neighbouring views: no consistency strip");
        return Ok(());
    };
    let last = if renderer.is_enhanced() { Method::Enhanced } else { learnt };
    let shown = [Method::Captured, Method::Proposal, last];
    let of = |look: &'_ Appearances, method| look.images.iter().position(|(m, _)| *m == method);
    let rows: Vec<Vec<&Image>> = shown
        .iter()
        .map(|method| looks.iter().filter_map(|l| Some(&l.images[of(l, *method)?].1)).collect())
        .collect();
    let (picture, moved) = sheet(&rows, &corners, side);
    write_png(&context.output().join(STRIP.0), &picture)?;
    let rows = shown.iter().map(|m| m.label().to_string()).zip(moved).collect();
    let strip = Strip { views: views.iter().map(|v| v.name.clone()).collect(), rows, side, corners };
    write_json(&context.output().join(STRIP.1), &strip)
}

fn entry<T>(lists: &mut Vec<(Method, Vec<T>)>, method: Method) -> &mut Vec<T> {
    let place = match lists.iter().position(|(m, _)| *m == method) {
        Some(place) => place,
        None => {
            lists.push((method, Vec::new()));
            lists.len() - 1
        }
    };
    &mut lists[place].1
}
