//! Converts a folder with pictures and a model of their cameras to a capture.
//!
//! The input is a folder with images and a model of COLMAP or another program: Metashape, nerfstudio, OpenSfM
//! or RealityScan. The outputs are a [`Capture`](use3d_capture::Capture), an [`ImportReport`], and the pixels
//! of single views. The crate estimates no cameras: the model must exist.
//!
//! ```text
//! layout ─▶ import ─▶ prepare ─▶ prepared ─▶ load
//! finds     chooses   resamples   reads back   one view's pixels
//! ```
//!
//! [`import`] finds the model and the images of a capture and resolves names without ever leaving the image
//! folder. It turns every lens into a pinhole, normalises the frame (R7), chooses the split (R8), and lists
//! its choices in an [`ImportReport`]. If pixels must change (distortion, size, white balance), [`prepare`]
//! streams them into a self-contained folder that [`load_prepared`] reads back exactly. [`load_pixels`],
//! [`load_mask`] and [`load_depth_prior`] load one view at its camera's size.
//!
//! [`Originals`] keeps the photographs as they came: their files, and their cameras before undistortion and
//! scaling.
//!
//! [`Imported::tracks`] gives the views and the pixels in which each sparse point was seen. [`read_cameras`]
//! reads the cameras of a model, a capture or a JSON list.
//!
//! ```no_run
//! # fn main() -> Result<(), use3d_import::ImportError> {
//! use std::path::Path;
//! use use3d_import::{ImportParams, import, load_pixels, prepare};
//!
//! let mut imported = import(Path::new("reef"), &ImportParams::default())?;
//! print!("{}", imported.report);
//! if imported.needs_preparation() {
//!     imported = prepare(&imported, Path::new("reef-prepared"), 0, &|_, _| true)?;
//! }
//! let first = load_pixels(&imported.capture.views[0])?;
//! # Ok(())
//! # }
//! ```

mod cameras;
mod copies;
mod depth;
mod error;
mod folder;
mod formats;
mod geometry;
mod import;
mod labels;
mod layout;
mod load;
mod metres;
mod normalise;
mod originals;
mod overlay;
mod parallel;
mod params;
mod prepare;
mod prepared;
mod report;
mod resample;
mod rows;
mod split;
mod stray;
mod tracks;
mod undistort;
mod white_balance;

pub use cameras::{camera_list, read_cameras, read_images_txt};
pub use depth::{DepthSight, depth_sights};
pub use error::ImportError;
pub use folder::{is_film, is_prepared};
pub use import::{Imported, capture_name, import};
pub use layout::{check_layout, has_depth_folder, holds_no_model};
pub use load::{load_depth_prior, load_mask, load_pixels};
pub use originals::{Original, Originals};
pub use params::{ImageSize, ImportParams, SplitOrder, SplitParams, WhiteBalance};
pub use prepare::{PreparedView, Progress, prepare};
pub use prepared::{Extent, load_prepared, prepared_extent, prepared_world};
pub use report::{CameraReport, ImportReport, OverlayReport};
pub use undistort::{LensFault, pinhole_of};
