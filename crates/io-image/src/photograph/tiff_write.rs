//! Writes a TIFF photograph: strips of new pixels, then the values of the tags, then the directories.
//!
//! ```text
//! header, strips, [maker notes at their old place], values and directories; the first directory is the last
//! ```
//!
//! The pixels are RGB or RGB and alpha, side by side, with the depth, order of bytes and compression of the
//! original. The predictor stores differences: of whole numbers to the left neighbour (2), of floats between
//! bytes of equal weight (3). Everything is written in one pass, except the header's pointer.

use std::io::{self, Seek, SeekFrom, Write};

use tiff::encoder::compression::{CompressionAlgorithm, Deflate, DeflateLevel, Lzw, Packbits};

use super::history::{self, IMAGE_HISTORY, SOFTWARE};
use super::interleaved::SampleRows;
use super::tiff_tags::{EXIF, GPS, INTEROPERABILITY, Packing, TiffTags};
use crate::decoded::Samples;
use crate::tiff_structure::TagValue;

/// Bytes of a strip before compression, about: one is in memory at a time.
const STRIP: usize = 1 << 18;

/// A file that can be written and corrected.
pub(crate) trait WriteSeek: Write + Seek {}

impl<T: Write + Seek> WriteSeek for T {}

/// A TIFF that is being written.
struct TiffFile<'a> {
    out: &'a mut dyn WriteSeek,
    at: u64,
    big: bool,
    wide: bool,
    /// Bytes that must stand at a place of their own, until they are written.
    fixed: Option<(u64, &'a [u8])>,
}

impl TiffFile<'_> {
    fn number(&self, value: u64, size: usize) -> io::Result<Vec<u8>> {
        if size < 8 && value >> (8 * size) != 0 {
            return Err(io::Error::other("a TIFF holds at most 4 GiB"));
        }
        Ok(if self.big {
            value.to_be_bytes()[8 - size..].to_vec()
        } else {
            value.to_le_bytes()[..size].to_vec()
        })
    }

    /// Bytes of a place.
    fn place_size(&self) -> usize {
        if self.wide { 8 } else { 4 }
    }

    fn put(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.at += bytes.len() as u64;
        self.out.write_all(bytes)
    }

    /// Writes zeros up to the fixed bytes, then these.
    fn put_fixed(&mut self) -> io::Result<()> {
        let Some((place, bytes)) = self.fixed.take() else { return Ok(()) };
        while self.at < place {
            let gap = (place - self.at).min(1 << 16) as usize;
            self.put(&vec![0; gap])?;
        }
        self.put(bytes)
    }

    /// Writes a block at an even place, around the fixed bytes, and returns its place.
    fn block(&mut self, bytes: &[u8]) -> io::Result<u64> {
        if self.fixed.is_some_and(|(place, _)| self.at + 1 + bytes.len() as u64 > place) {
            self.put_fixed()?;
        }
        if self.at % 2 == 1 {
            self.put(&[0])?;
        }
        let place = self.at;
        self.put(bytes)?;
        Ok(place)
    }

    /// Writes the values of the tags that need it, then their directory; returns its place.
    fn directory(&mut self, tags: &mut [TagValue]) -> io::Result<u64> {
        tags.sort_by_key(|t| t.tag);
        let inline = self.place_size();
        let mut body = self.number(tags.len() as u64, if self.wide { 8 } else { 2 })?;
        for tag in tags.iter() {
            body.extend(self.number(u64::from(tag.tag), 2)?);
            body.extend(self.number(u64::from(tag.kind), 2)?);
            body.extend(self.number(tag.count, inline)?);
            if tag.value.len() <= inline {
                let end = body.len() + inline;
                body.extend(&tag.value);
                body.resize(end, 0);
            } else {
                let place = match tag.place {
                    Some(place) => place,
                    None => self.block(&tag.value)?,
                };
                body.extend(self.number(place, inline)?);
            }
        }
        body.resize(body.len() + inline, 0); // no further directory
        self.block(&body)
    }

    /// A tag of whole numbers of 2, 4 or 8 bytes each.
    fn numbers(&self, tag: u16, size: usize, values: &[u64]) -> io::Result<TagValue> {
        let mut value = Vec::with_capacity(values.len() * size);
        for v in values {
            value.extend(self.number(*v, size)?);
        }
        let kind = match size {
            2 => 3,
            4 => 4,
            _ => 16,
        };
        Ok(TagValue { tag, kind, count: values.len() as u64, value, place: None })
    }

    /// A tag that points at a directory.
    fn pointer(&self, tag: u16, place: u64) -> io::Result<TagValue> {
        self.numbers(tag, self.place_size(), &[place])
    }
}

