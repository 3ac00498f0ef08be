//! The held-out photographs in the light and colours of the enhanced scene, at the size of the training.
//!
//! The same photographs at full size are written by [`crate::photographs`], straight to the folder of
//! results.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, Image, View};
use use3d_import::load_pixels;
use use3d_io_image::write_png;
use use3d_photographs::Grid;
use use3d_render::Mode;
use use3d_scene::white::Gains;
use use3d_workflow::{StageContext, StageError};

use crate::engines::EngineChoice;
use crate::parts::appearance::Appearance;
use crate::parts::captured::capture;
use crate::parts::files::proposal_of;
use crate::parts::scene::{drawn, scene};

/// Parameters of the enhanced photographs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Params {
    /// Share of each photograph's own exposure, white balance and light that stays, 0 (the light of the
    /// scene) to 1.
    pub(crate) keep_light: f32,
}

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_numerics::range::within;
    use use3d_workflow::{Scope, Stage};

    use crate::parts::files::out_of_range;
    use crate::planning::learns_from_proposals;
    use crate::planning::memory::{PROGRAM, gaussians, largest};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("photographs", Scope::Scene, run)
            .about("correct the colours of the photographs that were kept back")
            .delivers("photographs-held-out")
            .check(|p: &Params| within("keep_light", p.keep_light, 0.0, 1.0).map_err(out_of_range))
            .when(|all| !learns_from_proposals(all))
            .input("import", "import")
            .input("enhanced", "enhance")
            .usually_costs(1.5, 0.0)
            .cost(0, 1 << 30)
            .memory(|_: &Params, inputs| Some(PROGRAM + 900 * largest(inputs)? + 600 * gaussians(inputs)?))
    }
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let scene = scene(context, "enhanced")?;
    let shown = drawn(context, &scene, &EngineChoice::Cpu)?;
    let appearance = Appearance {
        mode: Mode::opening(&scene),
        strength: 1.0,
        water: 1.0,
        gains: Gains::ONE,
        keep_light: params.keep_light,
    };
    let training: Vec<Camera> = capture.training_views().map(|view| view.camera).collect();
    let mut photographer = appearance.photographer(&shown, &training)?;
    // Without held-out views, one training view is shown, as in `render`.
    let views: Vec<(&View, Option<usize>)> = if capture.split.test.is_empty() {
        capture.training_views().take(1).map(|view| (view, Some(0))).collect()
    } else {
        capture.test_views().map(|view| (view, None)).collect()
    };
    for (i, (view, own)) in views.iter().enumerate() {
        context.alive()?;
        context.progress_with(i as u64, views.len() as u64, "views", &view.name);
        let photograph = load_pixels(view)?.to_image();
        let graded = photographer.grade(&photograph, &Grid::pinhole(view.camera), *own, None);
        let graded = graded.map_err(StageError::failed)?;
        let (w, h) = (photograph.width(), photograph.height());
        let mut pixels = photograph.to_interleaved();
        graded.grade.map.apply(&mut pixels, w);
        let image = Image::from_interleaved(w, h, &pixels).unwrap_or(photograph);
        write_png(&proposal_of(context.output(), view), &image)?;
    }
    Ok(())
}
