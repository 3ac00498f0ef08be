//! Estimates the water of a capture before anything is reconstructed.

use use3d_import::{capture_name, load_prepared};
use use3d_stages::water::{WaterReport, from_tracks};
use use3d_water::WaterParams;

use use3d_pipeline::by_hand::{ByHand, scratch};

use crate::App;
use crate::args::WaterArgs;
use crate::error::{Done, WorkError};
use crate::interrupt;
use crate::output::show;

pub(crate) fn run(app: &App, args: &WaterArgs) -> Done {
    let hand = ByHand {
        flags: args.settings.spelled(args.size.spelled()),
        options: args.settings.options(None),
        ..ByHand::import_of(&args.capture)
    };
    let scratch = scratch()?;
    let folder = hand.imported(&app.host, scratch.path(), None, false)?;
    let capture = load_prepared(&folder).map_err(WorkError::input)?;
    let (capture, water) = interrupt::unless_stopped(move || {
        let water = from_tracks(&folder, &capture, &WaterParams::default());
        (capture, water)
    })?;
    let (water, judgement) = water.map_err(WorkError::input)?;
    // An import does not store the name, because equal captures must give equal bytes.
    let name = capture_name(&args.capture);
    let report = WaterReport { capture: name, ..WaterReport::new(&capture, &water, judgement) };
    show(&report, args.json)
}
