//! Pipelines: run, plan, status, why, graph, and the demo.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;
use use3d_build::machine::seconds;
use use3d_build::place;
use use3d_build::status::{Row, Standing};
use use3d_build::{Builder, Cache, Event, Graph, Listener, PATIENCE, Plan, RunOptions, Summary, picture};
use use3d_cluster::{quote, slurm};
use use3d_pipeline::config::{LoadOptions, Pipeline, for_capture, load};
use use3d_pipeline::results::Results;

use crate::App;
use crate::args::{
    CacheArgs, DemoArgs, DemoSize, GraphArgs, GraphFormat, PipelineArgs, PlanArgs, RunArgs, Settings,
    StatusArgs, WhyArgs, as_typed,
};
use crate::destination::path_text;
use crate::error::{CliError, Done};
use crate::verbs::outcome::{self, Outcome};
use crate::verbs::remote::of_run;
use crate::verbs::stages::{scratch, stages};
use crate::verbs::synth::keep_capture;
use crate::verbs::view::Watched;

/// A pipeline with the builder and graph to work on it.
pub(crate) struct Loaded {
    pub(crate) pipeline: Pipeline,
    pub(crate) builder: Builder,
    pub(crate) graph: Graph,
}

/// Loads a pipeline file, or makes one of a capture folder.
pub(crate) fn open(
    PipelineArgs { target, settings, calibration, cache }: &PipelineArgs,
    scenes: &[String],
) -> Result<Loaded, CliError> {
    let registry = stages()?;
    let options = LoadOptions {
        sets: settings.sets(),
        cache: cache.cache.clone(),
        models: cache.models.clone(),
        scenes: scenes.to_vec(),
        pairs: calibration.pairs(),
        calibrator: calibration.calibrator.clone(),
    };
    let pipeline = if target.is_dir() {
        for_capture(&registry, target, &options)
    } else if target.is_file() {
        if let Some(what) = no_pipeline(target) {
            return Err(CliError::Input(format!("{}: {what}", target.display())));
        }
        load(&registry, target, &options)
    } else {
        let what = "there is no such pipeline file (.toml) or capture folder";
        return Err(CliError::Input(format!("{}: {what}", target.display())));
    };
    let pipeline =
        pipeline.map_err(|error| CliError::Input(as_typed(&error.to_string(), settings.engine.as_ref())))?;
    outside_captures(&pipeline)?;
    let cache = Cache::open(&pipeline.cache, cache.rehash).map_err(CliError::input)?.asking(slurm::is_over());
    let graph = Graph::new(&registry, &pipeline.batch).map_err(CliError::input)?;
    Ok(Loaded { pipeline, builder: Builder::new(registry, cache), graph })
}

/// Refuses a cache in a capture's folder: beside the photographs it would be in the way, and in a prepared
/// capture, of which every file counts, it would change what it holds the results of.
fn outside_captures(pipeline: &Pipeline) -> Done {
    let cache = real(&pipeline.cache);
    let captures = pipeline.batch.scenes.iter().filter_map(|s| s.externals.get("capture")?.as_ref().ok());
    match captures.into_iter().find(|capture| cache.starts_with(real(capture))) {
        None => Ok(()),
        Some(capture) => Err(CliError::Input(format!(
            "--cache {}: it would lie in the capture {}; choose a folder outside",
            path_text(&pipeline.cache),
            path_text(capture)
        ))),
    }
}

/// Refuses results in the cache: they would lie among its own files.
fn outside_the_cache(out: &Path, cache: &Path) -> Done {
    if !real(out).starts_with(real(cache)) {
        return Ok(());
    }
    Err(CliError::Input(format!(
        "--out {}: it would lie in the cache {}; choose a folder outside",
        path_text(out),
        path_text(cache)
    )))
}

/// A path with all links followed, as far as it is there.
fn real(path: &Path) -> PathBuf {
    let path = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    let there = path.ancestors().find_map(|part| Some((part, part.canonicalize().ok()?)));
    match there {
        Some((part, real)) => path.strip_prefix(part).map_or(real.clone(), |rest| real.join(rest)),
        None => path,
    }
}

