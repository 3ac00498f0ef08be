//! Reads paths of other programs: nerfstudio's `camera_path.json` and COLMAP's cameras. Each of their cameras
//! is a frame, and so becomes a key: nothing is left to be interpolated between neighbours.
//!
//! nerfstudio writes camera-to-world matrices with x right, y up, z back, in the frame that its dataparser
//! made: `x_ns = scale T x_colmap`. Next to a trained model it stores `T` and `scale` in
//! `dataparser_transforms.json`; with that file a path is converted back to COLMAP's frame. Its field of view
//! is that of the height, in degrees.

use glam::{DMat3, DVec3};
use serde::Deserialize;
use use3d_capture::Camera;
use use3d_numerics::math;

use super::{CameraPath, FORMAT, Key, check_rate};
use crate::shot::{Shot, ShotError, check_fov};

/// The needed part of the file that nerfstudio's render panel saves.
#[derive(Deserialize)]
struct Nerfstudio {
    camera_path: Vec<Keyframe>,
    #[serde(default)]
    fps: Option<f64>,
    #[serde(default)]
    seconds: Option<f64>,
}

#[derive(Deserialize)]
struct Keyframe {
    camera_to_world: Vec<f64>,
    fov: f64,
}

/// The file `dataparser_transforms.json`.
#[derive(Deserialize)]
struct Dataparser {
    transform: [[f64; 4]; 3],
    scale: f64,
}

/// True if a JSON value is nerfstudio's.
pub(super) fn is_nerfstudio(value: &serde_json::Value) -> bool {
    value.get("camera_path").is_some()
}

impl CameraPath {
    /// Reads nerfstudio's `camera_path.json`; `dataparser` is the text of its model's
    /// `dataparser_transforms.json`. Without it the path is assumed to be in COLMAP's frame.
    ///
    /// # Errors
    /// Fails at the first fault in the file, and names the camera that has it.
    pub fn read_nerfstudio(text: &str, dataparser: Option<&str>) -> Result<Self, ShotError> {
        let path: Nerfstudio = serde_json::from_str(text)
            .map_err(|e| ShotError::Form("it is not a nerfstudio camera path", e))?;
        let count = path.camera_path.len();
        // The file may lack one of the two numbers.
        let by_length = path.seconds.filter(|s| *s > 0.0).map(|s| count as f64 / s);
        let rate = path.fps.or(by_length).unwrap_or(30.0);
        let (turn, shift, scale) = match dataparser {
            None => (DMat3::IDENTITY, DVec3::ZERO, 1.0),
            Some(text) => {
                let parsed: Dataparser = serde_json::from_str(text).map_err(|e| {
                    ShotError::Form("the dataparser_transforms.json beside it cannot be read", e)
                })?;
                let [x, y, z] = parsed.transform.map(|row| DVec3::new(row[0], row[1], row[2]));
                let shift = DVec3::from_array(parsed.transform.map(|row| row[3]));
                (DMat3::from_cols(x, y, z).transpose(), shift, parsed.scale)
            }
        };
        let whole = turn.determinant().abs() > 1e-12 && turn.is_finite() && shift.is_finite();
        if !(whole && scale.is_finite() && scale > 0.0) {
            return Err(ShotError::NoInverse);
        }
        let back = turn.inverse();
        let keys = path.camera_path.iter().enumerate().map(|(i, frame)| {
            let given = &frame.camera_to_world;
            let m: [f64; 16] = given.as_slice().try_into().map_err(|_| ShotError::Matrix(i, given.len()))?;
            let column = |c: usize| back * DVec3::new(m[c], m[4 + c], m[8 + c]);
            let axes = [column(0), -column(1), -column(2)].map(|axis| axis.normalize_or_zero().to_array());
            let center = back * (DVec3::new(m[3], m[7], m[11]) / scale - shift);
            Ok(key(i, rate, center, axes, frame.fov))
        });
        let keys = keys.collect::<Result<Vec<Key>, ShotError>>()?;
        // Errors in a key are reported with the names of the file's own fields.
        for (i, key) in keys.iter().enumerate() {
            check_fov(&format!("camera_path[{i}].fov"), key.shot.vertical_fov_degrees)?;
        }
        for (i, key) in keys.iter().enumerate() {
            let place = || format!("camera_path[{i}].camera_to_world is not a pose");
            key.shot.check().map_err(|fault| ShotError::At(place(), Box::new(fault)))?;
        }
        check_rate("fps", rate)?;
        Self::of_keys(rate, keys)
    }

