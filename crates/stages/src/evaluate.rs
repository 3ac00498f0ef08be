//! Scores the held-out views: stage 1 against the photographs, and every appearance by itself. Also scores
//! the consistency of neighbouring views.
//!
//! The 2D enhancer's images of the held-out photographs are kept; the report shows them next to the scene's.
//!
//! Rendered images are scored as they are rendered (f32, clamped to the display range) and not read from
//! files. The `render` stage shows the same images; both stages are functions of the same artifacts. If the
//! capture comes with its truth, appearances, depth and water are also measured against the truth
//! ([`use3d_judge::truth`]).
//!
//! Consistency has two forms, both over pairs of adjacent views. *Neighbours* are captured views that follow
//! one another in the capture. Only they have photographs, so only there can the 2D enhancer be tested on
//! photographs. The *path* moves through the training cameras with several frames from one to the next, like
//! a film of the scene. Depth, masks and raw inputs come from the reference variant's stage 1. They are the
//! same for all variants of a scene, so that no variant is judged by its own geometry.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_atc::proposers::Proposer;
use use3d_capture::{Appearance, Camera, Capture, Image, Map, View};
use use3d_import::{ImageSize, load_pixels};
use use3d_io_image::{read_image, write_png};
use use3d_metrics::{Mask, StepEdges, share};
use use3d_numerics::range::within;
use use3d_render::{Mode, Rendering, SceneRenderer, cover};
use use3d_scene::Scene;
use use3d_workflow::{Figure, StageContext, StageError, machine};

use crate::engines::{Drawn, EngineChoice};
use crate::parts::baselines::{Baseline, First, PAIRS, STEPS, frames, mask, neighbours, stored, strip_views};
use crate::parts::captured::capture;
use crate::parts::files::{
    AUTHORS_CLEAR, ENHANCED_IN_2D, EVALUATION, SCORES, SPEED, STRIP, TRUE_VIEWS, choice_sources, folder,
    out_of_range, proposal_of, read_json, write_json,
};
use crate::parts::proposer::{ProposerChoice, open};
use crate::parts::published_clear::PublishedClear;
use crate::parts::reference::Reference;
use crate::parts::scene::{drawn, shown_scene};
use crate::parts::visits::each_once;
use use3d_judge::scores::{
    self, Finite, Method, MethodScores, PairScores, SceneScores, SceneSpeed, Scores, ViewScores, Warp,
};
use use3d_judge::scoring::{ComparedView, Judges, Pairing, edge_scores};
use use3d_judge::speed;
use use3d_judge::strip::{Strip, StripRow, StripView, choose, sheet};
use use3d_judge::truth::{Truth, files};

/// The scores that an evaluation has to have.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Wanted {
    /// Those whose networks are in the models folder; for each other score, the missing files are reported.
    #[default]
    Available,
    /// All of the paper: LPIPS, URanker, MUSIQ and wLPIPS. A network that is missing is an error.
    All,
}

/// Parameters of the evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Params {
    /// The 2D enhancer of the reference rows; `auto` as in `pairs`.
    pub(crate) proposer: ProposerChoice,
    /// The scores that must be there.
    pub(crate) scores: Wanted,
    /// The clear view as the authors of a method show it: a row of its own beside the clear render.
    pub(crate) published_clear: PublishedClear,
    /// Pairs of captured views next to each other that are compared, evenly chosen; 0: none.
    pub(crate) neighbour_pairs: usize,
    /// Pairs of adjacent frames of the rendered path that are compared, evenly chosen; 0: none.
    pub(crate) path_pairs: usize,
    /// Frames of that path from one training view to the next.
    pub(crate) path_steps: usize,
    /// `"WxH"`: the size at which frames per second are measured; the size of the held-out views if not set.
    /// Another size does not score the scene again.
    pub(crate) fps_size: Option<ImageSize>,
    /// The engine that draws the scenes: `cpu`; `auto` (a graphics card that passed its check, else the
    /// processor); `gpu`; `gpu:NAME`.
    #[schemars(with = "String")]
    pub(crate) engine: EngineChoice,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            proposer: ProposerChoice::default(),
            scores: Wanted::Available,
            published_clear: PublishedClear::None,
            neighbour_pairs: PAIRS,
            path_pairs: PAIRS,
            path_steps: STEPS,
            fps_size: None,
            engine: EngineChoice::Cpu,
        }
    }
}

