//! Files of every format and version that is still read; `tests/museum/README.md` says what they are.

use std::path::{Path, PathBuf};

use use3d_atc::calibrator::{Calibrator, Dataset};
use use3d_atc::consensus::Targets;
use use3d_build::manifest::Manifest;
use use3d_import::load_prepared;
use use3d_scene::Scene;

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
    let manifest: Manifest =
        serde_json::from_slice(&bytes("artifact-v1/manifest.json")).expect("manifest v1");
    assert_eq!((manifest.format.as_str(), manifest.schema), ("use3d artifact", 1));
    // A key that came out differently would leave every cache behind.
    assert_eq!(manifest.ingredients.key(), manifest.key);
}
