//! Every format is written and read, with its precision, its alpha channel, and errors that name the file.

use std::path::Path;

use image::{DynamicImage, ImageFormat};
use proptest::prelude::*;
use use3d_capture::{Image, Map, Pixels, Raster};
use use3d_io_image::*;

fn gradient(width: usize, height: usize) -> Image {
    let mut image = Image::new(width, height);
    for y in 0..height {
        for x in 0..width {
            let (u, v) = (x as f32 / width as f32, y as f32 / height as f32);
            image.set_pixel(x, y, [u, v, 0.5 * (u + v)]);
        }
    }
    image
}

fn save(path: &Path, image: &DynamicImage, format: ImageFormat) {
    image.save_with_format(path, format).unwrap();
}

#[test]
fn exr_keeps_every_bit_and_the_same_bytes_every_time() {
    let dir = tempfile::tempdir().unwrap();
    let mut image = gradient(33, 17);
    image.set_pixel(3, 4, [-2.5, 1e-30, 7e8]);
    let (a, b) = (dir.path().join("a.exr"), dir.path().join("b.exr"));
    write_exr(&a, &image).unwrap();
    write_exr(&b, &image).unwrap();
    assert_eq!(read_image(&a).unwrap(), image);
    assert_eq!(std::fs::read(&a).unwrap(), std::fs::read(&b).unwrap());
    assert_eq!(image_size(&a).unwrap(), (33, 17));

    let depth = Map::from_planes(5, 2, (0..10).map(|v| v as f32 * 1.7).collect()).unwrap();
    for channel in ["Z", "A"] {
        let path = dir.path().join(format!("{channel}.exr"));
        write_exr_map(&path, &depth, channel).unwrap();
        assert_eq!(read_map(&path).unwrap(), depth);
    }
}

#[test]
fn png_rounds_half_up_and_clamps_and_reads_back() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("deep/folder/a.png");
    let mut image = gradient(20, 9);
    image.set_pixel(0, 0, [-1.0, 2.0, 0.5]);
    write_png(&path, &image).unwrap();
    assert_eq!(read_pixels(&path).unwrap(), Pixels::Eight(image.to_8bit()));
    assert_eq!(read_image(&path).unwrap().pixel(0, 0), [0.0, 1.0, 128.0 / 255.0]);

    let sixteen = Raster::<u16, 3>::from_planes(2, 1, vec![0, 65535, 1, 300, 40000, 7]).unwrap();
    write_png_pixels(&path, &Pixels::Sixteen(sixteen.clone())).unwrap();
    assert_eq!(read_pixels(&path).unwrap(), Pixels::Sixteen(sixteen));

    let map = Map::from_planes(3, 1, vec![0.0, 0.25, 1.0]).unwrap();
    write_png_map16(&path, &map).unwrap();
    assert!((read_map(&path).unwrap().data()[1] - 0.25).abs() < 1e-5);
    write_png_map(&path, &map).unwrap();
    assert_eq!(read_map(&path).unwrap().data(), [0.0, 64.0 / 255.0, 1.0]);
}

#[test]
fn alpha_is_kept_apart_from_colour() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.png");
    let rgba = image::RgbaImage::from_raw(2, 1, vec![10, 20, 30, 255, 40, 50, 60, 51]).unwrap();
    save(&path, &DynamicImage::ImageRgba8(rgba), ImageFormat::Png);
    assert!(image_info(&path).unwrap().alpha);
    let (pixels, alpha) = read_pixels_with_alpha(&path).unwrap();
    assert_eq!(pixels, Pixels::Eight(Raster::from_planes(2, 1, vec![10, 40, 20, 50, 30, 60]).unwrap()));
    assert_eq!(alpha.unwrap().data(), [1.0, 0.2]);
    let grey = image::GrayAlphaImage::from_raw(1, 1, vec![9, 0]).unwrap();
    save(&path, &DynamicImage::ImageLumaA8(grey), ImageFormat::Png);
    let (pixels, alpha) = read_pixels_with_alpha(&path).unwrap();
    assert_eq!(pixels, Pixels::Eight(Raster::from_planes(1, 1, vec![9, 9, 9]).unwrap()));
    assert_eq!(alpha.unwrap().data(), [0.0]);
}

