//! The calibrator end to end: data set, training, report, file.

use std::ops::ControlFlow;

use use3d_atc::AtcError;
use use3d_atc::calibrator::{
    Calibrator, CalibratorParams, Dataset, LastLayer, PairImages, RANGE_FLOOR, Scales, Statistics, evaluate,
    held_out, train,
};
use use3d_atc::extractor::{ExtractorSettings, SourceImage, Workspace, affine_apply};
use use3d_atc::progress::{LoopPosition, unwatched};
use use3d_atc::proposers::{Fusion, Proposer, ProposerId};
use use3d_capture::Image;
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};

/// A proposer with an error that depends on the source: it brightens by only half of the required amount.
struct Timid;

impl Proposer for Timid {
    fn name(&self) -> &str {
        "timid"
    }
    fn digest(&self) -> String {
        "1".into()
    }
    fn propose(&self, image: &Image) -> Result<Image, AtcError> {
        Ok(image.map(|v| 1.2 * v + 0.02))
    }
}

/// A photograph under water of some strength, and the clean one.
fn pair(index: u64) -> (Image, Image) {
    let stream = Stream::new(11, Purpose::new("pairs"), index);
    let (w, h) = (72, 48);
    let cast: [f32; 3] =
        std::array::from_fn(|c| (0.35 + 0.2 * c as f64 + 0.15 * stream.uniform(c as u64)) as f32);
    let veil = 0.15 * stream.uniform(7) as f32;
    let (mut water, mut clean) = (Image::new(w, h), Image::new(w, h));
    for y in 0..h {
        for x in 0..w {
            let k = 100 + 3 * (y * w + x) as u64;
            let wave = 0.25 * (math::sin(x as f32 * 0.15 + index as f32) + math::cos(y as f32 * 0.2));
            let colour: [f32; 3] = std::array::from_fn(|c| {
                (0.5 + wave + 0.15 * stream.uniform(k + c as u64) as f32).clamp(0.0, 1.0)
            });
            clean.set_pixel(x, y, colour);
            water.set_pixel(x, y, std::array::from_fn(|c| cast[c] * colour[c] + veil * c as f32 * 0.5));
        }
    }
    (water, clean)
}

fn pairs(count: u64) -> impl Iterator<Item = PairImages> {
    (0..count).map(|i| PairImages { name: format!("{i:03}.png"), images: Ok(pair(i)) })
}

fn quick() -> CalibratorParams {
    CalibratorParams {
        steps: 120,
        cells_per_step: 256,
        learning_rate: 3e-3,
        global_hidden: 24,
        local_hidden: 24,
        ..CalibratorParams::default()
    }
}

#[test]
fn training_brings_held_out_transitions_nearer_and_is_deterministic() {
    let dataset = Dataset::build(pairs(20), &Timid, &ExtractorSettings::default(), &mut unwatched).unwrap();
    assert_eq!((dataset.examples.len(), dataset.skipped.len()), (20, 0));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| train(&dataset, &quick(), "test pairs", &mut unwatched).unwrap())
    };
    let calibrator = run(1);
    assert_eq!(calibrator.to_bytes().unwrap(), run(3).to_bytes().unwrap());
    let report = calibrator.provenance.held_out.clone().unwrap();
    assert_eq!((report.fitted, report.tested.len()), (16, 4));
    for (what, change) in [("global", report.errors.global), ("local", report.errors.local)] {
        assert!(change.ratio() < 0.6, "{what}: {change:?}");
    }
    // The final fit, evaluated on the pairs used in it.
    let seen = evaluate(&calibrator, &dataset.examples);
    assert!(seen.global.ratio() < 0.5, "{seen:?}");
    let scales = calibrator.global_scales();
    let errors = dataset.examples.iter().map(|pair| {
        (0..12).map(|k| (pair.proposal[k] - pair.target[k]).abs() / scales[k]).sum::<f64>() / 12.0
    });
    let before = errors.sum::<f64>() / 20.0;
    assert!((seen.global.before - before).abs() < 1e-9 * before, "{seen:?} {before}");
    let cells: usize = dataset.examples.iter().map(|pair| pair.cells.len()).sum();
    let made = &calibrator.provenance;
    assert_eq!((made.cells, made.seed, made.tool.is_empty()), (cells, quick().seed, false));

    let back = Calibrator::from_bytes(&calibrator.to_bytes().unwrap()).unwrap();
    assert_eq!(back, calibrator);
    assert_eq!((back.proposer.name.as_str(), back.provenance.pairs), ("timid", 20));
    let bytes = calibrator.to_bytes().unwrap();
    for cut in [0, 7, 100, bytes.len() - 1] {
        assert!(Calibrator::from_bytes(&bytes[..cut]).is_err());
    }
}

