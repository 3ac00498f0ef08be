//! Pipelines: run, plan, status, why, graph, and the demo.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use use3d_cluster::cells::SubmittedCells;
use use3d_cluster::quote;
use use3d_config::LoadOptions;
use use3d_pipeline::by_hand::{IMPORT, scratch};
use use3d_pipeline::destination::{OUT, path_text};
use use3d_pipeline::history::{self, RunRecord};
use use3d_pipeline::loaded::{Loaded, PipelineRequest};
use use3d_pipeline::outcome::{self, Outcome};
use use3d_pipeline::preparation::capture_of;
use use3d_pipeline::remarks;
use use3d_pipeline::results::{Delivered, Results, scenes_of};
use use3d_pipeline::white::{self, WhiteChoice};
use use3d_pipeline::whole_run::WholeRun;
use use3d_workflow::machine::seconds;
use use3d_workflow::place;
use use3d_workflow::plan::{PlannedNode, State};
use use3d_workflow::run::{NodeResult, RanNode};
use use3d_workflow::status::{Row, Standing};
use use3d_workflow::{PATIENCE, Plan, RunOptions, Scope, Summary, picture};

use crate::App;
use crate::args::{DemoArgs, DemoSize, PipelineArgs, PlanArgs, RunArgs, StatusArgs, WhyArgs};
use crate::error::{Done, WorkError};
use crate::output;
use crate::verbs::check;
use crate::verbs::photographs;
use crate::verbs::prepare;
use crate::verbs::remote::of_run;
use crate::verbs::synth::keep_capture;
use crate::verbs::view::watched;
use crate::verbs::white::keep_for;

pub(crate) fn plan(args: &PlanArgs) -> Done {
    let loaded = resolved(args.pipeline.request()).0.look()?;
    loaded.nothing_lacks(None, None)?;
    remarks::unequal(&loaded.graph, &loaded.pipeline.batch).iter().for_each(|line| eprintln!("{line}"));
    show(&loaded.builder.plan(&loaded.graph, None), args.json)
}

/// Prints a plan. If it cannot be carried out because an input is missing, it fails like the run would.
fn show(plan: &Plan, as_json: bool) -> Done {
    output::show(plan, as_json)?;
    match plan.unavailable() {
        0 => Ok(()),
        _ => Err(WorkError::failed(
            "inputs that the pipeline names are missing (see `cannot` above); the stages that need them \
             would fail",
        )),
    }
}

pub(crate) fn status(args: &StatusArgs) -> Done {
    let loaded = resolved(args.plan.pipeline.request()).0.look()?;
    let mut status = loaded.builder.plan(&loaded.graph, None).status();
    for name in &args.scene {
        let known = || loaded.pipeline.batch.scenes.iter().map(|s| s.name.as_str());
        if !known().any(|scene| scene == name) {
            return Err(WorkError::input(use3d_workflow::BuildError::unknown("scene", name, known())));
        }
    }
    status.rows.retain(|row| {
        let asked = args.scene.is_empty() || args.scene.contains(&row.scene);
        let failed = |row: &Row| row.cells.iter().any(|cell| cell.standing == Standing::Failed);
        asked && (!args.failed || failed(row))
    });
    match args.summary {
        true => output::show(&status.counts(), args.plan.json),
        false => output::show(&status, args.plan.json),
    }
}

pub(crate) fn why(args: &WhyArgs) -> Done {
    let loaded = resolved(args.pipeline.request()).0.look()?;
    // `SCENE` or `SCENE@VARIANT`.
    let (scene, variant) = args.scene.split_once('@').unwrap_or((&args.scene, ""));
    let why = loaded.builder.why(&loaded.graph, scene, variant, &args.stage).map_err(WorkError::input)?;
    output::show(&why, args.json)
}

pub(crate) fn graph(pipeline: &PipelineArgs) -> Done {
    let loaded = resolved(pipeline.request()).0.look()?;
    let plan = loaded.builder.plan(&loaded.graph, None);
    print!("{}", picture::mermaid(&loaded.graph, &plan));
    Ok(())
}

