//! The EXIF data of a JPEG that matter here: the orientation, the camera that took it, and its GPS position.
//!
//! A camera stores a photograph as its sensor saw it, and a tag says how to turn it. COLMAP's versions treat
//! the tag differently, and under water it is often wrong, since the camera looks down. So photographs are
//! used as stored, and the tag of a prepared copy is set to 1, "not turned". The pixels stay as they are.

use std::io::Read;
use std::ops::Range;
use std::path::Path;

use crate::tiff_structure::TiffStructure;

/// A position by GPS.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GpsPosition {
    /// Degrees, north is positive.
    pub latitude: f64,
    /// Degrees, east is positive.
    pub longitude: f64,
    /// Metres above the sea, if it is stated.
    pub altitude: Option<f64>,
}

/// The properties of a JPEG's EXIF data.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Exif {
    /// The place of the orientation's two bytes in the file, with true for big-endian numbers.
    orientation_at: Option<(usize, bool)>,
    /// The orientation, 1 to 8; 1 if there is none.
    pub orientation: u16,
    /// Maker and model of the camera, and the focal length in thousandths of a millimetre.
    pub camera: (String, String, u64),
    /// The place where it was taken, if it is stated.
    pub gps: Option<GpsPosition>,
    /// The day when it was taken, if it is stated: `2026-11-27`.
    pub day: Option<String>,
}

/// The bytes of a JPEG that are read to find its EXIF data, which stand at the beginning.
pub(crate) const HEAD: u64 = 1 << 18;

