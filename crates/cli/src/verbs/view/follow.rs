//! Follows a training through its files: its checkpoints while it runs, its scene when it is done. The
//! training process is not contacted, so it needs no port, and may run on another machine that writes to the
//! same disk.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use use3d_capture::Frame;
use use3d_import::{ImportParams, Imported, import, load_prepared};
use use3d_pipeline::loaded::Loaded;
use use3d_pipeline::scene_views::{saved_views, scene_name};
use use3d_reconstruct::scene_in_checkpoint;
use use3d_scene::Scene;
use use3d_viewer::{Live, Shown};
use use3d_web::PageView;

use super::{Stream, WAIT, serve};
use crate::App;
use crate::args::ViewArgs;
use crate::error::{Done, WorkError};
use use3d_pipeline::destination::{checkpoints_in, entries, path_text, work_of};

/// Time between two checks of the files.
const EVERY: Duration = Duration::from_secs(3);
/// Time between two checks of a pipeline's plan, which reads more files.
const PLAN_EVERY: Duration = Duration::from_secs(10);

/// The training to follow.
enum Followed {
    /// A scene folder that exists or will exist, and the folder for the work of its training.
    Scene { folder: PathBuf, work: PathBuf },
    /// Checkpoints: a folder of them, or one file.
    Checkpoints(PathBuf),
    /// One scene of a pipeline.
    Pipeline { loaded: Box<Loaded>, scene: String },
}

/// The newest file of a training, and the folder of its photographs, if it is known.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Newest {
    file: PathBuf,
    /// Distinguishes it from an earlier file of the same name.
    modified: Option<SystemTime>,
    import: Option<PathBuf>,
}

/// `use3d view --follow`.
pub(super) fn run(app: &App, args: &ViewArgs, target: &Path, live: &Arc<Live>) -> Done {
    let followed = followed(args, target)?;
    let capture = args.cameras.as_ref().map(|path| import(path, &ImportParams::default()));
    let capture = capture.transpose().map_err(WorkError::input)?;
    let name = match &followed {
        Followed::Pipeline { scene, .. } => scene.clone(),
        Followed::Scene { folder, .. } => scene_name(folder),
        Followed::Checkpoints(path) => scene_name(path),
    };
    let saved = saved_views(args.views.as_deref())?.map(Arc::new);
    live.wait_for(&format!("Waiting for the first checkpoint of {name}"));
    let _server = serve(app, args.port, args.no_open, live, Stream::Result)?;
    if !app.quiet && newest(&followed).is_none() {
        let wanted = match &followed {
            Followed::Scene { folder, .. } => format!("a training whose --out is {}", path_text(folder)),
            Followed::Checkpoints(path) => format!("a checkpoint in {}", path_text(path)),
            Followed::Pipeline { scene, .. } => format!("the training of {scene}"),
        };
        eprintln!("nothing to show yet; waiting for {wanted}");
    }
    let every = if matches!(followed, Followed::Pipeline { .. }) { PLAN_EVERY } else { EVERY };
    let (mut shown, mut looked): (Option<Newest>, Option<Instant>) = (None, None);
    let mut places: Option<(Option<PathBuf>, Frame, Arc<Vec<PageView>>)> = None;
    while !app.host.stops() {
        if looked.is_some_and(|at| at.elapsed() < every) {
            std::thread::sleep(WAIT);
            continue;
        }
        looked = Some(Instant::now());
        let Some(newest) = newest(&followed).filter(|newest| shown.as_ref() != Some(newest)) else {
            continue;
        };
        let own = newest.import.as_deref().and_then(|folder| load_prepared(folder).ok());
        let capture = own.as_ref().or(capture.as_ref());
        let (step, scene) = match read(&newest.file, capture) {
            Ok(Some(found)) => found,
            // The training has removed it and has a later one by now.
            Ok(None) => continue,
            Err(error) => {
                live.wait_for(&error);
                tracing::warn!("{error}");
                shown = Some(newest);
                continue;
            }
        };
        let known =
            places.as_ref().is_some_and(|(of, frame, _)| *of == newest.import && *frame == scene.frame);
        if !known {
            let views = capture.map_or_else(|| Ok(Vec::new()), |capture| super::places(&scene, capture));
            places = Some((newest.import.clone(), scene.frame, Arc::new(views.map_err(WorkError::input)?)));
        }
        let Some((_, _, views)) = &places else { continue };
        let what = step.map_or_else(|| "the finished scene".to_string(), |step| format!("step {step}"));
        remark!(app, "{name}: {what}, {} Gaussians", scene.gaussians.len());
        let state = Shown::new(name.clone(), scene, views.clone(), step);
        live.show(Shown { metres_per_unit: args.metres_per_unit, saved: saved.clone(), ..state });
        shown = Some(newest);
    }
    Ok(())
}

