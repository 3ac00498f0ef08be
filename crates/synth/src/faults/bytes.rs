//! Faults of the files of photographs: what a file says about its pixels, and files that cannot be read.

use std::fs::File;
use std::io::BufWriter;
use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::codecs::tiff::TiffEncoder;
use image::{ExtendedColorType, ImageBuffer, ImageEncoder, Rgb, RgbImage};
use moxcms::{ColorProfile, Layout, TransformOptions};
use use3d_capture::Image;
use use3d_io_image::write_exr;
use use3d_numerics::math;

use super::folder::{Done, Spoiler, pixels_error};
use crate::error::SynthError;

/// The statements of a file about its pixels: a colour profile and EXIF data.
#[derive(Clone, Default)]
struct Said {
    profile: Option<Vec<u8>>,
    exif: Option<Vec<u8>>,
}

fn encode(mut encoder: impl ImageEncoder, picture: &RgbImage, said: Said) -> image::ImageResult<()> {
    use image::ImageError::Unsupported;
    said.profile.map_or(Ok(()), |profile| encoder.set_icc_profile(profile)).map_err(Unsupported)?;
    said.exif.map_or(Ok(()), |exif| encoder.set_exif_metadata(exif)).map_err(Unsupported)?;
    let (w, h) = picture.dimensions();
    encoder.write_image(picture.as_raw(), w, h, ExtendedColorType::Rgb8)
}

/// Writes a photograph in the format of its name: JPEG, TIFF or PNG.
fn save(path: &Path, picture: &RgbImage, said: Said) -> Done {
    let file = BufWriter::new(File::create(path).map_err(SynthError::io(path))?);
    let saved = match path.extension().and_then(|e| e.to_str()) {
        Some("jpg") => encode(JpegEncoder::new_with_quality(file, 97), picture, said),
        Some("tif") => encode(TiffEncoder::new(file), picture, said),
        _ => encode(PngEncoder::new(file), picture, said),
    };
    saved.map_err(pixels_error(path))
}

/// Writes every photograph in another format with a name of its own, and renames it in the model.
fn rewrite(s: &Spoiler<'_>, extension: &str, write: impl Fn(usize, &Path, &RgbImage) -> Done) -> Done {
    for (i, path) in s.photographs()?.iter().enumerate() {
        let picture = s.photograph(path)?;
        std::fs::remove_file(path).map_err(SynthError::io(path))?;
        write(i, &path.with_extension(extension), &picture)?;
    }
    s.rename_in_model(|_, name| format!("{}.{extension}", use3d_capture::stem(name)))
}

/// Writes the photographs as JPEG files with EXIF data.
pub(super) fn with_exif(s: &Spoiler<'_>, exif: impl Fn(usize) -> Vec<u8>) -> Done {
    rewrite(s, "jpg", |i, path, picture| save(path, picture, Said { exif: Some(exif(i)), ..Said::default() }))
}

/// The date and time in a profile: year, month, day, hour, minute, second.
const MADE: [u16; 6] = [2026, 1, 1, 0, 0, 0];

/// Converts the photographs to the colours of a profile, which their files name.
fn in_profile(s: &Spoiler<'_>, profile: &ColorProfile, extension: &str) -> Done {
    let failed = |e: moxcms::CmsError| SynthError::io(s.dir)(std::io::Error::other(e));
    let (rgb, options) = (Layout::Rgb, TransformOptions::default());
    let convert = ColorProfile::new_srgb().create_transform_8bit(rgb, profile, rgb, options);
    let (convert, mut bytes) = (convert.map_err(failed)?, profile.encode().map_err(failed)?);
    // The header has the time of writing. Equal captures must have equal bytes.
    bytes[24..36].copy_from_slice(&MADE.map(u16::to_be_bytes).concat());
    rewrite(s, extension, |_, path, picture| {
        let mut out = picture.clone();
        convert.transform(picture.as_raw(), &mut out).map_err(failed)?;
        save(path, &out, Said { profile: Some(bytes.clone()), exif: None })
    })
}

pub(super) fn adobe_rgb(s: &Spoiler<'_>) -> Done {
    in_profile(s, &ColorProfile::new_adobe_rgb(), "tif")
}

pub(super) fn pro_photo(s: &Spoiler<'_>) -> Done {
    in_profile(s, &ColorProfile::new_pro_photo_rgb(), "png")
}

pub(super) fn display_p3(s: &Spoiler<'_>) -> Done {
    in_profile(s, &ColorProfile::new_display_p3(), "jpg")
}

/// EXIF data with an orientation and nothing else.
pub(super) fn orientation(value: u8) -> Vec<u8> {
    let mut exif = b"II*\0\x08\0\0\0\x01\0".to_vec();
    exif.extend([0x12, 0x01, 3, 0, 1, 0, 0, 0, value, 0, 0, 0]);
    exif.extend([0; 4]);
    exif
}

