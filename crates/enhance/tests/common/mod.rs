//! The small golden scene, a teacher that enhances it, and targets read off the teacher's renders.

#![allow(dead_code, reason = "every test file uses its own part of this")]

use glam::{DMat3, DVec3};
use use3d_atc::consensus::{LocalConsensus, Targets};
use use3d_atc::extractor::{ExtractorSettings, Source, Workspace};
use use3d_atc::proposers::ProposerId;
use use3d_capture::{Appearance, Camera, Frame, Image, Intrinsics, Lattice, Pose};
use use3d_enhance::{EnhanceParams, EnhanceView, LabelSource, Look, Renderer};
use use3d_golden::Part;
use use3d_medium::{MediumModel, MediumRbf};
use use3d_numerics::random::{Purpose, Stream};
use use3d_scene::Scene;
use use3d_splat::{Gaussians, Rendered};
use use3d_ubaf::{Enhancement, Field, FieldBox, ObjectPass, Shape};

/// The scene and its views.
pub(crate) fn mini() -> (Scene, Vec<EnhanceView>) {
    let root = use3d_golden::root().join("scene-mini");
    let part = Part::load(&root.join("truth.safetensors"));
    let truth = part.whole();
    let sh = truth.rows::<48>("sh");
    let gaussians = Gaussians {
        sh_degree: 3,
        means: truth.rows("means"),
        log_scales: truth.rows("log_scales"),
        quaternions: truth.rows("quats"),
        opacity_logits: truth.f32("opacity_logits"),
        sh: sh.iter().map(|r| std::array::from_fn(|k| std::array::from_fn(|c| r[3 * k + c]))).collect(),
    };
    let mut medium = MediumRbf::new(truth.shape("medium.centers")[0], 4);
    medium.centers = truth.rows("medium.centers");
    medium.log_widths = truth.f32("medium.log_widths");
    medium.coefficients = truth
        .f32("medium.coefficients")
        .chunks_exact(3 * 16 * 3)
        .map(|a| {
            std::array::from_fn(|q| std::array::from_fn(|b| std::array::from_fn(|c| a[(q * 16 + b) * 3 + c])))
        })
        .collect();
    let scene = Scene {
        gaussians,
        frame: Frame::IDENTITY,
        medium: MediumModel::Rbf(medium),
        medium_degree: 3,
        enhancement: None,
    };
    let text = std::fs::read_to_string(root.join("scene.json")).unwrap();
    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
    let number = |v: &serde_json::Value| v.as_f64().unwrap();
    let row = |v: &serde_json::Value| DVec3::new(number(&v[0]), number(&v[1]), number(&v[2]));
    let mut views: Vec<EnhanceView> = json["views"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| {
            let r = &v["R_cw"];
            let rotation = DMat3::from_cols(row(&r[0]), row(&r[1]), row(&r[2])).transpose();
            let intrinsics = Intrinsics {
                width: v["width"].as_u64().unwrap() as usize,
                height: v["height"].as_u64().unwrap() as usize,
                fx: number(&v["fx"]),
                fy: number(&v["fy"]),
                cx: number(&v["cx"]),
                cy: number(&v["cy"]),
            };
            EnhanceView {
                name: v["name"].as_str().unwrap().into(),
                camera: Camera { intrinsics, pose: Pose { rotation, translation: row(&v["t_cw"]) } },
            }
        })
        .collect();
    views.sort_by(|a, b| a.name.cmp(&b.name));
    (scene, views)
}

/// The scene enhanced by a field that a person made up: a red boost, a little contrast, and local variation.
pub(crate) fn taught(scene: &Scene) -> Scene {
    let bounds = FieldBox::of_scene(&scene.gaussians.means, &[]);
    let mut field = Field::identity(Shape::default(), bounds, 7).unwrap();
    let draw = Stream::new(7, Purpose::new("teacher"), 0);
    let shape = field.shape();
    for i in shape.factors().chain(shape.output_weight()) {
        field.parameters[i] += 0.12 * draw.normal(i as u64) as f32;
    }
    let affine = [0.35, 0.05, 0.0, 0.02, 0.0, 0.15, 0.0, -0.02, -0.05, 0.0, -0.1, 0.0];
    field.parameters[shape.affine()].copy_from_slice(&affine);
    field.parameters[shape.transport()].copy_from_slice(&[-0.25, -0.1]);
    let mut pass = ObjectPass::new(&field, &scene.gaussians.means, scene.gaussians.sh.iter().map(|sh| sh[0]));
    pass.forward(&field);
    let enhancement = Enhancement { centre: pass.mean(), field, appearance: Appearance::Water };
    Scene { enhancement: Some(enhancement), ..scene.clone() }
}

/// A whole view of a scene.
pub(crate) fn draw(scene: &Scene, look: Look, camera: &Camera) -> Image {
    let mut out = Rendered::new();
    Renderer::new(scene, look).unwrap().render(camera, &Lattice::full(&camera.intrinsics), false, &mut out);
    out.image
}

/// Targets that the teacher meets nearly: the mean of its realised global operators, and its own local grades.
pub(crate) fn targets(scene: &Scene, taught: &Scene, views: &[EnhanceView]) -> Targets {
    let settings = ExtractorSettings::default();
    let mut operator = [0.0; 12];
    let mut candidates = Vec::new();
    for view in views {
        let before = draw(scene, Look::Reconstruction, &view.camera);
        let after = draw(taught, Look::Enhanced { strength: 1.0 }, &view.camera);
        let source = Source::from_image(&before, &settings).unwrap();
        let mut workspace = Workspace::new();
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
        scene: operator,
        dispersion: 0.0,
        global_scales: [0.2; 12],
        local_scales: [0.1, 0.1, 0.1, 0.04, 0.04, 0.04],
        views: candidates,
        state: LocalConsensus {
            mean: pass.locals(enhancement.centre),
            weight: vec![1.0; n],
            // The first twenty were seen once only and carry no target.
            count: (0..n).map(|i| if i < 20 { 1 } else { 3 }).collect(),
        },
    }
}

/// Quick settings.
pub(crate) fn quick(iterations: u64) -> EnhanceParams {
    EnhanceParams { iterations, learning_rate: 5e-3, log_every: 10, ..EnhanceParams::default() }
}

/// The teacher's renders as pseudo-labels.
pub(crate) struct Labels<'a> {
    pub(crate) taught: &'a Scene,
    pub(crate) views: &'a [EnhanceView],
}

impl LabelSource for Labels<'_> {
    fn label(&self, index: usize) -> Result<Image, String> {
        Ok(draw(self.taught, Look::Enhanced { strength: 1.0 }, &self.views[index].camera))
    }
}
