//! Compares the losses with goldens and finite differences.

use use3d_capture::{Camera, Formation, Image, Intrinsics, Map, MediumMaps, Pose};
use use3d_golden::{Case, Part};
use use3d_metrics::ms_ssim::level_weights;
use use3d_metrics::{decibels, mask_of, psnr};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};

use super::*;
use crate::{DepthPrior, Photometric, Priors, Target, Turns};

fn image(case: &Case<'_>, name: &str) -> Image {
    let (w, h, data) = case.planes(name);
    Image::from_planes(w, h, data).unwrap()
}

fn map(case: &Case<'_>, name: &str) -> Map {
    let (w, h, data) = case.planes(name);
    Map::from_planes(w, h, data).unwrap()
}

/// Level weights before they are renormalised: the training weights, or the case's own.
fn weights(case: &Case<'_>) -> Vec<f64> {
    let listed: Vec<f64> = serde_json::from_value(case.config()["weights"].clone()).unwrap();
    let (w, h) = (case.count("width"), case.count("height"));
    let ours = level_weights(&use3d_metrics::ms_ssim::RECONSTRUCTION_WEIGHTS, w, h);
    let same = ours.len() == listed.len() && ours.iter().zip(&listed).all(|(a, b)| (a - b).abs() < 1e-9);
    if same { use3d_metrics::ms_ssim::RECONSTRUCTION_WEIGHTS.to_vec() } else { listed }
}

/// The loss with other level weights.
fn with_levels(lambda: f64, weights: &[f64]) -> PhotometricLoss {
    let mut loss = PhotometricLoss::new(lambda);
    loss.weights = weights.to_vec();
    loss
}

#[test]
fn golden_losses() {
    let part = Part::math("losses");
    let mut seen = 0;
    for case in part.cases() {
        if !case.has("in.pred") {
            continue; // a whole training step, which is tested with the engine
        }
        seen += 1;
        let (prediction, target) = (image(&case, "in.pred"), image(&case, "in.target"));
        let (depth, prior) = (map(&case, "in.depth"), map(&case, "in.prior"));
        let (lambda, depth_weight) = (case.number("lam"), case.number("lam_d"));
        let levels = weights(&case);
        let mut gradient = Image::new(1, 1);
        let mut depth_gradient = Map::new(1, 1);
        let value = with_levels(lambda, &levels).evaluate(&prediction, &target, None, &mut gradient);
        let depth_loss = DepthPriorLoss.evaluate(&depth, &prior, 1.0, &mut depth_gradient);
        case.check_f64("out.reg_l1", &[value.reg_l1]);
        case.check_f64("out.reg_ms_ssim", &[value.reg_ms_ssim]);
        case.check_f64("out.depth_loss", &[depth_loss]);
        case.check_f64("out.total", &[value.total + depth_weight * depth_loss]);
        let mut measure = use3d_metrics::ms_ssim::MsSsim::default();
        let [x, y] = [&prediction, &target].map(|image| image.map(|v| v - 0.5));
        let plain = measure.value_and_gradient(&x, &y, 0.5, &levels, &mut gradient);
        case.check_f64("out.ms_ssim_plain", &[plain]);

        for pull in case.pulls().keys() {
            let d_output = case.f64(&format!("cot.{}", case.pulls()[pull][0]))[0];
            // (structure share, photometric factor, depth factor)
            let (lambda, photometric, depth_factor) = match pull.as_str() {
                "reg_l1" => (0.0, 1.0, 0.0),
                "reg_ms_ssim" => (1.0, 1.0, 0.0),
                "depth" => (lambda, 0.0, 1.0),
                "total" => (lambda, 1.0, depth_weight),
                other => panic!("unknown pull {other}"),
            };
            with_levels(lambda, &levels).evaluate(&prediction, &target, None, &mut gradient);
            let scaled = gradient.map(|g| (f64::from(g) * d_output * photometric) as f32);
            case.check_planes(&format!("grad.{pull}.pred"), scaled.data());
            DepthPriorLoss.evaluate(&depth, &prior, depth_factor * d_output, &mut depth_gradient);
            case.check_planes(&format!("grad.{pull}.depth"), depth_gradient.data());
        }
    }
    assert!(seen >= 4);
}

