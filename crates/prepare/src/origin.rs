//! The data sets of the paper by name, and the scenes of them that a pipeline names.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::error::PrepareError;

/// A data set.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
pub enum Recipe {
    /// The four scenes of SeaThru-NeRF, with cameras.
    #[serde(rename = "seathru")]
    SeaThruNerf,
    /// The sequences D3 and D5 of Sea-Thru: linear photographs.
    #[serde(rename = "d3d5")]
    SeaThru,
    /// The twenty films of DRUVA.
    #[serde(rename = "druva")]
    Druva,
}

/// A scene of a data set, written `druva/A3`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct SetScene {
    /// The data set.
    pub recipe: Recipe,
    /// The scene's name, as its owners spell it.
    pub scene: String,
}

impl TryFrom<String> for SetScene {
    type Error = PrepareError;

    fn try_from(text: String) -> Result<Self, PrepareError> {
        let parts = text.split_once('/').filter(|(_, scene)| !scene.is_empty());
        let found = parts.and_then(|(name, scene)| Some((Recipe::named(name)?, scene.to_string())));
        let Some((recipe, scene)) = found else {
            let reason = format!("{text:?}; expected a data set and its scene, such as \"druva/A3\"");
            return Err(PrepareError::Choice { flag: "origin", reason });
        };
        Ok(Self { recipe, scene })
    }
}

impl From<SetScene> for String {
    fn from(SetScene { recipe, scene }: SetScene) -> Self {
        format!("{}/{scene}", recipe.name())
    }
}

impl Recipe {
    /// All data sets.
    pub const ALL: [Self; 3] = [Self::SeaThruNerf, Self::SeaThru, Self::Druva];

    /// Its name in pipeline files.
    pub fn name(self) -> &'static str {
        match self {
            Self::SeaThruNerf => "seathru",
            Self::SeaThru => "d3d5",
            Self::Druva => "druva",
        }
    }

    fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|recipe| recipe.name() == name)
    }

    /// The environment variable of the folder that has its scenes.
    pub fn variable(self) -> &'static str {
        match self {
            Self::SeaThruNerf => "SEATHRU",
            Self::SeaThru => "SEATHRU_D",
            Self::Druva => "DRUVA",
        }
    }
}
