//! Tests of rendering and baking an enhanced scene.

mod common;

use common::{draw, mini, taught};
use use3d_capture::{Camera, Lattice, MediumMaps, Pose};
use use3d_medium::{MediumGlobal, MediumModel};
use use3d_numerics::math;
use use3d_render::{Look, RenderError, Renderer, bake, bake_in_water};
use use3d_scene::{KnownViews, Scene};
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
            Some(RenderError::Strength(_))
        ));
    }
    assert!(matches!(
        Renderer::new(&scene, Look::Enhanced { strength: 1.0 }).err(),
        Some(RenderError::NotEnhanced)
    ));
}

#[test]
fn water_goes_from_all_of_it_to_the_clear_radiance() {
    let (scene, views) = mini();
    let teacher = taught(&scene);
    let camera = &views[3].camera;
    let lattice = Lattice::full(&camera.intrinsics);
    for look in [Look::Reconstruction, Look::Enhanced { strength: 1.0 }] {
        let at = |water: f32| {
            let mut out = Rendered::new();
            let mut renderer = Renderer::new(&teacher, look).unwrap().with_water(water).unwrap();
            renderer.render(camera, &lattice, true, &mut out).unwrap();
            out
        };
        let shares = [0.0f32, 0.2, 0.4, 0.6, 0.8, 1.0].map(at);
        let [none, .., all] = &shares;
        assert_eq!(all.image, draw(&teacher, look, camera), "all of it is the picture as it was");
        let clear = &all.layers.as_ref().unwrap().clear;
        assert_eq!(&none.image, clear, "none of it is the clear radiance, to the bit");
        let mut drawn = Rendered::new();
        let mut renderer = Renderer::new(&teacher, look).unwrap();
        renderer.render_clear(camera, &lattice, &mut drawn).unwrap();
        assert_eq!(&drawn.image, clear);
        let layers = |r: &Rendered| r.layers.clone().unwrap();
        for pair in shares.windows(2) {
            let (less, more) = (layers(&pair[0]), layers(&pair[1]));
            let water = |l: &use3d_splat::Layers, p: usize| l.medium.data()[p] + l.far.data()[p];
            let (mut scene_light, mut water_light) = ([0.0f64; 2], [0.0f64; 2]);
            for p in 0..less.object.data().len() {
                assert!(water(&more, p) >= water(&less, p) - 1e-5, "water {p}");
                if look == Look::Reconstruction {
                    // Enhanced colours may be negative, so their sum need not shrink everywhere.
                    assert!(more.object.data()[p] <= less.object.data()[p] + 1e-5, "object {p}");
                }
                for (k, layers) in [&less, &more].into_iter().enumerate() {
                    scene_light[k] += f64::from(layers.object.data()[p]);
                    water_light[k] += f64::from(water(layers, p));
                }
            }
            assert!(scene_light[1] < scene_light[0] && water_light[1] > water_light[0]);
            let sum = |l: &use3d_splat::Layers, p: usize| l.object.data()[p] + water(l, p);
            for (p, v) in pair[1].image.data().iter().enumerate() {
                assert!((sum(&more, p) - v).abs() < 2e-5, "layers add up at every share");
            }
        }
        let mut out = Rendered::new();
        Renderer::new(&teacher, look)
            .unwrap()
            .with_water(0.4)
            .unwrap()
            .render(camera, &lattice, false, &mut out)
            .unwrap();
        assert_eq!((&out.image, &out.layers), (&shares[2].image, &None), "layers are an extra");
    }
    for water in [-0.1, 1.1, f32::NAN] {
        let refused = Renderer::new(&teacher, Look::Reconstruction).unwrap().with_water(water).err();
        assert!(matches!(refused, Some(RenderError::Water(_))));
        assert!(refused.unwrap().to_string().contains("expected 0"));
    }
}

