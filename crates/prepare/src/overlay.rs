//! Hides what lies over all images of a camera and never moves: `masks/NAME.png` beside the images, for the
//! search for features and for the training.

use std::path::{Path, PathBuf};

use use3d_capture::Map;
use use3d_io_image::{image_size, write_png_map};
use use3d_overlay::{ENOUGH, FEWEST, Overlay, Still, find};

use crate::error::PrepareError;
use crate::process::StepWatch;

/// The folder of the masks, beside that of the images.
pub(crate) const MASKS: &str = "masks";

/// Looks for the overlay of each camera's images, and writes their masks. Returns a remark on it.
pub(crate) fn hide(
    capture: &Path,
    cameras: &[Vec<&str>],
    watch: &StepWatch<'_>,
) -> Result<Option<String>, PrepareError> {
    let (mut count, mut share) = (0, 0.0f64);
    for images in cameras.iter().filter(|images| images.len() >= FEWEST) {
        let Some(overlay) = overlay_of(capture, images, watch)? else { continue };
        let mut mask = Map::new(0, 0);
        for name in images {
            let size = image_size(&image(capture, name))?;
            // The images of a camera nearly always have one size.
            if size != (mask.width(), mask.height()) {
                mask = overlay.mask(size.0, size.1);
            }
            let to = capture.join(MASKS).join(format!("{name}.png"));
            let folder = use3d_files::folder_of(&to);
            std::fs::create_dir_all(folder).map_err(PrepareError::write(folder))?;
            write_png_map(&to, &mask)?;
        }
        (count, share) = (count + images.len(), share.max(overlay.share()));
    }
    Ok((count > 0).then(|| {
        format!(
            "{count} images show the same thing in the same place, such as text or a part of the ROV ({:.1} % of the \
             picture). The masks in masks/ hide it (black is hidden): look at them, and paint white \
             over what they hide of the scene",
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
    for name in images.iter().step_by(images.len().div_ceil(ENOUGH)) {
        watch.check()?;
        pictures.push(Still::read(&image(capture, name))?);
    }
    Ok(find(&pictures))
}
