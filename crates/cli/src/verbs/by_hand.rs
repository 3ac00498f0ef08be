//! One stage by hand, without a pipeline file: a run until that stage, whose result is put where the user
//! wants it.
//!
//! The run has a cache of its own. Beside a result it is a hidden folder, which goes when the result is there
//! and stays after an interruption, so that the same command goes on. For a result that is only read it is a
//! temporary folder.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::Instant;

use use3d_import::ImportParams;
use use3d_pipeline::config::{LoadOptions, for_capture, without_captures};
use use3d_scene::Origin;
use use3d_stages::{CALIBRATOR, TARGETS};
use use3d_workflow::machine::{bytes, seconds};
use use3d_workflow::run::NodeResult;
use use3d_workflow::{Builder, Cache, Event, Graph, Registry, RunOptions, Source, Stage, Summary, leftovers};

use crate::App;
use crate::args::{
    CalibrateArgs, CalibrationArgs, EnhanceArgs, ImportArgs, ReconstructArgs, Spelled, TargetsArgs, as_typed,
};
use crate::destination::{
    check_file, check_folder, checkpoints_in, copy_file, copy_folder, path_text, word, work_of,
};
use crate::error::{CliError, Done};
use crate::verbs::loaded::stages;
use crate::verbs::view::watched;
use crate::verbs::web::scene_name;

/// Creates a folder that is removed at the end of the command.
pub(crate) fn scratch() -> Result<leftovers::Scratch, CliError> {
    leftovers::scratch().map_err(|e| {
        CliError::Failed(format!("cannot make a temporary folder: {e}; set TMPDIR to one with space"))
    })
}

/// The role in which stages read a prepared capture, and the stage that prepares it.
const IMPORT: &str = "import";

/// A stage by hand.
#[derive(Clone, Default)]
pub(crate) struct ByHand<'a> {
    /// The stage.
    pub(crate) stage: &'static str,
    /// The capture; `None` for a stage that reads none.
    pub(crate) capture: Option<&'a Path>,
    /// Finished results, by the role in which stages read them; `None` stands for an input that is left out.
    pub(crate) given: BTreeMap<&'static str, Option<PathBuf>>,
    /// Flags that stand for settings.
    pub(crate) flags: Vec<Spelled>,
    /// Settings; they win over the flags.
    pub(crate) sets: Vec<String>,
    /// The models folder.
    pub(crate) models: Option<&'a Path>,
    /// The pairs or the calibrator.
    pub(crate) calibration: CalibrationArgs,
}

/// The seed of a setting `seed=N`, which belongs to no single stage.
fn is_seed(set: &str) -> bool {
    set.split_once('=').is_some_and(|(key, _)| key.trim() == "seed")
}

impl<'a> ByHand<'a> {
    /// A stage on a capture, which may be prepared already.
    pub(crate) fn on(capture: &'a Path, stage: &'static str) -> Self {
        let prepared = stage != IMPORT && use3d_import::is_prepared(capture);
        let given = prepared.then(|| (IMPORT, Some(capture.to_path_buf())));
        Self { stage, capture: Some(capture), given: given.into_iter().collect(), ..Self::default() }
    }

    /// The import of a capture, unless the capture is prepared already.
    pub(crate) fn import_of(capture: &'a Path) -> Self {
        Self { stage: IMPORT, ..Self::on(capture, "") }
    }

