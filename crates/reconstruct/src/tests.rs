//! Tests of stage 1 as a whole: one golden step, and short runs on a tiny scene.

mod colors;
mod resume;
mod seasplat;
mod terms;
mod water;

use std::path::{Path, PathBuf};

use glam::DVec3;
use use3d_capture::{
    Camera, Capture, Frame, Image, Intrinsics, Lattice, Map, MediumMaps, Pixels, Pose, SparsePoint, Split,
    View,
};
use use3d_golden::{CaseGaussians, Part};
use use3d_medium::{MediumModel, MediumRbf};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{Colors, Gaussians, Options, Prepared, Rasterizer, Rendered};
use use3d_training::{Observer, Silent, TrainingProgress};

use crate::engine::{CpuEngine, Degrees, Engine, Moves, StepPlan, StepRates, TrainingState};
use crate::losses::{LossTerm, LossValue, Observation, Term, ViewGradients};
use crate::{
    DepthPrior, Exposure, FoundWater, Images, Known, LoadedView, LogEntry, Medium, MediumPrior,
    ReconstructError, ReconstructOutcome, ReconstructParams, TrainingView, ViewLoader, losses,
};

/// Reconstructs on the processor.
fn reconstruct(
    capture: &Capture,
    loader: &ViewLoader<'_>,
    params: &ReconstructParams,
    checkpoints: Option<&Path>,
    observer: &mut dyn Observer,
) -> Result<ReconstructOutcome, ReconstructError> {
    reconstruct_in(capture, &Known::default(), loader, params, checkpoints, observer)
}

/// Reconstructs on the processor with prior knowledge.
fn reconstruct_in(
    capture: &Capture,
    known: &Known,
    loader: &ViewLoader<'_>,
    params: &ReconstructParams,
    checkpoints: Option<&Path>,
    observer: &mut dyn Observer,
) -> Result<ReconstructOutcome, ReconstructError> {
    crate::reconstruct(capture, known, loader, params, &mut CpuEngine::default(), checkpoints, observer)
}

const NO_RATES: StepRates = StepRates {
    means: 0.0,
    sh_constant: 0.0,
    sh_directional: 0.0,
    opacity: 0.0,
    scales: 0.0,
    quaternions: 0.0,
    medium_constant: 0.0,
    medium_directional: 0.0,
    medium_network: 0.0,
};

fn view_named(name: &str, camera: Camera) -> View {
    let name = use3d_capture::FileName::new(name).expect("a name");
    View { name, id: 0, image: PathBuf::new(), mask: None, depth_prior: None, camera }
}

#[test]
fn golden_stage1_step() {
    let part = Part::math("losses");
    let mut seen = 0;
    for case in part.cases() {
        if !case.has("in.means") {
            continue;
        }
        seen += 1;
        let camera = case.camera();
        let CaseGaussians { means, log_scales, quaternions, opacity_logits, sh } = case.gaussians();
        let sh_degree = case.count("sh_degree");
        let gaussians = Gaussians { sh_degree, means, log_scales, quaternions, opacity_logits, sh };
        let coefficients = case.f32("in.coeffs");
        let water = MediumRbf {
            centers: case.rows("in.centers"),
            log_widths: case.f32("in.log_widths"),
            coefficients: bytemuck::cast_slice(&coefficients).to_vec(),
            top_k: case.count("top_k"),
        };
        let mut engine = CpuEngine::default();
        let (w, h, target) = case.planes("in.target");
        let (_, _, prior) = case.planes("in.prior");
        let view = TrainingView::exact(
            camera,
            use3d_capture::Image::from_planes(w, h, target).unwrap(),
            use3d_capture::Map::from_planes(w, h, prior).unwrap(),
        );
        let view = engine.upload(view).unwrap();
        engine.load(TrainingState::new(gaussians, MediumModel::Rbf(water), &[])).unwrap();
        let degree = case.count("medium_degree");
        let params = ReconstructParams {
            structure_weight: case.number("lam"),
            depth_weight: case.number("lam_d"),
            ..ReconstructParams::default()
        };
        let degrees = Degrees { colors: degree, water: degree };
        let settings = StepPlan { degrees, ..still(losses::weights(&params, 0)) };
        let loss = engine.differentiate(view, &settings).unwrap();
        case.check_planes("out.rgb", engine.rendered().image.data());
        case.check_planes("out.depth", engine.rendered().depth.data());
        for (name, value) in losses::names().zip(&loss.values).take(losses::OWN_VALUES) {
            case.check_f64(&format!("out.{name}"), &[value.unwrap()]);
        }
        case.check_f64("out.total", &[loss.total]);
        let d_output = case.f64("cot.total")[0];
        let (g, water) = engine.gradients();
        let MediumModel::Rbf(water) = water else { panic!("the water is an RBF") };
        let check = |name: &str, values: &[f32]| {
            let scaled: Vec<f64> = values.iter().map(|&v| f64::from(v) * d_output).collect();
            case.check_f64(&format!("grad.total.{name}"), &scaled);
        };
        check("means", g.means.as_flattened());
        check("log_scales", g.log_scales.as_flattened());
        check("quats", g.quaternions.as_flattened());
        check("opacity_logits", &g.opacity_logits);
        check("sh", g.sh.as_flattened().as_flattened());
        check("centers", water.centers.as_flattened());
        check("log_widths", &water.log_widths);
        check("coeffs", bytemuck::cast_slice(&water.coefficients));
    }
    assert!(seen > 0, "no whole step among the cases");
}

