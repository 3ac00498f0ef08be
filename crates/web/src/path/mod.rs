//! Camera paths in the page's format: keys with a time, a pose, a field of view and a look.
//!
//! Between keys the camera's position follows a cubic through all of them (Hermite, with the slope `(p_{i+1}
//! − p_{i−1}) / (t_{i+1} − t_{i−1})` at key `i`). The rotation turns at constant speed on the shortest arc.
//! Field of view, strength and water change linearly, and the mode is that of the key before. The page does
//! the same, so that the program draws the same path as the page. Poses are in the COLMAP frame, so that a
//! path can be used with other scenes of the same model.

mod formats;

use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, Intrinsics, Pose};
use use3d_numerics::math;
use use3d_numerics::range::{OutOfRange, check};

use crate::shot::{Shot, ShotError};

const FORMAT: &str = "3d-use camera path";
/// Longest path, frames: eleven hours at 25 frames per second.
const MOST_FRAMES: f64 = 1e6;

/// A path.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraPath {
    format: String,
    version: u32,
    /// Frames per second of the film it was made for.
    #[serde(default = "thirty")]
    pub frames_per_second: f64,
    /// Its keys, in the order of their times; at least one.
    pub keys: Vec<Key>,
}

fn thirty() -> f64 {
    30.0
}

/// A key.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Key {
    /// The time, seconds.
    pub time: f64,
    /// The pose and the look.
    #[serde(flatten)]
    pub shot: Shot,
}

/// One frame of a path.
#[derive(Clone, Debug, PartialEq)]
pub struct PathFrame<'a> {
    /// The camera, in the COLMAP frame.
    pub camera: Camera,
    /// The mode.
    pub mode: &'a str,
    /// The strength of the enhancement.
    pub strength: f32,
    /// The share of the water.
    pub water: f32,
}

impl CameraPath {
    /// Reads the text of a path file: this program's, or nerfstudio's in COLMAP's frame.
    ///
    /// # Errors
    /// Fails at the first fault in the file, and names the key that has it.
    pub fn read(text: &str) -> Result<Self, ShotError> {
        let no_path = |e| ShotError::Form("it is not a camera path", e);
        let value: serde_json::Value = serde_json::from_str(text).map_err(no_path)?;
        if formats::is_nerfstudio(&value) {
            return Self::read_nerfstudio(text, None);
        }
        serde_json::from_value::<Self>(value).map_err(no_path)?.checked()
    }

    /// True if a text is nerfstudio's `camera_path.json`.
    pub fn is_nerfstudio(text: &str) -> bool {
        serde_json::from_str(text).is_ok_and(|value| formats::is_nerfstudio(&value))
    }

    /// Returns the path if it is valid.
    fn checked(self) -> Result<Self, ShotError> {
        let path = self;
        if path.format != FORMAT {
            return Err(ShotError::Format(FORMAT));
        }
        if path.version != 1 {
            return Err(ShotError::Version(path.version));
        }
        let rate = path.frames_per_second;
        check_rate("frames_per_second", rate)?;
        let last = path.keys.last().ok_or(ShotError::NoKeys)?;
        for (i, key) in path.keys.iter().enumerate() {
            let rises = key.time.is_finite() && (i == 0 || key.time >= path.keys[i - 1].time);
            let checked = check(rises, "time", key.time, "times that rise").map_err(ShotError::Value);
            let checked = checked.and_then(|()| key.shot.check());
            checked.map_err(|fault| ShotError::At(format!("key {}", i + 1), Box::new(fault)))?;
        }
        if (last.time - path.keys[0].time) * rate > MOST_FRAMES {
            return Err(ShotError::TooLong(MOST_FRAMES));
        }
        Ok(path)
    }

