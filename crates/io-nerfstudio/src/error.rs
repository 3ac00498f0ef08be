//! The error of a survey that cannot be written.

/// A lens that a `transforms.json` cannot hold.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("camera {camera}: {reason}; undistort the images first")]
pub struct UnknownLens {
    /// The camera's id.
    pub camera: u32,
    /// The part of the lens that has no field.
    pub reason: &'static str,
}
