//! The photographs of the data set Sea-Thru: linear photographs, with 16 bits and without a colour space of
//! their own.
//!
//! They are encoded for screens. Pictures that are encoded already would be encoded twice, so
//! they are refused by name: those of 8 bits, those whose 16 bits repeat 8, and those that state a colour
//! space. Limit: a picture of 16 bits for screens without any statement cannot be told from a linear one; a
//! bright one gets a remark.

use std::path::{Path, PathBuf};

use use3d_capture::Pixels;
use use3d_io_image::{FileFormat, photograph_info, read_pixels, states_colors};

use crate::error::PrepareError;
use crate::sources::{is_photograph, walk};

/// Linear photographs of a scene have most of their pixels below this share of the brightest ones.
const BRIGHT: f64 = 0.4;
/// The share of the samples of a channel that are not brighter than its white.
const WHITE: f64 = 0.998;

/// Refuses photographs that are not linear, and returns remarks.
///
/// # Errors
/// The first photograph that is a picture for screens, with the way out.
pub fn check_linear(folder: &Path) -> Result<Vec<String>, PrepareError> {
    let mut photographs = walk(folder, usize::MAX).collect::<Result<Vec<PathBuf>, PrepareError>>()?;
    photographs.retain(|path| is_photograph(path));
    photographs.sort();
    for path in &photographs {
        let info = photograph_info(path)?;
        let reason = match info.format {
            FileFormat::Png | FileFormat::Tiff if info.bits < 16 => "it has 8 bits per channel",
            format @ (FileFormat::Png | FileFormat::Tiff) => {
                if !states_colors(path, format)? {
                    continue;
                }
                "it states a colour space, and linear values have none"
            }
            _ => "it is no PNG and no TIFF",
        };
        return Err(refused(folder, path, reason));
    }
    let Some(first) = photographs.first() else { return Ok(Vec::new()) };
    let Pixels::Sixteen(pixels) = read_pixels(first)? else {
        return Ok(Vec::new());
    };
    if pixels.data().iter().all(|value| value % 257 == 0) {
        return Err(refused(folder, first, "its 16 bits repeat 8 bits"));
    }
    let shares: Vec<f64> = (0..3).map(|c| median_share(pixels.plane(c))).collect();
    let share = shares.iter().sum::<f64>() / 3.0;
    let bright = format!(
        "{} is bright for a linear photograph: half of it is above {share:.2} of its white; if it was developed for \
         screens, {}",
        first.display(),
        way_out(folder)
    );
    Ok((share > BRIGHT).then_some(bright).into_iter().collect())
}

/// The median of a channel as a share of its white.
fn median_share(plane: &[u16]) -> f64 {
    let mut values = plane.to_vec();
    values.sort_unstable();
    let at = |share: f64| values.get((share * values.len() as f64) as usize).copied().map_or(0.0, f64::from);
    at(0.5) / at(WHITE).max(1.0)
}

fn refused(folder: &Path, path: &Path, reason: &str) -> PrepareError {
    PrepareError::input(
        path,
        format!(
            "{reason}, so it is a picture for screens; this recipe takes linear photographs: PNG or TIFF with 16 bits \
         per channel and without a colour profile, which it encodes for screens itself. For pictures for screens, {}",
            way_out(folder)
        ),
    )
}

/// The way for pictures that are encoded already.
fn way_out(folder: &Path) -> String {
    format!("use `use3d prepare {} --out CAPTURE_DIR` (docs/reference/datasets.md)", folder.display())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;
    use use3d_capture::Raster;
    use use3d_io_image::{write_png8, write_png16};

    fn picture(value: impl Fn(usize) -> u16) -> Raster<u16, 3> {
        let mut image = Raster::<u16, 3>::new(8, 4);
        image.data_mut().iter_mut().enumerate().for_each(|(i, v)| *v = value(i % 32));
        image
    }

    #[test]
    fn pictures_for_screens_are_refused_by_name_with_the_way_out() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        let said = || check_linear(dir.path()).unwrap_err().to_string();
        write_png16(&at("a.png"), &picture(|i| 300 + 1500 * i as u16)).unwrap();
        let bright = check_linear(dir.path()).unwrap();
        assert!(bright.len() == 1 && bright[0].contains("bright for a linear photograph"), "{bright:?}");
        write_png16(&at("a.png"), &picture(|i| 300 + 50 * (i * i) as u16)).unwrap();
        assert_eq!(check_linear(dir.path()).unwrap(), Vec::<String>::new());
        let linear = fs::read(at("a.png")).unwrap();
        // An sRGB chunk behind the header of 33 bytes.
        let stated = [&linear[..33], b"\0\0\0\x01sRGB\0\xae\xce\x1c\xe9", &linear[33..]].concat();
        fs::write(at("b.png"), stated).unwrap();
        assert!(
            said().contains("b.png: it states a colour space") && said().contains("use3d prepare"),
            "{}",
            said()
        );
        fs::remove_file(at("b.png")).unwrap();
        write_png8(&at("c.png"), &Raster::new(8, 4)).unwrap();
        assert!(said().contains("c.png: it has 8 bits per channel"), "{}", said());
        fs::remove_file(at("c.png")).unwrap();
        write_png16(&at("a.png"), &picture(|i| 257 * i as u16)).unwrap();
        assert!(said().contains("repeat 8 bits"), "{}", said());
    }
}
