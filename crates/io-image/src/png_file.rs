//! Two operations on a PNG that its decoder must not do: reading its header without unpacking metadata, and
//! removing the metadata before the pixels are decoded.
//!
//! A colour profile or a text may unpack to a thousand times its length, and the decoder unpacks it before it
//! reports the size. Neither is used here, so neither is passed on. A chunk is `u32 length, 4 letters, length
//! bytes, u32 checksum`.

use std::borrow::Cow;
use std::io::{self, BufRead, Seek, SeekFrom};

use crate::error::damaged;

const SIGNATURE: usize = 8;
/// Bytes around a chunk's contents: length and name before, checksum after.
const AROUND: usize = 12;
/// Chunks that may unpack to a large size, or that only describe the picture.
const METADATA: [&[u8; 4]; 5] = [b"iCCP", b"zTXt", b"iTXt", b"tEXt", b"eXIf"];

/// The properties of the decoded picture that the header gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    pub(crate) width: u64,
    pub(crate) height: u64,
    /// Bytes per pixel after decoding.
    pub(crate) bytes_per_pixel: u64,
    pub(crate) alpha: bool,
}

/// Reads the chunks up to the first chunk of pixels.
pub(crate) fn header(reader: &mut (impl BufRead + Seek)) -> io::Result<Header> {
    let ended = |_| damaged("it ends within its header");
    let mut start = [0u8; SIGNATURE + 8 + 13 + 4];
    reader.read_exact(&mut start).map_err(ended)?;
    let (head, body) = (&start[SIGNATURE..SIGNATURE + 8], &start[SIGNATURE + 8..]);
    if head != [0, 0, 0, 13, b'I', b'H', b'D', b'R'] {
        return Err(damaged("it does not begin with a header chunk"));
    }
    let side =
        |at: usize| u64::from(u32::from_be_bytes([body[at], body[at + 1], body[at + 2], body[at + 3]]));
    let (depth, color) = (body[8], body[9]);
    let (colors, own_alpha) = match color {
        0 => (1, false),
        2 | 3 => (3, false),
        4 => (1, true),
        6 => (3, true),
        _ => return Err(damaged(format!("its colour type is {color}; expected 0, 2, 3, 4 or 6"))),
    };
    // Transparency of a palette or of one colour is in a chunk of its own, before the pixels.
    let transparent = loop {
        let mut head = [0u8; 8];
        reader.read_exact(&mut head).map_err(ended)?;
        match &head[4..] {
            b"IDAT" | b"IEND" => break false,
            b"tRNS" => break true,
            _ => {
                let length = i64::from(u32::from_be_bytes([head[0], head[1], head[2], head[3]]));
                reader.seek(SeekFrom::Current(length + 4)).map_err(ended)?;
            }
        }
    };
    let alpha = own_alpha || transparent;
    let bytes_per_pixel = (colors + u64::from(alpha)) * if depth == 16 { 2 } else { 1 };
    Ok(Header { width: side(0), height: side(4), bytes_per_pixel, alpha })
}

/// The file without the chunks that only describe the picture. A damaged file is returned unchanged, so that
/// the decoder reports the error.
pub(crate) fn without_metadata(bytes: &[u8]) -> Cow<'_, [u8]> {
    let mut kept = bytes.get(..SIGNATURE).unwrap_or(bytes).to_vec();
    let mut rest = &bytes[kept.len()..];
    let mut dropped = false;
    while let Some((head, _)) = rest.split_first_chunk::<8>() {
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]) as usize;
        let Some((chunk, after)) = rest.split_at_checked(length.saturating_add(AROUND)) else { break };
        if METADATA.iter().any(|name| head[4..] == name[..]) {
            dropped = true;
        } else {
            kept.extend_from_slice(chunk);
        }
        rest = after;
    }
    if !dropped {
        return Cow::Borrowed(bytes);
    }
    kept.extend_from_slice(rest);
    Cow::Owned(kept)
}
