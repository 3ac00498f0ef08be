//! The data of a capture: images, cameras, views, sparse points, and the capture that holds them.
//!
//! Other crates read captures from files and pass them to the method as these types. This crate itself reads
//! and writes no files; it only defines valid file names ([`FileName`]). It is near the bottom of the
//! workspace.
//!
//! Conventions (for the whole workspace):
//!
//! * Camera frame as in COLMAP/OpenCV: x right, y down, z forward. `x_camera = R x_world + t`.
//! * Pixel centres at +0.5: pixel (column `j`, row `i`) has its centre at `(j + 0.5, i + 0.5)`.
//! * Colours are display-referred, `[0, 1]`, the PNG value over 255; they are never linearised.
//! * Lengths are in scene units (COLMAP's, or normalised by [`Frame`]). [`World`] takes them to metres.

mod appearance;
mod camera;
mod capture;
mod kept_water;
mod lattice;
pub mod name;
pub mod path;
mod raster;
mod reach;
mod track;
mod world;

pub use appearance::Appearance;
pub use camera::{Camera, CameraError, Frame, Intrinsics, Pose};
pub use capture::{Capture, CaptureError, Pixels, SparsePoint, Split, View};
pub use kept_water::KeptWater;
pub use lattice::{DEPTH_UNITS, DepthNetwork, Formation, Lattice, MediumMaps, world_direction};
pub use name::{FileName, NameError, flat_stem, masked, natural_order, shown, stem};
pub use raster::{Image, Image8, Map, Raster};
pub use reach::{Reach, Side, reaches};
pub use track::{Sighting, Track};
pub use world::World;