#[test]
fn golden_rivals() {
    let part = Part::math("rivals");
    for (name, which) in [("ssim", Photometric::Ssim), ("reg_ssim", Photometric::RegSsim)] {
        let case = part.cases().into_iter().find(|case| case.name() == name).unwrap();
        let (prediction, target) = (image(&case, "in.pred"), image(&case, "in.target"));
        let mut gradient = Image::new(1, 1);
        for (pull, lambda) in [("l1", 0.0), ("ssim", 1.0), ("total", case.number("lam"))] {
            let mut loss = PhotometricLoss::of(which, lambda);
            let value = loss.evaluate(&prediction, &target, None, &mut gradient);
            case.check_f64(&format!("out.{pull}"), &[value.total]);
            let d_output = case.f64(&format!("cot.{pull}"))[0] as f32;
            case.check_planes(&format!("grad.{pull}.pred"), gradient.map(|g| g * d_output).data());
        }
    }
    let case = part.cases().into_iter().find(|case| case.name() == "ranking").unwrap();
    let (depth, prior) = (map(&case, "in.depth"), map(&case, "in.prior"));
    let (mut gradient, d_output) = (Map::new(1, 1), case.f64("cot.depth_ranking")[0]);
    let value = ranking::DepthRanking.evaluate(&depth, &prior, d_output, &mut gradient);
    case.check_f64("out.depth_ranking", &[value]);
    case.check_planes("grad.depth_ranking.depth", gradient.data());
}

/// Evaluates a row of the table on a case of SeaSplat's priors, with weights of one value at a time.
fn golden_prior(case: &Case<'_>, row: LossTerm, outputs: &[&str]) {
    let (width, height) = (case.count("width"), case.count("height"));
    let of = |name: &str| if case.has(name) { image(case, name) } else { Image::new(width, height) };
    let map_of = |name: &str| if case.has(name) { map(case, name) } else { Map::new(width, height) };
    let laid_over = case.config()["laid_over"].as_bool().unwrap_or(true);
    let formation = if laid_over { Formation::Normalised } else { Formation::PerGaussian };
    let water = MediumMaps {
        color: of("in.c_m"),
        backscatter: of("in.beta_bs"),
        attenuation: Image::new(width, height),
        formation,
        network: None,
    };
    let (shown, clear) = (of("in.image"), of("in.clear"));
    let (depth, accumulation) = (map_of("in.depth"), map_of("in.accumulation"));
    let target = Target { image: of("in.target"), ..Target::default() };
    let intrinsics = Intrinsics { width, height, fx: 9.0, fy: 9.0, cx: 5.0, cy: 4.0 };
    let pose = Pose { rotation: glam::DMat3::IDENTITY, translation: glam::DVec3::ZERO };
    let seen = Observation {
        step: 0,
        camera: &Camera { intrinsics, pose },
        image: &shown,
        clear: Some(&clear),
        depth: &depth,
        accumulation: &accumulation,
        water: Some(&water),
        target: &target,
        gaussians: &Gaussians::empty(0),
        prepared: &Prepared::new(),
    };
    let mut losses = Losses::new(&[row]);
    for (i, output) in outputs.iter().enumerate() {
        let d_output = case.f64(&format!("cot.{output}"))[0];
        let mut weights = vec![0.0; outputs.len()];
        weights[i] = d_output;
        let loss = losses.evaluate(&seen, &weights);
        case.check_f64(&format!("out.{output}"), &[loss.values[i].unwrap()]);
        let gradients = &losses.gradients;
        for name in case.grads() {
            let found = match name.as_str() {
                "image" => gradients.image.get().unwrap().data(),
                "clear" => gradients.clear.get().unwrap().data(),
                "depth" => gradients.depth.get().unwrap().data(),
                "c_m" => gradients.water_color.get().unwrap().data(),
                "beta_bs" => gradients.backscatter.get().unwrap().data(),
                _ => gradients.accumulation.get().unwrap().data(),
            };
            case.check_planes(&format!("grad.{output}.{name}"), found);
        }
        // Nothing but these has a gradient.
        assert!(gradients.attenuation.get().is_none());
        assert_eq!(gradients.depth.get().is_some(), case.grads() == ["depth"]);
        assert_eq!(gradients.image.get().is_some(), case.grads() == ["image"]);
    }
}

