//! A PNG photograph: its chunks besides the pixels, and new pixels between them.
//!
//! Kept as bytes, on the same side of the pixels: every chunk that is known to describe the picture, and
//! every unknown one that its name marks as safe to copy. Left out: the palette and transparency (the pixels
//! become RGB with alpha), further pictures of an animation, unknown chunks that depend on the pixels, and
//! the ICC profile of a grey picture. `eXIf` is rewritten like the EXIF data of a JPEG; `Software` and
//! `History` are text chunks, as PNG stores them.
//!
//! The bit depth stays 8 or 16; 1, 2 and 4 bits become 8.

use std::io::{self, Write};

use png::chunk::ChunkType;
use png::{BitDepth, ColorType, DeflateCompression, Encoder, Filter};

use super::exif_block;
use super::history::one_line;
use super::interleaved::SampleRows;
use crate::exif::exif_of_block;

const SIGNATURE: usize = 8;
const EXIF: &[u8] = b"Exif\0\0";
/// Level of DEFLATE, 1 to 9: files are as long as those of cameras and programs, and level 6 takes 5 times as
/// long to make them a tenth shorter.
const LEVEL: u8 = 2;
/// Chunks to keep although their names do not mark them as safe to copy.
const DESCRIPTIONS: [&[u8; 4]; 14] = [
    b"cHRM", b"gAMA", b"iCCP", b"sRGB", b"cICP", b"mDCV", b"cLLI", b"sBIT", b"bKGD", b"oFFs", b"pCAL",
    b"sCAL", b"sTER", b"tIME",
];
/// Chunks that are written anew, or that belong to the old pixels.
const REPLACED: [&[u8; 4]; 10] =
    [b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"hIST", b"acTL", b"fcTL", b"fdAT", b"iDOT"];

/// One chunk: its name and contents.
type NamedChunk = ([u8; 4], Vec<u8>);

/// The chunks of a PNG that are written again.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct PngTags {
    before: Vec<NamedChunk>,
    after: Vec<NamedChunk>,
}

/// Name and contents of every chunk. Ends at the first one that is not whole.
pub(crate) fn chunks(bytes: &[u8]) -> impl Iterator<Item = ([u8; 4], &[u8])> {
    let mut rest = bytes.get(SIGNATURE..).unwrap_or_default();
    std::iter::from_fn(move || {
        let (&[a, b, c, d, n0, n1, n2, n3], after) = rest.split_first_chunk::<8>()?;
        let (body, after) = after.split_at_checked(u32::from_be_bytes([a, b, c, d]) as usize)?;
        rest = after.get(4..)?;
        Some(([n0, n1, n2, n3], body))
    })
}

/// The EXIF data of an `eXIf` chunk. Some programs put the name of the JPEG segment before them.
fn exif_of(body: &[u8]) -> &[u8] {
    body.strip_prefix(EXIF).unwrap_or(body)
}

/// True for a text chunk with this keyword.
fn is_text(name: [u8; 4], body: &[u8], keyword: &[u8]) -> bool {
    matches!(&name, b"tEXt" | b"zTXt" | b"iTXt")
        && body.strip_prefix(keyword).is_some_and(|rest| rest.first() == Some(&0))
}

/// A text chunk; texts beyond ASCII are UTF-8.
fn text_chunk(keyword: &str, text: &str) -> NamedChunk {
    let text = one_line(text);
    if text.is_ascii() {
        (*b"tEXt", [keyword.as_bytes(), b"\0", text.as_bytes()].concat())
    } else {
        (*b"iTXt", [keyword.as_bytes(), b"\0\0\0\0\0", text.as_bytes()].concat())
    }
}

/// Chunks that state a colour space.
const COLOR_SPACE: [&[u8; 4]; 5] = [b"cHRM", b"gAMA", b"iCCP", b"sRGB", b"cICP"];

impl PngTags {
    /// Leaves out the statements on the colour space.
    pub(crate) fn drop_profile(&mut self) {
        self.before.retain(|(name, _)| !COLOR_SPACE.contains(&name));
    }

