//! Pixels, names and masks as people have them: what files say about their pixels is honoured, names match as
//! people mean them, and masks of all usual forms have their effect or are named.

mod tiny;

use std::path::{Path, PathBuf};

use serde_json::Value;

/// A small capture with a fault.
fn faulty(dir: &Path, fault: &str) -> PathBuf {
    let at = dir.join(fault.replace(':', "-"));
    let made = tiny::command()
        .args(["-q", "synth", "capture", "--views", "12", "--size", "96x64", "--fault", fault, "--out"])
        .arg(&at)
        .output()
        .unwrap();
    assert!(made.status.success(), "{fault}: {}", String::from_utf8_lossy(&made.stderr));
    at
}

/// The capture that an import makes of a folder, and what it prints; an error's text.
fn imported(capture: &Path) -> Result<(Value, String, PathBuf), String> {
    let out = capture.with_extension("imported");
    let done = tiny::command().arg("import").arg(capture).arg("--out").arg(&out).output().unwrap();
    let text = String::from_utf8_lossy(&done.stderr).into_owned() + &String::from_utf8_lossy(&done.stdout);
    if !done.status.success() {
        return Err(text);
    }
    let document = serde_json::from_slice(&std::fs::read(out.join("capture.json")).unwrap()).unwrap();
    Ok((document, text, out))
}

/// The findings of a check with this subject: severity and text.
fn finding(capture: &Path, subject: &str) -> Option<(String, String)> {
    let done = tiny::command().args(["-q", "check", "--json"]).arg(capture).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let report: Value = serde_json::from_slice(&done.stdout).unwrap();
    let all = report["findings"].as_array().unwrap().iter().find(|f| f["subject"] == subject)?;
    Some((all["severity"].as_str()?.into(), all["text"].as_str()?.into()))
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
    let (_, _, sound) = imported(&faulty(dir.path(), "no-zeros")).unwrap();
    let sound = mean(&sound);
    for fault in ["adobe-rgb", "prophoto-rgb", "display-p3", "linear-png"] {
        let (document, text, out) = imported(&faulty(dir.path(), fault)).unwrap();
        assert_eq!(views(&document), 12);
        assert!(text.contains("to sRGB"), "{fault}: {text}");
        let found = mean(&out);
        let far = sound.iter().zip(found).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(far < 4.0, "{fault}: {found:?}, and {sound:?} without it");
    }
}

#[test]
fn low_range_16() {
    let dir = tempfile::tempdir().unwrap();
    let (severity, text) = finding(&faulty(dir.path(), "few-bits"), "range").unwrap();
    assert!(severity == "minor" && text.contains("the lower 12") && text.contains("16 times"), "{text}");
}

#[test]
fn turned_photos() {
    let dir = tempfile::tempdir().unwrap();
    let (document, text, _) = imported(&faulty(dir.path(), "turned-90")).unwrap();
    assert_eq!(views(&document), 10);
    assert!(text.contains("turned by 90 degrees"), "{text}");
    let (document, text, _) = imported(&faulty(dir.path(), "smaller")).unwrap();
    assert_eq!(views(&document), 12);
    assert!(text.contains("the lens is scaled"), "{text}");
    let text = imported(&faulty(dir.path(), "turn-tag")).unwrap().1;
    assert!(text.contains("EXIF data ask to turn 12"), "{text}");
}

#[test]
fn files_that_cannot_be_read_are_left_out_and_named() {
    let dir = tempfile::tempdir().unwrap();
    for fault in ["empty-file", "cut-off", "other-format"] {
        let capture = faulty(dir.path(), fault);
        let (document, text, _) = imported(&capture).unwrap();
        assert_eq!(views(&document), 11, "{fault}");
        assert!(text.contains("left out"), "{fault}: {text}");
    }
    assert_eq!(finding(&dir.path().join("empty-file"), "unusable").unwrap().0, "minor");
    assert_eq!(views(&imported(&faulty(dir.path(), "no-end")).unwrap().0), 12);
}

#[test]
fn model_prefix_names_and_names_nfd() {
    let dir = tempfile::tempdir().unwrap();
    let faults = [
        "prefix",
        "card-folder",
        "full-path",
        "extension",
        "letter-case",
        "unicode-form",
        "no-zeros",
        "patterns",
    ];
    for fault in faults {
        let (document, text, _) = imported(&faulty(dir.path(), fault)).unwrap();
        assert_eq!(views(&document), 12, "{fault}: {text}");
        assert!(!text.contains("not in the model"), "{fault}: {text}");
    }
    let text = imported(&faulty(dir.path(), "ambiguous")).unwrap_err();
    assert!(text.contains("left/") && text.contains("right/") && text.contains("image_dir"), "{text}");
}

#[test]
fn natural_order() {
    let dir = tempfile::tempdir().unwrap();
    let (document, ..) = imported(&faulty(dir.path(), "no-zeros")).unwrap();
    let names: Vec<&str> =
        document["views"].as_array().unwrap().iter().map(|v| v["name"].as_str().unwrap()).collect();
    let expected: Vec<String> = (1..=12).map(|i| format!("{i}.png")).collect();
    assert_eq!(names, expected);
}

#[test]
fn mask_forms() {
    let dir = tempfile::tempdir().unwrap();
    let faults = [
        "masks-zero-one",
        "masks-alpha",
        "folder-mask",
        "folder-masks-capital",
        "masks-beside",
        "masks-beside-whole",
        "masks-turned",
    ];
    for fault in faults {
        let capture = faulty(dir.path(), fault);
        let loaded = use3d_import::import(&capture, &use3d_import::ImportParams::default()).unwrap();
        assert_eq!(loaded.capture.views.len(), 12, "{fault}");
        assert!(loaded.report.extra.is_empty(), "{fault}: {:?}", loaded.report.extra);
        let mask =
            use3d_import::load_mask(&loaded.capture.views[3]).unwrap().unwrap_or_else(|| panic!("{fault}"));
        let (w, h) = (mask.width(), mask.height());
        assert_eq!((w, h), (96, 64), "{fault}");
        for (x, expected) in [(2, 0.0), (w / 4 - 2, 0.0), (w / 4 + 2, 1.0), (w - 2, 1.0)] {
            assert_eq!(mask.data()[(h / 2) * w + x], expected, "{fault} at {x}");
        }
    }
}

#[test]
fn masks_mark_the_diver() {
    let dir = tempfile::tempdir().unwrap();
    let (severity, text) = finding(&faulty(dir.path(), "masks-inverted"), "inverted").unwrap();
    assert!(severity == "serious" && text.contains("probably inverted"), "{text}");
}
