//! Pinhole cameras, rigid poses, and the similarity that normalises a scene.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};
use use3d_numerics::math;

/// Pinhole intrinsics in pixels; the image's top-left corner is (0, 0), pixel centres are at +0.5.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Image width, pixels.
    pub width: usize,
    /// Image height, pixels.
    pub height: usize,
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point x, pixels.
    pub cx: f64,
    /// Principal point y, pixels.
    pub cy: f64,
}

/// A camera with invalid parameters.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A size of zero.
    #[error("camera size is {width}x{height}; both sides must be at least 1 pixel")]
    EmptyImage {
        /// Width found.
        width: usize,
        /// Height found.
        height: usize,
    },
    /// A focal length that is not positive and finite, or a principal point that is not finite.
    #[error("camera {field} is {value}; expected a finite{} number", if field.starts_with('f') { " positive" } else { "" })]
    Intrinsic {
        /// `fx`, `fy`, `cx` or `cy`.
        field: &'static str,
        /// Value found.
        value: f64,
    },
    /// A rotation or translation with a non-finite entry, or a rotation that is not orthonormal.
    #[error("camera pose is not a rigid motion: {0}")]
    Pose(String),
}

impl Intrinsics {
    /// The horizontal angle of view, degrees: `2 atan(width / (2 f_x))`.
    pub fn angle(&self) -> f64 {
        2.0 * math::atan(self.width as f64 / (2.0 * self.fx)).to_degrees()
    }

    /// Checks that the intrinsics describe a usable pinhole.
    pub fn validate(&self) -> Result<(), CameraError> {
        if self.width == 0 || self.height == 0 {
            return Err(CameraError::EmptyImage { width: self.width, height: self.height });
        }
        for (field, value) in [("fx", self.fx), ("fy", self.fy), ("cx", self.cx), ("cy", self.cy)] {
            if !value.is_finite() || field.starts_with('f') && value <= 0.0 {
                return Err(CameraError::Intrinsic { field, value });
            }
        }
        Ok(())
    }

    /// The same lens with the image scaled by `sx`, `sy` to a new size (the pixel grid's corner stays at (0,
    /// 0)).
    pub fn scaled(&self, sx: f64, sy: f64, width: usize, height: usize) -> Self {
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }

    /// The image pyramid's level: sides `floor(side / divisor)`, intrinsics over `divisor` (R11).
    pub fn downscaled(&self, divisor: usize) -> Self {
        let s = 1.0 / divisor as f64;
        self.scaled(s, s, (self.width / divisor).max(1), (self.height / divisor).max(1))
    }

    /// The intrinsics after cutting `left` and `top` pixels and keeping `width × height`.
    pub fn cropped(&self, left: f64, top: f64, width: usize, height: usize) -> Self {
        Self { width, height, cx: self.cx - left, cy: self.cy - top, ..*self }
    }
}

/// A rigid motion from world to camera: `x_camera = rotation * x_world + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// World-to-camera rotation.
    pub rotation: DMat3,
    /// World-to-camera translation, scene units.
    pub translation: DVec3,
}

impl Pose {
    /// The identity: the camera at the origin looking along +z.
    pub const IDENTITY: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// The camera centre in the world, `-Rᵀ t`.
    pub fn center(&self) -> DVec3 {
        -(self.rotation.transpose() * self.translation)
    }

    /// A camera at `center` with the given world-to-camera rotation.
    pub fn from_center(rotation: DMat3, center: DVec3) -> Self {
        Self { rotation, translation: -(rotation * center) }
    }

    /// A camera at `eye` looking at `target`, with `up` towards the top of the image. The three must not be
    /// collinear.
    pub fn look_at(eye: DVec3, target: DVec3, up: DVec3) -> Self {
        let forward = (target - eye).normalize();
        let right = forward.cross(up).normalize();
        let down = forward.cross(right);
        Self::from_center(DMat3::from_cols(right, down, forward).transpose(), eye)
    }

    /// Checks that every entry is finite and the rotation orthonormal with determinant +1 (to 1e-4).
    pub fn validate(&self) -> Result<(), CameraError> {
        if !self.rotation.is_finite() || !self.translation.is_finite() {
            return Err(CameraError::Pose("it has an entry that is not finite".into()));
        }
        let gram = self.rotation * self.rotation.transpose() - DMat3::IDENTITY;
        let error = gram.to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs()));
        if error > 1e-4 || self.rotation.determinant() < 0.0 {
            return Err(CameraError::Pose(format!(
                "its matrix is off orthonormal by {error:.1e}, determinant {:.3}",
                self.rotation.determinant()
            )));
        }
        Ok(())
    }
}

/// A pinhole camera with its pose in the world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Lens and image size.
    pub intrinsics: Intrinsics,
    /// The position and orientation.
    pub pose: Pose,
}

