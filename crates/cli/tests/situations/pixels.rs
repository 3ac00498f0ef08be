//! Pixels, names and masks as people have them: what files say about their pixels is honoured, names match as
//! people mean them, and masks of all usual forms have their effect or are named.

use std::path::{Path, PathBuf};

use serde_json::Value;
use use3d_capture::FileName;
use use3d_check::Severity;
use use3d_io_colmap::{read_model, write_model_binary};
use use3d_synth::ChosenFault;

use super::{SEED, examined, faulty, finding, imported, sound};

/// The sound capture with other names of images in its model.
fn named(dir: &Path, name: &str, by: impl Fn(usize, &str) -> String) -> PathBuf {
    let at = sound(dir, name);
    let mut model = read_model(&at.join("sparse/0")).unwrap();
    for (index, image) in model.images.iter_mut().enumerate() {
        image.name = FileName::new(&by(index, &image.name)).unwrap();
    }
    write_model_binary(&at.join("sparse/0"), &model).unwrap();
    at
}

/// Mean colour of the photographs of an imported capture, in steps of 255.
fn mean(out: &Path) -> [f64; 3] {
    let (mut sum, mut count) = ([0.0; 3], 0.0);
    for entry in std::fs::read_dir(out.join("images")).unwrap() {
        let image = use3d_io_image::read_image(&entry.unwrap().path()).unwrap();
        for (sum, plane) in sum.iter_mut().zip(image.planes()) {
            *sum += plane.iter().map(|v| 255.0 * f64::from(*v)).sum::<f64>() / plane.len() as f64;
        }
        count += 1.0;
    }
    sum.map(|s| s / count)
}

fn views(document: &Value) -> usize {
    document["views"].as_array().unwrap().len()
}

#[test]
fn icc_profile() {
    let dir = tempfile::tempdir().unwrap();
    let (_, _, out) = imported(&sound(dir.path(), "sound")).unwrap();
    let expected = mean(&out);
    for fault in ["adobe-rgb", "linear-png"] {
        let (document, text, out) = imported(&faulty(dir.path(), fault)).unwrap();
        assert_eq!(views(&document), 12);
        assert!(text.contains("to sRGB"), "{fault}: {text}");
        let found = mean(&out);
        let far = expected.iter().zip(found).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(far < 4.0, "{fault}: {found:?}, and {expected:?} without it");
    }
}

#[test]
fn low_range_16() {
    let dir = tempfile::tempdir().unwrap();
    let found = finding(&faulty(dir.path(), "few-bits"), "range");
    let text = &found.text;
    assert!(
        found.severity == Severity::Minor && text.contains("the lower 12") && text.contains("16 times"),
        "{text}"
    );
}

#[test]
fn grain_is_named_and_not_taken_for_other_photographs() {
    let dir = tempfile::tempdir().unwrap();
    for fault in ["noisy:weak", "noisy", "noisy:strong"] {
        let findings = examined(&faulty(dir.path(), fault)).unwrap().1;
        let subjects: Vec<&str> = findings.iter().map(|f| f.subject).collect();
        assert!(subjects.contains(&"grain"), "{fault}: {subjects:?}");
        let others = findings.iter().find(|f| f.subject == "photographs" && f.severity == Severity::Serious);
        assert!(others.is_none(), "{fault}: {others:?}");
    }
}

/// The mean share that the masks of an imported capture hide.
fn hidden(out: &Path) -> f64 {
    let masks = std::fs::read_dir(out.join("masks")).map(|all| all.map(|entry| entry.unwrap().path()));
    let shares = masks.into_iter().flatten().map(|path| {
        let mask = use3d_io_image::read_map(&path).unwrap();
        mask.data().iter().filter(|v| **v < 0.5).count() as f64 / mask.data().len() as f64
    });
    let shares: Vec<f64> = shares.collect();
    shares.iter().sum::<f64>() / shares.len().max(1) as f64
}

