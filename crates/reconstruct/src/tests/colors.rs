//! The colour field in a whole step, and in a whole run.

use super::*;
use crate::{ColorField, ColorState, ColorStep};

/// The parts of MarineSTD-GS: caustics, learnt alone at first, and water of single views.
fn bright(mut params: ReconstructParams) -> ReconstructParams {
    (params.color_field, params.color_alone) = (ColorField::Caustics, 0.4);
    (params.medium, params.medium_prior) = (Medium::PerView, MediumPrior::Off);
    (params.smoothness_weight, params.smoothness_by_prior) = (0.01, true);
    params
}

#[test]
fn a_field_gets_the_gradient_of_the_loss_and_alone_it_changes_neither_gaussians_nor_water() {
    let (capture, loaded) = tiny_capture(2);
    let mut state =
        TrainingState::new(few_gaussians(&capture, 40), MediumModel::Rbf(MediumRbf::new(4, 2)), &[]);
    state.colors = ColorState::new(ColorField::Caustics, 2, 3);
    let params =
        ReconstructParams { depth_weight: 0.0, structure_weight: 0.0, ..ReconstructParams::default() };
    let params = ReconstructParams { photometric: crate::Photometric::Ssim, ..params };
    let plan = |colors| StepPlan { colors, ..still(losses::weights(&params, 0)) };
    let mut engine = CpuEngine::default();
    for at in 0..2 {
        engine.upload(TrainingView::new(&capture.views[at], loaded[at].clone()).unwrap().0).unwrap();
    }
    let joint = ColorStep { rates: [1e-2; 3], weight: 0.3, alone: false };
    engine.load(state.clone()).unwrap();
    engine.differentiate(1, &plan(Some(joint))).unwrap();
    let (values, sh) = (engine.color_gradient().to_vec(), engine.gradients().0.sh.clone());
    assert!(engine.save().unwrap().gaussians == state.gaussians, "the scene's colours are there again");
    let mut at = |change: &dyn Fn(&mut TrainingState, f32), by: f32| {
        let mut moved = state.clone();
        change(&mut moved, by);
        engine.load(moved).unwrap();
        engine.differentiate(1, &plan(Some(joint))).unwrap().total
    };
    let norm = values.iter().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>().sqrt();
    let h = 2e-3;
    let along = |s: &mut TrainingState, by: f32| {
        let steps = values.iter().map(|g| by * g / norm as f32);
        s.colors.values.iter_mut().zip(steps).for_each(|(v, step)| *v += step);
    };
    let numeric = (at(&along, h) - at(&along, -h)) / f64::from(2.0 * h);
    assert!((numeric - norm).abs() < 2e-2 * norm, "{numeric} {norm}");
    let most = sh.iter().map(|sh| sh[0][1].abs()).fold(0.0f32, f32::max);
    for i in (0..40).step_by(9) {
        // The field sees the colour without a gradient, so its part is small where the field is.
        let change = |s: &mut TrainingState, by: f32| s.gaussians.sh[i][0][1] += by;
        let numeric = (at(&change, h) - at(&change, -h)) / f64::from(2.0 * h);
        assert!((numeric - f64::from(sh[i][0][1])).abs() < 0.2 * f64::from(most), "{numeric} {:?}", sh[i][0]);
    }

    // Adam's first step has the sign of a gradient alone, so the light must be strong enough to turn one.
    state.colors.values.iter_mut().for_each(|v| *v += 0.05);
    let moving = StepRates { means: 1e-3, sh_constant: 1e-2, medium_constant: 1e-2, ..NO_RATES };
    let mut after = |colors| {
        engine.load(state.clone()).unwrap();
        engine.step(1, &StepPlan { rates: moving, ..plan(colors) }).unwrap();
        engine.save().unwrap().into_owned()
    };
    let without = after(None);
    let alone = after(Some(ColorStep { alone: true, ..joint }));
    let together = after(Some(joint));
    assert!(alone.gaussians == without.gaussians && alone.medium == without.medium);
    assert!(together.gaussians != without.gaussians);
    assert!(
        alone.colors == together.colors && alone.colors != state.colors && without.colors == state.colors
    );
}

#[test]
fn a_run_with_a_field_is_the_same_on_any_number_of_threads_and_after_an_interruption() {
    let (capture, loaded) = tiny_capture(6);
    let params = bright(ReconstructParams { checkpoint_steps: 8, schedule: 40, ..tiny_params(40) });
    let on = |threads: usize, dir: Option<&Path>, observer: &mut StoppingObserver| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| reconstruct(&capture, &loader(&loaded), &params, dir, observer))
    };
    let whole = on(1, None, &mut StoppingObserver::default()).unwrap();
    assert!(same(&whole, &on(3, None, &mut StoppingObserver::default()).unwrap()));
    let dir = tempfile::tempdir().unwrap();
    let stop = &mut StoppingObserver { stop_at: Some(23), ..StoppingObserver::default() };
    assert!(on(2, Some(dir.path()), stop).is_err());
    assert!(same(&whole, &on(2, Some(dir.path()), &mut StoppingObserver::default()).unwrap()));
    let MediumModel::PerView(water) = &whole.scene.medium else { panic!("each view has its own water") };
    assert!(water.centers.len() == capture.split.train.len() && water.numbers[0] != water.numbers[1]);
    // Without a field the colours differ.
    let plain = ReconstructParams { color_field: ColorField::Off, ..params.clone() };
    let plain = reconstruct(&capture, &loader(&loaded), &plain, None, &mut StoppingObserver::default());
    assert!(!same(&whole, &plain.unwrap()));
}
