//! The formation of a picture under water: the method's own formation, or one that is independent of its
//! assumptions.
//!
//! [`Physics::Display`] applies `I = J e^{-β_attn s} + c_m(d) (1 - e^{-β_bs s})` to display values, exactly
//! as the method models it ([`crate::water`]). [`Physics::Spectral`] works in linear light and ten
//! wavelengths ([`spectral`]), with daylight that fades with depth, optional lamps ([`spectral::Lamps`]), a
//! camera that exposes and balances every view separately ([`camera`]), and animals and particles in front of
//! the scene ([`passers`]). A method that succeeds only with the first has learnt its own assumptions; the
//! second shows this.

pub(crate) mod camera;
pub(crate) mod passers;
pub(crate) mod spectral;

pub use camera::Development;

use glam::Vec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::Camera;

/// The image formation of a synthetic capture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Physics {
    /// The method's formation, on display values.
    #[default]
    Display,
    /// Spectral transport in linear light, with a camera that sets itself automatically.
    Spectral,
}

/// The picture's x axis in the scene's frame.
pub(crate) fn sideways(camera: &Camera) -> Vec3 {
    camera.pose.rotation.transpose().x_axis.as_vec3()
}

impl Physics {
    /// Every formation, in the order of [`name`](Self::name).
    pub const ALL: [Self; 2] = [Self::Display, Self::Spectral];

    /// Its name in files and on the command line.
    pub fn name(self) -> &'static str {
        ["display", "spectral"][self as usize]
    }
}
