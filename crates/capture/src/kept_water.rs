//! The share of the water that an enhanced scene keeps.
//!
//! The kept water is thinner and has the same colour: with a share `k` per channel, both coefficients are
//! multiplied by it,
//!
//! ```text
//! β_attn ← k β_attn        β_bs ← k β_bs        c_m unchanged
//! ```
//!
//! so a surface at distance `s` appears as through `k s` of the stage-1 water, and open water keeps its
//! colour. `k = 1` is the stage-1 water, to the bit. A share is in `[0, 1]`, in the order red, green, blue.

use serde::{Deserialize, Serialize};

use crate::MediumMaps;

/// A share of the water per channel, each in `[0, 1]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct KeptWater(pub [f32; 3]);

impl Default for KeptWater {
    fn default() -> Self {
        Self::ALL
    }
}

impl KeptWater {
    /// All of the water, as in the paper.
    pub const ALL: Self = Self([1.0; 3]);

    /// True if no water is removed.
    pub fn is_all(&self) -> bool {
        *self == Self::ALL
    }

    /// True if every share is in `[0, 1]`.
    pub fn is_valid(&self) -> bool {
        self.0.iter().all(|k| (0.0..=1.0).contains(k))
    }

    /// The shares between the stage-1 water (strength 0) and these (strength 1), linearly.
    pub fn at_strength(&self, strength: f32) -> Self {
        Self(self.0.map(|k| 1.0 - strength * (1.0 - k)))
    }

    /// Multiplies both coefficients of `maps`, and the share of a network. Changes no bit if no water is
    /// removed.
    pub fn thin(&self, maps: &mut MediumMaps) {
        if self.is_all() {
            return;
        }
        for image in [&mut maps.backscatter, &mut maps.attenuation] {
            for (c, k) in self.0.into_iter().enumerate() {
                image.plane_mut(c).iter_mut().for_each(|beta| *beta *= k);
            }
        }
        if let Some(network) = &mut maps.network {
            network.share.iter_mut().zip(self.0).for_each(|(share, k)| *share *= k);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_multiplies_both_coefficients_and_leaves_the_colour() {
        let mut maps = MediumMaps::zeros(3, 2);
        for (i, v) in maps.color.data_mut().iter_mut().enumerate() {
            *v = 0.1 * i as f32;
        }
        maps.backscatter.data_mut().fill(0.4);
        maps.attenuation.data_mut().fill(0.8);
        let before = maps.clone();
        KeptWater::ALL.thin(&mut maps);
        assert_eq!(maps, before);
        KeptWater([1.0, 0.5, 0.25]).thin(&mut maps);
        assert_eq!(maps.color, before.color);
        assert_eq!(maps.backscatter.pixel(2, 1), [0.4, 0.2, 0.1]);
        assert_eq!(maps.attenuation.pixel(0, 0), [0.8, 0.4, 0.2]);
    }

    #[test]
    fn strength_leads_from_all_of_the_water_to_the_share() {
        let kept = KeptWater([0.5, 0.25, 1.0]);
        assert_eq!(kept.at_strength(0.0), KeptWater::ALL);
        assert_eq!(kept.at_strength(1.0), kept);
        assert_eq!(kept.at_strength(0.5), KeptWater([0.75, 0.625, 1.0]));
        assert!(kept.is_valid() && !KeptWater([1.0, f32::NAN, 0.0]).is_valid());
    }
}
