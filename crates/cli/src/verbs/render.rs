//! Pictures and films of a scene from any cameras.

use std::collections::BTreeMap;
use std::path::Path;

use use3d_capture::{Camera, FileName};
use use3d_pipeline::baked::CutOff;
use use3d_pipeline::found::capture_in;
use use3d_render::Mode;
use use3d_scene::Scene;
use use3d_scene::white::Gains;

use crate::App;
use crate::args::{CameraPath, FrameFormat, RenderArgs, check_shares};
use crate::error::{Done, WorkError};
use crate::interrupt;
use crate::verbs::drawing::{FRAME_RATE, Frames, cameras, drawn, modes, renderer, too_strong};
use crate::verbs::{film_path, speed, white};

pub(crate) fn run(app: &App, args: &RenderArgs) -> Done {
    let capture = args.cameras.clone().or_else(|| capture_in(&args.scene));
    let args = &RenderArgs { scene: app.scene_in(&args.scene)?, cameras: capture, ..args.clone() };
    let asked = modes(&args.modes)?;
    check_shares(&[("--strength", args.strength), ("--water", args.water)])?;
    let scene = Scene::load(&args.scene).map_err(WorkError::input)?;
    let modes = if asked.is_empty() { vec![Mode::opening(&scene)] } else { asked };
    let names: Vec<&str> = modes.iter().map(|mode| mode.name()).collect();
    if let (Some(mode), None) = (modes.iter().find(|mode| mode.is_enhanced()), &scene.enhancement) {
        return Err(WorkError::Input(format!(
            "--modes {}: {} has no enhancement; make one with `use3d enhance`",
            mode.name(),
            args.scene.display()
        )));
    }
    if args.water < 1.0 && !args.fps && !modes.iter().any(|mode| mode.shows_water()) {
        eprintln!("--water {} changes nothing in {}", args.water, names.join(", "));
    }
    let drawn = drawn(app, &scene, &args.engine)?;
    let white = white::of(app, &args.white, &args.scene, &scene, args.cameras.as_deref())?;
    let gains = white.map_or(Gains::ONE, |white| white.gains);
    if let Some(CameraPath::File(path)) = &args.path {
        return film_path::run(app, args, (&scene, gains), &drawn, path);
    }
    if args.fps {
        return speed::run(app, args, &scene, &drawn);
    }
    let cameras = cameras(args, &scene)?;
    let files = files(&cameras, args.format)?;
    let mut written = Frames::create(args, None, &modes, &files, FRAME_RATE)?;
    let mut renderer = renderer(args, &drawn)?.with_white(gains);
    let mut cut_off = CutOff::default();
    for (i, ((name, camera), file)) in cameras.iter().zip(&files).enumerate() {
        interrupt::check()?;
        app.host.progress("render", i as u64, cameras.len() as u64, "frames", name);
        let frames = renderer.render(camera, &modes).map_err(WorkError::failed)?;
        cut_off.add(&scene, &modes, &frames);
        written.add(file, &modes, &frames)?;
    }
    if cut_off.share().is_some() {
        remark!(app, "{}", too_strong(cut_off));
    }
    let (first, all) = (format!(" of {}", names[0]), format!(", modes {}", names.join(", ")));
    written.finish(app, cameras.len(), &first, &all)
}

/// The names of the files, one per camera.
///
/// # Errors
/// Two cameras whose pictures would be one file.
fn files(cameras: &[(FileName, Camera)], format: FrameFormat) -> Result<Vec<FileName>, WorkError> {
    let mut taken = BTreeMap::new();
    let mut name = |(camera, _): &(FileName, Camera)| {
        let file = camera.with_extension(format.extension()).map_err(WorkError::input)?;
        if let Some(first) = taken.insert(file.clone(), camera.clone()) {
            return Err(WorkError::Input(format!(
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
            return Err(WorkError::Input(format!(
                "--cameras: {} would be written as {}, which {file} needs as a folder; rename one of them",
                first.1, first.0
            )));
        }
    }
    Ok(files)
}
