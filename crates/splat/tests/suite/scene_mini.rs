//! The golden scene: whole images of the oracle, for the views whose medium maps are stored.

use glam::{DMat3, DVec3};
use use3d_capture::{Camera, Formation, Image, Intrinsics, MediumMaps, Pose};
use use3d_golden::{Part, root};
use use3d_numerics::math;
use use3d_splat::{Colors, Gaussians, Options, Prepared, Rendered};

use crate::support::{engines, lattice};

fn camera_of(view: &serde_json::Value) -> Camera {
    let number = |key: &str| view[key].as_f64().unwrap_or_else(|| panic!("scene.json: no {key}"));
    let row = |r: usize| -> [f64; 3] { std::array::from_fn(|c| view["R_cw"][r][c].as_f64().expect("R_cw")) };
    Camera {
        intrinsics: Intrinsics {
            width: number("width") as usize,
            height: number("height") as usize,
            fx: number("fx"),
            fy: number("fy"),
            cx: number("cx"),
            cy: number("cy"),
        },
        pose: Pose {
            rotation: DMat3::from_cols_array_2d(&[row(0), row(1), row(2)]).transpose(),
            translation: DVec3::from_array(std::array::from_fn(|i| view["t_cw"][i].as_f64().expect("t_cw"))),
        },
    }
}

#[test]
fn golden_scene_mini_images_and_layers() {
    let dir = root().join("scene-mini");
    let text = std::fs::read(dir.join("scene.json")).expect("scene.json");
    let scene: serde_json::Value = serde_json::from_slice(&text).expect("scene.json");
    let truth = Part::load(&dir.join("truth.safetensors"));
    let truth = truth.whole();
    let gaussians = Gaussians {
        sh_degree: 3,
        means: truth.rows("means"),
        log_scales: truth.rows("log_scales"),
        quaternions: truth.rows("quats"),
        opacity_logits: truth.f32("opacity_logits"),
        sh: truth
            .rows::<48>("sh")
            .iter()
            .map(|row| std::array::from_fn(|k| std::array::from_fn(|c| row[3 * k + c])))
            .collect(),
    };
    assert_eq!(gaussians.validate(), Ok(()));
    let maps = Part::load(&dir.join("maps.safetensors"));
    let maps = maps.whole();
    let mut views = 0;
    for view in scene["views"].as_array().expect("views") {
        let stem = view["name"].as_str().expect("name").trim_end_matches(".png");
        if !maps.has(&format!("{stem}/obj")) {
            continue;
        }
        views += 1;
        let camera = camera_of(view);
        let planes = |name: &str| maps.planes(&format!("{stem}/{name}")).2;
        let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
        let image = |name: &str| Image::from_planes(w, h, planes(name)).expect("an image");
        let medium = MediumMaps {
            color: image("c_m"),
            backscatter: image("beta_bs"),
            attenuation: image("beta_attn"),
            formation: Formation::default(),
            network: None,
        };
        let mut prepared = Prepared::new();
        prepared.prepare(&gaussians, &camera, &lattice(&camera), Colors::Sh { degree: 3 });
        for (engine, mut rasterizer) in engines() {
            let mut out = Rendered::new();
            let options = Options { layers: true, ..Options::default() };
            rasterizer.forward(&prepared, Some(&medium), &options, &mut out);
            let layers = out.layers.as_ref().unwrap();
            let total: Vec<f32> = planes("obj")
                .iter()
                .zip(planes("med"))
                .zip(planes("far"))
                .map(|((object, medium), far)| object + medium + far)
                .collect();
            for (name, actual, expected) in [
                ("rgb", out.image.data(), total),
                ("obj", layers.object.data(), planes("obj")),
                ("med", layers.medium.data(), planes("med")),
                ("far", layers.far.data(), planes("far")),
                ("clean", layers.clear.data(), planes("clean")),
                ("acc", out.accumulation.data(), planes("acc")),
                ("depth", out.depth.data(), planes("depth")),
                ("distance", layers.distance.data(), planes("distance")),
            ] {
                assert_eq!(actual.len(), expected.len());
                let (mut worst, mut squares) = (0.0f64, 0.0);
                for (a, b) in actual.iter().zip(&expected) {
                    let d = f64::from(a - b).abs();
                    worst = worst.max(d);
                    squares += d * d / actual.len() as f64;
                }
                let psnr = -10.0 * math::log10(squares);
                eprintln!("{stem} {engine} {name}: worst {worst:.2e}, {psnr:.1} dB");
                assert!(worst < 4e-3 && psnr > 90.0, "{stem} {engine} {name}: worst {worst}, {psnr} dB");
            }
        }
    }
    assert!(views >= 2, "maps.safetensors has {views} of the views");
}
