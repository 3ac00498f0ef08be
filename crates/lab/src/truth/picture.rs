//! One held-out view of a capture side by side: photograph, 2D enhancer, `clear`, `enhanced`, truth.
//!
//! Photograph and renderings are those of the `render` stage; the 2D enhancer runs here on the photograph, as
//! in `evaluate`. The view is the middle one of the held-out views.

use std::path::Path;

use use3d_atc::proposers::Proposer;
use use3d_capture::Image;
use use3d_io_image::{ImageError, read_image};

/// White between pictures, pixels.
const GAP: usize = 6;

/// One view side by side.
#[derive(Clone, Debug)]
pub struct Sheet {
    /// The capture's name.
    pub capture: String,
    /// The pictures in a row.
    pub image: Image,
    /// The names of the pictures, from left to right.
    pub shows: Vec<&'static str>,
}

/// Returns the true clean image of a view, given its stem and its width and height; `None` if it is not
/// known.
pub type Clean<'a> = dyn FnMut(&str, (usize, usize)) -> Option<Image> + 'a;

/// The reason why there is no picture.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// A picture of the run cannot be read.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The 2D enhancer failed.
    #[error(transparent)]
    Proposer(#[from] use3d_atc::AtcError),
    /// The folder of renderings cannot be listed.
    #[error("{0}: {1}")]
    Folder(std::path::PathBuf, std::io::Error),
    /// No view was held out.
    #[error("{0}: no held-out view was rendered")]
    NoView(std::path::PathBuf),
    /// The pictures of a view have different sizes.
    #[error("the view's pictures are of different heights: {0:?}")]
    Heights(Vec<usize>),
}

/// Pictures of one height side by side, with white between them.
fn beside(images: &[Image]) -> Result<Image, PictureError> {
    let heights: Vec<usize> = images.iter().map(Image::height).collect();
    let height = heights.first().copied().unwrap_or(0);
    if heights.iter().any(|h| *h != height) {
        return Err(PictureError::Heights(heights));
    }
    let width = images.iter().map(|i| i.width() + GAP).sum::<usize>().saturating_sub(GAP);
    let mut sheet = Image::filled(width, height, 1.0);
    let mut left = 0;
    for image in images {
        for y in 0..height {
            for x in 0..image.width() {
                sheet.set_pixel(left + x, y, image.pixel(x, y).map(|v| v.clamp(0.0, 1.0)));
            }
        }
        left += image.width() + GAP;
    }
    Ok(sheet)
}

/// The sheet of a capture from the artifact of its `render` stage.
///
/// # Errors
/// Fails if renderings are missing or cannot be read, or if the 2D enhancer fails.
pub fn sheet(
    capture: &str,
    renders: &Path,
    proposer: &dyn Proposer,
    clean: &mut Clean<'_>,
) -> Result<Sheet, PictureError> {
    let captured = renders.join("captured");
    let entries = std::fs::read_dir(&captured).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let entries = entries.map_err(|e| PictureError::Folder(captured.clone(), e))?;
    let mut names: Vec<String> =
        entries.iter().map(|e| e.file_name().to_string_lossy().into_owned()).collect();
    names.sort_unstable();
    let Some(name) = names.get(names.len() / 2) else { return Err(PictureError::NoView(captured)) };
    let photograph = read_image(&captured.join(name))?;
    let size = (photograph.width(), photograph.height());
    let enhanced = proposer.enhance(&photograph)?;
    let mut shown = vec![("photograph", photograph), ("2D enhancer on the photograph", enhanced)];
    // A scene without a second stage has fewer pictures.
    for modes in [["clear"].as_slice(), &["enhanced", "enhanced-clear"]] {
        let there = |mode: &&&str| renders.join(mode).join(name).is_file();
        if let Some(mode) = modes.iter().find(there) {
            shown.push((mode, read_image(&renders.join(mode).join(name))?));
        }
    }
    let stem = name.strip_suffix(".png").unwrap_or(name);
    shown.extend(clean(stem, size).map(|clean| ("truth", clean)));
    let (shows, images): (Vec<_>, Vec<_>) = shown.into_iter().unzip();
    Ok(Sheet { capture: capture.into(), image: beside(&images)?, shows })
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_atc::proposers::Fusion;
    use use3d_io_image::write_png;

    #[test]
    fn the_middle_view_stands_beside_what_was_made_of_it() {
        let dir = tempfile::tempdir().unwrap();
        let shade = |v: f32| {
            let mut image = Image::filled(24, 16, v);
            image.set_pixel(3, 3, [0.9, 0.1, 0.2]);
            image
        };
        for (folder, v) in [("captured", 0.2), ("clear", 0.4), ("enhanced", 0.6), ("enhanced-clear", 0.7)] {
            std::fs::create_dir(dir.path().join(folder)).unwrap();
            for (i, name) in ["a", "b", "c"].iter().enumerate() {
                let image = shade(v + 0.01 * i as f32);
                write_png(&dir.path().join(folder).join(format!("{name}.png")), &image).unwrap();
            }
        }
        let mut asked = Vec::new();
        let Sheet { image: sheet, shows, .. } = sheet("air", dir.path(), &Fusion, &mut |stem, size| {
            asked.push((stem.to_string(), size));
            Some(shade(0.8))
        })
        .unwrap();
        assert_eq!(asked, [("b".to_string(), (24, 16))]);
        assert_eq!(shows, ["photograph", "2D enhancer on the photograph", "clear", "enhanced", "truth"]);
        assert_eq!((sheet.width(), sheet.height()), (5 * 24 + 4 * GAP, 16));
        let at = |i: usize| sheet.pixel(i * (24 + GAP), 0)[1];
        for (i, v) in [(0, 0.21), (2, 0.41), (3, 0.61), (4, 0.8)] {
            assert!((at(i) - v).abs() < 0.003, "{i}: {}", at(i));
        }
        assert_eq!(sheet.pixel(24, 0), [1.0; 3], "white between");
        assert!(beside(&[shade(0.1), Image::new(24, 17)]).is_err());
        assert!(super::sheet("air", &dir.path().join("nowhere"), &Fusion, &mut |_, _| None).is_err());
    }
}
