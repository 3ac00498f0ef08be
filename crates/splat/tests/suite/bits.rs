//! The results have the same bits on any number of threads, on every instruction set with fused
//! multiply-add, and for the scalar twin.

use use3d_capture::{Image, MediumMaps};
use use3d_numerics::math;
use use3d_splat::{
    Colors, GaussianGradients, Gaussians, Gradients, Options, Prepared, Rasterizer, RenderGradients,
    Rendered, ViewOf,
};

use crate::support::{
    engines, fused_engines, lattice, random_camera, random_gaussians, random_image, random_map, random_medium,
};

/// All results that the crate computes for one scene.
#[derive(Debug, PartialEq)]
struct Everything {
    view: Vec<usize>,
    rendered: Rendered,
    grads: GaussianGradients,
    maps: MediumMaps,
    colors: Vec<[f32; 3]>,
    color_maps: MediumMaps,
    splat: Vec<f32>,
    lifted: Vec<f32>,
}

fn everything(rasterizer: &mut Rasterizer, gaussians: &Gaussians, medium: Option<&MediumMaps>) -> Everything {
    let (w, h) = (83, 61);
    let camera = random_camera(w, h);
    let mut view = Prepared::new();
    view.prepare(gaussians, &camera, &lattice(&camera), Colors::Sh { degree: 3 });
    let (mut rendered, options) = (Rendered::new(), Options { layers: true, ..Options::default() });
    rasterizer.forward(&view, medium, &options, &mut rendered);
    let (image, clear, depth, weight) =
        (random_image(w, h, 1), random_image(w, h, 2), random_map(w, h, 3), random_map(w, h, 4));
    let d_rendered = RenderGradients {
        image: &image,
        depth: Some(&depth),
        accumulation: Some(&weight),
        clear: Some(&clear),
    };
    let (mut grads, mut maps) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
    rasterizer.backward(
        &view,
        ViewOf { gaussians, camera: &camera },
        medium,
        &options,
        &d_rendered,
        Gradients { gaussians: &mut grads, medium: Some(&mut maps) },
    );
    let (mut colors, mut color_maps) = (vec![[0.0; 3]; gaussians.len()], MediumMaps::zeros(0, 0));
    rasterizer.backward_colors(&view, medium, &image, &mut colors, &mut color_maps);
    let channels = 11;
    let values: Vec<f32> = (0..channels * gaussians.len()).map(|i| math::sin(i as f32 * 0.37)).collect();
    let mut splat = vec![0.0; channels * w * h];
    rasterizer.splat(&view, channels, &values, &mut splat);
    let mut lifted = vec![0.0; channels * gaussians.len()];
    rasterizer.splat_adjoint(&view, channels, &splat, &mut lifted);
    Everything { view: view.visible().collect(), rendered, grads, maps, colors, color_maps, splat, lifted }
}

/// Scenes in which pixels stop (large opaque Gaussians), with smooth water, with rough water, and without
/// water.
fn scenes() -> Vec<(&'static str, Gaussians, Option<MediumMaps>)> {
    let mut opaque = random_gaussians(300, -0.8, 5);
    for logit in &mut opaque.opacity_logits {
        *logit += 4.0;
    }
    vec![
        ("smooth water", random_gaussians(400, -2.0, 6), Some(random_medium(83, 61, true, 1))),
        ("rough water", opaque.clone(), Some(random_medium(83, 61, false, 2))),
        ("no water", opaque, None),
    ]
}

#[test]
fn every_fused_engine_gives_the_bits_of_the_twin() {
    for (scene, gaussians, medium) in scenes() {
        let mut results: Vec<(&str, Everything)> = fused_engines()
            .into_iter()
            .map(|(name, mut engine)| (name, everything(&mut engine, &gaussians, medium.as_ref())))
            .collect();
        let (_, twin) = results.remove(0);
        for (name, result) in results {
            assert!(result.rendered == twin.rendered, "{scene}, {name}: images differ");
            assert!(result.grads == twin.grads, "{scene}, {name}: gradients differ");
            assert!(result == twin, "{scene}, {name}: something differs");
        }
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    for (scene, gaussians, medium) in scenes() {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| everything(&mut Rasterizer::new(), &gaussians, medium.as_ref()))
        };
        let one = run(1);
        for threads in [2, 3, 8] {
            assert!(one == run(threads), "{scene}: {threads} threads differ from one");
        }
    }
}

/// Without fused multiply-add only rounding differs.
#[test]
fn engines_without_fused_multiply_add_agree_closely() {
    let (_, gaussians, medium) = scenes().remove(0);
    let twin = everything(&mut Rasterizer::plain(), &gaussians, medium.as_ref());
    for (name, mut engine) in engines() {
        let other = everything(&mut engine, &gaussians, medium.as_ref());
        let worst = |a: &Image, b: &Image| {
            a.data().iter().zip(b.data()).map(|(a, b)| (a - b).abs()).fold(0.0f32, f32::max)
        };
        // A pixel on the 1/255 contour may fall on the other side of it.
        assert!(worst(&twin.rendered.image, &other.rendered.image) < 6e-3, "{name}");
        let mean = twin.rendered.image.data().iter().zip(other.rendered.image.data());
        let mean: f32 =
            mean.map(|(a, b)| (a - b).abs()).sum::<f32>() / twin.rendered.image.data().len() as f32;
        assert!(mean < 1e-6, "{name}: {mean}");
    }
}

/// A forward pass of another view in between must not change the backward pass.
#[test]
fn the_backward_pass_does_not_depend_on_which_view_was_rendered_last() {
    let (_, gaussians, medium) = scenes().remove(1);
    let (w, h) = (83, 61);
    let camera = random_camera(w, h);
    let mut view = Prepared::new();
    view.prepare(&gaussians, &camera, &lattice(&camera), Colors::Sh { degree: 3 });
    let mut other_view = Prepared::new();
    let other_camera = random_camera(40, 90);
    other_view.prepare(&gaussians, &other_camera, &lattice(&other_camera), Colors::Sh { degree: 3 });
    let image = random_image(w, h, 1);
    let depth = random_map(w, h, 3);
    let d_rendered = RenderGradients { image: &image, depth: Some(&depth), accumulation: None, clear: None };
    let run = |before: &Prepared, medium_before: Option<&MediumMaps>| {
        let (mut rasterizer, options) = (Rasterizer::new(), Options::default());
        rasterizer.forward(before, medium_before, &options, &mut Rendered::new());
        let (mut grads, mut maps) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
        rasterizer.backward(
            &view,
            ViewOf { gaussians: &gaussians, camera: &camera },
            medium.as_ref(),
            &options,
            &d_rendered,
            Gradients { gaussians: &mut grads, medium: Some(&mut maps) },
        );
        (grads, maps)
    };
    assert!(run(&view, medium.as_ref()) == run(&other_view, None));
}
