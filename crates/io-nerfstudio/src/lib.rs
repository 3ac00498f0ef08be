//! `transforms.json` of nerfstudio, in and out; files of instant-ngp have the same form.
//!
//! ```text
//! camera_model fl_x fl_y cx cy w h k1..k4 p1 p2     for all frames; a frame may state its own
//! applied_transform (3 x 4), applied_scale          how the poses were moved when the file was written
//! ply_file_path                                     points, moved in the same way
//! frames: file_path, transform_matrix (4 x 4), mask_path, depth_file_path, colmap_im_id
//! ```
//!
//! **Axes.** `transform_matrix` is camera-to-world with the camera axes of OpenGL: x right, y up, z backward.
//! A survey has x right, y down, z forward, so that the second and third column change their sign.
//!
//! **Frame.** `x_saved = applied_scale (A x + a)` with `applied_transform = [A | a]`. Both are undone, for
//! poses and points, so that a survey has the coordinates of the model that the file was made from.
//!
//! **Lens.** `OPENCV` and its like: `D(u) = u (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸)` and OpenCV's tangential
//! terms. `OPENCV_FISHEYE` (or `is_fisheye`): the same polynomial of the angle. Without focal lengths
//! `camera_angle_x` gives them; without `cx` and `cy` the middle of the image; without `w` and `h` the size
//! of the photograph.
//!
//! **Split.** `transforms_train.json` and `transforms_test.json` are one capture, as in NeRF's synthetic
//! form.

mod error;
mod frame;
mod read;
mod write;

pub use error::UnknownLens;
pub use read::{PhotographSize, Transforms, parse, read};
pub use write::{Export, export};
