//! `use3d submit`: submits the missing stages of a pipeline as jobs to a cluster's scheduler. The command
//! ends after the submission; `use3d status` shows the progress.

use std::path::{Path, PathBuf};
use std::time::Duration;

use use3d_cluster::jobs::{self, Job, Layout};
use use3d_cluster::site::{Scheduler, Site};
use use3d_cluster::slurm::{self, Submission, Submitted};
use use3d_cluster::{ClusterError, hyperqueue, quote, time};
use use3d_pipeline::config::{LoadOptions, Pipeline};
use use3d_pipeline::destination::OUT;
use use3d_pipeline::loaded::{Loaded, PipelineRequest, stages};
use use3d_pipeline::results::Results;
use use3d_workflow::Plan;
use use3d_workflow::machine::seconds;
use use3d_workflow::plan::State;

use crate::App;
use crate::args::{CancelArgs, Submit, SubmitArgs, SubmitLayout};
use crate::error::{Done, WorkError};
use crate::output::counted;

/// All decisions before anything is written.
struct Ready {
    jobs: Vec<Job>,
    submission: Submission,
    site: Site,
    /// Number of inputs that the pipeline names but that do not exist.
    missing: usize,
}

pub(crate) fn run(app: &App, what: &Submit) -> Done {
    let (scheduler, args) = match what {
        Submit::Slurm(args) => (Scheduler::Slurm, args),
        Submit::Hq(args) => (Scheduler::HyperQueue, args),
    };
    if let (SubmitLayout::Stages, Some(workers)) = (args.layout, args.workers) {
        return Err(WorkError::Input(format!(
            "--workers {workers}: --layout stages has a task for every scene and variant; leave one of them \
             out (`at_once` of the site limits the tasks that run at once)"
        )));
    }
    let Some(ready) = prepare(app, scheduler, args)? else { return Ok(()) };
    let Ready { jobs, submission, site, missing } = &ready;
    for job in jobs {
        println!(
            "{:<12} {}, {} processors, {} MB, up to {}",
            job.name,
            counted(job.count(), "task", "tasks"),
            job.asks.cpus,
            job.asks.memory.div_ceil(1_000_000),
            time::clock(job.asks.time)
        );
    }
    if args.dry_run {
        show(scheduler, &ready);
        return end(WITHOUT, *missing);
    }
    let last = Submitted::read(&submission.folder);
    let submitted = match scheduler {
        Scheduler::Slurm => {
            refuse_twice(args, slurm::still_queued(last), "scancel")?;
            slurm::write(jobs, submission, site).map_err(WorkError::failed)?;
            keep_pipeline(&args.pipeline.target, submission)?;
            slurm::submit(jobs, submission)
        }
        Scheduler::HyperQueue => {
            refuse_twice(args, hyperqueue::still_queued(last), "hq job cancel")?;
            hyperqueue::write(jobs, submission, site).map_err(WorkError::failed)?;
            keep_pipeline(&args.pipeline.target, submission)?;
            hyperqueue::submit(submission)
        }
    };
    let submitted = submitted.map_err(WorkError::failed)?;
    for (name, id) in &submitted.jobs {
        println!("submitted {name} as job {id}");
    }
    let command = |verb: &str, words: &[String]| format!("use3d {verb} {}", quote::words(words));
    match scheduler {
        Scheduler::Slurm => tell_stuck(&submitted.jobs),
        Scheduler::HyperQueue if hyperqueue::ends_with_a_failure(jobs) => println!(
            "if a task fails, HyperQueue starts no task that depends on it, not even `finish`; then \
             run: {} --keep-going",
            command("run", &[&submission.run[..], &submission.results].concat())
        ),
        Scheduler::HyperQueue => {}
    }
    println!("logs: {}", submission.folder.join("logs").display());
    // All arguments that affect keys are included: other arguments would show the state of other work.
    let own: Vec<String> = submission.run.iter().take_while(|word| *word != "--submitted").cloned().collect();
    println!("to see their progress: {}", command("status", &own));
    end(WITHOUT, *missing)
}

