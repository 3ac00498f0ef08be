//! Synthetic data with known truth.

use std::ops::ControlFlow;

use serde::de::DeserializeOwned;
use use3d_pipeline::engine::Event;
use use3d_synth::{CaptureParams, PairsParams, SynthError, write_capture, write_pairs};

use crate::App;
use crate::args::SynthArgs;
use crate::error::{CliError, Done};
use crate::interrupt;
use crate::size::parse_size;

/// Draws the progress, and answers whether to go on.
pub(crate) fn tell<'a>(app: &'a App, label: &'a str) -> impl FnMut(usize, usize) -> ControlFlow<()> + 'a {
    move |done, total| {
        let (done, total) = (done as u64, total as u64);
        app.listener.event(&Event::Progress {
            node: 0,
            label,
            done,
            total,
            unit: "images",
            message: "",
            seconds_left: None,
        });
        if done == total {
            app.listener.event(&Event::Done { node: 0, label, cached: true, seconds: 0.0 });
        }
        interrupt::go_on()
    }
}

/// What a person reads of it.
pub(crate) fn error(error: SynthError) -> CliError {
    match error {
        SynthError::Interrupted => CliError::Stopped,
        SynthError::Parameter { .. } | SynthError::OutputExists { .. } => CliError::input(error),
        SynthError::Io { .. } | SynthError::Image(_) | SynthError::Model(_) => CliError::failed(error),
    }
}

/// A value of an enumeration by its name in parameter files, in any letter case.
fn named<T: DeserializeOwned>(flag: &str, text: &str, known: &[&str]) -> Result<T, CliError> {
    let exact = known.iter().find(|k| k.eq_ignore_ascii_case(text)).copied().unwrap_or(text);
    serde_json::from_value(exact.into())
        .map_err(|_| CliError::Input(format!("{flag} {text}: expected one of {}", known.join(", "))))
}

pub(crate) fn capture(app: &App, args: &SynthArgs) -> Done {
    let mut params = CaptureParams { seed: args.seed, ..CaptureParams::default() };
    if let Some(views) = args.views {
        params.views = views;
    }
    if let Some(size) = &args.size {
        (params.width, params.height) = parse_size(size)?;
    }
    if let Some(water) = &args.water {
        params.water =
            named("--water", water, &use3d_synth::WaterType::ALL.map(use3d_synth::WaterType::name))?;
    }
    write_capture(&params, &args.out, &mut tell(app, "synth capture")).map_err(error)?;
    eprintln!("{}: {} views of {}x{}", args.out.display(), params.views, params.width, params.height);
    Ok(())
}

pub(crate) fn pairs(app: &App, args: &SynthArgs) -> Done {
    let mut params = PairsParams { seed: args.seed, ..PairsParams::default() };
    if let Some(pairs) = args.views {
        params.pairs = pairs;
    }
    if let Some(size) = &args.size {
        (params.width, params.height) = parse_size(size)?;
    }
    if args.water.is_some() {
        return Err(CliError::Input("--water: pairs are made over all water types; leave it out".into()));
    }
    write_pairs(&params, &args.out, &mut tell(app, "synth pairs")).map_err(error)?;
    eprintln!("{}: {} pairs of {}x{}", args.out.display(), params.pairs, params.width, params.height);
    Ok(())
}
