//! Reads files of every format and version that is still supported; `tests/museum/README.md` describes them.

use std::path::{Path, PathBuf};

use use3d_atc::calibrator::{Calibrator, Dataset};
use use3d_atc::consensus::Targets;
use use3d_capture::Appearance;
use use3d_import::load_prepared;
use use3d_judge::scores::{Method, SceneScores};
use use3d_scene::Scene;
use use3d_web::SavedViews;
use use3d_web::path::CameraPath;
use use3d_workflow::key::Key;
use use3d_workflow::manifest::Manifest;
use use3d_workflow::place::{self, Look, Standing};

fn exhibit(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("museum").join(name)
}

fn bytes(name: &str) -> Vec<u8> {
    std::fs::read(exhibit(name)).expect("the exhibit is there")
}

#[test]
fn scenes() {
    let scene = Scene::load(&exhibit("scene-v1")).expect("scene v1");
    assert_eq!((scene.gaussians.len(), scene.medium.kind().name()), (40, "rbf"));
    assert_eq!(scene.medium.anchors().map(|a| (a.centers.len(), a.top_k)), Some((8, 4)));
    assert!(scene.enhancement.is_some());
}

#[test]
fn waters_of_every_kind() {
    for kind in ["mlp", "global", "image"] {
        let scene = Scene::load(&exhibit(&format!("water-{kind}-v1"))).expect(kind);
        assert_eq!((scene.gaussians.len(), scene.medium.kind().name()), (28, kind));
        assert!(scene.medium.anchors().is_none() && scene.enhancement.is_none(), "{kind}");
    }
}

/// This enhancement was learnt from the scene without its water; the one of `scene-v1` through the water.
#[test]
fn enhancements_of_both_appearances() {
    let appearance = |folder: &str| {
        Scene::load(&exhibit(folder)).expect(folder).enhancement.expect("an enhancement").appearance
    };
    assert_eq!(appearance("enhancement-clear-v1"), Appearance::Clear);
    assert_eq!(appearance("scene-v1"), Appearance::Water);
}

/// The record that a stage run by hand writes next to its result, so that no other files are ever replaced.
#[test]
fn results() {
    match place::look(&exhibit("water-global-v1"), Look::Close).expect("looked at") {
        Standing::Ours(ours) => assert!(ours.whole),
        other => panic!("{other:?}"),
    }
}

#[test]
fn scores() {
    let scores = SceneScores::parse(&bytes("scores-v2/scores.json")).expect("scores v2");
    assert_eq!((scores.training_views, scores.held_out_views, scores.size), (4, 2, (48, 32)));
    let psnr = scores.mean(Method::Reconstruction, "psnr").and_then(|score| score.value());
    assert!(psnr.is_some_and(|psnr| psnr > 5.0), "{psnr:?}");
}

#[test]
fn what_a_page_saved() {
    let text = |name: &str| String::from_utf8(bytes(name)).expect("UTF-8");
    let path = CameraPath::read(&text("camera-path-v1/path.json")).expect("path v1");
    assert_eq!((path.keys.len(), path.keys[1].time, path.frames_per_second), (2, 1.5, 30.0));
    assert_eq!(path.keys[1].shot.mode, "enhanced-clear");
    let views = SavedViews::read(&text("views-v1/views.json")).expect("views v1");
    assert_eq!((views.views[0].name.as_str(), views.metres_per_unit), ("the wreck", Some(1.25)));
    assert_eq!(views.views[0].compare.as_deref(), Some("reconstruction"));
}

#[test]
fn captures() {
    let capture = load_prepared(&exhibit("capture-v1")).expect("capture v1").capture;
    assert_eq!((capture.views.len(), capture.points.len()), (6, 20));
    assert_eq!((capture.split.train.len(), capture.split.test.len()), (4, 2));
    assert!(capture.views.iter().all(|view| view.depth_prior.is_some()));
}

#[test]
fn calibration() {
    let dataset: Dataset = serde_json::from_slice(&bytes("pairs-v1/dataset.json")).expect("pairs v1");
    assert_eq!((dataset.examples.len(), dataset.extractor.cells), (4, 2));
    let calibrator =
        Calibrator::from_bytes(&bytes("calibrator-v1/calibrator.safetensors")).expect("calibrator v1");
    assert_eq!((calibrator.extractor.cells, calibrator.proposer.name.as_str()), (2, "fusion"));
    let targets = Targets::from_bytes(&bytes("targets-v1/targets.safetensors")).expect("targets v1");
    assert_eq!(targets.views.len(), 4);
}

#[test]
fn artifacts() {
    let bytes = bytes("artifact-v1/manifest.json");
    let read: serde_json::Value = serde_json::from_slice(&bytes).expect("JSON");
    let key: Key = serde_json::from_value(read["key"].clone()).expect("a key");
    // A changed key would make every existing cache useless.
    let manifest = Manifest::parse(&bytes, key).expect("manifest v1");
    assert_eq!((manifest.format.as_str(), manifest.schema), ("use3d artifact", 1));
}