/// A tiny reef with known truth: a wall of Gaussians in blue water, seen by a row of cameras.
fn tiny_capture(views: usize) -> (Capture, Vec<LoadedView>) {
    let stream = Stream::new(11, Purpose::new("tiny reef"), 0);
    let n = 260;
    let mut truth = Gaussians::empty(0);
    let mut points = Vec::new();
    for i in 0..n as u64 {
        let u = |k: u64| stream.uniform(10 * i + k);
        let position = [2.4 * u(0) - 1.2, 1.8 * u(1) - 0.9, 1.5 + 0.8 * u(2)];
        let color = [0.2 + 0.7 * u(3), 0.2 + 0.6 * u(4), 0.2 + 0.6 * u(5)];
        truth.means.push(position.map(|v| v as f32));
        truth.log_scales.push([0; 3].map(|_: i32| math::ln(0.09f64 + 0.05 * u(6)) as f32));
        truth.quaternions.push([1.0, 0.0, 0.0, 0.0]);
        truth.opacity_logits.push(2.5);
        let mut sh = [[0.0; 3]; 16];
        sh[0] = color.map(|c| ((c - 0.5) / 0.282_094_79) as f32);
        truth.sh.push(sh);
        points.push(SparsePoint {
            position: DVec3::from(position) + 0.01 * DVec3::new(u(7) - 0.5, u(8) - 0.5, u(9) - 0.5),
            color: color.map(|c| (c * 255.0) as u8),
            error: 0.5,
            track_length: 3,
        });
    }
    let mut water = MediumRbf::new(8, 4);
    for a in &mut water.coefficients {
        a[0][0] = [-1.4, -0.6, 0.2];
        a[1][0] = [-2.0, -1.5, -1.0];
        a[2][0] = [1.0, -1.5, -3.0];
    }
    let water = MediumModel::Rbf(water);
    let intrinsics = Intrinsics { width: 56, height: 44, fx: 50.0, fy: 50.0, cx: 28.0, cy: 22.0 };
    let (mut rasterizer, mut prepared) = (Rasterizer::new(), Prepared::new());
    let (mut maps, mut rendered) = (MediumMaps::zeros(0, 0), Rendered::new());
    let mut loaded = Vec::new();
    let views: Vec<View> = (0..views)
        .map(|i| {
            let t = i as f64 / views.max(2) as f64 - 0.5;
            let eye = DVec3::new(1.2 * t, 0.3 * math::sin(7.0 * t), -0.2 * t);
            let camera =
                Camera { intrinsics, pose: Pose::look_at(eye, DVec3::new(0.2 * t, 0.0, 2.0), -DVec3::Y) };
            let lattice = Lattice::full(&intrinsics);
            water.maps(&camera, &lattice, 3, &mut maps);
            prepared.prepare(&truth, &camera, &lattice, Colors::Sh { degree: 0 });
            rasterizer.forward(&prepared, Some(&maps), &Options::default(), &mut rendered);
            let prior = rendered.depth.map(|d| if d > 0.0 { 1.0 / d } else { 0.0 });
            loaded.push(LoadedView {
                pixels: Pixels::Eight(rendered.image.to_8bit()),
                mask: None,
                depth_prior: Some(prior),
            });
            view_named(&format!("{i:03}.png"), camera)
        })
        .collect();
    let split = Split::every(views.len(), 5);
    (Capture { name: "tiny".into(), views, split, points, frame: Frame::IDENTITY }, loaded)
}

