//! JPEG: segments are kept as bytes, except for those that belong to the old pixels.

use image::ExtendedColorType;
use use3d_io_image::{FileFormat, Photograph, Rgb, exif_of_bytes, photograph_info, straighten};

use crate::fixtures::*;
use crate::inverted;

fn starts(all: &[(u8, Vec<u8>)], marker: u8, start: &[u8]) -> Vec<Vec<u8>> {
    all.iter().filter(|(m, b)| *m == marker && b.starts_with(start)).map(|(_, b)| b.clone()).collect()
}

#[test]
fn every_segment_is_kept_and_the_history_is_added() {
    for big in [false, true] {
        let original = jpeg(big);
        let (photograph, written) = inverted(&original, "DSC_1.jpg");
        assert_eq!((photograph.orientation(), photograph.width, photograph.height), (6, 48, 32));
        assert_eq!((photograph.format, photograph.notes.len()), (FileFormat::Jpeg, 0));
        let (old, new) = (segments(&original), segments(&written));
        let tables = |m: u8| matches!(m, 0xDB | 0xC0 | 0xC4);
        let kept: Vec<_> = new.iter().filter(|(m, _)| !tables(*m)).collect();
        let expected: Vec<_> = old.iter().filter(|(m, _)| !tables(*m)).collect();
        assert_eq!(kept.len(), expected.len());
        for (kept, expected) in kept.iter().zip(&expected) {
            if expected.1.starts_with(b"Exif") {
                // No byte moved, except for the pointer in the header; the thumbnail left.
                assert_eq!(kept.1[14..700], expected.1[14..700]);
                assert!(!kept.1.windows(THUMBNAIL.len()).any(|w| w == THUMBNAIL));
                let has = |text: &str| kept.1.windows(text.len()).any(|w| w == text.as_bytes());
                assert!(has(SOFTWARE) && has(&format!("{HISTORY} (Software before: HD9.01.01.70.00)")));
            } else {
                assert_eq!(kept, expected);
            }
        }
        // Quality 95 and no chroma subsampling.
        let frame = &new.iter().find(|(m, _)| *m == 0xC0).unwrap().1;
        assert_eq!(frame[5..], [3, 1, 0x11, 0, 2, 0x11, 1, 3, 0x11, 1]);
        let table = &new.iter().find(|(m, _)| *m == 0xDB).unwrap().1;
        assert_eq!(table[1..8], [2, 1, 1, 1, 1, 1, 2]);
        let (before, after) = (exif_of_bytes(&original), exif_of_bytes(&written));
        assert_eq!((before.camera, before.gps), (after.camera, after.gps));
        assert_eq!(before.gps.unwrap().altitude, Some(-12.5));
        // The tag can still be set, as for a prepared copy.
        let mut straight = written.clone();
        straighten(&mut straight);
        assert_eq!(exif_of_bytes(&straight).orientation, 1);
    }
}

#[test]
fn segments_of_the_old_pixels_are_left_out() {
    let mut all = kept_segments(false);
    let thumbnail = [&b"JFIF\0\x01\x02\x01\0\x48\0\x48\x01\x01"[..], &[1, 2, 3]].concat();
    all[0].1 = thumbnail;
    all.insert(1, (0xE0, b"JFXX\0\x10\xFF\xD8".to_vec()));
    all.push((0xE2, b"MPF\0II*\0".to_vec()));
    all.push((0xEB, b"JP\0\x01c2pa".to_vec()));
    all.push((0xEE, b"Adobe\0d\0\0\0\0\x01".to_vec()));
    let bytes = jpeg_with(&jpeg_pixels(48, 32, ExtendedColorType::Rgb8), &all);
    let with_another = [&bytes[..], &jpeg(false)].concat();
    let (photograph, written) = inverted(&with_another, "a.jpg");
    assert_eq!(photograph.notes.len(), 2, "{:?}", photograph.notes);
    assert!(photograph.notes[0].contains("Further pictures"));
    let new = segments(&written);
    let head = starts(&new, 0xE0, b"");
    assert_eq!(head, [b"JFIF\0\x01\x02\x01\0\x48\0\x48\0\0".to_vec()]);
    for (marker, start) in [(0xE2, &b"MPF"[..]), (0xEB, b"JP"), (0xEE, b"Adobe")] {
        assert!(starts(&new, marker, start).is_empty());
    }
    assert!(written.ends_with(b"\xFF\xD9") && written.len() < with_another.len());
    assert_eq!(starts(&new, 0xE2, b"ICC_PROFILE").len(), 2);
}

