//! Properties of a JPEG that the decoder does not report: its size without reading the whole file, its
//! completeness, and its segments before the pixels.
//!
//! The decoder fills the missing part of a truncated file with grey and reports success. A scene would then
//! be trained on grey.

use std::io::{self, BufRead};

use crate::error::damaged;

/// The beginning of a segment with a part of an ICC profile.
pub(crate) const ICC: &[u8] = b"ICC_PROFILE\0";

/// Size and number of components from the frame header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct FrameHeader {
    pub(crate) width: u64,
    pub(crate) height: u64,
    pub(crate) components: u64,
    /// True if the first scan holds the whole picture.
    pub(crate) one_scan: bool,
}

/// Reads the segments up to the first scan; the reader is left at the scan's data.
pub(crate) fn frame(reader: &mut impl BufRead) -> io::Result<FrameHeader> {
    let ended = |_| damaged("it ends within its header");
    let mut two = [0u8; 2];
    reader.read_exact(&mut two).map_err(ended)?;
    if two != [0xFF, 0xD8] {
        return Err(damaged("it does not begin with a JPEG start marker"));
    }
    let mut frame: Option<FrameHeader> = None;
    loop {
        reader.read_exact(&mut two).map_err(ended)?;
        if two[0] != 0xFF {
            return Err(damaged("a marker is missing between two segments"));
        }
        let mut marker = two[1];
        while marker == 0xFF {
            reader.read_exact(&mut two[..1]).map_err(ended)?; // fill bytes
            marker = two[0];
        }
        if matches!(marker, 0x01 | 0xD0..=0xD7) {
            continue; // these have no body
        }
        if marker == 0xD9 {
            return Err(damaged("it ends before any picture"));
        }
        reader.read_exact(&mut two).map_err(ended)?;
        let length = u16::from_be_bytes(two).checked_sub(2);
        let length = length.ok_or_else(|| damaged("a segment is shorter than its own length"))?;
        let mut body = vec![0u8; usize::from(length)];
        reader.read_exact(&mut body).map_err(ended)?;
        let is_frame = matches!(marker, 0xC0..=0xCF) && !matches!(marker, 0xC4 | 0xC8 | 0xCC);
        if is_frame {
            let &[_, h0, h1, w0, w1, components, ..] = &body[..] else {
                return Err(damaged("its frame header is too short"));
            };
            let [height, width] = [[h0, h1], [w0, w1]].map(|side| u64::from(u16::from_be_bytes(side)));
            let one_scan = marker != 0xC2;
            frame = Some(FrameHeader { width, height, components: u64::from(components), one_scan });
        }
        if marker == 0xDA {
            let mut frame = frame.ok_or_else(|| damaged("a scan comes before its frame header"))?;
            frame.one_scan &= body.first().is_some_and(|count| u64::from(*count) == frame.components);
            return Ok(frame);
        }
    }
}

/// The frame header, and true if the end marker follows the first scan. It cannot occur inside entropy-coded
/// data.
pub(crate) fn ended(bytes: &[u8]) -> io::Result<(FrameHeader, bool)> {
    let mut rest = bytes;
    let found = frame(&mut rest)?;
    let whole = rest.windows(2).any(|w| w == [0xFF, 0xD9]);
    Ok((found, whole))
}

/// Marker and bytes of every segment before the first scan.
pub(crate) fn segments(bytes: &[u8]) -> Vec<(u8, &[u8])> {
    let (mut all, mut at) = (Vec::new(), 2);
    while let Some(&[0xFF, marker]) = bytes.get(at..at + 2) {
        match marker {
            0xFF => at += 1, // a fill byte
            0x01 | 0xD0..=0xD7 => at += 2,
            0xD9 | 0xDA => break,
            _ => {
                let Some(&[high, low]) = bytes.get(at + 2..at + 4) else { break };
                let end = at + 2 + usize::from(u16::from_be_bytes([high, low]));
                let Some(body) = bytes.get(at + 4..end) else { break };
                all.push((marker, body));
                at = end;
            }
        }
    }
    all
}

/// The ICC profile in the head of a JPEG, joined from its parts.
pub(crate) fn profile(bytes: &[u8]) -> Option<Vec<u8>> {
    let mut parts: Vec<(u8, &[u8])> = segments(bytes)
        .into_iter()
        .filter(|(marker, body)| *marker == 0xE2 && body.starts_with(ICC))
        .filter_map(|(_, body)| Some((*body.get(ICC.len())?, body.get(ICC.len() + 2..)?)))
        .collect();
    parts.sort_by_key(|(number, _)| *number);
    let whole: Vec<u8> = parts.iter().flat_map(|(_, part)| *part).copied().collect();
    (!whole.is_empty()).then_some(whole)
}
