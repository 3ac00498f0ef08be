//! One stage by hand, without a pipeline file: a run until that stage, whose result is put where the user
//! wants it.
//!
//! The run has a cache of its own. Beside a result it is a hidden folder, which goes when the result is there
//! and stays after an interruption, so that the same command goes on. For a result that is only read it is a
//! temporary folder.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use use3d_import::ImportParams;
use use3d_scene::Origin;
use use3d_workflow::run::NodeResult;
use use3d_workflow::{Builder, Cache, Graph, Registry, RunOptions, Source, Stage, Summary, leftovers};

use crate::WorkError;
use crate::destination::{checkpoints_in, path_text, work_of};
use crate::host::Host;
use crate::loaded::stages;
use crate::spelled::{Spelled, as_typed};
use use3d_config::{LoadOptions, for_capture, without_captures};

/// Creates a folder that is removed at the end of the work.
///
/// # Errors
/// No temporary folder can be made.
pub fn scratch() -> Result<leftovers::Scratch, WorkError> {
    leftovers::scratch().map_err(|e| {
        WorkError::Failed(format!("cannot make a temporary folder: {e}; set TMPDIR to one with space"))
    })
}

/// The role in which stages read a prepared capture, and the stage that prepares it.
pub const IMPORT: &str = "import";

/// A stage by hand.
#[derive(Clone, Default)]
pub struct ByHand<'a> {
    /// The stage.
    pub stage: &'static str,
    /// The capture; `None` for a stage that reads none.
    pub capture: Option<&'a Path>,
    /// Finished results, by the role in which stages read them; `None` stands for an input that is left out.
    pub given: BTreeMap<&'static str, Option<PathBuf>>,
    /// Flags that stand for settings.
    pub flags: Vec<Spelled>,
    /// Settings, which win over the flags; the models folder; the pairs or the calibrator.
    pub options: LoadOptions,
}

/// The seed of a setting `seed=N`, which belongs to no single stage.
fn is_seed(set: &str) -> bool {
    set.split_once('=').is_some_and(|(key, _)| key.trim() == "seed")
}

impl<'a> ByHand<'a> {
    /// A stage on a capture, which may be prepared already.
    pub fn on(capture: &'a Path, stage: &'static str) -> Self {
        let prepared = stage != IMPORT && use3d_import::is_prepared(capture);
        let given = prepared.then(|| (IMPORT, Some(capture.to_path_buf())));
        Self { stage, capture: Some(capture), given: given.into_iter().collect(), ..Self::default() }
    }