#[test]
fn an_identity_calibrator_returns_the_proposal_exactly() {
    let (water, _) = pair(3);
    let source = SourceImage::from_image(&water, &ExtractorSettings::default()).unwrap();
    let mut workspace = Workspace::default();
    let proposal = source.forward(&Fusion.propose(&source.image).unwrap(), &mut workspace).unwrap().clone();
    let calibrator = Calibrator::identity(ExtractorSettings::default(), Fusion.id());
    let descriptors = source.descriptors();
    assert_eq!(calibrator.calibrate_global(&descriptors.global, &proposal.global), proposal.global);
    let local = calibrator.calibrate_local(&descriptors, &proposal, &[0.7; 12]).unwrap();
    assert_eq!(local, proposal.local);
    let mut short = proposal;
    short.local.pop();
    assert!(calibrator.calibrate_local(&descriptors, &short, &[0.7; 12]).is_err());
}

#[test]
fn bad_pairs_are_listed_and_too_few_are_an_error() {
    let mut offered: Vec<PairImages> = pairs(2).collect();
    offered.push(PairImages { name: "torn.png".into(), images: Err("unexpected end of file".into()) });
    let (water, _) = pair(5);
    offered.push(PairImages {
        name: "other.png".into(),
        images: Ok((water.clone(), Image::filled(48, 72, 0.5))),
    });
    offered.push(PairImages { name: "tiny.png".into(), images: Ok((water, Image::filled(3, 2, 0.5))) });
    offered.push(PairImages {
        name: "nan.png".into(),
        images: Ok((Image::filled(30, 20, f32::NAN), Image::filled(30, 20, 0.5))),
    });
    let dataset = Dataset::build(offered, &Timid, &ExtractorSettings::default(), &mut unwatched).unwrap();
    let skipped: Vec<&str> = dataset.skipped.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(skipped, ["torn.png", "other.png", "tiny.png", "nan.png"]);
    assert!(dataset.skipped[1].reason.contains("72x48") && dataset.skipped[1].reason.contains("48x72"));
    let error = train(&dataset.subset(&[0]), &quick(), "", &mut unwatched).unwrap_err();
    assert!(error.to_string().contains("at least 2"), "{error}");
    let none = Dataset { examples: Vec::new(), ..dataset };
    let error = train(&none, &quick(), "", &mut unwatched).unwrap_err().to_string();
    assert!(error.contains("torn.png"), "{error}");
}

#[test]
fn a_watch_can_stop_training_and_bad_parameters_are_named() {
    let dataset = Dataset::build(pairs(4), &Timid, &ExtractorSettings::default(), &mut unwatched).unwrap();
    let mut last = 0;
    let mut watch = |progress: LoopPosition<'_>| {
        if let LoopPosition::Step { step, .. } = progress {
            last = step;
            if step == 5 {
                return ControlFlow::Break(());
            }
        }
        ControlFlow::Continue(())
    };
    assert_eq!(train(&dataset, &quick(), "", &mut watch).unwrap_err(), AtcError::Stopped);
    assert_eq!(last, 5);
    let bad = CalibratorParams { learning_rate: f64::NAN, ..quick() };
    assert!(train(&dataset, &bad, "", &mut unwatched).unwrap_err().to_string().contains("learning_rate"));
    let bad = CalibratorParams { scale_floor: 0.0, ..quick() };
    assert!(bad.validate().is_err_and(|e| e.path == "scale_floor"));
    let bad = CalibratorParams { trust: 1.5, ..quick() };
    assert!(train(&dataset, &bad, "", &mut unwatched).unwrap_err().to_string().contains("trust"));
    let unknown: Result<CalibratorParams, _> = serde_json::from_str(r#"{"step": 3}"#);
    assert!(unknown.unwrap_err().to_string().contains("step"));
}