#[test]
fn golden_seasplat() {
    let part = Part::math("seasplat");
    let mut seen = 0;
    for case in part.cases() {
        let (row, outputs): (LossTerm, &[&str]) = match case.name() {
            "far_l1" => (far::TERM, &["far_l1"]),
            "smoothness" => (smoothness::NORMALISED, &["smoothness"]),
            "backscatter" => (backscatter::TERM, &["backscatter"]),
            "clear_colors" => (clear_colors::TERM, &["saturation", "grey_world"]),
            "background" | "background_before" => (background::TERM, &["background"]),
            _ => continue,
        };
        golden_prior(&case, row, outputs);
        seen += 1;
    }
    assert_eq!(seen, 6);
}

#[test]
fn priors_on_water_begin_with_it_and_the_clear_image_is_made_for_those_that_read_it() {
    let priors = Priors { far: 1.0, backscatter: 1.0, saturation: 2.0, grey_world: 0.1, background: 0.01 };
    let turns = Turns { from: 0.5, water: 10, ..Turns::default() };
    let params = ReconstructParams { iterations: 100, priors, turns, ..ReconstructParams::default() };
    let named = |params: &ReconstructParams, step| -> Vec<(&str, f64)> {
        names().zip(super::weights(params, step)).skip(OWN_VALUES).filter(|(_, w)| *w > 0.0).collect()
    };
    assert_eq!(named(&params, 49), [("far_l1", 1.0), ("background_prior", 0.01)]);
    let all = [
        ("far_l1", 1.0),
        ("backscatter_prior", 1.0),
        ("saturation_prior", 2.0),
        ("grey_world_prior", 0.1),
        ("background_prior", 0.01),
    ];
    assert_eq!(named(&params, 50), all);
    let losses = Losses::new(TERMS);
    let read = |params: &ReconstructParams, step| losses.read_clear(&super::weights(params, step));
    assert_eq!((read(&params, 49), read(&params, 50)), (false, true));
    assert!(!read(&ReconstructParams::default(), 50));
}

#[test]
fn golden_smoothness() {
    let part = Part::math("marinestd");
    for (name, by_prior) in [("smoothness", false), ("adaptive_smoothness", true)] {
        let case = part.cases().into_iter().find(|case| case.name() == name).unwrap();
        let (depth, photograph) = (map(&case, "in.depth"), image(&case, "in.target"));
        let (prior, term) =
            (map(&case, "in.prior"), smoothness::DepthSmoothness { by_prior, normalised: false });
        let (mut gradient, d_output) = (Map::new(1, 1), case.f64("cot.smoothness")[0]);
        let value = term.evaluate(&depth, &photograph, Some(&prior), d_output, &mut gradient);
        case.check_f64("out.smoothness", &[value]);
        case.check_planes("grad.smoothness.depth", gradient.data());
        // Differences, where no pair is near the kink.
        let mut moved = depth.clone();
        let apart = |a: usize, b: usize| (depth.data()[a] - depth.data()[b]).abs() > 1e-3;
        let w = depth.width();
        let smooth = |at: usize| [at - 1, at + 1, at - w, at + w].into_iter().all(|other| apart(at, other));
        let inside = (w + 1..depth.pixels() - w - 1).step_by(7);
        for at in inside.filter(|at| depth.data()[*at] > 0.0 && smooth(*at)) {
            let mut value = |by: f32| {
                moved.data_mut()[at] = depth.data()[at] + by;
                term.evaluate(&moved, &photograph, Some(&prior), 1.0, &mut Map::new(1, 1))
            };
            let numeric = d_output * (value(1e-4) - value(-1e-4)) / 2e-4;
            moved.data_mut()[at] = depth.data()[at];
            let expected = f64::from(gradient.data()[at]);
            assert!((numeric - expected).abs() < 1e-2 * expected.abs() + 1e-6, "{at}: {numeric} {expected}");
        }
    }
}

#[test]
fn smoothness_waits_after_a_ceiling_and_has_one_kind_of_edges() {
    let mut params = ReconstructParams { iterations: 15_000, smoothness_weight: 0.01, ..Default::default() };
    let of = |params: &ReconstructParams, name: &str, step: u64| {
        names().zip(super::weights(params, step)).find(|(other, _)| *other == name).unwrap().1
    };
    assert_eq!(of(&params, "depth_smoothness", 0), 0.01);
    assert_eq!(of(&params, "adaptive_smoothness", 0), 0.0);
    params.smoothness_normalised = true;
    assert_eq!((of(&params, "depth_smoothness", 0), of(&params, "normalised_smoothness", 0)), (0.0, 0.01));
    params.smoothness_normalised = false;
    (params.smoothness_by_prior, params.smoothness_pause) = (true, 100);
    let ceiling = (1000..2000).find(|step| params.density_work(*step, 9).ceiling.is_some()).unwrap();
    let at = |step| of(&params, "adaptive_smoothness", step);
    assert_eq!([0, 1, 100, 101].map(|after| at(ceiling + after)), [0.01, 0.0, 0.0, 0.01]);
    assert_eq!(of(&params, "depth_smoothness", ceiling), 0.0);
}

