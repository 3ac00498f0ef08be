//! Pose normalisation (R7): the similarity from COLMAP's world to a frame in which the constants of the
//! training apply.
//!
//! With camera centres `o_i` and up vectors `u_i = -R_iᵀ e_y`, over all registered images:
//!
//! 1. axes are exchanged so that COLMAP's −y becomes +z: `P = (x, z, −y)`;
//! 2. the smallest rotation `Q` takes the mean of `P u_i` to +z;
//! 3. the mean of `Q P o_i` becomes the origin;
//! 4. the largest absolute coordinate of any centre becomes 1.
//!
//! `x' = s Q P x − s mean(Q P o)`. Without step 1 the frame would differ only by a rotation about z; with it,
//! the frame equals that of the tools that the method's authors use.

use glam::{DMat3, DVec3};
use use3d_capture::{Frame, Pose};

/// The frame of a set of poses.
pub(crate) fn frame(poses: &[Pose]) -> Frame {
    if poses.is_empty() {
        return Frame::IDENTITY;
    }
    let exchange =
        DMat3::from_cols(DVec3::new(1.0, 0.0, 0.0), DVec3::new(0.0, 0.0, -1.0), DVec3::new(0.0, 1.0, 0.0));
    let n = poses.len() as f64;
    let up: DVec3 =
        poses.iter().map(|p| exchange * (p.rotation.transpose() * DVec3::NEG_Y)).sum::<DVec3>() / n;
    let rotation = rotation_to_z(up) * exchange;
    let centers: Vec<DVec3> = poses.iter().map(|p| rotation * p.center()).collect();
    let mean = centers.iter().copied().sum::<DVec3>() / n;
    let largest = centers.iter().fold(0.0f64, |m, c| m.max((*c - mean).abs().max_element()));
    let scale = if largest > 1e-12 && largest.is_finite() { 1.0 / largest } else { 1.0 };
    Frame { scale, rotation, translation: -scale * mean }
}

/// The smallest rotation that takes a direction to +z: the identity for a zero vector, a half turn for −z.
fn rotation_to_z(direction: DVec3) -> DMat3 {
    let Some(d) = direction.try_normalize() else { return DMat3::IDENTITY };
    if d.z < -1.0 + 1e-12 {
        return DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    }
    // Rodrigues: I + [v] + [v]² / (1 + c), with v = d × z and c = d·z.
    let v = d.cross(DVec3::Z);
    let cross =
        DMat3::from_cols(DVec3::new(0.0, v.z, -v.y), DVec3::new(-v.z, 0.0, v.x), DVec3::new(v.y, -v.x, 0.0));
    DMat3::IDENTITY + cross + cross * cross * (1.0 / (1.0 + d.z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_camera_as_colmap_likes_it_keeps_x_and_stands_upright() {
        // Two upright cameras: COLMAP's y points down, so up is −y.
        let pose = |x: f64| Pose::from_center(DMat3::IDENTITY, DVec3::new(x, 5.0, 7.0));
        let frame = frame(&[pose(1.0), pose(5.0)]);
        assert!((frame.scale - 0.5).abs() < 1e-15);
        let moved = frame.apply(DVec3::new(3.0, 5.0, 9.0));
        assert!((moved - DVec3::new(0.0, 1.0, 0.0)).length() < 1e-12, "forward becomes +y: {moved}");
        let moved = frame.apply(DVec3::new(3.0, 3.0, 7.0));
        assert!((moved - DVec3::new(0.0, 0.0, 1.0)).length() < 1e-12, "up becomes +z: {moved}");
    }

    #[test]
    fn degenerate_sets_get_a_frame_too() {
        let one = Pose::from_center(DMat3::IDENTITY, DVec3::splat(3.0));
        assert_eq!(frame(&[one]).scale, 1.0);
        let flipped = Pose::from_center(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)), DVec3::ZERO);
        let both = frame(&[Pose::IDENTITY, flipped]); // the up vectors cancel
        assert!(both.rotation.is_finite() && (both.rotation.determinant() - 1.0).abs() < 1e-12);
        let down = frame(&[flipped]);
        let up = down.rotation * DVec3::Y;
        assert!((up - DVec3::Z).length() < 1e-12, "{up}");
    }

    proptest! {
        #[test]
        fn centres_fill_the_cube_and_the_mean_up_is_z(seed in prop::collection::vec((-1.0f64..1.0, -1.0f64..1.0, -1.0f64..1.0, 0.0f64..6.0), 2..12)) {
            let poses: Vec<Pose> = seed
                .iter()
                .map(|&(x, y, z, a)| {
                    let axis = DVec3::new(y, z + 1.5, x).normalize();
                    Pose::from_center(DMat3::from_axis_angle(axis, a * 0.3), 10.0 * DVec3::new(x, y, z))
                })
                .collect();
            let frame = frame(&poses);
            let moved: Vec<Pose> = poses.iter().map(|p| frame.apply_pose(p)).collect();
            let mean = moved.iter().map(Pose::center).sum::<DVec3>() / moved.len() as f64;
            prop_assert!(mean.length() < 1e-9);
            let largest = moved.iter().fold(0.0f64, |m, p| m.max(p.center().abs().max_element()));
            prop_assert!((largest - 1.0).abs() < 1e-9);
            let up = moved.iter().map(|p| p.rotation.transpose() * DVec3::NEG_Y).sum::<DVec3>().normalize();
            prop_assert!((up - DVec3::Z).length() < 1e-9);
            prop_assert!((frame.rotation.determinant() - 1.0).abs() < 1e-9);
        }
    }
}
