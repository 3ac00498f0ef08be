//! Compares every gradient with finite differences, on fresh random scenes.

use use3d_capture::{Formation, MediumMaps};
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{
    GaussianGradients, Gaussians, Gradients, Options, Rasterizer, RenderGradients, Rendered, ViewOf,
    view_colors,
};

use crate::support::{
    prepared, random_camera, random_depth_network, random_gaussians, random_image, random_map, random_medium,
};

struct Scene {
    camera: use3d_capture::Camera,
    gaussians: Gaussians,
    medium: Option<MediumMaps>,
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
}

/// The loss jumps where a 1/255 contour crosses a pixel centre, where a pixel stops, and where two depths
/// change order. Ten wide Gaussians put their contours outside the image and leave transmittance
/// everywhere. The remaining jumps are tolerated: the median of eight random directions must agree, and all
/// of them must stay within a looser bound.
fn check(scene: &mut Scene, options: Options, seed: u64) {
    let (w, h) = (scene.camera.intrinsics.width, scene.camera.intrinsics.height);
    let mut rasterizer = Rasterizer::new();
    // Smooth `d_rendered` keep the noise of contour crossings low.
    let (image, clear) = (random_image(w, h, seed), random_image(w, h, seed + 1));
    let (depth, accumulation) = (random_map(w, h, seed + 2), random_map(w, h, seed + 3));
    let d_rendered = RenderGradients {
        image: &image,
        depth: Some(&depth),
        accumulation: Some(&accumulation),
        clear: Some(&clear),
    };
    // The view direction of a colour is detached from the mean (R28), so moved means keep the colours of
    // their old position.
    let mut colors = Vec::new();
    view_colors(&scene.gaussians, &scene.camera, scene.gaussians.sh_degree, &mut colors);
    let loss = |scene: &Scene, rasterizer: &mut Rasterizer, detached: bool| {
        let mut out = Rendered::new();
        let with_layers = Options { layers: true, ..options };
        let mut view = prepared(&scene.gaussians, &scene.camera);
        if detached {
            view.set_colors(&colors);
        }
        rasterizer.forward(&view, scene.medium.as_ref(), &with_layers, &mut out);
        dot(out.image.data(), image.data())
            + dot(out.depth.data(), depth.data())
            + dot(out.accumulation.data(), accumulation.data())
            + dot(out.layers.unwrap().clear.data(), clear.data())
    };
    let mut grads = GaussianGradients::default();
    let mut maps = MediumMaps::zeros(0, 0);
    let view = prepared(&scene.gaussians, &scene.camera);
    rasterizer.backward(
        &view,
        ViewOf { gaussians: &scene.gaussians, camera: &scene.camera },
        scene.medium.as_ref(),
        &options,
        &d_rendered,
        Gradients { gaussians: &mut grads, medium: Some(&mut maps) },
    );
    // Rounding of f32 images changes the loss by about this amount.
    let rounding = 1e-7
        * [image.data(), clear.data(), depth.data(), accumulation.data()]
            .iter()
            .flat_map(|d| d.iter())
            .map(|c| f64::from(c.abs()))
            .sum::<f64>();
    let stream = Stream::new(seed, Purpose::new("directions"), 0);
    let n = scene.gaussians.len();
    // Directional derivatives along random directions of each parameter group.
    type Group = (&'static str, f32, fn(&mut Gaussians) -> &mut [f32], Vec<f32>);
    let groups: Vec<Group> = vec![
        ("means", 1e-3, |g| g.means.as_flattened_mut(), grads.means.as_flattened().to_vec()),
        ("log_scales", 2e-3, |g| g.log_scales.as_flattened_mut(), grads.log_scales.as_flattened().to_vec()),
        (
            "quaternions",
            2e-3,
            |g| g.quaternions.as_flattened_mut(),
            grads.quaternions.as_flattened().to_vec(),
        ),
        ("opacity_logits", 5e-3, |g| &mut g.opacity_logits, grads.opacity_logits.clone()),
        (
            "sh",
            5e-3,
            |g| g.sh.as_flattened_mut().as_flattened_mut(),
            grads.sh.as_flattened().as_flattened().to_vec(),
        ),
    ];
    for (number, (name, step, values, gradient)) in groups.into_iter().enumerate() {
        assert!(gradient.iter().all(|g| g.is_finite()));
        let (mut errors, mut sizes) = (Vec::new(), Vec::new());
        for trial in 0..8 {
            let base = ((number * 8 + trial) as u64) << 32;
            let direction: Vec<f32> =
                (0..gradient.len()).map(|i| stream.normal(base + i as u64).signum() as f32).collect();
            let old = values(&mut scene.gaussians).to_vec();
            let mut at = |sign: f32| {
                for (v, (o, d)) in values(&mut scene.gaussians).iter_mut().zip(old.iter().zip(&direction)) {
                    *v = o + sign * step * d;
                }
                loss(scene, &mut rasterizer, name == "means")
            };
            let (up, here, down) = (at(1.0), at(0.0), at(-1.0));
            let numeric = (up - down) / (2.0 * f64::from(step));
            values(&mut scene.gaussians).copy_from_slice(&old);
            // Two depths that change order make a jump; a difference across it does not estimate the
            // derivative.
            if (up - 2.0 * here + down).abs() > 0.1 * (up - down).abs() + 2.0 * rounding {
                continue;
            }
            let analytic = dot(&gradient, &direction);
            errors.push((numeric - analytic).abs());
            sizes.push(analytic.abs());
        }
        assert!(errors.len() >= 2, "{name}: {} of 8 directions are smooth", errors.len());
        errors.sort_by(f64::total_cmp);
        sizes.sort_by(f64::total_cmp);
        let size = sizes[sizes.len() - 1];
        assert!(size > 0.0, "{name}: no gradient at all");
        assert!(
            errors[errors.len() / 2] < 0.01 * size + rounding / f64::from(step)
                && errors[errors.len() - 1] < 0.08 * size + rounding / f64::from(step),
            "{name}, {n} Gaussians: {errors:?} of {sizes:?}"
        );
    }
    let Some(medium) = scene.medium.clone() else { return };
    let zero = MediumMaps::zeros(w, h);
    for quantity in 0..3 {
        fn of(m: &mut MediumMaps, quantity: usize) -> &mut [f32] {
            match quantity {
                0 => m.color.data_mut(),
                1 => m.backscatter.data_mut(),
                _ => m.attenuation.data_mut(),
            }
        }
        let direction: Vec<f32> =
            (0..3 * w * h).map(|i| stream.normal(7_000_000 + i as u64) as f32).collect();
        let analytic = dot(of(&mut maps, quantity), &direction);
        let mut at = |step: f32| {
            let mut moved = medium.clone();
            for (v, d) in of(&mut moved, quantity).iter_mut().zip(&direction) {
                *v += step * d;
            }
            scene.medium = Some(moved);
            loss(scene, &mut rasterizer, false)
        };
        let numeric = (at(1e-3) - at(-1e-3)) / 2e-3;
        assert!(
            (numeric - analytic).abs() < 2e-3 * analytic.abs().max(1.0),
            "map {quantity}: {numeric} {analytic}"
        );
    }
    assert_ne!(zero, maps);
    let slopes: Vec<f32> = maps.network.iter().flat_map(|network| network.values().copied()).collect();
    for (number, run) in [0..3, 3..6, 6..9, 9..41, 41..73, 73..169, 169..172].into_iter().enumerate() {
        let Some(slopes) = slopes.get(run.clone()) else { break };
        let direction: Vec<f32> = run.clone().map(|i| stream.normal(8_000_000 + i as u64) as f32).collect();
        let mut at = |step: f32| {
            let mut moved = medium.clone();
            let values = moved.network.as_mut().unwrap().values_mut().skip(run.start);
            values.zip(&direction).for_each(|(v, d)| *v += step * d);
            scene.medium = Some(moved);
            loss(scene, &mut rasterizer, false)
        };
        let (analytic, numeric) = (dot(slopes, &direction), (at(4e-3) - at(-4e-3)) / 8e-3);
        assert!(
            (numeric - analytic).abs() < 2e-3 * analytic.abs().max(1.0),
            "numbers {number}: {numeric} {analytic}"
        );
    }
    scene.medium = Some(medium);
}

#[test]
fn finite_differences_agree_under_water() {
    for seed in 0..3 {
        let mut scene = Scene {
            camera: random_camera(70, 45),
            gaussians: random_gaussians(10, 0.9, seed),
            medium: Some(random_medium(70, 45, seed % 2 == 0, seed)),
        };
        check(&mut scene, Options::default(), 100 * seed);
    }
}

#[test]
fn finite_differences_agree_with_water_over_the_image() {
    for (seed, formation) in
        [0, 1, 2, 3].into_iter().flat_map(|seed| [(seed, Formation::PerImage), (seed, Formation::Normalised)])
    {
        let mut medium = random_medium(70, 45, seed % 2 == 0, seed);
        medium.formation = formation;
        let mut scene = Scene {
            camera: random_camera(70, 45),
            gaussians: random_gaussians(10, 0.9, seed),
            medium: Some(medium),
        };
        check(&mut scene, Options::default(), 100 * seed);
    }
}

#[test]
fn finite_differences_agree_with_a_depth_network() {
    for seed in 0..3 {
        let mut scene = Scene {
            camera: random_camera(70, 45),
            gaussians: random_gaussians(10, 0.9, seed),
            medium: Some(random_depth_network(70, 45, seed)),
        };
        check(&mut scene, Options::default(), 100 * seed);
    }
}

#[test]
fn finite_differences_agree_without_a_medium() {
    let mut scene =
        Scene { camera: random_camera(50, 70), gaussians: random_gaussians(10, 0.9, 9), medium: None };
    check(&mut scene, Options::default(), 900);
}