    /// Its frames, from the first key to the last at its own rate, as pictures of `width × height` pixels.
    pub fn frames(&self, width: usize, height: usize) -> Vec<PathFrame<'_>> {
        let (Some(first), Some(last)) = (self.keys.first(), self.keys.last()) else { return Vec::new() };
        let count = ((last.time - first.time) * self.frames_per_second).round() as usize + 1;
        let time = |i: usize| first.time + i as f64 / self.frames_per_second;
        (0..count).map(|i| self.at(time(i).min(last.time), width, height)).collect()
    }

    fn at(&self, time: f64, width: usize, height: usize) -> PathFrame<'_> {
        let keys = &self.keys;
        let i = keys.partition_point(|k| k.time <= time).clamp(1, (keys.len() - 1).max(1)) - 1;
        let (a, b) = (&keys[i], &keys[(i + 1).min(keys.len() - 1)]);
        let span = b.time - a.time;
        let u = if span > 0.0 { ((time - a.time) / span).clamp(0.0, 1.0) } else { 1.0 };
        let place = |k: usize| DVec3::from_array(keys[k.min(keys.len() - 1)].shot.center);
        let slope = |k: usize| {
            let (before, after) = (k.saturating_sub(1), (k + 1).min(keys.len() - 1));
            let apart = keys[after].time - keys[before].time;
            if apart > 0.0 { (place(after) - place(before)) / apart } else { DVec3::ZERO }
        };
        let (u2, u3) = (u * u, u * u * u);
        let center = (2.0 * u3 - 3.0 * u2 + 1.0) * place(i)
            + (u3 - 2.0 * u2 + u) * span * slope(i)
            + (3.0 * u2 - 2.0 * u3) * place(i + 1)
            + (u3 - u2) * span * slope((i + 1).min(keys.len() - 1));
        let turn = |shot: &Shot| DQuat::from_mat3(&shot.pose().rotation);
        let (a, b) = (&a.shot, &b.shot);
        let rotation = DMat3::from_quat(turn(a).slerp(turn(b), u).normalize());
        let mix = |x: f64, y: f64| x + u * (y - x);
        let half = mix(a.vertical_fov_degrees, b.vertical_fov_degrees).to_radians() / 2.0;
        let (w, h) = (width as f64, height as f64);
        let f = h / 2.0 / math::tan(half);
        let intrinsics = Intrinsics { width, height, fx: f, fy: f, cx: w / 2.0, cy: h / 2.0 };
        let share = |x: f32, y: f32| mix(x.into(), y.into()) as f32;
        PathFrame {
            camera: Camera { intrinsics, pose: Pose::from_center(rotation, center) },
            mode: if u >= 1.0 { &b.mode } else { &a.mode },
            strength: share(a.strength, b.strength),
            water: share(a.water, b.water),
        }
    }
}

/// Checks a rate, frames per second.
fn check_rate(path: &str, rate: f64) -> Result<(), OutOfRange> {
    check(rate > 0.0 && rate <= 1000.0, path, rate, "a positive number up to 1000")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn text() -> String {
        let key = |time: f64, x: f64, mode: &str, strength: f64| {
            serde_json::json!({
                "time": time, "center": [x, 0.0, 1.0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
                "vertical_fov_degrees": 40.0 + 10.0 * time, "mode": mode, "strength": strength,
            })
        };
        let keys = [key(0.0, 0.0, "clear", 0.0), key(1.0, 1.0, "enhanced", 1.0), key(3.0, 3.0, "clear", 1.0)];
        serde_json::json!({ "format": FORMAT, "version": 1, "frames_per_second": 10, "keys": keys })
            .to_string()
    }

    #[test]
    fn a_path_passes_through_its_keys_and_evenly_between_even_ones() {
        let path = CameraPath::read(&text()).unwrap();
        let frames = path.frames(64, 48);
        assert_eq!(frames.len(), 31);
        for (i, frame) in frames.iter().enumerate() {
            frame.camera.validate().unwrap();
            let center = frame.camera.pose.center();
            assert!((center - DVec3::new(i as f64 / 10.0, 0.0, 1.0)).length() < 1e-9, "{i}: {center}");
        }
        assert_eq!((frames[9].mode, frames[10].mode, frames[30].mode), ("clear", "enhanced", "clear"));
        assert!((frames[5].strength - 0.5).abs() < 1e-6 && frames[5].water == 1.0);
        let fov = 2.0 * math::atan(24.0 / frames[20].camera.intrinsics.fy).to_degrees();
        assert!((fov - 60.0).abs() < 1e-9, "{fov}");
    }

    #[test]
    fn what_is_no_path_is_refused_with_the_key_that_is_wrong() {
        let good = text();
        for (from, to, said) in [
            (FORMAT, "other", "format"),
            ("\"version\":1", "\"version\":2", "version 2"),
            ("\"vertical_fov_degrees\":50.0", "\"vertical_fov_degrees\":190.0", "key 2"),
            ("\"time\":3.0", "\"time\":0.5", "key 3"),
            ("[1,0,0]", "[2,0,0]", "key 1"),
            ("\"time\":3.0", "\"time\":1e9", "longer"),
        ] {
            assert!(good.contains(from), "{from} in {good}");
            let error = CameraPath::read(&good.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(error.contains(said), "{error}");
        }
    }
}
