//! Photographs small enough to stand beside a picture: JPEG in a data address.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use use3d_capture::{Image, Image8};

use crate::WebError;

/// Long side, pixels.
const SIDE: usize = 480;
const QUALITY: u8 = 80;

/// A photograph as it stands in a page: a JPEG of at most 480 pixels along its longer side, scaled down by whole factors (box means).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Photograph {
    /// A `data:` address.
    pub(crate) address: String,
}

impl Photograph {
    /// Of pixels in the display range; `name` is for the error.
    ///
    /// # Errors
    /// Pixels that JPEG cannot hold.
    pub fn new(name: &str, photograph: &Image) -> Result<Self, WebError> {
        Ok(Self { address: address(name, photograph)? })
    }
}

fn address(name: &str, photograph: &Image) -> Result<String, WebError> {
    let small = shrunk(photograph);
    let mut jpeg = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, QUALITY)
        .encode(
            &small.to_interleaved(),
            small.width() as u32,
            small.height() as u32,
            image::ExtendedColorType::Rgb8,
        )
        .map_err(|source| WebError::Photograph { name: name.into(), source })?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)))
}

fn shrunk(image: &Image) -> Image8 {
    let (w, h) = (image.width(), image.height());
    let factor = w.max(h).div_ceil(SIDE).max(1);
    if factor == 1 {
        return image.to_8bit();
    }
    let (sw, sh) = ((w / factor).max(1), (h / factor).max(1));
    let mut small = Image::new(sw, sh);
    for y in 0..sh {
        for x in 0..sw {
            let (ys, xs) = (y * factor..((y + 1) * factor).min(h), x * factor..((x + 1) * factor).min(w));
            let share = 1.0 / (ys.len() * xs.len()).max(1) as f32;
            let mut mean = [0.0; 3];
            for v in ys {
                for u in xs.clone() {
                    let pixel = image.pixel(u, v);
                    (0..3).for_each(|c| mean[c] += share * pixel[c].clamp(0.0, 1.0));
                }
            }
            small.set_pixel(x, y, mean);
        }
    }
    small.to_8bit()
}