pub(crate) fn run(app: &App, args: &RunArgs) -> Done {
    // A results folder stands for the pipeline that was run into it, and new results go there again.
    let given = args.pipeline.request();
    let elsewhere =
        |request: &PipelineRequest| request.options.sets.iter().any(|set| set.contains("model_dir"));
    let prepares = !args.dry_run && !elsewhere(&given);
    let (mut pipeline, results) = resolved(given);
    if args.dry_run
        && !elsewhere(&pipeline)
        && let Some((_, capture)) = capture_of(&pipeline.target, args.out.as_deref())?
    {
        if use3d_import::check_layout(&capture).is_err() {
            return unprepared(&pipeline.target, &capture, args.json);
        }
        pipeline.target = capture;
    }
    // A film or a folder of photographs is prepared as a capture first.
    if prepares && let Some(capture) = prepare::capture_for(app, &pipeline.target, args.out.as_deref())? {
        pipeline.target = capture;
    }
    if pipeline.target.is_dir() && !use3d_import::is_prepared(&pipeline.target) && !elsewhere(&pipeline) {
        use3d_import::check_layout(&pipeline.target).map_err(WorkError::input)?;
    }
    pipeline.options.scenes.clone_from(&args.scene);
    pipeline.only_looks = args.dry_run || args.gather;
    let mut loaded = pipeline.open()?;
    let until = args.until.clone().map(|stage| vec![stage]);
    if let Some(stage) = &args.until {
        loaded.builder.registry.stage(stage).map_err(WorkError::input)?;
    }
    let mut only = loaded.cells(&args.only)?;
    loaded.nothing_lacks(until.as_deref(), only.as_deref())?;
    if !app.quiet && args.submitted.is_none() {
        let unequal = remarks::unequal(&loaded.graph, &loaded.pipeline.batch);
        let said = unequal.into_iter().chain(remarks::without_tables(&loaded.graph, until.as_deref()));
        said.for_each(|line| eprintln!("{line}"));
    }
    if args.dry_run {
        return show(&loaded.builder.plan(&loaded.graph, until.as_deref()), args.json);
    }
    let cells_of = |list| SubmittedCells::read(list, &loaded.graph, &loaded.builder.registry);
    let submitted = args.submitted.as_deref().map(cells_of).transpose()?;
    if let Some(cells) = &submitted {
        let shared =
            |stage: &String| loaded.builder.registry.stage(stage).is_ok_and(|s| s.scope() != Scope::Scene);
        let for_all = args.gather || args.until.as_ref().is_some_and(shared);
        only = cells.of_task(&pipeline.target, only, for_all)?;
        if !cells.changed.is_empty() && args.only.is_empty() {
            let names = cells.changed.join(", ");
            eprintln!(
                "warning: {names}: changed or removed since the submission, so not computed; submit again"
            );
        }
    }
    let choices = &args.white.choices[..];
    if !choices.is_empty() && !pipeline.target.is_dir() {
        return Err(WorkError::input(
            "--white works with one capture folder; for a pipeline, use `use3d white` on each of its scenes",
        ));
    }
    white::check(choices, &pipeline.target)?;
    let named = || Path::new(OUT).join(&loaded.pipeline.batch.name);
    let out = args.out.clone().or(results).unwrap_or_else(named);
    let mut results = None;
    if !args.cache_only {
        loaded.check_out(&out)?;
        let checked = Results::new(&out, &loaded.builder.cache, &loaded.graph, until.as_deref())
            .only_report(args.report_only);
        checked.check(&loaded.graph, until.as_deref())?;
        results = Some(Arc::new(checked));
    }
    if let Some(address) = &args.remote {
        let store = of_run(app, address, args.remote_read_only)?;
        loaded.builder = loaded.builder.with_remote(store);
    }
    let plan = (!app.quiet).then(|| loaded.builder.plan(&loaded.graph, until.as_deref()));
    if let Some(plan) = &plan {
        tell_faults(&loaded, plan, &pipeline.target);
        tell_why(plan);
    }
    let options = RunOptions {
        jobs: args.jobs,
        keep_going: args.keep_going || loaded.pipeline.keep_going,
        until,
        only,
        limit: args.max_time,
        until_empty: args.until_empty.then_some(PATIENCE),
        gather: args.gather,
        alone: args.alone,
        ..of_app(app)
    };
    let white = (!choices.is_empty()).then_some((choices, pipeline.target.as_path()));
    let (photographs, report_only) = (args.photographs, args.report_only);
    let given = Given { white, plan, submitted, photographs, report_only, ..Given::of(&pipeline) };
    let out = (results.as_ref(), &given);
    watched(app, &args.watch, None, |app| execute(app, &loaded, &options, out, args.json))
}

