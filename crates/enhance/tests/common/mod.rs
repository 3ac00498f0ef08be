//! The small golden scene, a teacher that enhances it, and targets computed from the teacher's renders.

#![allow(dead_code, reason = "every test file uses its own part of this")]

// One fixture for the tests of drawing and of training.
#[path = "../../../render/tests/common/mod.rs"]
mod drawn;

pub(crate) use drawn::{draw, taught};
use use3d_atc::consensus::{LocalConsensus, Targets};
use use3d_atc::extractor::{ExtractorSettings, SourceImage, Workspace};
use use3d_atc::proposers::ProposerId;
use use3d_capture::{Appearance, Image, KeptWater};
use use3d_enhance::{EnhanceParams, EnhanceView, LabelSource, Start};
use use3d_render::Look;
use use3d_scene::Scene;
use use3d_ubaf::ObjectPass;

/// The scene and its views.
pub(crate) fn mini() -> (Scene, Vec<EnhanceView>) {
    let (scene, views) = drawn::mini();
    (scene, views.into_iter().map(|view| EnhanceView { name: view.name, camera: view.camera }).collect())
}

/// Targets that the teacher nearly reaches: the mean of its realised global operators, and its own local
/// grades.
pub(crate) fn targets(scene: &Scene, taught: &Scene, views: &[EnhanceView]) -> Targets {
    let settings = ExtractorSettings::default();
    let mut operator = [0.0; 12];
    let mut candidates = Vec::new();
    for view in views {
        let before = draw(scene, Look::Reconstruction, &view.camera);
        let after = draw(taught, Look::Enhanced { strength: 1.0 }, &view.camera);
        let source = SourceImage::from_image(&before, &settings).unwrap();
        let mut workspace = Workspace::default();
        let global = source.forward(&after, &mut workspace).unwrap().global;
        for (o, g) in operator.iter_mut().zip(global) {
            *o += g / views.len() as f64;
        }
        candidates.push((view.name.clone(), global));
    }
    let enhancement = taught.enhancement.as_ref().unwrap();
    let gaussians = &scene.gaussians;
    let dc = gaussians.sh.iter().map(|sh| sh[0]);
    let mut pass = ObjectPass::new(&enhancement.field, &gaussians.means, dc);
    pass.forward(&enhancement.field);
    let n = gaussians.len();
    Targets {
        extractor: settings,
        proposer: ProposerId::default(),
        appearance: Appearance::Water,
        kept_water: KeptWater::ALL,
        scene: operator,
        dispersion: 0.0,
        global_scales: [0.2; 12],
        local_scales: [0.1, 0.1, 0.1, 0.04, 0.04, 0.04],
        views: candidates,
        state: LocalConsensus {
            mean: pass.locals(enhancement.centre),
            weight: vec![1.0; n],
            // The first twenty were seen only once and have no target.
            count: (0..n).map(|i| if i < 20 { 1 } else { 3 }).collect(),
        },
    }
}

/// Settings for short runs.
pub(crate) fn quick(iterations: u64) -> EnhanceParams {
    // The start is the identity, so that a test sees what was learnt.
    EnhanceParams {
        iterations,
        start: Start::Identity,
        learning_rate: 5e-3,
        log_every: 10,
        ..EnhanceParams::default()
    }
}

/// The teacher's renders as pseudo-labels.
pub(crate) struct Labels<'a> {
    pub(crate) taught: &'a Scene,
    pub(crate) views: &'a [EnhanceView],
}

impl LabelSource for Labels<'_> {
    fn label(&self, index: usize) -> Result<Image, Box<dyn std::error::Error + Send + Sync>> {
        Ok(draw(self.taught, Look::Enhanced { strength: 1.0 }, &self.views[index].camera))
    }
}
