//! The benchmark against known truth.

use use3d_lab::LabError;
use use3d_lab::truth::bench::{TruthBench, TruthRequest};
use use3d_pipeline::config::LoadOptions;
use use3d_workflow::RunOptions;

use crate::App;
use crate::args::{Baselines, BenchTruthArgs};
use crate::destination::path_text;
use crate::error::{CliError, Done};
use crate::output::json;
use crate::size::parse_size;
use crate::verbs::by_hand::scratch;
use crate::verbs::synth::keep_capture;

impl From<LabError> for CliError {
    fn from(error: LabError) -> Self {
        match error {
            LabError::Input(message) => Self::Input(message),
            LabError::Failed(message) => Self::Failed(message),
            LabError::Interrupted => Self::Interrupted,
        }
    }
}

fn request(args: &BenchTruthArgs) -> Result<TruthRequest, CliError> {
    Ok(TruthRequest {
        out: args.out.clone(),
        captures: args.captures.clone(),
        seeds: args.seeds.iter().map(|seed| u64::from(*seed)).collect(),
        views: args.views,
        size: parse_size(&args.size)?,
        iterations: args.iterations as u64,
        baselines: args.baselines == Baselines::All,
        load: LoadOptions {
            sets: args.settings.sets(),
            cache: args.cache.cache.clone(),
            models: args.cache.models.clone(),
            scenes: Vec::new(),
            pairs: args.calibration.pairs(),
            calibrator: args.calibration.calibrator.clone(),
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
            CliError::Stopped => CliError::Interrupted,
            other => other,
        })?;
    }
    let options =
        RunOptions { jobs: args.jobs, cores: app.threads, stop: app.stop.clone(), ..RunOptions::default() };
    let (figures, delivered) = bench.run(options, &app.listener, !app.quiet)?;
    if args.json {
        json(&figures)?;
    } else if !app.quiet {
        for path in delivered {
            println!("{}", path_text(&path));
        }
    }
    match figures.failed.as_slice() {
        [] => Ok(()),
        failed => Err(CliError::Failed(format!(
            "{}; the table is written without it; run the same command to try again",
            failed.join("; ")
        ))),
    }
}