/// Finds what a path names.
fn followed(args: &ViewArgs, target: &Path) -> Result<Followed, WorkError> {
    let is_checkpoint = |path: &Path| path.extension().is_some_and(|e| e == "checkpoint");
    let beside = work_of(target);
    if is_checkpoint(target) || target.is_dir() && entries(target).any(|file| is_checkpoint(&file)) {
        return Ok(Followed::Checkpoints(target.to_path_buf()));
    }
    // A training that has not begun yet may be waited for, but not below a folder that does not exist.
    let parent = target.parent().filter(|parent| !parent.as_os_str().is_empty());
    if let Some(parent) = parent.filter(|parent| !target.exists() && !parent.is_dir()) {
        return Err(WorkError::Input(format!(
            "--follow {}: there is no folder {}; expected a pipeline file, a capture, a checkpoint, or the --out of `use3d reconstruct`",
            path_text(target),
            path_text(parent)
        )));
    }
    if Scene::is_scene(target) || beside.is_dir() || !target.exists() {
        return Ok(Followed::Scene { folder: target.to_path_buf(), work: beside });
    }
    let mut request = args.cache.request(target);
    request.options.sets.clone_from(&args.set);
    let loaded = request.open()?;
    let plan = loaded.builder.plan(&loaded.graph, None);
    let mut scenes =
        plan.nodes.iter().filter(|node| node.stage == "reconstruct").map(|node| node.scene.clone());
    let scene = match &args.scene {
        Some(wanted) => scenes.find(|scene| scene == wanted),
        None => scenes.next(),
    };
    let Some(scene) = scene else {
        let wanted = args.scene.as_deref().unwrap_or("any");
        return Err(WorkError::Input(format!("{}: it has no scene `{wanted}`", target.display())));
    };
    Ok(Followed::Pipeline { loaded: Box::new(loaded), scene })
}

fn modified(path: &Path) -> Option<SystemTime> {
    std::fs::metadata(path).and_then(|m| m.modified()).ok()
}

/// The newest checkpoint of stage 1 in a folder, or the path itself if it is a file.
fn checkpoint(path: &Path) -> Option<PathBuf> {
    if path.is_file() {
        return Some(path.to_path_buf());
    }
    newest_of_stage_1(entries(path))
}

/// The newest checkpoint of stage 1 among some files.
fn newest_of_stage_1(files: impl Iterator<Item = PathBuf>) -> Option<PathBuf> {
    let named = |file: &PathBuf| {
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("reconstruct-") && name.ends_with(".checkpoint")
    };
    files.filter(named).max_by_key(|file| modified(file))
}

fn newest(followed: &Followed) -> Option<Newest> {
    let of = |file: PathBuf, import: Option<PathBuf>| Newest { modified: modified(&file), file, import };
    match followed {
        Followed::Checkpoints(path) => checkpoint(path).map(|file| of(file, None)),
        Followed::Scene { folder, work } => {
            // A training that began after the scene was made has newer files.
            let made = Some(folder.join("scene.json")).filter(|file| file.is_file());
            let found = made.into_iter().chain(newest_of_stage_1(checkpoints_in(work)));
            found.max_by_key(|file| modified(file)).map(|file| of(file, None))
        }
        Followed::Pipeline { loaded, scene } => {
            let plan = loaded.builder.plan(&loaded.graph, None);
            let node =
                |stage: &str| plan.nodes.iter().find(|node| node.stage == stage && node.scene == *scene);
            let import = node("import").and_then(|node| node.artifact.clone());
            let made = ["enhance", "reconstruct"].iter().find_map(|stage| node(stage)?.artifact.clone());
            let unfinished = || {
                let key = node("reconstruct")?.checkpoints?;
                checkpoint(&loaded.builder.cache.checkpoint_path("reconstruct", &key))
            };
            made.map(|folder| folder.join("scene.json")).or_else(unfinished).map(|file| of(file, import))
        }
    }
}

/// Reads the scene from a file: `scene.json` stands for its folder.
fn read(file: &Path, capture: Option<&Imported>) -> Result<Option<(Option<u64>, Scene)>, String> {
    if let Some(folder) = file.parent().filter(|_| file.file_name().is_some_and(|name| name == "scene.json"))
    {
        return Scene::load(folder).map(|scene| Some((None, scene))).map_err(|e| e.to_string());
    }
    let frame = capture.map_or(Frame::IDENTITY, |imported| imported.capture.frame);
    let found = scene_in_checkpoint(file, frame).map_err(|e| e.to_string())?;
    Ok(found.map(|(step, scene)| (Some(step), scene)))
}
