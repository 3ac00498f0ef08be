//! The jobs of a pipeline for a cluster's scheduler, and the words of their scripts.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use use3d_cluster::jobs::{self, Job, Layout};
use use3d_cluster::quote;
use use3d_cluster::site::{Scheduler, Site};
use use3d_cluster::slurm::{self, Submission, Submitted};
use use3d_workflow::machine::{self, seconds};
use use3d_workflow::plan::State;
use use3d_workflow::{Digest, Plan};

use crate::WorkError;
use crate::config::{LoadOptions, Pipeline};
use crate::destination::{OUT, path_text};
use crate::loaded::{Loaded, PipelineRequest, SceneVariant, cell_name};
use crate::results::Results;

/// The choices of a submission.
#[derive(Clone, Copy, Debug)]
pub struct SubmissionChoices<'a> {
    /// The scheduler.
    pub scheduler: Scheduler,
    /// The file of the site; `None` for the defaults.
    pub site: Option<&'a Path>,
    /// The way in which the work is cut into tasks.
    pub layout: Layout,
    /// Number of tasks that share the work; `None` for that of the site.
    pub workers: Option<usize>,
}

/// The jobs that compute the missing stages of a pipeline. Nothing is written.
pub struct PlannedSubmission<'a> {
    request: &'a PipelineRequest,
    choices: SubmissionChoices<'a>,
    loaded: Loaded,
    plan: Plan,
    /// The scenes and variants, each with the digest of its part of the pipeline.
    cells: BTreeMap<String, String>,
    /// The site.
    pub site: Site,
    /// The jobs; none if nothing can be submitted.
    pub jobs: Vec<Job>,
}

impl<'a> PlannedSubmission<'a> {
    /// Plans the jobs of a request.
    ///
    /// # Errors
    /// The pipeline or the site is refused, or the run would have to fail.
    pub fn new(request: &'a PipelineRequest, choices: SubmissionChoices<'a>) -> Result<Self, WorkError> {
        let loaded = request.clone().look()?;
        loaded.nothing_lacks(None, None)?;
        if let Some((stage, parameter)) = loaded.builder.undecided_device(&loaded.graph) {
            return Err(WorkError::Input(format!(
                "`{stage}.{parameter}` is auto: machines with and without a graphics card would make different \
                 results; write gpu or cpu"
            )));
        }
        let registry = &loaded.builder.registry;
        let stages: Vec<&str> = registry.stages().iter().map(|s| s.name()).collect();
        let read = choices.site.map(|file| Site::read(file, &stages)).transpose();
        let mut site = read.map_err(WorkError::input)?.unwrap_or_default();
        // The limit of the site's own configuration comes first, if Slurm reports one.
        if let (Scheduler::Slurm, Some(most)) = (choices.scheduler, slurm::largest_array()) {
            site.largest_array = site.largest_array.min(most);
        }
        let plan = loaded.builder.plan(&loaded.graph, None);
        let cells = loaded.parts();
        let mut planned = Self { request, choices, loaded, plan, cells, site, jobs: Vec::new() };
        planned.cut()?;
        Ok(planned)
    }

    /// Cuts the missing stages into jobs.
    fn cut(&mut self) -> Result<(), WorkError> {
        let (registry, SubmissionChoices { layout, workers, .. }) =
            (&self.loaded.builder.registry, self.choices);
        let jobs = jobs::of(&self.plan, registry, &self.site, layout, workers);
        self.jobs = jobs.map_err(WorkError::input)?;
        Ok(())
    }

    /// Leaves out the scenes and variants that jobs in the queue compute. Returns the number of the others
    /// that have something to do.
    ///
    /// # Errors
    /// As those of [`PlannedSubmission::new`].
    pub fn leave_out(&mut self, queued: &Submitted) -> Result<usize, WorkError> {
        self.cells.retain(|cell, part| cell.is_empty() || queued.cells.get(cell) != Some(part));
        let mut new = BTreeSet::new();
        for node in self.plan.nodes.iter_mut().filter(|node| !node.scene.is_empty()) {
            let cell = cell_name(&node.scene, &node.variant);
            if !self.cells.contains_key(&cell) {
                node.state = State::Unwanted;
            } else if matches!(node.state, State::Run(_) | State::Waiting(_)) {
                new.insert(cell);
            }
        }
        self.cut()?;
        Ok(new.len())
    }

    /// The folder of the scripts and logs for results in `out`, or in the usual folder of the pipeline.
    pub fn folder(&self, out: Option<&Path>) -> PathBuf {
        folder_of(&self.out(out))
    }

    fn out(&self, out: Option<&Path>) -> PathBuf {
        out.map_or_else(|| Path::new(OUT).join(&self.loaded.pipeline.batch.name), Path::to_path_buf)
    }