#[test]
fn another_proposer_is_refused_unless_digests_were_not_recorded() {
    let recorded = ProposerId { name: "nu2net".into(), digest: "aa".into() };
    let other = ProposerId { digest: "bb".into(), ..recorded.clone() };
    let unrecorded = ProposerId { digest: String::new(), ..recorded.clone() };
    assert!(recorded.require(&recorded).is_ok() && unrecorded.require(&other).is_ok());
    assert!(recorded.require(&other).is_err() && unrecorded.require(&Fusion.id()).is_err());
}

/// Targets that do not depend on their sources can only be overfitted.
#[test]
fn early_stopping_does_less_harm_where_there_is_nothing_to_learn() {
    let mut dataset =
        Dataset::build(pairs(16), &Timid, &ExtractorSettings::default(), &mut unwatched).unwrap();
    let stream = Stream::new(2, Purpose::new("unlearnable"), 0);
    for (i, example) in dataset.examples.iter_mut().enumerate() {
        for (k, t) in example.target.iter_mut().enumerate() {
            *t = example.proposal[k] + 0.2 * stream.normal((12 * i + k) as u64);
        }
    }
    let params = CalibratorParams { learning_rate: 1e-2, held_out: 0.5, ..quick() };
    let calibrator = train(&dataset, &params, "", &mut unwatched).unwrap();
    let report = calibrator.provenance.held_out.unwrap();
    assert!(report.stopped[0] < params.steps, "{:?}", report.stopped);
    assert!(report.errors.global.after < report.all_steps.global.after);
    // If no correction helps, the proposal remains.
    assert!(report.kept[0] < 1.0, "{:?}", report.kept);
    for change in [report.errors.global, report.errors.centered] {
        assert!(change.after <= change.before + 1e-12, "{change:?}");
    }
    let all = CalibratorParams { stop_early: false, ..params };
    let report = train(&dataset, &all, "", &mut unwatched).unwrap().provenance.held_out.unwrap();
    assert_eq!((report.errors, report.stopped), (report.all_steps, [all.steps; 2]));
    assert_eq!(report.kept, [1.0; 2]);
}

/// Pairs whose local corrections have two parts. The first alternates from cell to cell, is known from the
/// cell's descriptor, and is alike in all pairs: it can be learnt, and centring leaves it. The second is one
/// constant per pair with the sign of the pair's descriptor, and the opposite sign in the held-out pairs: to
/// learn it makes them worse, and centring takes it away. Uncentred, the held-out pairs want the earliest
/// step and no correction; centred, as the consensus uses them, a late step and all of it.
#[test]
fn the_local_head_stops_and_is_kept_by_centred_errors_where_uncentred_ones_disagree() {
    let mut dataset =
        Dataset::build(pairs(16), &Timid, &ExtractorSettings::default(), &mut unwatched).unwrap();
    let params = CalibratorParams { held_out: 0.5, ..quick() };
    let (_, tested) = held_out(&dataset, &params).unwrap();
    for (i, example) in dataset.examples.iter_mut().enumerate() {
        let side = if i % 2 == 0 { 1.0 } else { -1.0 };
        let learnt = if tested.contains(&i) { -side } else { side };
        example.descriptor = [side; 18];
        example.proposal = [0.1 * side; 12];
        example.target = example.proposal;
        // An even number of cells, so that their mean is the constant.
        example.cells.truncate(example.cells.len() / 2 * 2);
        for (c, cell) in example.cells.iter_mut().enumerate() {
            let pattern = if c % 2 == 0 { 0.1 } else { -0.1 };
            cell.descriptor = [10.0 * pattern; 6];
            cell.proposal = [0.0; 6];
            cell.target = [pattern + 0.5 * learnt; 6];
            cell.confidence = 1.0;
        }
    }
    let report = train(&dataset, &params, "", &mut unwatched).unwrap().provenance.held_out.unwrap();
    let (local, centered) = (report.errors.local, report.errors.centered);
    // Errors disagree: a share of 0 would have left `before`.
    assert!(local.after > 1.2 * local.before, "{local:?}");
    assert!(centered.after < 0.3 * centered.before, "{centered:?}");
    assert!(report.stopped[1] > 50 && report.kept[1] == 1.0, "{:?} {:?}", report.stopped, report.kept);
}

