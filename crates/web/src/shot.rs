//! A camera position and a look, as the page writes them into its files. Poses are in the COLMAP frame, so
//! that a file can be used with other scenes of the same model.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use use3d_capture::Pose;

/// A camera position and a look.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shot {
    /// The position of the camera, in the COLMAP frame.
    pub center: [f64; 3],
    /// World to camera, rows right, down, forward.
    pub rotation: [[f64; 3]; 3],
    /// The field of view of the picture's height, degrees.
    pub vertical_fov_degrees: f64,
    /// Distance from the camera to the point of interest, the centre of orbiting; units of the COLMAP model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focus: Option<f64>,
    /// The mode, one of the names of `use3d render --modes`.
    #[serde(default = "reconstruction")]
    pub mode: String,
    /// The strength of the enhancement, in `[0, 1]`.
    #[serde(default = "one")]
    pub strength: f32,
    /// The share of the water, in `[0, 1]`.
    #[serde(default = "one")]
    pub water: f32,
}

fn one() -> f32 {
    1.0
}

fn reconstruction() -> String {
    "reconstruction".into()
}

impl Shot {
    /// The reconstruction with all of its water and enhancement.
    pub(crate) fn plain(center: DVec3, rotation: [[f64; 3]; 3], vertical_fov_degrees: f64) -> Self {
        let (center, mode) = (center.to_array(), reconstruction());
        Self { center, rotation, vertical_fov_degrees, focus: None, mode, strength: 1.0, water: 1.0 }
    }

    /// Its pose.
    pub fn pose(&self) -> Pose {
        let [right, down, forward] = self.rotation.map(DVec3::from_array);
        let rotation = DMat3::from_cols(right, down, forward).transpose();
        Pose::from_center(rotation, DVec3::from_array(self.center))
    }

    /// Returns a message if a value is invalid.
    pub(crate) fn check(&self) -> Result<(), String> {
        let fov = self.vertical_fov_degrees;
        if !(fov > 0.0 && fov < 180.0) {
            return Err(format!("vertical_fov_degrees is {fov}; expected more than 0 and less than 180"));
        }
        if let Some(focus) = self.focus.filter(|focus| !(focus.is_finite() && *focus > 0.0)) {
            return Err(format!("focus is {focus}; expected a positive number"));
        }
        for (name, share) in [("strength", self.strength), ("water", self.water)] {
            if !(0.0..=1.0).contains(&share) {
                return Err(format!("{name} is {share}; expected 0 to 1"));
            }
        }
        self.pose().validate().map_err(|e| e.to_string())
    }
}
