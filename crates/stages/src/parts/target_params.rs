//! The parameters of the targets, which the requirements of other stages look at, too.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_atc::consensus::TargetsParams;

use super::kept_water::KeptWaterChoice;
use super::proposer::ProposerChoice;
use crate::engines::EngineChoice;

/// The pictures that transitions start from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Source {
    /// The photographs, as in the paper.
    Photographs,
    /// Stage 1's renders with part of the water taken away; the photographs where all of it is kept.
    #[default]
    Renders,
    /// Stage 1's renders without water, to measure colour: `enhanced-clear` is then the result.
    Clear,
}

/// Parameters of the targets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Params {
    /// The proposer. `auto` is the one that the calibrator was fitted for (another one is refused), or
    /// without a calibrator as in `pairs`.
    pub(crate) proposer: ProposerChoice,
    /// The pictures that transitions start from.
    pub(crate) source: Source,
    /// The share of the water in renders that transitions start from, which the enhanced scene then keeps:
    /// `"auto"`, one number from 0 to 1, or three (red, green, blue). For `source = "renders"`.
    pub(crate) kept_water: KeptWaterChoice,
    /// Correct the proposals with a calibrator that was fitted to pairs of images. On as soon as the pipeline
    /// names pairs, a calibrator or a parameter of its fit.
    pub(crate) calibrated: bool,
    /// Parameters of the consensus.
    pub(crate) consensus: TargetsParams,
    /// Number of views shown side by side: captured (or clear), proposal, calibrated on its own, consensus.
    pub(crate) previews: usize,
    /// The engine that lifts views to the Gaussians: `cpu`; `auto` (a graphics card that passed its check,
    /// else the processor); `gpu`; `gpu:NAME`.
    #[schemars(with = "String")]
    pub(crate) engine: EngineChoice,
}

impl Default for Params {
    fn default() -> Self {
        Self {
            proposer: ProposerChoice::Auto,
            source: Source::default(),
            kept_water: KeptWaterChoice::default(),
            calibrated: false,
            consensus: TargetsParams::default(),
            previews: 4,
            engine: EngineChoice::Cpu,
        }
    }
}

impl Params {
    /// The problem of parameters that contradict each other, and the setting that solves it.
    pub(crate) fn conflict(&self) -> Option<(&'static str, &'static str)> {
        if self.source != Source::Renders && self.kept_water != KeptWaterChoice::default() {
            let problem = "`kept_water` is the share of the water in renders; add `source = \"renders\"`";
            return Some((problem, "--set targets.source=renders"));
        }
        None
    }
}
