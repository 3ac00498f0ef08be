//! Cameras that a program placed far away from all others, such as failed registrations.
//!
//! The scene's frame follows the cameras, so that one stray camera would make the rest of the scene too
//! small to be learnt. With the median of the camera centres by axis, and the distance `d` within which three
//! quarters of the centres lie, a camera is *far* beyond `8 d`. A far camera is stray if its points do not
//! land where it saw them, or if it saw hardly any. Beyond `50 d` it is stray in any case.

use std::collections::BTreeSet;

use glam::DVec3;
use use3d_numerics::math;
use use3d_numerics::order::{Ascending, median};
use use3d_survey::{PosedImage, Survey};

/// Distances, in units of `d`, beyond which a camera is far, and stray in any case.
const FAR: f64 = 8.0;
const BEYOND: f64 = 50.0;
/// The fewest cameras among which one can be stray.
const FEWEST: usize = 5;
/// A camera that saw fewer points has no sure place.
const POINTS: usize = 30;
/// A point that lands farther than this share of the longer side from its keypoint was not seen there.
const ASIDE: f64 = 0.02;

/// The ids of stray images of a survey.
pub(crate) fn strays(survey: &Survey) -> BTreeSet<u32> {
    let centres: Vec<DVec3> = survey.images.iter().map(|image| image.pose().center()).collect();
    if centres.len() < FEWEST {
        return BTreeSet::new();
    }
    let median = |axis: usize| median(centres.iter().map(|c| c[axis])).unwrap_or(0.0);
    let middle = DVec3::new(median(0), median(1), median(2));
    let distances: Vec<f64> = centres.iter().map(|c| c.distance(middle)).collect();
    let usual = Ascending::of(distances.iter().copied()).at(0.75).unwrap_or(0.0);
    let far = survey.images.iter().zip(&distances).filter(|(_, d)| **d > FAR * usual && usual > 0.0);
    far.filter(|(image, d)| **d > BEYOND * usual || !fits(survey, image)).map(|(image, _)| image.id).collect()
}

/// True if most points of an image land where it saw them.
fn fits(survey: &Survey, image: &PosedImage) -> bool {
    let Some(camera) = survey.camera(image.camera) else { return false };
    let limit = ASIDE * camera.width.max(camera.height) as f64;
    let (mut seen, mut right) = (0usize, 0usize);
    for point in &survey.points {
        for (_, keypoint) in point.track.iter().filter(|(id, _)| *id == image.id) {
            let Some(at) = image.keypoints.get(*keypoint as usize) else { continue };
            let lands = survey.project(image, point.position);
            seen += 1;
            right += usize::from(lands.is_some_and(|(x, y)| math::hypot(x - at.x, y - at.y) < limit));
        }
    }
    seen >= POINTS && 2 * right > seen
}

#[cfg(test)]
mod tests {
    use glam::DMat3;
    use use3d_capture::{FileName, Pose};

    use super::*;

    fn survey(places: &[[f64; 3]]) -> Survey {
        let image = |(id, place): (usize, &[f64; 3])| {
            let pose = Pose::from_center(DMat3::IDENTITY, DVec3::from_array(*place));
            PosedImage::at(id as u32, FileName::new(&format!("{id}.png")).unwrap(), 1, &pose)
        };
        Survey { images: places.iter().enumerate().map(image).collect(), ..Survey::default() }
    }

    #[test]
    fn one_camera_far_from_all_others_is_stray() {
        let mut places: Vec<[f64; 3]> = (0..12).map(|i| [0.1 * f64::from(i), 0.0, 0.0]).collect();
        assert!(strays(&survey(&places)).is_empty(), "a straight swim");
        places[5] = [0.0, 0.0, 900.0];
        assert_eq!(strays(&survey(&places)), BTreeSet::from([5]));
        // Without points nothing speaks for a camera that is far.
        places[5] = [0.0, 0.0, 4.0];
        assert_eq!(strays(&survey(&places)), BTreeSet::from([5]));
        // A dense group and a way to it.
        let way = (0..12).map(|i| [if i < 9 { 0.1 } else { f64::from(i) / 10.0 } * f64::from(i), 0.0, 0.0]);
        assert!(strays(&survey(&way.collect::<Vec<_>>())).is_empty());
        assert!(strays(&survey(&[[0.0; 3]; 8])).is_empty(), "one place");
    }
}
