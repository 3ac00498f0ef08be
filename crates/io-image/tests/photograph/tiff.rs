//! TIFF: tags keep their bytes in both orders; depth, compression and the place of maker notes stay.

use std::path::Path;

use tiff::decoder::Decoder;
use tiff::tags::Tag as Name;
use use3d_io_image::{FileFormat, Photograph, Rgb, photograph_info};

use crate::fixtures::*;
use crate::inverted;

/// The samples of a picture of 30x20 pixels with `samples` of `bits` each.
pub(crate) fn samples(big: bool, bits: u16, samples: usize) -> Vec<u8> {
    let order = Order(big);
    (0..30 * 20 * samples)
        .flat_map(|i| match bits {
            8 => vec![(i % 251) as u8],
            16 => order.short((i * 37 % 65536) as u16),
            _ => order.long((i as f32 / 700.0).to_bits()),
        })
        .collect()
}

pub(crate) fn rgb(big: bool, bits: u16, count: usize, further: &[Tag]) -> Vec<u8> {
    let format = if bits == 32 { 3 } else { 1 };
    tiff(big, (30, 20), (bits, format, count, 2), &samples(big, bits, count), further)
}

fn tag(bytes: &[u8], tag: u16) -> Option<tiff::decoder::ifd::Value> {
    let mut decoder = Decoder::new(std::io::Cursor::new(bytes)).unwrap();
    decoder.find_tag(Name::from_u16_exhaustive(tag)).unwrap()
}

#[test]
fn every_depth_stays_in_both_orders_of_bytes_and_every_compression() {
    for big in [false, true] {
        for (bits, count) in [(8, 3), (8, 4), (16, 3), (16, 4), (32, 3), (32, 4)] {
            let original = rgb(big, bits, count, &[]);
            let (photograph, written) = inverted(&original, "a.tif");
            assert_eq!((photograph.format, photograph.orientation()), (FileFormat::Tiff, 8));
            assert!(photograph.notes.is_empty(), "{:?}", photograph.notes);
            let right = match photograph.pixels {
                Rgb::Eight(_) => bits == 8,
                Rgb::Sixteen(_) => bits == 16,
                Rgb::Float(_) => bits == 32,
            };
            assert!(right && photograph.alpha.is_some() == (count == 4));
            assert_eq!(written[..4], original[..4]);
            for same in [258, 271, 274, 277, 700, 33550, 338] {
                assert_eq!(tag(&original, same), tag(&written, same), "tag {same}");
            }
            assert_eq!(tag(&written, 305).unwrap().into_string().unwrap(), SOFTWARE);
            let said = tag(&written, 0x9213).unwrap().into_string().unwrap();
            assert_eq!(said, format!("{HISTORY} (Software before: Darkroom 2)"));
            // Maker notes stay at their place.
            let place = |b: &[u8]| b.windows(MAKER_NOTE.len()).position(|w| w == MAKER_NOTE);
            assert_eq!(place(&original), place(&written));
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().join("a.tif");
            std::fs::write(&path, &written).unwrap();
            let info = photograph_info(&path).unwrap();
            let expected = (bits as u8, 8, count == 4, 30, 20);
            assert_eq!((info.bits, info.orientation, info.alpha, info.width, info.height), expected);
        }
    }
}

/// A picture of 8 or 16 bits, by the number of a compression and of a predictor.
fn recompressed(bits: u16, code: u16, predictor: u16) -> Vec<u8> {
    use tiff::encoder::{Compression, Predictor, TiffEncoder, colortype};
    let mut bytes = std::io::Cursor::new(Vec::new());
    let compression = match code {
        5 => Compression::Lzw,
        8 => Compression::Deflate(Default::default()),
        32773 => Compression::Packbits,
        _ => Compression::Uncompressed,
    };
    let difference = if predictor == 2 { Predictor::Horizontal } else { Predictor::None };
    let encoder = TiffEncoder::new(&mut bytes).unwrap();
    let mut encoder = encoder.with_compression(compression).with_predictor(difference);
    let values: Vec<u16> = (0..1800).map(|i| (i * 37 % 65536) as u16).collect();
    if bits == 8 {
        let low: Vec<u8> = values.iter().map(|v| *v as u8).collect();
        encoder.write_image::<colortype::RGB8>(30, 20, &low).unwrap();
    } else {
        encoder.write_image::<colortype::RGB16>(30, 20, &values).unwrap();
    }
    bytes.into_inner()
}