/// The largest difference between the scores of one scene drawn in two classes of arithmetic: below the
/// printed decimals.
const FIGURES: [Figure; 2] = [
    Figure { file: SCORES, at: "/methods/*/mean/psnr/value", within: 0.005 },
    Figure { file: SCORES, at: "/methods/*/mean/ssim/value", within: 0.0005 },
];

impl Params {
    fn check(&self) -> Result<(), (String, String)> {
        let within = |name, value, least| within(name, value, least, 10_000).map_err(out_of_range);
        within("neighbour_pairs", self.neighbour_pairs, 0)?;
        within("path_pairs", self.path_pairs, 0)?;
        within("path_steps", self.path_steps, 1)
    }
}

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_nets::Network;
    use use3d_workflow::content::Choice;
    use use3d_workflow::{AllParameters, Checks, Lacking, Named, Scope, Stage};

    use crate::engines;
    use crate::parts::weights::judge_files;
    use crate::planning::memory::{NETWORK_PER_PIXEL, PROGRAM, gaussians, largest, networks};
    use crate::planning::requirements::{lacking, network, weights};
    use crate::planning::{expected::of_evaluation, learns_from_proposals};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("evaluate", Scope::Scene, run)
            .about("compare these pictures with the photographs that were kept back")
            .promises(&[SCORES])
            .delivers("scores")
            .check(Params::check)
            .computes_on("engine", |p: &Params| engines::asked(&p.engine), |p| engines::class(&p.engine))
            .without_effect(&["engine", "fps_size"])
            .agrees_across_classes(&FIGURES)
            .input("import", "import")
            .input("scene", "reconstruct")
            .optional_input("proposals", "propose")
            .optional_input("enhanced", "enhance")
            .optional_input("photographs", "photographs")
            .optional_input("baseline", "baseline")
            .reference_input("reference", "reconstruct", |all| !learns_from_proposals(all))
            .optional_external("models", "models")
            .select(|_: &Params, models| Ok(judge_files(models)))
            .optional_external("truth", "capture")
            .select_by(|_: &Params, capture| {
                let files = files(capture);
                // Without a truth, the answer costs nothing.
                let made_from = if files.is_empty() { Vec::new() } else { choice_sources(capture) };
                Ok(Choice { files, made_from })
            })
            .requires(missing)
            .expects(of_evaluation)
            .usually_costs(5.0, 0.0)
            .cost(0, 4 << 30)
            // The memory holds the scene, the reference's scene, two views in all their appearances, and the
            // strip's.
            .memory(|_: &Params, inputs| {
                let pixels = largest(inputs)?;
                let network = networks(inputs, judge_files, NETWORK_PER_PIXEL * pixels);
                Some(PROGRAM + 650 * pixels + 1200 * gaussians(inputs)? + network)
            })
    }

    fn missing(all: &AllParameters, named: &Named, checks: &Checks<'_>) -> Vec<Lacking> {
        let Some(own) = all.of::<Params>() else { return Vec::new() };
        let truth = named.path("capture").and_then(|capture| unreadable_truth(capture, checks));
        let enhancer = weights(all, named, ("evaluate", own.proposer));
        enhancer.into_iter().chain(missing_networks(own, named)).chain(truth).collect()
    }

    /// The missing networks of the paper's scores, if all scores are required.
    fn missing_networks(own: &Params, named: &Named) -> Vec<Lacking> {
        use Network::{AlexNet, LpipsHeads, Musiq, RaftLarge, URanker};
        if own.scores != Wanted::All {
            return Vec::new();
        }
        let each = [LpipsHeads, AlexNet, RaftLarge, URanker, Musiq].into_iter().filter_map(|net| {
            let known = net.known();
            let what = format!("the weights of {} ({})", known.title, known.used_for);
            network(named, &what, &[net], "--set evaluate.scores=available")
        });
        each.collect()
    }

    /// Truth that exists next to a capture and cannot be read.
    fn unreadable_truth(capture: &Path, checks: &Checks<'_>) -> Option<Lacking> {
        // Reading all images of a truth takes long.
        let fault =
            checks.once("a truth is readable, 1", capture, || use3d_judge::truth::check_readable(capture));
        fault.map(|reason| {
            let remedy = format!("{reason}; write that file again, or rename the truth/ folder");
            lacking("the truth beside a capture", remedy, "")
        })
    }
}

