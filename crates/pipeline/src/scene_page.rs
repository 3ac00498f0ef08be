//! A scene's page for a browser, with the photographs of its capture and the positions of their cameras.

use std::path::Path;

use use3d_import::{ImportError, Imported, load_prepared};
use use3d_io_image::{ImageError, read_exif, read_image};
use use3d_scene::{Origin, Scene, SceneError, White};
use use3d_web::{Page, PageView, Photograph, WebError, Written};

/// A page that cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum ScenePageError {
    /// The scene cannot be read.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The capture cannot be read.
    #[error(transparent)]
    Import(#[from] ImportError),
    /// A photograph cannot be read.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The page cannot be put together.
    #[error(transparent)]
    Web(#[from] WebError),
}

/// The views of a capture in the frame of a scene, with their photographs. `origin` lists the views that were
/// held out from training.
///
/// # Errors
/// Fails if a photograph cannot be read.
pub fn views(
    scene: &Scene,
    origin: Option<&Origin>,
    imported: &Imported,
) -> Result<Vec<PageView>, ScenePageError> {
    let capture = &imported.capture;
    let views = capture.views.iter().map(|view| {
        let mut camera = view.camera;
        camera.pose = scene.frame.apply_pose(&capture.frame.invert_pose(&camera.pose));
        let name = view.stem().to_string();
        let photograph = Some(Photograph::new(&name, &read_image(&view.image)?)?);
        let day = read_exif(&view.image).ok().and_then(|exif| exif.day);
        Ok(PageView { held_out: is_held_out(origin, &name), name, camera, day, photograph, enhanced: None })
    });
    views.collect()
}

/// True if a view of this stem was held out from training.
pub fn is_held_out(origin: Option<&Origin>, stem: &str) -> bool {
    origin.is_some_and(|origin| origin.held_out.iter().any(|held| held == stem))
}

/// Writes the page of a scene folder with the views of an imported capture, and with their photographs in the
/// folder `enhanced`. `parts` is the name of the folder for the page's parts, if it needs one; `white` is the
/// white balance that it opens with.
///
/// # Errors
/// Fails if the scene or the capture cannot be read, or the page cannot be built.
pub(crate) fn write(
    name: &str,
    folder: &Path,
    (capture, enhanced): (Option<&Path>, Option<&Path>),
    parts: &str,
    white: Option<&White>,
) -> Result<Written, ScenePageError> {
    let scene = Scene::load(folder)?;
    let origin = Origin::read(folder)?;
    let mut views = match capture {
        Some(capture) => views(&scene, origin.as_ref(), &load_prepared(capture)?)?,
        None => Vec::new(),
    };
    if let Some(enhanced) = enhanced {
        for view in &mut views {
            let file = enhanced.join(format!("{}.png", view.name));
            if file.is_file() {
                view.enhanced = Some(Photograph::new(&view.name, &read_image(&file)?)?);
            }
        }
    }
    let metres_per_unit = Scene::world(folder)?.map(|world| world.metres_per_unit);
    let page = Page { name, scene: &scene, views, metres_per_unit, saved: None, white };
    Ok(use3d_web::write(&page, parts)?)
}
