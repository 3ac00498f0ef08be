//! Pictures inside pages: small, as JPEG, in a data address. They are encoded in memory, never as files of
//! their own.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use use3d_capture::{Image, Image8};

/// A picture that cannot be stored as JPEG.
#[derive(Debug, thiserror::Error)]
#[error("it cannot be written as a JPEG: {0}")]
pub struct JpegError(#[from] image::ImageError);

/// The `data:` address of an image, as a JPEG with a quality from 1 to 100; the bytes are the same on every
/// processor.
///
/// # Errors
/// Fails for an image without pixels, or with a side above 65,535.
pub fn jpeg_address(image: &Image8, quality: u8) -> Result<String, JpegError> {
    let (width, height) = (image.width() as u32, image.height() as u32);
    let (pixels, mut bytes) = (image.to_interleaved(), Vec::new());
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, quality);
    encoder.encode(&pixels, width, height, ExtendedColorType::Rgb8)?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(bytes)))
}

/// An image (clamped to the display range) in 8 bits, shrunk by box means by the smallest whole factor that
/// makes its longer side at most `side`.
pub fn shrunk(image: &Image, side: usize) -> Image8 {
    let (w, h) = (image.width(), image.height());
    let factor = w.max(h).div_ceil(side.max(1)).max(1);
    if factor == 1 {
        return image.to_8bit();
    }
    let (sw, sh) = ((w / factor).max(1), (h / factor).max(1));
    let mut small = Image::new(sw, sh);
    for y in 0..sh {
        for x in 0..sw {
            let mut sum = [0.0; 3];
            let (ys, xs) = (y * factor..((y + 1) * factor).min(h), x * factor..((x + 1) * factor).min(w));
            let count = (ys.len() * xs.len()).max(1) as f32;
            for v in ys {
                for u in xs.clone() {
                    let pixel = image.pixel(u, v);
                    (0..3).for_each(|c| sum[c] += pixel[c].clamp(0.0, 1.0));
                }
            }
            small.set_pixel(x, y, sum.map(|s| s / count));
        }
    }
    small.to_8bit()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_again_and_what_cannot_be_is_said() {
        let mut image = Image::new(40, 24);
        for y in 0..24 {
            for x in 0..40 {
                image.set_pixel(x, y, [x as f32 / 40.0, y as f32 / 24.0, 0.25]);
            }
        }
        let eight = image.to_8bit();
        let address = jpeg_address(&eight, 90).unwrap();
        let bytes = STANDARD.decode(address.strip_prefix("data:image/jpeg;base64,").unwrap()).unwrap();
        let back = image::load_from_memory(&bytes).unwrap().to_rgb8();
        assert_eq!(back.dimensions(), (40, 24));
        let worst = back.as_raw().iter().zip(eight.to_interleaved()).map(|(a, b)| a.abs_diff(b)).max();
        assert!(worst <= Some(16), "{worst:?}");
        for (width, height) in [(0, 0), (70_000, 1)] {
            let said = jpeg_address(&Image8::new(width, height), 90).unwrap_err().to_string();
            assert!(said.contains("JPEG"), "{said}");
        }
    }

    #[test]
    fn boxes_are_means_and_nothing_small_is_touched() {
        let mut image = Image::filled(4, 2, 0.2);
        image.set_pixel(0, 0, [1.0, 1.4, -1.0]);
        let small = shrunk(&image, 2);
        assert_eq!((small.width(), small.height()), (2, 1));
        assert_eq!(small.pixel(0, 0), [0.4, 0.4, 0.15].map(|v: f32| (255.0 * v).round() as u8));
        assert_eq!(shrunk(&image, 4), image.to_8bit());
    }
}
