//! Two properties of a JPEG that the decoder does not report: its size without reading the whole file, and
//! its completeness.
//!
//! The decoder fills the missing part of a truncated file with grey and reports success. A scene would then
//! be trained on grey.

use std::io::{self, BufRead};

use crate::error::damaged;

/// Size and number of components from the frame header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct FrameHeader {
    pub(crate) width: u64,
    pub(crate) height: u64,
    pub(crate) components: u64,
}

/// Reads the segments up to the first scan; the reader is left at the scan's data.
pub(crate) fn frame(reader: &mut impl BufRead) -> io::Result<FrameHeader> {
    let ended = |_| damaged("it ends within its header");
    let mut two = [0u8; 2];
    reader.read_exact(&mut two).map_err(ended)?;
    if two != [0xFF, 0xD8] {
        return Err(damaged("it does not begin with a JPEG start marker"));
    }
    let mut frame = None;
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
            frame = Some(FrameHeader { width, height, components: u64::from(components) });
        }
        if marker == 0xDA {
            return frame.ok_or_else(|| damaged("a scan comes before its frame header"));
        }
    }
}

/// Checks that the end marker follows the first scan. It cannot occur inside entropy-coded data.
pub(crate) fn check_whole(bytes: &[u8]) -> io::Result<FrameHeader> {
    let mut rest = bytes;
    let found = frame(&mut rest)?;
    let whole = rest.windows(2).any(|w| w == [0xFF, 0xD9]);
    let missing = "it ends before its end marker, so the lower part of the picture is missing";
    whole.then_some(found).ok_or_else(|| damaged(missing))
}