/// Replaces whole numbers of `N` bytes by their differences to the pixel on the left.
fn differences<const N: usize>(row: &mut [u8], per_pixel: usize, big: bool) {
    let read = |b: &[u8]| b.iter().rev().fold(0u32, |n, v| n << 8 | u32::from(*v));
    for at in (per_pixel * N..row.len()).step_by(N).rev() {
        let (mut here, mut left) = ([0; N], [0; N]);
        here.copy_from_slice(&row[at..at + N]);
        left.copy_from_slice(&row[at - per_pixel * N..at - per_pixel * N + N]);
        if big {
            here.reverse();
            left.reverse();
        }
        let difference = read(&here).wrapping_sub(read(&left)).to_le_bytes();
        here.copy_from_slice(&difference[..N]);
        if big {
            here.reverse();
        }
        row[at..at + N].copy_from_slice(&here);
    }
}

/// Sorts the bytes of floats (most significant first) by weight and stores differences of neighbours.
fn float_differences(row: &mut [u8], per_pixel: usize) {
    let count = row.len() / 4;
    let old = row.to_vec();
    for (i, float) in old.chunks_exact(4).enumerate() {
        (0..4).for_each(|weight| row[weight * count + i] = float[weight]);
    }
    for at in (per_pixel..row.len()).rev() {
        row[at] = row[at].wrapping_sub(row[at - per_pixel]);
    }
}

fn packed(packing: Packing, strip: Vec<u8>) -> io::Result<Vec<u8>> {
    let mut out = Vec::with_capacity(strip.len() / 2);
    match packing {
        Packing::None => return Ok(strip),
        Packing::Lzw => Lzw.write_to(&mut out, &strip)?,
        Packing::Deflate => Deflate::with_level(DeflateLevel::Balanced).write_to(&mut out, &strip)?,
        Packing::PackBits => Packbits.write_to(&mut out, &strip)?,
    };
    Ok(out)
}

/// Writes the strips; returns the rows in each, their places, and their lengths.
fn strips(
    file: &mut TiffFile<'_>,
    tags: &TiffTags,
    rows: &SampleRows<'_>,
) -> io::Result<(u64, Vec<u64>, Vec<u64>)> {
    let (samples, height) = (rows.samples_per_pixel(), rows.height as usize);
    let row_bytes = rows.width as usize * samples * rows.bytes_per_sample();
    let per_strip = (STRIP / row_bytes.max(1)).clamp(1, height);
    let (mut places, mut lengths, mut row) = (Vec::new(), Vec::new(), Vec::new());
    for start in (0..height).step_by(per_strip) {
        let mut strip = Vec::with_capacity(row_bytes * per_strip);
        for y in start..(start + per_strip).min(height) {
            let float = matches!(rows.pixels, Samples::Float(_));
            rows.bytes(y, tags.big || (float && tags.predictor), &mut row);
            match rows.pixels {
                _ if !tags.predictor => {}
                Samples::Eight(_) => differences::<1>(&mut row, samples, tags.big),
                Samples::Sixteen(_) => differences::<2>(&mut row, samples, tags.big),
                Samples::Float(_) => float_differences(&mut row, samples),
            }
            // Runs do not cross rows, by the standard.
            if tags.packing == Packing::PackBits {
                strip.extend(packed(tags.packing, row.clone())?);
            } else {
                strip.extend_from_slice(&row);
            }
        }
        if tags.packing != Packing::PackBits {
            strip = packed(tags.packing, strip)?;
        }
        lengths.push(strip.len() as u64);
        places.push(file.block(&strip)?);
    }
    Ok((per_strip as u64, places, lengths))
}