/// Prints the beginning of the plan for a film or a folder of photographs: cameras are found first, and the
/// other stages follow from them.
fn unprepared(target: &Path, capture: &Path, as_json: bool) -> Done {
    if as_json {
        return output::json(&serde_json::json!({ "prepares": target, "capture": capture }));
    }
    println!(
        "run      prepare {}: choose pictures and find out where the camera was for each, into {}\n\
         waits    everything else: it is planned when that is known",
        path_text(target),
        path_text(capture)
    );
    Ok(())
}

/// Prints the gravest faults of a capture folder that is imported for the first time.
fn tell_faults(loaded: &Loaded, plan: &Plan, target: &Path) {
    let imports = |node: &&PlannedNode| node.stage == IMPORT && matches!(node.state, State::Run(_));
    let anew = target.is_dir() && plan.nodes.iter().any(|node| imports(&node) && !node.had);
    let node = loaded.graph.nodes.iter().find(|node| node.stage_name == IMPORT).filter(|_| anew);
    let params = node.and_then(|node| node.parameters.of());
    let lines = params.map_or_else(Vec::new, |params| check::before_run(target, params));
    lines.iter().for_each(|line| eprintln!("{line}"));
}

/// Prints why stages run again, and an estimate of the total time.
fn tell_why(plan: &Plan) {
    plan.reruns().iter().for_each(|line| eprintln!("{line}"));
    let (forecast, unknown) = plan.forecast();
    if plan.to_run() > unknown {
        let besides =
            if unknown > 0 { format!(" plus {unknown} stages that never ran before") } else { String::new() };
        eprintln!("about {}{besides} for the whole run, as in earlier runs", seconds(forecast));
    }
    if let Some(expected) = plan.expected() {
        eprintln!(
            "about {expected}: a guess from the sizes of the pictures, because these stages never ran here"
        );
    }
}

/// The default options of a run in this process, which a signal may end at a time limit.
fn of_app(app: &App) -> RunOptions {
    RunOptions { leave: crate::interrupt::leave(), ..app.host.options() }
}

/// The arguments of a run besides its options.
struct Given<'a> {
    pipeline: &'a PipelineRequest,
    /// The white balance for its scenes, and the capture in whose views it is measured.
    white: Option<(&'a [WhiteChoice], &'a Path)>,
    /// The plan, if the progress of the whole run is shown.
    plan: Option<Plan>,
    /// The scenes and variants that were submitted, for a task of a submission.
    submitted: Option<SubmittedCells>,
    /// True if all photographs are written, too.
    photographs: bool,
    /// True if the scenes stay in the cache.
    report_only: bool,
    /// True if nothing is printed.
    silent: bool,
}

impl<'a> Given<'a> {
    /// A run without any of these.
    fn of(pipeline: &'a PipelineRequest) -> Self {
        let (photographs, report_only, silent) = (false, false, false);
        Self { pipeline, white: None, plan: None, submitted: None, photographs, report_only, silent }
    }
}

/// The pipeline of a request. If its target is a results folder, this is the pipeline that was run into it,
/// and the folder is returned too.
fn resolved(request: PipelineRequest) -> (PipelineRequest, Option<PathBuf>) {
    match history::of_results(&request.target) {
        Some(record) => (record.request(&request), Some(request.target)),
        None => (request, None),
    }
}