/// What a file is that is given where a pipeline file or a capture folder is
/// expected, and what to do with it.
fn no_pipeline(file: &Path) -> Option<&'static str> {
    let extension = file.extension()?.to_string_lossy().to_lowercase();
    Some(match extension.as_str() {
        "mp4" | "mov" | "avi" | "mkv" | "webm" | "m4v" => {
            "a film is no capture yet: take frames out of it (`ffmpeg -i FILM -vf fps=2 images/%05d.png`), run COLMAP on \
             them, and give the folder that holds images/ and sparse/"
        }
        "png" | "jpg" | "jpeg" | "tif" | "tiff" | "exr" | "webp" | "heic" | "bmp" | "gif" => {
            "one picture is no capture: give the folder that holds the images and their COLMAP model"
        }
        "json" | "xml" | "psx" | "rcproj" => {
            "this is no pipeline file (.toml): give the capture's folder, with images and a COLMAP model (docs/guide/captures.md)"
        }
        _ => return None,
    })
}

/// Prints one JSON document.
pub(crate) fn json(value: &impl Serialize) -> Done {
    let text = serde_json::to_string_pretty(value).map_err(CliError::failed)?;
    println!("{text}");
    Ok(())
}

fn planned(args: &PlanArgs) -> Result<(Loaded, Plan), CliError> {
    let loaded = open(&args.pipeline, &[])?;
    let plan = loaded.builder.plan(&loaded.graph, None);
    Ok((loaded, plan))
}

pub(crate) fn plan(args: &PlanArgs) -> Done {
    let (_, plan) = planned(args)?;
    show(&plan, args.json)
}

/// Prints a plan. One that cannot be carried out, since an input is missing, ends as the run would.
fn show(plan: &Plan, as_json: bool) -> Done {
    if as_json {
        json(plan)?;
    } else {
        print!("{plan}");
    }
    match plan.unavailable() {
        0 => Ok(()),
        _ => Err(CliError::Failed(
            "inputs that the pipeline names are missing (`cannot` above); what needs them would fail".into(),
        )),
    }
}

pub(crate) fn status(args: &StatusArgs) -> Done {
    let (loaded, plan) = planned(&args.plan)?;
    let mut status = plan.status();
    for name in &args.scene {
        let known = || loaded.pipeline.batch.scenes.iter().map(|s| s.name.as_str());
        if !known().any(|scene| scene == name) {
            return Err(CliError::input(use3d_build::BuildError::unknown("scene", name, known())));
        }
    }
    status.rows.retain(|row| {
        let asked = args.scene.is_empty() || args.scene.contains(&row.scene);
        let failed = |row: &Row| row.cells.iter().any(|cell| cell.standing == Standing::Failed);
        asked && (!args.failed || failed(row))
    });
    match (args.summary, args.plan.json) {
        (true, true) => json(&status.counts()),
        (true, false) => {
            print!("{}", status.counts());
            Ok(())
        }
        (false, true) => json(&status),
        (false, false) => {
            print!("{status}");
            Ok(())
        }
    }
}

pub(crate) fn why(args: &WhyArgs) -> Done {
    let loaded = open(&args.pipeline, &[])?;
    // `SCENE` or `SCENE@VARIANT`.
    let (scene, variant) = args.scene.split_once('@').unwrap_or((&args.scene, ""));
    let why = loaded.builder.why(&loaded.graph, scene, variant, &args.stage).map_err(CliError::input)?;
    if args.json {
        return json(&why);
    }
    print!("{why}");
    Ok(())
}

pub(crate) fn graph(args: &GraphArgs) -> Done {
    let loaded = open(&args.pipeline, &[])?;
    let plan = loaded.builder.plan(&loaded.graph, None);
    match args.format {
        GraphFormat::Mermaid => print!("{}", picture::mermaid(&loaded.graph, &plan)),
        GraphFormat::Svg => print!("{}", picture::svg(&loaded.graph, &plan)),
    }
    Ok(())
}

