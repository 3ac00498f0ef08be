//! Photographs that are given back: an original with everything besides its pixels, and new pixels of the
//! same size in a file of the same kind.
//!
//! | convention | reason |
//! |---|---|
//! | same format, size and bit depth | the file takes the original's place in other programs |
//! | JPEG with quality 95 and 4:4:4 | a second compression must not be seen |
//! | pixels are not turned, the orientation tag is copied | other programs store points in unturned pixels |
//! | colours of another space than sRGB are converted to it, with a note | scenes have sRGB colours |
//! | other values are used as stored, the ICC profile is copied | colours mean the same as in the original |
//! | grey, palette and CMYK become RGB, and the notes say so | enhanced pixels have colours |
//! | an ICC profile for grey or CMYK is left out then | it would give wrong colours |
//! | EXIF, GPS, XMP, IPTC and comments are copied as bytes | surveys need positions, dates and names |
//! | only `Software` and one line of history are added | the pixels are no longer the camera's |
//! | thumbnails, previews and layers of the old pixels are left out | file browsers show their colours |
//! | damaged metadata are copied or left out, and the notes say so | a picture is worth more than a tag |
//!
//! Depths: JPEG 8 bits; PNG 8 and 16; TIFF 8, 16 and 32-bit float; EXR half and float.
//!
//! Some thumbnails stay: those in XMP, in Photoshop's resources, and in maker notes.
//!
//! The bytes of a file depend only on the pixels, the metadata and the two texts. An EXR with several
//! attributes of its own is the exception: their order may change.
//!
//! Memory: the original file and its decoded samples while it is read; one row or strip more while it is
//! written. A progressive JPEG needs 6 bytes per pixel more while it is read.

mod exif_block;
mod exr_layers;
mod history;
mod info;
mod interleaved;
mod jpeg_segments;
mod png_chunks;
mod tiff_tags;
mod tiff_write;

use std::io;
use std::path::Path;

use use3d_files::write_atomically;

pub use info::{PhotographInfo, photograph_info, states_colors, whole_photograph_info};

use crate::color_space;
use crate::decoded::{Decoded, Samples};
use crate::error::{FileFormat, ImageError};
use crate::exif::exif_of_bytes;
use crate::read::{decode, image_info};
use exr_layers::ExrTags;
use interleaved::{SampleRows, rgb_and_alpha};
use jpeg_segments::JpegTags;
use png_chunks::PngTags;
use tiff_tags::TiffTags;
use tiff_write::WriteSeek;

/// The samples of a photograph, `[height, width, 3]` red, green, blue: 8-bit (full scale 255), 16-bit (full
/// scale 65535), or floats as stored.
pub type Rgb = Samples;

/// Everything of a file besides its pixels.
#[derive(Clone, Debug)]
enum Tags {
    Jpeg(JpegTags),
    Png(PngTags),
    Tiff(TiffTags),
    Exr(Box<ExrTags>),
}

/// A decoded original with its metadata.
#[derive(Clone, Debug)]
pub struct Photograph {
    /// Width, pixels, as stored.
    pub width: usize,
    /// Height, pixels, as stored.
    pub height: usize,
    /// The format by the first bytes: JPEG, PNG, TIFF or EXR.
    pub format: FileFormat,
    /// `width * height * 3` samples in sRGB, not turned by the orientation tag. Replace their values, but
    /// neither their number nor their type.
    pub pixels: Rgb,
    /// `width * height` samples of the same type, if there is an alpha channel. They are written again.
    pub alpha: Option<Samples>,
    /// Sentences for users on every difference between the original and the written file, besides the
    /// pixels.
    pub notes: Vec<String>,
    orientation: u16,
    tags: Tags,
}

impl Tags {
    /// Leaves out the statements on the colour space, for colours that became sRGB.
    fn drop_profile(&mut self) {
        match self {
            Self::Jpeg(tags) => tags.drop_profile(),
            Self::Png(tags) => tags.drop_profile(),
            Self::Tiff(tags) => tags.drop_profile(),
            Self::Exr(_) => {}
        }
    }
}

