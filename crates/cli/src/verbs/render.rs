//! Pictures and films of a scene from any cameras.

use std::collections::BTreeMap;
use std::path::Path;

use use3d_capture::{Camera, FileName};
use use3d_pipeline::Drawn;
use use3d_reconstruct::EngineChoice;
use use3d_render::{Mode, picture};
use use3d_scene::Scene;
use use3d_workflow::machine::bytes;
use use3d_workflow::{Event, place};

use crate::App;
use crate::args::{CameraPath, FrameFormat, RenderArgs};
use crate::destination::check_file;
use crate::error::{CliError, Done};
use crate::interrupt;
use crate::verbs::drawing::{cameras, film, modes, not_filmed, renderer, write};
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