/// The values of EXIF directories.
impl TiffStructure<'_> {
    fn text(&self, entry: usize) -> Option<String> {
        let count = self.long(entry.checked_add(4)?)?;
        let at = if count <= 4 { entry + 8 } else { self.long(entry.checked_add(8)?)? };
        let bytes = self.bytes.get(at..at.checked_add(count.min(64))?)?;
        let text = String::from_utf8_lossy(bytes);
        Some(text.trim_matches(['\0', ' ']).to_string())
    }

    /// The ratio at a place.
    fn ratio(&self, at: usize) -> Option<(u64, u64)> {
        Some((self.number(at, 4)?, self.number(at.checked_add(4)?, 4)?))
    }

    /// The day of a date and time, `2026:11:27 10:15:00`.
    fn day(&self, entry: usize) -> Option<String> {
        let text = self.text(entry)?;
        let day = text.get(..10)?.replace(':', "-");
        let digits = day
            .bytes()
            .enumerate()
            .all(|(i, b)| if i == 4 || i == 7 { b == b'-' } else { b.is_ascii_digit() });
        (digits && !day.starts_with("0000")).then_some(day)
    }

    fn thousandths(&self, entry: usize) -> Option<u64> {
        let (over, under) = self.ratio(self.long(entry.checked_add(8)?)?)?;
        over.checked_mul(1000)?.checked_div(under)
    }

    /// A number of `N` parts, each a sixtieth of the one before it: degrees, minutes and seconds.
    fn sixtieths<const N: usize>(&self, entry: usize) -> Option<f64> {
        let at = self.long(entry.checked_add(8)?)?;
        let (mut sum, mut unit) = (0.0, 1.0);
        for i in 0..N {
            let (over, under) = self.ratio(at.checked_add(8 * i)?)?;
            // Cameras without a value write 0/0.
            if under == 0 {
                return None;
            }
            sum += unit * over as f64 / under as f64;
            unit /= 60.0;
        }
        Some(sum)
    }

    /// The position of a GPS directory.
    fn position(&self, directory: usize) -> Option<GpsPosition> {
        let (mut latitude, mut longitude, mut altitude) = (None, None, None);
        let (mut south, mut west, mut below) = (false, false, false);
        for (tag, entry) in self.entries(directory) {
            match tag {
                1 => south = self.text(entry)?.starts_with('S'),
                2 => latitude = self.sixtieths::<3>(entry),
                3 => west = self.text(entry)?.starts_with('W'),
                4 => longitude = self.sixtieths::<3>(entry),
                5 => below = self.number(entry.checked_add(8)?, 1)? == 1,
                6 => altitude = self.sixtieths::<1>(entry),
                _ => {}
            }
        }
        let signed = |value: f64, negative: bool| if negative { -value } else { value };
        let (latitude, longitude) = (signed(latitude?, south), signed(longitude?, west));
        let inside = (-90.0..=90.0).contains(&latitude) && (-180.0..=180.0).contains(&longitude);
        // Receivers without a fix write zeros.
        let fixed = latitude != 0.0 || longitude != 0.0;
        let altitude = altitude.map(|value| signed(value, below));
        (inside && fixed).then_some(GpsPosition { latitude, longitude, altitude })
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

/// Reads the EXIF data of a file; the default for a file without any, or with broken ones.
///
/// # Errors
/// A file that cannot be read.
pub fn read_exif(path: &Path) -> std::io::Result<Exif> {
    let mut head = Vec::new();
    std::fs::File::open(path)?.take(HEAD).read_to_end(&mut head)?;
    Ok(exif_of_bytes(&head))
}

/// Reads the EXIF data in the beginning of a file's bytes; the default if there are none, or broken ones.
pub fn exif_of_bytes(bytes: &[u8]) -> Exif {
    let bytes = &bytes[..bytes.len().min(HEAD as usize)];
    let plain = Exif { orientation: 1, ..Exif::default() };
    let Some(range) = segment(bytes) else { return plain };
    let start = range.start;
    let exif = exif_of_block(&bytes[range]);
    Exif { orientation_at: exif.orientation_at.map(|(at, big)| (start + at, big)), ..exif }
}

/// Reads EXIF data without the JPEG around them; the default if they are broken.
pub(crate) fn exif_of_block(block: &[u8]) -> Exif {
    let mut exif = Exif { orientation: 1, ..Exif::default() };
    let Some(tiff) = TiffStructure::of(block).filter(|tiff| !tiff.wide) else { return exif };
    let (big, Some(first)) = (tiff.big, tiff.first()) else { return exif };
    for (tag, entry) in tiff.entries(first) {
        match tag {
            0x0112 => {
                let value = tiff.short(entry + 8).unwrap_or(1);
                if (1..=8).contains(&value) {
                    (exif.orientation, exif.orientation_at) = (value as u16, Some((entry + 8, big)));
                }
            }
            0x010F => exif.camera.0 = tiff.text(entry).unwrap_or_default(),
            0x0110 => exif.camera.1 = tiff.text(entry).unwrap_or_default(),
            0x8825 => exif.gps = tiff.long(entry + 8).and_then(|at| tiff.position(at)),
            0x8769 => {
                let inner = tiff.long(entry + 8).unwrap_or(usize::MAX);
                let value =
                    |wanted: u64| tiff.entries(inner).find(|(tag, _)| *tag == wanted).map(|(_, entry)| entry);
                exif.camera.2 = value(0x920A).and_then(|entry| tiff.thousandths(entry)).unwrap_or(0);
                exif.day = value(0x9003).and_then(|entry| tiff.day(entry));
            }
            _ => {}
        }
    }
    exif
}

/// Sets the orientation in the bytes of a JPEG to 1.
pub fn straighten(bytes: &mut [u8]) {
    if let Some((at, big)) = exif_of_bytes(bytes).orientation_at
        && let Some(place) = bytes.get_mut(at..at + 2)
    {
        place.copy_from_slice(&if big { 1u16.to_be_bytes() } else { 1u16.to_le_bytes() });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A JPEG's head with an orientation, a camera, a focal length of 24 mm, and a place: 12° 6' 30.5" S,
    /// 68° 54' E, 2.5 m below the sea.
    fn head(orientation: u16, big: bool) -> Vec<u8> {
        let short = |v: u16| if big { v.to_be_bytes() } else { v.to_le_bytes() }.to_vec();
        let long = |v: u32| if big { v.to_be_bytes() } else { v.to_le_bytes() }.to_vec();
        let ratios =
            |all: &[(u32, u32)]| all.iter().flat_map(|(a, b)| [long(*a), long(*b)].concat()).collect();
        let entry = |tag: u16, kind: u16, count: u32, value: Vec<u8>| -> Vec<u8> {
            let mut value = value;
            value.resize(4, 0);
            [short(tag), short(kind), long(count), value].concat()
        };
        // Directory at 8 with 5 entries: it ends at 8 + 2 + 60 + 4 = 74. The text is there, then the inner
        // directory with its ratio, then that of the position with seven ratios.
        let text = b"GoPro\0\0\0";
        let inner = 74 + text.len() as u32;
        let place = inner + 2 + 24 + 4 + 8 + 20;
        let values = place + 2 + 6 * 12 + 4;
        let body = [
            if big { b"MM\0*".to_vec() } else { b"II*\0".to_vec() },
            long(8),
            short(5),
            entry(0x010F, 2, 6, long(74)),
            entry(0x0110, 2, 3, b"H9\0".to_vec()),
            entry(0x0112, 3, 1, short(orientation)),
            entry(0x8769, 4, 1, long(inner)),
            entry(0x8825, 4, 1, long(place)),
            long(0),
            text.to_vec(),
            short(2),
            entry(0x9003, 2, 20, long(inner + 2 + 24 + 4 + 8)),
            entry(0x920A, 5, 1, long(inner + 2 + 24 + 4)),
            long(0),
            long(240),
            long(10),
            b"2026:11:27 10:15:00\0".to_vec(),
            short(6),
            entry(1, 2, 2, b"S\0".to_vec()),
            entry(2, 5, 3, long(values)),
            entry(3, 2, 2, b"E\0".to_vec()),
            entry(4, 5, 3, long(values + 24)),
            entry(5, 1, 1, vec![1]),
            entry(6, 5, 1, long(values + 48)),
            long(0),
            ratios(&[(12, 1), (6, 1), (305, 10), (68, 1), (54, 1), (0, 1), (25, 10)]),
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
    fn orientation_camera_and_place_are_read_in_both_orders_of_bytes() {
        for big in [false, true] {
            let mut bytes = head(6, big);
            let exif = exif_of_bytes(&bytes);
            assert_eq!(exif.orientation, 6);
            assert_eq!(exif.camera, ("GoPro".to_string(), "H9".to_string(), 24_000));
            assert_eq!(exif.day.as_deref(), Some("2026-11-27"));
            let gps = exif.gps.unwrap();
            assert!((gps.latitude + (12.0 + 6.0 / 60.0 + 30.5 / 3600.0)).abs() < 1e-12, "{gps:?}");
            assert!((gps.longitude - 68.9).abs() < 1e-12 && gps.altitude == Some(-2.5), "{gps:?}");
            straighten(&mut bytes);
            assert_eq!(bytes, head(1, big));
        }
        assert_eq!((exif_of_bytes(b"\x89PNG").orientation, exif_of_bytes(b"").gps), (1, None));
    }

    #[test]
    fn broken_data_never_panic() {
        for big in [false, true] {
            let whole = head(8, big);
            for end in 0..whole.len() {
                exif_of_bytes(&whole[..end]);
            }
            for at in 0..whole.len() {
                for value in [0, 1, 0x7F, 0xFF] {
                    let mut broken = whole.clone();
                    broken[at] = value;
                    straighten(&mut broken);
                }
            }
        }
    }
}