    /// The stages that are run, the last one first.
    fn runs<'r>(&self, registry: &'r Registry) -> Vec<&'r Stage> {
        let mut needed = vec![self.stage];
        let mut runs = Vec::new();
        for stage in registry.stages().iter().rev() {
            if !needed.contains(&stage.name()) {
                continue;
            }
            let inputs = stage.inputs.iter().filter(|input| !self.given.contains_key(input.role));
            needed.extend(inputs.filter_map(|input| match input.source {
                Source::Stage(from) => Some(from),
                _ => None,
            }));
            runs.push(stage);
        }
        runs
    }

    /// The settings with the names of their stages: `KEY` is a parameter of the last stage that has it.
    fn settings(&self, registry: &Registry) -> Result<Vec<(String, String)>, CliError> {
        let runs = self.runs(registry);
        let mut all: Vec<(String, String)> = self.flags.iter().map(|flag| (flag.set(), flag.set())).collect();
        for set in &self.sets {
            let refuse = |what: &str| Err(CliError::Input(format!("--set {set}: {what}")));
            if is_seed(set) {
                if !runs.iter().any(|stage| stage.seeded) {
                    return refuse("this command draws no random numbers, so it has no seed; leave it out");
                }
                all.push((set.clone(), set.clone()));
                continue;
            }
            let head = set.split(['=', '.']).next().unwrap_or_default().trim();
            let names_a_stage =
                set.trim_start()[head.len()..].starts_with('.') && registry.stage(head).is_ok();
            if names_a_stage {
                if !runs.iter().any(|stage| stage.name() == head) {
                    return refuse(&format!(
                        "this command does not run the stage `{head}`; give this to `use3d run`"
                    ));
                }
                all.push((set.clone(), set.clone()));
                continue;
            }
            let has = |stage: &&&Stage| {
                let defaults = stage.parameters(&serde_json::json!({}));
                defaults.is_ok_and(|defaults| defaults.json().get(head).is_some())
            };
            // The last stage reports a key that no stage has, and suggests the nearest one.
            let stage = runs.iter().find(has).or(runs.first()).map_or(self.stage, |stage| stage.name());
            all.push((set.clone(), format!("{stage}.{}", set.trim_start())));
        }
        Ok(all)
    }

    /// Runs until the stage of this command with the cache in `cache`, and returns the folder of its result
    /// there.
    ///
    /// # Errors
    /// The input is refused, a stage failed, or the run was interrupted.
    pub(crate) fn run(&self, app: &App, cache: &Path) -> Result<PathBuf, CliError> {
        self.check_paths()?;
        self.run_until(app, self.stage, cache)
    }

    /// The parameters of the stage of this command.
    ///
    /// # Errors
    /// A setting is refused.
    pub(crate) fn parameters<P: Clone + 'static>(&self, cache: &Path) -> Result<P, CliError> {
        let (_, graph) = self.loaded(cache)?;
        let node = graph.nodes.iter().find(|node| node.stage_name == self.stage);
        let own = node.and_then(|node| node.parameters.of::<P>()).cloned();
        own.ok_or_else(|| CliError::Failed(format!("`{}` has other parameters", self.stage)))
    }

    /// True if this command's settings need the result of a stage.
    ///
    /// # Errors
    /// A setting is refused.
    fn needs(&self, stage: &str, cache: &Path) -> Result<bool, CliError> {
        let (_, graph) = self.loaded(cache)?;
        Ok(graph.nodes.iter().any(|node| node.stage_name == stage))
    }

    /// The pipeline of this command.
    fn loaded(&self, cache: &Path) -> Result<(Builder, Graph), CliError> {
        let registry = stages()?;
        let settings = self.settings(&registry)?;
        let options = LoadOptions {
            sets: settings.iter().map(|(_, full)| full.clone()).collect(),
            cache: Some(cache.to_path_buf()),
            models: self.models.map(Path::to_path_buf),
            pairs: self.calibration.pairs(),
            calibrator: self.calibration.calibrator.clone(),
            ..LoadOptions::default()
        };
        let typed = |message: String| {
            let full = settings.iter().find(|(_, full)| message.contains(&format!("--set {full}")));
            let message = match full {
                Some((short, full)) => message.replace(&format!("--set {full}"), &format!("--set {short}")),
                None => message,
            };
            CliError::Input(as_typed(&message, &self.flags))
        };
        // Settings are refused before anybody looks at a capture.
        let mut pipeline = without_captures(&registry, &options).map_err(|error| typed(error.to_string()))?;
        if let Some(capture) = self.capture {
            if !capture.is_dir() {
                use3d_import::import(capture, &ImportParams::default()).map_err(CliError::input)?;
            } else if !use3d_import::is_prepared(capture) {
                use3d_import::check_layout(capture).map_err(CliError::input)?;
            }
            pipeline = for_capture(&registry, capture, &options).map_err(CliError::input)?;
        }
        pipeline.batch.given.clone_from(&self.given);
        let graph = Graph::new(&registry, &pipeline.batch).map_err(|error| typed(error.to_string()))?;
        let cache = Cache::open(cache, false).map_err(CliError::input)?;
        Ok((Builder::new(registry, cache), graph))
    }

    /// Runs until one of the stages that this command runs.
    fn run_until(&self, app: &App, until: &str, cache: &Path) -> Result<PathBuf, CliError> {
        let (builder, graph) = self.loaded(cache)?;
        let until_only = [until.to_string()];
        let gaps = builder.gaps(&graph, Some(&until_only), None);
        if !gaps.is_empty() {
            return Err(CliError::input(gaps));
        }
        let options = RunOptions {
            cores: app.threads,
            stop: app.stop.clone(),
            until: Some(until_only.into()),
            ..RunOptions::default()
        };
        let summary = builder.run(&graph, &options, &app.listener);
        let made =
            summary.nodes.iter().find(|node| node.stage == until).and_then(|node| node.artifact.as_ref());
        made.map(|artifact| artifact.path.clone()).ok_or_else(|| problem(&summary))
    }

    /// Refuses a path that does not exist by the name of its argument.
    fn check_paths(&self) -> Done {
        let pairs = self.calibration.pairs();
        let pairs = pairs.iter().flat_map(|(input, target)| [("--input", input), ("--target", target)]);
        let given = self.given.iter().filter_map(|(role, path)| Some((named(role), path.as_ref()?)));
        let needed = given.chain(pairs).map(|(name, path)| (name, path.as_path(), ""));
        let models = self.models.map(|path| ("--models or USE3D_MODELS", path));
        let calibrator = self.calibration.calibrator.as_deref().map(|path| ("--calibrator", path));
        let optional = models.into_iter().chain(calibrator);
        let optional = optional.map(|(name, path)| (name, path, " or leave it out"));
        match needed.chain(optional).find(|(_, path, _)| !path.exists()) {
            None => Ok(()),
            Some((name, path, without)) => Err(CliError::Input(format!(
                "{name}: {} does not exist; correct the path{without}",
                path_text(path)
            ))),
        }
    }

    /// The folder of the capture, prepared. If a scene is given, a capture that the scene was not made from
    /// is refused; if views are scored, so is a split that holds out views of the scene's training.
    pub(crate) fn imported(
        &self,
        app: &App,
        cache: &Path,
        scene: Option<&Path>,
        scored: bool,
    ) -> Result<PathBuf, CliError> {
        let import = match self.given.get(IMPORT).cloned().flatten() {
            Some(folder) => folder,
            None => self.run_until(app, IMPORT, cache)?,
        };
        let Some(scene) = scene else { return Ok(import) };
        let Some(origin) = Origin::read(scene).map_err(CliError::input)? else { return Ok(import) };
        let capture = use3d_import::load_prepared(&import).map_err(CliError::input)?.capture;
        origin.check_capture(scene, &capture).map_err(CliError::input)?;
        if scored {
            origin.check_split(scene, &capture).map_err(CliError::input)?;
        }
        Ok(import)
    }
}

