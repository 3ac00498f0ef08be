//! Points that were exported beside the cameras.
//!
//! The cameras of the XML file stand in the chunk's own coordinates. Points are exported in the reference
//! system instead, if the project has one. Both readings are tried, and the one that puts more points in
//! front of the cameras is taken.

use std::path::Path;

use use3d_survey::{ReadError, Survey, ply};

use crate::chunk::check;

/// The number of points by which the reading is chosen.
const TRIED: usize = 200;

/// Adds the points of a PLY file to a survey, in the survey's units; `path` is for messages.
///
/// # Errors
/// A file that is no PLY file of points, and points that no camera sees in either reading.
pub fn add_points(survey: &mut Survey, bytes: &[u8], path: &Path) -> Result<(), ReadError> {
    let mut points =
        ply::points(bytes).map_err(|source| ReadError::Points { path: path.to_path_buf(), source })?;
    if points.is_empty() {
        survey.notes.push("the file of points is empty".into());
        return Ok(());
    }
    let step = points.len().div_ceil(TRIED);
    let tried: Vec<[f64; 3]> = points.iter().step_by(step).map(|p| p.position).collect();
    let as_they_are = survey.seen(&tried);
    let from_world = survey.world.as_ref().map_or(0, |world| {
        let moved: Vec<[f64; 3]> = tried.iter().map(|p| world.invert(*p)).collect();
        survey.seen(&moved)
    });
    if 2 * as_they_are.max(from_world) < tried.len() {
        let reason = format!(
            "of {} points tried, {as_they_are} lie in front of the cameras; the file is in another reference \
             system: export the points again with the coordinate system `Local Coordinates` and no shift",
            tried.len()
        );
        return Err(ReadError::broken(path, "vertex", reason));
    }
    if let Some(world) = survey.world.as_ref().filter(|_| from_world >= as_they_are) {
        for point in &mut points {
            point.position = world.invert(point.position);
        }
    }
    survey.points = points;
    check(survey, path)
}