/// The scene with only the Gaussian that covers most of a picture.
fn most_covering(scene: &Scene, camera: &Camera) -> Scene {
    let lattice = Lattice::full(&camera.intrinsics);
    let alone = |i: usize| Scene { gaussians: scene.gaussians.select(&[i]), ..scene.clone() };
    let covered = |i: usize| {
        let mut out = Rendered::new();
        let alone = alone(i);
        Renderer::new(&alone, Look::Reconstruction)
            .unwrap()
            .render(camera, &lattice, false, &mut out)
            .unwrap();
        out.accumulation.data().iter().map(|w| f64::from(*w)).sum::<f64>()
    };
    let most = (0..scene.gaussians.len()).max_by(|a, b| covered(*a).total_cmp(&covered(*b)));
    alone(most.unwrap())
}

#[test]
fn a_faint_gaussian_before_open_water_leaves_no_edge() {
    let (scene, views) = mini();
    let camera = &views[3].camera;
    let lattice = Lattice::full(&camera.intrinsics);
    let mut faint = most_covering(&scene, camera);
    let alpha = 0.006f32;
    let share = 0.4f32;
    let mut drawn = |logit: f32| {
        faint.gaussians.opacity_logits[0] = logit;
        let mut out = Rendered::new();
        let mut renderer = Renderer::new(&faint, Look::Reconstruction).unwrap().with_water(share).unwrap();
        renderer.render(camera, &lattice, true, &mut out).unwrap();
        (out, renderer.medium().unwrap().clone())
    };
    let (with, maps) = drawn(math::ln(alpha / (1.0 - alpha)));
    let (without, _) = drawn(-30.0);
    let (mut seen, mut step) = (0, 0.0f32);
    for y in 0..lattice.height() {
        for x in 0..lattice.width() {
            let w = with.accumulation.pixel(x, y)[0];
            assert!(w <= 1.01 * alpha);
            if w == 0.0 {
                continue;
            }
            seen += 1;
            let s = with.layers.as_ref().unwrap().distance.pixel(x, y)[0];
            for c in 0..3 {
                let change = (with.image.pixel(x, y)[c] - without.image.pixel(x, y)[c]).abs();
                assert!(change < 1.5 * alpha, "{x} {y} {c}: {change}");
                // The part of the water's light that lies nearer than the Gaussian.
                let nearer = 1.0 - math::exp(-share * maps.backscatter.pixel(x, y)[c] * s);
                step = step.max((1.0 - share) * nearer * maps.color.pixel(x, y)[c]);
            }
        }
    }
    assert!(
        seen > 10 && step > 3.0 * alpha,
        "{seen} pixels; dimmed by the far end alone the edge would be {step}"
    );
}

#[test]
fn a_share_of_the_water_is_the_documented_sum() {
    let (scene, views) = mini();
    let camera = &views[3].camera;
    let lattice = Lattice::full(&camera.intrinsics);
    let share = 0.35f32;
    let single = most_covering(&scene, camera);
    let (mut whole, mut part) = (Rendered::new(), Rendered::new());
    let mut renderer = Renderer::new(&single, Look::Reconstruction).unwrap();
    renderer.render(camera, &lattice, true, &mut whole).unwrap();
    let maps = renderer.medium().unwrap().clone();
    let mut renderer = renderer.with_water(share).unwrap();
    renderer.render(camera, &lattice, false, &mut part).unwrap();
    assert_eq!(renderer.medium(), Some(&maps), "the water itself is told whole");
    let layers = whole.layers.as_ref().unwrap();
    let (mut hit, mut open) = (0, 0);
    for y in 0..lattice.height() {
        for x in 0..lattice.width() {
            let w = f64::from(whole.accumulation.pixel(x, y)[0]);
            let s = if w > 0.0 { f64::from(layers.distance.pixel(x, y)[0]) } else { 0.0 };
            if w > 0.0 {
                hit += 1;
            } else {
                open += 1;
            }
            for c in 0..3 {
                let at = |image: &use3d_capture::Image| f64::from(image.pixel(x, y)[c]);
                let a = f64::from(share);
                let attenuated = math::exp(-a * at(&maps.attenuation) * s);
                let veil = math::exp(-a * at(&maps.backscatter) * s);
                let water = at(&maps.color) * (w * (1.0 - veil) + a * (1.0 - w));
                let expected = at(&layers.clear) * attenuated + water;
                assert!((at(&part.image) - expected).abs() < 1e-5, "{x} {y} {c}: {expected}");
            }
        }
    }
    assert!(hit > 20 && open > 20, "{hit} pixels see the Gaussian, {open} open water");
}