#[test]
fn only_the_chosen_comparison_has_weights_and_the_ranking_ends_with_growth() {
    let named = |params: &ReconstructParams, step: u64| -> Vec<&str> {
        names().zip(super::weights(params, step)).filter(|(_, w)| *w > 0.0).map(|(name, _)| name).collect()
    };
    let mut params = ReconstructParams { ranking_weight: 5.0, ..ReconstructParams::default() };
    assert_eq!(named(&params, 0), ["reg_l1", "reg_ms_ssim", "depth_loss", "depth_ranking"]);
    assert_eq!(named(&params, params.densify_end()), ["reg_l1", "reg_ms_ssim", "depth_loss"]);
    (params.depth_prior, params.photometric) = (DepthPrior::Off, Photometric::RegSsim);
    assert_eq!(named(&params, 0), ["relative_l1", "relative_ssim"]);
    params.plain_until = 0.1;
    assert_eq!(named(&params, params.course() / 10 - 1), ["plain_l1", "plain_ssim"]);
    assert_eq!(named(&params, params.course() / 10), ["relative_l1", "relative_ssim"]);
    (params.photometric, params.plain_until) = (Photometric::Ssim, 0.0);
    assert_eq!(named(&params, 0), ["plain_l1", "plain_ssim"]);
}

fn random_image(stream: &Stream, w: usize, h: usize, from: u64) -> Image {
    let values = (0..3 * w * h).map(|i| 0.1 + 0.8 * stream.uniform(from + i as u64) as f32).collect();
    Image::from_planes(w, h, values).unwrap()
}

/// The loss with the weight held at `held`, in f64 and by the definition up to MS-SSIM, which has its own
/// test.
fn held(prediction: &Image, held: &Image, target: &Image, mask: &Map) -> f64 {
    let n = mask.pixels();
    let weight = |i: usize| 1.0 / (f64::from(held.data()[i] * mask.data()[i % n]) + 1e-3);
    let weighted = |image: &Image| {
        let values =
            (0..3 * n).map(|i| (weight(i) * f64::from(image.data()[i] * mask.data()[i % n]) - 1.0) as f32);
        Image::from_planes(image.width(), image.height(), values.collect()).unwrap()
    };
    let (x, y) = (weighted(prediction), weighted(target));
    let absolute: f64 =
        x.data().iter().zip(y.data()).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / (3 * n) as f64;
    let mut scratch = Image::new(1, 1);
    let similarity = use3d_metrics::ms_ssim::MsSsim::default().value_and_gradient(
        &x,
        &y,
        1.0,
        &use3d_metrics::ms_ssim::RECONSTRUCTION_WEIGHTS,
        &mut scratch,
    );
    0.8 * absolute + 0.2 * (1.0 - similarity)
}