/// The name of a given result's argument.
fn named(role: &str) -> &str {
    match role {
        IMPORT => "CAPTURE_DIR",
        "scene" | "enhanced" => "SCENE_DIR",
        "targets" => "--targets",
        "reference" => "--warp-by",
        role => role,
    }
}

/// The reason why a run has no result.
fn problem(summary: &Summary) -> CliError {
    if summary.interrupted {
        return CliError::Interrupted;
    }
    let failed = summary.failed().find_map(|node| match &node.result {
        NodeResult::Failed { reason, bad_input, .. } => Some((reason.clone(), *bad_input)),
        _ => None,
    });
    match failed {
        Some((reason, true)) => CliError::Input(reason),
        Some((reason, false)) => CliError::Failed(reason),
        None => CliError::Failed("the stage did not run".into()),
    }
}

/// The hidden folder beside a result with the cache of its run. Trainings with the same `--out` but other
/// parameters or inputs share the folder; each resumes from its own checkpoints.
struct HandWork<'a> {
    folder: PathBuf,
    /// The checkpoints that existed before: those of this training, which removes the ones it no longer
    /// needs, or those of others.
    before: BTreeSet<PathBuf>,
    app: &'a App,
}

impl<'a> HandWork<'a> {
    fn beside(app: &'a App, out: &Path) -> Self {
        let folder = work_of(out);
        Self { before: checkpoints_in(&folder).collect(), folder, app }
    }

