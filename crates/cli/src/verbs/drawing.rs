//! The parts that every verb for pictures shares: cameras, modes, the renderer, and the written files.

use std::path::Path;

use use3d_capture::{Camera, FileName, path, stem};
use use3d_io_image::{write_exr, write_exr_map, write_png, write_png_map};
use use3d_pipeline::baked::CutOff;
use use3d_pipeline::destination::{check_file, path_text};
use use3d_pipeline::scene_views::{any_known, held_out, placed};
use use3d_reconstruct::EngineChoice;
use use3d_render::{Film, FilmError, Mode, Rendering, SceneRenderer, cover, focus, picture};
use use3d_scene::{Origin, Scene};
use use3d_stages::Drawn;
use use3d_workflow::error::nearest;
use use3d_workflow::machine::bytes;
use use3d_workflow::place;

use crate::App;
use crate::args::{CameraPath, EngineArgs, FrameFormat, RenderArgs};
use crate::error::{Done, WorkError};
use crate::size::parse_size;

/// The doubt about `enhanced-clear`, whose colours are too strong in most scenes.
pub(crate) fn too_strong(cut_off: CutOff) -> String {
    let share = cut_off.share().map_or_else(String::new, |share| {
        format!("; {:.1} % of its colour values are brighter than white and cut off", 100.0 * share)
    });
    format!(
        "warning: enhanced-clear is for experts: its colours were learnt through water and are too strong without it, so \
         far things become red{share}; `enhanced` is the look for showing"
    )
}

/// Frames per second of a film of cameras that have no rate of their own.
pub(crate) const FRAME_RATE: f64 = 30.0;

/// The modes of these names.
pub(crate) fn modes(names: &[String]) -> Result<Vec<Mode>, WorkError> {
    let known = Mode::ALL.map(Mode::name);
    let find = |name: &String| {
        let name = name.trim();
        let near =
            || nearest(name, known).map_or_else(String::new, |near| format!("did you mean `{near}`? "));
        let refused = || format!("--modes {name}: {}expected some of {}", near(), known.join(", "));
        Mode::from_name(name).ok_or_else(|| WorkError::Input(refused()))
    };
    names.iter().map(find).collect()
}

/// A scene on the requested engine, which is remarked if it is not the processor.
pub(crate) fn drawn<'s>(app: &App, scene: &'s Scene, engine: &EngineArgs) -> Result<Drawn<'s>, WorkError> {
    let engine = engine.choice().unwrap_or_default();
    let drawn =
        Drawn::new(scene, &engine).map_err(|what| WorkError::Input(format!("--engine {engine}: {what}")))?;
    if engine != EngineChoice::Cpu {
        remark!(app, "engine: {}", drawn.told);
    }
    Ok(drawn)
}

/// The renderer with the requested strength and share of the water.
pub(crate) fn renderer<'s>(args: &RenderArgs, drawn: &Drawn<'s>) -> Result<SceneRenderer<'s>, WorkError> {
    let renderer = drawn.renderer(args.strength).map_err(WorkError::input)?;
    renderer.with_water(args.water).map_err(WorkError::input)
}

/// The requested cameras, in the scene's frame.
pub(crate) fn cameras(args: &RenderArgs, scene: &Scene) -> Result<Vec<(FileName, Camera)>, WorkError> {
    let Some(from) = args.cameras.as_deref() else {
        return Err(WorkError::input(
            "give the cameras to render: --cameras with a capture, a COLMAP model or a list of cameras, or \
             --path FILE",
        ));
    };
    let mut cameras = placed(from, &scene.frame)?;
    let origin = Origin::read(&args.scene).map_err(WorkError::input)?;
    if from.is_dir() && origin.as_ref().is_some_and(|origin| !any_known(origin, &cameras)) {
        eprintln!(
            "warning: no camera of {} is a view that {} was made from: it may be another capture",
            from.display(),
            args.scene.display()
        );
    }
    let all = cameras.len();
    if args.held_out {
        match &origin {
            Some(origin) => cameras.retain(|(name, _)| origin.held_out.iter().any(|s| s == stem(name))),
            None => {
                let held_out = held_out(from)?;
                cameras.retain(|(name, _)| held_out.iter().any(|held| name == held));
            }
        }
    }
    if cameras.is_empty() && all > 0 {
        return Err(WorkError::Input(format!(
            "--cameras {}: none of its {all} cameras is a held-out view of the scene; leave out --held-out, or give the \
             capture that the scene was made from",
            from.display()
        )));
    }
    if cameras.is_empty() {
        return Err(WorkError::Input(format!("--cameras {}: no cameras to render from", from.display())));
    }
    if let Some(size) = &args.size {
        let (width, height) = parse_size(size)?;
        for (_, camera) in &mut cameras {
            camera.intrinsics = cover(&camera.intrinsics, width, height);
        }
    }
    let keys: Vec<Camera> = cameras.iter().map(|(_, camera)| *camera).collect();
    let film = match &args.path {
        None | Some(CameraPath::File(_)) => return Ok(cameras),
        Some(CameraPath::Interpolate) => path::interpolate(&keys, args.frames),
        Some(CameraPath::Spiral) => path::middle(&keys).map_or_else(Vec::new, |camera| {
            let focus = focus(scene, camera);
            path::spiral(camera, args.frames, 0.12 * focus, focus)
        }),
    };
    Ok(film.into_iter().enumerate().map(|(i, camera)| (FileName::frame(i), camera)).collect())
}

