//! Runs one stage by hand, without a pipeline file, with the same code and defaults.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

use serde_json::Value;
use use3d_pipeline::config::stage_parameters;
use use3d_scene::Origin;
use use3d_stages::{CALIBRATOR, TARGETS};
use use3d_workflow::machine::{bytes, seconds};
use use3d_workflow::{Alone, Event, Registry, StageError, leftovers};

use crate::App;
use crate::args::{
    CalibrateArgs, EngineArgs, EnhanceArgs, ImportArgs, ReconstructArgs, Spelled, TargetsArgs, as_typed,
};
use crate::destination::{
    check_file, check_folder, checkpoints_of, copy_file, copy_folder, entries, path_text, word,
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

/// The rules for a result that is kept.
struct Kept {
    /// Permission to replace an earlier result.
    force: bool,
    checkpoints: Option<PathBuf>,
}

/// Runs one stage of the table into `output`, a new folder that is removed at the end of the command.
pub(crate) fn run_stage(
    app: &App,
    registry: &Registry,
    stage: &str,
    parameters: &Value,
    inputs: Vec<(&str, PathBuf)>,
    output: &Path,
) -> Done {
    run_alone(app, registry, stage, parameters, inputs, output, None)
}

/// Runs one stage of the table; its result is kept if there are rules for it.
fn run_alone(
    app: &App,
    registry: &Registry,
    stage: &str,
    parameters: &Value,
    inputs: Vec<(&str, PathBuf)>,
    output: &Path,
    kept: Option<Kept>,
) -> Done {
    if let Some((role, path)) = inputs.iter().find(|(_, path)| !path.exists()) {
        // The name on the command line, and a hint for inputs that can be left out.
        let (named, without) = match *role {
            "models" => ("--models or USE3D_MODELS", " or leave it out"),
            "calibrator" => ("--calibrator", " or leave it out"),
            "reference" => ("--warp-by", " or leave it out"),
            "input" => ("--input", ""),
            "target" => ("--target", ""),
            "targets" => ("--targets", ""),
            role => (role, ""),
        };
        let message = format!("{named}: {} does not exist; correct the path{without}", path_text(path));
        return Err(CliError::Input(message));
    }
    let alone = Alone {
        parameters,
        inputs: inputs.into_iter().map(|(role, path)| (role.to_string(), path)).collect(),
        output,
        record: kept.is_some(),
        replace: kept.as_ref().is_some_and(|kept| kept.force),
        checkpoints: kept.and_then(|kept| kept.checkpoints),
        seed: app.seed,
        threads: app.threads,
        stop: app.stop.clone(),
    };
    let resumes = alone.checkpoints.is_some();
    let stage = registry.stage(stage).map_err(CliError::failed)?;
    stage.run_alone(alone, &app.listener).map_err(|error| match error {
        StageError::Cancelled if resumes => CliError::Interrupted,
        StageError::Cancelled => CliError::Stopped,
        StageError::Failed(_) if error.is_bad_input() => CliError::input(error),
        StageError::Failed(_) => CliError::failed(error),
    })
}

/// The value of a setting `seed=N`, which belongs to no single stage.
fn seed(set: &str) -> Option<&str> {
    set.split_once('=').filter(|(key, _)| key.trim() == "seed").map(|(_, value)| value.trim())
}

/// The same app with the seed of the settings, if they contain one.
fn seeded(app: &App, sets: &[String]) -> Result<App, CliError> {
    let mut app = app.clone();
    for (set, value) in sets.iter().filter_map(|set| Some((set, seed(set)?))) {
        let wrong = |_| CliError::Input(format!("--set {set}: the seed is a whole number, 0 or more"));
        app.seed = value.parse().map_err(wrong)?;
    }
    Ok(app)
}

/// Assigns settings to the stages whose parameters they name: `STAGE.KEY`, or `KEY` of the first stage that
/// has it.
pub(crate) fn parameters(
    registry: &Registry,
    names: &[&str],
    sets: &[String],
) -> Result<Vec<Value>, CliError> {
    let stages =
        names.iter().map(|n| registry.stage(n).map_err(CliError::failed)).collect::<Result<Vec<_>, _>>()?;
    let defaults: Vec<Value> =
        stages.iter().map(|s| stage_parameters(s, &[]).map_err(CliError::input)).collect::<Result<_, _>>()?;
    if let Some(set) = sets.iter().find(|set| seed(set).is_some())
        && !stages.iter().any(|stage| stage.seeded)
    {
        let what = "this command draws no random numbers, so it has no seed; leave it out";
        return Err(CliError::Input(format!("--set {set}: {what}")));
    }
    let mut sorted: Vec<Vec<String>> = vec![Vec::new(); stages.len()];
    for set in sets.iter().filter(|set| seed(set).is_none()) {
        let key = set.split(['=', '.']).next().unwrap_or_default().trim();
        let of_a_stage = set.trim_start()[key.len()..].starts_with('.');
        if of_a_stage && !names.contains(&key) && registry.stage(key).is_ok() {
            let what = format!("this command does not run the stage `{key}`; give this to `use3d run`");
            return Err(CliError::Input(format!("--set {set}: {what}")));
        }
        let named = names.iter().position(|n| of_a_stage && *n == key);
        let has = defaults.iter().position(|d| d.get(key).is_some());
        // The first stage reports a key that no stage has, and suggests the nearest one.
        sorted[named.or(has).unwrap_or(0)].push(set.clone());
    }
    stages.iter().zip(&sorted).map(|(s, sets)| stage_parameters(s, sets).map_err(CliError::input)).collect()
}

/// The engine of a stage, as a setting.
fn engine(args: &EngineArgs, stage: &'static str) -> Option<Spelled> {
    args.choice().map(|choice| Spelled::new("--engine", stage, "engine", choice))
}

/// The parameters of stages from flags that stand for settings, and from settings; the settings win. An error
/// names the flag that was typed.
fn with_flags(
    registry: &Registry,
    names: &[&str],
    flags: &[Spelled],
    sets: &[String],
) -> Result<Vec<Value>, CliError> {
    let all: Vec<String> = flags.iter().map(Spelled::set).chain(sets.iter().cloned()).collect();
    parameters(registry, names, &all).map_err(|error| match error {
        CliError::Input(message) => CliError::Input(as_typed(&message, flags)),
        other => other,
    })
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

/// The folder in which an unfinished training by hand keeps its checkpoints: beside its result, hidden.
/// Trainings with the same `--out` but other parameters or inputs share the folder; each resumes from its
/// own.
struct Checkpoints {
    folder: PathBuf,
    /// The files that existed before: those of this training, which removes the ones it no longer needs, or
    /// those of others.
    before: BTreeSet<PathBuf>,
}

impl Checkpoints {
    fn beside(out: &Path) -> Self {
        let folder = checkpoints_of(out);
        Self { before: entries(&folder).collect(), folder }
    }

    /// Removes the checkpoints that are no longer needed; those of other trainings stay.
    fn forget(&self, app: &App) {
        for path in entries(&self.folder).filter(|path| !self.before.contains(path)) {
            if let Err(error) = std::fs::remove_file(&path) {
                tracing::warn!("{}: {error}; this checkpoint is no longer needed", path.display());
            }
        }
        // This succeeds only if the folder is empty.
        let gone = std::fs::remove_dir(&self.folder).is_ok();
        if !gone && entries(&self.folder).next().is_some() {
            remark!(
                app,
                "{}: kept checkpoints of a run with other parameters or inputs; delete them if you will not \
                 resume it",
                path_text(&self.folder)
            );
        }
    }
}

/// Imports a capture into a scratch folder, or uses one that was imported before.
pub(crate) fn imported(
    app: &App,
    registry: &Registry,
    capture: &Path,
    parameters: &Value,
    scratch: &Path,
) -> Result<PathBuf, CliError> {
    if use3d_import::is_prepared(capture) {
        return Ok(capture.to_path_buf());
    }
    let folder = scratch.join("import");
    let inputs = vec![("capture", capture.to_path_buf())];
    run_stage(app, registry, "import", parameters, inputs, &folder)?;
    Ok(folder)
}

/// Refuses a capture that the scene was not made from. If views are scored, it also refuses a split that
/// holds out views of the scene's training.
pub(crate) fn check_origin(scene: &Path, import: &Path, scored: bool) -> Done {
    let Some(origin) = Origin::read(scene).map_err(CliError::input)? else { return Ok(()) };
    let capture = use3d_import::load_prepared(import).map_err(CliError::input)?.capture;
    origin.check_capture(scene, &capture).map_err(CliError::Input)?;
    if scored { origin.check_split(scene, &capture).map_err(CliError::Input) } else { Ok(()) }
}

pub(crate) fn import(app: &App, args: &ImportArgs) -> Done {
    let started = Instant::now();
    let force = args.replace.force;
    check_folder(&args.out, force)?;
    let registry = stages()?;
    let parameters = with_flags(&registry, &["import"], &args.size.spelled(), &args.settings.set)?;
    let inputs = vec![("capture", args.capture.clone())];
    let kept = Kept { force, checkpoints: None };
    run_alone(app, &registry, "import", &parameters[0], inputs, &args.out, Some(kept))?;
    finished(app, &args.out, started, &format!("use3d reconstruct {} --out scene/", word(&args.out)));
    Ok(())
}

/// The same app, which also prints the time of each part of a stage on stdout.
fn profiling(app: &App) -> App {
    app.heard_by(|event| {
        if let Event::Profile { text, .. } = event {
            print!("{text}");
        }
    })
}

/// Returns true if depth priors must be made for a prepared capture.
fn depth_wanted(reconstruct: &Value, depth: Option<&Value>, capture: &Path, models: Option<&Path>) -> bool {
    let import = use3d_import::ImportParams::default();
    let depth = depth.unwrap_or(&Value::Null);
    use3d_stages::depth_wanted(reconstruct, depth, Some((capture, &import)), models)
}

pub(crate) fn reconstruct(app: &App, args: &ReconstructArgs) -> Done {
    let started = Instant::now();
    let app = &seeded(app, &args.settings.set)?;
    let force = args.replace.force;
    check_folder(&args.out, force)?;
    let registry = stages()?;
    let names = ["reconstruct", "import", "propose", "depth"];
    let mut spelled = args.common.spelled();
    spelled.extend(engine(&args.engine, "reconstruct"));
    let parameters = with_flags(&registry, &names, &spelled, &args.settings.set)?;
    let scratch = scratch()?;
    let import = imported(app, &registry, &args.capture, &parameters[1], scratch.path())?;
    let mut inputs = vec![("import", import.clone())];
    if parameters[0]["images"] == "proposed" {
        let folder = scratch.path().join("proposals");
        let mut given = vec![("import", import)];
        given.extend(args.models.clone().map(|dir| ("models", dir)));
        run_stage(app, &registry, "propose", &parameters[2], given, &folder)?;
        inputs.push(("proposals", folder));
    }
    if depth_wanted(&parameters[0], parameters.get(3), &inputs[0].1, args.models.as_deref()) {
        let Some(models) = args.models.clone() else {
            return Err(CliError::input(
                "depth_prior=depth-anything-v2 needs the network's weights: pass --models DIR, or set USE3D_MODELS (`use3d models` lists what is there)",
            ));
        };
        let folder = scratch.path().join("depth");
        let given = vec![("import", inputs[0].1.clone()), ("models", models)];
        let depth = parameters.get(3).unwrap_or(&Value::Null);
        run_stage(app, &registry, "depth", depth, given, &folder)?;
        inputs.push(("depth", folder));
    }
    let app = if args.profile { &profiling(app) } else { app };
    let saved = Checkpoints::beside(&args.out);
    let kept = Kept { force, checkpoints: Some(saved.folder.clone()) };
    watched(app, &args.watch, Some(&scene_name(&args.out)), |app| {
        run_alone(app, &registry, "reconstruct", &parameters[0], inputs, &args.out, Some(kept))
    })?;
    saved.forget(app);
    let (scene, capture) = (word(&args.out), word(&args.capture));
    let next =
        format!("use3d render {scene} --cameras {capture} --out renders/ --modes reconstruction,clear");
    finished(app, &args.out, started, &next);
    Ok(())
}

pub(crate) fn calibrate(app: &App, args: &CalibrateArgs) -> Done {
    let started = Instant::now();
    let app = &seeded(app, &args.settings.set)?;
    check_file("--out", &args.out, args.replace.force, &[])?;
    let registry = stages()?;
    let mut sets = args.settings.set.clone();
    sets.extend(args.proposer.iter().map(|proposer| format!("pairs.proposer={proposer}")));
    let parameters = parameters(&registry, &["calibrate", "pairs"], &sets)?;
    let scratch = scratch()?;
    let pairs = scratch.path().join("pairs");
    let mut inputs = vec![("input", args.input.clone()), ("target", args.target.clone())];
    inputs.extend(args.models.clone().map(|dir| ("models", dir)));
    run_stage(app, &registry, "pairs", &parameters[1], inputs, &pairs)?;
    let out = scratch.path().join("calibrate");
    run_stage(app, &registry, "calibrate", &parameters[0], vec![("pairs", pairs)], &out)?;
    copy_file("--out", &out.join(CALIBRATOR), &args.out)?;
    let calibrator = word(&args.out);
    let next = format!("use3d targets SCENE CAPTURE --calibrator {calibrator} --out targets.safetensors");
    finished(app, &args.out, started, &next);
    Ok(())
}

pub(crate) fn targets(app: &App, args: &TargetsArgs) -> Done {
    let started = Instant::now();
    let app = &seeded(app, &args.settings.set)?;
    check_file("--out", &args.out, args.replace.force, &[])?;
    // The pictures that show the reason for consensus are written beside the file.
    let previews = args.out.with_extension("previews");
    check_folder(&previews, args.replace.force)?;
    let registry = stages()?;
    let mut sets = args.settings.set.clone();
    if args.calibrator.is_some() {
        sets.insert(0, "calibrated=true".into());
    }
    let parameters = with_flags(&registry, &["targets", "import"], &args.size.spelled(), &sets)?;
    if args.calibrator.is_none() && parameters[0]["calibrated"] == true {
        return Err(CliError::input(
            "calibrated = true needs a calibrator: give --calibrator FILE (`use3d calibrate` makes one)",
        ));
    }
    let scratch = scratch()?;
    let import = imported(app, &registry, &args.capture, &parameters[1], scratch.path())?;
    check_origin(&args.scene, &import, false)?;
    let mut inputs = vec![("import", import), ("scene", args.scene.clone())];
    inputs.extend(args.calibrator.clone().map(|file| ("calibrator", file)));
    inputs.extend(args.models.clone().map(|dir| ("models", dir)));
    let out = scratch.path().join("targets");
    run_stage(app, &registry, "targets", &parameters[0], inputs, &out)?;
    if out.join("previews").is_dir() {
        copy_folder(&out.join("previews"), &previews, args.replace.force)?;
    }
    copy_file("--out", &out.join(TARGETS), &args.out)?;
    let (scene, capture, targets) = (word(&args.scene), word(&args.capture), word(&args.out));
    let next = format!("use3d enhance {scene} {capture} --targets {targets} --out enhanced-scene/");
    finished(app, &args.out, started, &next);
    Ok(())
}

pub(crate) fn enhance(app: &App, args: &EnhanceArgs) -> Done {
    let started = Instant::now();
    let app = &seeded(app, &args.settings.set)?;
    let force = args.replace.force;
    check_folder(&args.out, force)?;
    let registry = stages()?;
    let mut spelled = args.size.spelled();
    spelled.extend(args.iterations.map(|n| Spelled::new("--iterations", "enhance", "iterations", n)));
    spelled.extend(engine(&args.engine, "enhance"));
    let parameters = with_flags(&registry, &["enhance", "import"], &spelled, &args.settings.set)?;
    let scratch = scratch()?;
    let import = imported(app, &registry, &args.capture, &parameters[1], scratch.path())?;
    check_origin(&args.scene, &import, false)?;
    let mut inputs =
        vec![("import", import), ("scene", args.scene.clone()), ("targets", args.targets.clone())];
    inputs.extend(args.models.clone().map(|dir| ("models", dir)));
    let app = if args.profile { &profiling(app) } else { app };
    let saved = Checkpoints::beside(&args.out);
    let kept = Kept { force, checkpoints: Some(saved.folder.clone()) };
    run_alone(app, &registry, "enhance", &parameters[0], inputs, &args.out, Some(kept))?;
    saved.forget(app);
    let (scene, capture) = (word(&args.out), word(&args.capture));
    let next =
        format!("use3d render {scene} --cameras {capture} --out renders/ --modes enhanced-clear,enhanced");
    finished(app, &args.out, started, &next);
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use use3d_workflow::Silent;

    use super::*;

    #[test]
    fn a_seed_by_hand_is_the_run_s_and_no_stage_s() {
        let app = App { quiet: true, seed: 42, threads: 1, stop: Arc::default(), listener: Arc::new(Silent) };
        let seed = |sets: &[&str]| {
            let sets: Vec<String> = sets.iter().map(ToString::to_string).collect();
            let parameters = parameters(&stages().ok()?, &["calibrate", "pairs"], &sets).ok()?;
            assert!(parameters.iter().all(|p| p.get("seed").is_none()));
            Some(seeded(&app, &sets).ok()?.seed)
        };
        assert_eq!(seed(&[]), Some(42));
        assert_eq!(seed(&["steps=3", "seed=7"]), Some(7));
        assert_eq!(seed(&["seed=x"]), None);
        assert_eq!(seed(&["calibrate.seed=7"]), None, "no stage has a seed of its own");
        let registry = stages().ok().unwrap();
        let refused = parameters(&registry, &["evaluate", "import"], &["seed=7".into()]);
        let Err(CliError::Input(message)) = refused else { panic!("a seed without effect") };
        assert!(message.contains("draws no random numbers"), "{message}");
    }
}
