//! Tracks: the views and the pixels in which a triangulated point was seen.

use glam::DVec3;

/// A triangulated point as seen in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// Index into [`crate::Capture::views`].
    pub view: usize,
    /// Pixel x in that view (centres at +0.5).
    pub x: f64,
    /// Pixel y in that view.
    pub y: f64,
}

/// A triangulated point with all views that saw it.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// Position in the capture's normalised frame.
    pub position: DVec3,
    /// The views that saw it, in the model's order; may be empty.
    pub sightings: Vec<Sighting>,
}
