//! Changed bytes give a photograph or an error, never a panic; a photograph can be written and read again.

use std::path::Path;

use use3d_golden::mutated;
use use3d_io_image::{Photograph, photograph_info};

use crate::fixtures::*;

fn survives(bytes: Vec<u8>, folder: &Path) -> bool {
    let info = folder.join("info");
    std::fs::write(&info, &bytes).unwrap();
    let _ = photograph_info(&info);
    let Ok(photograph) = Photograph::of_bytes(bytes, Path::new("mutated")) else { return false };
    let path = folder.join("new");
    if photograph.write(&path, SOFTWARE, HISTORY).is_err() {
        return false;
    }
    let again = Photograph::read(&path).unwrap();
    assert_eq!((again.width, again.height), (photograph.width, photograph.height));
    assert_eq!(again.orientation(), photograph.orientation());
    true
}

#[test]
fn mutated_photographs_never_panic() {
    let dir = tempfile::tempdir().unwrap();
    let picture = image::RgbImage::from_raw(24, 16, pixels(24, 16)).unwrap();
    let encoded = jpeg_pixels(24, 16, image::ExtendedColorType::Rgb8);
    let metadata = [
        (0xE1, [b"Exif\0\0", &exif(false)[..]].concat()),
        (0xE1, [b"http://ns.adobe.com/xap/1.0/\0", XMP].concat()),
        (0xE2, [b"ICC_PROFILE\0\x01\x01", &profile(b"RGB ", 200)[..]].concat()),
        (0xED, iptc()),
    ];
    let seeds = [
        jpeg_with(&encoded, &metadata),
        png_with(&picture.into(), &kept_chunks(), &[]),
        crate::tiff::rgb(false, 8, 3, &[]),
        crate::tiff::rgb(true, 16, 4, &[]),
        crate::exr::exr(true),
    ];
    for (which, seed) in seeds.iter().enumerate() {
        let mut written = 0;
        for round in 0..200 {
            written += usize::from(survives(mutated(seed, b"\0\xFF\x01IM*", round), dir.path()));
        }
        // A checksum protects every chunk of a PNG, and a table of places the lines of an EXR.
        let expected = if which == 1 || which == 4 { 3 } else { 20 };
        assert!(written > expected, "only {written} files of kind {which} were read");
    }
}

#[test]
fn every_byte_of_the_tags_may_be_wrong() {
    let dir = tempfile::tempdir().unwrap();
    let (little, big) = (crate::tiff::rgb(false, 8, 3, &[]), crate::tiff::rgb(true, 8, 3, &[]));
    let exr = crate::exr::exr(false);
    let picture = jpeg_pixels(24, 16, image::ExtendedColorType::Rgb8);
    let jpeg = jpeg_with(&picture, &[(0xE1, [b"Exif\0\0", &exif(true)[..]].concat())]);
    let pixels = 1800;
    for (seed, places) in [
        (&little, (0..8).chain(8 + pixels..little.len())),
        (&big, (0..8).chain(8 + pixels..big.len())),
        (&exr, (0..0).chain(0..exr.len().min(900))),
        (&jpeg, (0..0).chain(0..1000)),
    ] {
        for at in places {
            let mut bytes = seed.clone();
            bytes[at] = [0, 0x7F, 0xFF][at % 3];
            // Files are slow on some disks.
            if at % 4 == 0 {
                survives(bytes, dir.path());
            } else {
                let _ = Photograph::of_bytes(bytes, Path::new("mutated"));
            }
        }
    }
}
