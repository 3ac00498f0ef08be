//! Cameras of RealityScan, formerly RealityCapture: one table of all photographs as CSV, or one XMP file
//! beside each photograph.
//!
//! ```text
//! cameras.csv    #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2
//! IMG_0001.xmp   xcr:Rotation, xcr:Position, xcr:FocalLength35mm, xcr:DistortionCoeficients, …
//! ```
//!
//! **Pose.** The world has z up. In the table, a camera looks down with its top to the north if all angles
//! are 0; its axes are then turned by roll about y, by pitch about x, and by minus the heading about z. In
//! XMP the rotation stands row by row and takes the world to the camera, with x right, y down and z forward.
//! In both, the position is the centre.
//!
//! **Lens.** `f` is the focal length on film of 36 mm, so `f / 36` is a share of the longer side. `px` and
//! `py` are shares of it too, counted from the middle, y down. `1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸` is the
//! radial factor; `t1` belongs to `r² + 2 u²` along x, which is OpenCV's second tangential term.
//!
//! **Size.** No file has the size of a photograph, so a [`Registration`] becomes a survey only with the
//! sizes of the photographs.
//!
//! **Metres.** No file has the unit or the reference system.

mod points;
mod registration;
mod table;
mod xmp;

pub use points::add_points;
pub use registration::{RegisteredShot, Registration, ShareLens};
pub use table::{is_cameras_table, parse_table, read_table};
pub use xmp::{Sidecar, is_sidecar, parse_sidecars, read_sidecar};
