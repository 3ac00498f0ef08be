//! Camera paths for films: a smooth swim through given cameras, and a spiral around the one in their middle.

use glam::{DMat3, DQuat, DVec3};
use use3d_numerics::math;

use crate::{Camera, Pose};

/// Returns `frames` cameras along a smooth curve through `keys` in their order.
///
/// Centres follow a centripetal Catmull–Rom spline (it passes through every key and does not overshoot where
/// keys are close together). Orientations follow a spherical interpolation, and the frames are evenly spaced
/// in arc length. The lens is the first key's. A single key gives copies of it, no key an empty path.
pub fn interpolate(keys: &[Camera], frames: usize) -> Vec<Camera> {
    let Some(first) = keys.first() else { return Vec::new() };
    if keys.len() == 1 || frames == 0 {
        return vec![*first; frames];
    }
    let centers: Vec<DVec3> = keys.iter().map(|k| k.pose.center()).collect();
    let rotations: Vec<DQuat> = keys.iter().map(|k| DQuat::from_mat3(&k.pose.rotation)).collect();

    // Arc length of the curve, sampled finely, so that the film has a constant speed between unevenly spaced
    // keys.
    const SAMPLES: usize = 32;
    let segments = keys.len() - 1;
    let mut lengths = vec![0.0];
    let mut last = centers[0];
    for i in 1..=segments * SAMPLES {
        let point = spline(&centers, i as f64 / SAMPLES as f64);
        lengths.push(lengths[i - 1] + (point - last).length());
        last = point;
    }
    let total = lengths[segments * SAMPLES];

    (0..frames)
        .map(|f| {
            let share = if frames == 1 { 0.0 } else { f as f64 / (frames - 1) as f64 };
            let t = if total > 0.0 {
                let target = share * total;
                let i = lengths.partition_point(|&l| l < target).clamp(1, segments * SAMPLES);
                let span = lengths[i] - lengths[i - 1];
                let inside = if span > 0.0 { (target - lengths[i - 1]) / span } else { 0.0 };
                (i as f64 - 1.0 + inside) / SAMPLES as f64
            } else {
                share * segments as f64
            };
            let k = (t.floor() as usize).min(segments - 1);
            let rotation = rotations[k].slerp(rotations[k + 1], t - k as f64);
            let pose = Pose::from_center(DMat3::from_quat(rotation), spline(&centers, t));
            Camera { intrinsics: first.intrinsics, pose }
        })
        .collect()
}

/// The centripetal Catmull–Rom curve through `points` at parameter `t` (point `i` is at `t = i`).
fn spline(points: &[DVec3], t: f64) -> DVec3 {
    let last = points.len() - 1;
    let k = (t.floor().max(0.0) as usize).min(last - 1);
    let (p1, p2) = (points[k], points[k + 1]);
    // Reflected end points: the curve is straight at its ends.
    let p0 = if k == 0 { 2.0 * p1 - p2 } else { points[k - 1] };
    let p3 = if k + 2 > last { 2.0 * p2 - p1 } else { points[k + 2] };
    let knot = |a: DVec3, b: DVec3| (b - a).length().sqrt().max(1e-9);
    let (t0, t1) = (0.0, knot(p0, p1));
    let t2 = t1 + knot(p1, p2);
    let t3 = t2 + knot(p2, p3);
    let s = t1 + (t - k as f64) * (t2 - t1);
    let lerp = |a: DVec3, b: DVec3, ta: f64, tb: f64| a * ((tb - s) / (tb - ta)) + b * ((s - ta) / (tb - ta));
    let (a1, a2, a3) = (lerp(p0, p1, t0, t1), lerp(p1, p2, t1, t2), lerp(p2, p3, t2, t3));
    lerp(lerp(a1, a2, t0, t2), lerp(a2, a3, t1, t3), t1, t2)
}

/// The camera nearest to the centre of all. Between cameras nobody was, so the scene may be unknown there.
pub fn middle(cameras: &[Camera]) -> Option<&Camera> {
    let center = cameras.iter().map(|k| k.pose.center()).sum::<DVec3>() / cameras.len() as f64;
    let away = |k: &Camera| (k.pose.center() - center).length_squared();
    cameras.iter().min_by(|a, b| away(a).total_cmp(&away(b)))
}

/// Returns `frames` cameras that circle once around a camera, looking at the scene in front of it at distance
/// `focus`.
///
/// The circle is in the camera's image plane with `radius` (scene units) and is half as high as wide, with a
/// gentle dolly along the axis.
pub fn spiral(key: &Camera, frames: usize, radius: f64, focus: f64) -> Vec<Camera> {
    let (center, rotation) = (key.pose.center(), key.pose.rotation);
    let (right, up, forward) = (rotation.row(0), -rotation.row(1), rotation.row(2));
    let target = center + focus * forward;
    (0..frames)
        .map(|f| {
            let phase = std::f64::consts::TAU * f as f64 / frames as f64;
            let offset = radius
                * (math::cos(phase) * right
                    + 0.5 * math::sin(phase) * up
                    + 0.25 * math::sin(2.0 * phase) * forward);
            Camera { intrinsics: key.intrinsics, pose: Pose::look_at(center + offset, target, up) }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Intrinsics;

    fn keys() -> Vec<Camera> {
        let intrinsics = Intrinsics { width: 8, height: 6, fx: 8.0, fy: 8.0, cx: 4.0, cy: 3.0 };
        [DVec3::ZERO, DVec3::new(1.0, 0.2, 0.0), DVec3::new(1.1, 0.3, 0.4), DVec3::new(3.0, 0.0, 0.5)]
            .iter()
            .map(|&eye| Camera {
                intrinsics,
                pose: Pose::look_at(eye, eye + DVec3::new(0.1 * eye.x, 0.0, 1.0), -DVec3::Y),
            })
            .collect()
    }

    #[test]
    fn the_swim_starts_and_ends_at_its_keys_and_moves_evenly() {
        let keys = keys();
        let path = interpolate(&keys, 101);
        assert!((path[0].pose.center() - keys[0].pose.center()).length() < 1e-9);
        assert!((path[100].pose.center() - keys[3].pose.center()).length() < 1e-9);
        let steps: Vec<f64> =
            path.windows(2).map(|w| (w[1].pose.center() - w[0].pose.center()).length()).collect();
        let (low, high) = steps.iter().fold((f64::MAX, 0.0f64), |(l, h), &s| (l.min(s), h.max(s)));
        assert!(high < 1.2 * low, "{low} {high}");
        path.iter().for_each(|c| c.validate().unwrap());
        assert_eq!(interpolate(&keys[..1], 3).len(), 3);
        assert!(interpolate(&[], 3).is_empty());
    }

    #[test]
    fn the_spiral_stays_at_a_camera_and_keeps_its_target_in_the_middle() {
        let keys = keys();
        let key = middle(&keys).unwrap();
        assert_eq!(key.pose.center(), keys[2].pose.center());
        for camera in spiral(key, 24, 0.3, 2.0) {
            camera.validate().unwrap();
            assert!((camera.pose.center() - key.pose.center()).length() < 0.32);
            let target = key.pose.center() + 2.0 * key.pose.rotation.row(2);
            let (pixel, _) = camera.project(target).unwrap();
            assert!((pixel.x - 4.0).abs() < 1e-9 && (pixel.y - 3.0).abs() < 1e-9);
        }
        assert_eq!(middle(&[]), None);
    }
}
