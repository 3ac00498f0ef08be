//! The reasons why a measure cannot be computed.

use use3d_capture::{Image, Raster};

/// An error in images that cannot be compared or measured.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum MetricError {
    /// Two rasters have different sizes and must have the same.
    #[error(
        "{what} is {found_width}x{found_height} pixels, but the image it belongs to is {width}x{height}; resize or crop one of them"
    )]
    SizeMismatch {
        /// The raster with the wrong size.
        what: &'static str,
        /// Expected width.
        width: usize,
        /// Expected height.
        height: usize,
        /// Found width.
        found_width: usize,
        /// Found height.
        found_height: usize,
    },
    /// A value is NaN or infinite.
    #[error("{what} has a value that is not finite at column {x}, row {y}")]
    NotFinite {
        /// The raster with this value.
        what: &'static str,
        /// Column.
        x: usize,
        /// Row.
        y: usize,
    },
    /// The image has too few pixels for the measure.
    #[error("{measure} needs at least {least}x{least} pixels; the image has {width}x{height}")]
    TooSmall {
        /// The measure.
        measure: &'static str,
        /// Smallest side.
        least: usize,
        /// Width found.
        width: usize,
        /// Height found.
        height: usize,
    },
    /// There is no difference: an error of zero has no finite PSNR.
    #[error("the images are equal in every pixel that counts, so their PSNR is not finite")]
    Equal,
    /// The mask leaves no pixel.
    #[error("the mask leaves no pixel: masks are white (1) where pixels count and black (0) elsewhere")]
    NothingCounts,
    /// The mask leaves pixels, but no whole window.
    #[error("the mask leaves no whole window of {side}x{side} pixels for {measure}")]
    NoWindow {
        /// The measure.
        measure: &'static str,
        /// Side of its windows.
        side: usize,
    },
    /// The photograph has too few straight step edges.
    #[error("the photograph has {found} of the {least} straight step edges that a width needs")]
    FewEdges {
        /// Edges found.
        found: usize,
        /// Edges needed.
        least: usize,
    },
    /// The two views show different things.
    #[error("the two views see nothing in common")]
    NothingInCommon,
}

/// Fails unless `found` has the size of its image.
pub(crate) fn same_size<T, U, const C: usize, const D: usize>(
    what: &'static str,
    image: &Raster<T, C>,
    found: &Raster<U, D>,
) -> Result<(), MetricError> {
    let (width, height) = (image.width(), image.height());
    let (found_width, found_height) = (found.width(), found.height());
    if (width, height) == (found_width, found_height) {
        return Ok(());
    }
    Err(MetricError::SizeMismatch { what, width, height, found_width, found_height })
}

/// Fails at the first value that is not finite.
pub(crate) fn finite<const C: usize>(what: &'static str, image: &Raster<f32, C>) -> Result<(), MetricError> {
    // Folding over blocks vectorises and a search does not, so the search runs only if there is something
    // to find.
    let suspicious = image.data().chunks(4096).any(|c| c.iter().fold(false, |s, v| s | !v.is_finite()));
    let bad = suspicious.then(|| image.data().iter().position(|v| !v.is_finite())).flatten();
    let Some(p) = bad.map(|i| i % image.pixels()) else { return Ok(()) };
    Err(MetricError::NotFinite { what, x: p % image.width(), y: p / image.width() })
}

/// Fails unless two images have one size with sides of at least `least` pixels, and finite values.
pub(crate) fn comparable(
    measure: &'static str,
    x: &Image,
    y: &Image,
    least: usize,
) -> Result<(), MetricError> {
    same_size("the second image", x, y)?;
    large_enough(measure, x, least)?;
    finite("the first image", x)?;
    finite("the second image", y)
}

/// Fails if a side is shorter than `least`.
pub(crate) fn large_enough<T, const C: usize>(
    measure: &'static str,
    image: &Raster<T, C>,
    least: usize,
) -> Result<(), MetricError> {
    let (width, height) = (image.width(), image.height());
    if width.min(height) >= least {
        return Ok(());
    }
    Err(MetricError::TooSmall { measure, least, width, height })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_place_of_a_bad_value_is_named() {
        let mut image = Image::new(7, 5);
        assert!(finite("the image", &image).is_ok());
        image.set_pixel(3, 2, [0.0, f32::NAN, 0.0]);
        let text = finite("the image", &image).unwrap_err().to_string();
        assert!(text.contains("column 3, row 2"), "{text}");
        image.set_pixel(3, 2, [0.0; 3]);
        image.set_pixel(6, 4, [f32::INFINITY, 0.0, 0.0]);
        assert!(finite("the image", &image).is_err());
        assert!(same_size("b", &image, &Image::new(5, 7)).unwrap_err().to_string().contains("5x7"));
        assert!(large_enough("SSIM", &image, 11).is_err());
    }
}
