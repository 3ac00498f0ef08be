//! The pose of the camera at any time of a film, between the frames whose poses are known.
//!
//! Known: times `t_k` (seconds, rising), centres `c_k` (scene units) and world-to-camera rotations `q_k`
//! (unit quaternions). For `t_k ≤ t < t_{k+1}`, with `x_i` the centre or the rotation of frame `i`:
//!
//! ```text
//! A_i(t) = mix(x_i, x_{i+1}, (t - t_i) / (t_{i+1} - t_i))            i = k-1, k, k+1
//! B_i(t) = mix(A_{i-1}, A_i, (t - t_{i-1}) / (t_{i+1} - t_{i-1}))    i = k, k+1
//! x(t)   = mix(B_k, B_{k+1}, (t - t_k) / (t_{k+1} - t_k))
//! ```
//!
//! `mix(a, b, s)` is `a + s (b - a)` for centres and `a exp(s log(a⁻¹ b))` for rotations, the slerp. This is
//! a Catmull–Rom curve whose knots are the times, on SE(3) as the product of its two parts. It passes through
//! every known pose. Its velocity is continuous, also with uneven spacing. A camera that moves and turns
//! evenly is met exactly. A rigid motion of the world moves the curve with it.
//!
//! At an end, the missing neighbour is the mirrored one: `x_{k-1} = mix(x_{k+1}, x_k, 2)` at
//! `2 t_k - t_{k+1}`. A gap above the limit is an end, too. Nothing is extrapolated.

use glam::{DQuat, DVec3};
use use3d_capture::Pose;
use use3d_numerics::math;
use use3d_numerics::order::median;

/// The largest gap between two known frames over which poses are computed by default, seconds.
///
/// Divers and their cameras swing with swells of 4 seconds and more. Over half of such a period, the two ends
/// of a gap say nothing about the movement between them.
pub const LARGEST_GAP: f64 = 2.0;

/// The pose at a time of a film.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum FilmPose {
    /// The time is a known frame's, or lies between two known frames that are near enough.
    Known {
        /// The pose.
        pose: Pose,
        /// Seconds between the known frames before and after the time; 0 at a known frame.
        gap_seconds: f64,
        /// Seconds to the nearest known frame.
        nearest_seconds: f64,
    },
    /// No pose is near: the time lies before or after all known frames, or in too large a gap.
    Far {
        /// Seconds to the nearest known frame; infinite if none is known.
        nearest_seconds: f64,
    },
}

impl FilmPose {
    /// The pose; `None` if no known frame is near.
    pub fn pose(&self) -> Option<Pose> {
        match self {
            Self::Known { pose, .. } => Some(*pose),
            Self::Far { .. } => None,
        }
    }
}

/// A known frame.
#[derive(Clone, Copy, Debug)]
struct Knot {
    seconds: f64,
    pose: Pose,
    center: DVec3,
    rotation: DQuat,
}

impl Knot {
    fn new(seconds: f64, pose: Pose) -> Self {
        Self { seconds, pose, center: pose.center(), rotation: DQuat::from_mat3(&pose.rotation).normalize() }
    }

    /// The value of the line through two knots at a time.
    fn mix(a: &Self, b: &Self, seconds: f64) -> Self {
        let share = (seconds - a.seconds) / (b.seconds - a.seconds);
        let (center, rotation) =
            (a.center + share * (b.center - a.center), slerp(a.rotation, b.rotation, share));
        Self { seconds, center, rotation, ..*a }
    }

    /// The knot beyond `near`, seen from `far`.
    fn mirrored(far: &Self, near: &Self) -> Self {
        Self::mix(far, near, 2.0 * near.seconds - far.seconds)
    }
}

/// `a exp(s log(a⁻¹ b))` on the shorter way, also for `s` outside of `[0, 1]`.
fn slerp(a: DQuat, b: DQuat, s: f64) -> DQuat {
    let way = a.conjugate() * b;
    let way = if way.w < 0.0 { -way } else { way };
    let axis = way.xyz();
    let sine = axis.length();
    // Of a turn this small, only the identity is known in double precision.
    if sine < 1e-15 {
        return a;
    }
    let (sin, cos) = math::sin_cos(s * math::atan2(sine, way.w));
    let part = axis * (sin / sine);
    (a * DQuat::from_xyzw(part.x, part.y, part.z, cos)).normalize()
}

