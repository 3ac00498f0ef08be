//! Synthetic data with known truth.

use std::ops::ControlFlow;
use std::path::Path;

use serde::de::DeserializeOwned;
use use3d_pipeline::destination::put_folder;
use use3d_stages::code::built_in;
use use3d_synth::{
    CaptureParams, Development, Location, Optics, PairsParams, Physics, SynthError, WaterType, write_capture,
    write_faulty_capture, write_pairs,
};
use use3d_workflow::Digest;
use use3d_workflow::place::{self, Look, Standing};

use crate::App;
use crate::args::{SynthCaptureArgs, SynthPairsArgs};
use crate::error::{Done, WorkError};
use crate::interrupt::{self, ends_soon};
use crate::size::parse_size;

/// Reports the progress, and returns whether to continue.
fn tell<'a>(app: &'a App, label: &'a str) -> impl FnMut(usize, usize) -> ControlFlow<()> + 'a {
    move |done, total| {
        app.host.progress(label, done as u64, total as u64, "images", "");
        if done == total {
            app.host.over(label);
        }
        interrupt::go_on()
    }
}

/// Converts an error to a message for the user.
fn error(error: SynthError) -> WorkError {
    match error {
        SynthError::Interrupted => WorkError::Stopped,
        SynthError::Parameter(wrong) => {
            let flag = match wrong.path.as_str() {
                "pairs" => "views".to_string(),
                "width" | "height" => format!("size: {}", wrong.path),
                "air" => "water air".to_string(),
                parameter => parameter.replace('_', "-"),
            };
            WorkError::Input(format!("--{flag} {}", wrong.words()))
        }
        SynthError::OutputExists { .. } => WorkError::input(error),
        SynthError::Io { .. } | SynthError::Name(_) | SynthError::Image(_) | SynthError::Model(_) => {
            WorkError::failed(error)
        }
    }
}

/// Parses a value of an enumeration by its name in parameter files, in any letter case.
fn named<T: DeserializeOwned>(flag: &str, text: &str, known: &[&str]) -> Result<T, WorkError> {
    let exact = known.iter().find(|k| k.eq_ignore_ascii_case(text)).copied().unwrap_or(text);
    serde_json::from_value(exact.into())
        .map_err(|_| WorkError::Input(format!("{flag} {text}: expected one of {}", known.join(", "))))
}

/// The parameters from the arguments, on top of the defaults.
fn capture_params(args: &SynthCaptureArgs) -> Result<CaptureParams, WorkError> {
    let common = &args.common;
    let physics = named("--physics", &args.physics, &Physics::ALL.map(Physics::name))?;
    let place = named("--place", &args.place, &Location::ALL.map(Location::name))?;
    let camera = named("--camera", &args.camera, &Development::ALL.map(Development::name))?;
    let lens = named("--lens", &args.lens, &Optics::ALL.map(Optics::name))?;
    let mut params = CaptureParams {
        seed: common.seed,
        place,
        physics,
        camera,
        lens,
        greys: args.greys,
        ..CaptureParams::default()
    };
    if physics == Physics::Spectral {
        // The usual behaviour of cameras under water with automatic settings.
        (params.auto_exposure, params.white_balance) = (1.0, 0.5);
    }
    params.views = common.views.unwrap_or(params.views);
    if let Some(size) = &common.size {
        (params.width, params.height) = parse_size(size)?;
    }
    match args.water.as_deref() {
        Some(air) if air.eq_ignore_ascii_case("air") => params.air = true,
        Some(water) => params.water = named("--water", water, &WaterType::ALL.map(WaterType::name))?,
        None => {}
    }
    params.depth = args.depth.unwrap_or(params.depth);
    params.white_balance = args.white_balance.unwrap_or(params.white_balance);
    params.noise = args.noise.unwrap_or(params.noise);
    params.auto_exposure = args.auto_exposure.unwrap_or(params.auto_exposure);
    params.lamps = args.lamps.unwrap_or(params.lamps);
    params.snow = args.snow.unwrap_or(params.snow);
    params.backlight = args.backlight.unwrap_or(params.backlight);
    params.fish = args.fish.unwrap_or(params.fish);
    params.depth_priors = !args.no_depth_priors;
    Ok(params)
}

/// Makes a capture at `out`, unless one with the same parameters and code exists there; another result of
/// this program is replaced.
pub(crate) fn keep_capture(app: &App, params: &CaptureParams, out: &Path) -> Done {
    let code = built_in().stage(&["use3d-synth"], &[]).map_err(WorkError::failed)?.digest();
    let recipe = serde_json::json!({ "parameters": params, "code": code.to_string() });
    let recipe = Digest::of(recipe.to_string().as_bytes());
    place::check(out, true)?;
    let there = place::look(out, Look::Quick)?;
    if matches!(there, Standing::Ours(ours) if ours.whole && ours.key == Some(recipe)) {
        return Ok(());
    }
    let folder = place::parent(out);
    place::check_writable(folder)?;
    std::fs::create_dir_all(folder)
        .map_err(|e| WorkError::Input(format!("--out {}: {e}", folder.display())))?;
    let _ends_soon = ends_soon();
    put_folder(out, Some(recipe), true, |made| {
        write_capture(params, made, &mut tell(app, "synth capture")).map(drop).map_err(error)
    })
}

pub(crate) fn capture(app: &App, args: &SynthCaptureArgs) -> Done {
    let (params, out) = (capture_params(args)?, &args.common.out);
    let _ends_soon = ends_soon();
    write_faulty_capture(&params, args.fault, out, &mut tell(app, "synth capture")).map_err(error)?;
    remark!(app, "{}: {} views of {}x{}", out.display(), params.views, params.width, params.height);
    Ok(())
}

pub(crate) fn pairs(app: &App, args: &SynthPairsArgs) -> Done {
    let physics = named("--physics", &args.physics, &Physics::ALL.map(Physics::name))?;
    let args = &args.common;
    let mut params = PairsParams { seed: args.seed, physics, ..PairsParams::default() };
    params.pairs = args.views.unwrap_or(params.pairs);
    if let Some(size) = &args.size {
        (params.width, params.height) = parse_size(size)?;
    }
    let _ends_soon = ends_soon();
    write_pairs(&params, &args.out, &mut tell(app, "synth pairs")).map_err(error)?;
    remark!(app, "{}: {} pairs of {}x{}", args.out.display(), params.pairs, params.width, params.height);
    Ok(())
}
