//! The jobs of a pipeline for a cluster's scheduler, and the words of their scripts.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use use3d_cluster::jobs::{self, Job, Layout};
use use3d_cluster::quote::{self, one_line, path_word};
use use3d_cluster::site::{Scheduler, Site};
use use3d_cluster::submission::{Submission, Submitted, folder_of};
use use3d_cluster::{cells, slurm, variables};
use use3d_workflow::Plan;
use use3d_workflow::graph::cell_name;
use use3d_workflow::plan::State;

use crate::WorkError;
use crate::destination::OUT;
use crate::loaded::{Loaded, PipelineRequest};
use crate::results::Results;
use use3d_config::LoadOptions;

/// The variable with the address of a store.
const REMOTE: &str = "USE3D_REMOTE";
/// Variables of this program that decide what a task does.
const OF_TASKS: [&str; 4] = [REMOTE, "USE3D_COLMAP", "USE3D_PYTHON", "USE3D_FFMPEG"];

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
    /// Its plan.
    pub plan: Plan,
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
        let cells = cells::digests(&loaded.graph, &loaded.builder.registry);
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
        let digests = |loaded: &Loaded| cells::digests(&loaded.graph, &loaded.builder.registry);
        let planned = digests(&self.loaded);
        for (stage, needs) in self.site.stage.iter().filter(|(_, needs)| !needs.arguments.is_empty()) {
            let fault = |reason: String| WorkError::Input(format!("`stage.{stage}.arguments`: {reason}"));
            let changed =
                read(&[&submission.run[..], &needs.arguments].concat()).and_then(PipelineRequest::look);
            if digests(&changed.map_err(|error| fault(error.to_string()))?) != planned {
                return Err(fault(format!(
                    "`{}` changes results, so the tasks of this stage would not belong to the others; write \
                     it into the pipeline file, or give it to `use3d submit`",
                    quote::words(&needs.arguments)
                )));
            }
        }
        Ok(())
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
        check_remote: impl FnOnce(String) -> Result<(), WorkError>,
        warn: &mut dyn FnMut(String),
    ) -> Result<Submission, WorkError> {
        let Loaded { pipeline, builder, graph } = &self.loaded;
        let out = self.out(out);
        Results::new(&out, &builder.cache, graph, None).check(graph, None)?;
        let place = std::env::current_dir()
            .map_err(|e| WorkError::Failed(format!("the current folder cannot be found: {e}")))?;
        let out = place.join(out);
        let mut run = vec![
            path_word(&self.request.target)?,
            "--cache".into(),
            path_word(&place.join(&pipeline.cache))?,
        ];
        let LoadOptions { sets, models, pairs, calibrator, .. } = &self.request.options;
        if let Some(models) = models {
            run.extend(["--models".to_string(), path_word(models)?]);
        }
        run.extend(sets.iter().flat_map(|set| ["--set".to_string(), set.clone()]));
        if let Some((input, target)) = pairs {
            run.extend(["--pairs".to_string(), path_word(input)?, path_word(target)?]);
        }
        if let Some(calibrator) = calibrator {
            run.extend(["--calibrator".to_string(), path_word(calibrator)?]);
        }
        // `out` is also the folder of scripts and logs.
        let places = [path_word(&place)?, path_word(&out)?];
        let name = pipeline.batch.name.replace(|c: char| !(c.is_alphanumeric() || "-_.".contains(c)), "-");
        // The address of a store is checked like in a run.
        std::env::var(REMOTE).ok().filter(|address| !address.is_empty()).map_or(Ok(()), check_remote)?;
        let needed = pipeline.variables.iter().map(String::as_str).chain(OF_TASKS);
        let variables = variables::for_tasks(needed, warn)?;
        let by = format!("use3d submit {} {}", self.choices.scheduler.words()[1], quote::word(&run[0]));
        let results = vec!["--out".to_string(), path_word(&out)?];
        let shared = Submission { name, by, results, place, run, variables, before, ..Submission::default() };
        let mut submission = shared.of_cells(self.cells.clone(), &out);
        submission.run.extend(["--submitted".to_string(), path_word(&submission.cells_path())?]);
        submission.run.iter().chain(&places).try_for_each(|word| one_line(word, || format!("{word:?}")))?;
        Ok(submission)
    }
}
