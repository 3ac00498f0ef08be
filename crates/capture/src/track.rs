//! Tracks: which views saw a triangulated point, and at which pixel.

use glam::DVec3;

/// One view's sight of a triangulated point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Index into [`crate::Capture::views`].
    pub view: usize,
    /// Pixel x in that view (centres at +0.5).
    pub x: f64,
    /// Pixel y in that view.
    pub y: f64,
}

/// A triangulated point with everybody who saw it.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// Position in the capture's normalised frame.
    pub position: DVec3,
    /// Who saw it, in the model's order; may be empty.
    pub sightings: Vec<Sighting>,
}
