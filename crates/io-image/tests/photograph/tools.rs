//! ExifTool and Pillow read what was written, if they are installed. The tests say whether they ran.

use std::path::{Path, PathBuf};
use std::process::Command;

use image::DynamicImage;
use use3d_io_image::Photograph;

use crate::fixtures::*;

/// The output of a program; `None` if it cannot be started.
fn output(program: &str, arguments: &[&str]) -> Option<String> {
    let run = Command::new(program).args(arguments).output().ok()?;
    run.status.success().then(|| String::from_utf8_lossy(&run.stdout).into_owned())
}

/// Photographs of every format, written again: the originals and the new files.
fn written(folder: &Path) -> Vec<(PathBuf, PathBuf)> {
    let sixteen: Vec<u16> = (0..48 * 32 * 3).map(|v| (v * 13 % 65536) as u16).collect();
    let sixteen = DynamicImage::ImageRgb16(image::ImageBuffer::from_raw(48, 32, sixteen).unwrap());
    let icc = (34675, 7, 300, profile(b"RGB ", 300));
    let deflate = |tags: &[Tag]| crate::tiff::rgb(true, 16, 3, tags);
    let files = [
        ("a.jpg", jpeg(false)),
        ("b.jpg", jpeg(true)),
        ("c.jpg", jpeg_with(&jpeg_pixels(48, 32, image::ExtendedColorType::Rgb8), &[])),
        ("d.png", png_with(&sixteen, &kept_chunks(), &[])),
        ("e.tif", deflate(std::slice::from_ref(&icc))),
        ("f.tif", crate::tiff::rgb(false, 8, 4, &[icc])),
        ("g.tif", crate::tiff::rgb(false, 32, 3, &[])),
        ("h.exr", crate::exr::exr(true)),
    ];
    let place = |(name, bytes): &(&str, Vec<u8>)| {
        let (old, new) = (folder.join("old").join(name), folder.join("new").join(name));
        std::fs::create_dir_all(folder.join("old")).unwrap();
        std::fs::write(&old, bytes).unwrap();
        Photograph::read(&old).unwrap().write(&new, SOFTWARE, HISTORY).unwrap();
        (old, new)
    };
    files.iter().map(place).collect()
}

/// ExifTool's lines for a file, without those that may differ: places, sizes and times of the file itself,
/// the storage of the pixels, and the two texts.
fn tags(path: &Path) -> Option<Vec<String>> {
    let text = output("exiftool", &["-a", "-G1", "-s", "-n", "-u", path.to_str()?])?;
    let differs = [
        "[System]",
        "[ExifTool] ExifToolVersion",
        "Software",
        "ImageHistory",
        "History",
        "StripOffsets",
        "StripByteCounts",
        "RowsPerStrip",
        "ThumbnailOffset",
        "ThumbnailLength",
        "ThumbnailImage",
        "[IFD1]",
        "ExifOffset",
        "GPSInfo",
        "PlanarConfiguration",
        "SampleFormat",
        "YCbCrSubSampling",
        "ExifByteOrder",
    ];
    let kept = |l: &&str| !differs.iter().any(|d| l.contains(d));
    Some(text.lines().filter(kept).map(str::to_string).collect())
}

#[test]
fn exiftool_finds_every_tag_and_the_history() {
    if output("exiftool", &["-ver"]).is_none() {
        println!("skipped: exiftool is not installed");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    for (old, new) in written(dir.path()) {
        let name = new.display();
        let missing: Vec<String> = {
            let after = tags(&new).unwrap();
            tags(&old).unwrap().into_iter().filter(|line| !after.contains(line)).collect()
        };
        assert!(missing.is_empty(), "{name}: {missing:#?}");
        let all = output("exiftool", &["-a", "-G1", "-s", new.to_str().unwrap()]).unwrap();
        let has = |what: &str| assert!(all.contains(what), "{name}: no {what} in\n{all}");
        has(SOFTWARE);
        has(HISTORY);
        let before = output("exiftool", &["-a", "-G1", "-s", old.to_str().unwrap()]).unwrap();
        let warnings = |text: &str| text.lines().filter(|l| l.contains("Warning")).count();
        assert_eq!(warnings(&before), warnings(&all), "{name}:\n{all}");
        assert!(!all.contains("Thumbnail"), "{name}:\n{all}");
        if new.extension().is_some_and(|e| e == "jpg") {
            has("YCbCr4:4:4");
        }
    }
    println!("ran exiftool");
}

/// Some versions of Pillow turn a TIFF by its orientation, so the sides are sorted.
const PILLOW: &str = "
import sys
from PIL import Image
for path in sys.argv[1:]:
    with Image.open(path) as im:
        exif = im.getexif()
        icc = im.info.get('icc_profile')
        tags = exif.get(274), exif.get(305), icc and len(icc), exif.get_ifd(0x8825).get(1)
        print(path[-5:], im.format, im.mode, sorted(im.size), *tags)
        im.load()
";

#[test]
fn pillow_reads_the_pixels_and_the_tags() {
    if output("python3", &["-c", "import PIL"]).is_none() {
        println!("skipped: python3 with Pillow is not installed");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let mut arguments = vec!["-c".to_string(), PILLOW.to_string()];
    // Pillow reads no EXR, and of TIFF only 8 bits in colour.
    let can = |name: &str| ["a.jpg", "b.jpg", "c.jpg", "d.png", "f.tif"].contains(&name);
    let new = written(dir.path()).into_iter().map(|(_, new)| new);
    let new = new.filter(|p| can(p.file_name().and_then(|n| n.to_str()).unwrap()));
    arguments.extend(new.map(|p| p.to_str().unwrap().to_string()));
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let said = output("python3", &arguments).unwrap();
    let expected = "\
a.jpg JPEG RGB [32, 48] 6 3D-USE 0.1.0 100000 S
b.jpg JPEG RGB [32, 48] 6 3D-USE 0.1.0 100000 S
c.jpg JPEG RGB [32, 48] None 3D-USE 0.1.0 None None
d.png PNG RGB [32, 48] 6 3D-USE 0.1.0 500 S
f.tif TIFF RGBA [20, 30] 8 3D-USE 0.1.0 300 S
";
    assert_eq!(said, expected);
    println!("ran Pillow");
}
