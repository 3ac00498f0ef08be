//! The coordinates of a file and those of the model behind it: `x_saved = scale (A x + a)`.

use glam::{DMat3, DVec3};
use use3d_capture::Pose;

/// The similarity that was applied when a file was written.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Applied {
    /// `A`, a rotation.
    pub(crate) rotation: DMat3,
    /// `a`.
    pub(crate) translation: DVec3,
    /// The scale, above 0.
    pub(crate) scale: f64,
}

impl Applied {
    pub(crate) const NONE: Self = Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO, scale: 1.0 };

    /// The exchange of axes by which `ns-process-data` makes z point up: `(x, y, z) → (x, z, -y)`.
    pub(crate) const UPRIGHT: Self = Self {
        rotation: DMat3::from_cols(DVec3::X, DVec3::new(0.0, 0.0, -1.0), DVec3::Y),
        translation: DVec3::ZERO,
        scale: 1.0,
    };

    pub(crate) fn apply(&self, point: DVec3) -> DVec3 {
        self.scale * (self.rotation * point + self.translation)
    }

    pub(crate) fn undo(&self, point: DVec3) -> DVec3 {
        self.rotation.transpose() * (point / self.scale - self.translation)
    }

    /// A pose of the model from a saved camera-to-world rotation with OpenGL's camera axes, and its centre.
    pub(crate) fn pose(&self, saved: DMat3, center: DVec3) -> Pose {
        let to_world = self.rotation.transpose() * flipped(saved);
        Pose::from_center(to_world.transpose(), self.undo(center))
    }

    /// The camera-to-world rotation with OpenGL's axes and the centre that are saved for a pose.
    pub(crate) fn saved(&self, pose: &Pose) -> (DMat3, DVec3) {
        (flipped(self.rotation * pose.rotation.transpose()), self.apply(pose.center()))
    }
}

/// The same rotation for camera axes with y and z reversed.
fn flipped(to_world: DMat3) -> DMat3 {
    DMat3::from_cols(to_world.x_axis, -to_world.y_axis, -to_world.z_axis)
}
