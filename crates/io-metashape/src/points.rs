//! Points that were exported beside the cameras.
//!
//! The cameras of the XML file stand in the chunk's own coordinates. Points are exported in the reference
//! system instead, if the project has one. This can be metres from the earth's centre, or longitude, latitude
//! and altitude. All readings are tried, and the one that puts most points in front of the cameras is taken.

use std::path::Path;

use use3d_survey::{EarthPlace, ReadError, Survey, World, ply};

use crate::chunk::REMEDY;

/// The number of points by which the reading is chosen.
const TRIED: usize = 200;

/// A reading of the coordinates in a file of points.
#[derive(Clone, Copy)]
enum Reading {
    /// Those of the chunk's world.
    World,
    /// Longitude, latitude and altitude, where the chunk's world has its origin in the earth's centre.
    Geographic,
    /// The chunk's own.
    Own,
}

impl Reading {
    /// The position in the chunk's own coordinates; `None` if the reading makes no sense here.
    fn of(self, world: Option<&World>, [x, y, z]: [f64; 3]) -> Option<[f64; 3]> {
        match self {
            Self::Own => Some([x, y, z]),
            Self::World => Some(world?.invert([x, y, z])),
            Self::Geographic => {
                let on_earth = x.abs() <= 180.0 && y.abs() <= 90.0 && z.abs() < 1e5;
                let place = EarthPlace { latitude: y, longitude: x, altitude: z };
                on_earth.then_some(world?.invert(place.position().to_array()))
            }
        }
    }
}

/// Adds the points of a PLY file to a survey, in the survey's units; `path` is for messages.
///
/// # Errors
/// A file that is no PLY file of points, and points that no camera sees in either reading.
pub fn add_points(survey: &mut Survey, bytes: &[u8], path: &Path) -> Result<(), ReadError> {
    let mut points = ply::points(bytes, path)?;
    survey.faults.extend(ply::coarse(&points, path));
    if points.is_empty() {
        survey.notes.push("the file of points is empty".into());
        return Ok(());
    }
    let step = points.len().div_ceil(TRIED);
    let finite = points.iter().map(|p| p.position).filter(|p| p.iter().all(|v| v.is_finite()));
    let tried: Vec<[f64; 3]> = finite.step_by(step).collect();
    let world = survey.world.as_ref();
    let readings = [Reading::World, Reading::Geographic, Reading::Own];
    let seen = readings.map(|reading| {
        let moved: Option<Vec<[f64; 3]>> = tried.iter().map(|p| reading.of(world, *p)).collect();
        moved.map_or(0, |moved| survey.seen(&moved))
    });
    // The first of those with the most points.
    let best = seen.iter().copied().max().unwrap_or(0);
    let reading = readings.into_iter().zip(seen).find(|(_, seen)| *seen == best).map(|(reading, _)| reading);
    let Some(reading) = reading.filter(|_| 2 * best >= tried.len()) else {
        let reason = format!(
            "of {} points tried, {best} lie in front of the cameras; the file is in another reference system: export \
             the points again without a shift, in `Local Coordinates`",
            tried.len()
        );
        return Err(ReadError::broken(path, "vertex", reason));
    };
    for point in &mut points {
        point.position = reading.of(world, point.position).unwrap_or(point.position);
    }
    survey.take_points(points);
    survey.check(path, REMEDY)
}