#[test]
fn a_file_without_exif_gains_some_and_grey_and_cmyk_lose_their_profile() {
    let bare = jpeg_pixels(20, 10, ExtendedColorType::Rgb8);
    for bytes in [bare.clone(), jpeg_with(&bare, &[])] {
        let (photograph, written) = inverted(&bytes, "bare.jpg");
        assert_eq!((photograph.orientation(), photograph.notes.len()), (1, 0));
        assert_eq!(starts(&segments(&written), 0xE1, b"Exif\0\0II*\0").len(), 1);
    }
    let mut all = profile_segments(&profile(b"GRAY", 300));
    let grey = jpeg_with(&jpeg_pixels(20, 10, ExtendedColorType::L8), &all);
    let (photograph, written) = inverted(&grey, "grey.jpg");
    let Rgb::Eight(pixels) = &photograph.pixels else { panic!("8 bits") };
    assert!(pixels.chunks_exact(3).all(|p| p[0] == p[1] && p[1] == p[2]) && pixels.len() == 600);
    assert!(photograph.notes.iter().any(|n| n == "Grey became RGB."), "{:?}", photograph.notes);
    assert!(photograph.notes.iter().any(|n| n.contains("GRAY") && n.contains("left out")));
    assert!(starts(&segments(&written), 0xE2, b"").is_empty());
    all = profile_segments(&profile(b"CMYK", 300));
    let cmyk = jpeg_with(&jpeg_pixels(20, 10, ExtendedColorType::Rgb8), &all);
    let (photograph, written) = inverted(&cmyk, "cmyk-profile.jpg");
    assert!(photograph.notes[0].contains("CMYK"), "{:?}", photograph.notes);
    assert!(starts(&segments(&written), 0xE2, b"").is_empty());
}

#[test]
fn exif_that_is_full_or_broken_stays_and_the_history_becomes_a_comment() {
    let mut full = exif(false);
    full.extend(vec![7; 65_500 - full.len()]); // nothing is known about these bytes, so they stay
    let broken = b"II*\0\xFF\xFF\xFF\x7F".to_vec();
    for (block, notes) in [(full, 0), (broken, 1)] {
        let segment = (0xE1, [b"Exif\0\0", &block[..]].concat());
        let comment = (0xFE, b"a diver's comment".to_vec());
        let encoded = jpeg_pixels(20, 10, ExtendedColorType::Rgb8);
        let bytes = jpeg_with(&encoded, &[segment.clone(), comment.clone()]);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.jpg");
        std::fs::write(&path, &bytes).unwrap();
        let photograph = Photograph::read(&path).unwrap();
        assert_eq!(photograph.notes.len(), notes, "{:?}", photograph.notes);
        photograph.write(&path, SOFTWARE, HISTORY).unwrap();
        let new = segments(&std::fs::read(&path).unwrap());
        assert_eq!(new[..2], [segment, comment]);
        assert_eq!(new[2].1, format!("{SOFTWARE}: {HISTORY}").into_bytes());
    }
}

#[test]
fn the_header_tells_size_depth_and_orientation() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.jpg");
    std::fs::write(&path, jpeg(true)).unwrap();
    let info = photograph_info(&path).unwrap();
    assert_eq!((info.width, info.height, info.format), (48, 32, FileFormat::Jpeg));
    assert_eq!((info.bits, info.orientation, info.alpha), (8, 6, false));
}
