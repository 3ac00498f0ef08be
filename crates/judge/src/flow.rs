//! The flow from one view to the next, as it is stored: displacements in pixels, and where they count.
//!
//! A file is a 16-bit PNG in the form of the KITTI benchmark: `2^15 + 64 dx`, `2^15 + 64 dy`, and 1 where the
//! flow counts. So flow is rounded to 1/64 pixel, and displacements of 512 pixels and more do not count.

use use3d_capture::Raster;
use use3d_metrics::{Flow, Mask};

use crate::scoring::ScoreError;

/// A flow to the next view with the mask of its valid pixels, or the reason why there is none.
pub type Correspondence = Result<(Flow, Mask), ScoreError>;

/// Steps of a pixel.
const STEPS: f32 = 64.0;
/// The number that stands for no displacement.
const ZERO: f32 = 32768.0;

/// The samples of the file.
pub fn encode(flow: &Flow, mask: &Mask) -> Raster<u16, 3> {
    let mut samples = Raster::new(flow.width(), flow.height());
    for y in 0..flow.height() {
        for x in 0..flow.width() {
            let [u, v] = flow.pixel(x, y).map(|d| (ZERO + STEPS * d).round());
            let fits = |value: f32| (0.0..=f32::from(u16::MAX)).contains(&value);
            if mask.pixel(x, y)[0] != 0 && fits(u) && fits(v) {
                samples.set_pixel(x, y, [u as u16, v as u16, 1]);
            }
        }
    }
    samples
}

/// The flow of a file's samples, 0 where it does not count.
pub fn decode(samples: &Raster<u16, 3>) -> (Flow, Mask) {
    let (width, height) = (samples.width(), samples.height());
    let (mut flow, mut mask) = (Flow::new(width, height), Mask::new(width, height));
    for y in 0..height {
        for x in 0..width {
            let [u, v, counts] = samples.pixel(x, y);
            if counts != 0 {
                flow.set_pixel(x, y, [u, v].map(|value| (f32::from(value) - ZERO) / STEPS));
                mask.set_pixel(x, y, [1]);
            }
        }
    }
    (flow, mask)
}

/// A flow as its file will give it back.
pub(crate) fn stored(flow: &Flow, mask: &Mask) -> (Flow, Mask) {
    decode(&encode(flow, mask))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flow_is_kept_to_a_64th_of_a_pixel_and_far_displacements_do_not_count() {
        let mut flow = Flow::new(4, 1);
        let given = [[0.5, -3.25], [511.98, 0.004], [512.0, 0.0], [1.0, 1.0]];
        (0..4).for_each(|x| flow.set_pixel(x, 0, given[x]));
        let mut mask = Mask::filled(4, 1, 1);
        mask.set_pixel(3, 0, [0]);
        let (kept, counts) = stored(&flow, &mask);
        assert_eq!(counts.data(), [1, 1, 0, 0]);
        assert_eq!(kept.pixel(0, 0), [0.5, -3.25]);
        assert_eq!((kept.pixel(1, 0), kept.pixel(3, 0)), ([511.984_38, 0.0], [0.0, 0.0]));
        assert_eq!(stored(&kept, &counts), (kept, counts));
    }
}
