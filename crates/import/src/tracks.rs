//! Tracks of an imported capture: a model's keypoints as pixels of the views they were found in.

use std::collections::BTreeMap;

use use3d_capture::{Sighting, Track};

use crate::import::Imported;

impl Imported {
    /// Returns every sparse point's track, in the order of `capture.points`.
    ///
    /// Pixels are those of the views' cameras, that is, of the images after preparation. A sighting is left
    /// out if its image is missing, if the lens has no ray for its keypoint, or if the model names a keypoint
    /// that its image does not have. Models without tracks give empty tracks.
    pub fn tracks(&self) -> Vec<Track> {
        let views: BTreeMap<u32, usize> =
            self.capture.views.iter().enumerate().map(|(i, v)| (v.id, i)).collect();
        let images: BTreeMap<u32, usize> =
            self.model.images.iter().enumerate().map(|(i, image)| (image.id, i)).collect();
        let sighting = |&(image, keypoint): &(u32, u32)| {
            let (&view, &image) = (views.get(&image)?, images.get(&image)?);
            let keypoint = self.model.images[image].keypoints.get(keypoint as usize)?;
            let (x, y) = self.plans.get(view)?.geometry.point(keypoint.x, keypoint.y)?;
            (x.is_finite() && y.is_finite()).then_some(Sighting { view, x, y })
        };
        let points = self.capture.points.iter().zip(&self.model.points);
        points
            .map(|(point, stored)| Track {
                position: point.position,
                sightings: stored.track.iter().filter_map(sighting).collect(),
            })
            .collect()
    }
}