#[test]
fn a_crop_keeps_its_colours_and_layers_add_up() {
    let (scene, views) = mini();
    let teacher = taught(&scene);
    let camera = &views[5].camera;
    let half: Vec<usize> = (0..200).collect();
    let crop = Scene { gaussians: teacher.gaussians.select(&half), ..teacher.clone() };
    // In the crop, the remaining Gaussians keep their colours, as if the others were hidden.
    let mut hidden = teacher.clone();
    hidden.gaussians.opacity_logits[200..].fill(-30.0);
    let look = Look::Enhanced { strength: 1.0 };
    assert!(worst(&draw(&crop, look, camera), &draw(&hidden, look, camera)) < 1e-6);
    let mut out = Rendered::new();
    let mut renderer = Renderer::new(&teacher, look).unwrap();
    renderer.render(camera, &Lattice::full(&camera.intrinsics), true, &mut out).unwrap();
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
    // With colours far from the clamp, the bake is exact to rounding.
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
        .render(camera, &lattice, true, &mut out)
        .unwrap();
    let clear = &out.layers.as_ref().unwrap().clear;
    let mut prepared = Prepared::new();
    prepared.prepare(&baked, camera, &lattice, Colors::Sh { degree: 3 });
    let mut plain = Rendered::new();
    Rasterizer::new().forward(&prepared, None, &Options::default(), &mut plain);
    assert!(worst(clear, &plain.image) < 1e-4, "{}", worst(clear, &plain.image));
    assert_eq!(bake(&teacher, 0.0).unwrap().0.means, teacher.gaussians.means);

    // With clamped colours, the report states the error, and that it is large only there.
    let mut dark = teacher.clone();
    for sh in dark.gaussians.sh.iter_mut().take(100) {
        sh[0] = [-2.5, 0.3, -1.9];
        sh[3] = [0.9, 0.0, -0.8];
    }
    let (_, report) = bake(&dark, 1.0).unwrap();
    assert!(report.clamped_share > 0.02 && report.max_error > 1e-3, "{report:?}");
    assert!(report.max_error_unclamped < 1e-5, "{report:?}");
    assert!(matches!(bake(&scene, 1.0), Err(RenderError::NotEnhanced)));
}

