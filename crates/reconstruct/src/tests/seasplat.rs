//! Runs with turns, in which the water or the colours move alone.

use super::*;
use crate::{Photometric, Priors, Turns};

/// SeaSplat's schedule for a tiny scene: water from step 30 of 90, with turns of both kinds.
fn params() -> ReconstructParams {
    ReconstructParams {
        medium: Medium::Seasplat,
        photometric: Photometric::Ssim,
        sh_degree: 0,
        depth_weight: 0.0,
        smoothness_weight: 0.02,
        smoothness_normalised: true,
        priors: Priors { far: 1.0, backscatter: 1.0, saturation: 2.0, grey_world: 0.1, background: 0.01 },
        turns: Turns { from: 1.0 / 3.0, water_first: 0.2, colors_first: 0.1, every: 20, water: 6 },
        checkpoint_steps: 8,
        schedule: 90,
        ..tiny_params(90)
    }
}

#[test]
fn a_run_with_turns_learns_and_can_stop_in_the_middle_of_a_turn() {
    let (capture, loaded) = tiny_capture(10);
    let mut params = params();
    params.learning_rates.medium_constant = crate::Rate(0.01, 0.01);
    // 90 steps, 18 + 9 updates when the water begins, and three turns of 6.
    assert_eq!(params.updates(), 90 + 27 + 3 * 6);
    let run = |threads: usize, dir: Option<&std::path::Path>, observer: &mut StoppingObserver| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| reconstruct(&capture, &loader(&loaded), &params, dir, observer))
    };
    let whole = run(1, None, &mut StoppingObserver::default()).unwrap();
    let steps: Vec<u64> = whole
        .log
        .iter()
        .filter_map(|entry| match entry {
            LogEntry::Steps { step, .. } => Some(*step),
            _ => None,
        })
        .collect();
    assert_eq!(steps, (1..=9).map(|k| 10 * k).collect::<Vec<u64>>());
    assert_eq!(whole.scene.medium_degree, 3);
    let psnr = whole.evaluation.as_ref().unwrap().psnr.value().unwrap();
    assert!(psnr > 16.0, "held-out PSNR {psnr:.2} dB");
    let MediumModel::Seasplat(water) = &whole.scene.medium else { panic!("the water is SeaSplat's") };
    assert_ne!(water, &use3d_medium::MediumSeasplat::default());

    let dir = tempfile::tempdir().unwrap();
    // In a turn of the water, in one of the colours, in a step between, and in a later turn.
    for (stop_at, threads) in [(37, 2), (52, 1), (60, 3), (70, 2)] {
        let mut observer = StoppingObserver { stop_at: Some(stop_at), ..StoppingObserver::default() };
        let stopped = run(threads, Some(dir.path()), &mut observer);
        let Err(ReconstructError::Interrupted { step, steps: 135, saved: true }) = stopped else {
            panic!("not stopped");
        };
        assert_eq!(step, stop_at);
    }
    let resumed = run(2, Some(dir.path()), &mut StoppingObserver::default()).unwrap();
    assert!(same(&whole, &resumed), "interruptions change the scene");
}

/// An engine with one view, Gaussians in front of it, and the plan of a step with water.
fn engine() -> (CpuEngine, TrainingState, StepPlan) {
    let (capture, loaded) = tiny_capture(6);
    let params = params();
    let mut engine = CpuEngine::default();
    engine.upload(TrainingView::new(&capture.views[0], loaded[0].clone()).unwrap().0).unwrap();
    let mut gaussians = few_gaussians(&capture, 60);
    gaussians.opacity_logits.iter_mut().for_each(|logit| *logit += 1.0);
    gaussians.sh.iter_mut().for_each(|sh| sh[0] = [1.2, 0.2, -0.1]);
    let water = MediumModel::Seasplat(use3d_medium::MediumSeasplat::default());
    let plan = StepPlan {
        step: 40,
        degrees: Degrees { colors: 0, water: 3 },
        rates: params.rates(&params.phases(false), 40).0,
        ..still(losses::weights(&params, 40))
    };
    (engine, TrainingState::new(gaussians, water, &[]), plan)
}

#[test]
fn all_terms_together_agree_with_finite_differences() {
    let (mut engine, state, plan) = engine();
    engine.load(state.clone()).unwrap();
    let loss = engine.differentiate(0, &plan).unwrap();
    let named = losses::names().zip(&loss.values).filter(|(_, value)| value.is_some_and(|v| v > 0.0));
    let named: Vec<&str> = named.map(|(name, _)| name).collect();
    assert_eq!(
        named,
        [
            "plain_l1",
            "plain_ssim",
            "normalised_smoothness",
            "far_l1",
            "backscatter_prior",
            "saturation_prior",
            "grey_world_prior"
        ]
    );
    let (gaussian, water) = engine.gradients();
    let (gaussian, water) = (gaussian.clone(), water.flat());
    let mut at = |change: &dyn Fn(&mut TrainingState, f32), by: f32| {
        let mut moved = state.clone();
        change(&mut moved, by);
        engine.load(moved).unwrap();
        engine.differentiate(0, &plan).unwrap().total
    };
    let mut judge = |what: &str, change: &dyn Fn(&mut TrainingState, f32), gradient: &[f32]| {
        let h = 2e-3;
        let numeric = (at(change, h) - at(change, -h)) / f64::from(2.0 * h);
        let expected: f64 = gradient.iter().map(|g| f64::from(*g)).sum();
        let size: f64 = gradient.iter().map(|g| f64::from(g.abs())).sum();
        assert!((numeric - expected).abs() < 0.02 * size, "{what}: {numeric} against {expected} of {size}");
    };
    for (i, expected) in water.iter().enumerate() {
        let change = |s: &mut TrainingState, by: f32| {
            let mut flat = s.medium.flat();
            flat[i] += by;
            assert!(s.medium.set_flat(&flat));
        };
        judge("water", &change, &[*expected]);
    }
    // All colours of a channel, all opacities, and the whole scene nearer: sums have few kinks.
    for c in 0..3 {
        let change = |s: &mut TrainingState, by: f32| s.gaussians.sh.iter_mut().for_each(|sh| sh[0][c] += by);
        judge("colours", &change, &gaussian.sh.iter().map(|sh| sh[0][c]).collect::<Vec<f32>>());
    }
    let change =
        |s: &mut TrainingState, by: f32| s.gaussians.opacity_logits.iter_mut().for_each(|o| *o += by);
    judge("opacities", &change, &gaussian.opacity_logits);
}

#[test]
fn each_kind_of_update_moves_its_own_parameters() {
    let (mut engine, state, plan) = engine();
    for (moves, expected) in [
        (Moves::All, [true, true, true]),
        (Moves::Gaussians, [true, true, false]),
        (Moves::Colors, [false, true, false]),
        (Moves::Water, [false, false, true]),
    ] {
        engine.load(state.clone()).unwrap();
        engine.step(0, &StepPlan { moves, ..plan.clone() }).unwrap();
        let after = engine.save().unwrap();
        let moved = [
            after.gaussians.means != state.gaussians.means,
            after.gaussians.sh != state.gaussians.sh,
            after.medium != state.medium,
        ];
        assert_eq!(moved, expected, "{moves:?}");
    }
}