pub(crate) fn run(app: &App, args: &RunArgs) -> Done {
    let loaded = open(&args.pipeline, &args.scene)?;
    let until = args.until.clone().map(|stage| vec![stage]);
    if let Some(stage) = &args.until {
        loaded.builder.registry.stage(stage).map_err(CliError::input)?;
    }
    if args.dry_run {
        return show(&loaded.builder.plan(&loaded.graph, until.as_deref()), args.json);
    }
    if let Some(submitted) = &args.submitted
        && *submitted != loaded.graph.digest(&loaded.builder.registry).short()
    {
        return Err(CliError::Input(format!(
            "{}: this is not what was submitted: the file was edited since, or this is another version of the program; submit it \
             again",
            path_text(&args.pipeline.target)
        )));
    }
    let only = only(&loaded.graph, &args.only)?;
    let out =
        args.out.clone().unwrap_or_else(|| PathBuf::from("use3d-out").join(&loaded.pipeline.batch.name));
    let out = (!args.cache_only).then_some(out);
    if let Some(out) = &out {
        outside_the_cache(out, &loaded.pipeline.cache)?;
    }
    let results = out.map(|out| Arc::new(Results::new(&out, &loaded.builder.cache)));
    if let Some(results) = &results {
        results.check(&loaded.graph, until.as_deref())?;
    }
    let loaded = match &args.remote {
        Some(address) => {
            let store = of_run(app, address, args.remote_read_only)?;
            Loaded { builder: loaded.builder.with_remote(store), ..loaded }
        }
        None => loaded,
    };
    let watched = Watched::start(app, &args.watch, None)?;
    let app = watched.as_ref().map_or(app, Watched::app);
    let options = RunOptions {
        jobs: args.jobs,
        keep_going: args.keep_going,
        until,
        only,
        limit: args.max_time,
        until_empty: args.until_empty.then_some(PATIENCE),
        gather: args.gather,
        ..of_app(app)
    };
    let done = execute(app, &loaded, &options, results.as_ref(), args.json);
    if let Some(watched) = &watched {
        watched.end(&done);
    }
    done
}

/// How this process runs a pipeline, unless more is said.
fn of_app(app: &App) -> RunOptions {
    RunOptions {
        cores: app.threads,
        stop: app.stop.clone(),
        leave: crate::interrupt::leave(),
        ..RunOptions::default()
    }
}

/// The scenes and variants of `--only`.
fn only(graph: &Graph, named: &[String]) -> Result<Option<Vec<(String, String)>>, CliError> {
    let cells: BTreeSet<(String, String)> = graph
        .nodes
        .iter()
        .map(|n| (n.scene.clone(), n.variant.clone()))
        .filter(|(s, _)| !s.is_empty())
        .collect();
    let find = |name: &String| {
        let (scene, variant) = name.split_once('@').unwrap_or((name, ""));
        let cell = (scene.to_string(), variant.to_string());
        if cells.contains(&cell) {
            return Ok(cell);
        }
        let known: Vec<String> =
            cells.iter().map(|(s, v)| if v.is_empty() { s.clone() } else { format!("{s}@{v}") }).collect();
        let known = known.iter().map(String::as_str);
        Err(CliError::input(use3d_build::BuildError::unknown("scene and variant", name, known)))
    };
    let found: Vec<(String, String)> = named.iter().map(find).collect::<Result<_, _>>()?;
    Ok((!found.is_empty()).then_some(found))
}