/// EXIF data with a GPS position, degrees and metres.
pub(super) fn gps(latitude: f64, longitude: f64, altitude: f64) -> Vec<u8> {
    let mut exif = b"II*\0\x08\0\0\0\x01\0".to_vec();
    let entry = |out: &mut Vec<u8>, tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        out.extend(tag.to_le_bytes());
        out.extend(kind.to_le_bytes());
        out.extend(count.to_le_bytes());
        out.extend(value);
    };
    entry(&mut exif, 0x8825, 4, 1, 26u32.to_le_bytes());
    exif.extend([0; 4]);
    // The directory of GPS begins at byte 26, and its ratios follow at 26 + 2 + 6 * 12 + 4.
    exif.extend(6u16.to_le_bytes());
    let letter = |negative: bool, letters: [u8; 2]| [letters[usize::from(negative)], 0, 0, 0];
    entry(&mut exif, 1, 2, 2, letter(latitude < 0.0, *b"NS"));
    entry(&mut exif, 2, 5, 3, 104u32.to_le_bytes());
    entry(&mut exif, 3, 2, 2, letter(longitude < 0.0, *b"EW"));
    entry(&mut exif, 4, 5, 3, 128u32.to_le_bytes());
    entry(&mut exif, 5, 1, 1, [u8::from(altitude < 0.0), 0, 0, 0]);
    entry(&mut exif, 6, 5, 1, 152u32.to_le_bytes());
    exif.extend([0; 4]);
    let mut ratio = |value: f64, under: u32| {
        exif.extend(((value * f64::from(under)).round() as u32).to_le_bytes());
        exif.extend(under.to_le_bytes());
    };
    for degrees in [latitude.abs(), longitude.abs()] {
        ratio(degrees.floor(), 1);
        ratio((60.0 * degrees.fract()).floor(), 1);
        ratio(60.0 * (60.0 * degrees.fract()).fract(), 100_000);
    }
    ratio(altitude.abs(), 1000);
    exif
}

/// A quarter turn in the EXIF data of photographs that need none.
pub(super) fn turned_tag(s: &Spoiler<'_>) -> Done {
    with_exif(s, |_| orientation(6))
}

/// Photographs stored upside down, with the tag that turns them back.
pub(super) fn upside_down_with_tag(s: &Spoiler<'_>) -> Done {
    s.repaint(1.0, |_, picture| image::imageops::rotate180(&picture))?;
    with_exif(s, |_| orientation(3))
}

/// 16-bit files that use fewer bits.
pub(super) fn few_bits(s: &Spoiler<'_>) -> Done {
    let top = math::exp2(s.strength.min(16.0)) - 1.0;
    rewrite(s, "png", |_, path, picture| {
        let (w, h) = picture.dimensions();
        let deep: ImageBuffer<Rgb<u16>, Vec<u16>> = ImageBuffer::from_fn(w, h, |x, y| {
            Rgb(picture.get_pixel(x, y).0.map(|v| (f64::from(v) / 255.0 * top).round() as u16))
        });
        deep.save(path).map_err(pixels_error(path))
    })
}

/// A display value as linear light.
fn linear(value: u8) -> f32 {
    let v = f64::from(value) / 255.0;
    (if v <= 0.04045 { v / 12.92 } else { math::powf((v + 0.055) / 1.055, 2.4) }) as f32
}

/// EXR files of linear light.
pub(super) fn linear_exr(s: &Spoiler<'_>) -> Done {
    rewrite(s, "exr", |_, path, picture| {
        let (w, h) = picture.dimensions();
        let light: Vec<f32> = picture.as_raw().iter().map(|v| linear(*v)).collect();
        let Some(light) = Image::from_interleaved(w as usize, h as usize, &light) else { return Ok(()) };
        Ok(write_exr(path, &light)?)
    })
}

/// 16-bit PNG files of linear light, which say so (`gAMA` 1.0).
pub(super) fn linear_png(s: &Spoiler<'_>) -> Done {
    rewrite(s, "png", |_, path, picture| {
        let failed = |e: png::EncodingError| SynthError::io(path)(std::io::Error::other(e));
        let file = File::create(path).map_err(SynthError::io(path))?;
        let (w, h) = picture.dimensions();
        let mut encoder = png::Encoder::new(BufWriter::new(file), w, h);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Sixteen);
        encoder.set_source_gamma(png::ScaledFloat::new(1.0));
        let deep = picture.as_raw().iter().map(|v| (65535.0 * linear(*v)).round() as u16);
        let bytes: Vec<u8> = deep.flat_map(u16::to_be_bytes).collect();
        encoder.write_header().and_then(|mut w| w.write_image_data(&bytes)).map_err(failed)
    })
}

/// Changes the file of the photograph in the middle.
fn one_file(s: &Spoiler<'_>, change: impl FnOnce(&mut Vec<u8>)) -> Done {
    let files = s.photographs()?;
    files.get(files.len() / 2).map_or(Ok(()), |path| s.edit(path, change))
}

pub(super) fn cut_off(s: &Spoiler<'_>) -> Done {
    rewrite(s, "jpg", |_, path, picture| save(path, picture, Said::default()))?;
    one_file(s, |bytes| bytes.truncate(bytes.len() * 6 / 10))
}

/// JPEG files that lack the mark of their end, and nothing else.
pub(super) fn no_end(s: &Spoiler<'_>) -> Done {
    rewrite(s, "jpg", |_, path, picture| {
        save(path, picture, Said::default())?;
        s.edit(path, |bytes| bytes.truncate(bytes.len() - 2))
    })
}

pub(super) fn empty_file(s: &Spoiler<'_>) -> Done {
    one_file(s, Vec::clear)
}

/// The head of a HEIC file under the name of a photograph.
pub(super) fn other_format(s: &Spoiler<'_>) -> Done {
    one_file(s, |bytes| *bytes = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic".repeat(40))
}

pub(super) fn missing_file(s: &Spoiler<'_>) -> Done {
    let files = s.photographs()?;
    let Some(path) = files.get(files.len() / 2) else { return Ok(()) };
    std::fs::remove_file(path).map_err(SynthError::io(path))
}
