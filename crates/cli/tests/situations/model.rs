//! Models that do not fit their tracks or their photographs: `use3d check` finds them, and a sound capture
//! has none of these findings.

use use3d_check::Severity;

use super::{command, examined, faulty, run};

/// Checks that a fault has a finding of a severity on a subject, and returns the number of views it names.
fn found(fault: &str, severity: Severity, subject: &str) -> usize {
    let dir = tempfile::tempdir().unwrap();
    let findings = examined(&faulty(dir.path(), fault)).unwrap().1;
    let finding = findings.iter().find(|f| f.severity == severity && f.subject == subject);
    finding
        .unwrap_or_else(|| panic!("{fault} has no {severity:?} finding on {subject}: {findings:#?}"))
        .views
        .len()
}

#[test]
fn check_trusts_stored_error() {
    found("poses-turned:strong", Severity::Serious, "error");
    found("points-scaled:middle", Severity::Serious, "error");
    assert_eq!(found("pose-turned:strong", Severity::Serious, "cameras"), 1);
}

#[test]
fn photos_turned_180() {
    assert_eq!(found("turned-180:strong", Severity::Serious, "photographs"), 12);
    assert_eq!(found("turned-180:weak", Severity::Serious, "photographs"), 1);
    found("mirrored", Severity::Serious, "photographs");
}

#[test]
fn stray_camera() {
    assert_eq!(found("stray-camera:weak", Severity::Minor, "stray"), 1);
    assert_eq!(found("stray-camera:strong", Severity::Minor, "stray"), 1);
}

#[test]
fn ns_points_other_frame() {
    found("points-exchanged", Severity::Serious, "points_in_view");
    found("points-turned", Severity::Serious, "points_in_view");
}

#[test]
fn photographs_that_were_cropped_and_enlarged_are_found() {
    let dir = tempfile::tempdir().unwrap();
    let zoom = |fault: Option<&str>| {
        let capture = dir.path().join(fault.unwrap_or("sound"));
        let mut synth = command();
        synth.args(["-q", "synth", "capture", "--views", "12", "--size", "320x214", "--out"]).arg(&capture);
        run(synth.args(fault.iter().flat_map(|fault| ["--fault", fault]))).unwrap();
        let findings = examined(&capture).unwrap().1;
        findings.iter().find(|f| f.subject == "zoom").map(|f| f.text.clone())
    };
    assert_eq!(zoom(None), None);
    let text = zoom(Some("cropped")).unwrap();
    assert!(text.contains("a border had been cut off"), "{text}");
}
