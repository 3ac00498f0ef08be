//! The checks that every survey passes before it is used.

use std::collections::BTreeSet;
use std::path::Path;

use crate::read::ReadError;
use crate::survey::{PosedImage, Survey, SurveyPoint};

/// The longest side of an image, pixels.
const LONGEST_SIDE: usize = 1 << 20;
/// The largest coordinate or lens parameter. Training uses single precision, in which the square of a larger
/// one overflows.
const LARGEST: f64 = 1e15;
/// The end of a message about a number that [`fits_single`] refuses.
pub const SINGLE_RANGE: &str = "; expected numbers up to 1e15";
/// The shortest focal length, pixels: the square of a shorter one vanishes in single precision.
pub const SHORTEST_FOCAL: f64 = 1e-3;

/// True if a coordinate or a parameter of a lens can be used in single precision.
pub fn fits_single(value: f64) -> bool {
    value.abs() <= LARGEST
}

/// Checks that the ids and names of images are unique, their cameras `known` and their rotations usable, and
/// that the coordinates of images and points all fit; `range` says which ones do.
///
/// # Errors
/// The place of the first record that is not, and its fault.
pub fn check_records(
    images: &[PosedImage],
    points: &[SurveyPoint],
    known: impl Fn(u32) -> bool,
    fits: impl Fn(f64) -> bool,
    range: &str,
) -> Result<(), (String, String)> {
    let (mut ids, mut names) = (BTreeSet::new(), BTreeSet::new());
    for image in images {
        let fail = |fault: String| Err((format!("image {} ({})", image.id, image.name), fault));
        if !ids.insert(image.id) {
            return fail("its id occurs twice".into());
        }
        if !names.insert(image.name.as_str()) {
            return fail("its name occurs twice".into());
        }
        if !known(image.camera) {
            return fail(format!("it refers to camera {}, which is not there", image.camera));
        }
        let norm = image.quaternion.iter().map(|v| v * v).sum::<f64>().sqrt();
        if !(norm.is_finite() && norm > 1e-12) {
            return fail(format!("its quaternion is {:?}", image.quaternion));
        }
        if !image.translation.into_iter().all(&fits) {
            return fail(format!("its translation is {:?}{range}", image.translation));
        }
    }
    match points.iter().find(|point| !point.position.into_iter().all(&fits)) {
        Some(SurveyPoint { id, position, .. }) => {
            Err((format!("point {id}"), format!("its position is {position:?}{range}")))
        }
        None => Ok(()),
    }
}

impl Survey {
    /// Checks that ids are unique and known, numbers finite and within single precision, rotations and sizes
    /// sensible. `path` is the file that the survey came from, and `remedy` the next step, for the message.
    ///
    /// # Errors
    /// The first record that is not, with the value found and the expectation.
    pub fn check(&self, path: &Path, remedy: &str) -> Result<(), ReadError> {
        let fail = |place: String, reason: String| {
            Err(ReadError::broken(path, place, format!("{reason}; {remedy}")))
        };
        let mut ids = BTreeSet::new();
        for camera in &self.cameras {
            let place = format!("camera {}", camera.id);
            if !ids.insert(camera.id) {
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
            if let Some(bad) =
                numbers.find(|v| !fits_single(**v)).or_else(|| bends.find(|v| !fits_single(**v)))
            {
                return fail(place, format!("a parameter of its lens is {bad:e}{SINGLE_RANGE}"));
            }
        }
        let known = |camera| ids.contains(&camera);
        let (images, points) = (&self.images, &self.points);
        check_records(images, points, known, fits_single, SINGLE_RANGE)
            .or_else(|(place, reason)| fail(place, reason))?;
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
    use crate::{Lens, SurveyCamera, World};

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
        let check = |survey: &Survey| survey.check(Path::new("model"), "export it again");
        check(&good()).unwrap();
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
            let said = check(&survey).unwrap_err().to_string();
            assert!(said.contains(expected), "{said} lacks {expected}");
            assert!(said.starts_with("model: ") && said.ends_with("; export it again"), "{said}");
        }
    }
}