    /// The import of a capture, unless the capture is prepared already.
    pub fn import_of(capture: &'a Path) -> Self {
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
    fn settings(&self, registry: &Registry) -> Result<Vec<(String, String)>, WorkError> {
        let runs = self.runs(registry);
        let mut all: Vec<(String, String)> = self.flags.iter().map(|flag| (flag.set(), flag.set())).collect();
        for set in &self.options.sets {
            let refuse = |what: &str| Err(WorkError::Input(format!("--set {set}: {what}")));
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
    pub fn run(&self, host: &Host, cache: &Path) -> Result<PathBuf, WorkError> {
        self.check_paths()?;
        self.run_until(host, self.stage, cache)
    }

    /// The parameters of the stage of this command.
    ///
    /// # Errors
    /// A setting is refused.
    pub fn parameters<P: Clone + 'static>(&self, cache: &Path) -> Result<P, WorkError> {
        let (_, graph) = self.loaded(cache)?;
        let node = graph.nodes.iter().find(|node| node.stage_name == self.stage);
        let own = node.and_then(|node| node.parameters.of::<P>()).cloned();
        own.ok_or_else(|| WorkError::Failed(format!("`{}` has other parameters", self.stage)))
    }

    /// True if this command's settings need the result of a stage.
    ///
    /// # Errors
    /// A setting is refused.
    pub fn needs(&self, stage: &str, cache: &Path) -> Result<bool, WorkError> {
        let (_, graph) = self.loaded(cache)?;
        Ok(graph.nodes.iter().any(|node| node.stage_name == stage))
    }

    /// The pipeline of this command.
    fn loaded(&self, cache: &Path) -> Result<(Builder, Graph), WorkError> {
        let registry = stages()?;
        let settings = self.settings(&registry)?;
        let options = LoadOptions {
            sets: settings.iter().map(|(_, full)| full.clone()).collect(),
            cache: Some(cache.to_path_buf()),
            ..self.options.clone()
        };
        let typed = |message: String| {
            let full = settings.iter().find(|(_, full)| message.contains(&format!("--set {full}")));
            let message = match full {
                Some((short, full)) => message.replace(&format!("--set {full}"), &format!("--set {short}")),
                None => message,
            };
            WorkError::Input(as_typed(&message, &self.flags))
        };
        // Settings are refused before anybody looks at a capture.
        let mut pipeline = without_captures(&registry, &options).map_err(|error| typed(error.to_string()))?;
        if let Some(capture) = self.capture {
            if !capture.is_dir() {
                use3d_import::import(capture, &ImportParams::default()).map_err(WorkError::input)?;
            } else if !use3d_import::is_prepared(capture) {
                use3d_import::check_layout(capture).map_err(WorkError::input)?;
            }
            pipeline = for_capture(&registry, capture, &options).map_err(WorkError::input)?;
        }
        pipeline.batch.given.clone_from(&self.given);
        let graph = Graph::new(&registry, &pipeline.batch).map_err(|error| typed(error.to_string()))?;
        let cache = Cache::open(cache, false).map_err(WorkError::input)?;
        Ok((Builder::new(registry, cache), graph))
    }

    /// Runs until one of the stages that this command runs.
    fn run_until(&self, host: &Host, until: &str, cache: &Path) -> Result<PathBuf, WorkError> {
        let (builder, graph) = self.loaded(cache)?;
        let until_only = [until.to_string()];
        // A missing device of the last stage is named before the first one runs.
        let mut gaps = builder.missing_devices(&graph, Some(&[self.stage.to_string()]), None);
        if gaps.is_empty() {
            gaps = builder.gaps(&graph, Some(&until_only), None);
        }
        if !gaps.is_empty() {
            return Err(WorkError::input(gaps));
        }
        let options = RunOptions { until: Some(until_only.into()), ..host.options() };
        let summary = builder.run(&graph, &options, &host.listener);
        let made =
            summary.nodes.iter().find(|node| node.stage == until).and_then(|node| node.artifact.as_ref());
        made.map(|artifact| artifact.path.clone()).ok_or_else(|| problem(&summary))
    }

    /// Refuses a path that does not exist by the name of its argument.
    fn check_paths(&self) -> Result<(), WorkError> {
        let pairs =
            self.options.pairs.iter().flat_map(|(input, target)| [("--input", input), ("--target", target)]);
        let given = self.given.iter().filter_map(|(role, path)| Some((named(role), path.as_ref()?)));
        let needed = given.chain(pairs).map(|(name, path)| (name, path.as_path(), ""));
        let models = self.options.models.as_deref().map(|path| ("--models or USE3D_MODELS", path));
        let calibrator = self.options.calibrator.as_deref().map(|path| ("--calibrator", path));
        let optional = models.into_iter().chain(calibrator);
        let optional = optional.map(|(name, path)| (name, path, " or leave it out"));
        match needed.chain(optional).find(|(_, path, _)| !path.exists()) {
            None => Ok(()),
            Some((name, path, without)) => Err(WorkError::Input(format!(
                "{name}: {} does not exist; correct the path{without}",
                path_text(path)
            ))),
        }
    }

    /// The folder of the capture, prepared. If a scene is given, a capture that the scene was not made from
    /// is refused; if views are scored, so is a split that holds out views of the scene's training.
    ///
    /// # Errors
    /// The capture is refused, or its import failed or was interrupted.
    pub fn imported(
        &self,
        host: &Host,
        cache: &Path,
        scene: Option<&Path>,
        scored: bool,
    ) -> Result<PathBuf, WorkError> {
        let import = match self.given.get(IMPORT).cloned().flatten() {
            Some(folder) => folder,
            None => self.run_until(host, IMPORT, cache)?,
        };
        let Some(scene) = scene else { return Ok(import) };
        let Some(origin) = Origin::read(scene).map_err(WorkError::input)? else { return Ok(import) };
        let capture = use3d_import::load_prepared(&import).map_err(WorkError::input)?.capture;
        origin.check_capture(scene, &capture).map_err(WorkError::input)?;
        if scored {
            origin.check_split(scene, &capture).map_err(WorkError::input)?;
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
fn problem(summary: &Summary) -> WorkError {
    if summary.interrupted {
        return WorkError::Interrupted;
    }
    let failed = summary.failed().find_map(|node| match &node.result {
        NodeResult::Failed { reason, bad_input, .. } => Some((reason.clone(), *bad_input)),
        _ => None,
    });
    match failed {
        Some((reason, true)) => WorkError::Input(reason),
        Some((reason, false)) => WorkError::Failed(reason),
        None => WorkError::Failed("the stage did not run".into()),
    }
}

/// The hidden folder beside a result with the cache of its run. Trainings with the same `--out` but other
/// parameters or inputs share the folder; each resumes from its own checkpoints.
pub struct HandWork {
    /// Its path.
    pub folder: PathBuf,
    /// The checkpoints that existed before: those of this training, which removes the ones it no longer
    /// needs, or those of others.
    before: BTreeSet<PathBuf>,
}

impl HandWork {
    /// The folder for a result at `out`; it need not exist yet.
    pub fn beside(out: &Path) -> Self {
        let folder = work_of(out);
        Self { before: checkpoints_in(&folder).collect(), folder }
    }

    /// Ends the work, and removes the folder unless a checkpoint in it is still needed. `made` is true if the
    /// result is there. Returns true if checkpoints of a run with other parameters or inputs are kept.
    pub fn end(&self, made: bool) -> bool {
        let Self { folder, before } = self;
        let needed = match made {
            true => checkpoints_in(folder).any(|path| before.contains(&path)),
            false => checkpoints_in(folder).next().is_some(),
        };
        if !needed {
            if let Err(error) = std::fs::remove_dir_all(folder) {
                tracing::debug!("{}: {error}", folder.display());
            }
        } else if made {
            for path in checkpoints_in(folder).filter(|path| !before.contains(path)) {
                if let Err(error) = std::fs::remove_file(&path) {
                    tracing::warn!("{}: {error}; this checkpoint is no longer needed", path.display());
                }
            }
        }
        needed && made
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setting_goes_to_the_last_stage_that_has_it() {
        let registry = stages().ok().unwrap();
        let settings = |hand: &ByHand<'_>, set: &str| {
            let options = LoadOptions { sets: vec![set.into()], ..LoadOptions::default() };
            let hand = ByHand { options, ..hand.clone() };
            hand.settings(&registry).map(|all| all[0].1.clone()).map_err(|error| error.to_string())
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
