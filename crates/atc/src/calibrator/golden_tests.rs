//! Compares the calibrator with the golden cases.

use glam::DVec3;
use use3d_capture::{Appearance, Camera, Intrinsics, KeptWater, Pose};
use use3d_golden::{Case, Part};

use super::head::{Head, HeadBatch};
use super::mlp::{Linear, Mlp, Trace};
use super::{Calibrator, LOCAL_CONDITION, RANGE_FLOOR, Statistics, push_local_condition};
use crate::consensus::{Adjoint, Lift, TargetsParams, ViewRecord, targets_from_records};
use crate::error::AtcError;
use crate::extractor::{Affine, Descriptors, ExtractorSettings, Transition};
use crate::progress::unwatched;
use crate::proposers::ProposerId;

fn head(case: &Case<'_>, which: &str) -> Head {
    let layer = |i: usize| Linear {
        weight: case.f32(&format!("in.{which}_w{i}")),
        bias: case.f32(&format!("in.{which}_b{i}")),
    };
    let statistics = |part: &str| Statistics {
        median: case.f32(&format!("in.{which}_med_{part}")),
        range: case.f32(&format!("in.{which}_iqr_{part}")),
    };
    Head {
        mlp: Mlp { layers: [layer(0), layer(1), layer(2)] },
        condition: statistics("c"),
        residual: statistics("r"),
    }
}

/// A calibrator with the heads of a case; `None` for a case without heads.
fn calibrator(case: &Case<'_>) -> Option<Calibrator> {
    let (global, local) = case.has("in.g_w0").then(|| (head(case, "g"), head(case, "l")))?;
    let identity = Calibrator::identity(ExtractorSettings::default(), ProposerId::default());
    Some(Calibrator { global, local, ..identity })
}

fn arrays<const N: usize>(case: &Case<'_>, tensor: &str) -> Vec<[f64; N]> {
    case.f64(tensor).chunks_exact(N).map(|c| c.try_into().expect("row length")).collect()
}

#[test]
fn golden_heads_values_losses_and_gradients() {
    let mut checked = 0;
    for case in Part::math("calibrator").cases() {
        let Some(calibrator) = calibrator(&case) else { continue };
        checked += 1;
        let descriptors = arrays::<18>(&case, "in.global_desc");
        let proposals = arrays::<12>(&case, "in.proposal_t");
        let cell_descriptors = arrays::<6>(&case, "in.cell_desc");
        let cell_proposals = arrays::<6>(&case, "in.proposal_d");
        let cells = cell_descriptors.len() / descriptors.len();

        // Image by image, as a scene uses it.
        let mut global: Vec<Affine> = Vec::new();
        let mut local: Vec<[f64; 6]> = Vec::new();
        for b in 0..descriptors.len() {
            let t = calibrator.calibrate_global(&descriptors[b], &proposals[b]);
            let of_image = b * cells..(b + 1) * cells;
            let described =
                Descriptors { global: descriptors[b], local: cell_descriptors[of_image.clone()].to_vec() };
            let proposal = Transition { global: proposals[b], local: cell_proposals[of_image].to_vec() };
            local.extend(calibrator.calibrate_local(&described, &proposal, &t).unwrap());
            global.push(t);
        }
        case.check_f64("out.t", global.as_flattened());
        case.check_f64("out.delta", local.as_flattened());

        // In one batch, as training uses it.
        let mut conditions: Vec<f32> = Vec::new();
        let mut cell_conditions: Vec<f32> = Vec::with_capacity(LOCAL_CONDITION * cell_proposals.len());
        for b in 0..descriptors.len() {
            conditions.extend(descriptors[b].iter().chain(&proposals[b]).map(|&v| v as f32));
            for c in b * cells..(b + 1) * cells {
                push_local_condition(
                    &mut cell_conditions,
                    &cell_descriptors[c],
                    &descriptors[b],
                    &proposals[b],
                    &cell_proposals[c],
                    &global[b],
                );
            }
        }
        let mut losses = Vec::new();
        for (which, head, conditions, proposal, target, weights) in [
            ("g", &calibrator.global, &mut conditions, "in.proposal_t", "in.target_t", None),
            (
                "l",
                &calibrator.local,
                &mut cell_conditions,
                "in.proposal_d",
                "in.target_d",
                Some(case.f32("in.confidence")),
            ),
        ] {
            head.condition.normalise(conditions);
            let mut gradients =
                Mlp::zeros(head.mlp.layers[0].inputs(), head.mlp.layers[0].outputs(), head.mlp.outputs());
            let (proposals, targets) = (case.f32(proposal), case.f32(target));
            let batch = HeadBatch {
                conditions,
                proposals: &proposals,
                targets: &targets,
                weights: weights.as_deref(),
            };
            losses.push(head.loss(&batch, &mut Trace::default(), &mut gradients));
            if case.pulls().contains_key("total") {
                let d_total = case.f64("cot.total")[0];
                for (i, layer) in gradients.layers.iter().enumerate() {
                    for (part, values) in [("w", &layer.weight), ("b", &layer.bias)] {
                        let scaled: Vec<f64> = values.iter().map(|&v| d_total * f64::from(v)).collect();
                        case.check_f64(&format!("grad.total.{which}_{part}{i}"), &scaled);
                    }
                }
            }
        }
        case.check_f64("out.l_global", &losses[..1]);
        case.check_f64("out.l_local", &losses[1..]);
        case.check_f64("out.total", &[losses[0] + losses[1]]);
    }
    assert!(checked > 0, "no case with heads");
}

