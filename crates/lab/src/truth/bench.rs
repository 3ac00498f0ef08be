//! Runs the pipeline of every seed, and writes the table after each.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde_json::Value;
use use3d_config::{LoadOptions, Pipeline, from_text};
use use3d_judge::scores::SceneScores;
use use3d_judge::truth::Truth;
use use3d_stages::{ProposerChoice, SCORES, open_proposer, read_json, registry};
use use3d_synth::CaptureParams;
use use3d_workflow::machine::seconds;
use use3d_workflow::plan::State;
use use3d_workflow::{Builder, Cache, Event, Graph, Listener, Plan, RunOptions, Summary, place};

use super::captures::{Capture, named};
use super::figures::{FORMAT, Scored, TruthFigures, of_capture};
use super::output;
use super::picture::{Sheet, sheet};
use super::runs::{DEFAULT, LearntFrom, Recipe, STAGES};
use use3d_pipeline::WorkError;

/// Seconds of a training step per pixel, on two cores, if no earlier run gives a better value: 8 ms at
/// 320×180.
const STEP_PER_PIXEL: f64 = 1.4e-7;

/// The request for a table.
#[derive(Clone, Debug)]
pub struct TruthRequest {
    /// The folder for captures, table and pictures.
    pub out: PathBuf,
    /// The names of the captures; all if the list is empty.
    pub captures: Vec<String>,
    /// The seeds of captures and trainings, in any order.
    pub seeds: Vec<u64>,
    /// Photographs per capture.
    pub views: usize,
    /// Their width and height, pixels.
    pub size: (usize, usize),
    /// Steps of stage 1.
    pub iterations: u64,
    /// True if the baselines that need trainings of their own are run.
    pub baselines: bool,
    /// True if the methods of other authors are trained too.
    pub methods: bool,
    /// Further settings of the pipeline. The cache is below `out` if none is given.
    pub load: LoadOptions,
    /// True if all inputs are read again.
    pub rehash: bool,
}

/// A checked request.
pub struct TruthBench {
    request: TruthRequest,
    recipe: Recipe,
    captures: Vec<Capture>,
}

/// A seed's pipeline, ready to run.
struct Seed {
    seed: u64,
    text: String,
    pipeline: Pipeline,
    builder: Builder,
    graph: Graph,
}

/// The results so far.
#[derive(Default)]
struct Results {
    seeds: Vec<u64>,
    pipelines: BTreeMap<u64, String>,
    failed: Vec<String>,
    scored: Vec<Scored>,
    /// The pictures of the first seed that has any, by capture.
    pictures: Vec<Sheet>,
}

impl TruthBench {
    /// Checks a request.
    ///
    /// # Errors
    /// Returns the first setting that is wrong.
    pub fn new(mut request: TruthRequest) -> Result<Self, WorkError> {
        let load = &request.load;
        let recipe = Recipe {
            views: request.views,
            size: request.size,
            iterations: request.iterations,
            baselines: request.baselines,
            methods: request.methods,
            sets: load.sets.clone(),
            learnt_from: match (&load.pairs, &load.calibrator) {
                (Some(_), _) => LearntFrom::Pairs,
                (None, Some(_)) => LearntFrom::Calibrator,
                (None, None) => LearntFrom::Nothing,
            },
        };
        recipe.check()?;
        let captures = named(&request.captures).map_err(|e| WorkError::Input(format!("--captures: {e}")))?;
        request.seeds.sort_unstable();
        request.seeds.dedup();
        for capture in &captures {
            capture.parameters(0, recipe.views, recipe.size).validate().map_err(WorkError::input)?;
        }
        Ok(Self { request, recipe, captures })
    }

    /// The folder of a capture with a seed.
    fn folder(&self, capture: &Capture, seed: u64) -> PathBuf {
        self.request.out.join("captures").join(capture.folder(seed))
    }

