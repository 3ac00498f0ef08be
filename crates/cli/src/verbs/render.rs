//! Pictures and films of a scene from any cameras.

use std::collections::BTreeMap;
use std::path::Path;

use use3d_build::error::nearest;
use use3d_build::machine::bytes;
use use3d_build::{Event, place};
use use3d_capture::{Camera, FileName, path, stem};
use use3d_import::read_cameras;
use use3d_io_image::{write_exr, write_exr_map, write_png, write_png_map};
use use3d_pipeline::Drawn;
use use3d_reconstruct::EngineChoice;
use use3d_render::{Film, FilmError, Mode, Rendering, SceneRenderer, cover, focus, picture};
use use3d_scene::{Origin, Scene};

use crate::App;
use crate::args::{CameraPath, FrameFormat, RenderArgs};
use crate::destination::check_file;
use crate::error::{CliError, Done};
use crate::interrupt;
use crate::size::parse_size;
use crate::verbs::found::{capture_in, scene_in};

pub(crate) fn run(app: &App, args: &RenderArgs) -> Done {
    let capture = args.cameras.clone().or_else(|| capture_in(&args.scene));
    let args = &RenderArgs { scene: scene_in(app, &args.scene)?, cameras: capture, ..args.clone() };
    let asked = modes(&args.modes)?;
    for (flag, value) in [("--strength", args.strength), ("--water", args.water)] {
        if !(0.0..=1.0).contains(&value) {
            return Err(CliError::Input(format!("{flag} {value}: expected 0 to 1")));
        }
    }
    let scene = Scene::load(&args.scene).map_err(CliError::input)?;
    let modes = if asked.is_empty() { vec![Mode::opening(&scene)] } else { asked };
    let names: Vec<&str> = modes.iter().map(|mode| mode.name()).collect();
    if let (Some(mode), None) = (modes.iter().find(|mode| mode.is_enhanced()), &scene.enhancement) {
        return Err(CliError::Input(format!(
            "--modes {}: {} has no enhancement; make one with `use3d enhance`",
            mode.name(),
            args.scene.display()
        )));
    }
    if args.water < 1.0 && !args.fps && !modes.iter().any(|mode| mode.shows_water()) {
        eprintln!("--water {} changes nothing in {}", args.water, names.join(", "));
    }
    let engine = args.engine.choice().unwrap_or_default();
    let drawn =
        Drawn::new(&scene, &engine).map_err(|what| CliError::Input(format!("--engine {engine}: {what}")))?;
    if engine != EngineChoice::Cpu && !app.quiet {
        eprintln!("engine: {}", drawn.told());
    }
    let white = super::white::of(app, &args.white, &args.scene, &scene, args.cameras.as_deref())?;
    let gains = super::white::gains(white.as_ref());
    if let Some(CameraPath::File(path)) = &args.path {
        return super::film_path::run(app, args, (&scene, gains), &drawn, path);
    }
    if args.fps {
        return super::speed::run(app, args, &scene, &drawn);
    }
    let cameras = cameras(args, &scene)?;
    let files = files(&cameras, args.format)?;
    check_places(args, &modes, &files)?;
    let mut renderer = renderer(args, &drawn)?.with_white(gains);
    let mut film = args.video.as_deref().map(|path| film(path, args.frame_rate)).transpose()?;
    let total = cameras.len() as u64;
    for (i, ((name, camera), file)) in cameras.iter().zip(&files).enumerate() {
        interrupt::check()?;
        let label = "render";
        app.listener.event(&Event::Progress {
            node: 0,
            label,
            done: i as u64,
            total,
            unit: "frames",
            message: name,
            seconds_left: None,
        });
        let frames = renderer.render(camera, &modes).map_err(CliError::failed)?;
        if let (Some((path, film)), Some(frame), Some(mode)) = (&mut film, frames.first(), modes.first()) {
            film.push(&picture(*mode, frame).to_8bit()).map_err(|e| not_filmed(path, &e))?;
        }
        if let Some(out) = &args.out {
            for (mode, frame) in modes.iter().zip(&frames) {
                write(&out.join(mode.name()), *mode, file, frame, args.format)?;
            }
        }
    }
    app.listener.event(&Event::Done { node: 0, label: "render", cached: true, seconds: 0.0 });
    if let Some((path, film)) = film {
        film.finish().map_err(|e| not_filmed(path, &e))?;
        if !app.quiet {
            let size = std::fs::metadata(path).map_or(0, |m| m.len());
            eprintln!("{}: {total} frames of {}, {}", path.display(), names[0], bytes(size));
        }
    }
    if let Some(out) = args.out.as_ref().filter(|_| !app.quiet) {
        eprintln!("{}: {total} frames, modes {}", out.display(), names.join(", "));
    }
    Ok(())
}

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

/// The names of the files, one per camera.
///
/// # Errors
/// Two cameras whose pictures would be one file.
fn files(cameras: &[(FileName, Camera)], format: FrameFormat) -> Result<Vec<FileName>, CliError> {
    let extension = match format {
        FrameFormat::Png => "png",
        FrameFormat::Exr => "exr",
    };
    let mut taken = BTreeMap::new();
    let mut name = |(camera, _): &(FileName, Camera)| {
        let file = camera.with_extension(extension).map_err(CliError::input)?;
        if let Some(first) = taken.insert(file.clone(), camera.clone()) {
            return Err(CliError::Input(format!(
                "--cameras: {first} and {camera} would both be written as {file}; rename one of them"
            )));
        }
        Ok(file)
    };
    let files: Vec<FileName> = cameras.iter().map(&mut name).collect::<Result<_, _>>()?;
    // A picture cannot be the folder of another one.
    for file in &files {
        let folders = Path::new(file.as_str()).ancestors().skip(1);
        if let Some(first) =
            folders.filter_map(Path::to_str).find_map(|f| taken.iter().find(|(t, _)| t.as_str() == f))
        {
            return Err(CliError::Input(format!(
                "--cameras: {} would be written as {}, which {file} needs as a folder; rename one of them",
                first.1, first.0
            )));
        }
    }
    Ok(files)
}

/// Fails, before anything is drawn, if an existing file would be overwritten.
fn check_places(args: &RenderArgs, modes: &[Mode], files: &[FileName]) -> Done {
    let force = args.replace.force;
    if let Some(video) = &args.video {
        check_file("--video", video, force, &[])?;
    }
    let Some(out) = &args.out else { return Ok(()) };
    place::check_writable(out)?;
    for mode in modes {
        let folder = out.join(mode.name());
        // Only an existing folder can hold pictures.
        if folder.exists() {
            files.iter().try_for_each(|file| check_file("--out", &file.below(&folder), force, &[]))?;
        }
    }
    Ok(())
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
