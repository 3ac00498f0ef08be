//! The EXIF data of a JPEG that matter here: the orientation, and the camera that took it.
//!
//! A camera stores a photograph as its sensor saw it, and a tag says how to turn it. COLMAP's versions treat
//! the tag differently, and under water it is often wrong, since the camera looks down. So photographs are
//! used as stored, and the tag of the copy is set to 1, "not turned". The pixels stay as they are.

use std::ops::Range;

/// The properties of a JPEG's EXIF data.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Exif {
    /// The place of the orientation's two bytes in the file, with true for big-endian numbers.
    orientation_at: Option<(usize, bool)>,
    /// The orientation, 1 to 8; 1 if there is none.
    pub(crate) orientation: u16,
    /// Maker and model of the camera, and the focal length in thousandths of a millimetre.
    pub(crate) camera: (String, String, u64),
}

/// The bytes of a JPEG that are read to find its EXIF data, which stand at the beginning.
pub(crate) const HEAD: u64 = 1 << 18;

/// A TIFF structure inside a file.
struct Tiff<'a> {
    bytes: &'a [u8],
    big: bool,
}

impl Tiff<'_> {
    fn number(&self, at: usize, size: usize) -> Option<u64> {
        let bytes = self.bytes.get(at..at.checked_add(size)?)?;
        let fold = |n: u64, b: &u8| n << 8 | u64::from(*b);
        Some(if self.big { bytes.iter().fold(0, fold) } else { bytes.iter().rev().fold(0, fold) })
    }

    fn short(&self, at: usize) -> Option<u64> {
        self.number(at, 2)
    }

    fn long(&self, at: usize) -> Option<usize> {
        usize::try_from(self.number(at, 4)?).ok()
    }

    /// The positions of the entries of a directory, by tag.
    fn entries(&self, at: usize) -> impl Iterator<Item = (u64, usize)> + '_ {
        let count = self.short(at).unwrap_or(0) as usize;
        let position = move |i: usize| at.checked_add(2)?.checked_add(i * 12);
        (0..count).map_while(move |i| {
            let here = position(i)?;
            Some((self.short(here)?, here))
        })
    }

    fn text(&self, entry: usize) -> Option<String> {
        let count = self.long(entry.checked_add(4)?)?;
        let at = if count <= 4 { entry + 8 } else { self.long(entry.checked_add(8)?)? };
        let bytes = self.bytes.get(at..at.checked_add(count.min(64))?)?;
        let text = String::from_utf8_lossy(bytes);
        Some(text.trim_matches(['\0', ' ']).to_string())
    }

    fn thousandths(&self, entry: usize) -> Option<u64> {
        let at = self.long(entry.checked_add(8)?)?;
        let (over, under) = (self.long(at)?, self.long(at.checked_add(4)?)?);
        (over as u64).checked_mul(1000)?.checked_div(under as u64)
    }
}

/// The part of a JPEG that holds the TIFF structure of its EXIF data.
fn segment(bytes: &[u8]) -> Option<Range<usize>> {
    let mut at = 2usize;
    if !bytes.starts_with(b"\xFF\xD8") {
        return None;
    }
    loop {
        let &[0xFF, marker, high, low] = bytes.get(at..at.checked_add(4)?)? else { return None };
        let end = at.checked_add(2 + usize::from(u16::from_be_bytes([high, low])))?;
        if marker == 0xE1 && bytes.get(at + 4..)?.starts_with(b"Exif\0\0") && end > at + 10 {
            return Some(at + 10..end.min(bytes.len()));
        }
        // Pixels begin here, so no EXIF data follow.
        if marker == 0xDA || end <= at {
            return None;
        }
        at = end;
    }
}

