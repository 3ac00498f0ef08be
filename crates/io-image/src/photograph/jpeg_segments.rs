//! A JPEG photograph: its segments besides the pixels, and new pixels between them.
//!
//! A segment is `FF, marker, u16 length, bytes`, before the first scan. Kept as bytes, in their order: EXIF,
//! XMP and its continuation, the parts of an ICC profile, IPTC, comments, and segments of makers. Left out:
//!
//! | segment | reason |
//! |---|---|
//! | tables and frame header | they belong to the old pixels |
//! | `Adobe` (APP14) | it states how the old pixels are coded |
//! | `MPF` (APP2) | it gives the places of further pictures in the old file |
//! | `JFXX` (APP0), and the thumbnail in `JFIF` | they show the old colours |
//! | `JP` (APP11) | content credentials, which sign the old pixels, or a layer to add to them |
//! | ICC profile for grey or CMYK | the new pixels are RGB |
//!
//! New pixels: baseline, quality 95, no chroma subsampling (4:4:4), so the colours of small animals do not
//! bleed. The encoder is that of `image`: `jpeg-encoder` needs less than half of the time, but its bytes
//! depend on the processor.

use std::io::{self, Write};

use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;

use super::exif_block;
use super::history::one_line;
use crate::jpeg::{ICC, segments};

/// Quality of the encoder, 1 to 100.
const QUALITY: u8 = 95;
/// The largest number of bytes in a segment.
const LARGEST: usize = 65_533;
const EXIF: &[u8] = b"Exif\0\0";
/// Start marker and `JFIF` segment, which the encoder writes first.
const ENCODER_HEAD: usize = 20;

/// The segments of a JPEG that are written again.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct JpegTags {
    segments: Vec<(u8, Vec<u8>)>,
    /// The number of the segment with the EXIF data, if it can be rewritten.
    exif: Option<usize>,
    /// True if there is no EXIF data at all, so that some may be added.
    without_exif: bool,
}

/// The colour space of an ICC profile by its header: `RGB `, `GRAY`, `CMYK` …
fn profile_space<'a>(segments: &[(u8, &'a [u8])]) -> Option<&'a [u8]> {
    let first = segments.iter().find(|(m, b)| *m == 0xE2 && b.starts_with(ICC) && b.get(12) == Some(&1))?;
    first.1.get(14 + 16..14 + 20)
}

/// The segment as it is kept, or `None` for one that is left out.
fn kept(marker: u8, body: &[u8], profile: bool) -> Option<Vec<u8>> {
    let leave = match marker {
        0xE0 if body.starts_with(b"JFIF\0") => {
            let mut head = body.get(..14)?.to_vec();
            head[12..].fill(0); // no thumbnail
            return Some(head);
        }
        0xE0 => body.starts_with(b"JFXX\0"),
        0xE2 => body.starts_with(b"MPF\0") || (body.starts_with(ICC) && !profile),
        0xEB => body.starts_with(b"JP"),
        0xEE => body.starts_with(b"Adobe"),
        0xE1..=0xEF | 0xFE => false,
        _ => true,
    };
    (!leave).then(|| body.to_vec())
}

impl JpegTags {
    /// Leaves out the ICC profile.
    pub(crate) fn drop_profile(&mut self) {
        let is_profile = |(marker, body): &(u8, Vec<u8>)| *marker == 0xE2 && body.starts_with(ICC);
        let before = self.segments.iter().take(self.exif.unwrap_or(0)).filter(|s| is_profile(s)).count();
        self.exif = self.exif.map(|at| at - before);
        self.segments.retain(|s| !is_profile(s));
    }

