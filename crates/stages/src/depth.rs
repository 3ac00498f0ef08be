//! Depth priors by Depth Anything V2 (R14). They are made if the parameters request them; with `auto`, if the
//! capture has none of its own and the weights are in the models folder.

use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_import::load_pixels;
use use3d_io_image::write_png_map16;
use use3d_nets::{DepthAnythingSize, Models, Network};
use use3d_numerics::order::Ascending;
use use3d_workflow::{StageContext, StageError};

use crate::parts::captured::capture;
use crate::parts::weights::MissingWeights;

/// The size of the network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Encoder {
    /// The largest whose weights are in the models folder; the run reports the choice.
    #[default]
    Auto,
    /// 25 M parameters.
    Vits,
    /// 97 M parameters.
    Vitb,
    /// 335 M parameters, the authors' choice.
    Vitl,
}

impl Encoder {
    /// The networks that fit this choice, the best first.
    fn candidates(self) -> &'static [(Network, DepthAnythingSize)] {
        const ALL: [(Network, DepthAnythingSize); 3] = [
            (Network::DepthAnythingV2Large, DepthAnythingSize::Large),
            (Network::DepthAnythingV2Base, DepthAnythingSize::Base),
            (Network::DepthAnythingV2Small, DepthAnythingSize::Small),
        ];
        match self {
            Self::Auto => &ALL,
            Self::Vitl => &ALL[..1],
            Self::Vitb => &ALL[1..2],
            Self::Vits => &ALL[2..],
        }
    }

    fn networks(self) -> Vec<Network> {
        self.candidates().iter().map(|(network, _)| *network).collect()
    }

    /// The best network whose weights are in the models folder.
    fn found(self, models: &Path) -> Result<(Network, DepthAnythingSize), MissingWeights> {
        let folder = Models::open(models);
        let found = self.candidates().iter().find(|(network, _)| folder.has(*network));
        let missing = || MissingWeights::new("Depth Anything V2", &self.networks(), models);
        found.copied().ok_or_else(missing)
    }
}

/// Parameters of the depth priors.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Params {
    /// The size of the network.
    pub(crate) encoder: Encoder,
}

/// The stage in the table; no part of its key.
pub(crate) mod definition {
    use use3d_import::{ImportParams, has_depth_folder};
    use use3d_reconstruct::{DepthPrior, ReconstructParams};
    use use3d_workflow::{AllParameters, Lacking, Named, Scope, Stage, StageInput};

    use crate::parts::weights::model_files;
    use crate::planning::expected::of_depth;
    use crate::planning::memory::{PROGRAM, heaviest, input, largest};
    use crate::planning::requirements::network;

    use super::*;

    pub(crate) fn stage() -> Stage {
        Stage::new("depth", Scope::Scene, run)
            .about("estimate depth maps by Depth Anything V2")
            .input("import", "import")
            .external("models", "models")
            .select(|p: &Params, models| Ok(model_files(models, &[p.encoder.found(models)?.0])))
            .when_named(asked_for)
            .requires(|all, named, _| missing(all, named).into_iter().collect())
            .expects(of_depth)
            .cost(0, 4 << 30)
            .memory(|_: &Params, inputs| memory(inputs))
    }

    /// True if a scene's priors are to be made: if the parameters request them; with `auto`, if the weights
    /// are in the models folder and the capture has no priors of its own.
    fn asked_for(all: &AllParameters, named: &Named) -> bool {
        match all.of::<ReconstructParams>().map(|p| p.depth_prior) {
            Some(DepthPrior::DepthAnythingV2) => true,
            Some(DepthPrior::Auto) => {
                let encoder = all.of::<Params>().map_or(Encoder::Auto, |p| p.encoder);
                let has_own =
                    || match (named.path("capture").or(named.path("footage")), all.of::<ImportParams>()) {
                        (Some(capture), Some(import)) => has_depth_folder(capture, import),
                        _ => true,
                    };
                // The capture is not looked at without need: a large batch has many.
                named.path("models").is_some_and(|models| encoder.found(models).is_ok()) && !has_own()
            }
            _ => false,
        }
    }

    /// The network's weights if the parameters request priors and the weights are missing.
    fn missing(all: &AllParameters, named: &Named) -> Option<Lacking> {
        let asked = all.of::<ReconstructParams>()?.depth_prior == DepthPrior::DepthAnythingV2;
        let what = "the weights of Depth Anything V2, the depth prior of the paper";
        let networks = all.of::<Params>()?.encoder.networks();
        asked.then(|| network(named, what, &networks, "--set reconstruct.depth_prior=off"))?
    }

    fn memory(inputs: &[StageInput]) -> Option<u64> {
        let weights = input(inputs, "models").map_or(0, heaviest);
        Some(PROGRAM + 110 * largest(inputs)? + weights * 14 / 10 + (128 << 20))
    }
}

fn run(context: &StageContext, params: &Params) -> Result<(), StageError> {
    let capture = capture(context)?;
    let models = context.input("models")?;
    let (network, size) = params.encoder.found(models)?;
    context.say(format_args!("depth priors by {}", network.known().title));
    let network = Models::open(models).depth_anything_v2(size)?;
    let views: Vec<_> = capture.training_views().collect();
    for (i, view) in views.iter().enumerate() {
        context.alive()?;
        context.progress(i as u64, views.len() as u64, "views");
        let mut disparity = network.disparity(&load_pixels(view)?.to_image())?;
        // The scale is arbitrary: the range between the 1 % and 99 % quantiles is stored in 16 bits. Larger
        // is nearer, 0 is unknown.
        let known = disparity.data().iter().copied().filter(|v| v.is_finite() && *v > 1e-8);
        let known = Ascending::of(known);
        let [low, high] = [0.01, 0.99].map(|share| known.below(share).unwrap_or(0.0));
        let scale = 1.0 / (high - low).max(1e-12);
        for v in disparity.data_mut() {
            *v = ((*v - low) * scale).clamp(0.0, 1.0);
        }
        write_png_map16(&context.output().join(format!("{}.png", view.flat_stem())), &disparity)?;
    }
    Ok(())
}
