//! The cause for which no cameras were found, measured on the images.

use std::path::Path;

use use3d_io_image::ImageError;
use use3d_numerics::order::median;
use use3d_overlay::{ENOUGH, Still, find};

use crate::choose::{Frame, seen_together};
use crate::error::PrepareError;

/// A range of brightness, 5th to 95th percentile, below which hardly any detail is left, in levels.
const FLAT: u8 = 26;
/// An overlap of neighbours below which they have too little in common.
const LITTLE: f64 = 0.4;

/// The measured cause with its next step, and true if other choices of the search may help, too.
pub(crate) fn why_no_cameras(images: &Path, names: &[String]) -> Result<(String, bool), PrepareError> {
    // Neighbours, from the first one on.
    let few = names.iter().take(ENOUGH);
    let stills: Vec<Still> =
        few.map(|name| Still::read(&images.join(name))).collect::<Result<_, ImageError>>()?;
    let (mut frames, mut ranges) = (Vec::new(), Vec::new());
    for (number, Still { width, height, values }) in (0..).zip(&stills) {
        let mut values = values[..width * height].to_vec();
        frames.push(Frame::new(number, *width, *height, &values));
        values.sort_unstable();
        let at = |share: f64| values.get((share * values.len() as f64) as usize).copied().unwrap_or(0);
        ranges.push(at(0.95) - at(0.05));
    }
    let of = frames.len();
    let unusable = frames.iter().filter(|frame| !frame.usable).count();
    if 2 * unusable > of {
        let step = "film with more light, or leave the dark images out";
        return Ok((format!("{unusable} of {of} images are black or white; {step}"), false));
    }
    let flat = ranges.iter().filter(|range| **range < FLAT).count();
    if 2 * flat > of {
        let step = "go nearer, or dive when the water is clearer";
        let words =
            format!("{flat} of {of} images show hardly any detail, as in cloudy or open water; {step}");
        return Ok((words, true));
    }
    let together = seen_together(&frames, find(&stills).as_ref());
    if together.stands {
        let words = "all images are taken from the same point, so the camera does not move and no distance can be measured; swim \
            sideways along the scene and take new ones";
        return Ok((words.into(), false));
    }
    let usual = median(together.neighbours).unwrap_or(0.0);
    if usual < LITTLE {
        let words = format!(
            "each image shares only {:.0} % of its picture with the next one, and 70 % is a good value; take images in \
             between",
            100.0 * usual
        );
        return Ok((words, true));
    }
    let words = format!(
        "neighbouring images share {:.0} % of their picture, but the camera seems only to turn and not to travel; swim \
         sideways along the scene",
        100.0 * usual
    );
    Ok((words, true))
}

#[cfg(test)]
mod tests {
    use use3d_capture::Image8;
    use use3d_io_image::write_png8;

    use super::*;

    /// The cause for pictures that show a texture with these shifts, contrast and brightness.
    fn cause(shifts: impl Iterator<Item = usize>, contrast: f64, brightness: f64) -> String {
        cause_below(shifts, contrast, brightness, |_, _| None)
    }

    /// The cause with something over all of them.
    fn cause_below(
        shifts: impl Iterator<Item = usize>,
        contrast: f64,
        brightness: f64,
        over: impl Fn(usize, usize) -> Option<u8>,
    ) -> String {
        let dir = tempfile::tempdir().unwrap();
        let mut names = Vec::new();
        for (number, shift) in shifts.enumerate() {
            let mut picture = Image8::new(160, 90);
            for (x, y) in (0..160 * 90).map(|i| (i % 160, i / 160)) {
                let block = |side: usize| {
                    let (u, v) = ((x + shift) / side, y / side);
                    (u.wrapping_mul(7919) ^ v.wrapping_mul(104_729)).wrapping_mul(2_654_435_761) >> 16 & 0xFF
                };
                let value = brightness + contrast * (0.5 * (block(4) + block(13)) as f64 - 128.0);
                picture.set_pixel(x, y, [over(x, y).unwrap_or(value.clamp(0.0, 255.0) as u8); 3]);
            }
            names.push(format!("{number}.png"));
            write_png8(&dir.path().join(&names[number]), &picture).unwrap();
        }
        why_no_cameras(dir.path(), &names).unwrap().0
    }

    #[test]
    fn no_parallax_and_other_causes_are_named() {
        assert!(cause((0..10).map(|_| 5), 0.8, 120.0).contains("the camera does not move"));
        assert!(cause((0..10).map(|i| 400 * i), 0.8, 120.0).contains("of its picture with the next one"));
        assert!(cause((0..10).map(|i| 10 * i), 0.02, 120.0).contains("hardly any detail"));
        assert!(cause((0..10).map(|i| 10 * i), 0.8, -200.0).contains("10 of 10 images are black"));
        assert!(cause((0..10).map(|i| 10 * i), 0.8, 120.0).contains("only to turn"));
        // A display that never moves is no camera that does not move.
        let display = |x: usize, y: usize| {
            let letter = (x / 8 + y / 6).is_multiple_of(2);
            (!(22..68).contains(&y)).then_some(if letter { 250 } else { 5 })
        };
        let said = cause_below((0..20).map(|i| 10 * i), 0.2, 120.0, display);
        assert!(said.contains("only to turn"), "{said}");
    }
}
