//! The structure of TIFF, which TIFF files and EXIF data share: a header, then directories of tags.
//!
//! ```text
//! header    "II" or "MM" (order of bytes), 42, u32 place of the first directory
//! directory u16 count, count x (u16 tag, u16 kind, u32 count, 4 bytes), u32 place of the next directory
//! ```
//!
//! The 4 bytes hold the values, or their place if they need more bytes. BigTIFF (43 instead of 42) has 8
//! bytes for each count and place. Nothing here trusts a number: a place outside the bytes gives `None`.

/// A TIFF structure inside some bytes. Places count from the first byte.
pub(crate) struct TiffStructure<'a> {
    pub(crate) bytes: &'a [u8],
    /// True if the most significant byte of a number comes first.
    pub(crate) big: bool,
    /// True for BigTIFF.
    pub(crate) wide: bool,
}

/// One tag with its values, in the order of bytes of the structure that it comes from.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TagValue {
    pub(crate) tag: u16,
    /// The type of the values by the TIFF standard: 2 is text, 3 `u16`, 4 `u32`.
    pub(crate) kind: u16,
    pub(crate) count: u64,
    pub(crate) value: Vec<u8>,
    /// The place of the values in the structure; `None` if they stand inside the directory.
    pub(crate) place: Option<u64>,
}

/// Bytes of one value of a kind; `None` for an unknown kind.
fn size_of(kind: u16) -> Option<u64> {
    Some(match kind {
        1 | 2 | 6 | 7 => 1,
        3 | 8 => 2,
        4 | 9 | 11 | 13 => 4,
        5 | 10 | 12 | 16..=18 => 8,
        _ => return None,
    })
}

impl TagValue {
    /// The first value, for the kinds of whole numbers without a sign.
    pub(crate) fn number(&self, big: bool) -> Option<u64> {
        matches!(self.kind, 1 | 3 | 4 | 13 | 16 | 18).then_some(())?;
        let size = usize::try_from(size_of(self.kind)?).ok()?;
        TiffStructure { bytes: &self.value, big, wide: false }.number(0, size)
    }
}

impl<'a> TiffStructure<'a> {
    /// The structure with this header; `None` if the bytes begin with no such header.
    pub(crate) fn of(bytes: &'a [u8]) -> Option<Self> {
        let (big, wide) = match bytes.get(..4)? {
            b"II*\0" => (false, false),
            b"MM\0*" => (true, false),
            b"II+\0" => (false, true),
            b"MM\0+" => (true, true),
            _ => return None,
        };
        Some(Self { bytes, big, wide })
    }

    /// The place of the first directory.
    pub(crate) fn first(&self) -> Option<usize> {
        if self.wide { self.place(8) } else { self.long(4) }
    }

    /// The whole number of `size` bytes (at most 8) at a place.
    pub(crate) fn number(&self, at: usize, size: usize) -> Option<u64> {
        let bytes = self.bytes.get(at..at.checked_add(size)?)?;
        let fold = |n: u64, b: &u8| n << 8 | u64::from(*b);
        Some(if self.big { bytes.iter().fold(0, fold) } else { bytes.iter().rev().fold(0, fold) })
    }

    /// The `u16` at a place.
    pub(crate) fn short(&self, at: usize) -> Option<u64> {
        self.number(at, 2)
    }

    /// The `u32` at a place.
    pub(crate) fn long(&self, at: usize) -> Option<usize> {
        usize::try_from(self.number(at, 4)?).ok()
    }

    /// The place that stands at a place: 4 bytes, or 8 in BigTIFF.
    fn place(&self, at: usize) -> Option<usize> {
        usize::try_from(self.number(at, if self.wide { 8 } else { 4 })?).ok()
    }

    /// The positions of the entries of a directory, by tag. Entries beyond the bytes are left out. Not for
    /// BigTIFF.
    pub(crate) fn entries(&self, at: usize) -> impl Iterator<Item = (u64, usize)> + '_ {
        let count = self.short(at).unwrap_or(0) as usize;
        let position = move |i: usize| at.checked_add(2)?.checked_add(i * 12);
        (0..count).map_while(move |i| {
            let here = position(i)?;
            Some((self.short(here)?, here))
        })
    }

    /// All tags of a directory with their values, and the place of the next directory (0: none). A tag whose
    /// values cannot be read is counted and left out. `budget` is the number of bytes that values may still
    /// take; it keeps a small file from filling the memory by naming the same bytes again and again.
    pub(crate) fn directory(&self, at: usize, budget: &mut usize) -> Option<(Vec<TagValue>, usize, usize)> {
        let (head, size, inline) = if self.wide { (8, 20, 8) } else { (2, 12, 4) };
        let count = usize::try_from(self.number(at, head)?).ok()?;
        let start = at.checked_add(head)?;
        let end = start.checked_add(count.checked_mul(size)?)?;
        self.bytes.get(start..end)?;
        let (mut tags, mut broken) = (Vec::new(), 0);
        for here in (start..end).step_by(size) {
            match self.tag_value(here, inline, *budget) {
                Some(tag) => {
                    *budget -= tag.value.len();
                    tags.push(tag);
                }
                None => broken += 1,
            }
        }
        Some((tags, broken, self.place(end).unwrap_or(0)))
    }

    fn tag_value(&self, at: usize, inline: usize, budget: usize) -> Option<TagValue> {
        let (tag, kind) = (self.short(at)? as u16, self.short(at.checked_add(2)?)? as u16);
        let count = self.number(at.checked_add(4)?, inline)?;
        let length = usize::try_from(count.checked_mul(size_of(kind)?)?).ok()?;
        let here = at.checked_add(4 + inline)?;
        let from = if length <= inline { here } else { self.place(here)? };
        (length <= budget).then_some(())?;
        let value = self.bytes.get(from..from.checked_add(length)?)?.to_vec();
        Some(TagValue { tag, kind, count, value, place: (length > inline).then_some(from as u64) })
    }
}
