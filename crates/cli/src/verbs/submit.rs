//! `use3d submit`: submits the missing stages of a pipeline as jobs to a cluster's scheduler. The command
//! ends after the submission; `use3d status` shows the progress.

use std::path::Path;

use use3d_cluster::jobs::Layout;
use use3d_cluster::site::Scheduler;
use use3d_cluster::submission::{Submission, Submitted, folder_of};
use use3d_cluster::{hyperqueue, quote, time};
use use3d_pipeline::destination::OUT;
use use3d_pipeline::loaded::{PipelineRequest, stages};
use use3d_pipeline::submission::{PlannedSubmission, SubmissionChoices};

use crate::App;
use crate::args::{CancelArgs, Submit, SubmitArgs, SubmitLayout, parse_run};
use crate::error::{Done, WorkError};
use crate::output::counted;

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
    let request = args.pipeline.request();
    let layout = match args.layout {
        SubmitLayout::Workers => Layout::Workers,
        SubmitLayout::Stages => Layout::Stages,
    };
    let (site, workers) = (args.cluster.as_deref(), args.workers);
    let mut planned =
        PlannedSubmission::new(&request, SubmissionChoices { scheduler, site, layout, workers })?;
    let unused = planned.site.unused(scheduler);
    if let Some(file) = site.filter(|_| !unused.is_empty()) {
        let (file, name, unused) = (file.display(), scheduler.words()[0], unused.join(", "));
        remark!(app, "warning: {file}: {name} has no setting for {unused}; they are not used");
    }
    planned.plan.lacking().for_each(|line| eprintln!("warning: {line}; it is not submitted"));
    let missing = planned.plan.unavailable();
    if planned.jobs.is_empty() {
        if missing == 0 {
            println!("nothing to submit: all results are there");
        }
        return end("nothing can be submitted", missing);
    }
    let before = queued(scheduler, &planned.folder(args.out.as_deref()), args)?;
    if !before.jobs.is_empty() && !args.again {
        let new = planned.leave_out(&before)?;
        // A record of an older version does not say what is in the queue.
        if new == 0 || before.cells.is_empty() {
            return Err(refused(scheduler, &before));
        }
        let count = counted(new, "scene and variant is", "scenes and variants are");
        remark!(app, "{} still in the queue; {count} new and submitted beside them", listed(&before));
    }
    if !app.quiet {
        println!("{}", planned.plan.totals());
    }
    let check_remote = |address: String| match use3d_store::open(&address) {
        Ok(_) => Ok(()),
        Err(error) => Err(WorkError::Input(format!("USE3D_REMOTE: {error}"))),
    };
    let mut warn = |text: String| eprintln!("warning: {text}");
    let submission = planned.submission(args.out.as_deref(), before, check_remote, &mut warn)?;
    let of_site = |error: WorkError| match site {
        Some(file) => WorkError::Input(format!("{}: {error}", file.display())),
        None => error,
    };
    planned
        .check_arguments(&submission, |words| Ok(parse_run(words)?.pipeline.request()))
        .map_err(of_site)?;
    for job in &planned.jobs {
        println!(
            "{:<12} {}, {}, up to {}",
            job.name,
            counted(job.count(), "task", "tasks"),
            job.asks.words(),
            time::clock(job.asks.time)
        );
    }
    if args.dry_run {
        print!("{}", scheduler.preview(&planned.jobs, &submission, &planned.site));
    } else {
        submit(scheduler, &planned, &submission, args)?;
    }
    end("the stages that need them are not submitted", missing)
}

/// Writes the files, submits them, and prints the numbers of the jobs and the next steps.
fn submit(
    scheduler: Scheduler,
    planned: &PlannedSubmission<'_>,
    submission: &Submission,
    args: &SubmitArgs,
) -> Done {
    scheduler.write(&planned.jobs, submission, &planned.site).map_err(WorkError::failed)?;
    keep_pipeline(&args.pipeline.target, submission)?;
    let submitted = scheduler.submit(&planned.jobs, submission).map_err(WorkError::failed)?;
    for (name, id) in &submitted.jobs {
        println!("submitted {name} as job {id}");
    }
    let warnings = scheduler.warnings(&planned.jobs, &submitted);
    warnings.iter().for_each(|warning| eprintln!("warning: {warning}"));
    let command = |verb: &str, words: &[String]| format!("use3d {verb} {}", quote::words(words));
    if scheduler == Scheduler::HyperQueue && hyperqueue::ends_with_a_failure(&planned.jobs) {
        println!(
            "if a task fails, HyperQueue starts no task that depends on it, not even `finish`; then \
             run: {} --keep-going --gather",
            command("run", &[&submission.run[..], &submission.results].concat())
        );
    }
    println!("logs: {}", submission.folder.join("logs").display());
    // All arguments that affect keys are included: other arguments would show the state of other work.
    let own: Vec<String> = submission.run.iter().take_while(|word| *word != "--submitted").cloned().collect();
    println!("to see their progress: {}", command("status", &own));
    Ok(())
}

/// Stores a copy of the pipeline's file with the submission, for people. Tasks read the file itself, and
/// refuse to run if their own part of it was edited.
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
    let scheduler = Scheduler::of(&submitted);
    let queued = scheduler.still_queued(submitted).map_err(WorkError::failed)?;
    if queued.is_empty() {
        println!("nothing to cancel: all jobs of the last submission have ended");
        return Ok(());
    }
    let numbers: Vec<String> = queued.into_iter().map(|(_, number)| number).collect();
    scheduler.cancel(&numbers).map_err(WorkError::failed)?;
    println!(
        "cancelled {}; running stages write their checkpoints, and `use3d submit` submits the rest",
        numbers.join(", ")
    );
    Ok(())
}

/// Ends like the run would: with a failure if inputs are missing.
fn end(what: &str, missing: usize) -> Done {
    if missing == 0 {
        return Ok(());
    }
    let are = counted(missing, "input is", "inputs are");
    Err(WorkError::Failed(format!("{what}: {are} missing, see above")))
}

/// The jobs of earlier submissions that are still in the queue. A dry run also works without a scheduler.
fn queued(scheduler: Scheduler, folder: &Path, args: &SubmitArgs) -> Result<Submitted, WorkError> {
    let last = Submitted::read(folder);
    let asked = match last.jobs.is_empty() {
        true => Ok(Vec::new()),
        false => Scheduler::of(&last).still_queued(last.clone()),
    };
    let jobs = match asked {
        Err(_) if args.dry_run => Vec::new(),
        asked => asked.map_err(WorkError::failed)?,
    };
    if jobs.is_empty() {
        return Ok(Submitted::default());
    }
    let queued = Submitted { jobs, ..last };
    match (Scheduler::of(&queued) == scheduler, args.again) {
        (true, _) => Ok(queued),
        (false, true) => Ok(Submitted::default()),
        (false, false) => Err(refused(Scheduler::of(&queued), &queued)),
    }
}

/// The error for work that is still in the queue.
fn refused(scheduler: Scheduler, queued: &Submitted) -> WorkError {
    WorkError::Input(format!(
        "{} still in the queue, and no scene is new; wait for them, cancel them with `{}`, or pass --again to submit more \
         jobs",
        listed(queued),
        scheduler.words()[2]
    ))
}

/// Jobs of earlier submissions by number and name.
fn listed(queued: &Submitted) -> String {
    let named: Vec<String> = queued.jobs.iter().map(|(name, id)| format!("{id} ({name})")).collect();
    format!("jobs of the last submission, {}, are", named.join(", "))
}
