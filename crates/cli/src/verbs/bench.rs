//! The benchmark against known truth.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;
use use3d_judge::scores::SceneScores;
use use3d_judge::truth::Truth;
use use3d_pipeline::bench::captures::{Capture, named};
use use3d_pipeline::bench::figures::{FORMAT, Scored, TruthFigures, of_capture};
use use3d_pipeline::bench::output;
use use3d_pipeline::bench::picture::{Sheet, sheet};
use use3d_pipeline::bench::runs::{DEFAULT, LearntFrom, Recipe, STAGES};
use use3d_pipeline::config::{LoadOptions, Pipeline, from_text};
use use3d_stages::{ProposerChoice, SCORES, open_proposer, read_json};
use use3d_workflow::machine::seconds;
use use3d_workflow::plan::State;
use use3d_workflow::{Builder, Cache, Event, Graph, Plan, RunOptions, Summary, place};

use crate::App;
use crate::args::{Baselines, BenchTruthArgs};
use crate::destination::path_text;
use crate::error::{CliError, Done};
use crate::output::json;
use crate::size::parse_size;
use crate::verbs::by_hand::scratch;
use crate::verbs::loaded::stages;
use crate::verbs::synth::keep_capture;

/// Seconds of a training step per pixel, on two cores, if no earlier run gives a better value: 8 ms at
/// 320×180.
const STEP_PER_PIXEL: f64 = 1.4e-7;

/// The arguments, checked.
struct Bench<'a> {
    app: &'a App,
    args: &'a BenchTruthArgs,
    recipe: Recipe,
    captures: Vec<Capture>,
    seeds: Vec<u64>,
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

pub(crate) fn truth(app: &App, args: &BenchTruthArgs) -> Done {
    let bench = Bench::new(app, args)?;
    bench.check()?;
    for &seed in &bench.seeds {
        for capture in &bench.captures {
            let params = capture.parameters(seed, bench.recipe.views, bench.recipe.size);
            // Finished captures are kept.
            keep_capture(app, &params, &bench.folder(capture, seed)).map_err(|e| match e {
                CliError::Stopped => CliError::Interrupted,
                other => other,
            })?;
        }
    }
    let cache = args.cache.cache.clone().unwrap_or_else(|| args.out.join("cache"));
    let ready: Vec<Seed> =
        bench.seeds.iter().map(|&seed| bench.load(seed, &args.out, &cache)).collect::<Result<_, _>>()?;
    let mut results = Results::default();
    let mut delivered = Vec::new();
    for (i, seed) in ready.iter().enumerate() {
        bench.forecast(&ready[i..]);
        let options = RunOptions {
            jobs: args.jobs,
            cores: app.threads,
            keep_going: true,
            until: Some(STAGES.map(String::from).to_vec()),
            stop: app.stop.clone(),
            ..RunOptions::default()
        };
        let summary = seed.builder.run(&seed.graph, &options, &app.listener);
        if summary.interrupted {
            return Err(CliError::Interrupted);
        }
        bench.gather(seed, &summary, &mut results)?;
        // The table is written after every seed, because the next seed may take hours.
        delivered = output::deliver(&bench.figures(&results), &results.pictures, &args.out)?;
    }
    if args.json {
        json(&bench.figures(&results))?;
    } else if !app.quiet {
        for path in delivered {
            println!("{}", path_text(&path));
        }
    }
    match results.failed.as_slice() {
        [] => Ok(()),
        failed => Err(CliError::Failed(format!(
            "{}; the table is written without it; run the same command to try again",
            failed.join("; ")
        ))),
    }
}

impl<'a> Bench<'a> {
    fn new(app: &'a App, args: &'a BenchTruthArgs) -> Result<Self, CliError> {
        let recipe = Recipe {
            views: args.views,
            size: parse_size(&args.size)?,
            iterations: args.iterations as u64,
            baselines: args.baselines == Baselines::All,
            sets: args.settings.sets(),
            learnt_from: match (args.calibration.pairs(), &args.calibration.calibrator) {
                (Some(_), _) => LearntFrom::Pairs,
                (None, Some(_)) => LearntFrom::Calibrator,
                (None, None) => LearntFrom::Nothing,
            },
        };
        recipe.check().map_err(CliError::Input)?;
        let captures = named(&args.captures).map_err(|e| CliError::Input(format!("--captures: {e}")))?;
        let mut seeds: Vec<u64> = args.seeds.iter().map(|s| u64::from(*s)).collect();
        seeds.sort_unstable();
        seeds.dedup();
        for capture in &captures {
            capture.parameters(0, recipe.views, recipe.size).validate().map_err(CliError::input)?;
        }
        Ok(Self { app, args, recipe, captures, seeds })
    }

