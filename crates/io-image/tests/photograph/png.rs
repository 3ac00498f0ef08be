//! PNG: chunks are kept as bytes and in their places; 8 bits stay 8, 16 stay 16.

use image::DynamicImage;
use use3d_io_image::{FileFormat, Rgb, photograph_info};

use crate::fixtures::*;
use crate::inverted;

fn find<'a>(all: &'a [(String, Vec<u8>)], name: &str) -> Vec<&'a [u8]> {
    all.iter().filter(|(n, _)| n == name).map(|(_, b)| b.as_slice()).collect()
}

fn eight() -> DynamicImage {
    DynamicImage::ImageRgb8(image::RgbImage::from_raw(48, 32, pixels(48, 32)).unwrap())
}

#[test]
fn chunks_are_kept_on_their_side_of_the_pixels() {
    let late = chunk(b"tIME", &[7, 0xEA, 5, 1, 10, 11, 12]);
    let original = png_with(&eight(), &kept_chunks(), &[late, chunk(b"caBX", b"signature")]);
    let (photograph, written) = inverted(&original, "a.png");
    assert_eq!((photograph.format, photograph.orientation()), (FileFormat::Png, 6));
    assert!(photograph.notes.len() == 1 && photograph.notes[0].contains("caBX"), "{:?}", photograph.notes);
    let (old, new) = (chunks(&original), chunks(&written));
    for name in ["gAMA", "cHRM", "iCCP", "pHYs", "iTXt", "tIME"] {
        assert_eq!(find(&old, name), find(&new, name), "{name}");
    }
    let place = |name: &str| new.iter().position(|(n, _)| n == name).unwrap();
    assert!(place("iCCP") < place("IDAT") && place("IDAT") < place("tIME"));
    let texts = find(&new, "tEXt");
    let expected =
        ["Comment\0a diver's comment".into(), format!("Software\0{SOFTWARE}"), format!("History\0{HISTORY}")];
    assert_eq!(texts, expected.each_ref().map(|t: &String| t.as_bytes()));
    let block = find(&new, "eXIf")[0];
    assert_eq!(block[8..700], exif(true)[8..700]);
    assert!(block.windows(HISTORY.len()).any(|w| w == HISTORY.as_bytes()));
    assert!(find(&new, "caBX").is_empty());
}

#[test]
fn the_depth_and_alpha_stay() {
    let deep: Vec<u16> = (0..40 * 10 * 4).map(|v| (v * 41 % 65536) as u16).collect();
    let deep = image::ImageBuffer::from_raw(40, 10, deep).unwrap();
    let bytes = png_with(&DynamicImage::ImageRgba16(deep), &[], &[chunk(b"eXIf", &exif(false))]);
    let (photograph, written) = inverted(&bytes, "deep.png");
    assert!(
        matches!(photograph.pixels, Rgb::Sixteen(_)) && matches!(photograph.alpha, Some(Rgb::Sixteen(_)))
    );
    assert_eq!(written[24..26], [16, 6]);
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("deep.png");
    std::fs::write(&path, &written).unwrap();
    let info = photograph_info(&path).unwrap();
    assert_eq!((info.bits, info.orientation, info.alpha, info.width), (16, 6, true, 40));

    let rgba = image::RgbaImage::from_fn(9, 7, |x, y| image::Rgba([x as u8, y as u8, 7, (x * y) as u8]));
    let (photograph, written) = inverted(&png_with(&DynamicImage::ImageRgba8(rgba), &[], &[]), "a.png");
    assert_eq!((written[24..26].to_vec(), photograph.notes.len()), (vec![8, 6], 0));
}

/// A PNG with its own header, chunks before the pixels, and rows.
fn raw(bits: u8, color: u8, before: &[Vec<u8>], rows: &[u8]) -> Vec<u8> {
    let head = [&[0, 0, 0, 4, 0, 0, 0, 2, bits, color, 0, 0, 0][..]].concat();
    let parts = [chunk(b"IHDR", &head), before.concat(), chunk(b"IDAT", &stored(rows)), chunk(b"IEND", b"")];
    [&b"\x89PNG\r\n\x1a\n"[..], &parts.concat()].concat()
}

#[test]
fn palettes_and_grey_become_rgb_and_the_notes_say_so() {
    let palette = chunk(b"PLTE", &[1, 2, 3, 40, 50, 60, 7, 8, 9, 100, 110, 120]);
    let background = chunk(b"bKGD", &[1]);
    let bytes = raw(2, 3, &[palette, background], &[0, 0b00_01_10_11, 0, 0b11_10_01_00]);
    let (photograph, written) = inverted(&bytes, "palette.png");
    let Rgb::Eight(pixels) = &photograph.pixels else { panic!("8 bits") };
    assert_eq!(pixels[..6], [1, 2, 3, 40, 50, 60]);
    assert!(photograph.notes[0].contains("palette"), "{:?}", photograph.notes);
    assert!(find(&chunks(&written), "PLTE").is_empty() && find(&chunks(&written), "bKGD").is_empty());

    let profile = chunk(b"iCCP", &[b"grey\0\0", &stored(&profile(b"GRAY", 300))[..]].concat());
    let (photograph, written) = inverted(&raw(4, 0, &[profile], &[0, 0x1F, 0x80, 0, 0xFF, 0x0F]), "grey.png");
    let Rgb::Eight(pixels) = &photograph.pixels else { panic!("8 bits") };
    assert_eq!(pixels[..6], [17, 17, 17, 255, 255, 255]);
    let said = photograph.notes.join(" ");
    assert!(said.contains("Grey became RGB") && said.contains("4 bits") && said.contains("ICC"), "{said}");
    assert!(find(&chunks(&written), "iCCP").is_empty());
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("grey.png");
    std::fs::write(&path, raw(4, 0, &[], &[0, 0x1F, 0x80, 0, 0xFF, 0x0F])).unwrap();
    assert_eq!(photograph_info(&path).unwrap().bits, 8);
}

#[test]
fn an_animation_keeps_its_first_picture() {
    let control = chunk(b"acTL", &[0, 0, 0, 1, 0, 0, 0, 0]);
    let (photograph, written) = inverted(&png_with(&eight(), &[control], &[]), "a.png");
    assert!(photograph.notes[0].contains("animated"), "{:?}", photograph.notes);
    assert!(find(&chunks(&written), "acTL").is_empty());
}
