//! Models that do not fit their tracks or their photographs: `use3d check` finds them, and a sound capture
//! has none of these findings.

mod tiny;

use serde_json::Value;

/// The findings of a small capture with a fault, or of a sound one: severity, subject and number of views.
fn findings(fault: Option<&str>) -> Vec<(String, String, usize)> {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path().join("dive").to_string_lossy().into_owned();
    let fault = fault.map(|name| ["--fault", name]);
    let size = ["-q", "synth", "capture", "--views", "12", "--size", "96x64", "--out", &at];
    let made = tiny::command().args(size).args(fault.iter().flatten()).output().unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let checked = tiny::command().args(["-q", "check", &at, "--json"]).output().unwrap();
    assert!(checked.status.success(), "{fault:?}: {}", String::from_utf8_lossy(&checked.stderr));
    let report: Value = serde_json::from_slice(&checked.stdout).unwrap();
    let text = |finding: &Value, key: &str| finding[key].as_str().unwrap().to_string();
    let all = report["findings"].as_array().unwrap().iter();
    all.map(|f| (text(f, "severity"), text(f, "subject"), f["views"].as_array().unwrap().len())).collect()
}

/// Checks that a fault has a finding of a severity on a subject, and returns the number of views it names.
fn found(fault: &str, severity: &str, subject: &str) -> usize {
    let all = findings(Some(fault));
    let finding = all.iter().find(|(weight, about, _)| weight == severity && about == subject);
    finding.unwrap_or_else(|| panic!("{fault} has no {severity} finding on {subject}: {all:?}")).2
}

#[test]
fn a_sound_capture_has_no_serious_finding_and_one_minor_at_most() {
    let all = findings(None);
    let count = |severity: &str| all.iter().filter(|(weight, ..)| weight == severity).count();
    assert!(count("serious") == 0 && count("minor") <= 1, "{all:?}");
    for subject in ["error", "photographs", "few"] {
        assert!(all.iter().any(|(weight, about, _)| weight == "good" && about == subject), "{all:?}");
    }
}

#[test]
fn check_trusts_stored_error() {
    found("poses-turned:strong", "serious", "error");
    found("points-scaled:middle", "serious", "error");
    assert_eq!(found("pose-turned:strong", "serious", "cameras"), 1);
}

#[test]
fn photos_turned_180() {
    assert_eq!(found("turned-180:strong", "serious", "photographs"), 12);
    assert_eq!(found("turned-180:weak", "serious", "photographs"), 1);
    found("mirrored", "serious", "photographs");
}

#[test]
fn stray_camera() {
    assert_eq!(found("stray-camera:weak", "minor", "stray"), 1);
    assert_eq!(found("stray-camera:strong", "minor", "stray"), 1);
}

#[test]
fn ns_points_other_frame() {
    found("points-exchanged", "serious", "points_in_view");
    found("points-turned", "serious", "points_in_view");
}