/// Prints the files that would be submitted.
fn show(scheduler: Scheduler, Ready { jobs, submission, site, .. }: &Ready) {
    match scheduler {
        Scheduler::Slurm => {
            for (at, job) in jobs.iter().enumerate() {
                let before: Vec<String> =
                    jobs[..at].iter().map(|job| format!("NUMBER_OF_{}", job.name)).collect();
                let dependency = slurm::dependency(job, &before).unwrap_or_default();
                println!("\n--- sbatch {dependency} {}", submission.script_path(job).display());
                print!("{}", slurm::script(job, submission, site));
                for line in job.list().lines() {
                    println!("--- {}: {line}", submission.list_path(job).display());
                }
            }
        }
        Scheduler::HyperQueue => {
            println!("\n--- {}", hyperqueue::script_path(submission).display());
            print!("{}", hyperqueue::script(submission, site));
            println!("\n--- hq job submit-file {}", hyperqueue::file_path(submission).display());
            print!("{}", hyperqueue::file(jobs, submission));
        }
    }
}

/// The time that Slurm needs to find that a job can never run.
const EXAMINED: Duration = Duration::from_secs(2);

/// Names the jobs that will never start, because the site has no place for their requests.
fn tell_stuck(jobs: &[(String, String)]) {
    std::thread::sleep(EXAMINED);
    let numbers: Vec<String> = jobs.iter().map(|(_, number)| number.clone()).collect();
    for (number, reason) in slurm::never(&numbers) {
        let why = match reason.contains("NotAllowed") {
            true => "your account may not use it; write account or qos of the site into",
            false => {
                "no node of its partition has what it requests; write partition, cpus, memory and time of the \
                 site into"
            }
        };
        eprintln!(
            "warning: job {number} can never start ({reason}): {why} --cluster FILE (docs/guide/cluster.md), run \
             `use3d cancel`, and submit again"
        );
    }
}

/// Stores a copy of the pipeline's file with the submission, for people. Tasks read the file itself, and
/// refuse to run if it was edited.
fn keep_pipeline(target: &Path, submission: &Submission) -> Done {
    if !target.is_file() {
        return Ok(());
    }
    let text = std::fs::read(target).map_err(|e| WorkError::Failed(format!("{}: {e}", target.display())))?;
    let kept = submission.folder.join("pipeline.toml");
    use3d_files::write_atomically(&kept, |writer| std::io::Write::write_all(writer, &text))
        .map_err(|e| WorkError::Failed(format!("{}: {e}", kept.display())))
}

/// Cancels the jobs of the last submission.
pub(crate) fn cancel(args: &CancelArgs) -> Done {
    let out = match &args.out {
        Some(out) => out.clone(),
        None => {
            let request = PipelineRequest { target: args.target.clone(), ..PipelineRequest::default() };
            Path::new(OUT).join(request.read(&stages()?)?.batch.name)
        }
    };
    let folder = folder_of(&out);
    let submitted = Submitted::read(&folder);
    if submitted.jobs.is_empty() {
        return Err(WorkError::Input(format!(
            "{}: nothing was submitted from there; give the results folder of the submission with --out",
            folder.display()
        )));
    }
    // A scheduler refuses to cancel a job that it has forgotten, so only jobs in its queue are cancelled.
    let is_hq = submitted.scheduler == "hq";
    let queued = if is_hq { hyperqueue::still_queued(submitted) } else { slurm::still_queued(submitted) };
    let queued = queued.map_err(WorkError::failed)?;
    if queued.is_empty() {
        println!("nothing to cancel: all jobs of the last submission have ended");
        return Ok(());
    }
    let numbers: Vec<String> = queued.into_iter().map(|(_, number)| number).collect();
    let ended = if is_hq { hyperqueue::cancel(&numbers) } else { slurm::cancel(&numbers) };
    ended.map_err(WorkError::failed)?;
    println!(
        "cancelled {}; running stages write their checkpoints, and `use3d submit` submits the rest",
        numbers.join(", ")
    );
    Ok(())
}

