//! The parts that every verb for pictures shares: cameras, modes, the renderer, and the written files.

use std::path::Path;

use use3d_capture::{Camera, FileName, path, stem};
use use3d_import::read_cameras;
use use3d_io_image::{write_exr, write_exr_map, write_png, write_png_map};
use use3d_pipeline::Drawn;
use use3d_render::{Film, FilmError, Mode, Rendering, SceneRenderer, cover, focus, picture};
use use3d_scene::{Origin, Scene};
use use3d_workflow::error::nearest;
use use3d_workflow::place;

use crate::args::{CameraPath, FrameFormat, RenderArgs};
use crate::error::{CliError, Done};
use crate::size::parse_size;

/// The modes of these names.
pub(crate) fn modes(names: &[String]) -> Result<Vec<Mode>, CliError> {
    let known = Mode::ALL.map(Mode::name);
    let find = |name: &String| {
        let name = name.trim();
        let near =
            || nearest(name, known).map_or_else(String::new, |near| format!("did you mean `{near}`? "));
        let refused = || format!("--modes {name}: {}expected some of {}", near(), known.join(", "));
        Mode::from_name(name).ok_or_else(|| CliError::Input(refused()))
    };
    names.iter().map(find).collect()
}

/// The renderer with the requested strength and share of the water.
pub(crate) fn renderer<'s>(args: &RenderArgs, drawn: &Drawn<'s>) -> Result<SceneRenderer<'s>, CliError> {
    let renderer = drawn.renderer(args.strength).map_err(CliError::input)?;
    renderer.with_water(args.water).map_err(CliError::input)
}

/// The requested cameras, in the scene's frame.
pub(crate) fn cameras(args: &RenderArgs, scene: &Scene) -> Result<Vec<(FileName, Camera)>, CliError> {
    let from = args.cameras.as_deref().ok_or_else(|| {
        let what = "give the cameras to render: --cameras with a capture, a COLMAP model or a list of \
             cameras, or --path FILE";
        CliError::Input(what.into())
    })?;
    let mut cameras = read_cameras(from).map_err(CliError::input)?;
    for (_, camera) in &mut cameras {
        camera.pose = scene.frame.apply_pose(&camera.pose);
    }
    let origin = Origin::read(&args.scene).map_err(CliError::input)?;
    if let Some(origin) = origin.as_ref().filter(|_| from.is_dir()) {
        let known = |(name, _): &(FileName, Camera)| {
            let stem = stem(name);
            origin.train.iter().chain(&origin.held_out).any(|s| s == stem)
        };
        if !cameras.iter().any(known) {
            eprintln!(
                "warning: no camera of {} is a view that {} was made from: it may be another capture",
                from.display(),
                args.scene.display()
            );
        }
    }
    if args.held_out {
        match &origin {
            Some(origin) => cameras.retain(|(name, _)| origin.held_out.iter().any(|s| s == stem(name))),
            None => {
                let split = use3d_import::import(from, &use3d_import::ImportParams::default());
                let held_out = split.map_err(CliError::input)?.report.test;
                cameras.retain(|(name, _)| held_out.iter().any(|held| name == held));
            }
        }
    }
    if cameras.is_empty() {
        return Err(CliError::Input(format!("--cameras {}: no cameras to render from", from.display())));
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
        Some(CameraPath::Spiral) => {
            let focus = keys.first().map_or(1.0, |camera| focus(scene, camera));
            path::spiral(&keys, args.frames, 0.12 * focus, focus)
        }
    };
    Ok(film.into_iter().enumerate().map(|(i, camera)| (FileName::frame(i), camera)).collect())
}

/// The names of the held-out views of a capture with default parameters; empty if the folder is not a
/// capture.
pub(crate) fn held_out(capture: &Path) -> Vec<String> {
    use3d_import::import(capture, &use3d_import::ImportParams::default())
        .map_or_else(|_| Vec::new(), |imported| imported.report.test)
}

/// A film at a path, as named by `--video`.
pub(crate) fn film(path: &Path, frame_rate: u32) -> Result<(&Path, Film), CliError> {
    let film = Film::create(path, place::sibling(path), frame_rate).map_err(|e| not_filmed(path, &e))?;
    Ok((path, film))
}

/// The error of a film that cannot be written.
pub(crate) fn not_filmed(path: &Path, error: &FilmError) -> CliError {
    let message = format!("--video {}: {error}", path.display());
    if error.is_of_the_request() { CliError::Input(message) } else { CliError::Failed(message) }
}

/// Writes a frame as FOLDER/FILE.
pub(crate) fn write(
    folder: &Path,
    mode: Mode,
    file: &FileName,
    frame: &Rendering,
    format: FrameFormat,
) -> Done {
    let path = file.below(folder);
    if let Some(parent) = path.parent() {
        std::fs::create_dir_all(parent)
            .map_err(|e| CliError::Failed(format!("--out {}: {e}", parent.display())))?;
    }
    let channel = if mode == Mode::Alpha { "A" } else { "Z" };
    let written = match (format, frame) {
        (FrameFormat::Exr, Rendering::Color(image)) => write_exr(&path, image),
        (FrameFormat::Exr, Rendering::Scalar(map)) => write_exr_map(&path, map, channel),
        (FrameFormat::Png, Rendering::Scalar(map)) if mode == Mode::Alpha => write_png_map(&path, map),
        (FrameFormat::Png, frame) => write_png(&path, &picture(mode, frame)),
    };
    written.map_err(CliError::failed)
}
