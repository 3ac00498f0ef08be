//! Parameters and sizes that no real scene has: they never cause a panic, and every drawn value is finite.

use use3d_capture::MediumMaps;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{GaussianGradients, Gaussians, Gradients, Options, RenderGradients, Rendered, ViewOf};

use crate::support::{
    engines, prepared, random_camera, random_gaussians, random_image, random_map, random_medium,
};

fn run_all(gaussians: &Gaussians, width: usize, height: usize) {
    let camera = random_camera(width, height);
    let medium = random_medium(width, height, true, 1);
    let (image, clear) = (random_image(width, height, 1), random_image(width, height, 2));
    let (depth, weight) = (random_map(width, height, 3), random_map(width, height, 4));
    let d_rendered = RenderGradients {
        image: &image,
        depth: Some(&depth),
        accumulation: Some(&weight),
        clear: Some(&clear),
    };
    for (name, mut rasterizer) in engines() {
        let view = prepared(gaussians, &camera);
        for medium in [None, Some(&medium)] {
            let mut out = Rendered::new();
            let options = Options { layers: true, ..Options::default() };
            rasterizer.forward(&view, medium, &options, &mut out);
            let layers = out.layers.as_ref().unwrap();
            for image in [&out.image, &layers.object, &layers.medium, &layers.far, &layers.clear] {
                assert!(image.data().iter().all(|v| v.is_finite()), "{name}: image");
            }
            assert!(out.accumulation.data().iter().all(|v| (0.0..1.0).contains(v)), "{name}: accumulation");
            let (mut grads, mut maps) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
            rasterizer.backward(
                &view,
                ViewOf { gaussians, camera: &camera },
                medium,
                &options,
                &d_rendered,
                Gradients { gaussians: &mut grads, medium: Some(&mut maps) },
            );
            for values in [
                grads.means.as_flattened(),
                grads.log_scales.as_flattened(),
                grads.quaternions.as_flattened(),
                &grads.opacity_logits,
                grads.sh.as_flattened().as_flattened(),
                grads.screen.as_flattened(),
                maps.color.data(),
                maps.backscatter.data(),
                maps.attenuation.data(),
            ] {
                assert!(values.iter().all(|v| v.is_finite()), "{name}: gradient");
            }
        }
        let mut lifted = vec![0.0; 2 * gaussians.len()];
        rasterizer.splat_adjoint(&view, 2, &image.data()[..2 * width * height], &mut lifted);
        assert!(lifted.iter().all(|v| v.is_finite()));
    }
}

#[test]
fn parameters_that_are_not_finite_are_not_drawn() {
    let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e-42, -1e-42, 1e38, -1e38, 0.0];
    let s = Stream::new(3, Purpose::new("hostile"), 0);
    let mut gaussians = random_gaussians(400, -1.5, 1);
    // Two of three Gaussians have one to three bad entries. Colours stay finite, because they are drawn
    // unchanged.
    for i in 0..400 {
        if i % 3 == 0 {
            continue;
        }
        for k in 0..1 + s.below(i as u64 * 16, 3) as u64 {
            let value = bad[s.below(i as u64 * 16 + 2 * k + 1, bad.len())];
            let place = s.below(i as u64 * 16 + 2 * k + 2, 11);
            match place {
                0..3 => gaussians.means[i][place] = value,
                3..6 => gaussians.log_scales[i][place - 3] = value,
                6..10 => gaussians.quaternions[i][place - 6] = value,
                _ => gaussians.opacity_logits[i] = value,
            }
        }
        if i % 10 == 0 {
            gaussians.quaternions[i] = [0.0; 4];
        }
    }
    assert!(gaussians.validate().is_err());
    run_all(&gaussians, 50, 40);
}

#[test]
fn no_gaussians_and_none_in_front() {
    run_all(&Gaussians::empty(3), 33, 17);
    let mut behind = random_gaussians(50, -1.5, 1);
    for mean in &mut behind.means {
        mean[2] -= 50.0;
    }
    run_all(&behind, 33, 17);
}

#[test]
fn the_smallest_and_the_thinnest_images() {
    let gaussians = random_gaussians(60, -1.5, 1);
    run_all(&gaussians, 1, 1);
    run_all(&gaussians, 3, 5000);
    run_all(&gaussians, 2000, 2);
}

#[test]
fn gaussians_at_the_extremes_of_size_and_distance() {
    let mut gaussians = random_gaussians(60, -1.5, 1);
    for i in 0..60 {
        match i % 6 {
            0 => gaussians.log_scales[i] = [9.0, -20.0, 9.0],
            1 => gaussians.log_scales[i] = [-40.0; 3],
            2 => gaussians.log_scales[i] = [20.0, -80.0, -80.0],
            3 => gaussians.means[i] = [0.5, -0.3, -3.985],
            4 => gaussians.opacity_logits[i] = 60.0,
            _ => gaussians.means[i] = [100.0, 3000.0, 9000.0],
        }
    }
    assert!(gaussians.validate().is_ok());
    run_all(&gaussians, 50, 40);
}

/// Absurd water: it causes no panic, and results are finite where the coefficients are.
#[test]
fn absurd_water() {
    let gaussians = random_gaussians(100, -1.5, 1);
    let camera = random_camera(40, 40);
    let view = prepared(&gaussians, &camera);
    for value in [0.0, 1e-30, 50.0, 1e6, 1e30, f32::INFINITY, f32::NAN] {
        let mut medium = random_medium(40, 40, true, 1);
        medium.attenuation.set_pixel(7, 9, [value; 3]);
        medium.backscatter.data_mut()[..100].fill(value);
        for (name, mut rasterizer) in engines() {
            let mut out = Rendered::new();
            rasterizer.forward(
                &view,
                Some(&medium),
                &Options { layers: true, ..Options::default() },
                &mut out,
            );
            if value.is_finite() {
                assert!(out.image.data().iter().all(|v| v.is_finite()), "{name}: {value}");
            }
        }
    }
}