    /// The chunks of a PNG that was decoded, and the orientation by its EXIF data (1 if there is none).
    pub(crate) fn of(bytes: &[u8], notes: &mut Vec<String>) -> (Self, u16) {
        // Bits and colour type of the header.
        let kind = |at: usize| bytes.get(SIGNATURE + 8 + at).copied().unwrap_or(0);
        let (bits, color) = (kind(8), kind(9));
        if color == 3 {
            notes.push("Its palette was replaced by RGB of 8 bits.".into());
        } else if bits < 8 {
            notes.push(format!("Its {bits} bits per sample became 8."));
        }
        let (mut tags, mut orientation) = (Self { before: Vec::new(), after: Vec::new() }, 1);
        let mut pixels = false;
        let mut dropped: Vec<String> = Vec::new();
        for (name, body) in chunks(bytes) {
            pixels |= &name == b"IDAT";
            if &name == b"IEND" {
                break;
            }
            if &name == b"acTL" {
                notes.push("It is animated; only its first picture was kept.".into());
            }
            let same_colors = color == 2 || color == 6;
            let safe = name[3].is_ascii_lowercase() && name[0].is_ascii_lowercase();
            let keep = match &name {
                b"iCCP" if color == 0 || color == 4 => {
                    notes.push("Its ICC profile is for grey, not for RGB, and was left out.".into());
                    false
                }
                // Their contents depend on the kind of pixels.
                b"sBIT" | b"bKGD" => same_colors,
                _ if REPLACED.contains(&&name) => false,
                _ => safe || DESCRIPTIONS.contains(&&name),
            };
            if &name == b"eXIf" {
                orientation = exif_of_block(exif_of(body)).orientation;
                if !exif_block::is_readable(exif_of(body)) {
                    notes.push("Its EXIF data cannot be read and were copied unchanged.".into());
                }
            }
            if keep {
                if pixels { &mut tags.after } else { &mut tags.before }.push((name, body.to_vec()));
            } else if !REPLACED.contains(&&name) && !DESCRIPTIONS.contains(&&name) {
                dropped.push(String::from_utf8_lossy(&name).escape_default().to_string());
            }
        }
        dropped.dedup();
        dropped.truncate(8);
        if !dropped.is_empty() {
            notes
                .push(format!("Chunks that depend on the old pixels were left out: {}.", dropped.join(", ")));
        }
        (tags, orientation)
    }

    /// Writes the file with the given rows of RGB or RGB and alpha.
    pub(crate) fn write(
        &self,
        out: &mut dyn Write,
        rows: &SampleRows<'_>,
        software: &str,
        history: &str,
    ) -> io::Result<()> {
        let mut encoder = Encoder::new(out, rows.width, rows.height);
        encoder.set_color(if rows.has_alpha() { ColorType::Rgba } else { ColorType::Rgb });
        encoder.set_depth(if rows.bytes_per_sample() == 2 { BitDepth::Sixteen } else { BitDepth::Eight });
        encoder.set_deflate_compression(DeflateCompression::Level(LEVEL));
        encoder.set_filter(Filter::Adaptive);
        let mut writer = encoder.write_header()?;
        let put = |writer: &mut png::Writer<_>, chunks: &[NamedChunk]| -> io::Result<()> {
            for (name, body) in chunks.iter().filter(|(name, body)| !is_text(*name, body, b"Software")) {
                let exif = if name == b"eXIf" {
                    exif_block::with_history(exif_of(body), software, history)
                } else {
                    None
                };
                writer.write_chunk(ChunkType(*name), exif.as_deref().unwrap_or(body))?;
            }
            Ok(())
        };
        put(&mut writer, &self.before)?;
        for (name, body) in [text_chunk("Software", software), text_chunk("History", history)] {
            writer.write_chunk(ChunkType(name), &body)?;
        }
        let mut stream = writer.stream_writer_with_size(1 << 16)?;
        let mut row = Vec::new();
        for y in 0..rows.height as usize {
            rows.bytes(y, true, &mut row);
            stream.write_all(&row)?;
        }
        stream.finish()?;
        put(&mut writer, &self.after)?;
        writer.finish()?;
        Ok(())
    }
}