/// Gaussians at the first points of a capture.
fn few_gaussians(capture: &Capture, count: usize) -> Gaussians {
    let mut gaussians = Gaussians::empty(0);
    for (i, point) in capture.points.iter().take(count).enumerate() {
        gaussians.means.push(point.position.to_array().map(|v| v as f32));
        gaussians.log_scales.push([-1.8, -2.0, -1.9]);
        gaussians.quaternions.push([1.0, 0.1, 0.0, 0.2]);
        gaussians.opacity_logits.push(-0.5 + 0.03 * i as f32);
        let mut sh = [[0.0; 3]; 16];
        sh[0] = [0.4, 0.2, -0.1];
        gaussians.sh.push(sh);
    }
    gaussians
}

/// A step at full size in which nothing moves.
fn still(weights: Vec<f64>) -> StepPlan {
    StepPlan {
        step: 0,
        moves: Moves::All,
        water_updates: 0,
        divisor: 1,
        degrees: Degrees { colors: 0, water: 0 },
        rates: NO_RATES,
        weights,
        depth_gradient: true,
        network_clip: 0.0,
        exposure: None,
        colors: None,
        gather: None,
    }
}

fn loader(
    loaded: &[LoadedView],
) -> impl Fn(&View) -> Result<LoadedView, Box<dyn std::error::Error + Send + Sync>> + Sync + '_ {
    |view| {
        let index: usize = view.name[..3].parse()?;
        Ok(loaded[index].clone())
    }
}

fn tiny_params(iterations: u64) -> ReconstructParams {
    let mut params = ReconstructParams { iterations, log_every: 10, ..ReconstructParams::default() };
    params.resolution_schedule = vec![(0.0, 2), (0.3, 1)];
    params.densify.statistics_from = 0;
    params.densify.warm_up = iterations / 3;
    params.densify.gentle_below = 0;
    params.densify.every = 5;
    params.densify.period = 25;
    params.densify.pause = 10;
    params.densify.cull_opacity = 0.05;
    params.densify.gradient_threshold = 2e-4;
    params.densify.reference_pixels = 0;
    params
}

/// An observer that stops after some steps and stores its messages.
#[derive(Default)]
struct StoppingObserver {
    stop_at: Option<u64>,
    panic_at: Option<u64>,
    step: u64,
    notices: Vec<String>,
}

impl Observer for StoppingObserver {
    fn progress(&mut self, progress: &TrainingProgress) {
        self.step = progress.step;
        assert!(self.panic_at != Some(self.step), "killed");
    }

    fn notice(&mut self, message: &str) {
        self.notices.push(message.into());
    }

    fn should_stop(&self) -> bool {
        self.stop_at == Some(self.step)
    }
}

fn same(a: &ReconstructOutcome, b: &ReconstructOutcome) -> bool {
    a.scene == b.scene && a.log == b.log && a.evaluation == b.evaluation
}

#[test]
fn views_of_which_nothing_counts_are_said_and_have_no_score() {
    let (capture, mut loaded) = tiny_capture(10);
    let params = tiny_params(2);
    let black = |view: &mut LoadedView| {
        let (w, h) = view.pixels.size();
        view.mask = Some(Map::filled(w, h, f32::NAN));
    };
    let (first, held_out) = (capture.split.train[0], capture.split.test[0]);
    black(&mut loaded[first]);
    black(&mut loaded[held_out]);
    let mut heard = StoppingObserver::default();
    let outcome = reconstruct(&capture, &loader(&loaded), &params, None, &mut heard).unwrap();
    assert_eq!(
        heard.notices.iter().filter(|n| n.contains("leaves no pixel")).count(),
        2,
        "{:?}",
        heard.notices
    );
    let evaluation = outcome.evaluation.unwrap();
    assert!(evaluation.views[0].psnr.reason().unwrap().contains("leaves no pixel"));
    let counted = evaluation.views.iter().map(|v| v.pixels).collect::<Vec<_>>();
    assert_eq!((evaluation.pixels, counted), (0.5, vec![0.0, 1.0]));
    assert_eq!(evaluation.psnr, evaluation.views[1].psnr, "the mean is over the views that have a score");
    loaded.iter_mut().for_each(black);
    let error = reconstruct(&capture, &loader(&loaded), &params, None, &mut Silent).unwrap_err().to_string();
    assert!(error.contains("white where pixels count"), "{error}");
}

