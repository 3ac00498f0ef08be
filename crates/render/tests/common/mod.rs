//! The small golden scene, a teacher that enhances it, and whole views of both.

#![allow(dead_code, reason = "every test file uses its own part of this")]

use glam::{DMat3, DVec3};
use use3d_capture::{Appearance, Camera, Frame, Image, Intrinsics, KeptWater, Lattice, Pose};
use use3d_golden::Part;
use use3d_medium::{MediumModel, MediumRbf};
use use3d_numerics::random::{Purpose, Stream};
use use3d_render::{Look, Renderer};
use use3d_scene::Scene;
use use3d_splat::{Gaussians, Rendered};
use use3d_ubaf::{Enhancement, Field, FieldBox, ObjectPass, Shape};

/// A view of the golden scene.
pub(crate) struct ViewOfTruth {
    pub(crate) name: String,
    pub(crate) camera: Camera,
}

/// The scene and its views.
pub(crate) fn mini() -> (Scene, Vec<ViewOfTruth>) {
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
    let mut views: Vec<ViewOfTruth> = json["views"]
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
            ViewOfTruth {
                name: v["name"].as_str().unwrap().into(),
                camera: Camera { intrinsics, pose: Pose { rotation, translation: row(&v["t_cw"]) } },
            }
        })
        .collect();
    views.sort_by(|a, b| a.name.cmp(&b.name));
    (scene, views)
}

/// The scene enhanced by an invented field: a red boost, some contrast, and local variation.
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
    let enhancement =
        Enhancement { centre: pass.mean, field, appearance: Appearance::Water, kept_water: KeptWater::ALL };
    Scene { enhancement: Some(enhancement), ..scene.clone() }
}

/// A whole view of a scene.
pub(crate) fn draw(scene: &Scene, look: Look, camera: &Camera) -> Image {
    let mut out = Rendered::new();
    let lattice = Lattice::full(&camera.intrinsics);
    Renderer::new(scene, look).unwrap().render(camera, &lattice, false, &mut out).unwrap();
    out.image
}
