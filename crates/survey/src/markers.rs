//! Markers that people or programs set in images, and known distances between them.
//!
//! A marker's position follows from its marks: the point with the least sum of squared distances to their
//! rays. A scale bar then gives the metres of one unit, `metres / |a - b|`.

use glam::{DMat3, DVec3};

use crate::survey::Survey;

/// A place where a marker was seen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// The image's id.
    pub image: u32,
    /// Pixel x.
    pub x: f64,
    /// Pixel y.
    pub y: f64,
}

/// A marker.
#[derive(Clone, Debug, PartialEq)]
pub struct Marker {
    /// Its id in the program.
    pub id: u32,
    /// Its name.
    pub label: String,
    /// Its measured coordinates in the reference system, where they are known.
    pub reference: Option<[f64; 3]>,
    /// The places where it was seen.
    pub marks: Vec<Mark>,
}

/// A known distance between two markers.
#[derive(Clone, Debug, PartialEq)]
pub struct ScaleBar {
    /// Its name.
    pub label: String,
    /// The ids of the markers at its ends.
    pub ends: [u32; 2],
    /// Its length, metres.
    pub metres: f64,
}

impl Survey {
    /// The position of a marker, in units of the survey; `None` with fewer than two usable marks, and where
    /// their rays are parallel.
    pub fn marker_position(&self, marker: &Marker) -> Option<[f64; 3]> {
        let (mut normal, mut right, mut rays) = (DMat3::ZERO, DVec3::ZERO, 0);
        for mark in &marker.marks {
            let Some(image) = self.images.iter().find(|i| i.id == mark.image) else { continue };
            let Some(camera) = self.camera(image.camera) else { continue };
            let Some((u, v)) = camera.lens.unproject(mark.x, mark.y) else { continue };
            let pose = image.pose();
            let d = (pose.rotation.transpose() * DVec3::new(u, v, 1.0)).normalize();
            // I - d dᵀ takes the part along the ray away.
            let across = DMat3::IDENTITY - DMat3::from_cols(d * d.x, d * d.y, d * d.z);
            normal += across;
            right += across * pose.center();
            rays += 1;
        }
        if rays < 2 || normal.determinant() < 1e-9 {
            return None;
        }
        let position = normal.inverse() * right;
        position.is_finite().then(|| position.to_array())
    }

    /// Metres in one unit by the scale bars, the largest disagreement of one bar with their mean, as a share,
    /// and the label of that bar; `None` without a bar whose ends are both known.
    pub fn metres_by_scale_bars(&self) -> Option<(f64, f64, &str)> {
        let end = |id: u32| {
            let marker = self.markers.iter().find(|m| m.id == id)?;
            self.marker_position(marker).map(DVec3::from_array)
        };
        let known = self.scale_bars.iter().filter_map(|bar| {
            let length = (end(bar.ends[0])? - end(bar.ends[1])?).length();
            let factor = bar.metres / length;
            (factor.is_finite() && factor > 0.0).then_some((factor, bar.label.as_str()))
        });
        let factors: Vec<(f64, &str)> = known.collect();
        let mean = factors.iter().map(|(factor, _)| factor).sum::<f64>() / factors.len() as f64;
        let off = |(factor, label): &(f64, _)| ((factor / mean - 1.0).abs(), *label);
        let (worst, label) = factors.iter().map(off).max_by(|a, b| a.0.total_cmp(&b.0))?;
        Some((mean, worst, label))
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{FileName, Pose};

    use super::*;
    use crate::{Lens, PosedImage, SurveyCamera};

    #[test]
    fn two_measured_points_give_the_metres_of_a_unit() {
        let lens = Lens::pinhole([500.0, 500.0], [320.0, 240.0]);
        let camera =
            SurveyCamera { id: 1, model: "frame".into(), label: None, width: 640, height: 480, lens };
        let images = (0..3u32).map(|i| {
            let pose = Pose::look_at(DVec3::new(f64::from(i) - 1.0, 0.2, -5.0), DVec3::ZERO, DVec3::NEG_Y);
            PosedImage::at(i, FileName::numbered(i as usize), 1, &pose)
        });
        let mut survey = Survey { cameras: vec![camera], images: images.collect(), ..Survey::default() };
        let truth = [[0.5, 0.1, 0.2], [-0.7, 0.3, -0.1]];
        for (id, at) in truth.into_iter().enumerate() {
            let marks = survey.images.iter().map(|image| {
                let (x, y) = survey.project(image, at).unwrap();
                Mark { image: image.id, x, y }
            });
            let marks = marks.collect();
            survey.markers.push(Marker { id: id as u32, label: format!("t{id}"), reference: None, marks });
        }
        let found = survey.marker_position(&survey.markers[0]).unwrap();
        assert!(found.iter().zip(truth[0]).all(|(a, b)| (a - b).abs() < 1e-9), "{found:?}");
        assert_eq!(survey.metres_by_scale_bars(), None);
        let length = (DVec3::from_array(truth[0]) - DVec3::from_array(truth[1])).length();
        survey.scale_bars.push(ScaleBar { label: "bar".into(), ends: [0, 1], metres: 2.5 * length });
        let (metres, worst, label) = survey.metres_by_scale_bars().unwrap();
        assert!((metres - 2.5).abs() < 1e-9 && worst < 1e-12 && label == "bar");
        survey.markers[1].marks.truncate(1);
        assert_eq!(survey.marker_position(&survey.markers[1]), None, "one ray is no position");
        assert_eq!(survey.metres_by_scale_bars(), None);
    }
}
