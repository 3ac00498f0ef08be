//! Rewrites the EXIF data of a photograph: `Software` and the history are set, everything else is kept.
//!
//! A camera's maker notes contain places that count from the beginning of the EXIF data. If anything moved,
//! they would point at other bytes. So no byte moves: a copy of the first directory with the two new tags is
//! appended at the end, and the header points at it. The old directory stays behind unused.
//!
//! The second directory describes the thumbnail, which shows the old picture. File browsers would show its
//! old colours. So the new directory has no successor. If the thumbnail is the last part of the data, as
//! cameras write it, its bytes are left out. Previews inside maker notes stay.

use super::history::{self, IMAGE_HISTORY, SOFTWARE};
use crate::tiff_structure::TiffStructure;

/// Bytes of one entry of a directory.
const ENTRY: usize = 12;
/// The tags for the place and the length of a thumbnail.
const THUMBNAIL: [u64; 2] = [0x0201, 0x0202];

/// The place of the thumbnail, if it is a JPEG and the last part of the block.
fn last_thumbnail(tiff: &TiffStructure<'_>, directory: usize) -> Option<usize> {
    let value = |tag: u64| tiff.long(tiff.entries(directory).find(|(t, _)| *t == tag)?.1.checked_add(8)?);
    let (at, length) = (value(THUMBNAIL[0])?, value(THUMBNAIL[1])?);
    let bytes = tiff.bytes.get(at..at.checked_add(length)?)?;
    let after = &tiff.bytes[at + length..];
    let whole = bytes.starts_with(b"\xFF\xD8") && bytes.windows(2).any(|w| w == b"\xFF\xD9");
    (at > directory && whole && after.iter().all(|b| *b == 0)).then_some(at)
}

/// EXIF data without any tags, for files that have none.
pub(crate) const EMPTY: &[u8] = b"II*\0\x08\0\0\0\0\0\0\0\0\0";

/// True if the first directory can be read, so that [`with_history`] succeeds.
pub(crate) fn is_readable(block: &[u8]) -> bool {
    with_history(block, "", "").is_some()
}

