//! A place and how the scene looks from it, as the page writes it into its files. Poses are in the COLMAP
//! frame, so that a file outlives the scene that it was made in.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use use3d_capture::Pose;

/// A place and a look.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Shot {
    /// Where the camera is, in the COLMAP frame.
    pub center: [f64; 3],
    /// World to camera, rows right, down, forward.
    pub rotation: [[f64; 3]; 3],
    /// Of the picture's height, degrees.
    pub vertical_fov_degrees: f64,
    /// How far in front of the camera the point of interest lies, around which one
    /// orbits; units of the COLMAP model.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub focus: Option<f64>,
    /// What is shown, in the words of `use3d render --modes`.
    #[serde(default = "reconstruction")]
    pub mode: String,
    /// How much of the enhancement, in `[0, 1]`.
    #[serde(default = "one")]
    pub strength: f32,
    /// How much of the water, in `[0, 1]`.
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
    /// The reconstruction, all of its water and enhancement.
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

    /// What is wrong with it, in words.
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
