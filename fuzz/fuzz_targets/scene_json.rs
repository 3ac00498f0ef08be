//! A scene's description, in a folder with one Gaussian and no other file.
#![no_main]

use std::path::PathBuf;
use std::sync::LazyLock;

use libfuzzer_sys::fuzz_target;
use use3d_scene::Scene;
use use3d_splat::{Gaussians, ply};

/// A folder with one Gaussian and no medium.
static FOLDER: LazyLock<PathBuf> = LazyLock::new(|| {
    let dir = tempfile::tempdir().expect("a temporary folder").keep();
    let one = Gaussians {
        sh_degree: 0,
        means: vec![[0.0; 3]],
        log_scales: vec![[-2.0; 3]],
        quaternions: vec![[1.0, 0.0, 0.0, 0.0]],
        opacity_logits: vec![0.0],
        sh: vec![[[0.0; 3]; 16]],
    };
    let file = std::fs::File::create(dir.join("gaussians.ply")).expect("a file");
    ply::write(&one, file).expect("one Gaussian");
    dir
});

fuzz_target!(|data: &[u8]| {
    std::fs::write(FOLDER.join("scene.json"), data).expect("a file");
    let _ = Scene::load(&FOLDER);
});
