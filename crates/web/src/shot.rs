//! A camera position and a look, as the page writes them into its files. Poses are in the COLMAP frame, so
//! that a file can be used with other scenes of the same model.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use use3d_capture::{CameraError, Pose};
use use3d_numerics::range::{OutOfRange, check, positive, within};

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

/// A fault in a file of camera positions: a path, or named views.
#[derive(Debug, thiserror::Error)]
pub enum ShotError {
    /// A text that is not a file of the expected kind, after words that say which.
    #[error("{0}: {1}")]
    Form(&'static str, #[source] serde_json::Error),
    /// The file is of another kind than the expected one.
    #[error("its `format` is not `{0}`")]
    Format(&'static str),
    /// The version of the file is not known.
    #[error("version {0}; this program reads version 1")]
    Version(u32),
    /// A value is outside its range.
    #[error("{} {}", .0.path, .0.words())]
    Value(#[from] OutOfRange),
    /// A pose is not one.
    #[error(transparent)]
    Pose(#[from] CameraError),
    /// A fault in this key or view of the file.
    #[error("{0}: {1}")]
    At(String, Box<Self>),
    /// A view without a name.
    #[error("it has no name")]
    NoName,
    /// A path without keys.
    #[error("it has no keys")]
    NoKeys,
    /// More views than the most that are read.
    #[error("it has {0} views; at most {1} are read")]
    TooMany(usize, usize),
    /// More frames than these.
    #[error("it is longer than {0} frames")]
    TooLong(f64),
    /// nerfstudio's change of frame cannot be undone.
    #[error("the dataparser_transforms.json beside it has no inverse")]
    NoInverse,
    /// The matrix of the camera of this index has another number of entries.
    #[error("camera_path[{0}].camera_to_world has {1} numbers; expected 16")]
    Matrix(usize, usize),
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

    /// Checks its values.
    pub(crate) fn check(&self) -> Result<(), ShotError> {
        check_fov("vertical_fov_degrees", self.vertical_fov_degrees)?;
        self.focus.map_or(Ok(()), |focus| positive("focus", focus))?;
        within("strength", self.strength, 0.0, 1.0)?;
        within("water", self.water, 0.0, 1.0)?;
        Ok(self.pose().validate()?)
    }
}

/// Checks a field of view, degrees.
pub(crate) fn check_fov(path: &str, fov: f64) -> Result<(), OutOfRange> {
    check(fov > 0.0 && fov < 180.0, path, fov, "more than 0 and less than 180")
}