#[test]
fn the_compression_and_the_predictor_stay() {
    for bits in [8, 16] {
        for (code, predictor) in [(1, 1), (5, 1), (5, 2), (8, 1), (8, 2), (32773, 1)] {
            let original = recompressed(bits, code, predictor);
            let (photograph, written) = inverted(&original, "a.tif");
            assert!(photograph.notes.is_empty(), "{:?}", photograph.notes);
            assert_eq!(tag(&written, 259).unwrap().into_u16().unwrap(), code);
            let used = tag(&written, 317).map_or(1, |v| v.into_u16().unwrap());
            assert_eq!(used, predictor, "compression {code}, {bits} bits");
        }
    }
}

#[test]
fn what_cannot_be_kept_is_said() {
    let order = Order(true);
    let grey = (262, 3, 1, order.short(1));
    let icc = |space| (34675, 7, 132, profile(space, 132));
    let bytes = tiff(true, (30, 20), (16, 1, 1, 1), &samples(true, 16, 1), &[grey, icc(b"GRAY")]);
    let (photograph, written) = inverted(&bytes, "grey.tif");
    let said = photograph.notes.join(" ");
    assert!(said.contains("Grey became RGB") && said.contains("ICC"), "{said}");
    assert!(tag(&written, 34675).is_none());
    let layers = (37724, 7, 9, b"Layers 12".to_vec());
    let (photograph, written) = inverted(&rgb(true, 8, 3, &[icc(b"RGB "), layers]), "a.tif");
    assert!(photograph.notes[0].contains("Photoshop"), "{:?}", photograph.notes);
    assert_eq!(tag(&written, 34675).unwrap().into_u8_vec().unwrap(), profile(b"RGB ", 132));
    assert!(tag(&written, 37724).is_none());
    let cmyk = tiff(true, (30, 20), (8, 1, 4, 5), &samples(true, 8, 4), &[icc(b"CMYK")]);
    let (photograph, _) = inverted(&cmyk, "cmyk.tif");
    assert!(photograph.notes[0].contains("CMYK was converted"), "{:?}", photograph.notes);
    let depth = tiff(false, (30, 20), (32, 3, 1, 1), &samples(false, 32, 1), &[]);
    assert!(matches!(inverted(&depth, "float.tif").0.pixels, Rgb::Float(_)));
    // A tag whose values lie outside the file, and a directory outside the file.
    let outside = (34853, 4, 1, order.long(0x7FFF_FFFF));
    let (photograph, written) = inverted(&rgb(true, 8, 3, &[outside]), "a.tif");
    assert!(photograph.notes[0].contains("1 of its tags"), "{:?}", photograph.notes);
    assert!(tag(&written, 34853).is_none());
}

#[test]
fn raw_files_and_whole_numbers_of_32_bits_are_refused() {
    let raw = rgb(false, 8, 3, &[(50706, 1, 4, vec![1, 4, 0, 0])]);
    let said = Photograph::of_bytes(raw, Path::new("raw.dng")).unwrap_err().to_string();
    assert!(said.contains("raw.dng") && said.contains("develop"), "{said}");
    let wide = tiff(false, (30, 20), (32, 1, 1, 1), &samples(false, 32, 1), &[]);
    let said = Photograph::of_bytes(wide, Path::new("ids.tif")).unwrap_err().to_string();
    assert!(said.contains("whole numbers"), "{said}");
}
