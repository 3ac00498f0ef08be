//! Depth priors by Depth Anything V2, where they are asked for (R14).

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_io_colmap::load_pixels;
use use3d_io_image::write_png_map16;

use super::common::capture;
use crate::engine::{AllParameters, Scope, Stage, StageContext, StageError};

/// Which network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub(super) enum Encoder {
    /// 25 M parameters.
    Vits,
    /// 97 M parameters.
    Vitb,
    /// 335 M parameters, the authors' default.
    #[default]
    Vitl,
}

/// Parameters of the depth priors.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(super) struct Params {
    /// Which network.
    pub(super) encoder: Encoder,
}

pub(super) fn stage() -> Stage {
    Stage::new("depth", Scope::Scene, run)
        .about("depth priors by Depth Anything V2")
        .made_of(&["use3d-nets", "use3d-io-colmap", "use3d-io-image"], &["src/stages/depth.rs"])
        .input("import", "import")
        .external("models", "models")
        .select(|parameters, models| {
            let params: Params = serde_json::from_value(parameters.clone()).map_err(|e| e.to_string())?;
            Ok(super::model_files(models, &[network(params.encoder)]))
        })
        .when(|all: &AllParameters| {
            all.get("reconstruct").is_some_and(|r| r["depth_prior"] == "depth-anything-v2")
        })
        .cost(0, 4 << 30)
}

fn network(encoder: Encoder) -> use3d_nets::Network {
    match encoder {
        Encoder::Vits => use3d_nets::Network::DepthAnythingV2Small,
        Encoder::Vitb => use3d_nets::Network::DepthAnythingV2Base,
        Encoder::Vitl => use3d_nets::Network::DepthAnythingV2Large,
    }
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let size = match params.encoder {
        Encoder::Vits => use3d_nets::DepthAnythingSize::Small,
        Encoder::Vitb => use3d_nets::DepthAnythingSize::Base,
        Encoder::Vitl => use3d_nets::DepthAnythingSize::Large,
    };
    let network = use3d_nets::Models::open(context.input("models")?).depth_anything_v2(size)?;
    let views: Vec<_> = capture.training_views().collect();
    for (i, view) in views.iter().enumerate() {
        context.alive()?;
        context.progress(i as u64, views.len() as u64, "views");
        let mut disparity = network.disparity(&load_pixels(view)?.to_image())?;
        // The scale is arbitrary; 16 bits of the range between the 1 % and 99 % quantiles, larger is nearer, 0 is unknown.
        let mut sorted: Vec<f32> =
            disparity.data().iter().copied().filter(|v| v.is_finite() && *v > 1e-8).collect();
        sorted.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| {
            sorted.get((sorted.len().saturating_sub(1) as f64 * share) as usize).copied().unwrap_or(0.0)
        };
        let (low, high) = (at(0.01), at(0.99));
        let scale = 1.0 / (high - low).max(1e-12);
        for v in disparity.data_mut() {
            *v = ((*v - low) * scale).clamp(0.0, 1.0);
        }
        write_png_map16(&context.output().join(format!("{}.png", view.flat_stem())), &disparity)?;
    }
    Ok(())
}
