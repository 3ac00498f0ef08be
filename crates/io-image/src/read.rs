//! Reads image files: the format from the first bytes, the size from the header, then all samples.
//!
//! EXIF orientation is not applied: COLMAP works on the pixels as stored, and so must everything that uses
//! its poses.

use std::borrow::Cow;
use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek};
use std::path::Path;

use image::{DynamicImage, ImageDecoder, ImageFormat, ImageReader};
use tiff::decoder::DecodingResult;
use use3d_capture::{Image, Map, Pixels};

use crate::byte_source::ByteSource;
use crate::decoded::{Decoded, Samples};
use crate::error::{FileFormat, ImageError};
use crate::limits::{MAX_PIXELS, check_size};
use crate::{color_space, exr_file, jpeg, npy, png_file};

/// The properties that a header gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageInfo {
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// The format, by the file's first bytes.
    pub format: FileFormat,
    /// True if there is an alpha channel.
    pub alpha: bool,
}

fn open_error(path: &Path) -> impl Fn(std::io::Error) -> ImageError + '_ {
    |source| ImageError::Open { path: path.to_path_buf(), source }
}

/// The format that the first bytes belong to.
fn detect(start: &[u8]) -> Option<FileFormat> {
    const SIGNATURES: [(&[u8], FileFormat); 8] = [
        (b"\x89PNG\r\n\x1a\n", FileFormat::Png),
        (b"\xFF\xD8\xFF", FileFormat::Jpeg),
        (b"II*\0", FileFormat::Tiff),
        (b"MM\0*", FileFormat::Tiff),
        (b"II+\0", FileFormat::Tiff),
        (b"MM\0+", FileFormat::Tiff),
        (b"\x76\x2f\x31\x01", FileFormat::Exr),
        (b"\x93NUMPY", FileFormat::Npy),
    ];
    SIGNATURES.iter().find(|(s, _)| start.starts_with(s)).map(|&(_, f)| f)
}

/// Size, format and alpha from the header; the samples are not read.
pub fn image_info(path: &Path) -> Result<ImageInfo, ImageError> {
    let file = File::open(path).map_err(open_error(path))?;
    let length = file.metadata().map_err(open_error(path))?.len();
    info(&mut BufReader::new(file), length, path)
}

/// Width and height from the header.
pub fn image_size(path: &Path) -> Result<(usize, usize), ImageError> {
    image_info(path).map(|i| (i.width, i.height))
}

/// Like [`image_info`], for a file in memory; `path` is only for messages.
pub fn info_of_bytes(bytes: &[u8], path: &Path) -> Result<ImageInfo, ImageError> {
    info(&mut Cursor::new(bytes), bytes.len() as u64, path)
}

pub(crate) fn info(
    mut reader: &mut dyn ByteSource,
    length: u64,
    path: &Path,
) -> Result<ImageInfo, ImageError> {
    let start = reader.fill_buf().map_err(open_error(path))?;
    if start.is_empty() {
        return Err(ImageError::Empty { path: path.to_path_buf() });
    }
    let format = detect(start).ok_or_else(|| ImageError::UnknownFormat { path: path.to_path_buf() })?;
    let (width, height, bytes_per_pixel, alpha) = match format {
        FileFormat::Exr => {
            let (w, h, names, bytes) = exr_file::header(reader, path)?;
            let picked = exr_file::pick(&names, path)?;
            (w, h, bytes as u64, picked.len() == 4)
        }
        FileFormat::Npy => {
            let header = npy::header(&mut reader, path)?;
            let (w, h, c) = npy::dimensions(&header, path)?;
            (w, h, c * npy::element_size(&header), c % 2 == 0)
        }
        FileFormat::Jpeg => {
            let frame = jpeg::frame(&mut reader).map_err(|e| ImageError::decode(path, format, e))?;
            (frame.width, frame.height, 3, false)
        }
        FileFormat::Png => {
            let head = png_file::header(&mut reader).map_err(|e| ImageError::decode(path, format, e))?;
            (head.width, head.height, head.bytes_per_pixel, head.alpha)
        }
        FileFormat::Tiff => tiff_header(reader, path)?,
    };
    let (width, height) = check_size(path, format, width, height, bytes_per_pixel, length)?;
    Ok(ImageInfo { width, height, format, alpha })
}

/// Memory that a header alone may use, bytes: for tables of strips, not metadata.
const HEADER_ALLOWANCE: u64 = 64 << 20;

/// Limits for the decoders that support them, for an image with this number of pixels (0: only its header).
/// This crate's own limits are checked before.
fn decoder_limits(pixels: u64) -> image::Limits {
    let mut limits = image::Limits::no_limits();
    limits.max_image_width = Some(1 << 24);
    limits.max_image_height = Some(1 << 24);
    limits.max_alloc = Some(pixels.min(MAX_PIXELS) * 16 + HEADER_ALLOWANCE);
    limits
}

