//! In which appearance a scene's colours are compared and changed.

use serde::{Deserialize, Serialize};

/// What a picture of a scene shows of its water.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Appearance {
    /// Objects and the water before them, as a camera sees them.
    #[default]
    Water,
    /// The objects' own radiance, as if there were no water: black where nothing is.
    Clear,
}