impl Camera {
    /// The same view with its image divided by the smallest whole number that makes the longer side at most
    /// `side` pixels.
    pub fn no_larger_than(&self, side: usize) -> Self {
        let lens = &self.intrinsics;
        let divisor = lens.width.max(lens.height).div_ceil(side.max(1)).max(1);
        Self { intrinsics: lens.downscaled(divisor), ..*self }
    }

    /// Checks lens and pose.
    pub fn validate(&self) -> Result<(), CameraError> {
        self.intrinsics.validate()?;
        self.pose.validate()
    }

    /// The pixel's ray in the camera frame, not normalised: `d(p) = ((u-cx)/fx, (v-cy)/fy, 1)`; `u`, `v` are
    /// pixel coordinates (centres at +0.5).
    #[inline]
    pub fn ray(&self, u: f64, v: f64) -> DVec3 {
        let k = &self.intrinsics;
        DVec3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0)
    }

    /// Projects a world point: pixel coordinates and depth along the optical axis. `None` at or behind the
    /// camera.
    pub fn project(&self, point: DVec3) -> Option<(DVec2, f64)> {
        let x = self.pose.rotation * point + self.pose.translation;
        let k = &self.intrinsics;
        (x.z > 0.0).then(|| (DVec2::new(k.fx * x.x / x.z + k.cx, k.fy * x.y / x.z + k.cy), x.z))
    }

    /// The same camera at pyramid level `divisor`.
    pub fn downscaled(&self, divisor: usize) -> Self {
        Self { intrinsics: self.intrinsics.downscaled(divisor), pose: self.pose }
    }
}

/// The similarity from COLMAP's world to the scene's normalised frame (R7): `x_normalised = scale (rotation
/// x_colmap) + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Uniform scale.
    pub scale: f64,
    /// Rotation.
    pub rotation: DMat3,
    /// Translation, in normalised units.
    pub translation: DVec3,
}

impl Frame {
    /// The frame that changes nothing.
    pub const IDENTITY: Self = Self { scale: 1.0, rotation: DMat3::IDENTITY, translation: DVec3::ZERO };

    /// Converts a COLMAP point to the normalised frame.
    pub fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point) + self.translation
    }

    /// Converts a normalised point back to COLMAP's frame.
    pub fn invert(&self, point: DVec3) -> DVec3 {
        self.rotation.transpose() * ((point - self.translation) / self.scale)
    }

    /// Converts a COLMAP pose to the normalised frame: same pixels, lengths scaled.
    pub fn apply_pose(&self, pose: &Pose) -> Pose {
        Pose::from_center(pose.rotation * self.rotation.transpose(), self.apply(pose.center()))
    }

    /// Converts a normalised pose back to COLMAP's frame.
    pub fn invert_pose(&self, pose: &Pose) -> Pose {
        Pose::from_center(pose.rotation * self.rotation, self.invert(pose.center()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_moves_points_and_cameras_together() {
        let frame = Frame {
            scale: 0.3,
            rotation: DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 0.7),
            translation: DVec3::new(1.0, -2.0, 0.5),
        };
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 60.0, cx: 30.0, cy: 25.0 };
        let pose = Pose::look_at(DVec3::new(1.0, 2.0, -3.0), DVec3::ZERO, DVec3::Y);
        let point = DVec3::new(0.1, 0.2, 0.3);
        let camera = Camera { intrinsics, pose };
        let moved = Camera { intrinsics, pose: frame.apply_pose(&pose) };
        let (a, za) = camera.project(point).unwrap();
        let (b, zb) = moved.project(frame.apply(point)).unwrap();
        assert!((a - b).length() < 1e-9 && (za * frame.scale - zb).abs() < 1e-12);
        assert!((frame.invert(frame.apply(point)) - point).length() < 1e-12);
        let back = frame.invert_pose(&moved.pose);
        assert!((back.translation - pose.translation).length() < 1e-12);
        camera.validate().unwrap();
    }

    #[test]
    fn a_smaller_image_shows_the_same_view() {
        let intrinsics = Intrinsics { width: 640, height: 360, fx: 500.0, fy: 510.0, cx: 320.0, cy: 180.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        assert_eq!(camera.no_larger_than(640), camera);
        let small = camera.no_larger_than(200);
        assert_eq!((small.intrinsics.width, small.intrinsics.height), (160, 90));
        let point = DVec3::new(0.3, -0.2, 2.0);
        let ((large, _), (small, _)) = (camera.project(point).unwrap(), small.project(point).unwrap());
        assert!((large / 4.0 - small).length() < 1e-9);
        assert_eq!(camera.no_larger_than(0).intrinsics.width, 1);
    }

    #[test]
    fn bad_cameras_are_named() {
        let good = Intrinsics { width: 4, height: 3, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        assert!(Intrinsics { fx: f64::NAN, ..good }.validate().unwrap_err().to_string().contains("fx"));
        assert!(Intrinsics { width: 0, ..good }.validate().is_err());
        let skew = Pose { rotation: DMat3::IDENTITY * 1.1, ..Pose::IDENTITY };
        assert!(skew.validate().is_err());
    }
}
