//! The held-out views as pictures: captured, reconstruction, clear, enhanced (or enhanced-clear), depth, and
//! the water's maps.

use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::Raster;
use use3d_import::load_pixels;
use use3d_io_image::{read_image, read_map, write_exr_map, write_png, write_png8};
use use3d_render::{Mode, Rendering, picture};
use use3d_workflow::{AlikeFiles, StageContext, StageError};

use crate::engines::EngineChoice;
use crate::parts::captured::capture;
use crate::parts::files::folder;
use crate::parts::scene::{drawn, shown_scene};

/// The largest difference between two drawings of one scene in two classes of arithmetic: the last bits of a
/// kernel's results, and occasionally a pixel on an edge.
const ALIKE: [AlikeFiles; 2] = [
    AlikeFiles { ending: ".png", distance: apart, unit: "in the mean of display values", within: 1e-3 },
    AlikeFiles { ending: ".exr", distance: depths_apart, unit: "of the mean depth", within: 1e-3 },
];

/// Parameters of the pictures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Params {
    /// Strength of the enhancement that is shown, 0 to 1.
    pub(crate) strength: f32,
    /// Share of the water left in `reconstruction` and `enhanced`, 0 (none: they are `clear` and
    /// `enhanced-clear`) to 1.
    pub(crate) water: f32,
    /// Also write depth as EXR, in normalised scene units.
    pub(crate) depth_exr: bool,
    /// The engine that draws: `cpu`; `auto` (a graphics card that passed its check, else the processor);
    /// `gpu`; `gpu:NAME`.
    #[schemars(with = "String")]
    pub(crate) engine: EngineChoice,
}

impl Default for Params {
    fn default() -> Self {
        Self { strength: 1.0, water: 1.0, depth_exr: true, engine: EngineChoice::Cpu }
    }
}

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_numerics::range::within;
    use use3d_workflow::{Scope, Stage};

    use crate::engines;
    use crate::parts::files::out_of_range;
    use crate::planning::memory::{PROGRAM, gaussians, largest};

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("render", Scope::Scene, run)
            .about("draw the scene as seen from the photographs that were kept back")
            .promises(&["captured/"])
            .delivers("renders")
            .check(|p: &Params| within("strength", p.strength, 0.0, 1.0).map_err(out_of_range))
            .check(|p: &Params| within("water", p.water, 0.0, 1.0).map_err(out_of_range))
            .computes_on("engine", |p: &Params| engines::asked(&p.engine), |p| engines::class(&p.engine))
            .files_agree_across_classes(&ALIKE)
            .without_effect(&["engine"])
            .input("import", "import")
            .input("scene", "reconstruct")
            .optional_input("enhanced", "enhance")
            .cost(0, 1 << 30)
            .memory(|_: &Params, inputs| Some(PROGRAM + 270 * largest(inputs)? + 600 * gaussians(inputs)?))
    }
}

/// The mean absolute difference of two pictures, in display range.
fn apart(a: &Path, b: &Path) -> Result<f64, StageError> {
    difference(&read_image(a)?, &read_image(b)?)
}

/// The mean absolute difference of two depth maps over the mean of the first.
fn depths_apart(a: &Path, b: &Path) -> Result<f64, StageError> {
    let (a, b) = (read_map(a)?, read_map(b)?);
    // Both means are 0 if the maps show nothing.
    Ok(difference(&a, &b)? / mean(a.data().iter().map(|v| f64::from(v.abs()))).max(f64::MIN_POSITIVE))
}

/// The mean absolute difference of the values of two rasters of one size.
fn difference<const C: usize>(a: &Raster<f32, C>, b: &Raster<f32, C>) -> Result<f64, StageError> {
    let [made, again] = [a, b].map(|raster| format!("{} by {}", raster.width(), raster.height()));
    if made != again {
        return Err(StageError::message(format!("{made} pixels, and again {again}")));
    }
    Ok(mean(a.data().iter().zip(b.data()).map(|(a, b)| f64::from((a - b).abs()))))
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> f64 {
    let count = values.len().max(1);
    values.sum::<f64>() / count as f64
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let scene = shown_scene(context)?;
    let drawn = drawn(context, &scene, &params.engine)?;
    let mut renderer = drawn.renderer(params.strength)?.with_water(params.water)?;
    let mut modes = vec![Mode::Reconstruction, Mode::Clear, Mode::Depth];
    if renderer.is_enhanced() {
        let looks = [Mode::Enhanced, Mode::EnhancedClear];
        modes.extend(looks.into_iter().filter(|mode| !mode.is_too_strong(&scene)));
    }
    if !scene.medium.is_none() {
        modes.extend([Mode::Medium, Mode::Backscatter, Mode::Attenuation]);
    }
    let out = context.output();
    for name in modes.iter().map(|m| m.name()).chain(["captured"]) {
        folder(&out.join(name))?;
    }
    // Without held-out views, one training view is drawn.
    let views: Vec<_> = if capture.split.test.is_empty() {
        capture.training_views().take(1).collect()
    } else {
        capture.test_views().collect()
    };
    for (i, view) in views.iter().enumerate() {
        context.alive()?;
        context.progress(i as u64, views.len() as u64, "views");
        let stem = view.flat_stem();
        let file = |folder: &str| out.join(folder).join(format!("{stem}.png"));
        write_png8(&file("captured"), &load_pixels(view)?.to_image().to_8bit())?;
        for (mode, frame) in modes.iter().zip(renderer.render(&view.camera, &modes)?) {
            write_png(&file(mode.name()), &picture(*mode, &frame))?;
            if let (Rendering::Scalar(map), true) = (&frame, params.depth_exr) {
                write_exr_map(&out.join(mode.name()).join(format!("{stem}.exr")), map, "Z")?;
            }
        }
    }
    Ok(())
}
