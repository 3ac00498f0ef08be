//! The cameras and views of a capture, as the pages and pictures of a scene use them.

use std::path::Path;

use use3d_capture::{Camera, FileName, Frame};
use use3d_import::{ImportError, ImportParams, Imported, capture_name, import, read_cameras};
use use3d_scene::{Origin, Scene};
use use3d_web::{PageView, SavedViews};

use crate::WorkError;
use crate::destination::{absolute, path_text};
use crate::scene_page::{self, ScenePageError, is_held_out};

/// The name for a scene folder: `reef/enhanced-scene` has the name `reef`.
pub fn scene_name(folder: &Path) -> String {
    let place = absolute(folder);
    match capture_name(&place).as_str() {
        "scene" | "enhanced-scene" => place.parent().map_or_else(|| capture_name(&place), capture_name),
        own => own.to_string(),
    }
}

/// The cameras of a capture, a model or a list, in the frame of a scene.
///
/// # Errors
/// They cannot be read.
pub fn placed(cameras: &Path, frame: &Frame) -> Result<Vec<(FileName, Camera)>, WorkError> {
    let mut placed = read_cameras(cameras).map_err(WorkError::input)?;
    placed.iter_mut().for_each(|(_, camera)| camera.pose = frame.apply_pose(&camera.pose));
    Ok(placed)
}

/// True if a scene was made from one of these views.
pub fn any_known(origin: &Origin, cameras: &[(FileName, Camera)]) -> bool {
    let known = |stem: &str| origin.train.iter().chain(&origin.held_out).any(|own| own == stem);
    cameras.iter().any(|(name, _)| known(name.stem()))
}

/// The camera positions of an imported capture, held-out ones first: they show best how good a scene is.
///
/// # Errors
/// A photograph cannot be read.
pub fn held_out_first(scene: &Scene, imported: &Imported) -> Result<Vec<PageView>, ScenePageError> {
    let origin = Origin::of(&imported.capture);
    let mut views = scene_page::views(scene, Some(&origin), imported)?;
    views.sort_by_key(|view| !view.held_out);
    Ok(views)
}

/// The names of the held-out views of a capture with default parameters.
///
/// # Errors
/// The capture cannot be imported.
pub fn held_out(capture: &Path) -> Result<Vec<String>, WorkError> {
    Ok(import(capture, &ImportParams::default()).map_err(WorkError::input)?.report.test)
}

/// The metres in one unit of a scene's model: those given, those saved with its views, or those of its world.
///
/// # Errors
/// The file of the scene's world is damaged.
pub fn metres(
    given: Option<f64>,
    saved: Option<&SavedViews>,
    scene: &Path,
) -> Result<Option<f64>, WorkError> {
    match given.or_else(|| saved?.metres_per_unit) {
        Some(metres) => Ok(Some(metres)),
        None => Ok(Scene::world(scene).map_err(WorkError::input)?.map(|world| world.metres_per_unit)),
    }
}

/// The views that were saved from a page, if a file of them is named.
///
/// # Errors
/// The file cannot be read, or is none of a page.
pub fn saved_views(file: Option<&Path>) -> Result<Option<SavedViews>, WorkError> {
    let Some(file) = file else { return Ok(None) };
    let wrong = |what: String| WorkError::Input(format!("--views {}: {what}", path_text(file)));
    let next = "expected a file that the page saved with \"Save file\" below its views \
         (docs/reference/outputs.md)";
    let text = text_of(file).map_err(|what| wrong(format!("{what}; {next}")))?;
    SavedViews::read(&text).map(Some).map_err(|what| wrong(format!("{what}; {next}")))
}

/// The text of a file that a page wrote.
///
/// # Errors
/// The reason why it cannot be read, without the file's name.
pub fn text_of(file: &Path) -> Result<String, WorkError> {
    if file.is_dir() {
        return Err(WorkError::input("it is a folder, not a file"));
    }
    let bytes = std::fs::read(file).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => WorkError::input("there is no such file"),
        _ => WorkError::Input(format!("it cannot be read: {error}")),
    })?;
    String::from_utf8(bytes).map_err(|_| WorkError::input("it is not UTF-8 text"))
}

/// Returns true if a scene's frame is the one in which a capture is imported, or COLMAP's own
/// (`normalise = false`).
fn same_place(scene: &Frame, capture: &Frame) -> bool {
    // Much larger than rounding, much smaller than the difference to another model.
    const ALIKE: f64 = 0.01;
    let alike = |other: &Frame| {
        (scene.scale / other.scale - 1.0).abs() < ALIKE
            && (scene.rotation - other.rotation).to_cols_array().iter().all(|v| v.abs() < ALIKE)
            && (scene.translation - other.translation).abs().max_element() < ALIKE
    };
    alike(capture) || alike(&Frame::IDENTITY)
}

/// The camera positions of a capture with its photographs; for other sources of cameras, the positions alone.
/// `scene` is the scene in `folder`. The answer is true if the photographs show the distortion of their lens.
///
/// # Errors
/// The capture cannot be read, or is of another place: it has none of the photographs from which the scene
/// was made, or another model of them.
pub fn page_views(
    cameras: Option<&Path>,
    folder: &Path,
    scene: &Scene,
) -> Result<(Vec<PageView>, bool), WorkError> {
    let Some(cameras) = cameras else { return Ok((Vec::new(), false)) };
    let origin = Origin::read(folder).map_err(WorkError::input)?;
    let placed = placed(cameras, &scene.frame)?;
    if let Some(origin) = origin.as_ref().filter(|origin| cameras.is_dir() && !any_known(origin, &placed)) {
        let example = origin.train.first().map(|stem| format!(" (`{stem}` is one of them)"));
        return Err(WorkError::Input(format!(
            "--cameras {}: it has none of the photographs that {} was made from{}; give the capture of this scene",
            path_text(cameras),
            path_text(folder),
            example.unwrap_or_default()
        )));
    }
    // A model without its images is no capture, but it has cameras.
    let imported = match cameras.is_dir().then(|| import(cameras, &ImportParams::default())) {
        None | Some(Err(ImportError::NoImages { .. })) => None,
        Some(found) => Some(found.map_err(WorkError::input)?),
    };
    if let Some(imported) = imported {
        if origin.is_some() && !same_place(&scene.frame, &imported.capture.frame) {
            return Err(WorkError::Input(format!(
                "--cameras {}: its photographs have the same names as those that {} was made from, but its \
                 cameras are elsewhere: it is another model; give the capture of this scene",
                path_text(cameras),
                path_text(folder)
            )));
        }
        let views = scene_page::views(scene, origin.as_ref(), &imported).map_err(WorkError::input)?;
        return Ok((views, imported.needs_preparation()));
    }
    let view = |(name, camera): (FileName, Camera)| {
        let name = name.stem().to_string();
        PageView {
            held_out: is_held_out(origin.as_ref(), &name),
            name,
            camera,
            day: None,
            photograph: None,
            enhanced: None,
        }
    };
    Ok((placed.into_iter().map(view).collect(), false))
}
