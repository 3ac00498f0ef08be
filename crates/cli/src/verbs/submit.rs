//! `use3d submit`: what is missing of a pipeline, as jobs of a cluster's scheduler. The command ends when
//! they are handed over; `use3d status` tells how far they are.

use std::path::{Path, PathBuf};

use use3d_build::machine::seconds;
use use3d_build::plan::State;
use use3d_cluster::jobs::{self, Job, Layout};
use use3d_cluster::site::Site;
use use3d_cluster::slurm::{self, Submission};
use use3d_cluster::{hyperqueue, quote, time};
use use3d_pipeline::results;

use crate::App;
use crate::args::{Submit, SubmitArgs, SubmitLayout};
use crate::error::{CliError, Done};
use crate::verbs::run::{Loaded, open};

/// Everything that is decided before anything is written.
struct Ready {
    jobs: Vec<Job>,
    submission: Submission,
    site: Site,
}

pub(crate) fn run(app: &App, what: &Submit) -> Done {
    let (scheduler, args) = match what {
        Submit::Slurm(args) => ("slurm", args),
        Submit::Hq(args) => ("hq", args),
    };
    let Some(ready) = prepare(app, scheduler, args)? else {
        println!("everything is there: nothing to submit");
        return Ok(());
    };
    let Ready { jobs, submission, site } = &ready;
    for job in jobs {
        let tasks = job.tasks.map_or_else(|| "1 task".to_string(), |n| format!("{n} tasks"));
        println!(
            "{:<12} {tasks}, {} processors, {} MB, up to {}",
            job.name,
            job.asks.cpus,
            job.asks.memory.div_ceil(1_000_000),
            time::clock(job.asks.time)
        );
    }
    match what {
        Submit::Slurm(_) if args.dry_run => {
            for (at, job) in jobs.iter().enumerate() {
                let before: Vec<String> =
                    jobs[..at].iter().map(|job| format!("NUMBER_OF_{}", job.name)).collect();
                let dependency = slurm::dependency(job, &before).unwrap_or_default();
                println!("\n--- sbatch {dependency} {}", submission.script_path(job).display());
                print!("{}", slurm::script(job, submission, site));
                for cell in &job.cells {
                    println!("--- {}: {cell}", submission.list_path(job).display());
                }
            }
            return Ok(());
        }
        Submit::Hq(_) if args.dry_run => {
            println!("\n--- {}", hyperqueue::script_path(submission).display());
            print!("{}", hyperqueue::script(submission, site));
            println!("\n--- hq job submit-file {}", hyperqueue::file_path(submission).display());
            print!("{}", hyperqueue::file(jobs, submission));
            return Ok(());
        }
        Submit::Slurm(_) => {
            let queued = slurm::queued(submission).map_err(CliError::failed)?;
            if !queued.is_empty() && !args.again {
                let named: Vec<String> = queued.iter().map(|(name, id)| format!("{id} ({name})")).collect();
                return Err(CliError::Input(format!(
                    "jobs of the last submission are still in the queue: {}; wait for them, end them with `scancel`, or pass \
                     --again to submit beside them",
                    named.join(", ")
                )));
            }
            slurm::write(jobs, submission, site).map_err(CliError::failed)?;
            let submitted = slurm::submit(jobs, submission).map_err(CliError::failed)?;
            for (name, id) in &submitted.jobs {
                println!("submitted {name} as job {id}");
            }
        }
        Submit::Hq(_) => {
            hyperqueue::write(jobs, submission, site).map_err(CliError::failed)?;
            println!("{}", hyperqueue::submit(submission).map_err(CliError::failed)?);
        }
    }
    println!("logs: {}", submission.folder.join("logs").display());
    // With all that makes keys what they are: other words would tell of other work.
    let told = [&["use3d".to_string(), "status".to_string()][..], &submission.run[..]];
    println!("how far they are: {}", quote::words(&told.concat()));
    Ok(())
}

fn prepare(app: &App, scheduler: &str, args: &SubmitArgs) -> Result<Option<Ready>, CliError> {
    let loaded = open(&args.pipeline, &[])?;
    let Loaded { pipeline, builder, graph } = &loaded;
    let stages: Vec<&str> = builder.registry.stages().iter().map(|s| s.name()).collect();
    let site = match &args.cluster {
        Some(file) => Site::read(file, &stages).map_err(CliError::input)?,
        None => Site::default(),
    };
    let plan = builder.plan(graph, None);
    for node in plan.nodes.iter().filter(|n| n.shared_with.is_none() && !app.quiet) {
        if let State::Unavailable(reason) = &node.state {
            eprintln!("warning: {} {}: {reason}; it is not submitted", node.scene, node.stage);
        }
    }
    let layout = match args.layout {
        SubmitLayout::Workers => Layout::Workers,
        SubmitLayout::Stages => Layout::Stages,
    };
    let jobs = jobs::of(&plan, &builder.registry, &site, layout, args.workers).map_err(CliError::input)?;
    if jobs.is_empty() {
        return Ok(None);
    }
    let (forecast, without) = plan.forecast();
    if !app.quiet {
        let unknown =
            if without > 0 { format!(", and {without} stages never ran before") } else { String::new() };
        println!(
            "{}: {} to run, {} cached; about {}{unknown}",
            plan.pipeline,
            plan.to_run(),
            plan.cached(),
            seconds(forecast)
        );
    }
    let place = std::env::current_dir().map_err(CliError::failed)?;
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from("use3d-out").join(&pipeline.batch.name));
    results::check(graph, None, &out)?;
    let out = place.join(out);
    let mut run =
        vec![text(&args.pipeline.target)?, "--cache".to_string(), text(&absolute(&pipeline.cache)?)?];
    if let Some(models) = &args.pipeline.cache.models {
        run.extend(["--models".to_string(), text(models)?]);
    }
    run.extend(args.pipeline.settings.sets().into_iter().flat_map(|set| ["--set".to_string(), set]));
    if let Some((input, target)) = args.pipeline.calibration.pairs() {
        run.extend(["--pairs".to_string(), text(&input)?, text(&target)?]);
    }
    if let Some(calibrator) = &args.pipeline.calibration.calibrator {
        run.extend(["--calibrator".to_string(), text(calibrator)?]);
    }
    // Into comments and lines of a script: one line, whatever the names.
    if let Some(word) = run.iter().find(|word| word.chars().any(char::is_control)) {
        return Err(CliError::Input(format!(
            "{word:?} has a control character in it; a script cannot hold it"
        )));
    }
    let name: String = pipeline
        .batch
        .name
        .chars()
        .map(|c| if c.is_alphanumeric() || "-_.".contains(c) { c } else { '-' })
        .collect();
    let folder =
        out.with_file_name(format!("{}-submit", out.file_name().unwrap_or_default().to_string_lossy()));
    let submission = Submission {
        name,
        by: format!("use3d submit {scheduler} {}", quote::word(&run[0])),
        place,
        run,
        results: vec!["--out".to_string(), text(&out)?],
        folder,
    };
    Ok(Some(Ready { jobs, submission, site }))
}

fn absolute(path: &Path) -> Result<PathBuf, CliError> {
    std::path::absolute(path).map_err(CliError::failed)
}

/// A path as a word of a script.
fn text(path: &Path) -> Result<String, CliError> {
    let text = path.to_str().map(String::from);
    text.ok_or_else(|| {
        CliError::Input(format!("{}: a script cannot hold a path that is not UTF-8", path.display()))
    })
}