#[test]
fn a_short_run_learns_the_scene_and_its_water() {
    let (capture, loaded) = tiny_capture(10);
    let run = |medium, iterations| {
        let mut params = ReconstructParams { medium, ..tiny_params(iterations) };
        // With so few steps, even ten times the method's rate would leave the water near its start.
        params.learning_rates.medium_constant = crate::Rate(0.01, 0.002);
        reconstruct(&capture, &loader(&loaded), &params, None, &mut Silent).unwrap()
    };
    let (wet, dry) = (run(Medium::Rbf, 160), run(Medium::None, 160));
    let psnr = |o: &ReconstructOutcome| o.evaluation.as_ref().unwrap().psnr.value().unwrap();
    assert!(psnr(&wet) > 18.5, "held-out PSNR {:.2} dB", psnr(&wet));
    assert!(psnr(&wet) > psnr(&dry) + 0.5, "with water {:.2} dB, without {:.2} dB", psnr(&wet), psnr(&dry));
    assert!(wet.log.iter().any(|e| matches!(e, LogEntry::Refine { split, .. } if *split > 0)));
    assert!(wet.log.iter().any(|e| matches!(e, LogEntry::Ceiling { .. })));
    assert_eq!(wet.evaluation.as_ref().unwrap().views.len(), 2);
    wet.scene.gaussians.validate().unwrap();
    assert!(wet.log_lines().lines().count() == wet.log.len());
    for medium in [Medium::Global, Medium::Image, Medium::Mlp] {
        let other = run(medium, 40);
        let first = |o: &ReconstructOutcome| {
            o.log.iter().find_map(|e| if let LogEntry::Steps { psnr, .. } = e { *psnr } else { None })
        };
        assert!(psnr(&other) > first(&other).unwrap() + 1.0, "{medium:?}: {:.2} dB", psnr(&other));
    }
}

#[test]
fn the_growth_of_a_step_is_told_beside_its_pairs() {
    let (capture, loaded) = tiny_capture(6);
    let mut params = tiny_params(44);
    params.densify.enabled = false;
    let outcome = reconstruct(&capture, &loader(&loaded), &params, None, &mut Silent).unwrap();
    assert_eq!(outcome.growth.iter().map(|s| (s.step, s.steps)).collect::<Vec<_>>(), {
        // The last stretch is the remainder.
        (1..=14).map(|k| (3 * k, 3)).chain([(44, 2)]).collect::<Vec<_>>()
    });
    let spent: std::time::Duration = outcome.growth.iter().map(|s| s.spent).sum();
    // Three steps may take less than the clock's resolution; all of them together do not.
    assert!(spent <= outcome.profile.spent() && !spent.is_zero());
    // Every fourth pixel in both directions represents all pixels of the view, for any view.
    let pairs = capture.training_views().map(|view| {
        let lattice = use3d_capture::Lattice::full(&view.camera.intrinsics);
        let mut prepared = use3d_splat::Prepared::new();
        let colors = use3d_splat::Colors::Sh { degree: 0 };
        prepared.prepare(&outcome.scene.gaussians, &view.camera, &lattice, colors);
        1e-6 * prepared.pairs().contributing as f64
    });
    let (least, most) = pairs.fold((f64::INFINITY, 0.0f64), |(l, m), p| (l.min(p), m.max(p)));
    let last = outcome.growth.last().unwrap();
    assert!(0.9 * least < last.pairs && last.pairs < 1.1 * most, "{} of {least} to {most}", last.pairs);
    assert_eq!(crate::growth(&outcome.growth).lines().count(), 16);
}