/// One view in all its appearances.
struct Appearances {
    images: Vec<(Method, Image)>,
    depth: Map,
    accumulation: Map,
    /// Attenuation and backscatter of every ray, if the scene has water.
    water: Option<[Image; 2]>,
}

impl Appearances {
    fn of(&self, method: Method) -> Option<&Image> {
        self.images.iter().find(|(m, _)| *m == method).map(|(_, image)| image)
    }

    /// Only the images of some methods, and the depth.
    fn only(&self, methods: &[Method]) -> Self {
        let images = self.images.iter().filter(|(method, _)| methods.contains(method)).cloned().collect();
        Self { images, depth: self.depth.clone(), accumulation: Map::new(0, 0), water: None }
    }
}

/// Means of an image's channels.
fn channel_means(image: &Image) -> [f64; 3] {
    image.planes().map(|plane| plane.iter().map(|v| f64::from(*v)).sum::<f64>() / plane.len().max(1) as f64)
}

/// A scene's renderer and the 2D enhancer: produces all appearances of a view.
struct Looker<'a> {
    renderer: SceneRenderer<'a>,
    proposer: &'a dyn Proposer,
    /// The method that the scene was learnt with: from photographs, or from proposals.
    learnt: Method,
    published: PublishedClear,
}

impl Looker<'_> {
    /// All appearances at a camera, with those made of a photograph if there is one. It may come with the 2D
    /// enhancer's picture of it.
    fn look(
        &mut self,
        camera: &Camera,
        photograph: Option<(Image, Option<Image>)>,
    ) -> Result<Appearances, StageError> {
        let mut modes =
            vec![Mode::Reconstruction, Mode::Depth, Mode::Alpha, Mode::Attenuation, Mode::Backscatter];
        if self.learnt == Method::Reconstruction {
            modes.push(Mode::Clear);
        }
        if self.renderer.is_enhanced() {
            modes.extend([Mode::Enhanced, Mode::EnhancedClear]);
        }
        let mut images = Vec::new();
        if let Some((captured, known)) = photograph {
            let proposal =
                known.map_or_else(|| Ok(stored(&self.proposer.enhance(&captured)?)), Ok::<_, StageError>)?;
            images.extend([(Method::Captured, captured), (Method::Proposal, proposal)]);
        }
        let (mut depth, mut accumulation) = (Map::new(0, 0), Map::new(0, 0));
        let mut water = Vec::new();
        for (mode, frame) in modes.iter().zip(self.renderer.render(camera, &modes)?) {
            match (mode, frame) {
                (Mode::Reconstruction, Rendering::Color(image)) => {
                    if self.learnt == Method::Reconstruction {
                        let shown = image.map(|v| v.clamp(0.0, 1.0));
                        images.push((Method::ProposalOfRender, self.proposer.enhance(&shown)?));
                    }
                    images.push((self.learnt, image));
                }
                (Mode::Clear, Rendering::Color(image)) => {
                    let shown = self.published.shown(&image).map(|shown| (Method::PublishedClear, shown));
                    images.extend([(Method::Clear, image)].into_iter().chain(shown));
                }
                (Mode::Enhanced, Rendering::Color(image)) => images.push((Method::Enhanced, image)),
                (Mode::EnhancedClear, Rendering::Color(image)) => images.push((Method::EnhancedClear, image)),
                (Mode::Depth, Rendering::Scalar(map)) => depth = map,
                (Mode::Alpha, Rendering::Scalar(map)) => accumulation = map,
                (Mode::Attenuation | Mode::Backscatter, Rendering::Color(image)) => water.push(image),
                _ => {}
            }
        }
        Ok(Appearances { images, depth, accumulation, water: water.try_into().ok() })
    }
}

/// Lists by method.
type Lists<T> = BTreeMap<Method, Vec<T>>;

