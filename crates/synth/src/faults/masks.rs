//! Faults of masks: forms and folders of other programs, and masks that hide the wrong part.

use std::path::Path;

use image::{GrayImage, Luma, LumaA};

use super::bytes::{orientation, with_exif};
use super::folder::{Done, Spoiler, pixels_error};

/// Writes a mask of every photograph: `place` gives its path from that of the photograph's name and stem.
fn write(
    s: &Spoiler<'_>,
    place: impl Fn(&str, &str) -> String,
    value: impl Fn(u32, u32, u32, u32) -> u8,
) -> Done {
    let (w, h) = s.size()?;
    let mask = GrayImage::from_fn(w, h, |x, y| Luma([value(x, y, w, h)]));
    save(s, place, |path| mask.save(path))
}

fn save(
    s: &Spoiler<'_>,
    place: impl Fn(&str, &str) -> String,
    write: impl Fn(&Path) -> image::ImageResult<()>,
) -> Done {
    for photograph in s.photographs()? {
        let name = photograph.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let path = s.path(&place(&name, use3d_capture::stem(&name)));
        let folder = use3d_files::folder_of(&path);
        std::fs::create_dir_all(folder).map_err(crate::SynthError::io(folder))?;
        write(&path).map_err(pixels_error(&path))?;
    }
    Ok(())
}

fn usual(_: &str, stem: &str) -> String {
    format!("masks/{stem}.png")
}

/// A quarter at the left is hidden, as by a housing.
fn left(x: u32, _: u32, w: u32, _: u32) -> u8 {
    if 4 * x < w { 0 } else { 255 }
}

/// Only a small box in the middle counts: the diver who should be hidden is white.
pub(super) fn inverted(s: &Spoiler<'_>) -> Done {
    write(s, usual, |x, y, w, h| {
        let inside = (5 * w..8 * w).contains(&(12 * x)) && (4 * h..8 * h).contains(&(12 * y));
        if inside { 255 } else { 0 }
    })
}

pub(super) fn zero_one(s: &Spoiler<'_>) -> Done {
    write(s, usual, |x, y, w, h| left(x, y, w, h) / 255)
}

pub(super) fn all_black(s: &Spoiler<'_>) -> Done {
    write(s, usual, |_, _, _, _| 0)
}

pub(super) fn in_alpha(s: &Spoiler<'_>) -> Done {
    let (w, h) = s.size()?;
    let mask = image::GrayAlphaImage::from_fn(w, h, |x, y| LumaA([255, left(x, y, w, h)]));
    save(s, usual, |path| mask.save(path))
}

pub(super) fn folder_mask(s: &Spoiler<'_>) -> Done {
    write(s, |_, stem| format!("mask/{stem}.png"), left)
}

pub(super) fn folder_masks(s: &Spoiler<'_>) -> Done {
    write(s, |_, stem| format!("Masks/{stem}.png"), left)
}

pub(super) fn beside(s: &Spoiler<'_>) -> Done {
    write(s, |_, stem| format!("images/{stem}_mask.png"), left)
}

pub(super) fn beside_with_extension(s: &Spoiler<'_>) -> Done {
    write(s, |name, _| format!("images/{name}.mask.png"), left)
}

pub(super) fn misnamed(s: &Spoiler<'_>) -> Done {
    write(s, |_, stem| format!("masks/diver {stem} final.png"), left)
}

/// Photographs with a quarter turn in their EXIF data, and masks painted on the turned pictures.
pub(super) fn turned(s: &Spoiler<'_>) -> Done {
    with_exif(s, |_| orientation(6))?;
    let (w, h) = s.size()?;
    let mask = GrayImage::from_fn(h, w, |x, y| Luma([left(y, h - 1 - x, w, h)]));
    save(s, usual, |path| mask.save(path))
}