/// Without trust the pairs give only the scales of the errors.
#[test]
fn without_trust_the_proposal_stays_as_it_is() {
    let dataset = Dataset::build(pairs(8), &Timid, &ExtractorSettings::default(), &mut unwatched).unwrap();
    let learnt = train(&dataset, &quick(), "", &mut unwatched).unwrap();
    for stop_early in [true, false] {
        let params = CalibratorParams { stop_early, trust: 0.0, ..quick() };
        // No step is taken that would be discarded, and the scales are those of a fit.
        let calibrator = train(&dataset, &params, "pairs", &mut |_| panic!("a step was taken")).unwrap();
        assert_eq!((calibrator.corrects(), learnt.corrects()), ([false; 2], [true; 2]));
        assert_eq!(calibrator.global_scales(), learnt.global_scales());
        assert_eq!(calibrator.local_scales(), learnt.local_scales());
        let said = &calibrator.provenance;
        assert_eq!((said.pairs, said.steps, said.data.as_str()), (8, 0, "pairs"));
        assert!(said.held_out.is_none());
        assert_eq!(Calibrator::from_bytes(&calibrator.to_bytes().unwrap()).unwrap(), calibrator);
        for example in &dataset.examples {
            let said = calibrator.calibrate_global(&example.descriptor, &example.proposal);
            let change = said.iter().zip(&example.proposal).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
            assert!(change < 1e-6, "{change}");
        }
    }
}

/// A pair that differs by one affine has this affine as its transition at every cell.
#[test]
fn an_affine_pair_has_that_affine_as_its_target() {
    let (water, _) = pair(9);
    let t = [0.5, 0.0, 0.0, 0.05, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, -0.2, 0.1];
    let mut target = water.clone();
    for y in 0..water.height() {
        for x in 0..water.width() {
            target.set_pixel(x, y, affine_apply(&t, water.pixel(x, y).map(f64::from)).map(|v| v as f32));
        }
    }
    let given = vec![PairImages { name: "a".into(), images: Ok((water, target)) }];
    let dataset = Dataset::build(given, &Timid, &ExtractorSettings::default(), &mut unwatched).unwrap();
    let found = &dataset.examples[0];
    let direction: f64 = found.target.iter().zip(t).map(|(a, b)| a * b).sum();
    let norm = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    assert!(direction / (norm(&found.target) * norm(&t)) > 0.9);
}

/// Fits a calibrator to all pairs of a data set with the whole recipe: nothing is held out.
fn fit(dataset: &Dataset, params: &CalibratorParams) -> Calibrator {
    let params = CalibratorParams { held_out: 0.0, ..params.clone() };
    train(dataset, &params, "", &mut unwatched).unwrap()
}

