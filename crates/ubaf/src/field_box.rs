//! The box in which the field is resolved (R23): the extent of the scene without the few Gaussians that fly
//! far away.
//!
//! For each axis it spans the 1 % and 99 % quantiles of the Gaussian means and the medium's anchor centres
//! together, widened by 2 % of the range on each side. A position outside is looked up on the box's face.
//! `u = clamp(2 (x - lo)/(hi - lo) - 1, -1, 1)`.

use use3d_numerics::order::Ascending;

/// Lower and upper corner, scene units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldBox {
    /// Lower corner.
    pub low: [f32; 3],
    /// Upper corner; above the lower one on every axis.
    pub high: [f32; 3],
}

/// The smallest length of a side as a share of the coordinate's size, so that a flat scene still has a box.
const THINNEST: f64 = 1e-4;

impl FieldBox {
    /// `[-1, 1]³`: coordinates equal positions.
    pub const UNIT: Self = Self { low: [-1.0; 3], high: [1.0; 3] };

    /// The box of a scene: `means` are the Gaussian centres, `anchors` the medium's. Coordinates that
    /// are not finite are ignored; if an axis has no other, the box is [`FieldBox::UNIT`].
    pub fn of_scene(means: &[[f32; 3]], anchors: &[[f32; 3]]) -> Self {
        let mut out = Self::UNIT;
        for axis in 0..3 {
            let values = means.iter().chain(anchors).map(|p| p[axis]).filter(|v| v.is_finite());
            let values = Ascending::of(values);
            let (Some(low), Some(high)) = (values.interpolated(0.01), values.interpolated(0.99)) else {
                return Self::UNIT;
            };
            let smallest = THINNEST * low.abs().max(high.abs()).max(1.0);
            let margin = (0.02 * (high - low)).max(0.5 * smallest);
            out.low[axis] = (low - margin) as f32;
            out.high[axis] = (high + margin) as f32;
        }
        out
    }

    /// Field coordinates of a position, each in `[-1, 1]`.
    #[inline(always)]
    pub fn normalise(&self, position: [f32; 3]) -> [f32; 3] {
        std::array::from_fn(|a| {
            let (low, high) = (self.low[a], self.high[a]);
            (2.0 * (position[a] - low) / (high - low) - 1.0).clamp(-1.0, 1.0)
        })
    }

    /// True if the corners are finite and the upper lies above the lower on every axis.
    pub fn is_valid(&self) -> bool {
        (0..3).all(|a| self.low[a].is_finite() && self.high[a].is_finite() && self.low[a] < self.high[a])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_flyers_do_not_stretch_the_box_and_anchors_count() {
        let mut means: Vec<[f32; 3]> =
            (0..1000).map(|i| [i as f32 / 999.0, 2.0 * i as f32 / 999.0, 5.0]).collect();
        means.extend([[1e6, 0.5, 5.0], [f32::NAN, 0.5, 5.0]]);
        let b = FieldBox::of_scene(&means, &[]);
        assert!(b.low[0] > -0.05 && b.high[0] < 1.05, "{b:?}");
        assert!((b.low[0] - (0.01 - 0.02 * 0.98)).abs() < 2e-3, "{b:?}");
        assert!(b.is_valid() && b.low[2] < 5.0 && b.high[2] > 5.0, "a flat axis keeps a box: {b:?}");
        let anchors = vec![[-3.0, 0.0, 0.0]; 100];
        assert!(FieldBox::of_scene(&means, &anchors).low[0] < -2.9);
        assert_eq!(FieldBox::of_scene(&[], &[]), FieldBox::UNIT);
    }

    #[test]
    fn corners_map_to_plus_and_minus_one_and_outside_is_clamped() {
        let b = FieldBox { low: [0.0, -2.0, 1.0], high: [1.0, 2.0, 4.0] };
        assert_eq!(b.normalise([0.0, 2.0, 2.5]), [-1.0, 1.0, 0.0]);
        assert_eq!(b.normalise([-9.0, 9.0, 4.0]), [-1.0, 1.0, 1.0]);
    }
}