#[test]
fn jpeg_and_tiff_of_all_depths_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let image = gradient(64, 48);
    let eight = image::RgbImage::from_raw(64, 48, image.to_8bit().to_interleaved()).unwrap();
    let jpeg = dir.path().join("misnamed.png"); // the contents decide
    save(&jpeg, &DynamicImage::ImageRgb8(eight.clone()), ImageFormat::Jpeg);
    let info = image_info(&jpeg).unwrap();
    assert_eq!((info.format, info.width, info.height), (FileFormat::Jpeg, 64, 48));
    let read = read_image(&jpeg).unwrap();
    let worst = read.data().iter().zip(image.data()).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
    assert!(worst < 0.1, "{worst}");

    let tiff = dir.path().join("a.tif");
    save(&tiff, &DynamicImage::ImageRgb8(eight), ImageFormat::Tiff);
    assert_eq!(read_pixels(&tiff).unwrap(), Pixels::Eight(image.to_8bit()));
    let deep: Vec<u16> = image.to_interleaved().iter().map(|v| (v * 65535.0) as u16).collect();
    let buffer = image::ImageBuffer::<image::Rgb<u16>, _>::from_raw(64, 48, deep.clone()).unwrap();
    save(&tiff, &DynamicImage::ImageRgb16(buffer), ImageFormat::Tiff);
    assert_eq!(
        read_pixels(&tiff).unwrap(),
        Pixels::Sixteen(Raster::from_interleaved(64, 48, &deep).unwrap())
    );
    let buffer = image::ImageBuffer::<image::Rgb<f32>, _>::from_raw(64, 48, image.to_interleaved()).unwrap();
    save(&tiff, &DynamicImage::ImageRgb32F(buffer), ImageFormat::Tiff);
    assert_eq!(read_image(&tiff).unwrap(), image);
}

#[test]
fn one_channel_float_tiffs_are_read_as_depth() {
    use tiff::encoder::{TiffEncoder, colortype};
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("depth.tiff");
    let values: Vec<f32> = (0..12).map(|v| v as f32 * 0.3 - 1.0).collect();
    let mut encoder = TiffEncoder::new(std::fs::File::create(&path).unwrap()).unwrap();
    encoder.write_image::<colortype::Gray32Float>(4, 3, &values).unwrap();
    assert_eq!(image_size(&path).unwrap(), (4, 3));
    assert_eq!(read_map(&path).unwrap().data(), values);
}

/// The bytes of a version-1 NPY file.
fn npy(descr: &str, fortran: bool, shape: &str, data: &[u8]) -> Vec<u8> {
    let order = if fortran { "True" } else { "False" };
    let mut header = format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': {shape}, }}");
    while (10 + header.len() + 1) % 64 != 0 {
        header.push(' ');
    }
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(data);
    bytes
}

#[test]
fn npy_arrays_of_every_kind_are_read_as_maps() {
    let path = Path::new("depth.npy");
    let expected: Vec<f32> = (0..6).map(|v| v as f32).collect(); // 2 rows of 3
    let map = |bytes: &[u8]| decode(bytes, path).unwrap().to_map().into_data();
    let le = |v: &f32| v.to_le_bytes().to_vec();
    let data: Vec<u8> = expected.iter().flat_map(le).collect();
    for shape in ["(2, 3)", "(2, 3, 1)"] {
        assert_eq!(map(&npy("<f4", false, shape, &data)), expected);
    }
    let column_major: Vec<u8> = [0, 3, 1, 4, 2, 5].iter().flat_map(|&i| le(&expected[i])).collect();
    assert_eq!(map(&npy("<f4", true, "(2, 3)", &column_major)), expected);
    let data: Vec<u8> = expected.iter().flat_map(|v| f64::from(*v).to_be_bytes()).collect();
    assert_eq!(map(&npy(">f8", false, "(2, 3)", &data)), expected);
    let data: Vec<u8> = expected.iter().flat_map(|v| (*v as i64).to_le_bytes()).collect();
    assert_eq!(map(&npy("<i8", false, "(2, 3)", &data)), expected);
    // 0, 1, 2, 3, 4, 5 as IEEE half.
    let half = [0u16, 0x3C00, 0x4000, 0x4200, 0x4400, 0x4500];
    let data: Vec<u8> = half.iter().flat_map(|v| v.to_le_bytes()).collect();
    assert_eq!(map(&npy("<f2", false, "(2, 3)", &data)), expected);
    let data: Vec<u8> = [0u16, 65535, 0, 0, 0, 0].iter().flat_map(|v| v.to_le_bytes()).collect();
    assert_eq!(map(&npy("<u2", false, "(2, 3)", &data))[1], 1.0);
    assert_eq!(map(&npy("|b1", false, "(1, 2)", &[0, 1])), [0.0, 1.0]);
    let wide = npy("<f4", false, "(2, 3, 5)", &[0; 120]);
    assert!(decode(&wide, path).unwrap_err().to_string().contains("[H, W]"));
}

#[test]
fn what_is_not_finite_in_a_map_is_unknown() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("d.npy");
    let data: Vec<u8> = [1.0f32, f32::NAN, f32::INFINITY].iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(&path, npy("<f4", false, "(1, 3)", &data)).unwrap();
    assert_eq!(read_map(&path).unwrap().data(), [1.0, 0.0, 0.0]);
}