    /// Refuses `arguments` of the site that would change a result: the tasks would refuse them one by one.
    /// `read` turns the words of a `use3d run` into the pipeline that it would run.
    ///
    /// # Errors
    /// A word is no argument of `use3d run`, or changes the keys of results.
    pub fn check_arguments(
        &self,
        submission: &Submission,
        read: impl Fn(&[String]) -> Result<PipelineRequest, WorkError>,
    ) -> Result<(), WorkError> {
        let planned = self.loaded.parts();
        for (stage, needs) in self.site.stage.iter().filter(|(_, needs)| !needs.arguments.is_empty()) {
            let fault = |reason: String| WorkError::Input(format!("`stage.{stage}.arguments`: {reason}"));
            let changed =
                read(&[&submission.run[..], &needs.arguments].concat()).and_then(PipelineRequest::look);
            if changed.map_err(|error| fault(error.to_string()))?.parts() != planned {
                return Err(fault(format!(
                    "`{}` changes results, so the tasks of this stage would not belong to the others; write \
                     it into the pipeline file, or give it to `use3d submit`",
                    quote::words(&needs.arguments)
                )));
            }
        }
        Ok(())
    }

    /// The number of inputs that the pipeline names but that do not exist.
    pub fn missing(&self) -> usize {
        self.plan.unavailable()
    }

    /// The missing inputs, each with its reason.
    pub fn missing_lines(&self) -> impl Iterator<Item = String> {
        let own = self.plan.nodes.iter().filter(|node| node.shared_with.is_none());
        own.filter_map(|node| match &node.state {
            State::Unavailable(reason) => {
                Some(format!("{} {}: {reason}; it is not submitted", node.scene, node.stage))
            }
            _ => None,
        })
    }

    /// The plan in a line: stages to run, cached ones, and the forecast of their time.
    pub fn summary(&self) -> String {
        let plan = &self.plan;
        let (forecast, without) = plan.forecast();
        let about = match without {
            0 => format!("about {}", seconds(forecast)),
            n if n == plan.to_run() => "no forecast, because none of their stages ran before".to_string(),
            1 => format!("about {}, and 1 stage never ran before", seconds(forecast)),
            n => format!("about {}, and {n} stages never ran before", seconds(forecast)),
        };
        format!("{}: {} to run, {} cached; {about}", plan.pipeline, plan.to_run(), plan.cached())
    }

    /// The submission with results in `out`, or in the usual folder of the pipeline. `before` has the jobs of
    /// earlier ones that are still in the queue. `check_remote` checks the address of a store; `warn` gets
    /// the variables that tasks will lack.
    ///
    /// # Errors
    /// The results cannot be written there, or a script cannot hold a word of it.
    pub fn submission(
        &self,
        out: Option<&Path>,
        before: Submitted,
        check_remote: impl Fn(&str) -> Result<(), WorkError>,
        warn: &mut dyn FnMut(String),
    ) -> Result<Submission, WorkError> {
        let Loaded { pipeline, builder, graph } = &self.loaded;
        let out = self.out(out);
        Results::new(&out, &builder.cache, graph, None).check(graph, None)?;
        let place = std::env::current_dir()
            .map_err(|e| WorkError::Failed(format!("the current folder cannot be found: {e}")))?;
        let out = place.join(out);
        let mut run =
            vec![text(&self.request.target)?, "--cache".into(), text(&place.join(&pipeline.cache))?];
        let LoadOptions { sets, models, pairs, calibrator, .. } = &self.request.options;
        if let Some(models) = models {
            run.extend(["--models".to_string(), text(models)?]);
        }
        run.extend(sets.iter().flat_map(|set| ["--set".to_string(), set.clone()]));
        if let Some((input, target)) = pairs {
            run.extend(["--pairs".to_string(), text(input)?, text(target)?]);
        }
        if let Some(calibrator) = calibrator {
            run.extend(["--calibrator".to_string(), text(calibrator)?]);
        }
        let (record, now) = (folder_of(&out), machine::now());
        // Tasks that wait in the queue read the lists of their own submission.
        let folder = match before.jobs.is_empty() {
            true => record.clone(),
            false => record.join(format!("added-{now}")),
        };
        let cells = serde_json::to_vec(&self.cells).unwrap_or_default();
        let id = format!("{}-{now}", Digest::of(&cells).short());
        // These words go into comments and lines of a script, so each must be one line. `out` is also the
        // folder of scripts and logs.
        let places = [text(&place)?, text(&out)?];
        let name = pipeline.batch.name.replace(|c: char| !(c.is_alphanumeric() || "-_.".contains(c)), "-");
        let mut submission = Submission {
            name,
            by: format!("use3d submit {} {}", self.choices.scheduler.words()[1], quote::word(&run[0])),
            results: vec!["--out".to_string(), text(&out)?],
            folder,
            place,
            run,
            variables: variables(pipeline, check_remote, warn)?,
            id,
            cells: self.cells.clone(),
            before,
            record,
        };
        submission.run.extend(["--submitted".to_string(), text(&submission.cells_path())?]);
        if let Some(word) =
            submission.run.iter().chain(&places).find(|word| word.chars().any(char::is_control))
        {
            return Err(WorkError::Input(format!(
                "{word:?} has a control character in it; a script cannot hold it"
            )));
        }
        Ok(submission)
    }
}