/// Data that all parts of an evaluation use.
struct Evaluation<'a> {
    context: &'a StageContext,
    capture: &'a Capture,
    judges: Judges,
    looker: Looker<'a>,
    /// The reference variant's stage 1; `None` if it is the scene's own.
    reference: Option<Reference<'a>>,
    /// The results on photographs that are known beforehand.
    baseline: Baseline,
}

impl Evaluation<'_> {
    /// The methods' images at a camera. For a comparison with another camera, the depth and the raw image are
    /// those of the reference, if there is one.
    fn station(
        &mut self,
        camera: &Camera,
        view: Option<&View>,
        compared: bool,
    ) -> Result<Station, StageError> {
        self.context.alive()?;
        let (photograph, mask) = match view {
            Some(view) => {
                let photograph = load_pixels(view)?.to_image();
                (Some((photograph, self.baseline.proposal(view)?)), mask(view)?)
            }
            None => (None, None),
        };
        let looks = self.looker.look(camera, photograph)?;
        let warp = match &mut self.reference {
            Some(reference) if compared => Some(reference.look(camera)?),
            _ => None,
        };
        let render = || warp.as_ref().map(|(_, image)| image).or(looks.of(self.looker.learnt));
        let raw = looks.of(Method::Captured).or_else(render);
        let raw = raw.map_or_else(|| Image::new(0, 0), |image| image.map(|v| v.clamp(0.0, 1.0)));
        Ok(Station { camera: *camera, raw, depth: warp.map(|(depth, _)| depth), mask, looks })
    }

    /// Adds the scores of every method on one pair, of captured views or of frames, to `lists`.
    fn pair(
        &self,
        ends: [&Station; 2],
        at: First<'_>,
        names: &[String; 2],
        lists: &mut Lists<PairScores>,
    ) -> Result<(), StageError> {
        let [first, second] = ends;
        let found = || self.judges.flow([&first.raw, &second.raw], ends.map(|end| end.mask.as_ref()));
        let flow = self.baseline.flow(at)?.unwrap_or_else(found);
        let pairing = Pairing::new(flow, &first.compared(), &second.compared());
        let (prefix, known) = match at {
            First::View(view) => ("", self.baseline.neighbours.get(&*view.name)),
            First::Frame(_) => ("path_", None),
        };
        for (method, image) in &first.looks.images {
            let Some(other) = second.looks.of(*method) else { continue };
            let [first, second] = names.clone();
            let place = format!("{first} and {second}");
            let known = known.and_then(|scores| scores.get(method)).cloned();
            let scores = pairing.scores(&self.judges, [image, other], prefix, known);
            let scores = scores.into_iter().map(|(name, score)| (name, score.named(&place))).collect();
            lists.entry(*method).or_default().push(PairScores { first, second, scores });
        }
        Ok(())
    }

    /// Renders every view that is held out, compared with a neighbour or shown in the strip once. `held_out`
    /// gets each held-out view. Returns the scores of the pairs of captured views that follow one another,
    /// and the views of the strip.
    fn views(
        &mut self,
        most: usize,
        strip: &StripRows,
        held_out: &mut dyn FnMut(&Self, &View, &Station) -> Result<(), StageError>,
    ) -> Result<(Lists<PairScores>, Vec<Appearances>), StageError> {
        let (mut lists, mut shown) = (Lists::new(), Vec::new());
        let capture = self.capture;
        let views = &capture.views;
        let pairs = neighbours(capture, most);
        let test: BTreeSet<usize> = capture.split.test.iter().copied().collect();
        let alone: BTreeSet<usize> = test.iter().copied().chain(strip.views.clone()).collect();
        each_once(&alone, &pairs, |i, before: Option<&Station>| {
            let view = &views[i];
            self.context.progress_with(i as u64, views.len() as u64, "views", &view.name);
            let compared = before.is_some() || pairs.contains(&i);
            let station = self.station(&view.camera, Some(view), compared)?;
            if test.contains(&i) {
                held_out(self, view, &station)?;
            }
            if let Some(before) = before {
                let names = [views[i - 1].name.to_string(), view.name.to_string()];
                self.pair([before, &station], First::View(&views[i - 1]), &names, &mut lists)?;
            }
            if strip.views.contains(&i) {
                shown.push(station.looks.only(&strip.methods));
            }
            Ok::<_, StageError>(station)
        })?;
        Ok((lists, shown))
    }

    /// Scores of pairs of adjacent frames of a path through the training cameras.
    fn path(&mut self, most: usize, steps: usize) -> Result<Lists<PairScores>, StageError> {
        let mut lists = Lists::new();
        let ((frames, pairs), mut done) = (frames(self.capture, most, steps), 0);
        each_once(&BTreeSet::new(), &pairs, |i, before: Option<&Station>| {
            self.context.progress_with(done, pairs.len() as u64, "pairs of frames", "");
            let station = self.station(&frames[i], None, true)?;
            if let Some(before) = before {
                let names = [i - 1, i].map(|f| format!("frame {f}"));
                self.pair([before, &station], First::Frame(i - 1), &names, &mut lists)?;
                done += 1;
            }
            Ok::<_, StageError>(station)
        })?;
        Ok(lists)
    }
}