#[test]
fn a_look_baked_in_water_shows_what_cameras_saw() {
    let (scene, views) = mini();
    let teacher = taught(&scene);
    let cameras: Vec<Camera> = views.iter().map(|v| v.camera).collect();
    let mean = |a: &use3d_capture::Image, b: &use3d_capture::Image| {
        let apart = a.data().iter().zip(b.data()).map(|(a, b)| f64::from((a.max(0.0) - b.max(0.0)).abs()));
        apart.sum::<f64>() / a.data().len() as f64
    };
    let file = |gaussians: use3d_splat::Gaussians| Scene {
        gaussians,
        medium: MediumModel::None,
        enhancement: None,
        ..scene.clone()
    };
    for (look, of) in [(Look::Reconstruction, &scene), (Look::Enhanced { strength: 1.0 }, &teacher)] {
        let baked = bake_in_water(of, look, 1.0, &cameras).unwrap();
        assert!(baked.backdrop > 0 && baked.gaussians.len() == of.gaussians.len() + baked.backdrop);
        baked.gaussians.validate().unwrap();
        let dry = bake_in_water(of, look, 0.0, &[]).unwrap();
        assert_eq!(dry.backdrop, 0);
        let alone: Vec<usize> = (0..of.gaussians.len()).collect();
        let (wet, no_backdrop, dry) =
            (file(baked.gaussians.clone()), file(baked.gaussians.select(&alone)), file(dry.gaussians));
        for camera in &cameras {
            let picture = draw(of, look, camera);
            let [wet, bare, dry] =
                [&wet, &no_backdrop, &dry].map(|s| mean(&draw(s, Look::Reconstruction, camera), &picture));
            assert!(wet < 0.05, "{wet}");
            assert!(2.0 * wet < dry && wet < bare, "in water {wet}, without backdrop {bare}, dry {dry}");
        }
    }
    // Without water the bake equals the one without any water.
    let (plain, report) = bake(&teacher, 1.0).unwrap();
    let dry = bake_in_water(&teacher, Look::Enhanced { strength: 1.0 }, 0.0, &[]).unwrap();
    assert_eq!((dry.gaussians, dry.report), (plain, report));
    let refused = |water, cameras: &[Camera]| {
        bake_in_water(&scene, Look::Reconstruction, water, cameras).err().map(|e| e.to_string())
    };
    assert!(refused(1.0, &[]).unwrap().contains("at least one camera"));
    assert!(refused(1.5, &cameras).unwrap().contains("expected 0"));
}

/// The green of the first Gaussian behind water that is the same in all directions, if it has the green `own`
/// without water.
fn green_through_water(scene: &Scene, camera: &Camera, own: f64) -> f64 {
    let mut maps = MediumMaps::zeros(0, 0);
    scene.look_through(camera, &Lattice::full(&camera.intrinsics), &mut maps);
    let [attenuation, backscatter, veil] =
        [&maps.attenuation, &maps.backscatter, &maps.color].map(|m| f64::from(m.pixel(0, 0)[1]));
    let s = (camera.pose.center() - glam::Vec3::from_array(scene.gaussians.means[0]).as_dvec3()).length();
    own * math::exp(-attenuation * s) + veil * (1.0 - math::exp(-backscatter * s))
}

#[test]
fn one_camera_and_one_gaussian_are_baked_exactly() {
    let (mut scene, views) = mini();
    let camera = views[0].camera;
    scene.gaussians = most_covering(&scene, &camera).gaussians;
    scene.medium = MediumModel::Global(MediumGlobal::default());
    let baked = bake_in_water(&scene, Look::Reconstruction, 1.0, &[camera]).unwrap();
    // Green of the constant band: the former colour is attenuated, and the veil is added.
    let c0 = f64::from(use3d_numerics::spherical_harmonics::C0);
    let before = 0.5 + c0 * f64::from(scene.gaussians.sh[0][0][1]);
    let after = 0.5 + c0 * f64::from(baked.gaussians.sh[0][0][1]);
    let expected = green_through_water(&scene, &camera, before);
    assert!((after - expected).abs() < 1e-5, "{after} {expected}");
}

#[test]
fn what_stage_1_knows_of_a_view_is_what_its_layers_say() {
    let (scene, views) = mini();
    for scene in [scene.clone(), Scene { medium: MediumModel::None, ..scene }] {
        let camera = &views[0].camera;
        let known = KnownViews::new(&scene).view(camera);
        let (mut renderer, mut out) = (Renderer::new(&scene, Look::Reconstruction).unwrap(), Rendered::new());
        renderer.render(camera, &Lattice::full(&camera.intrinsics), true, &mut out).unwrap();
        let layers = out.layers.as_ref().unwrap();
        let apart = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(apart(known.clear.data(), layers.clear.data()) < 1e-6);
        assert_eq!(known.accumulation, out.accumulation);
        // Each channel arrives attenuated, with at most the light of the surface.
        let n = known.accumulation.pixels();
        for (i, (arriving, clear)) in known.arriving.data().iter().zip(layers.clear.data()).enumerate() {
            let accumulation = known.accumulation.data()[i % n];
            assert!((0.0..=accumulation + 1e-6).contains(arriving), "{arriving} of {accumulation}");
            // For a surface of one colour, the arriving part is its share.
            let share = arriving / accumulation.max(1e-6);
            let object = layers.object.data()[i];
            assert!((object - share * clear).abs() < 0.12, "{object} {share} {clear}");
        }
        if scene.medium.is_none() {
            assert!(apart(&known.arriving.data()[..n], known.accumulation.data()) < 1e-6);
        } else {
            assert!(apart(&known.arriving.data()[..n], known.accumulation.data()) > 0.1);
        }
    }
}