    /// All captures that the table needs, each with its folder.
    pub fn captures(&self) -> Vec<(CaptureParams, PathBuf)> {
        let of = |seed: u64| {
            let params = move |c: &Capture| c.parameters(seed, self.recipe.views, self.recipe.size);
            self.captures.iter().map(move |capture| (params(capture), self.folder(capture, seed)))
        };
        self.request.seeds.iter().flat_map(|&seed| of(seed)).collect()
    }

    /// Makes every check that is possible before anything is made. `probe` is an empty folder.
    ///
    /// # Errors
    /// Returns the first place that this program must not write, or a setting that the pipeline refuses.
    pub fn check(&self, probe: &Path) -> Result<(), WorkError> {
        output::check(&self.request.out)?;
        for (_, folder) in self.captures() {
            place::check(&folder, true)?;
        }
        // Settings are checked before anything is rendered.
        let first = self.request.seeds.first().copied().unwrap_or_default();
        self.load(first, probe, &probe.join("cache")).map(|_| ())
    }

    /// Runs every seed's pipeline on its captures, which exist. The table is written after every seed,
    /// because the next seed may take hours. `forecasts` says if the time of the remaining seeds is
    /// estimated. Returns the figures and the written files.
    ///
    /// # Errors
    /// Returns an interruption, a result that cannot be read, or a place that cannot be written. A failed
    /// stage is no error: the figures name it.
    pub fn run(
        &self,
        options: RunOptions,
        listener: &Arc<dyn Listener>,
        forecasts: bool,
    ) -> Result<(TruthFigures, Vec<PathBuf>), WorkError> {
        let out = &self.request.out;
        let cache = self.request.load.cache.clone().unwrap_or_else(|| out.join("cache"));
        let seeds = self.request.seeds.iter();
        let ready: Vec<Seed> = seeds.map(|&seed| self.load(seed, out, &cache)).collect::<Result<_, _>>()?;
        let until = Some(STAGES.map(String::from).to_vec());
        let options = RunOptions { keep_going: true, until, ..options };
        let mut results = Results::default();
        let mut delivered = Vec::new();
        for (i, seed) in ready.iter().enumerate() {
            if forecasts {
                self.forecast(&ready[i..], listener.as_ref());
            }
            let summary = seed.builder.run(&seed.graph, &options, listener);
            if summary.interrupted {
                return Err(WorkError::Interrupted);
            }
            self.gather(seed, &summary, &mut results)?;
            delivered = output::deliver(&self.figures(&results), &results.pictures, out)?;
        }
        Ok((self.figures(&results), delivered))
    }

    /// The pipeline of a seed with its graph; captures are below `out`.
    fn load(&self, seed: u64, out: &Path, cache: &Path) -> Result<Seed, WorkError> {
        let registry = registry().map_err(WorkError::failed)?;
        let text = self.recipe.pipeline(&self.captures, seed);
        let options = LoadOptions { cache: Some(cache.to_path_buf()), ..self.request.load.clone() };
        let pipeline =
            from_text(&registry, &text, &out.join("truth.toml"), &options).map_err(WorkError::input)?;
        let graph = Graph::new(&registry, &pipeline.batch).map_err(WorkError::input)?;
        let cache = Cache::open(&pipeline.cache, self.request.rehash).map_err(WorkError::input)?;
        Ok(Seed { seed, text, pipeline, builder: Builder::new(registry, cache), graph })
    }

