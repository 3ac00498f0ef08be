//! Water that is known before training, and views that differ in exposure.

use super::*;

/// The water of the tiny reef itself.
fn true_water(points: usize) -> FoundWater {
    let c0 = f64::from(use3d_numerics::spherical_harmonics::C0);
    let soft = |x: f64| math::ln_1p(math::exp(c0 * x));
    FoundWater {
        veil: [-1.4, -0.6, 0.2].map(|x| c0 * x + 0.5),
        veil_slope: [[0.0; 3]; 3],
        backscatter: [-2.0, -1.5, -1.0].map(soft),
        attenuation: [1.0, -1.5, -3.0].map(soft),
        radiances: vec![None; points],
    }
}

fn known(found: Option<&FoundWater>) -> Known {
    Known { water: found.cloned(), ..Known::default() }
}

/// The tiny reef taken by a camera that exposes every view separately, and the gains.
fn unevenly_exposed(views: usize) -> (Capture, Vec<LoadedView>, Vec<[f64; 3]>) {
    let (capture, mut loaded) = tiny_capture(views);
    let stream = Stream::new(3, Purpose::new("tiny exposures"), 0);
    let gain = |view: usize| {
        let n = |k: u64| stream.normal(10 * view as u64 + k);
        [0, 1, 2].map(|c| math::exp(0.12 * n(0) + 0.05 * n(1 + c)))
    };
    let gains: Vec<[f64; 3]> = (0..views).map(gain).collect();
    for (view, gain) in loaded.iter_mut().zip(&gains) {
        let mut image = view.pixels.to_image();
        for c in 0..3 {
            image.plane_mut(c).iter_mut().for_each(|v| *v *= 0.7 * gain[c] as f32);
        }
        view.pixels = Pixels::Eight(image.to_8bit());
    }
    (capture, loaded, gains)
}

