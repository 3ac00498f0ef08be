//! Draws a camera path file exactly: every frame has the look that the path's keys set.

use std::path::Path;

use use3d_capture::FileName;
use use3d_import::read_images_txt;
use use3d_pipeline::baked::CutOff;
use use3d_pipeline::destination::path_text;
use use3d_pipeline::scene_views::text_of;
use use3d_render::{Mode, SceneRenderer};
use use3d_scene::Scene;
use use3d_scene::white::Gains;
use use3d_stages::Drawn;
use use3d_web::path::CameraPath;

use crate::App;
use crate::args::RenderArgs;
use crate::error::{Done, WorkError};
use crate::interrupt;
use crate::size::parse_size;
use crate::verbs::drawing::{FRAME_RATE, Frames, modes, too_strong};

/// The folder for frames with the path's own looks.
const OWN: &str = "path";
/// The default size of pictures: a path has no size in pixels.
const SIZE: (usize, usize) = (1280, 720);

/// Reads a path file of any supported program.
fn read(app: &App, args: &RenderArgs, file: &Path) -> Result<CameraPath, WorkError> {
    if file.extension().is_some_and(|e| e.eq_ignore_ascii_case("txt")) {
        let cameras = read_images_txt(file).map_err(WorkError::input)?;
        let rate = args.frame_rate.map_or(FRAME_RATE, f64::from);
        return CameraPath::of_cameras(&cameras, rate).map_err(WorkError::input);
    }
    let text = text_of(file)?;
    if !CameraPath::is_nerfstudio(&text) {
        return CameraPath::read(&text).map_err(WorkError::input);
    }
    let beside = file.with_file_name("dataparser_transforms.json");
    let dataparser = match std::fs::read_to_string(&beside) {
        Ok(text) => Some(text),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => None,
        Err(error) => return Err(WorkError::Input(format!("{}: {error}", beside.display()))),
    };
    if dataparser.is_none() {
        remark!(
            app,
            "{}: no dataparser_transforms.json beside it, so its positions are read in the frame of the \
             COLMAP model; if they are in nerfstudio's frame, copy that file of the nerfstudio model there",
            path_text(file)
        );
    }
    CameraPath::read_nerfstudio(&text, dataparser.as_deref()).map_err(WorkError::input)
}

/// `use3d render SCENE --path FILE`.
pub(crate) fn run(
    app: &App,
    args: &RenderArgs,
    (scene, gains): (&Scene, Gains),
    drawn: &Drawn<'_>,
    file: &Path,
) -> Done {
    let wrong = |what: &str| WorkError::Input(format!("--path {}: {what}", path_text(file)));
    let path = read(app, args, file).map_err(|what| {
        wrong(&format!(
            "{what}; expected a camera path as the page saves it, nerfstudio's camera_path.json or COLMAP's images.txt (docs/reference/outputs.md)"
        ))
    })?;
    let (width, height) = args.size.as_deref().map(parse_size).transpose()?.unwrap_or(SIZE);
    let given = modes(&args.modes)?;
    let frames = path.frames(width, height);
    // The looks of the path's keys, or the requested modes instead; known before anything is drawn.
    let mut looks: Vec<Vec<Mode>> = Vec::with_capacity(frames.len());
    for frame in &frames {
        let own = Mode::from_name(frame.mode).ok_or_else(|| {
            let known = Mode::ALL.map(Mode::name).join(", ");
            wrong(&format!("unknown mode `{}`; expected one of {known}", frame.mode))
        })?;
        let shown = if given.is_empty() { vec![own] } else { given.clone() };
        if shown.iter().any(|mode| mode.is_enhanced()) && scene.enhancement.is_none() {
            return Err(wrong(
                "its keys show the enhancement, but the scene has none; give other --modes, or make one \
                 with `use3d enhance`",
            ));
        }
        looks.push(shown);
    }
    let name = |i| FileName::frame(i).with_extension(args.format.extension()).map_err(WorkError::input);
    let names: Vec<FileName> = (0..frames.len()).map(name).collect::<Result<_, _>>()?;
    let first = looks.first().map_or(&[][..], Vec::as_slice);
    let folder = given.is_empty().then_some(OWN);
    let mut written = Frames::create(args, folder, first, &names, path.frames_per_second)?;
    let mut renderer: Option<((f32, f32), SceneRenderer<'_>)> = None;
    let mut cut_off = CutOff::default();
    for (i, ((frame, looks), name)) in frames.iter().zip(&looks).zip(&names).enumerate() {
        interrupt::check()?;
        app.host.progress("render", i as u64, frames.len() as u64, "frames", name);
        // A renderer has one strength and one share of the water: a new one is made only when they change.
        let look = (frame.strength, frame.water);
        let ready = renderer.take().filter(|(made, _)| *made == look);
        let (_, drawing) = match ready {
            Some(ready) => renderer.insert(ready),
            None => {
                let made = drawn.renderer(look.0).and_then(|r| r.with_water(look.1));
                renderer.insert((look, made.map_err(WorkError::input)?.with_white(gains)))
            }
        };
        let mut camera = frame.camera;
        camera.pose = scene.frame.apply_pose(&camera.pose);
        let pictures = drawing.render(&camera, looks).map_err(WorkError::failed)?;
        cut_off.add(scene, looks, &pictures);
        written.add(name, looks, &pictures)?;
    }
    if cut_off.share().is_some() {
        remark!(app, "{}", too_strong(cut_off));
    }
    written.finish(app, frames.len(), "", &format!(" of {width}x{height}"))
}
