//! Metres that are wrong, copies, cameras of different exposure, and scenes far from zero.

use serde_json::Value;
use use3d_check::Severity;

use super::{faulty, finding, imported};

fn has_metres(document: &Value) -> bool {
    document["world"].is_object()
}

#[test]
fn gps_wanders() {
    let dir = tempfile::tempdir().unwrap();
    let (document, said, _) = imported(&faulty(dir.path(), "gps-wanders")).unwrap();
    assert!(!has_metres(&document) && said.contains("GPS wanders by 3 m and more"), "{said}");
}

#[test]
fn positions_in_degrees() {
    let dir = tempfile::tempdir().unwrap();
    let (document, said, _) = imported(&faulty(dir.path(), "positions-degrees")).unwrap();
    let metres = document["world"]["metres_per_unit"].as_f64().unwrap();
    assert!(said.contains("are degrees, and were converted") && (metres - 1.0).abs() < 0.02, "{said}");
}

#[test]
fn positions_that_are_wrong_are_named() {
    let dir = tempfile::tempdir().unwrap();
    for (fault, words) in [
        ("positions-swapped", "mirror image"),
        ("position-false", "is not used; look for a wrong number"),
        ("positions-line", "lie on one line"),
    ] {
        let (_, said, _) = imported(&faulty(dir.path(), fault)).unwrap();
        assert!(said.contains(words), "{fault}: {said}");
    }
}

#[test]
fn duplicates() {
    let dir = tempfile::tempdir().unwrap();
    let capture = faulty(dir.path(), "same-twice:strong");
    let (document, said, _) = imported(&capture).unwrap();
    assert!(said.contains("have copies") && said.contains("kept back, too"), "{said}");
    let report = &document["report"];
    let of = |list: &str| -> Vec<Vec<u8>> {
        let names = report[list].as_array().unwrap().iter().map(|n| n.as_str().unwrap());
        names.map(|name| std::fs::read(capture.join("images").join(name)).unwrap()).collect()
    };
    let (train, test) = (of("train"), of("test"));
    assert!(!test.is_empty() && test.iter().all(|photograph| !train.contains(photograph)), "{report}");
}

#[test]
fn rig_exposure() {
    let dir = tempfile::tempdir().unwrap();
    let rig = finding(&faulty(dir.path(), "rig-exposure"), "rig_exposure");
    let words = "stops brighter than those of left/";
    assert!(rig.severity == Severity::Serious && rig.text.contains(words), "{rig:?}");
    let drift = finding(&faulty(dir.path(), "exposure-drift"), "drift");
    assert!(drift.severity == Severity::Minor && drift.text.contains("brighter along the swim"), "{drift:?}");
}
