//! Situations of people's files and depth maps: what is read, what is named, and what is refused.

use use3d_check::{Finding, Severity};
use use3d_import::ImportReport;

use super::{examined, faulty, sound};

/// The report and the findings of the capture with a fault, or without one; the error of its import.
fn tried(fault: &str) -> Result<(ImportReport, Vec<Finding>), String> {
    let dir = tempfile::tempdir().unwrap();
    examined(&if fault == "none" { sound(dir.path(), "none") } else { faulty(dir.path(), fault) })
}

/// The error of a capture's import.
fn refused(fault: &str) -> String {
    tried(fault).err().unwrap_or_else(|| panic!("{fault} is not refused"))
}

/// The report of a capture that is read, with a finding whose text has these words and that is so grave.
fn found(fault: &str, severity: Severity, words: &str) -> ImportReport {
    let (report, findings) = tried(fault).unwrap_or_else(|e| panic!("{fault} is refused: {e}"));
    let texts: Vec<String> = findings.iter().map(|f| format!("{:?} {}", f.severity, f.text)).collect();
    let has = findings.iter().any(|f| f.severity == severity && f.text.contains(words));
    assert!(has, "{fault}: no {severity:?} finding has {words:?}: {texts:#?}");
    report
}

/// A capture that is read without a finding on its reader or its depth maps.
fn right(fault: &str) -> ImportReport {
    let (report, findings) = tried(fault).unwrap_or_else(|e| panic!("{fault} is refused: {e}"));
    let grave = |f: &&Finding| matches!(f.severity, Severity::Serious | Severity::Minor);
    let ours = |f: &&Finding| ["import", "depth", "points_in_view", "photographs"].contains(&f.subject);
    let found: Vec<&str> = findings.iter().filter(grave).filter(ours).map(|f| f.text.as_str()).collect();
    assert_eq!(found, [""; 0], "{fault}");
    report
}

#[test]
fn json_nan_bom() {
    let said = refused("json-nan");
    assert!(said.contains("frame 6 (") && said.contains("row 1, column 4 of `transform_matrix`"), "{said}");
    let said = refused("json-comments");
    assert!(said.contains("line 2: it has a comment"), "{said}");
    assert_eq!(right("json-mark").views, 12);
    assert_eq!(right("text-mark").views, 12);
    assert_eq!(found("nan-point", Severity::Minor, "a position is not a number").views, 12);
    let said = refused("nan-pose");
    assert!(said.contains("(frame_0007.png): its translation is") && said.contains("NaN"), "{said}");
}

#[test]
fn transforms_no_size() {
    assert_eq!(right("no-size").views, 12);
    let report = found("two-lists", Severity::Note, "are read as one capture");
    assert_eq!(
        (report.train.len(), report.test.len(), report.model.as_str()),
        (10, 2, "transforms_train.json")
    );
    assert!(report.test[1].contains("0009"), "{:?}", report.test);
}

#[test]
fn fisheye_crop() {
    found("crop-radius", Severity::Minor, "not used: fisheye_crop_radius; they change the pictures");
    found("unknown-fields", Severity::Minor, "not used: crop, crop_rect, rolling_shutter_time;");
}

#[test]
fn images_txt_one_line() {
    let said = refused("one-line");
    assert!(
        said.contains("line 2: it is the next image") && said.contains("the second may be empty"),
        "{said}"
    );
}

#[test]
fn depth_named_and_used() {
    assert_eq!(right("none").depth_priors, 12);
    assert_eq!(found("depth-named", Severity::Note, "depth_file_path are not used").depth_priors, 0);
    assert_eq!(found("depth-metric", Severity::Minor, "larger where things are farther").depth_priors, 0);
    let report = found("depth-empty", Severity::Minor, "cannot be read and are left out: frame_0001");
    assert_eq!(report.depth_priors, 11);
    found("depth-coarse:weak", Severity::Minor, "fewer than 32 different values");
    for strength in ["weak", "strong"] {
        found(&format!("depth-shuffled:{strength}"), Severity::Serious, "belong to other photographs");
    }
}

#[test]
fn float_points_far() {
    for strength in ["weak", "strong"] {
        found(&format!("points-far-float:{strength}"), Severity::Minor, "where their numbers have steps of");
    }
}

#[test]
fn poses_of_another_kind() {
    found("camera-axes", Severity::Serious, "if the y and z axes of the cameras were flipped");
    found(
        "poses-inverse",
        Severity::Serious,
        "would be in view if the poses were inverted (from the world to the camera)",
    );
}