/// A camera with all images from its position.
struct Station {
    camera: Camera,
    raw: Image,
    /// The reference's depth, if there is another reference than the scene.
    depth: Option<Map>,
    mask: Option<Mask>,
    looks: Appearances,
}

impl Station {
    fn compared(&self) -> ComparedView<'_> {
        let depth = self.depth.as_ref().unwrap_or(&self.looks.depth);
        ComparedView { camera: &self.camera, depth, mask: self.mask.as_ref() }
    }
}

/// The method that a scene was learnt with. It follows from the stage's inputs or, if the stage is run by
/// hand, from the record that stage 1 wrote.
fn learnt_from(context: &StageContext) -> Method {
    let written = |folder: &Path| read_json::<serde_json::Value>(&folder.join(EVALUATION)).ok();
    let by_hand =
        || context.optional_input("scene").and_then(written).is_some_and(|w| w["learnt_from"] == "proposed");
    if context.optional_input("proposals").is_some() || by_hand() {
        Method::EnhanceThenReconstruct
    } else {
        Method::Reconstruction
    }
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let scene = shown_scene(context)?;
    // The scored scene's own stage 1 is in memory already, and its looks are those of the scene.
    let referred = context.optional_input("reference");
    let other = referred.filter(|folder| Some(*folder) != context.optional_input("scene"));
    let reference = other.map(Scene::load).transpose()?;
    let learnt = learnt_from(context);
    let photographs = context.optional_input("photographs");
    let models = context.optional_input("models");
    let proposer =
        open(params.proposer, models, &mut |line| context.log(line)).map_err(StageError::bad_input)?;
    let shown = drawn(context, &scene, &params.engine)?;
    let reference_shown = reference.as_ref().map(|scene| Drawn::new(scene, &params.engine)).transpose()?;
    let judges = Judges::open(models);
    if params.scores == Wanted::All {
        judges.complete().map_err(StageError::bad_input)?;
    }
    let views: Vec<&View> = capture.test_views().collect();
    if views.is_empty() {
        context.say(
            "no view is held out (split.every = 0), so there is nothing to score; import again with \
             `split.every` above 0",
        );
    }
    let mut evaluation = Evaluation {
        context,
        capture: &capture,
        judges,
        looker: Looker {
            renderer: shown.renderer(1.0)?,
            proposer: proposer.as_ref(),
            learnt,
            published: params.published_clear,
        },
        reference: reference_shown.as_ref().map(|r| Reference::new(r, scene.frame)).transpose()?,
        baseline: Baseline::read(context.optional_input("baseline"))?,
    };

    let size = views.first().map_or((0, 0), |v| (v.camera.intrinsics.width, v.camera.intrinsics.height));
    let truth = match context.optional_input("truth") {
        Some(folder) if !views.is_empty() => Truth::open(folder, size, &mut |notice| context.say(notice)),
        _ => None,
    };
    let knows_depth = truth.as_ref().is_some_and(|t| t.knows_depth);
    let scale = capture.frame.scale;
    let (mut water, mut pixels) = ([[0.0; 3]; 2], 0.0);

    let enhanced_in_2d = context.output().join(ENHANCED_IN_2D);
    folder(&enhanced_in_2d)?;
    let mut per_view: Lists<ViewScores> = Lists::new();
    let rows = StripRows::new(&capture, &scene, learnt);
    let mut held_out = |evaluation: &Evaluation<'_>, view: &View, station: &Station| {
        let now = &station.looks;
        let photograph = photographs.map(|folder| read_image(&proposal_of(folder, view))).transpose()?;
        let photograph = photograph.map(|image| (Method::Photograph, image));
        if let Some(proposal) = now.of(Method::Proposal) {
            write_png(&proposal_of(&enhanced_in_2d, view), proposal)?;
        }
        if let Some(clear) = now.of(Method::PublishedClear) {
            let folder_of_views = context.output().join(AUTHORS_CLEAR);
            folder(&folder_of_views)?;
            write_png(&proposal_of(&folder_of_views, view), clear)?;
        }
        let mask = &station.mask;
        pixels += share(mask.as_ref()) / views.len() as f64;
        let judges = &evaluation.judges;
        let true_view = truth.as_ref().map(|t| t.view(view.stem())).transpose()?.flatten();
        if let Some(truth) = &true_view {
            let true_views = context.output().join(TRUE_VIEWS);
            folder(&true_views)?;
            write_png(&proposal_of(&true_views, view), &truth.clean)?;
        }
        let edges = now.of(Method::Captured).map(|captured| StepEdges::of(captured, mask.as_ref()));
        for (method, image) in now.images.iter().chain(&photograph) {
            let known = evaluation.baseline.views.get(&*view.name).and_then(|known| known.get(method));
            let mut scores = known.cloned().unwrap_or_else(|| {
                let mut scores: Scores = judges.alone(image, mask.as_ref());
                if let (true, Some(captured)) = (*method != Method::Captured, now.of(Method::Captured)) {
                    scores.extend(judges.against(image, captured, mask.as_ref()));
                }
                scores
            });
            if let (true, Some(edges)) = (*method != Method::Captured, &edges) {
                scores.extend(edge_scores(edges, image));
            }
            if let Some(truth) = &true_view {
                if *method == learnt && knows_depth {
                    scores.insert("depth_error".into(), truth.depth_error(&now.depth, scale));
                    scores.insert("holes".into(), truth.holes(&now.accumulation));
                }
                // Stage 1's images still contain the water.
                if *method != Method::Reconstruction {
                    scores.extend(truth.scores(image, mask.as_ref()));
                    scores.extend(truth.greys(image));
                }
            }
            let scores = scores.into_iter().map(|(name, score)| (name, score.named(&view.name))).collect();
            per_view.entry(*method).or_default().push(ViewScores { view: view.name.to_string(), scores });
        }
        for (sum, map) in water.iter_mut().zip(now.water.iter().flatten()) {
            let means = channel_means(map);
            (0..3).for_each(|c| sum[c] += means[c] / views.len() as f64);
        }
        Ok(())
    };
    let (mut neighbours, looks) = evaluation.views(params.neighbour_pairs, &rows, &mut held_out)?;
    let mut path = evaluation.path(params.path_pairs, params.path_steps)?;
    let moved: BTreeMap<Method, f64> =
        neighbours.iter().filter_map(|(method, pairs)| Some((*method, change(pairs)?))).collect();
    strip(context, &capture, (&rows, &moved), &looks)?;
    time(context, (&views, params.fps_size), &mut evaluation.looker.renderer, shown.card.as_deref())?;

    let methods = Method::ALL.into_iter().filter_map(|method| {
        let views = per_view.remove(&method);
        let pairs = [neighbours.remove(&method), path.remove(&method)];
        let known = views.is_some() || pairs.iter().any(Option::is_some);
        let [neighbours, path] = pairs.map(Option::unwrap_or_default);
        known.then(|| MethodScores::new(method, views.unwrap_or_default(), neighbours, path))
    });
    let scores = SceneScores {
        format: scores::FORMAT.into(),
        version: scores::VERSION,
        training_views: capture.split.train.len(),
        held_out_views: views.len(),
        size,
        pixels: if views.is_empty() { 1.0 } else { pixels },
        gaussians: scene.gaussians.len(),
        warp: if referred.is_some() { Warp::Reference } else { Warp::Own },
        result: match scene.enhancement.as_ref().map(|e| e.appearance) {
            Some(Appearance::Clear) => Method::EnhancedClear,
            Some(Appearance::Water) | None => Method::Enhanced,
        },
        water: truth
            .filter(|_| !scene.medium.is_none() && scene.medium.kind().is_per_length())
            .and_then(|truth| truth.water(water[0], water[1], scale)),
        methods: methods.collect(),
    };
    write_json(&context.output().join(SCORES), &scores)
}

