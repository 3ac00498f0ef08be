//! The checks that every survey passes before it is used.

use std::collections::{BTreeMap, BTreeSet};

use crate::survey::Survey;

/// A survey that cannot be used: the place in it, and the value with the expectation.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{place}: {reason}")]
pub struct SurveyError {
    /// The camera, image or point.
    pub place: String,
    /// The fault, with the value found and the expectation.
    pub reason: String,
}

/// The longest side of an image, pixels.
const LONGEST_SIDE: usize = 1 << 20;
/// The largest coordinate or lens parameter. Training is done in single precision, where the square of a
/// larger one is no number any more.
const LARGEST: f64 = 1e15;
/// The shortest focal length, pixels: shorter ones vanish in single precision once they are squared.
const SHORTEST_FOCAL: f64 = 1e-3;

impl Survey {
    /// Checks that ids are unique and known, numbers finite and within single precision, rotations and sizes
    /// sensible.
    ///
    /// # Errors
    /// The first record that is not, with the value found and the expectation.
    pub fn check(&self) -> Result<(), SurveyError> {
        let fail = |place: String, reason: String| Err(SurveyError { place, reason });
        let fits = |v: &f64| v.abs() <= LARGEST;
        let range = "expected numbers up to 1e15";
        let mut sizes = BTreeMap::new();
        for camera in &self.cameras {
            let place = format!("camera {}", camera.id);
            if sizes.insert(camera.id, (camera.width, camera.height)).is_some() {
                return fail(place, "its id occurs twice".into());
            }
            let (w, h) = (camera.width, camera.height);
            if !(1..=LONGEST_SIDE).contains(&w) || !(1..=LONGEST_SIDE).contains(&h) {
                return fail(place, format!("its size is {w}x{h}; expected sides of 1 to {LONGEST_SIDE}"));
            }
            let lens = &camera.lens;
            if !lens.focal.iter().all(|f| f.is_finite() && *f >= SHORTEST_FOCAL) {
                let reason =
                    format!("its focal length is {:?}; expected {SHORTEST_FOCAL} pixels or more", lens.focal);
                return fail(place, reason);
            }
            let d = &lens.distortion;
            let mut numbers = lens.focal.iter().chain(&lens.principal).chain([&lens.skew]);
            let mut bends =
                d.numerator.iter().chain(&d.denominator).chain(&d.tangential).chain(&d.tangential_growth);
            if let Some(bad) = numbers.find(|v| !fits(v)).or_else(|| bends.find(|v| !fits(v))) {
                return fail(place, format!("a parameter of its lens is {bad:e}; {range}"));
            }
        }
        let (mut ids, mut names) = (BTreeSet::new(), BTreeSet::new());
        for image in &self.images {
            let place = || format!("image {} ({})", image.id, image.name);
            if !ids.insert(image.id) {
                return fail(place(), "its id occurs twice".into());
            }
            if !names.insert(image.name.as_str()) {
                return fail(place(), "its name occurs twice".into());
            }
            if !sizes.contains_key(&image.camera) {
                return fail(place(), format!("it refers to camera {}, which is not there", image.camera));
            }
            let norm = image.quaternion.iter().map(|v| v * v).sum::<f64>().sqrt();
            if !(norm.is_finite() && norm > 1e-12) {
                return fail(place(), format!("its quaternion is {:?}", image.quaternion));
            }
            if !image.translation.iter().all(fits) {
                return fail(place(), format!("its translation is {:?}; {range}", image.translation));
            }
        }
        for point in &self.points {
            if !point.position.iter().all(fits) {
                let reason = format!("its position is {:?}; {range}", point.position);
                return fail(format!("point {}", point.id), reason);
            }
        }
        if let Some(world) = &self.world
            && !world.is_valid()
        {
            let reason = format!(
                "one unit is {} metres and its transform {:?}; expected finite numbers and a scale above 0",
                world.metres_per_unit, world.transform
            );
            return fail("world".into(), reason);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{FileName, Pose};

    use super::*;
    use crate::{Lens, PosedImage, SurveyCamera, SurveyPoint, World};

    fn good() -> Survey {
        let lens = Lens::pinhole([500.0, 500.0], [320.0, 240.0]);
        Survey {
            cameras: vec![SurveyCamera {
                id: 1,
                model: "frame".into(),
                label: None,
                width: 640,
                height: 480,
                lens,
            }],
            images: vec![
                PosedImage::at(1, FileName::new("a.png").unwrap(), 1, &Pose::IDENTITY),
                PosedImage::at(2, FileName::new("b.png").unwrap(), 1, &Pose::IDENTITY),
            ],
            points: vec![SurveyPoint {
                id: 9,
                position: [0.0, 0.0, 3.0],
                color: [0; 3],
                error: -1.0,
                track: vec![],
            }],
            world: Some(World {
                metres_per_unit: 1.0,
                transform: [[1.0, 0.0, 0.0, 0.0]; 4],
                crs: None,
                source: "test".into(),
            }),
            ..Survey::default()
        }
    }

    #[test]
    fn what_is_wrong_is_named() {
        good().check().unwrap();
        type Change = fn(&mut Survey);
        let cases: [(Change, &str); 14] = [
            (|s| s.cameras.push(s.cameras[0].clone()), "camera 1: its id occurs twice"),
            (|s| s.cameras[0].width = 0, "0x480"),
            (|s| s.cameras[0].height = usize::MAX, "camera 1: its size"),
            (|s| s.cameras[0].lens.focal[1] = 0.0, "focal length"),
            (|s| s.cameras[0].lens.focal[1] = f64::NAN, "focal length"),
            (|s| s.cameras[0].lens.skew = f64::INFINITY, "parameter of its lens"),
            (|s| s.cameras[0].lens.distortion.numerator[3] = f64::NAN, "parameter of its lens"),
            (|s| s.images[1].id = 1, "image 1 (b.png): its id"),
            (|s| s.images[1].name = s.images[0].name.clone(), "its name occurs twice"),
            (|s| s.images[0].camera = 7, "camera 7, which is not there"),
            (|s| s.images[0].quaternion = [0.0; 4], "quaternion"),
            (|s| s.images[0].translation[2] = 1e20, "translation"),
            (|s| s.points[0].position[0] = f64::NAN, "point 9"),
            (|s| s.world.as_mut().unwrap().metres_per_unit = 0.0, "world"),
        ];
        for (change, expected) in cases {
            let mut survey = good();
            change(&mut survey);
            let said = survey.check().unwrap_err().to_string();
            assert!(said.contains(expected), "{said} lacks {expected}");
        }
    }
}