/// The block with the two texts; `None` if its first directory cannot be read.
pub(crate) fn with_history(block: &[u8], software: &str, history: &str) -> Option<Vec<u8>> {
    let tiff = TiffStructure::of(block).filter(|tiff| !tiff.wide)?;
    let first = tiff.first()?;
    let count = tiff.short(first)? as usize;
    let start = first.checked_add(2)?;
    let end = start.checked_add(count * ENTRY)?;
    let entries = block.get(start..end)?.chunks_exact(ENTRY);
    let mut budget = block.len();
    let tags = tiff.directory(first, &mut budget)?.0;
    let old = |tag: u16| tags.iter().find(|t| t.tag == tag && t.kind == 2).map(|t| t.value.as_slice());
    let texts = history::values(software, history, old(SOFTWARE), old(IMAGE_HISTORY));

    let second = tiff.long(end).filter(|next| *next != 0);
    let thumbnail = second.and_then(|next| last_thumbnail(&tiff, next)).filter(|at| *at >= end);
    let mut out = block[..thumbnail.unwrap_or(block.len())].to_vec();
    out.resize(out.len().next_multiple_of(2), 0);
    let short = |v: u16| if tiff.big { v.to_be_bytes() } else { v.to_le_bytes() };
    let long =
        |v: usize| u32::try_from(v).ok().map(|v| if tiff.big { v.to_be_bytes() } else { v.to_le_bytes() });
    let tag_of = |entry: &[u8]| {
        let two = [entry[0], entry[1]];
        if tiff.big { u16::from_be_bytes(two) } else { u16::from_le_bytes(two) }
    };
    let mut kept: Vec<(u16, Vec<u8>)> = entries
        .map(|entry| (tag_of(entry), entry.to_vec()))
        .filter(|(tag, _)| !matches!(*tag, SOFTWARE | IMAGE_HISTORY))
        .collect();
    let at = out.len();
    let mut place = at + 2 + (kept.len() + texts.len()) * ENTRY + 4;
    let mut values = Vec::new();
    for (tag, text) in texts {
        let mut entry = [short(tag), short(2)].concat();
        entry.extend(long(text.len())?);
        if text.len() <= 4 {
            entry.extend(&text);
            entry.resize(ENTRY, 0);
        } else {
            entry.extend(long(place)?);
            values.extend(&text);
            values.resize(values.len().next_multiple_of(2), 0);
            place += text.len().next_multiple_of(2);
        }
        kept.push((tag, entry));
    }
    kept.sort_by_key(|(tag, _)| *tag);
    out[4..8].copy_from_slice(&long(at)?);
    out.extend(short(u16::try_from(kept.len()).ok()?));
    kept.iter().for_each(|(_, entry)| out.extend(entry));
    out.extend([0; 4]); // no further directory
    out.extend(values);
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small(big: bool) -> Vec<u8> {
        let short = |v: u16| if big { v.to_be_bytes() } else { v.to_le_bytes() }.to_vec();
        let long = |v: u32| if big { v.to_be_bytes() } else { v.to_le_bytes() }.to_vec();
        [
            if big { b"MM\0*".to_vec() } else { b"II*\0".to_vec() },
            long(8),
            short(2),
            [short(0x0112), short(3), long(1), short(6), short(0)].concat(),
            [short(SOFTWARE), short(2), long(6), long(38)].concat(),
            long(44),
            b"HD9.1\0".to_vec(),
            short(2),
            [short(0x0201), short(4), long(1), long(74)].concat(),
            [short(0x0202), short(4), long(1), long(6)].concat(),
            long(0),
            b"\xFF\xD8ab\xFF\xD9".to_vec(),
        ]
        .concat()
    }

    #[test]
    fn the_old_bytes_stay_in_place_and_the_thumbnail_leaves() {
        for big in [false, true] {
            let block = small(big);
            assert_eq!(block.len(), 80);
            let new = with_history(&block, "3D-USE 0.1.0", "water removed").unwrap();
            assert_eq!(new[8..74], block[8..74]);
            let tiff = TiffStructure::of(&new).unwrap();
            let (tags, broken, next) = tiff.directory(tiff.first().unwrap(), &mut 10_000).unwrap();
            assert_eq!((tags.len(), broken, next), (3, 0, 0));
            assert_eq!((tags[0].tag, tags[0].number(big)), (0x0112, Some(6)));
            assert_eq!(tags[1].value, b"3D-USE 0.1.0\0");
            assert_eq!(tags[2].value, b"water removed (Software before: HD9.1)\0");
            assert!(!new.windows(4).any(|w| w == b"\xD8ab\xFF"), "the thumbnail is still there");
            let again = with_history(&new, "3D-USE 0.1.0", "again").unwrap();
            let tiff = TiffStructure::of(&again).unwrap();
            let (tags, ..) = tiff.directory(tiff.first().unwrap(), &mut 10_000).unwrap();
            assert_eq!(tags[2].value, b"water removed (Software before: HD9.1); again\0");
        }
        let made = with_history(EMPTY, "3", "a\nb\0c").unwrap();
        let tiff = TiffStructure::of(&made).unwrap();
        let (tags, ..) = tiff.directory(tiff.first().unwrap(), &mut 100).unwrap();
        assert_eq!((tags[0].value.as_slice(), tags[1].value.as_slice()), (&b"3\0"[..], &b"a b c\0"[..]));
    }

    #[test]
    fn broken_blocks_never_panic() {
        for big in [false, true] {
            let whole = small(big);
            for end in 0..whole.len() {
                with_history(&whole[..end], "s", "h");
                is_readable(&whole[..end]);
            }
            for at in 0..whole.len() {
                for value in [0, 1, 0x7F, 0xFF] {
                    let mut broken = whole.clone();
                    broken[at] = value;
                    with_history(&broken, "a program", "a long line of history");
                }
            }
        }
    }
}
