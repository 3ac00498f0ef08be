//! The stage that learns the calibrator: it maps proposed transitions towards those of the paired data.

use use3d_atc::calibrator::{Calibrator, CalibratorParams, Dataset, METHOD_PAIRS, train};
use use3d_atc::progress::LoopPosition;
use use3d_workflow::{StageContext, StageError};

use crate::parts::files::{CALIBRATOR, DATASET, go_on, read_json, write, write_json};

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_workflow::{Scope, Stage};

    use crate::parts::files::out_of_range;
    use crate::planning::learns_a_calibrator;

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("calibrate", Scope::Shared, run)
            .about("learn from the pairs of pictures how corrected colours look")
            .promises(&[CALIBRATOR, "report.json"])
            .check(|p: &CalibratorParams| p.validate().map_err(out_of_range))
            .input("pairs", "pairs")
            .when_named(learns_a_calibrator)
            .seeded()
            .usually_costs(5.0, 0.0)
    }
}

fn run(context: &StageContext, params: &CalibratorParams) -> Result<(), StageError> {
    let dataset: Dataset = read_json(&context.input("pairs")?.join(DATASET))?;
    let params = CalibratorParams { seed: context.seed(), ..params.clone() };
    let data = format!("{} pairs, {} left out", dataset.examples.len(), dataset.skipped.len());
    let mut last = 0;
    let calibrator = train(&dataset, &params, &data, &mut |progress| {
        if let LoopPosition::Step { step, steps, loss } = progress {
            if step < last {
                context.say("tested on a part of the pairs; now learning from all of them");
            }
            last = step;
            context.progress_with(step, steps, "steps", &format!("loss {loss:.4}"));
        }
        go_on(context)
    });
    context.alive()?;
    let calibrator = calibrator?;
    tell(context, &calibrator, &params, dataset.examples.len());
    write(&context.output().join(CALIBRATOR), calibrator.to_bytes()?)?;
    write_json(&context.output().join("report.json"), &calibrator.provenance)
}

/// Reports how much of the proposals the calibrator corrects, and how reliable that is.
fn tell(context: &StageContext, calibrator: &Calibrator, params: &CalibratorParams, pairs: usize) {
    let trust = params.trust;
    if CalibratorParams::few(pairs) {
        context.say(format_args!(
            "{pairs} pairs of pictures (before and after a correction) are few ({METHOD_PAIRS} are recommended): the colours \
             may not fit your water; if they look wrong, run again without the pairs"
        ));
    }
    if calibrator.corrects() == [false; 2] {
        let why = match trust {
            0.0 => "calibrate.trust is 0",
            _ => "what was learnt from them did not improve the pairs that were kept back for a test",
        };
        context.say(format_args!("the pairs change no colours: {why}"));
        return;
    }
    if let Some(held_out) = &calibrator.provenance.held_out {
        let errors = &held_out.errors;
        let (global, local) = (&errors.global, &errors.centered);
        context.detail(format_args!(
            "colour error on held-out pairs, proposal → calibrated: global {:.3} → {:.3}, local {:.3} → {:.3}",
            global.before, global.after, local.before, local.after
        ));
        context.say(format_args!(
            "the pairs make the colours of the usual filter better: its error falls by {:.0} % (tested with pairs that were \
             kept back)",
            100.0 * (global.before - global.after).max(0.0) / global.before.max(f64::MIN_POSITIVE)
        ));
        for (head, share) in ["global", "local"].into_iter().zip(held_out.kept) {
            if share < trust {
                context.detail(format_args!(
                    "the {head} head keeps {:.0} % of its correction, as more made the held-out pairs \
                     worse; more pairs, or pairs of one kind, help",
                    100.0 * share
                ));
            }
        }
    }
}
