//! Points that were exported beside the cameras, in the same coordinates.

use std::path::Path;

use use3d_survey::{ReadError, Survey, ply};

use crate::registration::REMEDY;

/// The number of points by which the coordinates are compared.
const TRIED: usize = 200;

/// Adds the points of a PLY file to a survey; `path` is for messages.
///
/// # Errors
/// A file that is no PLY file of points, and points that the cameras do not see.
pub fn add_points(survey: &mut Survey, bytes: &[u8], path: &Path) -> Result<(), ReadError> {
    let points = ply::points(bytes, path)?;
    let step = points.len().div_ceil(TRIED).max(1);
    let tried: Vec<[f64; 3]> = points.iter().step_by(step).map(|p| p.position).collect();
    let seen = survey.seen(&tried);
    if 2 * seen < tried.len() {
        let reason = format!(
            "of {} points tried, {seen} lie in front of the cameras; cameras and points are in different coordinates: \
             export both again with the coordinate system `Grid plane`",
            tried.len()
        );
        return Err(ReadError::broken(path, "vertex", reason));
    }
    if points.is_empty() {
        survey.notes.push("the file of points is empty".into());
    }
    survey.faults.extend(ply::coarse(&points, path));
    survey.take_points(points);
    survey.check(path, REMEDY)
}
