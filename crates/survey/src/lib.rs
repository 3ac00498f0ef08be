//! The lenses, cameras, poses and points of a capture, in no program's format.
//!
//! A [`Survey`] holds cameras with their lenses, posed images, triangulated points with their tracks,
//! markers, and, where it is known, the [`World`] that the coordinates belong to, in metres. Each `io-*`
//! crate reads a program's files into a survey, and the import knows surveys alone. [`Lens`] computes where
//! a ray lands on the sensor, and back. [`ply`] reads points that a program exported beside its cameras.
//!
//! Conventions:
//!
//! * Camera frame: x right, y down, z forward. Poses are world-to-camera: `x_camera = R x_survey + t`.
//! * Pixel (0, 0) is the image's top-left corner; pixel centres lie at +0.5.
//! * Positions are `f64` in the program's own unit. [`World::transform`] takes them to metres.
//!
//! Only [`read_at_most`] and [`first_bytes`] open a file.

mod check;
mod fit;
mod geo;
mod jet;
mod lens;
mod markers;
pub mod ply;
mod ranks;
mod read;
mod sights;
mod survey;
mod table;
mod text;

pub use check::{SHORTEST_FOCAL, SINGLE_RANGE, check_records, fits_single};
pub use fit::{PositionsFit, fit_depths, fit_positions};
pub use geo::EarthPlace;
pub use lens::{Distortion, Lens, Projection};
pub use markers::{Mark, Marker, ScaleBar};
pub use ranks::rank_correlation;
pub use read::{ReadError, RotationFault, check_rotation, first_bytes, is_last_row, read_at_most, tidy_name};
pub use sights::{PointSight, PosedCamera};
pub use survey::{ImageFiles, Keypoint, PosedImage, Survey, SurveyCamera, SurveyPoint, leave_out_points};
pub use table::{TextRow, TextTable};
pub use text::{json, text, unread};
pub use use3d_capture::World;
