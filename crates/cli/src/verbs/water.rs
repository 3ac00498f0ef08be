//! What water a capture was taken in, before anything is reconstructed.

use use3d_import::{capture_name, load_prepared};
use use3d_pipeline::water::{WaterReport, from_tracks};
use use3d_water::WaterParams;

use crate::App;
use crate::args::WaterArgs;
use crate::error::{CliError, Done};
use crate::interrupt::ends_soon;
use crate::verbs::stages::{imported, parameters, scratch, stages};

pub(crate) fn run(app: &App, args: &WaterArgs) -> Done {
    let _ends_soon = ends_soon();
    let registry = stages()?;
    let parameters = parameters(&registry, &["import"], &args.settings.set)?;
    let scratch = scratch()?;
    let folder = imported(app, &registry, &args.capture, &parameters[0], scratch.path())?;
    let capture = load_prepared(&folder).map_err(CliError::input)?;
    let water = from_tracks(&capture, &WaterParams::default()).map_err(CliError::input)?;
    // An import does not keep the name, since equal captures give equal bytes.
    let report = WaterReport { capture: capture_name(&args.capture), ..WaterReport::new(&capture, &water) };
    if args.json {
        return crate::verbs::run::json(&report);
    }
    print!("{report}");
    Ok(())
}