/// Restores the results of an earlier run into their folder; prints nothing if `silent`.
///
/// # Errors
/// Some results are no longer in the cache. Nothing is computed.
pub(crate) fn again(app: &App, record: &RunRecord, results: &Path, silent: bool) -> Done {
    let scenes = LoadOptions { scenes: record.scenes.clone(), ..LoadOptions::default() };
    let request = record.request(&PipelineRequest { options: scenes, ..PipelineRequest::default() });
    let loaded = request.open()?;
    let plan = loaded.builder.plan(&loaded.graph, record.until.as_deref());
    let missing = plan.to_run();
    if missing > 0 || plan.unavailable() > 0 {
        return Err(WorkError::Input(format!(
            "{missing} of its stages are not in the cache any more, or the program or its input has changed \
             since; to run it again: {}",
            record.command
        )));
    }
    let options = RunOptions { until: record.until.clone(), ..of_app(app) };
    let given = Given { silent, ..Given::of(&request) };
    let until = record.until.as_deref();
    let results = Arc::new(Results::new(results, &loaded.builder.cache, &loaded.graph, until));
    execute(app, &loaded, &options, (Some(&results), &given), false)
}

/// Runs a pipeline, writes its results into `out`, and stores a record of the run there.
fn execute(
    app: &App,
    loaded: &Loaded,
    options: &RunOptions,
    (out, given): (Option<&Arc<Results>>, &Given<'_>),
    as_json: bool,
) -> Done {
    let mut listener = out
        .map_or_else(|| app.host.listener.clone(), |out| out.delivering(app.host.listener.clone(), typed()));
    if let Some(plan) = &given.plan {
        let whole = WholeRun::new(plan, options.only.as_deref(), options.jobs);
        listener = whole.listener(listener);
    }
    let mut summary = loaded.builder.run(&loaded.graph, options, &listener);
    // The bar of the whole run ends before anything is printed.
    drop(listener);
    // A scene that was added since belongs to another submission, which gathers it.
    if let Some(cells) = given.submitted.as_ref().filter(|_| options.gather) {
        let own = |node: &RanNode| node.scene.is_empty() || cells.has(&node.scene, &node.variant);
        let lacks = |result: &NodeResult| {
            matches!(result, NodeResult::Missing | NodeResult::Blocked(_) | NodeResult::Failed { .. })
        };
        summary.nodes.retain(|node| own(node) || !lacks(&node.result));
    }
    // The finished results of an interrupted run were delivered scene by scene.
    let whole = !summary.interrupted && !summary.left;
    let mut delivered = match out {
        Some(out) if whole => out.deliver(&summary, &typed()),
        _ => Ok(Vec::new()),
    };
    if let (Some((choices, capture)), Ok(there), Some(out)) = (given.white, &delivered, out) {
        balance(app, choices, capture, there)?;
        // The pages open with this white balance.
        if !there.is_empty() {
            out.look_again();
            delivered = out.deliver(&summary, &typed());
        }
    }
    if as_json {
        output::json(&Outcome::new(&summary, &delivered))?;
    } else if !given.silent {
        print!("{summary}");
    }
    // The places were checked before, so an error here comes from the disk and not from the arguments.
    let delivered = delivered.map_err(WorkError::failed)?;
    let quiet = app.quiet || as_json || given.silent;
    if !quiet {
        outcome::lines(&delivered).iter().for_each(|line| println!("{line}"));
    }
    if let Some(out) = out.filter(|_| !delivered.is_empty()) {
        let until = options.until.as_deref();
        let cache = &loaded.pipeline.cache;
        let mut record = RunRecord::of(given.pipeline, until, cache, &summary, typed());
        if given.report_only {
            record.artifacts.retain(|made| made.scene.is_empty());
        }
        let replaced = history::keep(&out.out, record)?;
        replaced.iter().filter(|_| !quiet).for_each(|line| eprintln!("{line}"));
    }
    match summary.exit_code() {
        0 if given.photographs => photographs(app, loaded, &delivered, &summary),
        0 => Ok(()),
        75 => Err(WorkError::OutOfTime),
        130 => Err(WorkError::Interrupted),
        _ => {
            let missing: Vec<&str> = summary.missing().map(|node| node.label.as_str()).collect();
            if !missing.is_empty() {
                return Err(WorkError::Failed(format!(
                    "{} missing: {}{}; `use3d submit` submits them again, `use3d run` without --gather \
                     computes them here",
                    output::counted(missing.len(), "stage is", "stages are"),
                    missing[..missing.len().min(SHOWN)].join(", "),
                    if missing.len() > SHOWN { ", …" } else { "" }
                )));
            }
            let failed: Vec<&str> = summary.failed().map(|node| node.label.as_str()).collect();
            Err(WorkError::Failed(format!("failed: {}; see the reasons and logs above", failed.join(", "))))
        }
    }
}

/// Measures the white balance of every scene in the results.
fn balance(app: &App, choices: &[WhiteChoice], capture: &Path, delivered: &[Delivered]) -> Done {
    scenes_of(delivered).try_for_each(|result| keep_for(app, choices, &result.path, capture))
}

/// Writes all photographs of every scene in the results.
fn photographs(app: &App, loaded: &Loaded, delivered: &[Delivered], summary: &Summary) -> Done {
    for result in scenes_of(delivered) {
        let capture = loaded.capture_of(&result.scene).or_else(|| prepared(summary, &result.scene));
        photographs::of_run(app, &result.path, capture)?;
    }
    Ok(())
}

/// The capture that a stage of this run made for a scene.
fn prepared<'s>(summary: &'s Summary, scene: &str) -> Option<&'s Path> {
    let made = summary.nodes.iter().find(|node| node.stage == "prepare" && node.scene == scene)?;
    Some(&made.artifact.as_ref()?.path)
}

