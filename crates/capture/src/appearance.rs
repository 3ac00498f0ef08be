//! The appearance in which a scene's colours are compared and changed.

use serde::{Deserialize, Serialize};

/// The water that a picture of a scene shows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Appearance {
    /// Objects and the water in front of them, as a camera sees them.
    #[default]
    Water,
    /// The objects' own radiance, as if there were no water: black where there is no object.
    Clear,
}
