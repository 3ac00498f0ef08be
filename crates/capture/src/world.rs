//! The world in metres that the coordinates of a capture belong to.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// The world that the coordinates of a capture's model belong to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct World {
    /// Metres in one unit of the model.
    pub metres_per_unit: f64,
    /// From the model's homogeneous coordinates to metres of the reference system: four rows of four,
    /// `[scale R | t]` over `[0 0 0 1]`. In `f64`, so that earth-centred coordinates keep the millimetre.
    pub transform: [[f64; 4]; 4],
    /// The reference system as well-known text, where one is stated.
    pub crs: Option<String>,
    /// The statement that the metres rest on, such as `Metashape chunk transform`.
    pub source: String,
}

impl World {
    /// A world that differs from the model by its unit alone.
    pub fn scaled(metres_per_unit: f64, source: String) -> Self {
        Self::of(metres_per_unit, &DMat3::IDENTITY, DVec3::ZERO, source)
    }

    /// The world `x = scale R x_model + t`, in metres.
    pub fn of(scale: f64, rotation: &DMat3, translation: DVec3, source: String) -> Self {
        let rows = (rotation.transpose() * scale).to_cols_array_2d();
        let t = translation.to_array();
        let row = |i: usize| [rows[i][0], rows[i][1], rows[i][2], t[i]];
        let transform = [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]];
        Self { metres_per_unit: scale, transform, crs: None, source }
    }

    /// A position of the model in metres of the world.
    pub fn apply(&self, position: [f64; 3]) -> [f64; 3] {
        let [a, b, c, _] = self.transform;
        [a, b, c].map(|r| r[0] * position[0] + r[1] * position[1] + r[2] * position[2] + r[3])
    }

    /// A position of the world, metres, in the model's units.
    pub fn invert(&self, position: [f64; 3]) -> [f64; 3] {
        let [a, b, c, _] = self.transform;
        let moved = DVec3::from_array(position) - DVec3::new(a[3], b[3], c[3]);
        // The transpose of s R over s² is its inverse.
        (self.scaled_rotation().transpose() * moved / (self.metres_per_unit * self.metres_per_unit))
            .to_array()
    }

    /// The turn from the model's axes to those of the world.
    pub fn rotation(&self) -> DMat3 {
        self.scaled_rotation() * (1.0 / self.metres_per_unit)
    }

    fn scaled_rotation(&self) -> DMat3 {
        let [a, b, c, _] = self.transform;
        DMat3::from_cols_array_2d(&[a, b, c].map(|r| [r[0], r[1], r[2]])).transpose()
    }

    /// True if all numbers are finite and the scale is above 0.
    pub fn is_valid(&self) -> bool {
        let finite = self.transform.iter().flatten().all(|v| v.is_finite());
        finite && self.metres_per_unit.is_finite() && self.metres_per_unit > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_world_goes_there_and_back_to_the_millimetre() {
        let turn = DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 1.1) * 12.354;
        let rows = turn.transpose().to_cols_array_2d();
        let t = [-2_499_366.429888, -4_256_836.520906, 4_029_217.965003];
        let row = |i: usize| [rows[i][0], rows[i][1], rows[i][2], t[i]];
        let world = World {
            metres_per_unit: 12.354,
            transform: [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]],
            crs: None,
            source: "test".into(),
        };
        let point = [0.3, -7.0, 2.5];
        let there = world.apply(point);
        let direct = turn * DVec3::from_array(point) + DVec3::from_array(t);
        assert!((DVec3::from_array(there) - direct).length() < 1e-8);
        let back = world.invert(there);
        assert!(back.iter().zip(point).all(|(a, b)| (a - b).abs() < 1e-9), "{back:?}");
    }
}