/// The scenes and variants of a submission, compared with the pipeline as it is now.
pub struct SubmittedCells {
    /// Those with the same keys as then.
    same: BTreeSet<SceneVariant>,
    /// The names of those that were changed or removed since.
    pub changed: Vec<String>,
    /// True if the stages that all scenes share have the same keys as then.
    shared: bool,
}

impl SubmittedCells {
    /// Reads the list of a submission's scenes and variants, and compares it with a pipeline.
    ///
    /// # Errors
    /// The list cannot be read.
    pub fn read(list: &Path, loaded: &Loaded) -> Result<Self, WorkError> {
        let text = std::fs::read(list);
        let noted = text.and_then(|text| Ok(serde_json::from_slice::<BTreeMap<String, String>>(&text)?));
        let mut noted = noted.map_err(|error| {
            let path = path_text(list);
            WorkError::Input(format!(
                "{path}: the list of the submitted scenes cannot be read ({error}); submit again"
            ))
        })?;
        let mut shared = true;
        let mut same = BTreeSet::new();
        for ((scene, variant), part) in loaded.graph.parts(&loaded.builder.registry) {
            let is_same = noted.get(&cell_name(&scene, &variant)) == Some(&part.short());
            match scene.is_empty() {
                true => shared = is_same,
                false if is_same => {
                    noted.remove(&cell_name(&scene, &variant));
                    same.insert((scene, variant));
                }
                false => {}
            }
        }
        noted.remove("");
        Ok(Self { same, changed: noted.into_keys().collect(), shared })
    }

    /// The scenes and variants of a task that was asked for `only` these; `None` for a task that all scenes
    /// share. Other scenes of the file do not concern it.
    ///
    /// # Errors
    /// Nothing of the task is as it was submitted.
    pub fn of_task(
        &self,
        target: &Path,
        only: Option<Vec<SceneVariant>>,
        for_all: bool,
    ) -> Result<Option<Vec<SceneVariant>>, WorkError> {
        let own: Option<Vec<SceneVariant>> = match only {
            _ if for_all => None,
            Some(only) => Some(only.into_iter().filter(|cell| self.same.contains(cell)).collect()),
            None => Some(self.same.iter().cloned().collect()),
        };
        if own.as_ref().map_or(self.shared, |cells| !cells.is_empty()) {
            return Ok(own);
        }
        Err(WorkError::Input(format!(
            "{}: this is not the submitted pipeline: the settings of this task were edited since, this is another version of the program, or `arguments` of the site change a parameter; submit it again",
            path_text(target)
        )))
    }

    /// True if a scene and variant was submitted.
    pub fn has(&self, scene: &str, variant: &str) -> bool {
        let cell = (scene.to_string(), variant.to_string());
        self.same.contains(&cell) || self.changed.contains(&cell_name(scene, variant))
    }
}

/// The folder of the scripts and logs for results in `out`.
pub fn folder_of(out: &Path) -> PathBuf {
    out.with_file_name(format!("{}-submit", out.file_name().unwrap_or_default().to_string_lossy()))
}

/// Variables of this program that decide what a task does.
const OF_TASKS: [&str; 4] = ["USE3D_REMOTE", "USE3D_COLMAP", "USE3D_PYTHON", "USE3D_FFMPEG"];

/// The variables that tasks need, with their values: schedulers may start tasks without them. Variables that
/// may be secret are left out, because other people may be able to read the scripts.
fn variables(
    pipeline: &Pipeline,
    check_remote: impl Fn(&str) -> Result<(), WorkError>,
    warn: &mut dyn FnMut(String),
) -> Result<Vec<(String, String)>, WorkError> {
    let mut found = Vec::new();
    for name in pipeline.variables.iter().map(String::as_str).chain(OF_TASKS) {
        let Some(value) = std::env::var(name).ok().filter(|value| !value.is_empty()) else { continue };
        if may_be_secret(name) || !is_shell_name(name) {
            warn(format!(
                "the environment variable {name} is not written into scripts{}; make sure that \
                 tasks have it, for instance by `setup` of the site",
                if may_be_secret(name) { ", it may be a secret" } else { ", no shell knows such a name" }
            ));
            continue;
        }
        if name == "USE3D_REMOTE" {
            // The address is checked like in a run; the value is not printed, because it may contain a key.
            check_remote(&value)?;
        }
        if value.chars().any(char::is_control) {
            return Err(WorkError::Input(format!(
                "the environment variable {name} has a control character in it; a script cannot hold it"
            )));
        }
        found.push((name.to_string(), value));
    }
    Ok(found)
}

fn may_be_secret(name: &str) -> bool {
    let name = name.to_uppercase();
    name.starts_with("AWS_")
        || ["SECRET", "TOKEN", "PASSWORD", "CREDENTIAL", "_KEY"].iter().any(|part| name.contains(part))
}

fn is_shell_name(name: &str) -> bool {
    !name.starts_with(|c: char| c.is_ascii_digit())
        && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

/// A path as a word of a script.
fn text(path: &Path) -> Result<String, WorkError> {
    let what = "a script cannot hold a path that is not UTF-8";
    let text = path.to_str().ok_or_else(|| WorkError::Input(format!("{}: {what}", path.display())));
    text.map(String::from)
}