#[test]
fn the_photometric_gradient_agrees_with_finite_differences_under_a_mask() {
    for seed in 0..3 {
        let (w, h) = (33 + seed as usize, 29);
        let stream = Stream::new(seed, Purpose::new("photometric probes"), 0);
        let prediction = random_image(&stream, w, h, 0);
        let noise = random_image(&stream, w, h, 50_000);
        // The target is never nearer to the prediction than the step of a difference, so that no pixel
        // crosses the kink of |Î − I|.
        let factor = |n: &f32| if *n < 0.5 { 0.95 - 0.1 * n } else { 1.05 + 0.1 * n };
        let values = prediction.data().iter().zip(noise.data()).map(|(p, n)| p * factor(n)).collect();
        let target = Image::from_planes(w, h, values).unwrap();
        let mask_values = (0..w * h).map(|i| if i % w < 8 { 0.0 } else { 1.0 }).collect();
        let mask = Map::from_planes(w, h, mask_values).unwrap();
        let mut gradient = Image::new(1, 1);
        let value = PhotometricLoss::new(0.2).evaluate(&prediction, &target, Some(&mask), &mut gradient);
        assert!((value.total - held(&prediction, &prediction, &target, &mask)).abs() < 1e-5);
        // The error that training reports equals the score of a finished scene.
        let shown = target.map(|v| v.clamp(0.0, 1.0));
        let told =
            PhotometricLoss::new(0.2).evaluate(&prediction, &shown, Some(&mask), &mut Image::new(1, 1));
        let told = decibels(told.squared_error).unwrap();
        let scored = psnr(&prediction, &shown, Some(&mask_of(&mask))).unwrap();
        assert!((told - scored).abs() < 4e-5, "{told} {scored}");
        let norm = gradient.data().iter().map(|&g| math::powi(f64::from(g), 2)).sum::<f64>().sqrt();
        for probe in 0..6u64 {
            let direction: Vec<f32> =
                (0..3 * w * h).map(|i| stream.normal(900_000 + probe * 50_000 + i as u64) as f32).collect();
            let moved = |by: f32| {
                let values =
                    prediction.data().iter().zip(&direction).map(|(p, d)| p + by * d.clamp(-2.0, 2.0));
                let image = Image::from_planes(w, h, values.collect()).unwrap();
                held(&image, &prediction, &target, &mask)
            };
            let numeric = (moved(1e-3) - moved(-1e-3)) / 2e-3;
            let expected: f64 =
                gradient.data().iter().zip(&direction).map(|(&g, d)| f64::from(g * d.clamp(-2.0, 2.0))).sum();
            assert!((numeric - expected).abs() < 2e-2 * norm, "{numeric} against {expected}, norm {norm}");
        }
        for (i, &g) in gradient.data().iter().enumerate() {
            assert!(i % w >= 8 || g == 0.0, "a masked pixel has a gradient");
        }
    }
}

#[test]
fn the_depth_gradient_agrees_with_finite_differences() {
    for seed in 0..3 {
        let (w, h) = (23, 17);
        let stream = Stream::new(seed, Purpose::new("depth probes"), 0);
        let depth: Vec<f32> = (0..w * h).map(|i| 0.2 + 2.0 * stream.uniform(i as u64) as f32).collect();
        let prior: Vec<f32> =
            (0..w * h)
                .map(|i| {
                    if i % 7 == 0 {
                        0.0
                    } else {
                        1.0 / depth[i] + 0.3 * stream.uniform(9000 + i as u64) as f32
                    }
                })
                .collect();
        let (mut depth, prior) =
            (Map::from_planes(w, h, depth).unwrap(), Map::from_planes(w, h, prior).unwrap());
        let (mut gradient, mut scratch) = (Map::new(1, 1), Map::new(1, 1));
        DepthPriorLoss.evaluate(&depth, &prior, 1.0, &mut gradient);
        let scale = gradient.data().iter().fold(0.0f32, |m, g| m.max(g.abs()));
        for at in (0..w * h).step_by(11) {
            let mut moved = |by: f32| {
                depth.data_mut()[at] += by;
                let value = DepthPriorLoss.evaluate(&depth, &prior, 1.0, &mut scratch);
                depth.data_mut()[at] -= by;
                value
            };
            let numeric = (moved(1e-3) - moved(-1e-3)) / 2e-3;
            assert!((numeric - f64::from(gradient.data()[at])).abs() < 1e-2 * f64::from(scale));
        }
    }
}

#[test]
fn worthless_priors_give_no_gradient_and_no_nan() {
    let depth = Map::from_planes(8, 8, (0..64).map(|i| i as f32 * 0.1).collect()).unwrap();
    let mut gradient = Map::new(1, 1);
    for value in [0.5, 0.0, f32::NAN, f32::INFINITY, -1.0] {
        let loss = DepthPriorLoss.evaluate(&depth, &Map::filled(8, 8, value), 0.1, &mut gradient);
        assert!(loss.is_finite() && (0.0..=1.0).contains(&loss));
        assert!(gradient.data().iter().all(|g| g.abs() < 1e-6), "prior {value}");
    }
    let loss = DepthPriorLoss.evaluate(&Map::filled(8, 8, f32::NAN), &depth, 0.1, &mut gradient);
    assert!(loss == 0.0 && gradient.data().iter().all(|&g| g == 0.0));
}

mod uir;