fn photo_reader(
    reader: &mut dyn ByteSource,
    format: FileFormat,
    pixels: u64,
) -> ImageReader<&mut dyn ByteSource> {
    let format = match format {
        FileFormat::Png => ImageFormat::Png,
        FileFormat::Jpeg => ImageFormat::Jpeg,
        _ => ImageFormat::Tiff,
    };
    let mut reader = ImageReader::with_format(reader, format);
    reader.limits(decoder_limits(pixels));
    reader
}

/// Width, height, bytes per pixel and alpha of a TIFF.
fn tiff_header(reader: &mut dyn ByteSource, path: &Path) -> Result<(u64, u64, u64, bool), ImageError> {
    let format = FileFormat::Tiff;
    if let Some((width, height)) = float_tiff_size(reader, path)? {
        return Ok((width, height, 8, false));
    }
    let decoder =
        photo_reader(reader, format, 0).into_decoder().map_err(|e| ImageError::decode(path, format, e))?;
    let (width, height) = decoder.dimensions();
    let color = decoder.color_type();
    Ok((u64::from(width), u64::from(height), u64::from(color.bytes_per_pixel()), color.has_alpha()))
}

/// The size of a one-channel TIFF of floats or wide integers, which `image` does not decode; `None` for other
/// TIFFs. The reader is rewound.
fn float_tiff_size(reader: &mut dyn ByteSource, path: &Path) -> Result<Option<(u64, u64)>, ImageError> {
    let fail = |e: tiff::TiffError| ImageError::decode(path, FileFormat::Tiff, e);
    let mut decoder = tiff::decoder::Decoder::new(&mut *reader).map_err(fail)?;
    let (width, height) = decoder.dimensions().map_err(fail)?;
    let float = |d: &mut tiff::decoder::Decoder<_>| {
        let formats = d.find_tag_unsigned_vec::<u16>(tiff::tags::Tag::SampleFormat);
        matches!(formats, Ok(Some(f)) if f.first() == Some(&3))
    };
    let ours = match decoder.colortype().map_err(fail)? {
        tiff::ColorType::Gray(32 | 64) => true,
        tiff::ColorType::Gray(16) => float(&mut decoder),
        _ => false,
    };
    drop(decoder);
    reader.rewind().map_err(open_error(path))?;
    Ok(ours.then_some((u64::from(width), u64::from(height))))
}

fn decode_float_tiff(bytes: &[u8], width: usize, height: usize, path: &Path) -> Result<Decoded, ImageError> {
    let fail = |e: &dyn std::fmt::Display| ImageError::decode(path, FileFormat::Tiff, e);
    let mut limits = tiff::decoder::Limits::default();
    limits.decoding_buffer_size = width * height * 8;
    limits.intermediate_buffer_size = width * height * 8 + (1 << 20);
    let mut cursor = Cursor::new(bytes);
    let source: &mut dyn ByteSource = &mut cursor;
    let mut decoder = tiff::decoder::Decoder::new(source).map_err(|e| fail(&e))?.with_limits(limits);
    let samples: Vec<f32> = match decoder.read_image().map_err(|e| fail(&e))? {
        DecodingResult::F32(v) => v,
        DecodingResult::F64(v) => v.into_iter().map(|x| x as f32).collect(),
        DecodingResult::F16(v) => v.into_iter().map(f32::from).collect(),
        DecodingResult::U32(v) => v.into_iter().map(|x| x as f32).collect(),
        DecodingResult::I32(v) => v.into_iter().map(|x| x as f32).collect(),
        DecodingResult::U64(v) => v.into_iter().map(|x| x as f32).collect(),
        DecodingResult::I64(v) => v.into_iter().map(|x| x as f32).collect(),
        _ => return Err(fail(&"its samples differ from what its header says")),
    };
    if samples.len() != width * height {
        return Err(fail(&"it holds fewer samples than its header says"));
    }
    Ok(Decoded { width, height, channels: 1, samples: Samples::Float(samples) })
}

/// Decodes a JPEG without its end marker. Its picture is complete if further data change nothing.
fn without_end(bytes: &[u8], frame: jpeg::FrameHeader, path: &Path) -> Result<Decoded, ImageError> {
    let with = |more: &[u8]| decode(&[bytes, more, b"\xFF\xD9"].concat(), path);
    let whole = frame.one_scan.then(|| with(&[])).transpose()?;
    match whole.filter(|whole| with(&[0x5A; 256]).is_ok_and(|other| other == *whole)) {
        Some(whole) => Ok(whole),
        None => {
            let reason = "it ends before its end marker, so the lower part of the picture is missing";
            Err(ImageError::decode(path, FileFormat::Jpeg, reason))
        }
    }
}