#[test]
fn overlay_is_learnt() {
    let dir = tempfile::tempdir().unwrap();
    assert_eq!(hidden(&imported(&sound(dir.path(), "sound")).unwrap().2), 0.0);
    // The share of the picture that is no scene.
    for (fault, share) in [("bars", 0.156), ("display", 0.1), ("port-rim", 0.07), ("gripper", 0.09)] {
        let (_, text, out) = imported(&faulty(dir.path(), fault)).unwrap();
        assert!(
            text.contains("in the same place") && text.contains("import.hide_overlay=false"),
            "{fault}: {text}"
        );
        let found = hidden(&out);
        // The pixels beside it are hidden, too.
        assert!((0.8 * share..share + 0.06).contains(&found), "{fault}: {found} of {share}");
    }
    // Masks of the user stay, and both count.
    let capture = faulty(dir.path(), "masks-zero-one");
    "bars".parse::<ChosenFault>().unwrap().spoil(&capture, SEED).unwrap();
    let (alone, both) =
        (hidden(&imported(&faulty(dir.path(), "masks-black")).unwrap().2), imported(&capture));
    assert_eq!(alone, 1.0);
    let both = hidden(&both.unwrap().2);
    assert!((0.2..0.6).contains(&both), "{both}");
}

/// The photographs of a capture, sorted.
fn photographs(capture: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(capture.join("images")).unwrap();
    let mut all: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    all.sort();
    all
}

/// Writes a picture of one colour of another size.
fn resize(path: &Path, width: usize, height: usize) {
    use3d_io_image::write_png8(path, &use3d_capture::Raster::filled(width, height, 90)).unwrap();
}

#[test]
fn turned_photos() {
    let dir = tempfile::tempdir().unwrap();
    let turned = sound(dir.path(), "turned");
    photographs(&turned)[4..6].iter().for_each(|path| resize(path, 64, 96));
    let (document, text, _) = imported(&turned).unwrap();
    assert_eq!(views(&document), 10);
    assert!(text.contains("turned by 90 degrees"), "{text}");
    let smaller = sound(dir.path(), "smaller");
    photographs(&smaller).iter().for_each(|path| resize(path, 72, 48));
    let (document, text, _) = imported(&smaller).unwrap();
    assert_eq!(views(&document), 12);
    assert!(text.contains("the lens is scaled"), "{text}");
}

#[test]
fn files_that_cannot_be_read_are_left_out_and_named() {
    let dir = tempfile::tempdir().unwrap();
    let capture = sound(dir.path(), "damaged");
    let files = photographs(&capture);
    std::fs::write(&files[2], "").unwrap();
    std::fs::write(&files[3], b"\0\0\0\x18ftypheic\0\0\0\0mif1heic".repeat(40)).unwrap();
    let bytes = std::fs::read(&files[4]).unwrap();
    std::fs::write(&files[4], &bytes[..bytes.len() / 2]).unwrap();
    let (document, text, _) = imported(&capture).unwrap();
    assert_eq!(views(&document), 9, "{text}");
    assert!(text.contains("left out") && text.contains("the file is empty"), "{text}");
    let found = finding(&capture, "unusable");
    assert!(found.severity == Severity::Minor && found.text.contains("3 of 12"), "{found:?}");
    assert_eq!(views(&imported(&faulty(dir.path(), "no-end")).unwrap().0), 12);
}

#[test]
fn model_prefix_names_and_names_nfd() {
    let dir = tempfile::tempdir().unwrap();
    type Rename = fn(&str) -> String;
    let cases: [(&str, Rename); 4] = [
        ("prefix", |name| format!("images/{name}")),
        ("full-path", |name| format!("Users\\diver\\2026 reef\\{name}")),
        ("extension", |name| name.replace(".png", ".JPG")),
        ("letter-case", |name| name.to_uppercase()),
    ];
    for (case, by) in cases {
        let (document, text, _) = imported(&named(dir.path(), case, |_, name| by(name))).unwrap();
        assert_eq!(views(&document), 12, "{case}: {text}");
        assert!(!text.contains("not known where the camera was"), "{case}: {text}");
    }
    let umlauts = named(dir.path(), "umlauts", |i, _| format!("H\u{f6}hle %d_{i:04}.png"));
    for (i, path) in photographs(&umlauts).iter().enumerate() {
        std::fs::rename(path, path.with_file_name(format!("Ho\u{308}hle %d_{i:04}.png"))).unwrap();
    }
    assert_eq!(views(&imported(&umlauts).unwrap().0), 12);
    let twice = sound(dir.path(), "twice");
    for path in photographs(&twice) {
        for folder in ["left", "right"] {
            let to = twice.join("images").join(folder);
            std::fs::create_dir_all(&to).unwrap();
            std::fs::copy(&path, to.join(path.file_name().unwrap())).unwrap();
        }
        std::fs::remove_file(&path).unwrap();
    }
    let text = imported(&twice).unwrap_err();
    assert!(text.contains("left/") && text.contains("right/") && text.contains("image_dir"), "{text}");
}