#[test]
fn a_camera_that_exposes_each_view_on_its_own_is_seen_through() {
    let (capture, loaded, gains) = unevenly_exposed(10);
    let run = |exposure: Exposure, known: &Known, steps: u64, stop: Option<u64>, dir: Option<&Path>| {
        let params = ReconstructParams { exposure, ..tiny_params(steps) };
        let mut watcher = StoppingObserver { stop_at: stop, ..StoppingObserver::default() };
        reconstruct_in(&capture, known, &loader(&loaded), &params, dir, &mut watcher)
    };
    let nothing = Known::default();
    let learnt = run(Exposure::PerView, &nothing, 400, None, None).unwrap();
    // Gains are determined only up to a factor that all views share.
    let log = |rows: &[[f64; 3]], c: usize| -> Vec<f64> {
        let logs: Vec<f64> = rows.iter().map(|g| math::ln(g[c])).collect();
        let mean = logs.iter().sum::<f64>() / logs.len() as f64;
        logs.iter().map(|g| g - mean).collect()
    };
    let truth: Vec<[f64; 3]> = capture.split.train.iter().map(|v| gains[*v]).collect();
    let found: Vec<[f64; 3]> = learnt.exposures.iter().map(|(_, g)| g.map(f64::from)).collect();
    assert_eq!(found.len(), truth.len());
    for c in 0..3 {
        let (a, b) = (log(&found, c), log(&truth, c));
        let error = a.iter().zip(&b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>();
        let size = b.iter().map(|b| b * b).sum::<f64>();
        // With so few steps most of the gain is found, but not all.
        assert!(error < 0.4 * size, "channel {c}: {a:?} for {b:?}");
    }
    // A held-out view is scored after a gain of its own; the other run gets the same.
    let off = run(Exposure::Off, &nothing, 400, None, None).unwrap();
    assert!(off.exposures.is_empty() && off.evaluation.as_ref().unwrap().fitted.is_none());
    let (with, without) = (learnt.evaluation.as_ref().unwrap(), off.evaluation.as_ref().unwrap());
    let fitted = with.fitted.as_ref().expect("views have gains").psnr.value().unwrap();
    assert!(fitted > with.psnr.value().unwrap().max(without.psnr.value().unwrap()) + 1.0, "{fitted}");
    // Gains start from known gains, and a checkpoint must agree with them. A stopped run ends like an
    // undisturbed one.
    let known = Known { gains, ..Known::default() };
    let dir = tempfile::tempdir().unwrap();
    let stopped = run(Exposure::PerView, &known, 60, Some(35), Some(dir.path()));
    assert!(matches!(stopped, Err(ReconstructError::Interrupted { step: 35, .. })));
    let whole = run(Exposure::PerView, &known, 60, None, None).unwrap();
    let resumed = run(Exposure::PerView, &known, 60, None, Some(dir.path())).unwrap();
    assert!(same(&resumed, &whole) && resumed.exposures == whole.exposures);
    assert!(!same(&whole, &run(Exposure::PerView, &nothing, 60, None, None).unwrap()));
}

#[test]
fn water_that_was_found_is_held_and_then_let_go_gently() {
    let (capture, loaded) = tiny_capture(8);
    let found = true_water(capture.points.len());
    let run = |found: Option<&FoundWater>, hold: f64, release: f64, stop: Option<u64>, dir: Option<&Path>| {
        let params = ReconstructParams { medium_hold: hold, medium_release: release, ..tiny_params(40) };
        let mut watcher = StoppingObserver { stop_at: stop, ..StoppingObserver::default() };
        reconstruct_in(&capture, &known(found), &loader(&loaded), &params, dir, &mut watcher)
    };
    let water = |outcome: &ReconstructOutcome| match &outcome.scene.medium {
        MediumModel::Rbf(rbf) => rbf.clone(),
        other => panic!("{:?}", other.kind()),
    };
    let start = found.coefficients();
    let held = run(Some(&found), 1.0, 1.0, None, None).unwrap();
    assert!(water(&held).coefficients.iter().all(|anchor| *anchor == start));
    assert_eq!(water(&held).centers, MediumRbf::new(8, 4).centers);
    assert!(held.scene.medium_degree >= 1, "the veil's slope needs its bands");
    let half = run(Some(&found), 0.5, 0.1, None, None).unwrap();
    let moved = |o: &ReconstructOutcome| (water(o).coefficients[0][1][0][0] - start[1][0][0]).abs();
    let free = run(Some(&found), 0.0, 1.0, None, None).unwrap();
    assert!(moved(&half) > 0.0 && moved(&half) < 0.2 * moved(&free), "{} {}", moved(&half), moved(&free));
    // A checkpoint must agree with the water that was found. A stopped run ends like an undisturbed one.
    let dir = tempfile::tempdir().unwrap();
    let stopped = run(Some(&found), 0.5, 0.1, Some(25), Some(dir.path()));
    assert!(matches!(stopped, Err(ReconstructError::Interrupted { step: 25, .. })));
    let other = FoundWater { veil: [0.1; 3], ..found.clone() };
    assert!(!same(&run(Some(&other), 0.5, 0.1, None, Some(dir.path())).unwrap(), &half));
    assert!(same(&run(Some(&found), 0.5, 0.1, None, Some(dir.path())).unwrap(), &half));
    // Without known water, neither parameter has an effect.
    let (a, b) = (run(None, 0.5, 0.1, None, None).unwrap(), run(None, 1.0, 0.0, None, None).unwrap());
    assert!(same(&a, &b));
}

#[test]
fn right_water_held_gives_truer_colours_than_water_that_is_learnt_with_them() {
    let (capture, loaded) = tiny_capture(10);
    let found = true_water(capture.points.len());
    let params = tiny_params(160);
    let run = |found: Option<&FoundWater>| {
        reconstruct_in(&capture, &known(found), &loader(&loaded), &params, None, &mut Silent).unwrap().scene
    };
    // The scene's mean colour without its water; the truth's albedo has a mean of about 0.55, 0.5, 0.5.
    let mean = |scene: &use3d_scene::Scene| -> [f64; 3] {
        let n = scene.gaussians.len() as f64;
        let c0 = f64::from(use3d_numerics::spherical_harmonics::C0);
        std::array::from_fn(|c| {
            scene.gaussians.sh.iter().map(|sh| 0.5 + c0 * f64::from(sh[0][c])).sum::<f64>() / n
        })
    };
    let off = |scene: &use3d_scene::Scene| {
        mean(scene).iter().zip([0.55, 0.5, 0.5]).map(|(found, truth)| (found - truth).abs()).sum::<f64>()
    };
    let (held, learnt) = (run(Some(&found)), run(None));
    assert!(off(&held) < off(&learnt), "{:?} held, {:?} learnt", mean(&held), mean(&learnt));
}

#[test]
fn tracks_are_for_waters_that_can_start_from_them() {
    let params = ReconstructParams { medium_prior: MediumPrior::Tracks, ..ReconstructParams::default() };
    params.validate().unwrap();
    let wrong = |params: ReconstructParams| params.validate().unwrap_err().to_string();
    assert!(wrong(ReconstructParams { medium: Medium::Mlp, ..params.clone() }).contains("medium_prior"));
    assert!(wrong(ReconstructParams { images: Images::Proposed, ..params.clone() }).contains("images"));
    assert!(wrong(ReconstructParams { medium_hold: 1.5, ..params }).contains("medium_hold"));
}
