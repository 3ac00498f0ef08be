//! Reads the export of a capture from Agisoft Metashape (PhotoScan before 2019).
//!
//! *File > Export > Export Cameras*, format *Agisoft XML*, gives a file with the lenses, poses, markers and
//! scale bars of a chunk. [`read`] takes it as a [`Survey`](use3d_survey::Survey), with Metashape's own lens
//! model ([`calibration`]) and the chunk's transform to metres ([`chunk`]). [`add_points`] takes the tie
//! points from *Export Point Cloud* as PLY.
//!
//! ```text
//! document version
//!   chunk label enabled
//!     sensors/sensor id type          resolution, property fixed, calibration class="adjusted|initial"
//!     components/component id         transform: rotation (9), translation (3), scale; partition/camera_ids
//!     cameras/(group label)*/camera   id sensor_id component_id label enabled, transform (16, row by row)
//!     markers/marker id label         reference x y z
//!     scalebars/scalebar label        endpoint marker_id (2), reference d
//!     frames/frame/markers/marker     marker_id, location camera_id x y
//!     reference                       the reference system as well-known text
//!     transform                       as in a component; files without components
//! ```
//!
//! A camera's transform takes its own axes (x right, y down, z forward) to those of its component. Files of
//! the versions 0.8 to 2.x are read.

pub mod calibration;
pub mod chunk;
mod points;
mod xml;

pub use chunk::{is_cameras_file, parse, read};
pub use points::add_points;
