//! The judgement on a capture's water: may training start from the estimate?

use std::fmt;

/// The judgement on a capture's water; every report uses the same words for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Judgement {
    /// The water is known, and training starts from it.
    Found,
    /// Points look alike from near and far: no water.
    Dry,
    /// The veil is nearly white in all channels: a sky, no water.
    Sky,
    /// Without tracks: far points are as dark and as bright as near ones.
    Air,
    /// The estimate cannot be water: without it, points would be brighter than white.
    Lamps,
    /// The water is not known; training learns it.
    Unknown,
}

impl Judgement {
    /// One word for files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Found => "found",
            Self::Dry | Self::Sky | Self::Air => "no-water",
            Self::Lamps => "lamps",
            Self::Unknown => "not-known",
        }
    }

    /// The judgement in the words of a diver.
    pub(crate) fn in_short(self) -> &'static str {
        match self {
            Self::Found => {
                "the water was measured in the photographs: colours fade from near to far as in water"
            }
            Self::Dry | Self::Sky | Self::Air => "no water found in the photographs, so none is learnt",
            Self::Lamps => {
                "the water could not be measured before, because lamps light what is near; it is learnt with the scene"
            }
            Self::Unknown => {
                "the water could not be measured before in every colour; it is learnt with the scene"
            }
        }
    }

    /// True if there is no water.
    pub fn no_water(self) -> bool {
        matches!(self, Self::Dry | Self::Sky | Self::Air)
    }
}

impl fmt::Display for Judgement {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Found => "water found: stage 1 starts from this estimate",
            Self::Dry => "no water found: points look the same from near and far",
            Self::Sky => "no water found: the veil would be nearly white in all colours, like a sky",
            Self::Air => "no water found: far points are as dark and as bright as near ones, as in air",
            Self::Lamps => {
                "water estimate not used: it would make surfaces brighter than white (lamps at the camera, \
                 or far walls taken for water?); stage 1 learns the water from the photographs"
            }
            Self::Unknown => "water not known in every colour: stage 1 learns it from the photographs",
        })
    }
}