/// The number of missing stages that are named one by one.
const SHOWN: usize = 6;

/// The command as it was typed.
fn typed() -> String {
    let words: Vec<String> = std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect();
    quote::words(&words)
}

/// The name of the demo's capture, and so of its scene.
const SCENE: &str = "reef";

pub(crate) fn demo(app: &App, args: &DemoArgs) -> Done {
    let started = Instant::now();
    let (views, width, height, iterations, steps) = match args.size {
        DemoSize::Small => (40, 320, 180, 1100, 600),
        DemoSize::Full => (48, 640, 360, 3000, 1000),
    };
    // No depth priors: those of synthetic captures are made from the true depth, which a real diver does not
    // have.
    let params = use3d_synth::CaptureParams {
        views,
        width,
        height,
        depth_priors: false,
        ..use3d_synth::CaptureParams::default()
    };
    let capture = args.out.join("captures").join(SCENE);
    let mut sets =
        vec![format!("reconstruct.iterations={iterations}"), format!("enhance.iterations={steps}")];
    sets.extend(args.iterations.map(|n| format!("reconstruct.iterations={n}")));
    sets.extend(args.settings.sets());
    // Settings and the places of all results are checked before anything is rendered, with the pipeline of an
    // empty folder that has the capture's name.
    let probe = scratch()?;
    let empty = probe.path().join(SCENE);
    std::fs::create_dir(&empty).map_err(|e| WorkError::Failed(format!("{}: {e}", empty.display())))?;
    let mut probing = args.cache.request(&empty);
    probing.options =
        LoadOptions { sets: sets.clone(), cache: Some(probe.path().join("cache")), ..probing.options };
    let probed = probing.open()?;
    Results::new(&args.out, &probed.builder.cache, &probed.graph, None).check(&probed.graph, None)?;
    place::check(&capture, true)?;
    place::check_writable(&args.out)?;
    keep_capture(app, &params, &capture)?;
    let mut pipeline = args.cache.request(&capture);
    pipeline.options.sets = sets;
    pipeline.options.cache.get_or_insert_with(|| args.out.join("cache"));
    let loaded = pipeline.open()?;
    let results = Arc::new(Results::new(&args.out, &loaded.builder.cache, &loaded.graph, None));
    results.check(&loaded.graph, None)?;
    let plan = (!app.quiet).then(|| loaded.builder.plan(&loaded.graph, None));
    let given = Given { plan, ..Given::of(&pipeline) };
    execute(app, &loaded, &of_app(app), (Some(&results), &given), false)?;
    if !app.quiet {
        println!("The demo took {}.", seconds(started.elapsed().as_secs_f64()));
    }
    Ok(())
}
