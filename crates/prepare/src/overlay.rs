//! Hides what lies over all images of a camera and never moves: `masks/NAME.png` beside the images, for the
//! search for features and for the training.

use std::path::{Path, PathBuf};

use use3d_io_image::{image_size, read_image, shrunk, write_png_map};
use use3d_overlay::{FEWEST, Overlay, SIDE, Still, find};

use crate::error::PrepareError;
use crate::process::StepWatch;

/// The folder of the masks, beside that of the images.
pub(crate) const MASKS: &str = "masks";
/// The most images of a camera that are read.
const MOST: usize = 40;

/// Looks for the overlay of each camera's images, and writes their masks. Returns a remark on it.
pub(crate) fn hide(
    capture: &Path,
    cameras: &[Vec<&str>],
    watch: &StepWatch<'_>,
) -> Result<Option<String>, PrepareError> {
    let (mut count, mut share) = (0, 0.0f64);
    for images in cameras.iter().filter(|images| images.len() >= FEWEST) {
        let Some(overlay) = overlay_of(capture, images, watch)? else { continue };
        for name in images {
            let (width, height) = image_size(&image(capture, name))?;
            let to = capture.join(MASKS).join(format!("{name}.png"));
            let folder = use3d_files::folder_of(&to);
            std::fs::create_dir_all(folder).map_err(PrepareError::write(folder))?;
            write_png_map(&to, &overlay.mask(width, height))?;
        }
        (count, share) = (count + images.len(), share.max(overlay.share()));
    }
    Ok((count > 0).then(|| {
        format!(
            "{count} images show the same thing in the same place, such as text or a part of the ROV ({:.1} % of the \
             picture). The masks in masks/ hide it (black is hidden): look at them, and correct them if they hide the \
             scene",
            100.0 * share
        )
    }))
}

fn image(capture: &Path, name: &str) -> PathBuf {
    capture.join("images").join(name)
}

fn overlay_of(
    capture: &Path,
    images: &[&str],
    watch: &StepWatch<'_>,
) -> Result<Option<Overlay>, PrepareError> {
    let mut pictures = Vec::new();
    for name in images.iter().step_by(images.len().div_ceil(MOST)) {
        watch.check()?;
        pictures.push(Still::of(&shrunk(&read_image(&image(capture, name))?, SIDE)));
    }
    Ok(find(&pictures))
}