/// Decodes a file in memory; `path` is only for messages.
pub fn decode(bytes: &[u8], path: &Path) -> Result<Decoded, ImageError> {
    let ImageInfo { width, height, format, .. } = info_of_bytes(bytes, path)?;
    let fail = |reason: String| ImageError::decode(path, format, reason);
    match format {
        FileFormat::Exr => return exr_file::decode(bytes, path),
        FileFormat::Npy => return npy::decode(bytes, path),
        FileFormat::Jpeg => {
            let (frame, ended) = jpeg::ended(bytes).map_err(|e| fail(e.to_string()))?;
            if !ended {
                return without_end(bytes, frame, path);
            }
            if !matches!(frame.components, 1 | 3 | 4) {
                return Err(fail(format!("it has {} components", frame.components)));
            }
        }
        FileFormat::Tiff if float_tiff_size(&mut Cursor::new(bytes), path)?.is_some() => {
            return decode_float_tiff(bytes, width, height, path);
        }
        FileFormat::Png | FileFormat::Tiff => {}
    }
    let pixels =
        if format == FileFormat::Png { png_file::without_metadata(bytes) } else { Cow::Borrowed(bytes) };
    let mut cursor = Cursor::new(pixels.as_ref());
    let reader = photo_reader(&mut cursor, format, (width * height) as u64);
    let image = reader.decode().map_err(|e| fail(e.to_string()))?;
    let (width, height) = (image.width() as usize, image.height() as usize);
    let channels = usize::from(image.color().channel_count());
    let samples = match image {
        DynamicImage::ImageLuma8(b) => Samples::Eight(b.into_raw()),
        DynamicImage::ImageLumaA8(b) => Samples::Eight(b.into_raw()),
        DynamicImage::ImageRgb8(b) => Samples::Eight(b.into_raw()),
        DynamicImage::ImageRgba8(b) => Samples::Eight(b.into_raw()),
        DynamicImage::ImageLuma16(b) => Samples::Sixteen(b.into_raw()),
        DynamicImage::ImageLumaA16(b) => Samples::Sixteen(b.into_raw()),
        DynamicImage::ImageRgb16(b) => Samples::Sixteen(b.into_raw()),
        DynamicImage::ImageRgba16(b) => Samples::Sixteen(b.into_raw()),
        DynamicImage::ImageRgb32F(b) => Samples::Float(b.into_raw()),
        DynamicImage::ImageRgba32F(b) => Samples::Float(b.into_raw()),
        _ => return Err(fail("its pixel type is not supported".into())),
    };
    Ok(Decoded { width, height, channels, samples })
}

/// The bytes of a whole file and its format. The header is read first: a file that is refused for its size
/// is not read into memory.
fn bytes_of(path: &Path) -> Result<(Vec<u8>, FileFormat), ImageError> {
    let file = File::open(path).map_err(open_error(path))?;
    let length = file.metadata().map_err(open_error(path))?.len();
    let mut reader = BufReader::new(file);
    let format = info(&mut reader, length, path)?.format;
    let mut bytes = Vec::new();
    // A file may be longer than the memory.
    let no_room = |_| open_error(path)(std::io::ErrorKind::OutOfMemory.into());
    bytes.try_reserve_exact(usize::try_from(length).unwrap_or(usize::MAX)).map_err(no_room)?;
    reader.rewind().and_then(|()| reader.take(length).read_to_end(&mut bytes)).map_err(open_error(path))?;
    Ok((bytes, format))
}

/// Reads a whole file into samples.
pub fn read(path: &Path) -> Result<Decoded, ImageError> {
    decode(&bytes_of(path)?.0, path)
}

/// Reads a whole file into samples whose colours are sRGB.
fn read_colors(path: &Path) -> Result<Decoded, ImageError> {
    let (bytes, format) = bytes_of(path)?;
    let mut decoded = decode(&bytes, path)?;
    color_space::convert(&bytes, format, &mut decoded);
    Ok(decoded)
}

/// Reads a picture in display range `[0, 1]` (float files keep their values); grey becomes RGB, alpha is
/// dropped.
pub fn read_image(path: &Path) -> Result<Image, ImageError> {
    read_colors(path).map(|d| d.to_image())
}

/// Reads a picture in the form that a training loop keeps: 8-bit files stay 8-bit, all others become 16-bit.
pub fn read_pixels(path: &Path) -> Result<Pixels, ImageError> {
    read_colors(path).map(|d| d.to_pixels())
}

/// Like [`read_pixels`], with the alpha channel, if there is one, as a weight in `[0, 1]`.
pub fn read_pixels_with_alpha(path: &Path) -> Result<(Pixels, Option<Map>), ImageError> {
    read_colors(path).map(|d| (d.to_pixels(), d.alpha()))
}

/// Reads one channel: a mask, a depth, a weight. It is the grey value or the mean of RGB; 8- and 16-bit
/// values are divided by their full scale, floats are kept as stored. Values that are not finite become 0,
/// which means "unknown" in every map of this program.
pub fn read_map(path: &Path) -> Result<Map, ImageError> {
    let mut map = read(path)?.to_map();
    map.data_mut().iter_mut().filter(|v| !v.is_finite()).for_each(|v| *v = 0.0);
    Ok(map)
}