    /// A path of one frame per camera, in COLMAP's frame. Only the vertical field of view of each lens is
    /// kept.
    ///
    /// # Errors
    /// Fails for no cameras, more cameras than a path may have, or a rate that is not above 0.
    pub fn of_cameras(cameras: &[Camera], frames_per_second: f64) -> Result<Self, ShotError> {
        let keys = cameras.iter().enumerate().map(|(i, camera)| {
            let k = &camera.intrinsics;
            let fov = 2.0 * math::atan(k.height as f64 / 2.0 / k.fy).to_degrees();
            let rows = std::array::from_fn(|r| camera.pose.rotation.row(r).to_array());
            key(i, frames_per_second, camera.pose.center(), rows, fov)
        });
        Self::of_keys(frames_per_second, keys.collect())
    }

    fn of_keys(frames_per_second: f64, keys: Vec<Key>) -> Result<Self, ShotError> {
        Self { format: FORMAT.into(), version: 1, frames_per_second, keys }.checked()
    }
}

fn key(index: usize, rate: f64, center: DVec3, rotation: [[f64; 3]; 3], vertical_fov_degrees: f64) -> Key {
    let shot = Shot::plain(center, rotation, vertical_fov_degrees);
    Key { time: index as f64 / rate, shot }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Intrinsics, Pose};

    fn cameras() -> Vec<Camera> {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
        let at = |i: usize| DVec3::new(1.0 + i as f64, -2.0, 0.5 * i as f64);
        (0..4).map(|i| Camera { intrinsics, pose: Pose::look_at(at(i), DVec3::ZERO, DVec3::Z) }).collect()
    }

    fn near(a: &Camera, b: &Camera) -> bool {
        (a.pose.center() - b.pose.center()).length() < 1e-9
            && (a.pose.rotation - b.pose.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-9)
            && (a.intrinsics.fy - b.intrinsics.fy).abs() < 1e-9
    }

    #[test]
    fn cameras_make_a_path_of_a_frame_each() {
        let path = CameraPath::of_cameras(&cameras(), 7.0).unwrap();
        let frames = path.frames(64, 48);
        assert_eq!(frames.len(), 4);
        assert!(frames.iter().zip(cameras()).all(|(frame, camera)| near(&frame.camera, &camera)));
        assert!(CameraPath::of_cameras(&[], 7.0).unwrap_err().to_string().contains("no keys"));
    }

    #[test]
    fn a_path_of_nerfstudio_returns_to_the_frame_of_colmap() {
        // The positions and rotations as its dataparser would write them.
        let turn = DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.7);
        let (shift, scale) = (DVec3::new(0.2, -0.4, 3.0), 0.25);
        let frame = |camera: &Camera| {
            let rows: [DVec3; 3] = std::array::from_fn(|r| turn * camera.pose.rotation.row(r));
            let (x, y, z) = (rows[0], -rows[1], -rows[2]);
            let c = scale * (turn * camera.pose.center() + shift);
            let matrix = [x.x, y.x, z.x, c.x, x.y, y.y, z.y, c.y, x.z, y.z, z.z, c.z, 0.0, 0.0, 0.0, 1.0];
            let fov = 2.0 * f64::to_degrees(math::atan(24.0 / 60.0));
            serde_json::json!({ "camera_to_world": matrix, "fov": fov, "aspect": 4.0 / 3.0 })
        };
        let frames: Vec<_> = cameras().iter().map(frame).collect();
        let text = serde_json::json!({ "camera_type": "perspective", "render_height": 48, "render_width": 64, "camera_path": frames, "fps": 24, "seconds": 0.2 }).to_string();
        let rows: Vec<Vec<f64>> = (0..3)
            .map(|r| {
                let row = turn.row(r);
                vec![row.x, row.y, row.z, shift[r]]
            })
            .collect();
        let parser = serde_json::json!({ "transform": rows, "scale": scale }).to_string();
        let path = CameraPath::read_nerfstudio(&text, Some(&parser)).unwrap();
        assert_eq!(path.frames_per_second, 24.0);
        let frames = path.frames(64, 48);
        assert!(
            frames.len() == 4
                && frames.iter().zip(cameras()).all(|(frame, camera)| near(&frame.camera, &camera))
        );
        // The format is recognised by its content, and errors name the faulty camera.
        assert!(CameraPath::read(&text).is_ok());
        for (from, to, said) in [
            ("\"camera_to_world\":[", "\"camera_to_world\":[1.0,", "camera_path[0]"),
            ("\"fps\":24", "\"fps\":0", "fps is 0"),
            ("\"fov\":", "\"fov\":-", "camera_path[0].fov is -"),
            (
                "\"camera_to_world\":[",
                "\"camera_to_world\":[0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0,0.0],\"was\":[",
                "camera_path[0].camera_to_world",
            ),
        ] {
            assert!(text.contains(from), "{text}");
            let error = CameraPath::read(&text.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
        assert!(
            CameraPath::read_nerfstudio(&text, Some("{}"))
                .unwrap_err()
                .to_string()
                .contains("dataparser_transforms")
        );
    }
}
