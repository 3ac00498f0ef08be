//! Writes a scene as a page for a browser.

use std::path::Path;

use use3d_pipeline::destination::{check_file, path_text, write_text};
use use3d_pipeline::scene_views::{metres, page_views, saved_views, scene_name};
use use3d_scene::{Scene, White};
use use3d_web::{Page, PageView};
use use3d_workflow::machine::bytes;

use crate::App;
use crate::args::ExportArgs;
use crate::error::{Done, WorkError};

/// Refuses a wrong value of `--metres-per-unit`.
pub(crate) fn check_metres(given: Option<f64>) -> Done {
    match given.filter(|metres| !(metres.is_finite() && *metres > 0.0)) {
        None => Ok(()),
        Some(metres) => {
            Err(WorkError::Input(format!("--metres-per-unit {metres}: expected a positive number")))
        }
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
    let written = use3d_web::write(&page, &folder_name).map_err(WorkError::input)?;
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

/// The views of the page's capture; a page with distorted photographs is remarked.
pub(crate) fn views(
    cameras: Option<&Path>,
    folder: &Path,
    scene: &Scene,
) -> Result<Vec<PageView>, WorkError> {
    let (views, distorted) = page_views(cameras, folder, scene)?;
    if distorted {
        eprintln!("the page shows the photographs with the distortion of their lens");
    }
    Ok(views)
}
