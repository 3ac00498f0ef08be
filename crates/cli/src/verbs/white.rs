//! The white balance of a scene: `--white` of every verb that shows one, and the balance beside it.

use std::path::Path;

use use3d_pipeline::destination::{path_text, word};
use use3d_pipeline::white::{self, WhiteChoice, measured};
use use3d_scene::{Scene, White};

use crate::App;
use crate::args::WhiteArgs;
use crate::error::{Done, WorkError};

/// The white balance with which a verb shows a scene: from `--white`, or the stored one.
pub(crate) fn of(
    app: &App,
    args: &WhiteArgs,
    folder: &Path,
    scene: &Scene,
    cameras: Option<&Path>,
) -> Result<Option<White>, WorkError> {
    if !args.choices.is_empty() {
        let white = measured(&args.choices, scene, cameras)?;
        white.iter().for_each(|white| tell(app, white, scene));
        return Ok(white);
    }
    let Some(white) = White::beside(folder).map_err(WorkError::input)? else { return Ok(None) };
    let place = path_text(&White::place(folder));
    if white.is_outdated(folder) {
        eprintln!(
            "{place} was measured in an earlier scene and is left out; measure it again with `use3d white {}`",
            word(folder)
        );
        return Ok(None);
    }
    remark!(app, "white balance: {place} (--white off leaves the colours unchanged)");
    Ok(Some(white))
}

/// Prints the effect of a white balance, and its range.
pub(crate) fn tell(app: &App, white: &White, scene: &Scene) {
    white::lines(white, scene).iter().for_each(|line| remark!(app, "{line}"));
}

/// Measures a scene of a run, and stores the result beside it.
pub(crate) fn keep_for(app: &App, choices: &[WhiteChoice], folder: &Path, capture: &Path) -> Done {
    let scene = Scene::load(folder).map_err(WorkError::input)?;
    let white = measured(choices, &scene, Some(capture))?;
    keep(app, white.as_ref(), folder)?;
    white.iter().for_each(|white| tell(app, white, &scene));
    Ok(())
}

/// Stores a white balance beside a scene, or removes the stored one.
pub(crate) fn keep(app: &App, white: Option<&White>, folder: &Path) -> Done {
    if let (Some(earlier), Some(_)) = (white::keep(white, folder)?, white) {
        remark!(app, "the earlier white balance by {} is replaced", earlier.method.name());
    }
    Ok(())
}