fn no_photograph(path: &Path) -> ImageError {
    ImageError::Content {
        path: path.to_path_buf(),
        expected: "a photograph (JPEG, PNG, TIFF or EXR)".into(),
        found: "an NPY array".into(),
    }
}

impl Photograph {
    /// Reads a photograph.
    ///
    /// # Errors
    /// The file cannot be read, is damaged or truncated, too large ([`crate::MAX_PIXELS`]), or no photograph:
    /// an NPY array, a camera's raw file, an EXR without `R G B`. Damaged metadata are no error.
    pub fn read(path: &Path) -> Result<Self, ImageError> {
        // The header is read first: a file that is refused for its size is not read into memory.
        if image_info(path)?.format == FileFormat::Npy {
            return Err(no_photograph(path));
        }
        let bytes =
            std::fs::read(path).map_err(|source| ImageError::Open { path: path.to_path_buf(), source })?;
        Self::of_bytes(bytes, path)
    }

    /// Like [`Photograph::read`], for a file in memory; `path` is only for messages.
    ///
    /// # Errors
    /// Those of [`Photograph::read`].
    pub fn of_bytes(bytes: Vec<u8>, path: &Path) -> Result<Self, ImageError> {
        let format = crate::read::info_of_bytes(&bytes, path)?.format;
        let fail = |fault: io::Error| ImageError::decode(path, format, fault);
        let mut notes = Vec::new();
        let (mut tags, orientation, mut decoded) = match format {
            FileFormat::Jpeg => {
                let decoded = decode(&bytes, path)?;
                let components = crate::jpeg::frame(&mut bytes.as_slice()).map_err(fail)?.components;
                match components {
                    1 => notes.push("Grey became RGB.".into()),
                    4 => notes.push("CMYK was converted to RGB.".into()),
                    _ => {}
                }
                let tags = JpegTags::of(&bytes, &mut notes);
                (Tags::Jpeg(tags), exif_of_bytes(&bytes).orientation, decoded)
            }
            FileFormat::Png => {
                let decoded = decode(&bytes, path)?;
                if decoded.channels < 3 {
                    notes.push("Grey became RGB.".into());
                }
                let (tags, orientation) = PngTags::of(&bytes, &mut notes);
                (Tags::Png(tags), orientation, decoded)
            }
            FileFormat::Tiff => {
                let (tags, orientation) = TiffTags::of(&bytes, &mut notes).map_err(fail)?;
                (Tags::Tiff(tags), orientation, decode(&bytes, path)?)
            }
            FileFormat::Exr => {
                let (tags, decoded) = ExrTags::read(&bytes, path, &mut notes)?;
                (Tags::Exr(Box::new(tags)), 1, decoded)
            }
            FileFormat::Npy => return Err(no_photograph(path)),
        };
        if let Some(name) = color_space::convert(&bytes, format, &mut decoded) {
            notes.push(format!("Its colours were converted from {name} to sRGB."));
            tags.drop_profile();
        }
        drop(bytes);
        let Decoded { width, height, .. } = decoded;
        let (pixels, alpha) = rgb_and_alpha(decoded);
        Ok(Self { width, height, format, pixels, alpha, notes, orientation, tags })
    }

    /// The same photograph with pixels of another size, of the same type as before.
    #[must_use]
    pub fn with_pixels(self, (width, height): (usize, usize), pixels: Rgb, alpha: Option<Samples>) -> Self {
        Self { width, height, pixels, alpha, ..self }
    }

    /// The orientation tag by EXIF or TIFF, 1 to 8; 1 if there is none. The pixels are not turned by it.
    pub fn orientation(&self) -> u16 {
        self.orientation
    }