/// Notes the speed of drawing the scene, at the held-out views' own size or at `size`. A time is never part
/// of an artifact.
fn time(
    context: &StageContext,
    (views, size): (&[&View], Option<ImageSize>),
    renderer: &mut SceneRenderer<'_>,
    card: Option<&str>,
) -> Result<(), StageError> {
    if !context.keeps_notes() {
        return Ok(());
    }
    let mut cameras: Vec<Camera> = views.iter().take(4).map(|v| v.camera).collect();
    if let Some(ImageSize { width, height }) = size {
        cameras.iter_mut().for_each(|camera| camera.intrinsics = cover(&camera.intrinsics, width, height));
    }
    let mode = if renderer.is_enhanced() { Mode::Enhanced } else { Mode::Reconstruction };
    let measured = speed::measure(renderer, &cameras, mode, Duration::ZERO, &|| context.cancelled())?;
    let (Some(measured), Some(camera)) = (measured, cameras.first()) else { return Ok(()) };
    let Some(fps) = Finite::new(measured.fps) else { return Ok(()) };
    let size = (camera.intrinsics.width, camera.intrinsics.height);
    let (processor, threads) = match card {
        Some(card) => (card.to_string(), 0),
        None => (machine::processor(), context.threads()),
    };
    let speed = SceneSpeed { fps, size, processor, threads };
    context.log(format_args!("{}: {:.2} frames per second at {speed}", measured.mode, measured.fps));
    context.note(SPEED, &speed);
    Ok(())
}

