//! Parameters of SeaSplat: the weights of its priors on water, colours and background, and its turns.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::range::{OutOfRange, at_least, not_negative, within};

/// Weights of the terms that know something of water and clear colours beforehand; 0 leaves a term out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Priors {
    /// Weight of absolute errors that count more the farther away they are.
    pub far: f64,
    /// Weight of the light that is left of a photograph without its backscatter: little is better, and
    /// below zero is worst.
    pub backscatter: f64,
    /// Weight of clear colours outside 0 to 0.7.
    pub saturation: f64,
    /// Weight of the distance of the mean clear colour from middle grey.
    pub grey_world: f64,
    /// Weight of the opacity of pixels that have the water's own colour.
    pub background: f64,
}

impl Priors {
    pub(crate) fn validate(&self) -> Result<(), OutOfRange> {
        not_negative("priors.far", self.far)?;
        not_negative("priors.backscatter", self.backscatter)?;
        not_negative("priors.saturation", self.saturation)?;
        not_negative("priors.grey_world", self.grey_world)?;
        not_negative("priors.background", self.background)
    }
}

/// The turns of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Turns {
    /// Share of the run from which there is water. Before, its colour is the background behind the scene.
    pub from: f64,
    /// Updates of the water alone when it begins, as a share of the run's steps.
    pub water_first: f64,
    /// Updates of the colours alone after them, as a share of the run's steps.
    pub colors_first: f64,
    /// Steps between later turns of the water.
    pub every: u64,
    /// Updates of the water alone in each later turn. Outside its turns the water does not move. 0: there
    /// are no turns, and the water moves in every step.
    pub water: u64,
}

impl Default for Turns {
    fn default() -> Self {
        Self { from: 0.0, water_first: 0.0, colors_first: 0.0, every: 100, water: 0 }
    }
}

/// The most updates in a turn.
const MOST: u64 = 10_000;

impl Turns {
    pub(crate) fn validate(&self) -> Result<(), OutOfRange> {
        within("turns.from", self.from, 0.0, 1.0)?;
        within("turns.water_first", self.water_first, 0.0, 1.0)?;
        within("turns.colors_first", self.colors_first, 0.0, 1.0)?;
        at_least("turns.every", self.every, 1)?;
        within("turns.water", self.water, 0, MOST)
    }
}
