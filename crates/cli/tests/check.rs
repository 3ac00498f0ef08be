//! `use3d check` on a good capture and on one that was spoilt on purpose, and the lines before a run.

mod tiny;

use std::path::Path;
use std::process::Output;

use serde_json::Value;
use use3d_capture::Image;
use use3d_io_colmap::{Keypoint, read_model, write_model_binary};
use use3d_io_image::{read_image, write_png8};

fn use3d(arguments: &[&str]) -> Output {
    tiny::command().args(arguments).output().expect("the command starts")
}

fn out(output: &Output) -> String {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// A synthetic capture of 24 views.
fn capture(folder: &str) {
    out(&use3d(&["-q", "synth", "capture", "--out", folder, "--views", "24", "--size", "320x180"]));
}

/// The names of a capture's photographs, sorted.
fn photographs(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder.join("images")).unwrap();
    let mut names: Vec<String> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

fn change(folder: &Path, name: &str, by: impl Fn(&Image) -> Image) {
    let path = folder.join("images").join(name);
    write_png8(&path, &by(&read_image(&path).unwrap()).to_8bit()).unwrap();
}

/// The mean of 9 x 9 pixels around each.
fn blurred(image: &Image) -> Image {
    let (w, h) = (image.width(), image.height());
    let mut out = Image::filled(w, h, 0.0);
    for y in 0..h {
        for x in 0..w {
            let (mut sum, mut count) = ([0.0f32; 3], 0.0f32);
            for v in y.saturating_sub(4)..(y + 5).min(h) {
                for u in x.saturating_sub(4)..(x + 5).min(w) {
                    let pixel = image.pixel(u, v);
                    (0..3).for_each(|c| sum[c] += pixel[c]);
                    count += 1.0;
                }
            }
            out.set_pixel(x, y, sum.map(|s| s / count));
        }
    }
    out
}

/// Spoils a capture: a blurred view, a step of exposure, a photograph that the model does not know, a missing
/// one, tracks that end at 60 % of the width, and points that were moved.
fn spoil(folder: &Path) -> Vec<String> {
    let names = photographs(folder);
    change(folder, &names[5], blurred);
    for name in &names[14..] {
        change(folder, name, |image| image.map(|v| 0.6 * v));
    }
    std::fs::copy(folder.join("images").join(&names[3]), folder.join("images/later.png")).unwrap();
    std::fs::remove_file(folder.join("images").join(&names[20])).unwrap();
    let sparse = folder.join("sparse/0");
    let mut model = read_model(&sparse).unwrap();
    for image in &mut model.images {
        let id = image.id;
        for (i, keypoint) in image.keypoints.iter_mut().enumerate().filter(|(_, k)| k.x > 0.6 * 320.0) {
            if let Some(point) = model.points.iter_mut().find(|p| p.id == keypoint.point) {
                point.track.retain(|sighting| *sighting != (id, i as u32));
            }
            keypoint.point = Keypoint::NONE;
        }
    }
    model.points.iter_mut().for_each(|p| p.position[0] += 0.1);
    write_model_binary(&sparse, &model).unwrap();
    names
}

/// The severity of a subject and the views that it names.
fn finding(report: &Value, subject: &str) -> (String, Vec<String>) {
    let all = report["findings"].as_array().unwrap();
    let found =
        all.iter().find(|f| f["subject"] == subject).unwrap_or_else(|| panic!("{subject}: {report:#}"));
    let views = found["views"].as_array().unwrap().iter().map(|v| v.as_str().unwrap().to_string());
    (found["severity"].as_str().unwrap().to_string(), views.collect())
}

#[test]
fn a_good_capture_is_praised_and_a_spoilt_one_is_told_what_to_do() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    capture(&at("reef"));
    let report: Value = serde_json::from_str(&out(&use3d(&["-q", "check", &at("reef"), "--json"]))).unwrap();
    for subject in ["unplaced", "error", "blur", "exposure", "balance", "split", "reach", "water"] {
        assert_eq!(finding(&report, subject).0, "good", "{subject}: {report:#}");
    }
    let serious =
        report["findings"].as_array().unwrap().iter().filter(|f| f["severity"] == "serious").count();
    assert_eq!(serious, 0, "{report:#}");

    let names = spoil(&dir.path().join("reef"));
    let page = at("check.html");
    let text = out(&use3d(&["-q", "check", &at("reef"), "--html", &page]));
    println!("{text}");
    for expected in [
        "do this: ",
        "The right 40 % of the picture area",
        "will look like fog",
        "something in it was changed afterwards",
    ] {
        assert!(text.contains(expected), "{text} lacks {expected}");
    }
    let report: Value = serde_json::from_str(&out(&use3d(&["-q", "check", &at("reef"), "--json"]))).unwrap();
    assert_eq!(finding(&report, "error").0, "serious");
    assert_eq!(finding(&report, "reach").0, "serious");
    assert_eq!(finding(&report, "blur"), ("minor".into(), vec![names[5].clone()]));
    let (severity, views) = finding(&report, "exposure");
    assert!(severity == "serious" && views.contains(&names[14]), "{views:?}");
    assert_eq!(finding(&report, "missing"), ("minor".into(), vec![names[20].clone()]));
    assert_eq!(finding(&report, "unplaced"), ("minor".into(), vec!["later.png".into()]));
    let html = std::fs::read_to_string(&page).unwrap();
    assert!(html.contains("data:image/jpeg;base64,") && html.contains("<svg"), "pictures and the drawing");
    assert!(!html.contains("http://") && !html.contains("https://"), "the page needs no network");
    // An existing page is not replaced by accident.
    assert_eq!(use3d(&["check", &at("reef"), "--html", &page]).status.code(), Some(2));

    // A run says the gravest beforehand, once.
    let run = ["run", &at("reef"), "--until", "import", "--cache", &at("cache"), "--out", &at("out")];
    let said = String::from_utf8_lossy(&use3d(&run).stderr).into_owned();
    let lines: Vec<&str> =
        said.lines().filter(|l| l.starts_with("serious: ") || l.starts_with("minor: ")).collect();
    assert_eq!(lines.len(), 3, "{said}");
    assert!(said.contains("something in it was changed afterwards") && lines[1].contains("fog"), "{said}");
    assert!(said.contains("use3d check "), "{said}");
    let again = String::from_utf8_lossy(&use3d(&run).stderr).into_owned();
    assert!(!again.contains("serious: "), "{again}");
}

#[test]
fn no_capture_no_check() {
    let dir = tempfile::tempdir().unwrap();
    let output = use3d(&["check", &dir.path().to_string_lossy()]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2) && said.contains("no camera positions found"), "{said}");
}
