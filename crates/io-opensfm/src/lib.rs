//! Reconstructions of OpenSfM, the part of OpenDroneMap and WebODM that finds cameras.
//!
//! ```text
//! reconstruction.json   a list of reconstructions: cameras, shots, points, reference_lla
//! tracks.csv            the features of each image that belong to a point, with tabs between fields
//! ```
//!
//! **Pose.** A shot has an axis times an angle, and a translation: `x_camera = R x + t`, with x right, y down
//! and z forward, as in a survey.
//!
//! **Lens.** Lengths are shares of the longer side `s`, and places count from the middle of the image:
//! `x = s (f u' + c_x) + w/2`. `perspective` and `radial` have `1 + k1 r² + k2 r⁴`, `brown` also `k3` and
//! OpenCV's tangential terms. `fisheye` and `fisheye_opencv` have the same polynomial of the angle.
//!
//! **Metres.** With GPS, coordinates are metres east, north and up of `reference_lla`. Without GPS, that is
//! all zeros, and the unit is not known.

mod lens;
mod read;
mod tracks;

pub use read::{parse, read};
pub use tracks::{add_tracks, read_tracks};
