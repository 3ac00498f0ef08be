//! The share of the water that an enhanced scene keeps.
//!
//! A 2D enhancer sees near rock and far rock through different water and applies one change of colour to
//! both. So near rock is changed too much, while the distance stays veiled. A scene with known water can
//! first remove a part of it, near and far alike; the enhancer then gets the result. Removing all of the
//! water multiplies the little light that came from afar, with its noise and its errors, so the gain is
//! bounded.
//!
//! With the optical depth `τ_c = −ln(A t_c / A)` of every pixel of every training view, weighted by its
//! accumulated opacity `A`, and `τ̂` the largest of the channels' 90th percentiles, the share that is kept
//! is
//!
//! ```text
//! k = max(k_least, 1 − ln G / τ̂)
//! ```
//!
//! Light from far surfaces is amplified by at most `G`, unless `k_least` applies. In shallow water (`τ̂`
//! small) the share may fall to `k_least`. Both bounds were chosen by eye on real captures (docs, results):
//! `G = 2`, `k_least = 0.4` if the water was measured beforehand. If it was only learnt together with the
//! pictures, surface and water are separated less reliably, and `G = 1.4`, `k_least = 0.7`.

use use3d_capture::{Image, KeptWater, Map};
use use3d_numerics::math;

/// The knowledge of a scene's water.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trust {
    /// All three attenuations were measured before training.
    Measured,
    /// The water was learnt together with the pictures.
    Learnt,
}

/// Number of bins per unit of optical depth.
const FINE: f64 = 100.0;
/// Index of the last bin; all larger optical depths share it.
const DEEPEST: usize = 800;
/// The percentile of optical depth that counts as far.
const FAR: f64 = 0.9;
/// Opacity below which a pixel shows no surface.
const LEAST_OPACITY: f32 = 0.2;

/// The optical depths of a scene's surfaces in its training views: a histogram per channel.
#[derive(Clone, Debug)]
pub struct Depths {
    weights: [Vec<f64>; 3],
}

impl Default for Depths {
    fn default() -> Self {
        Self { weights: std::array::from_fn(|_| vec![0.0; DEEPEST + 1]) }
    }
}

impl Depths {
    /// Adds a view: the accumulated opacity `A` in `[0, 1]`, and the part of a white surface's light that
    /// arrives, `A t`, per channel. Both have the same size.
    pub fn add(&mut self, accumulation: &Map, arriving: &Image) {
        for (c, weights) in self.weights.iter_mut().enumerate() {
            for (&a, &light) in accumulation.data().iter().zip(arriving.plane(c)) {
                if a < LEAST_OPACITY {
                    continue;
                }
                let depth = -math::ln(f64::from(light / a).clamp(1e-6, 1.0));
                weights[((depth * FINE) as usize).min(DEEPEST)] += f64::from(a);
            }
        }
    }

    /// The 90th percentile of a channel's optical depth; 0 where no surface was seen.
    pub fn far(&self, channel: usize) -> f64 {
        let weights = &self.weights[channel];
        let wanted = FAR * weights.iter().sum::<f64>();
        let mut sum = 0.0;
        for (bin, weight) in weights.iter().enumerate() {
            sum += weight;
            if sum >= wanted && sum > 0.0 {
                return (bin as f64 + 0.5) / FINE;
            }
        }
        0.0
    }
}

/// The share of the water that the enhanced scene keeps.
pub fn shares(depths: &Depths, trust: Trust) -> KeptWater {
    // The largest gain `G` of far light, and the smallest share `k_least` that is kept.
    let (gain, least) = match trust {
        Trust::Measured => (2.0, 0.4),
        Trust::Learnt => (1.4, 0.7),
    };
    let far = (0..3).map(|c| depths.far(c)).fold(0.0, f64::max);
    let kept = if far > 0.0 { (1.0 - math::ln(gain) / far).max(least) } else { 1.0 };
    KeptWater([kept as f32; 3])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A view with the same optical depth everywhere.
    fn view(depth: [f64; 3]) -> Depths {
        let mut depths = Depths::default();
        let arriving = depth.map(|d| 0.8 * math::exp(-d) as f32);
        let planes = arriving.iter().flat_map(|v| [*v; 12]).collect();
        depths.add(&Map::filled(4, 3, 0.8), &Image::from_planes(4, 3, planes).unwrap());
        depths
    }

    #[test]
    fn far_light_is_amplified_by_the_gain_and_no_more() {
        let depths = view([2.0, 0.5, 0.4]);
        let KeptWater([k, g, b]) = shares(&depths, Trust::Measured);
        assert!(k == g && k == b);
        let amplified = math::exp((1.0 - f64::from(k)) * depths.far(0));
        assert!((amplified - 2.0).abs() < 1e-6, "{amplified}");
        assert!((depths.far(0) - 2.0).abs() < 0.02 && (depths.far(1) - 0.5).abs() < 0.02);
    }

    #[test]
    fn less_is_taken_away_where_the_water_is_known_less_well() {
        for depth in [0.1, 0.7, 1.5, 4.0] {
            let [measured, learnt] =
                [Trust::Measured, Trust::Learnt].map(|trust| shares(&view([depth; 3]), trust).0[0]);
            assert!(measured < learnt && learnt <= 1.0, "{depth}: {measured}, {learnt}");
        }
        assert_eq!(shares(&view([0.3; 3]), Trust::Measured).0, [0.4; 3]);
    }

    #[test]
    fn a_scene_without_surfaces_keeps_all_of_its_water() {
        let mut depths = Depths::default();
        depths.add(&Map::filled(2, 2, 0.1), &Image::filled(2, 2, 0.05));
        assert_eq!(shares(&depths, Trust::Measured), KeptWater::ALL);
    }
}