    /// Passes the result of the work on, and removes the folder unless a checkpoint in it is still needed.
    fn end<T>(self, done: Result<T, CliError>) -> Result<T, CliError> {
        let Self { folder, before, app } = self;
        let needed = match &done {
            Ok(_) => checkpoints_in(&folder).any(|path| before.contains(&path)),
            Err(_) => checkpoints_in(&folder).next().is_some(),
        };
        if !needed {
            if let Err(error) = std::fs::remove_dir_all(&folder) {
                tracing::debug!("{}: {error}", folder.display());
            }
        } else if done.is_ok() {
            for path in checkpoints_in(&folder).filter(|path| !before.contains(path)) {
                if let Err(error) = std::fs::remove_file(&path) {
                    tracing::warn!("{}: {error}; this checkpoint is no longer needed", path.display());
                }
            }
            remark!(
                app,
                "{}: kept checkpoints of a run with other parameters or inputs; delete the folder if you will \
                 not resume it",
                path_text(&folder)
            );
        }
        done
    }
}

/// Prints the path of a result, its size, its duration, and the next step.
fn finished(app: &App, out: &Path, started: Instant, next: &str) {
    let time = seconds(started.elapsed().as_secs_f64());
    remark!(app, "{}: {}, in {time}; next: {next}", path_text(out), bytes(size(out)));
}

/// The bytes of a file, or of all files in a folder.
fn size(path: &Path) -> u64 {
    match std::fs::read_dir(path) {
        Ok(entries) => entries.filter_map(Result::ok).map(|entry| size(&entry.path())).sum(),
        Err(_) => std::fs::metadata(path).map_or(0, |file| file.len()),
    }
}

/// The same app, which also prints the time of each part of a stage on stdout.
fn profiling(app: &App) -> App {
    app.heard_by(|event| {
        if let Event::Profile { text, .. } = event {
            print!("{text}");
        }
    })
}

pub(crate) fn import(app: &App, args: &ImportArgs) -> Done {
    let started = Instant::now();
    check_folder(&args.out, args.replace.force)?;
    let hand = ByHand {
        flags: args.size.spelled(),
        sets: args.settings.set.clone(),
        ..ByHand::on(&args.capture, IMPORT)
    };
    let work = HandWork::beside(app, &args.out);
    let made = hand.imported(app, &work.folder, None, false);
    work.end(made.and_then(|made| copy_folder(&made, &args.out, args.replace.force)))?;
    finished(app, &args.out, started, &format!("use3d reconstruct {} --out scene/", word(&args.out)));
    Ok(())
}

pub(crate) fn reconstruct(app: &App, args: &ReconstructArgs) -> Done {
    let started = Instant::now();
    check_folder(&args.out, args.replace.force)?;
    let mut flags = args.common.spelled();
    flags.extend(args.engine.choice().map(|e| Spelled::new("--engine", "reconstruct", "engine", e)));
    let hand = ByHand {
        flags,
        sets: args.settings.set.clone(),
        models: args.models.as_deref(),
        ..ByHand::on(&args.capture, "reconstruct")
    };
    let app = if args.profile { &profiling(app) } else { app };
    let work = HandWork::beside(app, &args.out);
    let made = watched(app, &args.watch, Some(&scene_name(&args.out)), |app| {
        hand.imported(app, &work.folder, None, false)?;
        let made = hand.run(app, &work.folder)?;
        copy_folder(&made, &args.out, args.replace.force)
    });
    work.end(made)?;
    let (scene, capture) = (word(&args.out), word(&args.capture));
    let next =
        format!("use3d render {scene} --cameras {capture} --out renders/ --modes reconstruction,clear");
    finished(app, &args.out, started, &next);
    Ok(())
}

pub(crate) fn calibrate(app: &App, args: &CalibrateArgs) -> Done {
    let started = Instant::now();
    check_file("--out", &args.out, args.replace.force, &[])?;
    let proposer = args.proposer.iter();
    let hand = ByHand {
        stage: "calibrate",
        flags: proposer.map(|name| Spelled::new("--proposer", "pairs", "proposer", name)).collect(),
        sets: args.settings.set.clone(),
        models: args.models.as_deref(),
        calibration: CalibrationArgs::of(Some((args.input.clone(), args.target.clone())), None),
        ..ByHand::default()
    };
    let work = HandWork::beside(app, &args.out);
    let made = hand.run(app, &work.folder);
    work.end(made.and_then(|made| copy_file("--out", &made.join(CALIBRATOR), &args.out)))?;
    let calibrator = word(&args.out);
    let next = format!("use3d targets SCENE CAPTURE --calibrator {calibrator} --out targets.safetensors");
    finished(app, &args.out, started, &next);
    Ok(())
}

