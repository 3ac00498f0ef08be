//! A TIFF photograph: the tags besides its pixels.
//!
//! Kept with their bytes: every tag of the first directory that is not about the storage of the pixels (ICC,
//! XMP, IPTC, GeoTIFF, orientation, resolution, those of the camera, and unknown ones), and the directories
//! for EXIF, GPS and interoperability with all their tags. The file keeps its order of bytes, so no value
//! changes. Maker notes contain places in the file, so they keep their own place.
//!
//! Left out, with a sentence in the notes: further pages and previews, the layers of Photoshop (they show
//! the old pixels), and an ICC profile that is not for RGB. A camera's raw file, which is also a TIFF, is
//! refused: its first picture is only a preview.

use std::io;

use crate::error::damaged;
use crate::tiff_structure::{TagValue, TiffStructure};

/// The tags that point at the directories for EXIF, GPS and interoperability.
pub(crate) const EXIF: u16 = 34665;
pub(crate) const GPS: u16 = 34853;
pub(crate) const INTEROPERABILITY: u16 = 40965;
const MAKER_NOTE: u16 = 37500;
/// Bytes of the longest header, which no value may overlap.
const FIRST_PLACE: u64 = 16;
const ORIENTATION: u16 = 274;
const COMPRESSION: u16 = 259;
const PREDICTOR: u16 = 317;
const EXTRA_SAMPLES: u16 = 338;
const ICC: u16 = 34675;
const SUB_DIRECTORIES: u16 = 330;
const PHOTOSHOP_LAYERS: u16 = 37724;
const DNG_VERSION: u16 = 50706;

/// Tags about the storage of the pixels, which are written anew or no longer hold.
const STORAGE: &[u16] = &[
    254, 255, 256, 257, 258, 259, 262, 263, 264, 265, 266, 273, 277, 278, 279, 280, 281, 284, 288, 289, 290,
    291, 292, 293, 317, 320, 322, 323, 324, 325, 332, 333, 334, 336, 338, 339, 340, 341, 347, 529, 530,
];
/// More of them: old JPEG, coefficients of YCbCr, and compressions of other programs.
const OLD: &[u16] = &[531, 532, 512, 513, 514, 515, 517, 518, 519, 520, 521, 34892, 50674, 32995, 32996];

/// The compressions that are written. Others become [`Packing::Deflate`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Packing {
    /// No compression.
    None,
    /// Lempel, Ziv and Welch.
    Lzw,
    /// DEFLATE with the header of zlib.
    Deflate,
    /// Runs of equal bytes.
    PackBits,
}

/// The properties of a TIFF that are written again.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TiffTags {
    /// The order of bytes, and whether it is a BigTIFF.
    pub(crate) big: bool,
    pub(crate) wide: bool,
    pub(crate) packing: Packing,
    /// True to store differences between neighbours, which are shorter after compression.
    pub(crate) predictor: bool,
    /// The meaning of the fourth sample: 1 alpha with colours multiplied by it, 2 plain alpha, 0 unknown.
    pub(crate) extra: u16,
    pub(crate) first: Vec<TagValue>,
    /// Only maker notes still have a place: the one that they keep.
    pub(crate) exif: Vec<TagValue>,
    pub(crate) gps: Vec<TagValue>,
    pub(crate) interoperability: Vec<TagValue>,
}

fn find(tags: &[TagValue], tag: u16) -> Option<&TagValue> {
    tags.iter().find(|t| t.tag == tag)
}

/// The reason why a file with these tags holds no photograph, if there is one.
fn refusal(tags: &[TagValue], big: bool) -> Option<&'static str> {
    let number = |tag: u16| find(tags, tag)?.number(big);
    let preview = number(254).is_some_and(|kind| kind & 1 == 1) && find(tags, SUB_DIRECTORIES).is_some();
    if find(tags, DNG_VERSION).is_some() || preview {
        return Some("it is a camera's raw file; develop it to a TIFF or JPEG first");
    }
    let bits = number(258).unwrap_or(1);
    let float = number(339).unwrap_or(1) == 3;
    (bits > 16 && !float).then_some("it has whole numbers of more than 16 bits, which are no photograph")
}

impl TiffTags {
    /// Leaves out the ICC profile.
    pub(crate) fn drop_profile(&mut self) {
        self.first.retain(|t| t.tag != ICC);
    }

