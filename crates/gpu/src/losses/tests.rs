//! Compares the losses on the device with those of the processor.

use use3d_capture::{Image, Map};
use use3d_golden::{Case, Part};
use use3d_metrics::ms_ssim;

use super::*;
use crate::kernel::submit;
use crate::test_support::software;
use crate::twins::{LossCase, losses};

impl Losses {
    /// Fills everything that a step must write before it reads.
    pub(crate) fn poison(&self, gpu: &Gpu) {
        for level in &self.levels {
            for array in
                [&level.x, &level.y, &level.by_mean, &level.by_square, &level.by_product, &level.slope]
            {
                array.poison(gpu);
            }
        }
        for array in
            [&self.sums, &self.level_sums, &self.factors, &self.depth_sums, &self.depth_told, &self.nothing]
        {
            array.poison(gpu);
        }
    }
}

#[test]
fn the_losses_are_those_of_the_processor() {
    let Some(gpu) = software() else { return };
    for (seed, (width, height), [mask, prior, gains]) in [
        (1, (61, 47), [true, true, true]),
        (2, (64, 48), [false, false, false]),
        (3, (11, 130), [true, false, false]),
        (4, (10, 40), [false, true, true]),
        (5, (1, 1), [false, true, false]),
        (6, (26, 27), [false, true, false]),
        (7, (96, 64), [true, true, false]),
        (8, (257, 33), [false, false, true]),
    ] {
        let case = LossCase { width, height, seed, mask, prior, gains };
        for found in losses(&gpu, &case).unwrap() {
            assert!(found.holds(), "{case:?}: {found:?}");
        }
    }
}

/// Evaluates a golden case with photograph and render on the device: report, gradient of the image,
/// gradient of depth.
fn evaluate(gpu: &Gpu, case: &Case<'_>, weights: [f64; 3]) -> (Vec<f32>, Vec<f32>, Vec<f32>) {
    let image = |name: &str| {
        let (w, h, data) = case.planes(name);
        Image::from_planes(w, h, data).unwrap()
    };
    let map = |name: &str| {
        let (w, h, data) = case.planes(name);
        Map::from_planes(w, h, data).unwrap()
    };
    let (rendered, photograph) = (image("in.pred"), image("in.target"));
    let (depth, prior) = (map("in.depth"), map("in.prior"));
    let n = depth.pixels();
    let mut losses = Losses::new(gpu).unwrap();
    losses.resize(gpu, depth.width(), depth.height()).unwrap();
    losses.poison(gpu);
    let array = |values: &[f32]| Array::from(gpu, "golden", values).unwrap();
    let (rendered, photograph) = (array(rendered.data()), array(photograph.data()));
    let (depth, prior) = (array(depth.data()), array(prior.data()));
    let (by_image, by_depth) = (array(&vec![0.0; 3 * n]), array(&vec![0.0; n]));
    let reports = array(&[0.0; 16]);
    let stop = Array::from(gpu, "counts", &[0u32; counts::WORDS]).unwrap();
    let seen = LossInput {
        image: &rendered,
        depth: &depth,
        photograph: &photograph,
        mask: None,
        prior: Some(&prior),
    };
    let told = LossOutput { image: &by_image, depth: &by_depth, reports: &reports, counts: &stop };
    let plan = LossPlan { step: 0, report: 0, weights, gains: None };
    losses.prepare(gpu, &plan, &seen, None);
    submit(gpu, "losses", |pass| losses.record(pass, &seen, None, &told)).unwrap();
    (reports.read(gpu, 16).unwrap(), by_image.read(gpu, 3 * n).unwrap(), by_depth.read(gpu, n).unwrap())
}

