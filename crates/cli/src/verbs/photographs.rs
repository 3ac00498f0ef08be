//! The photographs of a scene, enhanced at full size.

use std::path::{Path, PathBuf};

use use3d_import::Originals;
use use3d_pipeline::destination::path_text;
use use3d_pipeline::found::capture_in;
use use3d_pipeline::photographs::{
    Appearance, FileLayout, Overwrite, PhotographWork, TABLE, Totals, default_mode, scene_digest,
};
use use3d_render::Mode;
use use3d_scene::Scene;
use use3d_scene::white::Gains;

use crate::App;
use crate::args::{PhotographLayout, PhotographLook, PhotographsArgs, check_shares};
use crate::error::{Done, WorkError};
use crate::output::counted;
use crate::verbs::drawing::drawn;
use crate::verbs::photographs_film::{self, FilmJob};
use crate::verbs::white;

/// The folder of a run's photographs, beside its scene.
pub(crate) const FOLDER: &str = "photographs";

pub(crate) fn run(app: &App, args: &PhotographsArgs) -> Done {
    check_shares(&[
        ("--strength", args.strength),
        ("--water", args.water),
        ("--keep-light", args.keep_light),
    ])?;
    let capture = capture_in(&args.scene);
    let folder = app.scene_in(&args.scene)?;
    let overwrite = if args.replace.force { Overwrite::All } else { Overwrite::Nothing };
    write_all(app, args, (&folder, capture.as_deref()), overwrite)
}

/// Writes all photographs of a scene in the results of a run into `photographs` beside it.
pub(crate) fn of_run(app: &App, scene: &Path, capture: Option<&Path>) -> Done {
    let args = PhotographsArgs::of(scene, scene.parent().unwrap_or(scene).join(FOLDER));
    write_all(app, &args, (scene, capture), Overwrite::Own)
}

/// Writes all photographs of the scene in `folder`, whose capture may be known.
fn write_all(
    app: &App,
    args: &PhotographsArgs,
    (folder, capture): (&Path, Option<&Path>),
    overwrite: Overwrite,
) -> Done {
    let scene = Scene::load(folder).map_err(WorkError::input)?;
    let originals = Originals::read(folder).map_err(WorkError::input)?.ok_or_else(|| {
        WorkError::Input(format!(
            "{}: this scene does not know its photographs, because an older version made it; run it again with \
             `use3d run CAPTURE`",
            path_text(folder)
        ))
    })?;
    let mode = mode(args.look, &scene, folder)?;
    let gains = white::of(app, &args.white, folder, &scene, capture)?;
    let appearance = Appearance {
        mode,
        strength: args.strength,
        water: args.water,
        gains: gains.map_or(Gains::ONE, |white| white.gains),
        keep_light: args.keep_light,
    };
    let drawn = drawn(app, &scene, &args.engine)?;
    if let Some((film, video)) = args.film.as_deref().zip(args.video.as_deref()) {
        let capture = capture.ok_or_else(|| {
            WorkError::input(
                "the capture of this scene is not known, which says where its frames lie in the film: give \
                 the results folder of the run in place of the scene",
            )
        })?;
        let job = FilmJob { film, video, capture, replace: overwrite == Overwrite::All };
        photographs_film::write(app, &job, &drawn, &originals, &appearance)?;
    }
    let Some(out) = args.out.as_deref() else { return Ok(()) };
    let images = images(args, capture, &originals)?;
    // Other photographs of the same cameras may lie elsewhere, so only the capture's own folder is searched.
    let without_camera = match (capture, &args.images) {
        (Some(capture), None) if !args.undistorted => {
            originals.without_camera(capture).map_err(WorkError::input)?
        }
        _ => Vec::new(),
    };
    let scale = Scene::world(folder).map_err(WorkError::input)?.map(|world| world.metres_per_unit);
    let work = PhotographWork {
        scene: &drawn,
        metres: scale,
        originals: &originals,
        folder: &images,
        developed: args.images.is_some(),
        without_camera: &without_camera,
        out,
        appearance,
        layout: match args.layout {
            PhotographLayout::Same => FileLayout::Same,
            PhotographLayout::Texture => FileLayout::Texture,
        },
        undistorted: args.undistorted,
        unknown: args.unknown.as_deref(),
        settings: format!(
            "{} {appearance:?} {:?} {} {:?}",
            scene_digest(folder).map_err(WorkError::failed)?,
            args.layout,
            args.undistorted,
            args.images.as_ref().and_then(|images| images.canonicalize().ok())
        ),
        overwrite,
    };
    let mut progress = |done: usize, total: usize, name: &str| {
        app.host.progress("photographs", done as u64, total as u64, "photographs", name);
        !app.host.stops()
    };
    let mut lines = Vec::new();
    let totals = work.run(&mut progress, &mut |line| lines.push(line.to_string()));
    app.host.over("photographs");
    lines.iter().for_each(|line| remark!(app, "{line}"));
    tell(app, out, &totals?);
    Ok(())
}

/// The look as a mode of the scene.
fn mode(look: Option<PhotographLook>, scene: &Scene, folder: &Path) -> Result<Mode, WorkError> {
    match look {
        None => Ok(default_mode(scene)),
        Some(PhotographLook::Clear) => Ok(Mode::Clear),
        Some(PhotographLook::Reconstruction) => Ok(Mode::Reconstruction),
        Some(PhotographLook::Enhanced) if scene.enhancement.is_none() => Err(WorkError::Input(format!(
            "--look enhanced: {} has no enhancement; make one with `use3d enhance`",
            path_text(folder)
        ))),
        Some(PhotographLook::Enhanced) => Ok(default_mode(scene)),
    }
}

/// The folder with the files of the photographs.
fn images(
    args: &PhotographsArgs,
    capture: Option<&Path>,
    originals: &Originals,
) -> Result<PathBuf, WorkError> {
    let folder = match (&args.images, capture) {
        (Some(folder), _) => folder.clone(),
        (None, Some(capture)) => capture.join(&originals.image_folder),
        (None, None) => {
            return Err(WorkError::input(
                "the place of the original photographs is not known: give their folder with --images",
            ));
        }
    };
    if !folder.is_dir() {
        return Err(WorkError::Input(format!(
            "{}: there is no such folder; give the folder of the original photographs with --images",
            path_text(&folder)
        )));
    }
    Ok(folder)
}

fn tell(app: &App, out: &Path, totals: &Totals) {
    let Totals { written, kept, without_camera, missing } = *totals;
    remark!(
        app,
        "{}: {} written{}, {TABLE}",
        path_text(out),
        counted(written, "photograph", "photographs"),
        if kept > 0 { format!(", {kept} finished before") } else { String::new() }
    );
    if without_camera > 0 {
        remark!(
            app,
            "{} without a camera: changed by the mean of the others",
            counted(without_camera, "photograph", "photographs")
        );
    }
    if missing > 0 {
        remark!(app, "{} of the scene missing in the folder", counted(missing, "photograph", "photographs"));
    }
}
