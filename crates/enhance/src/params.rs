//! The user's parameters of stage 2.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::range::{OutOfRange, at_least, not_negative, within};
use use3d_training::EngineChoice;
use use3d_ubaf::{FieldError, Shape};

/// The guidance from which stage 2 learns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Objective {
    /// Scene-global and Gaussian-local transition targets: the method.
    #[default]
    Full,
    /// The global term alone (ablation).
    GlobalOnly,
    /// The local term alone (ablation).
    LocalOnly,
    /// The proposer's images, view by view, as colours to reproduce: the baseline with which the method is
    /// compared.
    PseudoLabels,
}

/// The measure by which a rendered image is compared with a pseudo-label.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PixelLoss {
    /// Mean absolute difference.
    #[default]
    L1,
    /// Mean squared difference.
    L2,
}

/// The start of the field.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Start {
    /// At the identity, as in the paper.
    Identity,
    /// With the scene's affine at the global target. An image is linear in its colours, so the global
    /// target is nearly reached at once. The field's local part does not have to learn it first and unlearn
    /// it later. Without a global term the same as `identity`.
    #[default]
    Operator,
}

/// Parameters of stage 2. The defaults are the paper's except for a fifth of its steps, the start, and the
/// sampling (`sample_side`, `centre_sample`).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EnhanceParams {
    /// Optimisation steps, one view each.
    pub iterations: u64,
    /// The guidance to learn from.
    pub objective: Objective,
    /// The start of the field.
    pub start: Start,
    /// Weight λ_g of the global term.
    pub lambda_global: f64,
    /// Weight λ_ℓ of the local term.
    pub lambda_local: f64,
    /// Weight λ_tv of the factors' total variation.
    pub lambda_variation: f64,
    /// In a step, a training view is sampled at its nearest pixels to at most this long side; 0 renders all
    /// that the extractor weighs. The distance from the targets is always measured as the extractor reads
    /// an image.
    pub sample_side: usize,
    /// The field's constant mode is the mean over at most this many Gaussians, evenly chosen from all (0:
    /// over all). A step looks the field up at these and at the Gaussians that its view sees.
    pub centre_sample: usize,
    /// The measure by which pseudo-labels are compared (objective `pseudo-labels` only).
    pub pixel_loss: PixelLoss,
    /// Nodes per axis of the field, 2 to 256.
    pub resolution: usize,
    /// Rank of the field, 1 to 16.
    pub rank: usize,
    /// Hidden width of the decoder, 1 to 1024.
    pub width: usize,
    /// Adam's constant learning rate of the field.
    pub learning_rate: f64,
    /// Adam's constant learning rate of the two transport ratios.
    pub transport_learning_rate: f64,
    /// Seed of the field's start and of the order of views. Not read from settings: the caller sets it.
    #[serde(skip)]
    pub seed: u64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Number of steps over which one line of the log averages.
    pub log_every: u64,
    /// Memory for the constants of views, MiB. Views beyond it are prepared again in every step that uses
    /// them.
    pub cache_mib: usize,
    /// The device that computes: `cpu`, `gpu` (the best graphics card), `gpu:NAME` (any part of an
    /// adapter's name), or `auto`: a graphics card that passes its check, else the processor. Results of
    /// different devices are kept apart.
    #[schemars(with = "String")]
    pub engine: EngineChoice,
}

impl Default for EnhanceParams {
    fn default() -> Self {
        let shape = Shape::default();
        Self {
            iterations: 1000,
            objective: Objective::Full,
            start: Start::Operator,
            lambda_global: 1.0,
            lambda_local: 1.0,
            lambda_variation: 1e-4,
            sample_side: 96,
            centre_sample: 4096,
            pixel_loss: PixelLoss::L1,
            resolution: shape.resolution,
            rank: shape.rank,
            width: shape.width,
            learning_rate: 1e-3,
            transport_learning_rate: 2e-4,
            seed: 42,
            checkpoint_every: 500,
            log_every: 50,
            cache_mib: 2048,
            engine: EngineChoice::Cpu,
        }
    }
}

impl EnhanceParams {
    /// The field's sizes.
    pub fn shape(&self) -> Shape {
        Shape { resolution: self.resolution, rank: self.rank, width: self.width }
    }

    /// `(λ_g, λ_ℓ)` after the ablation switch.
    pub fn transition_weights(&self) -> (f64, f64) {
        match self.objective {
            Objective::Full => (self.lambda_global, self.lambda_local),
            Objective::GlobalOnly => (self.lambda_global, 0.0),
            Objective::LocalOnly => (0.0, self.lambda_local),
            Objective::PseudoLabels => (0.0, 0.0),
        }
    }

    /// Checks every range; the error has the first bad parameter's path.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        const MOST_STEPS: u64 = 200_000_000;
        match self.shape().validate() {
            Err(FieldError::Size { what, value, low, high }) => within(what, value, low, high)?,
            Err(other) => return Err(OutOfRange::new("resolution", self.resolution, other.to_string())),
            Ok(()) => {}
        }
        not_negative("lambda_global", self.lambda_global)?;
        not_negative("lambda_local", self.lambda_local)?;
        not_negative("lambda_variation", self.lambda_variation)?;
        for (path, value) in
            [("learning_rate", self.learning_rate), ("transport_learning_rate", self.transport_learning_rate)]
        {
            if !(value > 0.0 && value <= 1.0) {
                return Err(OutOfRange::new(path, value, "above 0, at most 1"));
            }
        }
        if !(self.sample_side == 0 || (8..=8192).contains(&self.sample_side)) {
            return Err(OutOfRange::new("sample_side", self.sample_side, "0, or 8 to 8192 pixels"));
        }
        within("iterations", self.iterations, 0, MOST_STEPS)?;
        at_least("checkpoint_every", self.checkpoint_every, 1)?;
        at_least("log_every", self.log_every, 1)
    }
}