/// The curve through the known poses of a film.
#[derive(Clone, Debug)]
pub struct FilmPath {
    knots: Vec<Knot>,
    largest_gap: f64,
}

impl FilmPath {
    /// The curve through these poses, each with its time in seconds, in any order. Poses with a number that
    /// is not finite are left out, and so are all but the first at one time. In a gap of more than
    /// `largest_gap` seconds there is no pose; `None` stands for [`default_gap`](Self::default_gap).
    pub fn new(known: &[(f64, Pose)], largest_gap: Option<f64>) -> Self {
        let usable = known.iter().filter(|(seconds, pose)| seconds.is_finite() && pose.validate().is_ok());
        let mut knots: Vec<Knot> = usable.map(|(seconds, pose)| Knot::new(*seconds, *pose)).collect();
        knots.sort_by(|a, b| a.seconds.total_cmp(&b.seconds));
        knots.dedup_by(|later, first| later.seconds == first.seconds);
        let times: Vec<f64> = knots.iter().map(|k| k.seconds).collect();
        Self { knots, largest_gap: largest_gap.unwrap_or_else(|| Self::default_gap(&times)) }
    }

    /// The largest gap by default, seconds: [`LARGEST_GAP`], or one and a half median spacings if the known
    /// frames are farther apart. So one sparse film keeps its poses, and loses those where a frame is
    /// missing.
    pub fn default_gap(times: &[f64]) -> f64 {
        let spacing = median(times.windows(2).map(|pair| pair[1] - pair[0]));
        LARGEST_GAP.max(spacing.map_or(0.0, |median| 1.5 * median))
    }

    /// The largest gap over which poses are computed, seconds.
    pub fn largest_gap(&self) -> f64 {
        self.largest_gap
    }

    /// The first and the last known time, seconds; `None` if no pose is known.
    pub fn range(&self) -> Option<(f64, f64)> {
        Some((self.knots.first()?.seconds, self.knots.last()?.seconds))
    }

    /// The pose at a time, seconds.
    pub fn at(&self, seconds: f64) -> FilmPose {
        let after = self.knots.partition_point(|k| k.seconds <= seconds);
        let (before, next) = (after.checked_sub(1).map(|i| &self.knots[i]), self.knots.get(after));
        let apart = |knot: Option<&Knot>| knot.map_or(f64::INFINITY, |k| (k.seconds - seconds).abs());
        // Compared with NaN, every number is the larger one.
        let nearest_seconds = apart(before).min(apart(next));
        let (Some(first), false) = (before, seconds.is_nan()) else {
            return FilmPose::Far { nearest_seconds };
        };
        if first.seconds == seconds {
            return FilmPose::Known { pose: first.pose, gap_seconds: 0.0, nearest_seconds };
        }
        let gap_seconds = next.map_or(f64::INFINITY, |k| k.seconds - first.seconds);
        match next {
            Some(_) if gap_seconds <= self.largest_gap => {
                let pose = self.between(after - 1, seconds);
                FilmPose::Known { pose, gap_seconds, nearest_seconds }
            }
            _ => FilmPose::Far { nearest_seconds },
        }
    }

    /// The pose between knot `k` and the next one.
    fn between(&self, k: usize, seconds: f64) -> Pose {
        let near = |i: Option<usize>, to: &Knot| {
            let knot = i.and_then(|i| self.knots.get(i));
            knot.filter(|knot| (knot.seconds - to.seconds).abs() <= self.largest_gap)
        };
        let (x1, x2) = (&self.knots[k], &self.knots[k + 1]);
        let x0 = near(k.checked_sub(1), x1).copied().unwrap_or_else(|| Knot::mirrored(x2, x1));
        let x3 = near(Some(k + 2), x2).copied().unwrap_or_else(|| Knot::mirrored(x1, x2));
        let line = |a: &Knot, b: &Knot| Knot::mix(a, b, seconds);
        let (a0, a1, a2) = (line(&x0, x1), line(x1, x2), line(x2, &x3));
        let over = |from: &Knot, to: &Knot, a: Knot, b: Knot| {
            line(&Knot { seconds: from.seconds, ..a }, &Knot { seconds: to.seconds, ..b })
        };
        let (b1, b2) = (over(&x0, x2, a0, a1), over(x1, &x3, a1, a2));
        let end = over(x1, x2, b1, b2);
        Pose::from_center(glam::DMat3::from_quat(end.rotation), end.center)
    }
}

#[cfg(test)]
#[path = "path_tests.rs"]
mod tests;