    /// The folder of a capture with a seed.
    fn folder(&self, capture: &Capture, seed: u64) -> std::path::PathBuf {
        self.args.out.join("captures").join(capture.folder(seed))
    }

    /// Makes every check that is possible before anything is made.
    fn check(&self) -> Done {
        output::check(&self.args.out)?;
        for &seed in &self.seeds {
            for capture in &self.captures {
                place::check(&self.folder(capture, seed), true)?;
            }
        }
        // Settings are checked before anything is rendered.
        let probe = scratch()?;
        let first = self.seeds.first().copied().unwrap_or_default();
        self.load(first, probe.path(), &probe.path().join("cache")).map(|_| ())
    }

    /// The pipeline of a seed with its graph; captures are below `out`.
    fn load(&self, seed: u64, out: &Path, cache: &Path) -> Result<Seed, CliError> {
        let registry = stages()?;
        let text = self.recipe.pipeline(&self.captures, seed);
        let options = LoadOptions {
            sets: self.recipe.sets.clone(),
            cache: Some(cache.to_path_buf()),
            models: self.args.cache.models.clone(),
            scenes: Vec::new(),
            pairs: self.args.calibration.pairs(),
            calibrator: self.args.calibration.calibrator.clone(),
        };
        let pipeline =
            from_text(&registry, &text, &out.join("truth.toml"), &options).map_err(CliError::input)?;
        let graph = Graph::new(&registry, &pipeline.batch).map_err(CliError::input)?;
        let cache = Cache::open(&pipeline.cache, self.args.cache.rehash).map_err(CliError::input)?;
        Ok(Seed { seed, text, pipeline, builder: Builder::new(registry, cache), graph })
    }

    /// Prints an estimate of the time for the remaining seeds.
    fn forecast(&self, left: &[Seed]) {
        if self.app.quiet {
            return;
        }
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
        self.app.listener.event(&Event::Note { label: &label, text: &text });
    }

    /// Adds the cached results of a seed's run.
    fn gather(&self, seed: &Seed, summary: &Summary, results: &mut Results) -> Done {
        results.seeds.push(seed.seed);
        results.pipelines.insert(seed.seed, seed.text.clone());
        for node in summary.failed() {
            results.failed.push(format!("{} with seed {}", node.label, seed.seed));
        }
        for node in summary.nodes.iter().filter(|n| n.stage == "evaluate") {
            let Some(artifact) = &node.artifact else { continue };
            let scores: SceneScores = read_json(&artifact.path.join(SCORES)).map_err(CliError::failed)?;
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
    fn picture(&self, capture: &Capture, seed: &Seed, summary: &Summary) -> Result<Option<Sheet>, CliError> {
        let artifact = |stage: &str| summary.artifact(capture.name, DEFAULT, stage);
        let (Some(renders), Some(scores)) = (artifact("render"), artifact("evaluate")) else {
            return Ok(None);
        };
        // The enhancer that was scored.
        let choice: ProposerChoice = match &scores.manifest.ingredients.parameters["proposer"] {
            Value::Null => ProposerChoice::default(),
            given => serde_json::from_value(given.clone()).map_err(CliError::failed)?,
        };
        let models = seed.pipeline.batch.externals.get("models").and_then(|m| m.as_deref().ok());
        let proposer = open_proposer(choice, models, &mut |_| {}).map_err(CliError::Failed)?;
        let folder = self.folder(capture, seed.seed);
        let mut clean = |stem: &str, size: (usize, usize)| {
            let truth = Truth::open(&folder, size, &mut |_| {})?;
            Some(truth.view(stem).ok()??.clean)
        };
        let sheet = sheet(capture.name, &renders.path, proposer.as_ref(), &mut clean);
        sheet.map(Some).map_err(CliError::failed)
    }

    fn figures(&self, results: &Results) -> TruthFigures {
        let names: Vec<&str> = self.captures.iter().map(|c| c.name).collect();
        TruthFigures {
            format: FORMAT.into(),
            version: 1,
            program: env!("CARGO_PKG_VERSION").into(),
            command: self.recipe.command(&names, &self.seeds),
            recipe: self.recipe.clone(),
            seeds: results.seeds.clone(),
            pipelines: results.pipelines.clone(),
            failed: results.failed.clone(),
            captures: self.captures.iter().map(|c| of_capture(c, &results.scored)).collect(),
        }
    }
}
