//! Scores what is the same in all variants of a scene, once for all of them: the photographs, and the 2D
//! enhancer's pictures of them. Also finds the flow between neighbouring views.
//!
//! Its parameters are those of `evaluate` that say which views are compared. It runs only if the pipeline
//! names a models folder, because only networks take long. The flow between frames of a path is that of the
//! reference variant's stage 1, drawn on the processor.

use std::collections::BTreeSet;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_atc::proposers::Proposer;
use use3d_capture::{Capture, Image, View};
use use3d_import::load_pixels;
use use3d_judge::flow::Correspondence;
use use3d_judge::scores::{Method, Scores};
use use3d_judge::scoring::Judges;
use use3d_metrics::Mask;
use use3d_scene::Scene;
use use3d_workflow::{StageContext, StageError};

use crate::engines::{Drawn, EngineChoice};
use crate::parts::baselines::{
    BASELINE, Baseline, ByMethod, First, PAIRS, STEPS, folders, frames, keep_flow, keep_proposal, mask,
    neighbours, stored, strip_views,
};
use crate::parts::captured::capture;
use crate::parts::proposer::{ProposerChoice, open};
use crate::parts::reference::Reference;
use crate::parts::visits::each_once;

/// The parameters of `evaluate` that it depends on.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub(crate) struct Params {
    /// The 2D enhancer.
    pub(crate) proposer: ProposerChoice,
    /// Pairs of captured views next to each other.
    pub(crate) neighbour_pairs: usize,
    /// Pairs of adjacent frames of the path.
    pub(crate) path_pairs: usize,
    /// Frames of the path from one training view to the next.
    pub(crate) path_steps: usize,
}

impl Default for Params {
    fn default() -> Self {
        let proposer = ProposerChoice::default();
        Self { proposer, neighbour_pairs: PAIRS, path_pairs: PAIRS, path_steps: STEPS }
    }
}

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_workflow::{Scope, Stage};

    use crate::parts::weights::judge_files;
    use crate::planning::expected::of_baseline;
    use crate::planning::learns_from_proposals;
    use crate::planning::memory::{NETWORK_PER_PIXEL, PROGRAM, gaussians, largest, networks};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("baseline", Scope::Scene, run)
            .about("score the photographs and the 2D enhancer, once for all variants")
            .with_parameters_of("evaluate")
            .promises(&[BASELINE])
            .input("import", "import")
            .reference_input("reference", "reconstruct", |all| !learns_from_proposals(all))
            .optional_external("models", "models")
            .select(|_: &Params, models| Ok(judge_files(models)))
            .when_named(|_, named| named.path("models").is_some())
            .expects(of_baseline)
            .usually_costs(5.0, 0.0)
            .cost(0, 4 << 30)
            .memory(|_: &Params, inputs| {
                let pixels = largest(inputs)?;
                let network = networks(inputs, judge_files, NETWORK_PER_PIXEL * pixels);
                Some(PROGRAM + 250 * pixels + 1200 * gaussians(inputs)? + network)
            })
    }
}

/// A photograph and the 2D enhancer's picture of it.
struct JudgedView {
    captured: Image,
    proposal: Image,
    mask: Option<Mask>,
}

impl JudgedView {
    fn new(view: &View, proposer: &dyn Proposer) -> Result<Self, StageError> {
        let captured = load_pixels(view)?.to_image();
        let proposal = stored(&proposer.enhance(&captured)?);
        Ok(Self { captured, proposal, mask: mask(view)? })
    }

    /// The scores of both.
    fn scores(&self, judges: &Judges) -> ByMethod {
        let mask = self.mask.as_ref();
        let mut proposal: Scores = judges.alone(&self.proposal, mask);
        proposal.extend(judges.against(&self.proposal, &self.captured, mask));
        [(Method::Captured, judges.alone(&self.captured, mask)), (Method::Proposal, proposal)].into()
    }
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let (capture, out) = (capture(context)?, context.output());
    let models = context.optional_input("models");
    let proposer =
        open(params.proposer, models, &mut |line| context.log(line)).map_err(StageError::bad_input)?;
    let judges = Judges::open(models);
    folders(out)?;
    let mut baseline = Baseline::default();
    let pairs = neighbours(&capture, params.neighbour_pairs);
    let test: BTreeSet<usize> = capture.split.test.iter().copied().collect();
    let alone: BTreeSet<usize> = test.iter().copied().chain(strip_views(&capture)).collect();
    each_once(&alone, &pairs, |i, before: Option<&JudgedView>| {
        context.alive()?;
        let view = &capture.views[i];
        context.progress_with(i as u64, capture.views.len() as u64, "views", &view.name);
        let seen = JudgedView::new(view, proposer.as_ref())?;
        keep_proposal(out, view, &seen.proposal)?;
        if test.contains(&i) {
            baseline.views.insert(view.name.to_string(), seen.scores(&judges));
        }
        if let Some(before) = before {
            let first = &capture.views[i - 1];
            let flow =
                judges.flow([&before.captured, &seen.captured], [before.mask.as_ref(), seen.mask.as_ref()]);
            keep_flow(out, First::View(first), &flow)?;
            let along = |flow: &Correspondence, pair| judges.along(flow, pair, "");
            let scores = [
                (Method::Captured, along(&flow, [&before.captured, &seen.captured])),
                (Method::Proposal, along(&flow, [&before.proposal, &seen.proposal])),
            ];
            baseline.neighbours.insert(first.name.to_string(), scores.into());
        }
        Ok::<_, StageError>(seen)
    })?;
    along_the_path(context, params, &capture, &judges)?;
    baseline.write(out)
}

/// Stores the flow between frames of the path through the reference's scene.
fn along_the_path(
    context: &StageContext,
    params: &Params,
    capture: &Capture,
    judges: &Judges,
) -> Result<(), StageError> {
    let Some(reference) = context.optional_input("reference").map(Scene::load).transpose()? else {
        return Ok(());
    };
    let drawn = Drawn::new(&reference, &EngineChoice::Cpu)?;
    let mut reference = Reference::new(&drawn, capture.frame)?;
    let (cameras, pairs) = frames(capture, params.path_pairs, params.path_steps);
    let mut done = 0;
    each_once(&BTreeSet::new(), &pairs, |i, before: Option<&Image>| {
        context.alive()?;
        context.progress_with(done, pairs.len() as u64, "pairs of frames", "");
        let image = reference.look(&cameras[i])?.1.map(|v| v.clamp(0.0, 1.0));
        if let Some(before) = before {
            let flow = judges.flow([before, &image], [None; 2]);
            keep_flow(context.output(), First::Frame(i - 1), &flow)?;
            done += 1;
        }
        Ok::<_, StageError>(image)
    })
}