/// Reads the EXIF data in the beginning of a file; the default if there are none, or broken ones.
pub(crate) fn read(bytes: &[u8]) -> Exif {
    let plain = Exif { orientation: 1, ..Exif::default() };
    let Some(range) = segment(bytes) else { return plain };
    let start = range.start;
    let body = &bytes[range];
    let big = match body.get(..4) {
        Some(b"MM\0*") => true,
        Some(b"II*\0") => false,
        _ => return plain,
    };
    let tiff = Tiff { bytes: body, big };
    let Some(first) = tiff.long(4) else { return plain };
    let mut exif = plain;
    for (tag, entry) in tiff.entries(first) {
        match tag {
            0x0112 => {
                let value = tiff.short(entry + 8).unwrap_or(1);
                if (1..=8).contains(&value) {
                    (exif.orientation, exif.orientation_at) = (value as u16, Some((start + entry + 8, big)));
                }
            }
            0x010F => exif.camera.0 = tiff.text(entry).unwrap_or_default(),
            0x0110 => exif.camera.1 = tiff.text(entry).unwrap_or_default(),
            0x8769 => {
                let inner = tiff.long(entry + 8).unwrap_or(usize::MAX);
                let focal = tiff.entries(inner).find(|(tag, _)| *tag == 0x920A);
                exif.camera.2 = focal.and_then(|(_, entry)| tiff.thousandths(entry)).unwrap_or(0);
            }
            _ => {}
        }
    }
    exif
}

/// Sets the orientation in a file's bytes to 1.
pub(crate) fn straighten(exif: &Exif, bytes: &mut [u8]) {
    if let Some((at, big)) = exif.orientation_at
        && let Some(place) = bytes.get_mut(at..at + 2)
    {
        place.copy_from_slice(&if big { 1u16.to_be_bytes() } else { 1u16.to_le_bytes() });
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// A JPEG's head with an orientation, a camera and a focal length of 24 mm.
    pub(crate) fn head(orientation: u16, big: bool) -> Vec<u8> {
        let short = |v: u16| if big { v.to_be_bytes() } else { v.to_le_bytes() }.to_vec();
        let long = |v: u32| if big { v.to_be_bytes() } else { v.to_le_bytes() }.to_vec();
        let entry = |tag: u16, kind: u16, count: u32, value: Vec<u8>| -> Vec<u8> {
            let mut value = value;
            value.resize(4, 0);
            [short(tag), short(kind), long(count), value].concat()
        };
        // Directory at 8 with 4 entries: it ends at 8 + 2 + 48 + 4 = 62. The text is there, then the inner
        // directory.
        let text = b"GoPro\0\0\0";
        let inner = 62 + text.len() as u32;
        let body = [
            if big { b"MM\0*".to_vec() } else { b"II*\0".to_vec() },
            long(8),
            short(4),
            entry(0x010F, 2, 6, long(62)),
            entry(0x0110, 2, 3, b"H9\0".to_vec()),
            entry(0x0112, 3, 1, short(orientation)),
            entry(0x8769, 4, 1, long(inner)),
            long(0),
            text.to_vec(),
            short(1),
            entry(0x920A, 5, 1, long(inner + 2 + 12 + 4)),
            long(0),
            long(240),
            long(10),
        ]
        .concat();
        let length = (body.len() + 8) as u16;
        let mut file = b"\xFF\xD8\xFF\xE0\x00\x04xx\xFF\xE1".to_vec();
        file.extend(length.to_be_bytes());
        file.extend(b"Exif\0\0");
        file.extend(&body);
        file.extend(b"\xFF\xDA\x00\x02");
        file
    }

    #[test]
    fn orientation_and_camera_are_read_in_both_orders_of_bytes() {
        for big in [false, true] {
            let mut bytes = head(6, big);
            let exif = read(&bytes);
            assert_eq!(exif.orientation, 6);
            assert_eq!(exif.camera, ("GoPro".to_string(), "H9".to_string(), 24_000));
            straighten(&exif, &mut bytes);
            assert_eq!(bytes, head(1, big));
        }
        assert_eq!(read(b"\x89PNG").orientation, 1);
    }

    #[test]
    fn broken_data_never_panic() {
        for big in [false, true] {
            let whole = head(8, big);
            for end in 0..whole.len() {
                read(&whole[..end]);
            }
            for at in 0..whole.len() {
                for value in [0, 1, 0x7F, 0xFF] {
                    let mut broken = whole.clone();
                    broken[at] = value;
                    let exif = read(&broken);
                    straighten(&exif, &mut broken);
                }
            }
        }
    }
}
