//! Writes PNG files: display range, clamped, `floor(255 x + 0.5)`.

use std::path::Path;

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use use3d_capture::{Image, Image8, Map, Pixels, Raster};
use use3d_files::write_atomically;

use crate::error::ImageError;

/// Writes samples that have the size of a raster.
fn write<T, const C: usize>(
    path: &Path,
    like: &Raster<T, C>,
    bytes: &[u8],
    color: ExtendedColorType,
) -> Result<(), ImageError> {
    let fail = |reason: &str| ImageError::write(path, reason);
    let side = |n: usize| u32::try_from(n).map_err(|_| fail(&format!("a side of {n} pixels")));
    let (width, height) = (side(like.width())?, side(like.height())?);
    if width == 0 || height == 0 {
        return Err(fail("the image has no pixels"));
    }
    write_atomically(path, |writer| {
        PngEncoder::new_with_quality(writer, CompressionType::Fast, FilterType::Adaptive)
            .write_image(bytes, width, height, color)
            .map_err(std::io::Error::other)
    })
    .map_err(|e| ImageError::write(path, e))
}

/// 16-bit samples in the byte order that the encoder expects.
fn native_bytes(samples: &[u16]) -> Vec<u8> {
    samples.iter().flat_map(|v| v.to_ne_bytes()).collect()
}

/// Writes an 8-bit RGB PNG.
pub fn write_png(path: &Path, image: &Image) -> Result<(), ImageError> {
    write_png8(path, &image.to_8bit())
}

/// Writes an 8-bit RGB PNG of 8-bit pixels.
pub fn write_png8(path: &Path, image: &Image8) -> Result<(), ImageError> {
    write(path, image, &image.to_interleaved(), ExtendedColorType::Rgb8)
}

/// Writes an RGB PNG of 16-bit pixels, full scale 65535.
pub fn write_png16(path: &Path, image: &Raster<u16, 3>) -> Result<(), ImageError> {
    write(path, image, &native_bytes(&image.to_interleaved()), ExtendedColorType::Rgb16)
}

/// Writes pixels in their own precision: 8- or 16-bit.
pub fn write_png_pixels(path: &Path, pixels: &Pixels) -> Result<(), ImageError> {
    match pixels {
        Pixels::Eight(p) => write_png8(path, p),
        Pixels::Sixteen(p) => write_png16(path, p),
    }
}

/// Writes a map in `[0, 1]` as an 8-bit grey PNG.
pub fn write_png_map(path: &Path, map: &Map) -> Result<(), ImageError> {
    let bytes = map.map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5).floor() as u8).into_data();
    write(path, map, &bytes, ExtendedColorType::L8)
}

/// Writes a map in `[0, 1]` as a 16-bit grey PNG.
pub fn write_png_map16(path: &Path, map: &Map) -> Result<(), ImageError> {
    let values = map.map(|v| (v.clamp(0.0, 1.0) * 65535.0 + 0.5).floor() as u16).into_data();
    write(path, map, &native_bytes(&values), ExtendedColorType::L16)
}
