//! Compares the calibrator with the golden cases.

use use3d_golden::{Case, Part};

use super::head::{Head, HeadBatch};
use super::mlp::{Linear, Mlp, Trace};
use super::{Calibrator, LOCAL_CONDITION, RANGE_FLOOR, Statistics, push_local_condition};
use crate::extractor::{Affine, Descriptors, ExtractorSettings, Transition};
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

fn arrays<const N: usize>(case: &Case<'_>, tensor: &str) -> Vec<[f64; N]> {
    case.f64(tensor).chunks_exact(N).map(|c| c.try_into().expect("row length")).collect()
}

#[test]
fn golden_heads_values_losses_and_gradients() {
    let mut checked = 0;
    for case in Part::math("calibrator").cases() {
        if !case.has("in.g_w0") {
            continue;
        }
        checked += 1;
        let calibrator = Calibrator {
            global: head(&case, "g"),
            local: head(&case, "l"),
            ..Calibrator::identity(ExtractorSettings::default(), ProposerId::default())
        };
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
