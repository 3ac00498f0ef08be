//! A term of the loss that is not part of the program: tests that every gradient reaches its target.

use super::*;

/// A term that reads every input:
/// `½ mean image² + ½ mean clear² + mean depth + ½ mean accumulation² + mean of the water's maps`.
struct Everything;

impl Term for Everything {
    fn reads_clear(&self) -> bool {
        true
    }

    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        let n = seen.depth.pixels() as f64;
        let scale = (weights[0] / n) as f32;
        let mean =
            |values: &[f32], f: fn(f64) -> f64| values.iter().map(|v| f(f64::from(*v))).sum::<f64>() / n;
        let half_square = |v: f64| 0.5 * v * v;
        let clear = seen.clear.unwrap();
        let mut value = mean(seen.image.data(), half_square)
            + mean(clear.data(), half_square)
            + mean(seen.depth.data(), |v| v)
            + mean(seen.accumulation.data(), half_square);
        gradients.image.add(|g| *g = seen.image.map(|v| scale * v));
        gradients.clear.add(|g| *g = clear.map(|v| scale * v));
        gradients.depth.add(|g| *g = seen.depth.map(|_| scale));
        gradients.accumulation.add(|g| *g = seen.accumulation.map(|v| scale * v));
        let water = seen.water.unwrap();
        for (map, slot) in [
            (&water.color, &mut gradients.water_color),
            (&water.backscatter, &mut gradients.backscatter),
            (&water.attenuation, &mut gradients.attenuation),
        ] {
            value += mean(map.data(), |v| v);
            slot.add(|g| *g = map.map(|_| scale));
        }
        values[0] = Some(value);
    }
}

#[test]
fn a_term_from_outside_reaches_gaussians_and_water_through_everything_it_reads() {
    const ROW: LossTerm = LossTerm {
        values: &[LossValue { name: "everything", weight: |_, _| 1.0 }],
        term: || Box::new(Everything),
    };
    let (capture, loaded) = tiny_capture(2);
    let mut water = MediumRbf::new(4, 2);
    water.coefficients.iter_mut().for_each(|a| a[0][0] = [0.5, 0.8, 1.1]);
    let state = TrainingState::new(few_gaussians(&capture, 40), MediumModel::Rbf(water), &[]);
    let plan = StepPlan { divisor: 2, ..still(vec![1.0]) };
    let engine = |rows: &[LossTerm]| {
        let mut engine = CpuEngine::with_terms(rows);
        let view = &capture.views[0];
        engine.upload(TrainingView::new(view, loaded[0].clone()).unwrap().0).unwrap();
        engine
    };
    let mut one = engine(&[ROW]);
    one.load(state.clone()).unwrap();
    one.differentiate(0, &plan).unwrap();
    let (gaussian, water) = one.gradients();
    let (gaussian, water) = (gaussian.clone(), water.flat());
    let mut at = |change: &dyn Fn(&mut TrainingState, f32), by: f32| {
        let mut moved = state.clone();
        change(&mut moved, by);
        one.load(moved).unwrap();
        one.differentiate(0, &plan).unwrap().total
    };
    let mut judge = |what: &str, change: &dyn Fn(&mut TrainingState, f32), expected: f32, most: f32| {
        let h = 4e-3;
        let numeric = (at(change, h) - at(change, -h)) / f64::from(2.0 * h);
        let error = (numeric - f64::from(expected)).abs();
        assert!(error < 1e-2 * f64::from(most), "{what}: {numeric} against {expected}, most {most}");
    };
    let most = |values: &[f32]| values.iter().fold(0.0f32, |m, v| m.max(v.abs()));
    for i in (0..40).step_by(7) {
        let (g, all) = (gaussian.opacity_logits[i], most(&gaussian.opacity_logits));
        judge("opacity", &|s, by| s.gaussians.opacity_logits[i] += by, g, all);
        let (g, all) = (gaussian.sh[i][0][1], most(gaussian.sh.as_flattened().as_flattened()));
        judge("colour", &|s, by| s.gaussians.sh[i][0][1] += by, g, all);
    }
    for i in (0..water.len()).step_by(29) {
        let change = |s: &mut TrainingState, by: f32| {
            let mut flat = s.medium.flat();
            flat[i] += by;
            assert!(s.medium.set_flat(&flat));
        };
        judge("water", &change, water[i], most(&water));
    }

    // A term of the Gaussians' sizes reaches them alone.
    let flatness = crate::losses::TERMS.iter().find(|row| row.values[0].name == "smallest_scale").unwrap();
    let mut sized = engine(&[*flatness]);
    sized.load(state.clone()).unwrap();
    sized.differentiate(0, &StepPlan { weights: vec![40.0], ..plan.clone() }).unwrap();
    let sizes = &sized.gradients().0.log_scales;
    let (most_of_all, expected) = (most(sizes.as_flattened()), use3d_numerics::math::exp(-2.0f32));
    assert!((most_of_all - expected).abs() < 0.2 * expected, "{most_of_all} of {expected}");
    assert!(sizes.iter().all(|[x, _, z]| *x == 0.0 && *z == 0.0));

    // Terms add up: the same term twice gives twice the loss and twice every gradient.
    let mut two = engine(&[ROW, ROW]);
    two.load(state.clone()).unwrap();
    let error = two.differentiate(0, &plan).unwrap_err().to_string();
    assert!(error.contains("1 weights of the loss, expected 2"), "{error}");
    let loss = two.differentiate(0, &StepPlan { weights: vec![1.0, 1.0], ..plan.clone() }).unwrap();
    assert_eq!(loss.values[0], loss.values[1]);
    let (twice, twice_water) = two.gradients();
    let pairs = twice.opacity_logits.iter().zip(&gaussian.opacity_logits);
    for (a, b) in pairs.chain(twice_water.flat().iter().zip(&water)) {
        assert!((a - 2.0 * b).abs() <= 1e-5 * most(&gaussian.opacity_logits).max(most(&water)), "{a} {b}");
    }
}
