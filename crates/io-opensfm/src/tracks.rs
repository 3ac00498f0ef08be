//! The features of each image that belong to a point: `tracks.csv`.
//!
//! A line has image, track, feature, x, y, from version 1 on a scale, and colours, with tabs between them. x
//! and y count from the middle of the image, as shares of its longer side.

use std::collections::BTreeMap;
use std::path::Path;

use use3d_survey::{Keypoint, ReadError, Survey, read_at_most, text};

use crate::read::REMEDY;

/// The largest file that is read, bytes.
const LARGEST: u64 = 1 << 31;
const HEADER: &str = "OPENSFM_TRACKS_VERSION_v";

/// Reads a file of tracks into a survey.
///
/// # Errors
/// A file that cannot be read, or is no file of tracks.
pub fn read_tracks(survey: &mut Survey, path: &Path) -> Result<(), ReadError> {
    let bytes = read_at_most(path, LARGEST, "remove it; the points are used without their tracks")?;
    add_tracks(survey, &bytes, path)
}

/// Adds the tracks of a file's bytes; `path` is for messages. Tracks of images and points that the survey
/// does not have are left out.
///
/// # Errors
/// A line that is no track.
pub fn add_tracks(survey: &mut Survey, bytes: &[u8], path: &Path) -> Result<(), ReadError> {
    let text =
        text(bytes).map_err(|(line, reason)| ReadError::broken(path, format!("line {line}"), reason))?;
    let images: BTreeMap<String, usize> =
        survey.images.iter().enumerate().map(|(i, image)| (image.name.to_string(), i)).collect();
    let points: BTreeMap<u64, usize> = survey.points.iter().enumerate().map(|(i, p)| (p.id, i)).collect();
    let (mut sightings, mut used) = (0usize, 0usize);
    for (number, line) in (1usize..).zip(text.lines()) {
        if line.trim().is_empty() || number == 1 && line.starts_with(HEADER) {
            continue;
        }
        let mut fields = line.split('\t');
        let (image, track) = (fields.next(), fields.next().and_then(|t| t.parse::<u64>().ok()));
        let _feature = fields.next();
        let mut number_of = || fields.next().and_then(|v| v.parse::<f64>().ok()).filter(|v| v.is_finite());
        let (Some(name), Some(track), Some(x), Some(y)) = (image, track, number_of(), number_of()) else {
            let reason = "expected image, track, feature, x and y with tabs between: take the file that OpenSfM's \
                `create_tracks` wrote, or remove it";
            return Err(ReadError::broken(path, format!("line {number}"), reason));
        };
        sightings += 1;
        let (Some(&image), Some(&point)) = (images.get(name), points.get(&track)) else { continue };
        let Some(camera) = survey.camera(survey.images[image].camera) else { continue };
        let (w, h) = (camera.width as f64, camera.height as f64);
        let longer = w.max(h);
        let keypoint = Keypoint { x: x * longer + 0.5 * w, y: y * longer + 0.5 * h, point: track };
        let image = &mut survey.images[image];
        let sighting = (image.id, image.keypoints.len() as u32);
        image.keypoints.push(keypoint);
        survey.points[point].track.push(sighting);
        used += 1;
    }
    if used == 0 && sightings > 0 {
        survey.notes.push(
            "no line of tracks.csv is of these photographs and points: take the file of the same reconstruction".into(),
        );
    }
    survey.check(path, REMEDY)
}
