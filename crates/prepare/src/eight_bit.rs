//! Copies of 8 bits for COLMAP: some of its versions cannot read 16 bits (Debian's 3.8). They are only read
//! to find the cameras; the capture keeps the photographs as they are.

use std::path::Path;

use use3d_io_image::{photograph_info, read_image, write_png8};

use crate::error::PrepareError;
use crate::sfm::IMAGES;

/// The folder of the copies, beside the capture in the folder of the work. It has every image.
const COPIES: &str = "eight-bit";

/// The folder whose images COLMAP can read, below the folder of the work.
pub(crate) fn readable(work: &Path) -> &'static str {
    if work.join(COPIES).is_dir() { COPIES } else { IMAGES }
}

/// Makes the copies, if an image has more than 8 bits. The images of 8 bits are linked, or copied where that
/// is impossible.
///
/// # Errors
/// An image cannot be read, or a copy cannot be written.
pub(crate) fn make<'a>(
    work: &Path,
    names: impl Iterator<Item = &'a String> + Clone,
) -> Result<(), PrepareError> {
    let copies = work.join(COPIES);
    if copies.is_dir() {
        // Those of an earlier attempt may be of other photographs.
        std::fs::remove_dir_all(&copies).map_err(PrepareError::write(&copies))?;
    }
    let image = |name: &String| work.join(IMAGES).join(name);
    let deep = |name: &String| photograph_info(&image(name)).is_ok_and(|info| info.bits > 8);
    if !names.clone().any(deep) {
        return Ok(());
    }
    for name in names {
        let (from, to) = (image(name), copies.join(name));
        if let Some(folder) = to.parent() {
            std::fs::create_dir_all(folder).map_err(PrepareError::write(folder))?;
        }
        if deep(name) {
            let picture = read_image(&from).map_err(|e| PrepareError::input(&from, e.to_string()))?;
            write_png8(&to, &picture.to_8bit()).map_err(|e| PrepareError::input(&to, e.to_string()))?;
        } else if std::fs::hard_link(&from, &to).is_err() {
            std::fs::copy(&from, &to).map_err(PrepareError::write(&to))?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use use3d_capture::{Image8, Raster};
    use use3d_io_image::write_png16;

    use super::*;

    #[test]
    fn only_deep_photographs_are_copied_and_a_folder_without_any_stays_as_it_is() {
        let dir = tempfile::tempdir().unwrap();
        let images = dir.path().join(IMAGES);
        std::fs::create_dir_all(images.join("left")).unwrap();
        write_png8(&images.join("a.png"), &Image8::new(6, 4)).unwrap();
        let mut names = vec!["a.png".to_string()];
        make(dir.path(), names.iter()).unwrap();
        assert_eq!(readable(dir.path()), IMAGES);
        let mut deep = Raster::<u16, 3>::new(6, 4);
        deep.data_mut().fill(0x8080);
        write_png16(&images.join("left/b.png"), &deep).unwrap();
        names.push("left/b.png".to_string());
        // The same call again, as after an interruption, changes nothing.
        for _ in 0..2 {
            make(dir.path(), names.iter()).unwrap();
            let copies = dir.path().join(readable(dir.path()));
            assert_ne!(readable(dir.path()), IMAGES);
            let bits = |name: &str| photograph_info(&copies.join(name)).unwrap().bits;
            assert_eq!((bits("a.png"), bits("left/b.png")), (8, 8));
            let seen = read_image(&copies.join("left/b.png")).unwrap();
            assert!(seen.data().iter().all(|v| (v - 128.0 / 255.0).abs() < 1e-6));
        }
        // Copies of earlier photographs do not stand for others.
        make(dir.path(), names[..1].iter()).unwrap();
        assert_eq!(readable(dir.path()), IMAGES);
    }
}