#[test]
fn a_truncated_jpeg_is_an_error_not_a_half_grey_picture() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.jpg");
    let eight = image::RgbImage::from_raw(64, 48, gradient(64, 48).to_8bit().to_interleaved()).unwrap();
    save(&path, &DynamicImage::ImageRgb8(eight), ImageFormat::Jpeg);
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() * 3 / 4]).unwrap();
    let message = read_image(&path).unwrap_err().to_string();
    assert!(message.contains("a.jpg") && message.contains("end marker"), "{message}");
    // Data that some cameras append after the picture is no reason to refuse the file.
    std::fs::write(&path, [bytes.as_slice(), b"maker's trailer"].concat()).unwrap();
    read_image(&path).unwrap();
}

#[test]
fn lying_headers_are_refused_before_memory_is_asked_for() {
    let path = Path::new("lie.png");
    let mut png = Vec::new();
    let small = image::RgbImage::new(1, 1);
    small.write_to(&mut std::io::Cursor::new(&mut png), ImageFormat::Png).unwrap();
    let announce = |w: u32, h: u32| {
        let mut lie = png.clone();
        lie[16..20].copy_from_slice(&w.to_be_bytes());
        lie[20..24].copy_from_slice(&h.to_be_bytes());
        let crc = crc32(&lie[12..29]);
        lie[29..33].copy_from_slice(&crc.to_be_bytes());
        decode(&lie, path).unwrap_err().to_string()
    };
    let message = announce(60_000, 60_000);
    assert!(message.contains("60000x60000") && message.contains("134217728"), "{message}");
    let message = announce(10_000, 10_000);
    assert!(message.contains("cannot be stored"), "{message}");
    let message = decode(&npy("<f4", false, "(11000, 11000)", &[0; 16]), path).unwrap_err().to_string();
    assert!(message.contains("cannot be stored"), "{message}");
    let message = decode(&npy("<f4", false, "(100, 100)", &[0; 16]), path).unwrap_err().to_string();
    assert!(message.contains("16 bytes follow"), "{message}");
    let nested = npy("<f4", false, &"(".repeat(2000), &[]);
    assert!(decode(&nested, path).unwrap_err().to_string().contains("one array of numbers"));
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |mut crc, &b| {
        crc ^= u32::from(b);
        for _ in 0..8 {
            crc = (crc >> 1) ^ (0xEDB8_8320 & (crc & 1).wrapping_neg());
        }
        crc
    })
}

#[test]
fn errors_name_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("nothing.png");
    assert!(read_image(&path).unwrap_err().to_string().contains("nothing.png"));
    std::fs::write(&path, b"GIF89a....").unwrap();
    let message = read_image(&path).unwrap_err().to_string();
    assert!(message.contains("nothing.png") && message.contains("PNG, JPEG"), "{message}");
    std::fs::write(&path, b"").unwrap();
    assert!(matches!(read_image(&path), Err(ImageError::Empty { .. })));
    assert!(write_png(dir.path(), &gradient(2, 2)).is_err());
    assert!(write_png(&path, &Image::new(0, 3)).is_err());
    assert!(write_exr(&path, &Image::new(0, 3)).is_err());
}

/// One small valid file of every format.
fn seeds() -> Vec<Vec<u8>> {
    let dir = tempfile::tempdir().unwrap();
    let image = gradient(19, 13);
    let eight = image::RgbImage::from_raw(19, 13, image.to_8bit().to_interleaved()).unwrap();
    let mut seeds = Vec::new();
    for format in [ImageFormat::Png, ImageFormat::Jpeg, ImageFormat::Tiff] {
        let mut bytes = std::io::Cursor::new(Vec::new());
        eight.write_to(&mut bytes, format).unwrap();
        seeds.push(bytes.into_inner());
    }
    let path = dir.path().join("a.exr");
    write_exr(&path, &image).unwrap();
    seeds.push(std::fs::read(&path).unwrap());
    let path = dir.path().join("a.tif");
    let mut encoder = tiff::encoder::TiffEncoder::new(std::fs::File::create(&path).unwrap()).unwrap();
    encoder.write_image::<tiff::encoder::colortype::Gray32Float>(2, 2, &[0.0, 1.0, 2.0, 3.0]).unwrap();
    seeds.push(std::fs::read(&path).unwrap());
    seeds.push(npy("<f4", false, "(4, 4)", &[7; 64]));
    seeds
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 600, failure_persistence: None, rng_seed: proptest::test_runner::RngSeed::Fixed(7), ..ProptestConfig::default() })]

    /// A changed file gives a picture or an error.
    #[test]
    fn mutated_files_never_panic(which in 0usize..6, edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8), cut in any::<prop::sample::Index>(), truncate in any::<bool>()) {
        thread_local!(static SEEDS: Vec<Vec<u8>> = seeds());
        let mut bytes = SEEDS.with(|s| s[which].clone());
        for (at, value) in edits {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if truncate {
            bytes.truncate(cut.index(bytes.len()));
        }
        if let Ok(decoded) = decode(&bytes, Path::new("mutated")) {
            let (w, h) = decoded.to_pixels().size();
            prop_assert_eq!((w, h), (decoded.width, decoded.height));
            decoded.to_map();
        }
    }
}