    /// Reports an estimate of the time for the remaining seeds.
    fn forecast(&self, left: &[Seed], listener: &dyn Listener) {
        let until = STAGES.map(String::from);
        let plans: Vec<Plan> = left.iter().map(|s| s.builder.plan(&s.graph, Some(&until))).collect();
        let (mut known, mut trainings, mut runs) = (0.0, 0.0, 0);
        for plan in &plans {
            known += plan.forecast().0;
            runs += plan.to_run();
            let would = plan.nodes.iter().filter(|n| {
                n.stage == "reconstruct"
                    && n.shared_with.is_none()
                    && n.forecast.is_none()
                    && matches!(n.state, State::Run(_) | State::Waiting(_))
            });
            trainings += would.count() as f64;
        }
        if runs == 0 {
            return;
        }
        let pixels = (self.recipe.size.0 * self.recipe.size.1) as f64;
        let guessed = trainings * self.recipe.iterations as f64 * pixels * STEP_PER_PIXEL;
        let text = if known > 0.0 {
            format!("{runs} stages to run, about {} one after another", seconds(known + guessed))
        } else {
            let trainings = seconds(guessed);
            format!(
                "{runs} stages to run; the trainings of stage 1 alone take about {trainings} on two idle \
                 cores. The next seed has a better forecast"
            )
        };
        let seeds: Vec<String> = left.iter().map(|s| s.seed.to_string()).collect();
        let label = format!("seeds {}", seeds.join(", "));
        listener.event(&Event::Note { label: &label, text: &text });
    }

    /// Adds the cached results of a seed's run.
    fn gather(&self, seed: &Seed, summary: &Summary, results: &mut Results) -> Result<(), WorkError> {
        results.seeds.push(seed.seed);
        results.pipelines.insert(seed.seed, seed.text.clone());
        for node in summary.failed() {
            results.failed.push(format!("{} with seed {}", node.label, seed.seed));
        }
        for node in summary.nodes.iter().filter(|n| n.stage == "evaluate") {
            let Some(artifact) = &node.artifact else { continue };
            let scores: SceneScores = read_json(&artifact.path.join(SCORES)).map_err(WorkError::failed)?;
            let (capture, variant) = (node.scene.clone(), node.variant.clone());
            results.scored.push(Scored { seed: seed.seed, capture, variant, scores });
        }
        for capture in &self.captures {
            if !results.pictures.iter().any(|sheet| sheet.capture == capture.name) {
                results.pictures.extend(self.picture(capture, seed, summary)?);
            }
        }
        Ok(())
    }

    /// A capture's sheet, if its scene was rendered.
    fn picture(&self, capture: &Capture, seed: &Seed, summary: &Summary) -> Result<Option<Sheet>, WorkError> {
        let artifact = |stage: &str| summary.artifact(capture.name, DEFAULT, stage);
        let (Some(renders), Some(scores)) = (artifact("render"), artifact("evaluate")) else {
            return Ok(None);
        };
        // The enhancer that was scored.
        let choice: ProposerChoice = match &scores.manifest.ingredients.parameters["proposer"] {
            Value::Null => ProposerChoice::default(),
            given => serde_json::from_value(given.clone()).map_err(WorkError::failed)?,
        };
        let models = seed.pipeline.batch.externals.get("models").and_then(|m| m.as_deref().ok());
        let proposer = open_proposer(choice, models, &mut |_| {});
        let proposer = proposer.map_err(|e| WorkError::Failed(e.to_string()))?;
        let folder = self.folder(capture, seed.seed);
        let mut clean = |stem: &str, size: (usize, usize)| {
            let truth = Truth::open(&folder, size, &mut |_| {})?;
            Some(truth.view(stem).ok()??.clean)
        };
        let sheet = sheet(capture.name, &renders.path, proposer.as_ref(), &mut clean);
        sheet.map(Some).map_err(WorkError::failed)
    }

    fn figures(&self, results: &Results) -> TruthFigures {
        let names: Vec<&str> = self.captures.iter().map(|c| c.name).collect();
        TruthFigures {
            format: FORMAT.into(),
            version: 1,
            program: env!("CARGO_PKG_VERSION").into(),
            command: self.recipe.command(&names, &self.request.seeds),
            recipe: self.recipe.clone(),
            seeds: results.seeds.clone(),
            pipelines: results.pipelines.clone(),
            failed: results.failed.clone(),
            captures: self.captures.iter().map(|c| of_capture(c, &results.scored)).collect(),
        }
    }
}
