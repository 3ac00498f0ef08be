//! Rendering and baking an enhanced scene.

mod common;

use common::{draw, mini, taught};
use use3d_capture::Lattice;
use use3d_enhance::{EnhanceError, Look, Renderer, bake};
use use3d_scene::Scene;
use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered};

fn worst(a: &use3d_capture::Image, b: &use3d_capture::Image) -> f32 {
    a.data().iter().zip(b.data()).fold(0.0, |m, (a, b)| m.max((a - b).abs()))
}

#[test]
fn strength_goes_from_the_reconstruction_to_the_enhancement() {
    let (scene, views) = mini();
    let teacher = taught(&scene);
    let camera = &views[3].camera;
    let at = |strength| draw(&teacher, Look::Enhanced { strength }, camera);
    let plain = draw(&scene, Look::Reconstruction, camera);
    assert_eq!(at(0.0), plain, "strength 0 is the reconstruction, bit for bit");
    assert_eq!(
        draw(&teacher, Look::Reconstruction, camera),
        plain,
        "an enhancement does not touch the reconstruction"
    );
    let steps: Vec<f32> = (0..=4).map(|k| worst(&at(k as f32 / 4.0), &plain)).collect();
    assert!(steps.windows(2).all(|w| w[1] > w[0]), "{steps:?}");
    assert!(steps[4] > 0.1, "the teacher does something: {steps:?}");
    for strength in [-0.1, 1.1, f32::NAN] {
        assert!(matches!(
            Renderer::new(&teacher, Look::Enhanced { strength }).err(),
            Some(EnhanceError::Strength(_))
        ));
    }
    assert!(matches!(
        Renderer::new(&scene, Look::Enhanced { strength: 1.0 }).err(),
        Some(EnhanceError::NotEnhanced)
    ));
}

#[test]
fn a_crop_keeps_its_colours_and_layers_add_up() {
    let (scene, views) = mini();
    let teacher = taught(&scene);
    let camera = &views[5].camera;
    let half: Vec<usize> = (0..200).collect();
    let crop = Scene { gaussians: teacher.gaussians.select(&half), ..teacher.clone() };
    // In the crop, the Gaussians that remain have the colours they had: the same as hiding the others.
    let mut hidden = teacher.clone();
    hidden.gaussians.opacity_logits[200..].fill(-30.0);
    let look = Look::Enhanced { strength: 1.0 };
    assert!(worst(&draw(&crop, look, camera), &draw(&hidden, look, camera)) < 1e-6);
    let mut out = Rendered::new();
    let mut renderer = Renderer::new(&teacher, look).unwrap();
    renderer.render(camera, &Lattice::full(&camera.intrinsics), true, &mut out);
    let layers = out.layers.as_ref().unwrap();
    for (p, v) in out.image.data().iter().enumerate() {
        let sum = layers.object.data()[p] + layers.medium.data()[p] + layers.far.data()[p];
        assert!((sum - v).abs() < 2e-5, "{sum} {v}");
    }
    assert!(renderer.medium().is_some());
}

#[test]
fn a_baked_scene_shows_the_enhanced_radiance() {
    let (scene, views) = mini();
    let mut teacher = taught(&scene);
    // Colours far from the clamp: the bake is exact to rounding.
    for sh in &mut teacher.gaussians.sh {
        for band in &mut sh[1..] {
            *band = band.map(|v| 0.05 * v);
        }
        sh[0] = sh[0].map(|v| v.clamp(-0.8, 1.5));
    }
    let (baked, report) = bake(&teacher, 1.0).unwrap();
    assert_eq!(report.clamped_share, 0.0, "{report:?}");
    assert!(report.max_error < 1e-5, "{report:?}");
    let camera = &views[0].camera;
    let lattice = Lattice::full(&camera.intrinsics);
    let mut out = Rendered::new();
    Renderer::new(&teacher, Look::Enhanced { strength: 1.0 })
        .unwrap()
        .render(camera, &lattice, true, &mut out);
    let clear = &out.layers.as_ref().unwrap().clear;
    let mut prepared = Prepared::new();
    prepared.prepare(&baked, camera, &lattice, Colors::Sh { degree: 3 });
    let mut plain = Rendered::new();
    Rasterizer::new().forward(&prepared, None, &Options::default(), &mut plain);
    assert!(worst(clear, &plain.image) < 1e-4, "{}", worst(clear, &plain.image));
    assert_eq!(bake(&teacher, 0.0).unwrap().0.means, teacher.gaussians.means);

    // With clamped colours the report says how far off it is, and that it is far off only there.
    let mut dark = teacher.clone();
    for sh in dark.gaussians.sh.iter_mut().take(100) {
        sh[0] = [-2.5, 0.3, -1.9];
        sh[3] = [0.9, 0.0, -0.8];
    }
    let (_, report) = bake(&dark, 1.0).unwrap();
    assert!(report.clamped_share > 0.02 && report.max_error > 1e-3, "{report:?}");
    assert!(report.max_error_unclamped < 1e-5, "{report:?}");
    assert!(matches!(bake(&scene, 1.0), Err(EnhanceError::NotEnhanced)));
}