/// The views and the methods of the consistency strip.
struct StripRows {
    views: Range<usize>,
    methods: [Method; 4],
}

impl StripRows {
    fn new(capture: &Capture, scene: &Scene, learnt: Method) -> Self {
        let last = match scene.enhancement.as_ref().map(|e| e.appearance) {
            Some(Appearance::Clear) => Method::EnhancedClear,
            Some(Appearance::Water) => Method::Enhanced,
            None => learnt,
        };
        let methods = [Method::Captured, Method::Proposal, Method::ProposalOfRender, last];
        Self { views: strip_views(capture), methods }
    }
}

/// The same spot in three neighbouring views: captured, enhanced in 2D, and as the scene shows it.
fn strip(
    context: &StageContext,
    capture: &Capture,
    (rows, moved): (&StripRows, &BTreeMap<Method, f64>),
    looks: &[Appearances],
) -> Result<(), StageError> {
    context.alive()?;
    let views = &capture.views[rows.views.clone()];
    let seen = views.iter().zip(looks).filter_map(|(view, look)| {
        Some(StripView { camera: &view.camera, depth: &look.depth, photograph: look.of(Method::Captured)? })
    });
    let row = |method: Method| -> Option<Vec<&Image>> { looks.iter().map(|look| look.of(method)).collect() };
    let shown = rows.methods.into_iter().filter_map(|method| Some((method, row(method)?)));
    let (shown, rows): (Vec<Method>, Vec<StripRow<'_>>) =
        shown.map(|(method, images)| (method, (images, moved.get(&method).copied()))).unzip();
    let Some((side, corners)) = choose(&seen.collect::<Vec<_>>(), &rows) else {
        context.log("no spot is seen by three neighbouring views: no consistency strip");
        return Ok(());
    };
    write_png(&context.output().join(STRIP.0), &sheet(&rows, &corners, side))?;
    let rows = shown.iter().map(|m| m.label().to_string()).zip(rows.iter().map(|(_, mean)| *mean)).collect();
    let strip = Strip { views: views.iter().map(|v| v.name.to_string()).collect(), rows, side, corners };
    write_json(&context.output().join(STRIP.1), &strip)
}

/// The mean change of colour of one method over all pairs.
fn change(pairs: &[PairScores]) -> Option<f64> {
    let values = || pairs.iter().filter_map(|pair| pair.scores.get("w_delta_e")?.value());
    let count = values().count();
    (count > 0).then(|| values().sum::<f64>() / count as f64)
}
