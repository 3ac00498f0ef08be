//! A stream of raw RGB frames with exact time stamps, as Matroska, for ffmpeg's pipe.
//!
//! An element is `id, size, content`. The size has eight bytes, of which the first is `01`; all ones mean
//! "unknown". The unit of time is one nanosecond. Each frame is a cluster of its own, with its time and one
//! block. Only elements that ffmpeg needs are written.

use std::io::{self, Write};

/// The size of a segment whose end is not known.
const UNKNOWN: [u8; 8] = [0x01, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF];

fn size(bytes: usize) -> [u8; 8] {
    ((bytes as u64) | 1 << 56).to_be_bytes()
}

fn element(id: &[u8], content: &[u8]) -> Vec<u8> {
    [id, &size(content.len()), content].concat()
}

fn number(id: &[u8], value: u64) -> Vec<u8> {
    element(id, &value.to_be_bytes())
}

/// Writes the head of a film: its frames in pixels, and the usual distance of two frames in nanoseconds.
pub(super) fn write_head(
    to: &mut impl Write,
    (width, height): (usize, usize),
    distance: u64,
) -> io::Result<()> {
    let video = [
        number(&[0xB0], width as u64),
        number(&[0xBA], height as u64),
        // Red, green and blue bytes.
        element(&[0x2E, 0xB5, 0x24], b"RGB\x18"),
    ];
    let track = [
        number(&[0xD7], 1),
        number(&[0x73, 0xC5], 1),
        number(&[0x83], 1),
        element(&[0x86], b"V_UNCOMPRESSED"),
        number(&[0x23, 0xE3, 0x83], distance.max(1)),
        element(&[0xE0], &video.concat()),
    ];
    let ebml = [
        number(&[0x42, 0x86], 1),
        number(&[0x42, 0xF7], 1),
        number(&[0x42, 0xF2], 4),
        number(&[0x42, 0xF3], 8),
        element(&[0x42, 0x82], b"matroska"),
        number(&[0x42, 0x87], 4),
        number(&[0x42, 0x85], 2),
    ];
    // One nanosecond; the usual unit would be a millisecond.
    let info = number(&[0x2A, 0xD7, 0xB1], 1);
    to.write_all(&element(&[0x1A, 0x45, 0xDF, 0xA3], &ebml.concat()))?;
    to.write_all(&[0x18, 0x53, 0x80, 0x67])?;
    to.write_all(&UNKNOWN)?;
    to.write_all(&element(&[0x15, 0x49, 0xA9, 0x66], &info))?;
    to.write_all(&element(&[0x16, 0x54, 0xAE, 0x6B], &element(&[0xAE], &track.concat())))
}

/// Writes a frame that is shown at this time, nanoseconds from the first frame.
pub(super) fn write_frame(to: &mut impl Write, nanoseconds: u64, rgb: &[u8]) -> io::Result<()> {
    // Track 1, no time beside the cluster's, a key frame.
    const BLOCK: [u8; 4] = [0x81, 0, 0, 0x80];
    let time = number(&[0xE7], nanoseconds);
    let block = BLOCK.len() + rgb.len();
    to.write_all(&[0x1F, 0x43, 0xB6, 0x75])?;
    to.write_all(&size(time.len() + 1 + 8 + block))?;
    to.write_all(&time)?;
    to.write_all(&[0xA3])?;
    to.write_all(&size(block))?;
    to.write_all(&BLOCK)?;
    to.write_all(rgb)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_those_of_the_bytes_that_follow() {
        let mut bytes = Vec::new();
        write_frame(&mut bytes, 5, &[7; 12]).unwrap();
        let stated = u64::from_be_bytes(bytes[4..12].try_into().unwrap()) ^ 1 << 56;
        assert_eq!(stated as usize, bytes.len() - 12);
        assert_eq!(bytes[12..29], [0xE7, 1, 0, 0, 0, 0, 0, 0, 8, 0, 0, 0, 0, 0, 0, 0, 5]);
        assert_eq!(bytes[29], 0xA3);
        assert_eq!(bytes[bytes.len() - 12..], [7; 12]);
        let mut head = Vec::new();
        write_head(&mut head, (4, 3), 1).unwrap();
        assert_eq!(head[..4], [0x1A, 0x45, 0xDF, 0xA3]);
    }
}