/// The folder of the scripts and logs for results in `out`.
fn folder_of(out: &Path) -> PathBuf {
    out.with_file_name(format!("{}-submit", out.file_name().unwrap_or_default().to_string_lossy()))
}

/// The message about the part of a batch that was not submitted.
const WITHOUT: &str = "the stages that need them are not submitted";

/// Ends like the run would: with a failure if inputs are missing.
fn end(what: &str, missing: usize) -> Done {
    if missing == 0 {
        return Ok(());
    }
    let are = counted(missing, "input is", "inputs are");
    Err(WorkError::Failed(format!("{what}: {are} missing, see above")))
}

/// Fails if jobs of the last submission are still in the queue, unless `--again` is given.
fn refuse_twice(
    args: &SubmitArgs,
    queued: Result<Vec<(String, String)>, ClusterError>,
    cancel: &str,
) -> Done {
    let queued = queued.map_err(WorkError::failed)?;
    if queued.is_empty() || args.again {
        return Ok(());
    }
    let named: Vec<String> = queued.iter().map(|(name, id)| format!("{id} ({name})")).collect();
    Err(WorkError::Input(format!(
        "jobs of the last submission are still in the queue: {}; wait for them, cancel them with \
         `{cancel}`, or pass --again to submit more jobs",
        named.join(", ")
    )))
}

/// Prints the missing inputs, each with its reason; also with `--quiet`.
fn tell_missing(plan: &Plan) {
    for node in plan.nodes.iter().filter(|n| n.shared_with.is_none()) {
        if let State::Unavailable(reason) = &node.state {
            eprintln!("warning: {} {}: {reason}; it is not submitted", node.scene, node.stage);
        }
    }
}

/// Reads the site, and warns about entries that the scheduler does not support.
fn site(app: &App, scheduler: Scheduler, args: &SubmitArgs, stages: &[&str]) -> Result<Site, WorkError> {
    let Some(file) = &args.cluster else { return Ok(Site::default()) };
    let site = Site::read(file, stages).map_err(WorkError::input)?;
    let unused = site.unused(scheduler);
    if !unused.is_empty() {
        let name = match scheduler {
            Scheduler::Slurm => "Slurm",
            Scheduler::HyperQueue => "HyperQueue",
        };
        let (file, unused) = (file.display(), unused.join(", "));
        remark!(app, "warning: {file}: {name} has no setting for {unused}; they are not used");
    }
    Ok(site)
}

