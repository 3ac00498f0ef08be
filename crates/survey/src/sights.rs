//! Points in the images of a survey: where they were seen, and where the model puts them.

use std::collections::BTreeMap;

use glam::DVec3;
use use3d_capture::Pose;

use crate::survey::{PosedImage, Survey, SurveyCamera};

/// Points farther from the cameras than this many times the spread of the cameras are not of their scene.
const FARTHEST: f64 = 1000.0;

/// A point in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointSight {
    /// Index into [`Survey::points`].
    pub point: usize,
    /// Pixel x and y in the survey's image.
    pub at: [f64; 2],
}

/// The pose and lens of an image.
#[derive(Clone, Copy, Debug)]
pub struct PosedCamera<'a> {
    /// World to camera.
    pub pose: Pose,
    /// The lens, and the size of the image.
    pub camera: &'a SurveyCamera,
}

impl PosedCamera<'_> {
    /// The pixel on which a position, in units of the survey, lands. `None` behind the camera, and where the
    /// lens has no pixel for it.
    pub fn pixel(&self, position: [f64; 3]) -> Option<[f64; 2]> {
        let at = self.pose.rotation * DVec3::from_array(position) + self.pose.translation;
        let (x, y) = (at.z > 0.0).then(|| self.camera.lens.project(at.x / at.z, at.y / at.z))?;
        (x.is_finite() && y.is_finite()).then_some([x, y])
    }

    /// True if a position lands in the image, or at most this share of a side outside of it.
    pub fn sees(&self, position: [f64; 3], margin: f64) -> bool {
        let sides = [self.camera.width as f64, self.camera.height as f64];
        let inside =
            |at: [f64; 2]| (0..2).all(|i| (-margin * sides[i]..=(1.0 + margin) * sides[i]).contains(&at[i]));
        self.pixel(position).is_some_and(inside)
    }
}

impl Survey {
    /// The pose and lens of an image; `None` for an unknown camera.
    pub fn posed(&self, image: &PosedImage) -> Option<PosedCamera<'_>> {
        Some(PosedCamera { pose: image.pose(), camera: self.camera(image.camera)? })
    }

    /// The keypoints of each image that have a point, by image id, in the order of points; empty for a survey
    /// without tracks.
    pub fn tracked_sights(&self) -> BTreeMap<u32, Vec<PointSight>> {
        let images: BTreeMap<u32, &PosedImage> = self.images.iter().map(|image| (image.id, image)).collect();
        let mut found: BTreeMap<u32, Vec<PointSight>> = BTreeMap::new();
        for (point, stored) in self.points.iter().enumerate() {
            for (id, keypoint) in &stored.track {
                let keypoint = images.get(id).and_then(|image| image.keypoints.get(*keypoint as usize));
                if let Some(k) = keypoint.filter(|k| k.x.is_finite() && k.y.is_finite()) {
                    found.entry(*id).or_default().push(PointSight { point, at: [k.x, k.y] });
                }
            }
        }
        found
    }

    /// The points that land in each image, by image id, of about `most` to twice as many evenly chosen ones.
    /// Hidden points count too.
    pub fn landing_sights(&self, most: usize) -> BTreeMap<u32, Vec<PointSight>> {
        let step = (self.points.len() / most.max(1)).max(1);
        let of_image = |image: &PosedImage| {
            let camera = self.posed(image)?;
            let chosen = self.points.iter().enumerate().step_by(step);
            let landing = chosen.filter(|(_, p)| camera.sees(p.position, 0.0));
            let sight = |(point, p): (usize, &crate::SurveyPoint)| {
                Some(PointSight { point, at: camera.pixel(p.position)? })
            };
            Some((image.id, landing.filter_map(sight).collect()))
        };
        self.images.iter().filter_map(of_image).collect()
    }

    /// The pixel of an image on which a position, in units of the survey, lands. `None` behind the camera,
    /// where the lens has no pixel for it, and for an unknown camera.
    pub fn project(&self, image: &PosedImage, position: [f64; 3]) -> Option<(f64, f64)> {
        self.posed(image)?.pixel(position).map(Into::into)
    }

    /// The number of `positions` that fall onto any image, and are not absurdly far from it: coordinates of
    /// another reference system would lie in the centre of the earth.
    pub fn seen(&self, positions: &[[f64; 3]]) -> usize {
        let centres: Vec<DVec3> = self.images.iter().map(|image| image.pose().center()).collect();
        let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
        let spread = centres.iter().map(|c| c.distance(mean)).fold(0.0, f64::max);
        let reach = if spread > 0.0 { FARTHEST * spread } else { f64::INFINITY };
        let near = |p: &[f64; 3]| DVec3::from_array(*p).distance(mean) < reach;
        let cameras: Vec<PosedCamera<'_>> = self.images.iter().filter_map(|i| self.posed(i)).collect();
        let near = positions.iter().filter(|p| near(p));
        near.filter(|p| cameras.iter().any(|camera| camera.sees(**p, 0.0))).count()
    }
}
