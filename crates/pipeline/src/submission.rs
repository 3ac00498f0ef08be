//! The jobs of a pipeline for a cluster's scheduler, and the words of their scripts.

use std::path::{Path, PathBuf};

use use3d_cluster::jobs::{self, Job, Layout};
use use3d_cluster::quote;
use use3d_cluster::site::{Scheduler, Site};
use use3d_cluster::slurm::{self, Submission};
use use3d_workflow::Plan;
use use3d_workflow::machine::{self, seconds};
use use3d_workflow::plan::State;

use crate::WorkError;
use crate::config::{LoadOptions, Pipeline};
use crate::destination::OUT;
use crate::loaded::{Loaded, PipelineRequest};
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
    scheduler: Scheduler,
    loaded: Loaded,
    plan: Plan,
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
    pub fn new(request: &'a PipelineRequest, choices: SubmissionChoices<'_>) -> Result<Self, WorkError> {
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
        let jobs = jobs::of(&plan, registry, &site, choices.layout, choices.workers);
        let jobs = jobs.map_err(WorkError::input)?;
        Ok(Self { request, scheduler: choices.scheduler, loaded, plan, site, jobs })
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
        let planned = self.loaded.digest();
        for (stage, needs) in self.site.stage.iter().filter(|(_, needs)| !needs.arguments.is_empty()) {
            let fault = |reason: String| WorkError::Input(format!("`stage.{stage}.arguments`: {reason}"));
            let changed =
                read(&[&submission.run[..], &needs.arguments].concat()).and_then(PipelineRequest::look);
            if changed.map_err(|error| fault(error.to_string()))?.digest() != planned {
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

    /// The submission with results in `out`, or in the usual folder of the pipeline. `check_remote` checks
    /// the address of a store; `warn` gets the variables that tasks will lack.
    ///
    /// # Errors
    /// The results cannot be written there, or a script cannot hold a word of it.
    pub fn submission(
        &self,
        out: Option<&Path>,
        check_remote: impl Fn(&str) -> Result<(), WorkError>,
        warn: &mut dyn FnMut(String),
    ) -> Result<Submission, WorkError> {
        let Loaded { pipeline, builder, graph } = &self.loaded;
        let out = out.map_or_else(|| Path::new(OUT).join(&pipeline.batch.name), Path::to_path_buf);
        Results::new(&out, &builder.cache).check(graph, None)?;
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
        run.extend(["--submitted".to_string(), self.loaded.digest()]);
        // These words go into comments and lines of a script, so each must be one line. `out` is also the
        // folder of scripts and logs.
        let places = [text(&place)?, text(&out)?];
        if let Some(word) = run.iter().chain(&places).find(|word| word.chars().any(char::is_control)) {
            return Err(WorkError::Input(format!(
                "{word:?} has a control character in it; a script cannot hold it"
            )));
        }
        let name = pipeline.batch.name.replace(|c: char| !(c.is_alphanumeric() || "-_.".contains(c)), "-");
        Ok(Submission {
            name,
            by: format!("use3d submit {} {}", self.scheduler.words()[1], quote::word(&run[0])),
            results: vec!["--out".to_string(), text(&out)?],
            folder: folder_of(&out),
            place,
            run,
            variables: variables(pipeline, check_remote, warn)?,
            id: format!("{}-{}", self.loaded.digest(), machine::now()),
        })
    }
}

/// The folder of the scripts and logs for results in `out`.
pub fn folder_of(out: &Path) -> PathBuf {
    out.with_file_name(format!("{}-submit", out.file_name().unwrap_or_default().to_string_lossy()))
}

/// The variables that tasks need, with their values: schedulers may start tasks without them. Variables that
/// may be secret are left out, because other people may be able to read the scripts.
fn variables(
    pipeline: &Pipeline,
    check_remote: impl Fn(&str) -> Result<(), WorkError>,
    warn: &mut dyn FnMut(String),
) -> Result<Vec<(String, String)>, WorkError> {
    let mut found = Vec::new();
    for name in pipeline.variables.iter().map(String::as_str).chain(["USE3D_REMOTE"]) {
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