    /// Writes the present pixels in the format and bit depth of the original, with its metadata. The file is
    /// written under a temporary name in the same folder and then renamed.
    ///
    /// `software` is the name and version of the program, `history` one line that says what was done to the
    /// pixels. If the EXIF data of a JPEG are full (64 KiB) or damaged, both texts become a comment.
    ///
    /// # Errors
    /// The file cannot be written, as on a full disk, or the pixels or alpha changed their number or type.
    pub fn write(&self, path: &Path, software: &str, history: &str) -> Result<(), ImageError> {
        write_atomically(path, |out| self.encode(out, software, history))
            .map_err(|e| ImageError::write(path, e))
    }

    /// The pixels by rows, if they have the number and type that the file needs.
    fn rows(&self) -> io::Result<SampleRows<'_>> {
        let wrong = |what: &str| io::Error::other(format!("{what} of {}x{} pixels", self.width, self.height));
        let count = self.width * self.height;
        let side = |n: usize| u32::try_from(n).map_err(|_| wrong("a side that is too long"));
        if self.pixels.count() != 3 * count {
            return Err(wrong(&format!("{} samples instead of 3 for each", self.pixels.count())));
        }
        let alpha = self.alpha.as_ref();
        if alpha.is_some_and(|a| a.count() != count || !a.same_type(&self.pixels)) {
            return Err(wrong("alpha that does not fit a picture"));
        }
        Ok(SampleRows { width: side(self.width)?, height: side(self.height)?, pixels: &self.pixels, alpha })
    }

    fn encode(&self, out: &mut dyn WriteSeek, software: &str, history: &str) -> io::Result<()> {
        let rows = self.rows()?;
        match (&self.tags, &self.pixels) {
            (Tags::Jpeg(tags), Samples::Eight(pixels)) if rows.alpha.is_none() => {
                tags.write(out, (rows.width, rows.height), pixels, software, history)
            }
            (Tags::Png(tags), Samples::Eight(_) | Samples::Sixteen(_)) => {
                tags.write(out, &rows, software, history)
            }
            (Tags::Tiff(tags), _) => tiff_write::write(out, tags, &rows, software, history),
            (Tags::Exr(tags), Samples::Float(_)) => tags.write(out, &rows, software, history),
            _ => Err(io::Error::other(format!("{} files hold no such samples", self.format))),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Cursor, Seek, SeekFrom, Write};

    use image::{DynamicImage, ImageFormat};

    use super::*;

    /// A disk that is full after some bytes.
    struct FullDisk(usize);

    impl Write for FullDisk {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if self.0 == 0 {
                return Err(io::ErrorKind::StorageFull.into());
            }
            let taken = bytes.len().min(self.0);
            self.0 -= taken;
            Ok(taken)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    impl Seek for FullDisk {
        fn seek(&mut self, _: SeekFrom) -> io::Result<u64> {
            Ok(0)
        }
    }

    #[test]
    fn a_full_disk_is_an_error_of_every_format() {
        let picture = image::RgbImage::from_fn(64, 48, |x, y| image::Rgb([x as u8, y as u8, (x * y) as u8]));
        let mut files = Vec::new();
        for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff] {
            let mut bytes = Cursor::new(Vec::new());
            DynamicImage::ImageRgb8(picture.clone()).write_to(&mut bytes, format).unwrap();
            files.push(bytes.into_inner());
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        crate::write_exr(&path, &crate::decode(&files[1], Path::new("p")).unwrap().to_image()).unwrap();
        files.push(std::fs::read(&path).unwrap());
        for bytes in files {
            let photograph = Photograph::of_bytes(bytes, Path::new("a")).unwrap();
            let mut whole = Cursor::new(Vec::new());
            photograph.encode(&mut whole, "3D-USE", "test").unwrap();
            let length = whole.into_inner().len();
            for room in [0, 1, 20, 100, length / 2, length - 1] {
                let result = photograph.encode(&mut FullDisk(room), "3D-USE", "test");
                let said = result.unwrap_err().to_string();
                assert!(said.contains("no storage space"), "{} after {room}: {said}", photograph.format);
            }
        }
    }
}