#[test]
fn water_over_the_image_is_graded_and_thinned_as_any_other() {
    let (scene, views) = mini();
    let over = Scene { medium: MediumModel::Image(MediumGlobal::default()), ..scene.clone() };
    let front = Scene { medium: MediumModel::Global(MediumGlobal::default()), ..scene };
    let (teacher, camera) = (taught(&over), &views[3].camera);
    let plain = draw(&over, Look::Reconstruction, camera);
    assert!(worst(&plain, &draw(&front, Look::Reconstruction, camera)) > 1e-3, "the formations differ");
    assert_eq!(draw(&teacher, Look::Enhanced { strength: 0.0 }, camera), plain);
    let lattice = Lattice::full(&camera.intrinsics);
    let (mut out, mut maps, share) = (Rendered::new(), MediumMaps::zeros(0, 0), 0.4);
    let mut renderer = Renderer::new(&over, Look::Reconstruction).unwrap().with_water(share).unwrap();
    renderer.render(camera, &lattice, true, &mut out).unwrap();
    assert!(over.look_through(camera, &lattice, &mut maps));
    let (layers, n) = (out.layers.unwrap(), out.accumulation.pixels());
    for i in 0..3 * n {
        let (a, s) = (out.accumulation.data()[i % n], share * layers.distance.data()[i % n]);
        let object = layers.clear.data()[i] * math::exp(-maps.attenuation.data()[i] * s);
        let between = a * (1.0 - math::exp(-maps.backscatter.data()[i] * s));
        let expected = object + maps.color.data()[i] * (between + share * (1.0 - a));
        assert!((out.image.data()[i] - expected).abs() < 1e-5, "{} {expected}", out.image.data()[i]);
    }
}

#[test]
fn two_cameras_at_two_distances_each_find_their_own_colour() {
    let (mut scene, views) = mini();
    let near = views[0].camera;
    scene.gaussians = most_covering(&scene, &near).gaussians;
    scene.medium = MediumModel::Global(MediumGlobal::default());
    // The second camera stands on the other side, at twice the distance.
    let at = glam::Vec3::from_array(scene.gaussians.means[0]).as_dvec3();
    let away = near.pose.center() - at;
    let up = if away.y.abs() < 0.9 * away.length() { glam::DVec3::Y } else { glam::DVec3::X };
    let far = Camera { pose: Pose::look_at(at - 2.0 * away, at, up), ..near };
    let baked = bake_in_water(&scene, Look::Reconstruction, 1.0, &[near, far]).unwrap();
    let green = |gaussians: &use3d_splat::Gaussians, camera: &Camera| {
        let d = (at - camera.pose.center()).normalize().as_vec3().to_array();
        let y = use3d_numerics::spherical_harmonics::basis(3, d);
        0.5 + (0..16).map(|k| f64::from(y[k] * gaussians.sh[0][k][1])).sum::<f64>()
    };
    let expected =
        |camera: &Camera| green_through_water(&scene, camera, green(&scene.gaussians, camera).max(0.0));
    let (here, there) = (expected(&near), expected(&far));
    assert!((here - there).abs() > 0.02, "the distances make a difference: {here} {there}");
    for (camera, expected) in [(&near, here), (&far, there)] {
        let shown = green(&baked.gaussians, camera);
        assert!((shown - expected).abs() < 0.1 * (here - there).abs(), "{shown} for {expected}");
    }
}
