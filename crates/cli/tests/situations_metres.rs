//! Metres that are wrong, copies, cameras of different exposure, and scenes far from zero.

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

/// The capture that an import makes of a folder, and what it prints.
fn imported(capture: &Path) -> (Value, String) {
    let out = capture.with_extension("imported");
    let done = tiny::command().arg("import").arg(capture).arg("--out").arg(&out).output().unwrap();
    let text = String::from_utf8_lossy(&done.stderr).into_owned() + &String::from_utf8_lossy(&done.stdout);
    assert!(done.status.success(), "{text}");
    (serde_json::from_slice(&std::fs::read(out.join("capture.json")).unwrap()).unwrap(), text)
}

/// The severity of the finding whose text contains these words.
fn finding(capture: &Path, words: &str) -> String {
    let done = tiny::command().args(["-q", "check", "--json"]).arg(capture).output().unwrap();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let report: Value = serde_json::from_slice(&done.stdout).unwrap();
    let all = report["findings"].as_array().unwrap();
    let found = all.iter().find(|f| f["text"].as_str().is_some_and(|text| text.contains(words)));
    found.unwrap_or_else(|| panic!("{words}: {all:#?}"))["severity"].as_str().unwrap().into()
}

fn has_metres(document: &Value) -> bool {
    document["world"].is_object()
}

#[test]
fn gps_wanders() {
    let dir = tempfile::tempdir().unwrap();
    let (document, said) = imported(&faulty(dir.path(), "gps-wanders"));
    assert!(!has_metres(&document) && said.contains("GPS wanders by 3 m and more"), "{said}");
}

#[test]
fn positions_in_degrees() {
    let dir = tempfile::tempdir().unwrap();
    let (document, said) = imported(&faulty(dir.path(), "positions-degrees"));
    let metres = document["world"]["metres_per_unit"].as_f64().unwrap();
    assert!(said.contains("are degrees, and were converted") && (metres - 1.0).abs() < 0.02, "{said}");
}

#[test]
fn positions_that_are_wrong_are_named() {
    let dir = tempfile::tempdir().unwrap();
    for (fault, words) in [
        ("positions-swapped", "mirror image"),
        ("position-false", "is not used; look for a wrong number"),
        ("positions-line", "not on one line"),
    ] {
        let (_, said) = imported(&faulty(dir.path(), fault));
        assert!(said.contains(words), "{fault}: {said}");
    }
}

#[test]
fn duplicates() {
    let dir = tempfile::tempdir().unwrap();
    let capture = faulty(dir.path(), "same-twice:strong");
    let (document, said) = imported(&capture);
    assert!(said.contains("are there more than once") && said.contains("held out, too"), "{said}");
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
    assert_eq!(finding(&faulty(dir.path(), "rig-exposure"), "stops brighter than those of left/"), "serious");
    assert_eq!(finding(&faulty(dir.path(), "exposure-drift"), "brighter along the swim"), "minor");
}