/// The frames that are written: pictures in folders, and the first mode as a film.
pub(crate) struct Frames<'a> {
    args: &'a RenderArgs,
    /// The folder of all pictures; `None` if each mode has a folder of its own.
    folder: Option<&'static str>,
    film: Option<(&'a Path, Film)>,
}

impl<'a> Frames<'a> {
    /// Fails, before anything is drawn, if an existing file would be overwritten. `rate` is the path's own
    /// number of frames per second, which `--frame-rate` replaces.
    pub(crate) fn create(
        args: &'a RenderArgs,
        folder: Option<&'static str>,
        modes: &[Mode],
        files: &[FileName],
        rate: f64,
    ) -> Result<Self, WorkError> {
        let force = args.replace.force;
        if let Some(video) = &args.video {
            check_file("--video", video, force, &[])?;
        }
        if let Some(out) = &args.out {
            place::check_writable(out)?;
            let folders = modes.iter().map(|mode| out.join(folder.unwrap_or(mode.name())));
            // Only an existing folder can hold pictures.
            for folder in folders.filter(|folder| folder.exists()) {
                files.iter().try_for_each(|file| check_file("--out", &file.below(&folder), force, &[]))?;
            }
        }
        let film = args.video.as_deref().map(|path| {
            let film = Film::create(path, place::sibling(path), args.frame_rate.map_or(rate, f64::from));
            film.map(|film| (path, film)).map_err(|e| not_filmed(path, &e))
        });
        Ok(Self { args, folder, film: film.transpose()? })
    }

    /// Writes the pictures of one camera.
    pub(crate) fn add(&mut self, file: &FileName, modes: &[Mode], frames: &[Rendering]) -> Done {
        if let (Some((path, film)), Some(mode), Some(frame)) = (&mut self.film, modes.first(), frames.first())
        {
            film.push(&picture(*mode, frame).to_8bit()).map_err(|e| not_filmed(path, &e))?;
        }
        if let Some(out) = &self.args.out {
            for (mode, frame) in modes.iter().zip(frames) {
                write(&out.join(self.folder.unwrap_or(mode.name())), *mode, file, frame, self.args.format)?;
            }
        }
        Ok(())
    }

    /// Ends the film, and names the written files; the words about film and folder follow their numbers of
    /// frames.
    pub(crate) fn finish(self, app: &App, count: usize, of_film: &str, of_folder: &str) -> Done {
        app.host.over("render");
        if let Some((path, film)) = self.film {
            film.finish().map_err(|e| not_filmed(path, &e))?;
            let size = std::fs::metadata(path).map_or(0, |m| m.len());
            remark!(app, "{}: {count} frames{of_film}, {}", path_text(path), bytes(size));
        }
        if let Some(out) = &self.args.out {
            remark!(app, "{}: {count} frames{of_folder}", path_text(out));
        }
        Ok(())
    }
}

/// The error of a film that cannot be written.
fn not_filmed(path: &Path, error: &FilmError) -> WorkError {
    let message = format!("--video {}: {error}", path.display());
    if error.is_of_the_request() { WorkError::Input(message) } else { WorkError::Failed(message) }
}

/// Writes a frame as FOLDER/FILE.
fn write(folder: &Path, mode: Mode, file: &FileName, frame: &Rendering, format: FrameFormat) -> Done {
    let path = file.below(folder);
    if let Some(parent) = path.parent() {
        std::fs::create_dir_all(parent)
            .map_err(|e| WorkError::Failed(format!("--out {}: {e}", parent.display())))?;
    }
    let channel = if mode == Mode::Alpha { "A" } else { "Z" };
    let written = match (format, frame) {
        (FrameFormat::Exr, Rendering::Color(image)) => write_exr(&path, image),
        (FrameFormat::Exr, Rendering::Scalar(map)) => write_exr_map(&path, map, channel),
        (FrameFormat::Png, Rendering::Scalar(map)) if mode == Mode::Alpha => write_png_map(&path, map),
        (FrameFormat::Png, frame) => write_png(&path, &picture(mode, frame)),
    };
    written.map_err(WorkError::failed)
}