pub(crate) fn targets(app: &App, args: &TargetsArgs) -> Done {
    let started = Instant::now();
    let force = args.replace.force;
    check_file("--out", &args.out, force, &[])?;
    // The pictures that show the reason for consensus are written beside the file.
    let previews = args.out.with_extension("previews");
    check_folder(&previews, force)?;
    let mut hand = ByHand {
        flags: args.size.spelled(),
        sets: args.settings.set.clone(),
        models: args.models.as_deref(),
        calibration: CalibrationArgs::of(None, args.calibrator.clone()),
        ..ByHand::on(&args.capture, "targets")
    };
    hand.given.insert("scene", Some(args.scene.clone()));
    let work = HandWork::beside(app, &args.out);
    let made = hand.imported(app, &work.folder, Some(&args.scene), false).and_then(|_| {
        if args.calibrator.is_none() && hand.needs("calibrate", &work.folder)? {
            return Err(CliError::input(
                "calibrated = true needs a calibrator: give --calibrator FILE (`use3d calibrate` makes one)",
            ));
        }
        let made = hand.run(app, &work.folder)?;
        if made.join("previews").is_dir() {
            copy_folder(&made.join("previews"), &previews, force)?;
        }
        copy_file("--out", &made.join(TARGETS), &args.out)
    });
    work.end(made)?;
    let (scene, capture, targets) = (word(&args.scene), word(&args.capture), word(&args.out));
    let next = format!("use3d enhance {scene} {capture} --targets {targets} --out enhanced-scene/");
    finished(app, &args.out, started, &next);
    Ok(())
}

pub(crate) fn enhance(app: &App, args: &EnhanceArgs) -> Done {
    let started = Instant::now();
    check_folder(&args.out, args.replace.force)?;
    let mut flags = args.size.spelled();
    flags.extend(args.iterations.map(|n| Spelled::new("--iterations", "enhance", "iterations", n)));
    flags.extend(args.engine.choice().map(|e| Spelled::new("--engine", "enhance", "engine", e)));
    let mut hand = ByHand {
        flags,
        sets: args.settings.set.clone(),
        models: args.models.as_deref(),
        ..ByHand::on(&args.capture, "enhance")
    };
    hand.given.insert("scene", Some(args.scene.clone()));
    hand.given.insert("targets", Some(args.targets.clone()));
    let app = if args.profile { &profiling(app) } else { app };
    let work = HandWork::beside(app, &args.out);
    let made = hand.imported(app, &work.folder, Some(&args.scene), false).and_then(|_| {
        let made = hand.run(app, &work.folder)?;
        copy_folder(&made, &args.out, args.replace.force)
    });
    work.end(made)?;
    let (scene, capture) = (word(&args.out), word(&args.capture));
    let next =
        format!("use3d render {scene} --cameras {capture} --out renders/ --modes enhanced-clear,enhanced");
    finished(app, &args.out, started, &next);
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_goes_to_the_last_stage_that_has_it() {
        let registry = stages().ok().unwrap();
        let settings = |hand: &ByHand<'_>, set: &str| {
            let hand = ByHand { sets: vec![set.into()], ..hand.clone() };
            hand.settings(&registry).map(|all| all[0].1.clone()).map_err(|error| error.text().to_string())
        };
        let mut hand = ByHand { stage: "enhance", capture: Some(Path::new("reef")), ..ByHand::default() };
        hand.given.insert("scene", None);
        hand.given.insert("targets", None);
        assert_eq!(settings(&hand, "iterations=3").unwrap(), "enhance.iterations=3");
        assert_eq!(settings(&hand, "max_side=64").unwrap(), "import.max_side=64");
        assert_eq!(settings(&hand, "import.max_side=64").unwrap(), "import.max_side=64");
        assert_eq!(settings(&hand, "seed=7").unwrap(), "seed=7");
        assert!(settings(&hand, "reconstruct.iterations=3").unwrap_err().contains("does not run the stage"));
        let import = ByHand { stage: IMPORT, ..hand.clone() };
        assert!(settings(&import, "seed=7").unwrap_err().contains("draws no random numbers"));
    }
}
