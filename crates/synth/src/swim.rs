//! The swimmer's path along the sand channel: it sways, the camera points ahead and down, and nothing is
//! touched.

use glam::{DVec3, Vec3};
use use3d_capture::{Camera, Intrinsics, Pose};
use use3d_numerics::math;

use crate::scene::{Draws, Terrain};

/// A lens of about 67 degrees horizontally, with the principal point off the centre by a few pixels, as in
/// calibrations.
pub(crate) fn lens(width: usize, height: usize, draws: &mut Draws) -> Intrinsics {
    let f = 0.76 * width as f64;
    let off = |amount: f32, draws: &mut Draws| f64::from(draws.about(amount));
    Intrinsics {
        width,
        height,
        fx: f * (1.0 + off(0.002, draws)),
        fy: f,
        cx: width as f64 * (0.5 + off(0.008, draws)),
        cy: height as f64 * (0.5 + off(0.008, draws)),
    }
}

/// The height of the floor under the swimmer, smoothed like a swimmer's path.
fn floor(terrain: &Terrain, x: f32, y: f32) -> f32 {
    let offsets = [-0.9, -0.45, 0.0, 0.45, 0.9];
    let sum: f32 = offsets
        .iter()
        .flat_map(|dx| offsets.iter().map(move |dy| (dx, dy)))
        .fold(0.0, |s, (dx, dy)| s + terrain.height(x + 0.7 * dx, y + dy));
    sum / 25.0
}

/// Largest distance from one view to the next, metres: neighbours must overlap.
const STRIDE: f32 = 0.18;

/// The longest way out, metres; the way back has the same length.
const LONGEST: f32 = 6.0;
/// Height of the way back above the way out, metres.
const RISE: f32 = 1.2;

/// `views` cameras along the swim, in metres: out along the channel, then back at a greater height, still
/// pointing ahead, so that the reef is seen through different amounts of water. The length is limited by the
/// stride, and to six metres.
pub(crate) fn path(terrain: &Terrain, seed: u64, views: usize, intrinsics: &Intrinsics) -> Vec<Camera> {
    let mut draws = Draws::new(seed, "swim", 0);
    let tau = std::f32::consts::TAU;
    let phases: [f32; 5] = std::array::from_fn(|_| draws.range(0.0, tau));
    let side = if draws.below(2) == 0 { 1.0 } else { -1.0 };
    let length = (0.5 * STRIDE * views.saturating_sub(1) as f32).min(LONGEST);
    let part = length / LONGEST;
    (0..views)
        .map(|i| {
            let way = 2.0 * i as f32 / views.saturating_sub(1).max(1) as f32;
            let t = part * way.min(2.0 - way);
            // The path rises over the last half metre out and the first half metre back.
            let rise = ((way - 1.0) * length + 0.5).clamp(0.0, 1.0);
            let back = rise * rise * (3.0 - 2.0 * rise);
            let sway = |cycles: f32, phase: f32| math::sin(tau * cycles * t + phase);
            let y = -0.7 + LONGEST * t + 0.05 * sway(6.0, phases[0]);
            let x = terrain.channel_center(y)
                + side * 0.75 * math::sin(tau * 1.25 * t)
                + 0.06 * sway(7.0, phases[1]);
            let z = floor(terrain, x, y)
                + 1.5
                + RISE * back
                + 0.22 * sway(1.6, phases[2])
                + 0.03 * sway(8.0, phases[3]);
            let eye = Vec3::new(x, y, z);
            let ahead = y + 4.2;
            let gaze_x = terrain.channel_center(ahead) * 0.8 + 0.55 * sway(1.1, phases[4]);
            let gaze =
                Vec3::new(gaze_x, ahead, floor(terrain, gaze_x, ahead) + 0.42 + 0.12 * sway(2.3, phases[1]));
            let roll = 0.05 * sway(3.1, phases[0]);
            let up = DVec3::new(f64::from(roll), 0.0, 1.0);
            Camera { intrinsics: *intrinsics, pose: Pose::look_at(eye.as_dvec3(), gaze.as_dvec3(), up) }
        })
        .collect()
}

/// One camera at a random place over the reef, nearer in turbid water (`nearness` 0 to 1).
pub(crate) fn snapshot(
    terrain: &Terrain,
    draws: &mut Draws,
    intrinsics: &Intrinsics,
    nearness: f32,
) -> Camera {
    let y = draws.range(-0.7, 6.5);
    let x = terrain.channel_center(y) + draws.about(0.9);
    let altitude = draws.range(1.0, 1.9) * (1.0 - 0.35 * nearness);
    let eye = Vec3::new(x, y, floor(terrain, x, y) + altitude);
    let reach = draws.range(1.6, 4.5) * (1.0 - 0.5 * nearness);
    let turn = draws.about(0.75);
    let (gx, gy) = (x + reach * math::sin(turn), y + reach * math::cos(turn));
    let gaze = Vec3::new(gx, gy, floor(terrain, gx, gy) + draws.range(0.1, 0.5));
    let up = DVec3::new(f64::from(draws.about(0.12)), 0.0, 1.0);
    Camera { intrinsics: *intrinsics, pose: Pose::look_at(eye.as_dvec3(), gaze.as_dvec3(), up) }
}