/// Writes the file: new pixels, all tags, `Software` and the history.
pub(crate) fn write(
    out: &mut dyn WriteSeek,
    tags: &TiffTags,
    rows: &SampleRows<'_>,
    software: &str,
    history: &str,
) -> io::Result<()> {
    let header = if tags.wide { 16 } else { 8 };
    let fixed = tags.exif.iter().find_map(|t| Some((t.place?, t.value.as_slice())));
    let mut file = TiffFile { out, at: 0, big: tags.big, wide: tags.wide, fixed };
    file.put(if tags.big { b"MM" } else { b"II" })?;
    let mut head = file.number(if tags.wide { 43 } else { 42 }, 2)?;
    if tags.wide {
        head.extend(file.number(8, 2)?);
        head.extend([0; 2]);
    }
    head.resize(header as usize - 2, 0); // the first directory's place, corrected at the end
    file.put(&head)?;
    let (per_strip, places, lengths) = strips(&mut file, tags, rows)?;
    file.put_fixed()?;

    let mut first = tags.first.clone();
    let old = |tag: u16| tags.first.iter().find(|t| t.tag == tag && t.kind == 2).map(|t| t.value.as_slice());
    let texts = history::values(software, history, old(SOFTWARE), old(IMAGE_HISTORY));
    first.retain(|t| !matches!(t.tag, SOFTWARE | IMAGE_HISTORY));
    for (tag, value) in texts {
        first.push(TagValue { tag, kind: 2, count: value.len() as u64, value, place: None });
    }
    let samples = rows.samples_per_pixel();
    let bits = vec![8 * rows.bytes_per_sample() as u64; samples];
    let code = match tags.packing {
        Packing::None => 1,
        Packing::Lzw => 5,
        Packing::Deflate => 8,
        Packing::PackBits => 32773,
    };
    let float = matches!(rows.pixels, Samples::Float(_));
    let size = file.place_size();
    first.extend([
        file.numbers(256, 4, &[u64::from(rows.width)])?,
        file.numbers(257, 4, &[u64::from(rows.height)])?,
        file.numbers(258, 2, &bits)?,
        file.numbers(259, 2, &[code])?,
        file.numbers(262, 2, &[2])?,
        file.numbers(273, size, &places)?,
        file.numbers(277, 2, &[samples as u64])?,
        file.numbers(278, 4, &[per_strip])?,
        file.numbers(279, size, &lengths)?,
        file.numbers(284, 2, &[1])?,
    ]);
    if tags.predictor {
        first.push(file.numbers(317, 2, &[if float { 3 } else { 2 }])?);
    }
    if rows.has_alpha() {
        first.push(file.numbers(338, 2, &[u64::from(tags.extra)])?);
    }
    if float {
        first.push(file.numbers(339, 2, &vec![3; samples])?);
    }
    let mut exif = tags.exif.clone();
    if !tags.interoperability.is_empty() {
        let place = file.directory(&mut tags.interoperability.clone())?;
        exif.push(file.pointer(INTEROPERABILITY, place)?);
    }
    if !exif.is_empty() {
        let place = file.directory(&mut exif)?;
        first.push(file.pointer(EXIF, place)?);
    }
    if !tags.gps.is_empty() {
        let place = file.directory(&mut tags.gps.clone())?;
        first.push(file.pointer(GPS, place)?);
    }
    let place = file.directory(&mut first)?;
    let pointer = file.number(place, size)?;
    file.out.seek(SeekFrom::Start(header - size as u64))?;
    file.out.write_all(&pointer)?;
    file.out.seek(SeekFrom::End(0))?;
    Ok(())
}
