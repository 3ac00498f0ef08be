//! The parts of a survey: cameras, posed images with keypoints, points with tracks, and the world.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat3, DQuat, DVec3};
use use3d_capture::{FileName, Pose, World};

use crate::lens::Lens;
use crate::markers::{Marker, ScaleBar};

/// A camera: a lens and the size of its images.
#[derive(Clone, Debug, PartialEq)]
pub struct SurveyCamera {
    /// The id that images refer to.
    pub id: u32,
    /// The name of its lens model in the program that the survey came from, for reports.
    pub model: String,
    /// The name that people gave it, if any.
    pub label: Option<String>,
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Its lens, in pixels of an image of that size.
    pub lens: Lens,
}

/// A keypoint of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Keypoint {
    /// Pixel x.
    pub x: f64,
    /// Pixel y.
    pub y: f64,
    /// The id of the triangulated point, or [`Keypoint::NONE`].
    pub point: u64,
}

impl Keypoint {
    /// Stands for the point of a keypoint without a triangulated point.
    pub const NONE: u64 = u64::MAX;
}

/// An image whose pose is known.
#[derive(Clone, Debug, PartialEq)]
pub struct PosedImage {
    /// Its id.
    pub id: u32,
    /// World-to-camera rotation `w x y z`, as stored (not necessarily of unit length).
    pub quaternion: [f64; 4],
    /// World-to-camera translation, units of the survey.
    pub translation: [f64; 3],
    /// The id of its camera.
    pub camera: u32,
    /// Its file, relative to the image folder.
    pub name: FileName,
    /// Its keypoints.
    pub keypoints: Vec<Keypoint>,
}

impl PosedImage {
    /// The pose, with the quaternion normalised.
    pub fn pose(&self) -> Pose {
        let [w, x, y, z] = self.quaternion;
        let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        Pose { rotation, translation: DVec3::from_array(self.translation) }
    }

    /// An image without keypoints at a pose.
    pub fn at(id: u32, name: FileName, camera: u32, pose: &Pose) -> Self {
        let q = DQuat::from_mat3(&pose.rotation);
        Self {
            id,
            quaternion: [q.w, q.x, q.y, q.z],
            translation: pose.translation.to_array(),
            camera,
            name,
            keypoints: Vec::new(),
        }
    }
}

/// A triangulated point.
#[derive(Clone, Debug, PartialEq)]
pub struct SurveyPoint {
    /// Its id.
    pub id: u64,
    /// Position, units of the survey.
    pub position: [f64; 3],
    /// 8-bit RGB.
    pub color: [u8; 3],
    /// Mean reprojection error, pixels (−1 where not known).
    pub error: f64,
    /// Its observations: `(image id, keypoint index)`; empty where a program exports none.
    pub track: Vec<(u32, u32)>,
}

/// Files that belong to an image, relative to the survey's folder.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ImageFiles {
    /// A mask: 0 is ignored, white counts fully.
    pub mask: Option<FileName>,
    /// A depth map of distances along the optical axis.
    pub depth: Option<FileName>,
}

/// All that a photogrammetry program knows of a capture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Survey {
    /// Cameras, in the program's order.
    pub cameras: Vec<SurveyCamera>,
    /// Images with a pose, in the program's order.
    pub images: Vec<PosedImage>,
    /// Points, in the program's order.
    pub points: Vec<SurveyPoint>,
    /// Masks and depth maps that the program names, by image id.
    pub files: BTreeMap<u32, ImageFiles>,
    /// Markers.
    pub markers: Vec<Marker>,
    /// Known distances between markers.
    pub scale_bars: Vec<ScaleBar>,
    /// The world, where it is known.
    pub world: Option<World>,
    /// Sentences for the report: images without a pose, parts that were left out, and the like.
    pub notes: Vec<String>,
    /// Sentences on faults that cost something and stop nothing, each with its next step.
    pub faults: Vec<String>,
}

/// Leaves out the points whose position is not finite, and returns a sentence on them. Their keypoints have
/// no point afterwards.
pub fn leave_out_points(points: &mut Vec<SurveyPoint>, images: &mut [PosedImage]) -> Option<String> {
    let is_none = |point: &SurveyPoint| !point.position.iter().all(|v| v.is_finite());
    let none: BTreeSet<u64> = points.iter().filter(|p| is_none(p)).map(|p| p.id).collect();
    let first = none.first()?;
    points.retain(|point| !is_none(point));
    for keypoint in images.iter_mut().flat_map(|image| &mut image.keypoints) {
        if none.contains(&keypoint.point) {
            keypoint.point = Keypoint::NONE;
        }
    }
    let count = match none.len() {
        1 => "1 point of the model is".to_string(),
        several => format!("{several} points of the model are"),
    };
    Some(format!(
        "{count} left out, because a position is not a number (point {first}); export the model again if you miss points"
    ))
}

impl Survey {
    /// Takes these points, without those that have no position.
    pub fn take_points(&mut self, mut points: Vec<SurveyPoint>) {
        self.faults.extend(leave_out_points(&mut points, &mut self.images));
        self.points = points;
    }

    /// The camera of an id.
    pub fn camera(&self, id: u32) -> Option<&SurveyCamera> {
        self.cameras.iter().find(|c| c.id == id)
    }

    /// Keeps the images for which `keep` is true, and takes the others out of tracks, marks and file lists.
    pub fn retain_images(&mut self, keep: impl Fn(&PosedImage) -> bool) {
        let before = self.images.len();
        self.images.retain(keep);
        if self.images.len() < before {
            let kept: BTreeSet<u32> = self.images.iter().map(|i| i.id).collect();
            for point in &mut self.points {
                point.track.retain(|(image, _)| kept.contains(image));
            }
            for marker in &mut self.markers {
                marker.marks.retain(|mark| kept.contains(&mark.image));
            }
            self.files.retain(|image, _| kept.contains(image));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn removed_images_leave_no_trace() {
        let name = |n: &str| FileName::new(n).unwrap();
        let mut survey = Survey {
            images: vec![
                PosedImage::at(4, name("a.png"), 1, &Pose::IDENTITY),
                PosedImage::at(7, name("b.png"), 1, &Pose::IDENTITY),
            ],
            points: vec![SurveyPoint {
                id: 1,
                position: [0.0, 0.0, 2.0],
                color: [1, 2, 3],
                error: -1.0,
                track: vec![(4, 0), (7, 0)],
            }],
            ..Survey::default()
        };
        survey.files.insert(7, ImageFiles { mask: Some(name("m.png")), depth: None });
        survey.retain_images(|image| image.id == 4);
        assert_eq!((survey.points[0].track.as_slice(), survey.files.len()), (&[(4, 0)][..], 0));
    }
}
