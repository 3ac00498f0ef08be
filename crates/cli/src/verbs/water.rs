//! Estimates the water of a capture before anything is reconstructed.

use use3d_import::{capture_name, load_prepared};
use use3d_stages::water::{WaterReport, from_tracks};
use use3d_water::WaterParams;

use crate::App;
use crate::args::WaterArgs;
use crate::error::{CliError, Done};
use crate::interrupt;
use crate::output::show;
use crate::verbs::by_hand::{ByHand, scratch};

pub(crate) fn run(app: &App, args: &WaterArgs) -> Done {
    let hand = ByHand {
        flags: args.size.spelled(),
        sets: args.settings.set.clone(),
        ..ByHand::import_of(&args.capture)
    };
    let scratch = scratch()?;
    let folder = hand.imported(app, scratch.path(), None, false)?;
    let capture = load_prepared(&folder).map_err(CliError::input)?;
    let (capture, water) = interrupt::unless_stopped(move || {
        let water = from_tracks(&folder, &capture, &WaterParams::default());
        (capture, water)
    })?;
    let (water, judgement) = water.map_err(CliError::input)?;
    // An import does not store the name, because equal captures must give equal bytes.
    let name = capture_name(&args.capture);
    let report = WaterReport { capture: name, ..WaterReport::new(&capture, &water, judgement) };
    show(&report, args.json)
}
