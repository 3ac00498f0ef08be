//! The benchmark against known truth.

use use3d_config::LoadOptions;
use use3d_lab::truth::bench::{TruthBench, TruthRequest};
use use3d_pipeline::by_hand::scratch;
use use3d_pipeline::destination::path_text;
use use3d_workflow::RunOptions;

use crate::App;
use crate::args::{Baselines, BenchTruthArgs};
use crate::error::{Done, WorkError};
use crate::output::json;
use crate::size::parse_size;
use crate::verbs::synth::keep_capture;

fn request(args: &BenchTruthArgs) -> Result<TruthRequest, WorkError> {
    Ok(TruthRequest {
        out: args.out.clone(),
        captures: args.captures.clone(),
        seeds: args.seeds.iter().map(|seed| u64::from(*seed)).collect(),
        views: args.views,
        size: parse_size(&args.size)?,
        iterations: args.iterations as u64,
        baselines: args.baselines == Baselines::All,
        methods: args.methods,
        load: LoadOptions {
            sets: args.settings.sets(),
            pairs: args.calibration.pairs(),
            calibrator: args.calibration.calibrator.clone(),
            ..args.cache.request(&args.out).options
        },
        rehash: args.cache.rehash,
    })
}

pub(crate) fn truth(app: &App, args: &BenchTruthArgs) -> Done {
    let bench = TruthBench::new(request(args)?)?;
    bench.check(scratch()?.path())?;
    for (params, folder) in bench.captures() {
        // Finished captures are kept.
        keep_capture(app, &params, &folder).map_err(|e| match e {
            WorkError::Stopped => WorkError::Interrupted,
            other => other,
        })?;
    }
    let options = RunOptions { jobs: args.jobs, ..app.host.options() };
    let (figures, delivered) = bench.run(options, &app.host.listener, !app.quiet)?;
    if args.json {
        json(&figures)?;
    } else if !app.quiet {
        for path in delivered {
            println!("{}", path_text(&path));
        }
    }
    match figures.failed.as_slice() {
        [] => Ok(()),
        failed => Err(WorkError::Failed(format!(
            "{}; the table is written without it; run the same command to try again",
            failed.join("; ")
        ))),
    }
}