    /// The segments of a JPEG that is known to be whole. `notes` gains a sentence for everything that is left
    /// out and that a user may miss.
    pub(crate) fn of(bytes: &[u8], notes: &mut Vec<String>) -> Self {
        let all = segments(bytes);
        let has = |marker: u8, start: &[u8]| all.iter().any(|(m, b)| *m == marker && b.starts_with(start));
        let space = profile_space(&all);
        let profile = space == Some(b"RGB ");
        if has(0xE2, ICC) && !profile {
            let space =
                space.map_or("unknown colours".into(), |s| String::from_utf8_lossy(s).trim().to_string());
            notes.push(format!("Its ICC profile is for {space}, not for RGB, and was left out."));
        }
        if has(0xE2, b"MPF\0") {
            notes.push("Further pictures in the file (previews, gain maps) were left out.".into());
        }
        if has(0xEB, b"JP") {
            notes.push("Content credentials sign the old pixels and were left out.".into());
        }
        let segments: Vec<(u8, Vec<u8>)> =
            all.iter().filter_map(|(m, b)| Some((*m, kept(*m, b, profile)?))).collect();
        // A second segment continues the first unless it has a header of its own.
        let exif: Vec<usize> = (0..segments.len())
            .filter(|i| segments[*i].0 == 0xE1 && segments[*i].1.starts_with(EXIF))
            .collect();
        let block = |i: usize| &segments[i].1[EXIF.len()..];
        let continued = exif.iter().skip(1).any(|i| !matches!(block(*i).get(..2), Some(b"II" | b"MM")));
        let readable = exif.first().copied().filter(|i| !continued && exif_block::is_readable(block(*i)));
        if !exif.is_empty() && readable.is_none() {
            notes.push("Its EXIF data cannot be read and were copied unchanged.".into());
        }
        Self { exif: readable, without_exif: exif.is_empty(), segments }
    }

    /// Writes the file: `pixels` are RGB, `width * height * 3` bytes.
    pub(crate) fn write(
        &self,
        out: &mut dyn Write,
        (width, height): (u32, u32),
        pixels: &[u8],
        software: &str,
        history: &str,
    ) -> io::Result<()> {
        let fits = |block: &Vec<u8>| EXIF.len() + block.len() <= LARGEST;
        let old = match self.exif {
            Some(i) => Some(&self.segments[i].1[EXIF.len()..]),
            None => self.without_exif.then_some(exif_block::EMPTY),
        };
        let exif = old.and_then(|old| exif_block::with_history(old, software, history)).filter(fits);
        let exif = exif.map(|block| [EXIF, &block].concat());
        out.write_all(b"\xFF\xD8")?;
        // New EXIF data come first, but after the JFIF segment, which must be the first.
        let first = self.segments.iter().take_while(|(m, _)| *m == 0xE0).count();
        for (i, (marker, body)) in self.segments.iter().enumerate() {
            match &exif {
                Some(exif) if self.exif == Some(i) => segment(out, 0xE1, exif)?,
                Some(exif) if self.exif.is_none() && first == i => {
                    segment(out, 0xE1, exif)?;
                    segment(out, *marker, body)?;
                }
                _ => segment(out, *marker, body)?,
            }
        }
        match &exif {
            Some(exif) if self.exif.is_none() && first == self.segments.len() => segment(out, 0xE1, exif)?,
            Some(_) => {}
            // EXIF data that are full or cannot be read stay as they are.
            None => {
                let mut text = format!("{}: {}", one_line(software), one_line(history)).into_bytes();
                text.truncate(LARGEST);
                segment(out, 0xFE, &text)?;
            }
        }
        let mut after = AfterHead { out, head: Vec::new() };
        JpegEncoder::new_with_quality(&mut after, QUALITY)
            .encode(pixels, width, height, ExtendedColorType::Rgb8)
            .map_err(|e| match e {
                image::ImageError::IoError(e) => e,
                other => io::Error::other(other),
            })
    }
}

fn segment(out: &mut dyn Write, marker: u8, body: &[u8]) -> io::Result<()> {
    let length = u16::try_from(body.len() + 2).map_err(|_| io::Error::other("a segment is too long"))?;
    out.write_all(&[0xFF, marker])?;
    out.write_all(&length.to_be_bytes())?;
    out.write_all(body)
}

/// Passes on the encoder's bytes without its start marker and its own `JFIF` segment.
struct AfterHead<'a> {
    out: &'a mut dyn Write,
    head: Vec<u8>,
}

impl Write for AfterHead<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let missing = ENCODER_HEAD - self.head.len();
        if missing == 0 {
            return self.out.write(bytes);
        }
        let taken = missing.min(bytes.len());
        self.head.extend(&bytes[..taken]);
        let expected = b"\xFF\xD8\xFF\xE0\0\x10JFIF\0";
        if self.head.len() == ENCODER_HEAD && !self.head.starts_with(expected) {
            return Err(io::Error::other("the encoder does not begin with a JFIF segment"));
        }
        Ok(taken)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.out.flush()
    }
}