#[test]
fn golden_losses_on_the_device() {
    let Some(gpu) = software() else { return };
    let part = Part::math("losses");
    let mut seen = 0;
    for case in part.cases() {
        if !case.has("in.pred") {
            continue; // a whole training step
        }
        let listed: Vec<f64> = serde_json::from_value(case.config()["weights"].clone()).unwrap();
        let (w, h) = (case.count("width"), case.count("height"));
        let ours = ms_ssim::level_weights(&ms_ssim::RECONSTRUCTION_WEIGHTS, w, h);
        if listed.len() != ours.len() || listed.iter().zip(&ours).any(|(a, b)| (a - b).abs() > 1e-9) {
            continue; // another measure's levels
        }
        seen += 1;
        let (lambda, depth_weight) = (case.number("lam"), case.number("lam_d"));
        let (told, ..) = evaluate(&gpu, &case, [1.0 - lambda, lambda, depth_weight]);
        let within = |name: &str, value: f32| {
            case.check_within(name, &[f64::from(value)], case.tolerance(name).max(2e-6));
        };
        within("out.total", told[0]);
        within("out.reg_l1", told[1]);
        within("out.reg_ms_ssim", told[2]);
        within("out.depth_loss", told[3]);
        for pull in case.pulls().keys() {
            let cotangent = case.f64(&format!("cot.{}", case.pulls()[pull][0]))[0];
            let weights = match pull.as_str() {
                "reg_l1" => [1.0, 0.0, 0.0],
                "reg_ms_ssim" => [0.0, 1.0, 0.0],
                "depth" => [0.0, 0.0, 1.0],
                "total" => [1.0 - lambda, lambda, depth_weight],
                other => panic!("unknown pull {other}"),
            };
            let (_, by_image, by_depth) = evaluate(&gpu, &case, weights.map(|w| w * cotangent));
            case.check_planes(&format!("grad.{pull}.pred"), &by_image);
            case.check_planes(&format!("grad.{pull}.depth"), &by_depth);
        }
    }
    assert!(seen >= 3);
}

#[test]
fn the_same_bits_every_time() {
    let Some(gpu) = software() else { return };
    let part = Part::math("losses");
    let case = part.cases().into_iter().find(|case| case.has("in.pred")).unwrap();
    let bits = |of: (Vec<f32>, Vec<f32>, Vec<f32>)| {
        [of.0[..6].to_vec(), of.1, of.2].concat().iter().map(|v| v.to_bits()).collect::<Vec<_>>()
    };
    let first = bits(evaluate(&gpu, &case, [0.8, 0.2, 0.1]));
    assert!((0..2).all(|_| bits(evaluate(&gpu, &case, [0.8, 0.2, 0.1])) == first));
}

#[test]
fn every_value_of_the_table_has_a_kernel_or_is_refused() {
    // A new term of the processor needs a kernel, or a run with a weight for it must be refused: see
    // `LossPlan::weights`.
    let names: Vec<_> = use3d_reconstruct::losses::names().collect();
    assert_eq!(names[..3], VALUES);
    let mut given = vec![0.0; names.len()];
    given[..3].copy_from_slice(&[0.8, 0.2, 0.1]);
    assert_eq!(LossPlan::weights(&given).unwrap(), [0.8, 0.2, 0.1]);
    assert!(LossPlan::weights(&[0.8]).unwrap_err().to_string().contains("expected"));
    for at in 3..names.len() {
        let mut given = vec![0.0; names.len()];
        given[at] = 1.0;
        assert!(LossPlan::weights(&given).unwrap_err().to_string().contains(names[at]));
    }
}

#[test]
fn a_loss_that_is_no_number_stops_the_run() {
    let Some(gpu) = software() else { return };
    let (w, h) = (20, 12);
    let mut picture = vec![0.5; 3 * w * h];
    picture[100] = f32::NAN;
    let array = |values: &[f32]| Array::from(&gpu, "test", values).unwrap();
    let (image, photograph) = (array(&picture), array(&vec![0.4; 3 * w * h]));
    let (by_image, by_depth) = (array(&picture), array(&vec![0.0; w * h]));
    let (depth, reports) = (array(&vec![1.0; w * h]), array(&[0.0; 16]));
    let stop = Array::from(&gpu, "counts", &[0u32; counts::WORDS]).unwrap();
    let mut losses = Losses::new(&gpu).unwrap();
    losses.resize(&gpu, w, h).unwrap();
    let seen = LossInput { image: &image, depth: &depth, photograph: &photograph, mask: None, prior: None };
    let told = LossOutput { image: &by_image, depth: &by_depth, reports: &reports, counts: &stop };
    let plan = LossPlan { step: 12, report: 0, weights: [0.8, 0.2, 0.0], gains: None };
    losses.prepare(&gpu, &plan, &seen, None);
    submit(&gpu, "losses", |pass| losses.record(pass, &seen, None, &told)).unwrap();
    let words = stop.read(&gpu, counts::WORDS).unwrap();
    assert_eq!(words[counts::STOP], counts::NON_FINITE);
    assert_eq!((words[counts::STOP_STEP], words[counts::BAD]), (12, 1 << 7));
}
