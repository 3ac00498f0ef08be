//! The properties of a photograph that its header gives.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::Path;

use tiff::tags::Tag;

use crate::byte_source::ByteSource;
use crate::color_space::{ColorUse, color_use, states_any};
use crate::cut_off::is_marked_at_the_end;
use crate::error::{FileFormat, ImageError};
use crate::exif::{exif_of_block, exif_of_bytes};
use crate::read::{ImageInfo, info};

/// The properties of a photograph by its header.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PhotographInfo {
    /// Width, pixels, as stored.
    pub width: usize,
    /// Height, pixels, as stored.
    pub height: usize,
    /// The format by the first bytes: JPEG, PNG, TIFF or EXR.
    pub format: FileFormat,
    /// Bits per sample of the file: 8, 16 or 32. Fewer than 8 count as 8, because they are written as 8. 32
    /// are floats; 16 in an EXR are half floats.
    pub bits: u8,
    /// The orientation tag by EXIF or TIFF, 1 to 8; 1 if there is none.
    pub orientation: u16,
    /// True if there is an alpha channel.
    pub alpha: bool,
    /// The length of the file, bytes.
    pub length: u64,
    /// The use of what the file states about its colours.
    pub colors: ColorUse,
}

/// The largest `eXIf` chunk that is read for its orientation.
const LARGEST_EXIF: u32 = 1 << 20;

/// Bits per sample and orientation of a PNG.
fn png(reader: &mut dyn ByteSource) -> std::io::Result<(u8, u16)> {
    let mut start = [0; 8 + 8 + 13 + 4];
    reader.read_exact(&mut start)?;
    let bits = if start[24] == 16 { 16 } else { 8 };
    let mut head = [0; 8];
    while reader.read_exact(&mut head).is_ok() && &head[4..] != b"IEND" {
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]);
        if &head[4..] == b"eXIf" && length <= LARGEST_EXIF {
            let mut body = Vec::new();
            reader.take(u64::from(length)).read_to_end(&mut body)?;
            let block = body.strip_prefix(b"Exif\0\0").unwrap_or(&body);
            return Ok((bits, exif_of_block(block).orientation));
        }
        reader.seek(SeekFrom::Current(i64::from(length) + 4))?;
    }
    Ok((bits, 1))
}

/// Bits per sample and orientation of a TIFF.
fn tiff_file(reader: &mut dyn ByteSource) -> Result<(u8, u16), tiff::TiffError> {
    let mut decoder = tiff::decoder::Decoder::new(reader)?;
    let bits = decoder.find_tag_unsigned_vec::<u16>(Tag::BitsPerSample)?.and_then(|b| b.first().copied());
    let bits = match bits.unwrap_or(1) {
        0..=8 => 8,
        9..=16 => 16,
        _ => 32,
    };
    // An orientation that cannot be read counts as none.
    let orientation = decoder.find_tag_unsigned::<u16>(Tag::Orientation).ok().flatten();
    Ok((bits, orientation.filter(|o| (1..=8).contains(o)).unwrap_or(1)))
}

/// Bits of the colours of an EXR.
fn exr_file(reader: &mut dyn ByteSource) -> exr::error::Result<u8> {
    let meta = exr::meta::MetaData::read_from_buffered(reader, false)?;
    let mut channels = meta.headers.iter().flat_map(|h| &h.channels.list);
    let half = channels.any(|c| c.name.eq("R") && c.sample_type == exr::meta::attribute::SampleType::F16);
    Ok(if half { 16 } else { 32 })
}

/// Size, format, bits, orientation, alpha and colour space of a photograph, from its header. The file is
/// opened once.
///
/// # Errors
/// The file cannot be read, is of no known format, has a header that is damaged or announces an impossible
/// size, or is an NPY array.
pub fn photograph_info(path: &Path) -> Result<PhotographInfo, ImageError> {
    of_file(&mut open(path)?, path)
}

/// True if a photograph of this format states what its colours stand for, also if they are sRGB: by a
/// profile, or by the words of a PNG (`sRGB`, `gAMA`, `cICP`).
///
/// # Errors
/// The file cannot be read.
pub fn states_colors(path: &Path, format: FileFormat) -> Result<bool, ImageError> {
    Ok(states_any(&mut open(path)?, format))
}

/// Like [`photograph_info`], for a photograph that is used afterwards.
///
/// # Errors
/// Those of [`photograph_info`], and those of [`crate::read`] if the file ends too early.
pub fn whole_photograph_info(path: &Path) -> Result<PhotographInfo, ImageError> {
    let mut file = open(path)?;
    let info = of_file(&mut file, path)?;
    let opening = |source| ImageError::Open { path: path.to_path_buf(), source };
    if !is_marked_at_the_end(&mut file, info.format).map_err(opening)? {
        // Only a file without the mark near its end is decoded; the decoder names the reason.
        crate::read(path)?;
    }
    Ok(info)
}

fn open(path: &Path) -> Result<BufReader<File>, ImageError> {
    let file = File::open(path).map_err(|source| ImageError::Open { path: path.to_path_buf(), source })?;
    Ok(BufReader::new(file))
}

fn of_file(reader: &mut BufReader<File>, path: &Path) -> Result<PhotographInfo, ImageError> {
    let open = |source| ImageError::Open { path: path.to_path_buf(), source };
    let length = reader.get_ref().metadata().map_err(open)?.len();
    let ImageInfo { width, height, format, alpha } = info(reader, length, path)?;
    reader.rewind().map_err(open)?;
    let (bits, orientation) = match format {
        FileFormat::Jpeg => {
            let mut head = Vec::new();
            reader.take(crate::exif::HEAD).read_to_end(&mut head).map_err(open)?;
            (8, exif_of_bytes(&head).orientation)
        }
        FileFormat::Png => png(reader).map_err(open)?,
        FileFormat::Tiff => tiff_file(reader).map_err(|e| ImageError::decode(path, format, e))?,
        FileFormat::Exr => (exr_file(reader).map_err(|e| ImageError::decode(path, format, e))?, 1),
        FileFormat::Npy => return Err(super::no_photograph(path)),
    };
    reader.rewind().map_err(open)?;
    let colors = color_use(reader, format);
    Ok(PhotographInfo { width, height, format, bits, orientation, alpha, length, colors })
}
