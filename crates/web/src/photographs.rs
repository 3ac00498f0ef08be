//! Photographs small enough to be embedded in a page: JPEG in a data address.

use use3d_capture::Image;
use use3d_io_image::{jpeg_address, shrunk};

use crate::WebError;

/// Long side, pixels.
const SIDE: usize = 480;
const QUALITY: u8 = 80;

/// A photograph as embedded in a page: a JPEG of at most 480 pixels along its longer side, scaled down by
/// whole factors (box means).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Photograph {
    /// A `data:` address.
    pub(crate) address: String,
}

impl Photograph {
    /// Makes it from pixels in the display range; `name` is for the error.
    ///
    /// # Errors
    /// Fails for pixels that JPEG cannot store.
    pub fn new(name: &str, photograph: &Image) -> Result<Self, WebError> {
        let address = jpeg_address(&shrunk(photograph, SIDE), QUALITY);
        address
            .map(|address| Self { address })
            .map_err(|source| WebError::Photograph { name: name.into(), source })
    }
}