/// The ranges of both heads' targets, and those of the residuals, for five pairs of four cells. The expected
/// numbers are `numpy.subtract(*numpy.percentile(values, [75, 25]))` in float64 with
///
/// ```text
/// global: target = 0.1 (k + 1) T[e],              proposal = 0.1 (k + 1) (T[e] − R[e])
/// local:  target = (k + 1) (T[e] + C[c]),         proposal = target − (k + 1) (R[e] + C[c] / 8)
/// T = 0, 1, 3, 7, 20   R = 0, 1, −1, 2, −6   C = 0, 2, 5, 11
/// ```
///
/// 6, 2 for the sets T and R, 10.5 for the twenty sums T + C and 2.53125 for the twenty sums R + C / 8.
#[test]
fn operator_scales_are_the_ranges_of_both_heads_targets() {
    const T: [f64; 5] = [0.0, 1.0, 3.0, 7.0, 20.0];
    const R: [f64; 5] = [0.0, 1.0, -1.0, 2.0, -6.0];
    const C: [f64; 4] = [0.0, 2.0, 5.0, 11.0];
    let mut dataset =
        Dataset::build(pairs(5), &Timid, &ExtractorSettings::default(), &mut unwatched).unwrap();
    for (e, example) in dataset.examples.iter_mut().enumerate() {
        example.target = std::array::from_fn(|k| 0.1 * (k + 1) as f64 * T[e]);
        example.proposal = std::array::from_fn(|k| 0.1 * (k + 1) as f64 * (T[e] - R[e]));
        example.cells.truncate(4);
        for (c, cell) in example.cells.iter_mut().enumerate() {
            cell.target = std::array::from_fn(|k| (k + 1) as f64 * (T[e] + C[c]));
            cell.proposal = std::array::from_fn(|k| (k + 1) as f64 * (T[e] + C[c] - R[e] - C[c] / 8.0));
        }
    }
    for (scales, global, local) in [(Scales::Operators, 6.0, 10.5), (Scales::Residuals, 2.0, 2.53125)] {
        // The scales of a fit without steps, and those of a calibrator that corrects nothing.
        let fitted = fit(&dataset, &CalibratorParams { steps: 0, scales, ..quick() });
        let unchanged = CalibratorParams { trust: 0.0, scales, ..quick() };
        for calibrator in [fitted, train(&dataset, &unchanged, "", &mut unwatched).unwrap()] {
            for (k, found) in calibrator.global_scales().iter().enumerate() {
                assert!((found / (0.1 * (k + 1) as f64 * global) - 1.0).abs() < 1e-6, "{scales:?}: {found}");
            }
            for (k, found) in calibrator.local_scales().iter().enumerate() {
                assert!((found / ((k + 1) as f64 * local) - 1.0).abs() < 1e-6, "{scales:?}: {found}");
            }
        }
    }
}

/// The paper scales errors by the ranges of the paired operators, the release by those of the residuals
/// (R19). The paper does not specify a head's start, and the release starts its last layer at random (R18).
#[test]
fn the_scales_and_the_start_of_the_last_layer_can_be_chosen() {
    let dataset = Dataset::build(pairs(9), &Timid, &ExtractorSettings::default(), &mut unwatched).unwrap();
    let fitted = |scales, last_layer| {
        let params = CalibratorParams { steps: 0, scales, last_layer, ..quick() };
        fit(&dataset, &params)
    };
    let ranges = |of: &dyn Fn(usize, usize) -> f64| {
        let rows = (0..dataset.examples.len()).flat_map(|e| (0..12).map(move |k| (e, k)));
        Statistics::of(&rows.map(|(e, k)| of(e, k) as f32).collect::<Vec<_>>(), 12, RANGE_FLOOR).range
    };
    let target = |e: usize, k: usize| f64::from(dataset.examples[e].target[k] as f32);
    let residual = |e: usize, k: usize| {
        f64::from(dataset.examples[e].target[k] as f32 - dataset.examples[e].proposal[k] as f32)
    };
    let [usual, paper] = [Scales::Residuals, Scales::Operators].map(|s| fitted(s, LastLayer::Zero));
    assert_eq!(usual.global.residual.range, ranges(&residual));
    assert_eq!(paper.global.residual.range, ranges(&target));
    assert_ne!(usual.local.residual.range, paper.local.residual.range);
    assert_eq!(usual.global.residual.median, paper.global.residual.median);
    // The floor bounds the scales of errors, and no range of a condition.
    let floored = |scale_floor| fit(&dataset, &CalibratorParams { steps: 0, scale_floor, ..quick() });
    let (low, high) = (floored(1e-4), floored(0.9));
    let least = |ranges: &[f32]| ranges.iter().copied().fold(f32::INFINITY, f32::min);
    for (low, high) in [(&low.global, &high.global), (&low.local, &high.local)] {
        assert!(least(&low.residual.range) < 0.9 && least(&high.residual.range) == 0.9);
        assert_eq!(low.condition, high.condition);
    }
    let silent = |c: &Calibrator| c.global.mlp.layers[2].weight.iter().all(|w| *w == 0.0);
    assert!(silent(&usual) && !silent(&fitted(Scales::Operators, LastLayer::Random)));
    // With any scales, the fit brings the pairs nearer to their targets.
    let params = CalibratorParams { scales: Scales::Operators, last_layer: LastLayer::Random, ..quick() };
    let errors = evaluate(&fit(&dataset, &params), &dataset.examples);
    assert!(errors.global.ratio() < 0.6, "{errors:?}");
}