/// The variables that tasks need, with their values: schedulers may start tasks without them. Variables that
/// may be secret are left out, because other people may be able to read the scripts.
fn variables(pipeline: &Pipeline) -> Result<Vec<(String, String)>, WorkError> {
    let mut found = Vec::new();
    for name in pipeline.variables.iter().map(String::as_str).chain(["USE3D_REMOTE"]) {
        let Some(value) = std::env::var(name).ok().filter(|value| !value.is_empty()) else { continue };
        if may_be_secret(name) || !is_shell_name(name) {
            eprintln!(
                "warning: the environment variable {name} is not written into scripts{}; make sure that \
                 tasks have it, for instance by `setup` of the site",
                if may_be_secret(name) { ", it may be a secret" } else { ", no shell knows such a name" }
            );
            continue;
        }
        if name == "USE3D_REMOTE" {
            // The address is checked like in a run; the value is not printed, because it may contain a key.
            use3d_store::open(&value).map_err(|e| WorkError::Input(format!("{name}: {e}")))?;
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

/// Prepares the submission; `None` if there is nothing to do.
fn prepare(app: &App, scheduler: Scheduler, args: &SubmitArgs) -> Result<Option<Ready>, WorkError> {
    let request = args.pipeline.request();
    let loaded = request.open()?;
    loaded.nothing_lacks(None, None)?;
    let Loaded { pipeline, builder, graph } = &loaded;
    let stages: Vec<&str> = builder.registry.stages().iter().map(|s| s.name()).collect();
    let mut site = site(app, scheduler, args, &stages)?;
    // The limit of the site's own configuration comes first, if Slurm reports one.
    if let (Scheduler::Slurm, Some(most)) = (scheduler, slurm::largest_array()) {
        site.largest_array = site.largest_array.min(most);
    }
    let plan = builder.plan(graph, None);
    tell_missing(&plan);
    let layout = match args.layout {
        SubmitLayout::Workers => Layout::Workers,
        SubmitLayout::Stages => Layout::Stages,
    };
    let jobs = jobs::of(&plan, &builder.registry, &site, layout, args.workers).map_err(WorkError::input)?;
    let missing = plan.unavailable();
    if jobs.is_empty() {
        if missing == 0 {
            println!("nothing to submit: all results are there");
        }
        return end("nothing can be submitted", missing).map(|()| None);
    }
    let (forecast, without) = plan.forecast();
    if !app.quiet {
        let about = match without {
            0 => format!("about {}", seconds(forecast)),
            n if n == plan.to_run() => "no forecast, because none of their stages ran before".to_string(),
            1 => format!("about {}, and 1 stage never ran before", seconds(forecast)),
            n => format!("about {}, and {n} stages never ran before", seconds(forecast)),
        };
        println!("{}: {} to run, {} cached; {about}", plan.pipeline, plan.to_run(), plan.cached());
    }
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from("use3d-out").join(&pipeline.batch.name));
    Results::new(&out, &builder.cache).check(graph, None)?;
    let place = std::env::current_dir()
        .map_err(|e| WorkError::Failed(format!("the current folder cannot be found: {e}")))?;
    let out = place.join(out);
    let cache = place.join(&pipeline.cache);
    let mut run = vec![text(&args.pipeline.target)?, "--cache".to_string(), text(&cache)?];
    let LoadOptions { sets, models, pairs, calibrator, .. } = request.options;
    if let Some(models) = &models {
        run.extend(["--models".to_string(), text(models)?]);
    }
    run.extend(sets.into_iter().flat_map(|set| ["--set".to_string(), set]));
    if let Some((input, target)) = &pairs {
        run.extend(["--pairs".to_string(), text(input)?, text(target)?]);
    }
    if let Some(calibrator) = &calibrator {
        run.extend(["--calibrator".to_string(), text(calibrator)?]);
    }
    run.extend(["--submitted".to_string(), graph.digest(&builder.registry).short()]);
    // These words go into comments and lines of a script, so each must be one line. `out` is also the folder
    // of scripts and logs.
    let places = [text(&place)?, text(&out)?];
    if let Some(word) = run.iter().chain(&places).find(|word| word.chars().any(char::is_control)) {
        return Err(WorkError::Input(format!(
            "{word:?} has a control character in it; a script cannot hold it"
        )));
    }
    let name = pipeline.batch.name.replace(|c: char| !(c.is_alphanumeric() || "-_.".contains(c)), "-");
    let folder = folder_of(&out);
    let verb = match scheduler {
        Scheduler::Slurm => "slurm",
        Scheduler::HyperQueue => "hq",
    };
    let submission = Submission {
        name,
        by: format!("use3d submit {verb} {}", quote::word(&run[0])),
        place,
        run,
        results: vec!["--out".to_string(), text(&out)?],
        folder,
        variables: variables(pipeline)?,
    };
    Ok(Some(Ready { jobs, submission, site, missing }))
}

/// A path as a word of a script.
fn text(path: &Path) -> Result<String, WorkError> {
    let what = "a script cannot hold a path that is not UTF-8";
    let text = path.to_str().ok_or_else(|| WorkError::Input(format!("{}: {what}", path.display())));
    text.map(String::from)
}
