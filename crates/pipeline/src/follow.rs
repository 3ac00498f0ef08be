//! Follows a training through its files: its checkpoints while it runs, its scene when it is done. The
//! training process is not contacted, so it needs no port, and may run on another machine that writes to the
//! same disk.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use use3d_capture::Frame;
use use3d_import::{ImportParams, Imported, import, load_prepared};
use use3d_reconstruct::scene_in_checkpoint;
use use3d_scene::Scene;
use use3d_web::PageView;

use crate::WorkError;
use crate::destination::{checkpoints_in, entries, path_text, work_of};
use crate::loaded::{Loaded, PipelineRequest};
use crate::scene_views::{held_out_first, scene_name};

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

/// A state of a training that was not seen before.
pub struct TrainingNews {
    /// The step of a checkpoint; `None` for the finished scene.
    pub step: Option<u64>,
    /// The scene.
    pub scene: Scene,
    /// The camera positions of its capture, held-out ones first.
    pub views: Arc<Vec<PageView>>,
}

/// Reads the states of a training as they appear.
pub struct Follower {
    followed: Followed,
    capture: Option<Imported>,
    seen: Option<Newest>,
    /// The camera positions, with the import and the frame that they belong to.
    places: Option<(Option<PathBuf>, Frame, Arc<Vec<PageView>>)>,
}

impl Follower {
    /// The training that the target of a request names: a pipeline file or capture in work, the result of
    /// `use3d reconstruct`, or checkpoints. `scene` chooses one of a pipeline; the photographs are those of
    /// `capture` if the training does not name its own.
    ///
    /// # Errors
    /// There is no such training, pipeline, scene or capture.
    pub fn find(
        request: &PipelineRequest,
        scene: Option<&str>,
        capture: Option<&Path>,
    ) -> Result<Self, WorkError> {
        let followed = followed(request, scene)?;
        let capture = capture.map(|path| import(path, &ImportParams::default())).transpose();
        Ok(Self { followed, capture: capture.map_err(WorkError::input)?, seen: None, places: None })
    }

    /// The name of the scene.
    pub fn name(&self) -> String {
        match &self.followed {
            Followed::Pipeline { scene, .. } => scene.clone(),
            Followed::Scene { folder: path, .. } | Followed::Checkpoints(path) => scene_name(path),
        }
    }

    /// The file that it waits for, in words; `None` if there is one already.
    pub fn wanted(&self) -> Option<String> {
        match (self.newest(), &self.followed) {
            (Some(_), _) => None,
            (None, Followed::Scene { folder, .. }) => {
                Some(format!("a training whose --out is {}", path_text(folder)))
            }
            (None, Followed::Checkpoints(path)) => Some(format!("a checkpoint in {}", path_text(path))),
            (None, Followed::Pipeline { scene, .. }) => Some(format!("the training of {scene}")),
        }
    }

    /// A good time between two looks; the plan of a pipeline reads more files.
    pub fn interval(&self) -> Duration {
        Duration::from_secs(if matches!(self.followed, Followed::Pipeline { .. }) { 10 } else { 3 })
    }

    /// The newest state; `None` if it was seen before.
    ///
    /// # Errors
    /// [`WorkError::Failed`] if a file is damaged: the next one may be whole. Other errors end the work.
    pub fn look(&mut self) -> Result<Option<TrainingNews>, WorkError> {
        let Some(newest) = self.newest().filter(|newest| self.seen.as_ref() != Some(newest)) else {
            return Ok(None);
        };
        let own = newest.import.as_deref().and_then(|folder| load_prepared(folder).ok());
        let capture = own.as_ref().or(self.capture.as_ref());
        let found = read(&newest.file, capture);
        // Without a state, the training has removed the file and has a later one by now.
        if matches!(found, Ok(None)) {
            return Ok(None);
        }
        self.seen = Some(newest.clone());
        let Some((step, scene)) = found? else { return Ok(None) };
        let places = self.places.take();
        let known = places.filter(|(of, frame, _)| *of == newest.import && *frame == scene.frame);
        let places = match known {
            Some(known) => known,
            None => {
                let views = capture.map_or_else(|| Ok(Vec::new()), |capture| held_out_first(&scene, capture));
                (newest.import, scene.frame, Arc::new(views.map_err(WorkError::input)?))
            }
        };
        let views = self.places.insert(places).2.clone();
        Ok(Some(TrainingNews { step, scene, views }))
    }

    fn newest(&self) -> Option<Newest> {
        let of = |file: PathBuf, import: Option<PathBuf>| Newest { modified: modified(&file), file, import };
        match &self.followed {
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
}

/// Finds what a path names.
fn followed(request: &PipelineRequest, wanted: Option<&str>) -> Result<Followed, WorkError> {
    let target = request.target.as_path();
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
    let loaded = request.open()?;
    let plan = loaded.builder.plan(&loaded.graph, None);
    let mut scenes =
        plan.nodes.iter().filter(|node| node.stage == "reconstruct").map(|node| node.scene.clone());
    let scene = match wanted {
        Some(wanted) => scenes.find(|scene| scene == wanted),
        None => scenes.next(),
    };
    let Some(scene) = scene else {
        let wanted = wanted.unwrap_or("any");
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

/// Reads the scene from a file: `scene.json` stands for its folder.
fn read(file: &Path, capture: Option<&Imported>) -> Result<Option<(Option<u64>, Scene)>, WorkError> {
    if let Some(folder) = file.parent().filter(|_| file.file_name().is_some_and(|name| name == "scene.json"))
    {
        return Scene::load(folder).map(|scene| Some((None, scene))).map_err(WorkError::failed);
    }
    let frame = capture.map_or(Frame::IDENTITY, |imported| imported.capture.frame);
    let found = scene_in_checkpoint(file, frame).map_err(WorkError::failed)?;
    Ok(found.map(|(step, scene)| (Some(step), scene)))
}
