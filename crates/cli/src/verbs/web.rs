//! Writes a scene as a page for a browser.

use std::path::Path;

use use3d_capture::{Camera, FileName, Frame};
use use3d_import::{ImportError, ImportParams, capture_name, import};
use use3d_pipeline::scene_page;
use use3d_scene::{Origin, Scene, White};
use use3d_web::{Page, PageView, SavedViews};
use use3d_workflow::machine::bytes;

use crate::App;
use crate::args::ExportArgs;
use crate::destination::{absolute, check_file, path_text, write_text};
use crate::error::{CliError, Done};
use crate::verbs::drawing::{any_known, placed};

/// Refuses a wrong value of `--metres-per-unit`.
pub(crate) fn check_metres(given: Option<f64>) -> Done {
    match given.filter(|metres| !(metres.is_finite() && *metres > 0.0)) {
        None => Ok(()),
        Some(metres) => {
            Err(CliError::Input(format!("--metres-per-unit {metres}: expected a positive number")))
        }
    }
}

/// The metres in one unit of a scene's model: those given, those saved with its views, or those of its world.
pub(crate) fn metres(
    given: Option<f64>,
    saved: Option<&SavedViews>,
    scene: &Path,
) -> Result<Option<f64>, CliError> {
    match given.or_else(|| saved?.metres_per_unit) {
        Some(metres) => Ok(Some(metres)),
        None => Ok(Scene::world(scene).map_err(CliError::input)?.map(|world| world.metres_per_unit)),
    }
}

/// Writes the page, and its parts into a folder beside it if it is too large for one file.
pub(crate) fn write(app: &App, args: &ExportArgs, path: &Path, scene: &Scene, white: Option<&White>) -> Done {
    let views = views(args.cameras.as_deref(), &args.scene, scene)?;
    let saved = saved_views(args.views.as_deref())?;
    let name = scene_name(&args.scene);
    // The folder for the parts of a page: `reef_files` for `reef.html`.
    let folder_name = format!("{}_files", path.file_stem().unwrap_or_default().to_string_lossy());
    let folder = path.with_file_name(&folder_name);
    let page = Page {
        name: &name,
        scene,
        views,
        metres_per_unit: metres(args.metres_per_unit, saved.as_ref(), &args.scene)?,
        saved: saved.as_ref(),
        white,
    };
    let written = use3d_web::write(&page, &folder_name).map_err(CliError::input)?;
    // Nothing is written if one of the parts may not be replaced.
    for (file, _) in &written.parts {
        check_file("--web", &folder.join(file), args.replace.force, &["js"])?;
    }
    for (file, text) in &written.parts {
        write_text("--web", &folder.join(file), text)?;
    }
    write_text("--web", path, &written.html)?;
    let photographs = page.views.iter().filter(|v| v.photograph.is_some()).count();
    let less = match written.degree {
        degree if degree == scene.gaussians.sh_degree.min(3) => String::new(),
        degree => format!(", harmonics to degree {degree} so that it stays one file"),
    };
    let beside = match &written.parts[..] {
        [] => String::new(),
        _ => format!(" with {} beside it", path_text(&folder)),
    };
    remark!(
        app,
        "{}{beside}: {} Gaussians, {photographs} photographs, {}{less}; open it in a browser",
        path_text(path),
        scene.gaussians.len(),
        bytes(written.bytes() as u64)
    );
    Ok(())
}

/// The views that were saved from a page, if a file of them is named.
pub(crate) fn saved_views(file: Option<&Path>) -> Result<Option<SavedViews>, CliError> {
    let Some(file) = file else { return Ok(None) };
    let wrong = |what: String| CliError::Input(format!("--views {}: {what}", path_text(file)));
    let next = "expected a file that the page saved with \"Save file\" below its views \
         (docs/guide/browser.md)";
    let text = text_of(file).map_err(|what| wrong(format!("{what}; {next}")))?;
    SavedViews::read(&text).map(Some).map_err(|what| wrong(format!("{what}; {next}")))
}

/// The text of a file that a page wrote, or the reason why it cannot be read.
pub(crate) fn text_of(file: &Path) -> Result<String, String> {
    if file.is_dir() {
        return Err("it is a folder, not a file".into());
    }
    let bytes = std::fs::read(file).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => "there is no such file".to_string(),
        _ => format!("it cannot be read: {error}"),
    })?;
    String::from_utf8(bytes).map_err(|_| "it is not UTF-8 text".into())
}

/// The name for a scene folder: `reef/enhanced-scene` has the name `reef`.
pub(crate) fn scene_name(folder: &Path) -> String {
    let place = absolute(folder);
    match capture_name(&place).as_str() {
        "scene" | "enhanced-scene" => place.parent().map_or_else(|| capture_name(&place), capture_name),
        own => own.to_string(),
    }
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
/// A capture of another place is refused: one without any of the photographs from which the scene was made.
pub(crate) fn views(cameras: Option<&Path>, folder: &Path, scene: &Scene) -> Result<Vec<PageView>, CliError> {
    let Some(cameras) = cameras else { return Ok(Vec::new()) };
    let origin = Origin::read(folder).map_err(CliError::input)?;
    let placed = placed(cameras, &scene.frame)?;
    if let Some(origin) = origin.as_ref().filter(|origin| cameras.is_dir() && !any_known(origin, &placed)) {
        let example = origin.train.first().map(|stem| format!(" (`{stem}` is one of them)"));
        return Err(CliError::Input(format!(
            "--cameras {}: it has none of the photographs that {} was made from{}; give the capture of this scene",
            path_text(cameras),
            path_text(folder),
            example.unwrap_or_default()
        )));
    }
    // A model without its images is no capture, but it has cameras.
    let imported = match cameras.is_dir().then(|| import(cameras, &ImportParams::default())) {
        None | Some(Err(ImportError::NoImages { .. })) => None,
        Some(found) => Some(found.map_err(CliError::input)?),
    };
    if let Some(imported) = imported {
        if origin.is_some() && !same_place(&scene.frame, &imported.capture.frame) {
            return Err(CliError::Input(format!(
                "--cameras {}: its photographs have the same names as those that {} was made from, but its \
                 cameras are elsewhere: it is another model; give the capture of this scene",
                path_text(cameras),
                path_text(folder)
            )));
        }
        if imported.needs_preparation() {
            eprintln!("the page shows the photographs with the distortion of their lens");
        }
        return scene_page::views(scene, origin.as_ref(), &imported).map_err(CliError::input);
    }
    let view = |(name, camera): (FileName, Camera)| {
        let name = name.stem().to_string();
        PageView {
            held_out: scene_page::is_held_out(origin.as_ref(), &name),
            name,
            camera,
            photograph: None,
            enhanced: None,
        }
    };
    Ok(placed.into_iter().map(view).collect())
}
