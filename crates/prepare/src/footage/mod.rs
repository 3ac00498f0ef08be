//! Whole films: every frame with its time, and films that are written again.

mod path;

pub use path::{FilmPath, FilmPose, LARGEST_GAP, pose_at};