    /// The tags of a TIFF that was decoded, and its orientation (1 if none is stated).
    ///
    /// # Errors
    /// The reason why the file holds no photograph.
    pub(crate) fn of(bytes: &[u8], notes: &mut Vec<String>) -> io::Result<(Self, u16)> {
        let tiff = TiffStructure::of(bytes).ok_or_else(|| damaged("it has no TIFF header"))?;
        let mut budget = bytes.len();
        let first = tiff.first().and_then(|at| tiff.directory(at, &mut budget));
        let (mut first, mut broken, next) =
            first.ok_or_else(|| damaged("its first directory lies outside the file"))?;
        if let Some(reason) = refusal(&first, tiff.big) {
            return Err(damaged(reason));
        }
        let number = |tag: u16| find(&first, tag).and_then(|t| t.number(tiff.big));
        let orientation = number(ORIENTATION).filter(|o| (1..=8).contains(o)).unwrap_or(1) as u16;
        let (bits, float) = (number(258).unwrap_or(1), number(339) == Some(3));
        if bits < 8 {
            notes.push(format!("Its {bits} bits per sample became 8."));
        } else if float && bits != 32 {
            notes.push(format!("Its floats of {bits} bits became 32 bits."));
        }
        match number(262) {
            Some(5) => notes.push("CMYK was converted to RGB.".into()),
            Some(0 | 1) => notes.push("Grey became RGB.".into()),
            _ => {}
        }
        let (code, mut predictor) = (number(COMPRESSION).unwrap_or(1), number(PREDICTOR).unwrap_or(1) != 1);
        let packing = match code {
            1 => Packing::None,
            5 => Packing::Lzw,
            8 | 32946 => Packing::Deflate,
            32773 => Packing::PackBits,
            _ => {
                notes
                    .push("Its compression cannot be written; DEFLATE, without loss, took its place.".into());
                predictor = true;
                Packing::Deflate
            }
        };
        predictor &= matches!(packing, Packing::Lzw | Packing::Deflate);
        let extra = number(EXTRA_SAMPLES).unwrap_or(2) as u16;
        if next != 0 || find(&first, SUB_DIRECTORIES).is_some() {
            notes.push("Further pages and previews in the file were left out.".into());
        }
        if find(&first, PHOTOSHOP_LAYERS).is_some() {
            notes.push("The layers of Photoshop show the old pixels and were left out.".into());
        }
        if find(&first, ICC).is_some_and(|t| t.value.get(16..20) != Some(b"RGB ")) {
            notes.push("Its ICC profile is not for RGB and was left out.".into());
            first.retain(|t| t.tag != ICC);
        }
        let mut inner = |tags: &[TagValue], pointer: u16| -> Vec<TagValue> {
            let Some(at) = find(tags, pointer).and_then(|t| usize::try_from(t.number(tiff.big)?).ok()) else {
                return Vec::new();
            };
            let Some((tags, unread, _)) = tiff.directory(at, &mut budget) else {
                broken += 1;
                return Vec::new();
            };
            broken += unread;
            tags
        };
        let (mut exif, mut gps) = (inner(&first, EXIF), inner(&first, GPS));
        let mut interoperability = inner(&exif, INTEROPERABILITY);
        if broken > 0 {
            notes.push(format!("{broken} of its tags cannot be read and were left out."));
        }
        let fixed = exif.iter().position(|t| t.tag == MAKER_NOTE && t.place >= Some(FIRST_PLACE));
        let others = exif.iter_mut().enumerate().filter(|(i, _)| Some(*i) != fixed).map(|(_, t)| t);
        let movable = others.chain(&mut first).chain(&mut gps).chain(&mut interoperability);
        movable.for_each(|t| t.place = None);
        first.retain(|t| {
            let pointer = [EXIF, GPS, SUB_DIRECTORIES, PHOTOSHOP_LAYERS].contains(&t.tag);
            !pointer && !STORAGE.contains(&t.tag) && !OLD.contains(&t.tag)
        });
        exif.retain(|t| t.tag != INTEROPERABILITY);
        let (big, wide) = (tiff.big, tiff.wide);
        let tags = Self { big, wide, packing, predictor, extra, first, exif, gps, interoperability };
        Ok((tags, orientation))
    }
}
