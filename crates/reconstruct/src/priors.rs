//! The weights of SeaSplat's priors on water, colours and background.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::range::{OutOfRange, not_negative};

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