/// An adjoint of which each pixel is a Gaussian, so that the lifted numbers are those of the map.
struct PixelsAsGaussians(usize);

impl Adjoint for PixelsAsGaussians {
    fn gaussians(&self) -> usize {
        self.0
    }

    fn lift(&mut self, _: &Camera, channels: usize, planes: &[f32], out: &mut [f32]) -> Result<(), AtcError> {
        for (i, v) in out.iter_mut().enumerate() {
            *v = planes[i % channels * self.0 + i / channels];
        }
        Ok(())
    }
}

/// From records to targets with the golden heads: their local operators are not centred, the observations of
/// the Gaussians are, and the last condition is the scene's operator and not the view's own.
#[test]
fn golden_heads_reach_the_gaussians_centred_and_under_the_scenes_operator() {
    let mut checked = 0;
    for case in Part::math("calibrator").cases() {
        let Some(calibrator) = calibrator(&case) else { continue };
        checked += 1;
        let descriptors = arrays::<18>(&case, "in.global_desc");
        let proposals = arrays::<12>(&case, "in.proposal_t");
        let cells = case.shape("in.proposal_d")[1];
        let cell_descriptors = arrays::<6>(&case, "in.cell_desc");
        let cell_proposals = arrays::<6>(&case, "in.proposal_d");
        let (calibrated, local) = (arrays::<12>(&case, "out.t"), arrays::<6>(&case, "out.delta"));
        let intrinsics = Intrinsics { width: cells, height: 1, fx: 9.0, fy: 9.0, cx: 3.5, cy: 0.5 };
        let camera = Camera { intrinsics, pose: Pose::look_at(DVec3::ZERO, DVec3::Z, -DVec3::Y) };
        for b in 0..descriptors.len() {
            let of_image = b * cells..(b + 1) * cells;
            // The view's own candidate is far away; that of four others is what the golden head has for it.
            let record = |candidate: Affine| ViewRecord {
                name: "view".into(),
                camera,
                grid: (cells, 1),
                descriptors: Descriptors {
                    global: descriptors[b],
                    local: cell_descriptors[of_image.clone()].to_vec(),
                },
                proposal: Transition {
                    global: proposals[b],
                    local: cell_proposals[of_image.clone()].to_vec(),
                },
                candidate,
            };
            let records = [[3.0; 12], calibrated[b], calibrated[b], calibrated[b], calibrated[b]].map(record);
            let (targets, _) = targets_from_records(
                &mut Lift::by(Box::new(PixelsAsGaussians(cells))),
                &records,
                (Appearance::Water, KeptWater::ALL),
                ProposerId::default(),
                &calibrator,
                &TargetsParams::default(),
                &mut unwatched,
            )
            .unwrap();
            // The golden operators minus their plain mean over the image: v − Σ v / n.
            let golden = &local[of_image];
            let (mut largest_mean, n) = (0.0f64, cells as f64);
            for k in 0..6 {
                let mean = golden.iter().map(|c| c[k]).sum::<f64>() / n;
                largest_mean = largest_mean.max(mean.abs());
                for (cell, found) in golden.iter().zip(&targets.state.mean) {
                    let error = f64::from(found[k]) - (cell[k] - mean);
                    assert!(error.abs() < 4.0 * case.tolerance("out.delta"), "image {b}: {error:e}");
                }
            }
            assert!(largest_mean > 0.01, "image {b} of the golden case is centred: {largest_mean}");
        }
    }
    assert!(checked > 0, "no case with heads");
}

#[test]
fn golden_statistics() {
    let mut checked = 0;
    for case in Part::math("calibrator").cases() {
        for name in case.names() {
            let Some(sample) = name.strip_prefix("out.median_") else { continue };
            let input = format!("in.{sample}");
            let columns = case.shape(&input)[1];
            let found = Statistics::of(&case.f32(&input), columns, RANGE_FLOOR);
            case.check(&format!("out.median_{sample}"), &found.median);
            case.check(&format!("out.iqr_{sample}"), &found.range);
            checked += 1;
        }
    }
    assert!(checked > 0, "no case with statistics");
}