#[test]
fn bad_captures_get_a_clear_word() {
    let (capture, loaded) = tiny_capture(6);
    let params = tiny_params(2);
    let run = |capture: &Capture, params: &ReconstructParams| {
        let mut watcher = StoppingObserver::default();
        let result = reconstruct(capture, &loader(&loaded), params, None, &mut watcher);
        (result.map_err(|e| e.to_string()), watcher.notices)
    };
    let error = |capture: &Capture| run(capture, &params).0.unwrap_err();

    let nothing = Capture { views: Vec::new(), split: Split::default(), ..capture.clone() };
    assert!(error(&nothing).contains("no views"));
    let held_out = Capture { split: Split::every(6, 1), ..capture.clone() };
    assert!(error(&held_out).contains("all 6 views are in the test split"));
    let one = Capture { split: Split { train: vec![2], test: vec![] }, ..capture.clone() };
    assert!(error(&one).contains("only one training view (`002.png`)"));
    let mut behind = capture.clone();
    behind.points.iter_mut().for_each(|p| p.position.z = -9.0);
    assert!(error(&behind).contains("in front of any"));
    let mut wrong_size = capture.clone();
    wrong_size.views[3].camera.intrinsics.width = 57;
    assert!(error(&wrong_size).contains("`003.png`: its image is 56x44 pixels, its camera 57x44"));
    let wrong = ReconstructParams { top_k: 0, ..params.clone() };
    assert!(run(&capture, &wrong).0.unwrap_err().contains("top_k"));

    let few = Capture { points: capture.points[..9].to_vec(), ..capture.clone() };
    let (result, notices) = run(&few, &ReconstructParams { random_points: 300, ..params.clone() });
    assert_eq!(result.unwrap().initial_gaussians, 309);
    assert!(notices.iter().any(|n| n.contains("only 9 sparse points")), "{notices:?}");
    let none = Capture { points: Vec::new(), ..capture.clone() };
    assert_eq!(
        run(&none, &ReconstructParams { random_points: 250, ..params.clone() }).0.unwrap().initial_gaussians,
        250
    );

    let mut bad_priors = loaded.clone();
    bad_priors[1].depth_prior = Some(use3d_capture::Map::filled(56, 44, 0.3));
    bad_priors[2].depth_prior = Some(use3d_capture::Map::filled(56, 44, f32::NAN));
    let mut watcher = StoppingObserver::default();
    reconstruct(&capture, &loader(&bad_priors), &params, None, &mut watcher).unwrap();
    for part in [
        "`001.png`: its depth prior is the same everywhere",
        "`002.png`: its depth prior has no finite",
        "only 2 of 4",
    ] {
        assert!(watcher.notices.iter().any(|n| n.contains(part)), "{part}: {:?}", watcher.notices);
    }
}

#[test]
fn a_run_that_diverges_says_where_and_keeps_the_last_checkpoint() {
    let (capture, loaded) = tiny_capture(5);
    let dir = tempfile::tempdir().unwrap();
    let mut params = ReconstructParams { checkpoint_steps: 1, ..tiny_params(30) };
    // The rate exceeds the range of f32 about two thirds of the way.
    params.learning_rates.means = crate::Rate(1e-4, 1e60);
    let result = reconstruct(&capture, &loader(&loaded), &params, Some(dir.path()), &mut Silent);
    let Err(ReconstructError::NonFinite(found)) = result.map(|_| ()) else { panic!("the run goes on") };
    assert!(found.step > 1 && found.view.ends_with(".png") && found.what == "means", "{found}");
    assert!(found.index.is_some(), "{found}");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
}

#[test]
fn the_cap_bites_with_a_word_and_masks_hide_pixels() {
    let (capture, mut loaded) = tiny_capture(6);
    let params = ReconstructParams { max_gaussians: 270, ..tiny_params(60) };
    let mut watcher = StoppingObserver::default();
    let outcome = reconstruct(&capture, &loader(&loaded), &params, None, &mut watcher).unwrap();
    assert!(outcome.scene.gaussians.len() <= 270);
    assert!(watcher.notices.iter().any(|n| n.contains("max_gaussians")), "{:?}", watcher.notices);

    // The limit also applies to the first Gaussians, and the same ones stay.
    let params = ReconstructParams { max_gaussians: 40, ..tiny_params(10) };
    let first = |params: &ReconstructParams| {
        let mut watcher = StoppingObserver::default();
        let outcome = reconstruct(&capture, &loader(&loaded), params, None, &mut watcher).unwrap();
        assert!(
            watcher.notices.iter().any(|n| n.contains("40 of 260 sparse points")),
            "{:?}",
            watcher.notices
        );
        assert_eq!(outcome.initial_gaussians, 40);
        outcome.scene
    };
    assert!(first(&params) == first(&params));
    assert!(first(&params).gaussians.len() <= 40);

    // The pixels under the mask do not affect the scene.
    let half = |x: usize| if x < 28 { 0.0 } else { 1.0 };
    let mask = (0..56 * 44).map(|p| half(p % 56)).collect();
    let mask = use3d_capture::Map::from_planes(56, 44, mask).unwrap();
    for view in &mut loaded {
        view.mask = Some(mask.clone());
        view.depth_prior = None;
    }
    let mut scribbled = loaded.clone();
    for view in &mut scribbled {
        let Pixels::Eight(pixels) = &mut view.pixels else { panic!("8-bit pixels") };
        for y in 0..44 {
            for x in 0..28 {
                pixels.set_pixel(x, y, [255, 0, 255]);
            }
        }
    }
    let params = ReconstructParams { depth_prior: DepthPrior::Off, ..tiny_params(12) };
    let clean = reconstruct(&capture, &loader(&loaded), &params, None, &mut Silent).unwrap();
    let masked = reconstruct(&capture, &loader(&scribbled), &params, None, &mut Silent).unwrap();
    assert!(clean.scene == masked.scene);
}
