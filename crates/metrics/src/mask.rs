//! The pixels that count.
//!
//! There is one rule for the whole workspace: a pixel counts if its weight (a mask file times an alpha
//! channel) is at least one half. Pixels that do not count enter no score:
//!
//! * measures of single pixels (PSNR, UCIQE, CIEDE2000) use only the others: [`only_counted`];
//! * measures of windows (SSIM) use only the windows in which all pixels count;
//! * measures of whole pictures (LPIPS and the quality networks) get black pixels instead, in every picture
//!   alike: [`blacked_out`].

use use3d_capture::{Image, Map};

use crate::error::{MetricError, same_size};
use crate::warp::Mask;

/// The mask of weights in `[0, 1]`; a weight of NaN does not count.
pub fn mask_of(weights: &Map) -> Mask {
    weights.map(|w| u8::from(w >= 0.5))
}

/// Number of pixels that count.
pub fn counted(mask: &Mask) -> usize {
    mask.data().iter().filter(|m| **m != 0).count()
}

/// Share of the pixels that count, 0 to 1: all of them without a mask, none of an empty one.
pub fn share(mask: Option<&Mask>) -> f64 {
    mask.map_or(1.0, |mask| counted(mask) as f64 / mask.pixels().max(1) as f64)
}

/// An image of one row with the pixels that count.
///
/// # Errors
/// The mask has another size, or leaves no pixel.
pub fn only_counted(image: &Image, mask: &Mask) -> Result<Image, MetricError> {
    same_size("the mask", image, mask)?;
    let places: Vec<usize> = (0..image.pixels()).filter(|p| mask.data()[*p] != 0).collect();
    if places.is_empty() {
        return Err(MetricError::NothingCounts);
    }
    let mut row = Image::new(places.len(), 1);
    for c in 0..3 {
        let plane = image.plane(c);
        row.plane_mut(c).iter_mut().zip(&places).for_each(|(out, p)| *out = plane[*p]);
    }
    Ok(row)
}

/// The image, black where pixels do not count.
///
/// # Errors
/// The mask has another size, or leaves no pixel.
pub fn blacked_out(image: &Image, mask: &Mask) -> Result<Image, MetricError> {
    same_size("the mask", image, mask)?;
    if counted(mask) == 0 {
        return Err(MetricError::NothingCounts);
    }
    let mut out = image.clone();
    for c in 0..3 {
        out.plane_mut(c).iter_mut().zip(mask.data()).filter(|(_, m)| **m == 0).for_each(|(v, _)| *v = 0.0);
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_counts_and_nothing_is_said() {
        let weights = Map::from_planes(5, 1, vec![0.0, 0.5, 1.0, f32::NAN, -3.0]).unwrap();
        let mask = mask_of(&weights);
        assert_eq!((mask.data(), counted(&mask)), (&[0u8, 1, 1, 0, 0][..], 2));
        let image = Image::from_planes(5, 1, (0..15).map(|i| i as f32).collect()).unwrap();
        assert_eq!(only_counted(&image, &mask).unwrap().data(), [1.0, 2.0, 6.0, 7.0, 11.0, 12.0]);
        assert_eq!(blacked_out(&image, &mask).unwrap().row(1, 0), [0.0, 6.0, 7.0, 0.0, 0.0]);
        let none = Mask::new(5, 1);
        assert_eq!(only_counted(&image, &none), Err(MetricError::NothingCounts));
        assert_eq!(blacked_out(&image, &none), Err(MetricError::NothingCounts));
        assert!(only_counted(&image, &Mask::new(1, 5)).is_err());
    }
}