fn execute(
    app: &App,
    loaded: &Loaded,
    options: &RunOptions,
    out: Option<&Arc<Results>>,
    as_json: bool,
) -> Done {
    let listener = out.map_or_else(|| app.listener.clone(), |out| delivering(app, out));
    let summary = loaded.builder.run(&loaded.graph, options, &listener);
    // What an interrupted run has finished was delivered scene by scene.
    let delivered = match out {
        Some(out) if !summary.interrupted && !summary.left => out.deliver(&summary, &typed()),
        _ => Ok(Vec::new()),
    };
    if as_json {
        json(&Outcome::new(&summary, &delivered))?;
    } else {
        print!("{summary}");
    }
    // Places were looked at before: what fails now is the disk, not the request.
    let delivered = delivered.map_err(CliError::failed)?;
    if !app.quiet && !as_json {
        outcome::tell(&delivered);
    }
    match summary.exit_code() {
        0 => Ok(()),
        75 => Err(CliError::OutOfTime),
        130 => Err(CliError::Interrupted),
        _ => {
            let missing: Vec<&str> = summary.missing().map(|node| node.label.as_str()).collect();
            if !missing.is_empty() {
                return Err(CliError::Failed(format!(
                    "{} missing: {}{}; `use3d submit` hands them over once more, `use3d run` without --gather computes them \
                     here",
                    if missing.len() == 1 {
                        "1 stage is".to_string()
                    } else {
                        format!("{} stages are", missing.len())
                    },
                    missing[..missing.len().min(SHOWN)].join(", "),
                    if missing.len() > SHOWN { ", …" } else { "" }
                )));
            }
            let failed: Vec<&str> = summary.failed().map(|node| node.label.as_str()).collect();
            Err(CliError::Failed(format!("failed: {}; see the reasons and logs above", failed.join(", "))))
        }
    }
}

/// Stages that are named one by one.
const SHOWN: usize = 6;

/// The command as it was typed.
fn typed() -> String {
    let words: Vec<String> = std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect();
    quote::words(&words)
}

/// The app's listener, which also delivers every scene as soon as it is over: the
/// batch may take days yet, or fail.
fn delivering(app: &App, out: &Arc<Results>) -> Arc<dyn Listener> {
    let (inner, out) = (app.listener.clone(), out.clone());
    Arc::new(move |event: &Event<'_>| {
        inner.event(event);
        if let Event::SceneOver { scene, variant, nodes } = event
            && let Err(error) = out.deliver(&Summary::of_scene(nodes, scene, variant), &typed())
        {
            // Tried again at the end, where it counts.
            let text = format!("its results could not be delivered yet: {error}");
            inner.event(&Event::Warning { label: scene, text: &text });
        }
    })
}

/// The demo's capture, and so its scene.
const SCENE: &str = "reef";

pub(crate) fn demo(app: &App, args: &DemoArgs) -> Done {
    let started = Instant::now();
    let (views, width, height, iterations, steps) = match args.size {
        DemoSize::Small => (40, 320, 180, 3000, 600),
        DemoSize::Full => (48, 640, 360, 15_000, 5000),
    };
    let params = use3d_synth::CaptureParams { views, width, height, ..use3d_synth::CaptureParams::default() };
    let capture = args.out.join("captures").join(SCENE);
    let mut sets =
        vec![format!("reconstruct.iterations={iterations}"), format!("enhance.iterations={steps}")];
    sets.extend(args.settings.sets());
    // Settings and the places of all results are checked before anything is rendered: the pipeline of an
    // empty folder of the capture's name knows the same ones.
    let probe = scratch()?;
    let empty = probe.path().join(SCENE);
    std::fs::create_dir(&empty).map_err(CliError::failed)?;
    let settings = Settings { set: sets, engine: None };
    let throwaway = CacheArgs { cache: Some(probe.path().join("cache")), ..args.cache.clone() };
    let probed =
        open(&PipelineArgs { settings: settings.clone(), ..PipelineArgs::of(&empty, &throwaway) }, &[])?;
    Results::new(&args.out, &probed.builder.cache).check(&probed.graph, None)?;
    place::check(&capture, true)?;
    place::check_writable(&args.out)?;
    keep_capture(app, &params, &capture)?;
    let mut cache = args.cache.clone();
    cache.cache.get_or_insert_with(|| args.out.join("cache"));
    let loaded = open(&PipelineArgs { settings, ..PipelineArgs::of(&capture, &cache) }, &[])?;
    let results = Arc::new(Results::new(&args.out, &loaded.builder.cache));
    results.check(&loaded.graph, None)?;
    execute(app, &loaded, &of_app(app), Some(&results), false)?;
    if !app.quiet {
        println!(
            "the demo took {}; open {} in a browser",
            seconds(started.elapsed().as_secs_f64()),
            args.out.join("report.html").display()
        );
    }
    Ok(())
}