#[test]
fn natural_order() {
    let dir = tempfile::tempdir().unwrap();
    let capture = named(dir.path(), "numbers", |i, _| format!("{}.png", i + 1));
    for (i, path) in photographs(&capture).iter().enumerate() {
        std::fs::rename(path, path.with_file_name(format!("{}.png", i + 1))).unwrap();
    }
    let (document, ..) = imported(&capture).unwrap();
    let names: Vec<&str> =
        document["views"].as_array().unwrap().iter().map(|v| v["name"].as_str().unwrap()).collect();
    let expected: Vec<String> = (1..=12).map(|i| format!("{i}.png")).collect();
    assert_eq!(names, expected);
}

/// Fails unless the masks of a capture hide the left quarter.
fn check_masks(capture: &Path) {
    let loaded = use3d_import::import(capture, &use3d_import::ImportParams::default()).unwrap();
    let case = capture.display();
    assert_eq!(loaded.capture.views.len(), 12, "{case}");
    assert!(loaded.report.extra.is_empty(), "{case}: {:?}", loaded.report.extra);
    let mask = use3d_import::load_mask(&loaded.capture.views[3]).unwrap();
    let mask = mask.unwrap_or_else(|| panic!("{case} has no mask"));
    let (w, h) = (mask.width(), mask.height());
    assert_eq!((w, h), (96, 64), "{case}");
    for (x, expected) in [(2, 0.0), (w / 4 - 2, 0.0), (w / 4 + 2, 1.0), (w - 2, 1.0)] {
        assert_eq!(mask.data()[(h / 2) * w + x], expected, "{case} at {x}");
    }
}

/// Masks of one white: the left quarter is hidden, but for masks inverted the rest.
fn mask(path: &Path, white: u8, inverted: bool) {
    let mut picture = use3d_capture::Raster::<u8, 3>::filled(96, 64, 0);
    for (at, value) in picture.data_mut().iter_mut().enumerate() {
        *value = if (at % 96 < 24) == inverted { white } else { 0 };
    }
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    use3d_io_image::write_png8(path, &picture).unwrap();
}

#[test]
fn mask_forms_and_masks_beside_photos() {
    let dir = tempfile::tempdir().unwrap();
    let places = [
        "masks/NAME.png",
        "mask/NAME.png",
        "Masks/NAME.png",
        "images/NAME_mask.png",
        "images/NAME.png.mask.png",
    ];
    for (case, place) in places.into_iter().enumerate() {
        let capture = sound(dir.path(), &format!("masks-{case}"));
        for path in photographs(&capture) {
            let stem = path.file_stem().unwrap().to_str().unwrap();
            mask(&capture.join(place.replace("NAME", stem)), if case == 0 { 1 } else { 255 }, false);
        }
        check_masks(&capture);
    }
    check_masks(&faulty(dir.path(), "masks-turned"));
}

#[test]
fn masks_mark_the_diver() {
    let dir = tempfile::tempdir().unwrap();
    let capture = sound(dir.path(), "inverted");
    for path in photographs(&capture) {
        mask(&capture.join("masks").join(path.file_name().unwrap()), 255, true);
    }
    let found = finding(&capture, "inverted");
    assert!(found.severity == Severity::Serious && found.text.contains("probably exchanged"), "{found:?}");
}
