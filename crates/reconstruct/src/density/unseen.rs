//! Bounds Gaussians that no view has seen well: no streaks, and no fog beyond the last tracks.
//!
//! Views from almost one direction give no depth. A Gaussian seen only by such views may become arbitrarily
//! long along the view, or float anywhere in open water, and no photograph contradicts it. From another
//! direction it looks like a streak or fog. For every Gaussian, over the training views that have its
//! centre in their picture (occlusion is ignored; at most [`MOST_VIEWS`] views are used):
//!
//! ```text
//! u_v       unit directions to the cameras,       R = |Σ_v u_v| / n,      θ = √(2 (1 − R))   their spread
//! d         Σ_v u_v, normalised
//! σ_d       the standard deviation along d, √(dᵀ Σ d)
//! σ_⊥       the largest extent across d of the two axes that lie less along d
//! z_far     of a view: `beyond` times a depth; 99 of 100 sparse points in its picture are nearer than it
//! beyond    depth > z_far of every one of these views
//!
//! θ < spread                        ⇒   σ_d ≤ stretch · σ_⊥      (the axis that lies along d is shortened)
//! θ < spread and n < 3, or beyond   ⇒   largest σ ≤ width · (picture's width at the nearest view's depth)
//! beyond, or seen by no view        ⇒   opacity ≤ `opacity`
//! ```
//!
//! Only sizes and opacities are lowered, and Adam's moments stay, so that the training continues
//! undisturbed.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use use3d_capture::Camera;
use use3d_numerics::math;
use use3d_splat::{Gaussians, NEAR};

use super::logit;
use crate::Unseen;

/// Largest number of views used, spread over the capture.
const MOST_VIEWS: usize = 64;
/// A Gaussian seen by fewer views than this lies at the edge of a capture.
const FEW: u32 = 3;
/// The share of sparse points that define a view's far depth.
const LAST: f64 = 0.99;

/// A training view that bounds Gaussians: the part of it that is used here.
#[derive(Clone, Copy, Debug)]
struct BoundingView {
    camera: Camera,
    center: DVec3,
    /// z_far.
    far: f64,
}

/// The training views that decide which part of the scene can have been seen.
#[derive(Clone, Debug, Default)]
pub(crate) struct BoundingViews(Vec<BoundingView>);

/// The bounded parameters of one Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Bounded {
    log_scales: [f32; 3],
    opacity_logit: f32,
}

impl BoundingViews {
    /// The views with these cameras, of a scene with these sparse points.
    pub(crate) fn new(cameras: &[Camera], sparse: &[DVec3], beyond: f64) -> Self {
        let count = cameras.len().min(MOST_VIEWS);
        let view = |i: usize| {
            let camera = &cameras[i * cameras.len() / count];
            let mut depths: Vec<f64> = sparse.iter().filter_map(|p| depth(camera, *p)).collect();
            depths.sort_unstable_by(f64::total_cmp);
            let last = depths.get((LAST * depths.len() as f64) as usize).copied();
            BoundingView {
                camera: *camera,
                center: camera.pose.center(),
                far: last.map_or(f64::INFINITY, |z| beyond * z),
            }
        };
        Self((0..count).into_par_iter().map(view).collect())
    }

    /// Lowers sizes and opacities to the bounds.
    pub(crate) fn hold_back(&self, gaussians: &mut Gaussians, settings: &Unseen) {
        let bounded: Vec<Bounded> =
            (0..gaussians.len()).into_par_iter().map(|i| self.bounded(gaussians, i, settings)).collect();
        for (i, to) in bounded.into_iter().enumerate() {
            (gaussians.log_scales[i], gaussians.opacity_logits[i]) = (to.log_scales, to.opacity_logit);
        }
    }

    fn bounded(&self, gaussians: &Gaussians, i: usize, settings: &Unseen) -> Bounded {
        let mean = DVec3::from(gaussians.means[i].map(f64::from));
        let mut log_scales = gaussians.log_scales[i];
        let mut opacity_logit = gaussians.opacity_logits[i];
        let (mut sum, mut views, mut beyond, mut nearest) = (DVec3::ZERO, 0, true, f64::INFINITY);
        for view in &self.0 {
            let Some(z) = depth(&view.camera, mean) else { continue };
            sum += (view.center - mean).normalize_or_zero();
            views += 1;
            beyond &= z > view.far;
            let k = &view.camera.intrinsics;
            nearest = nearest.min(z * k.width as f64 / k.fx);
        }
        if views == 0 || beyond {
            opacity_logit = opacity_logit.min(logit(settings.opacity));
        }
        if views == 0 {
            return Bounded { log_scales, opacity_logit };
        }
        let spread = (2.0 * (1.0 - sum.length() / f64::from(views)).max(0.0)).sqrt();
        if spread < settings.spread {
            shorten(&mut log_scales, gaussians.quaternions[i], sum.normalize_or_zero(), settings.stretch);
        }
        if (spread < settings.spread && views < FEW) || beyond {
            let most = math::ln(settings.width * nearest) as f32;
            log_scales = log_scales.map(|s| s.min(most));
        }
        Bounded { log_scales, opacity_logit }
    }
}

/// The depth of a point; `None` if the point is not in the view's picture.
fn depth(camera: &Camera, point: DVec3) -> Option<f64> {
    let (at, z) = camera.project(point)?;
    let k = &camera.intrinsics;
    let inside = (0.0..k.width as f64).contains(&at.x) && (0.0..k.height as f64).contains(&at.y);
    (inside && z > NEAR).then_some(z)
}

/// Shortens the axis that lies along `direction` until the extent along it is at most `stretch` times the
/// largest extent of the two other axes across it, but not below the longer of these.
fn shorten(log_scales: &mut [f32; 3], q: [f32; 4], direction: DVec3, stretch: f64) {
    let q = DQuat::from_xyzw(q[1].into(), q[2].into(), q[3].into(), q[0].into());
    let length = q.length();
    if length == 0.0 || !length.is_finite() {
        return;
    }
    // The direction in the Gaussian's own axes.
    let d = DMat3::from_quat(q.normalize()).transpose() * direction;
    let scales = log_scales.map(|s| math::exp(f64::from(s)));
    let along: [f64; 3] = std::array::from_fn(|k| scales[k] * d[k]);
    let axis = (1..3).fold(0, |a, k| if along[k].abs() > along[a].abs() { k } else { a });
    let others = || (0..3).filter(|k| *k != axis);
    let across = others().map(|k| scales[k] * (1.0 - d[k] * d[k]).max(0.0).sqrt()).fold(0.0, f64::max);
    let of_others = others().map(|k| along[k] * along[k]).sum::<f64>();
    let most = (stretch * across) * (stretch * across);
    if along[axis] * along[axis] + of_others > most {
        let longest = others().map(|k| scales[k]).fold(0.0, f64::max);
        let shortened = ((most - of_others).max(0.0).sqrt() / d[axis].abs()).max(longest).min(scales[axis]);
        log_scales[axis] = math::ln(shortened) as f32;
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{Intrinsics, Pose};

    use super::*;
    use crate::engine::zeros;

    fn camera(eye: DVec3, target: DVec3) -> Camera {
        let intrinsics = Intrinsics { width: 200, height: 150, fx: 180.0, fy: 180.0, cx: 100.0, cy: 75.0 };
        Camera { intrinsics, pose: Pose::look_at(eye, target, -DVec3::Y) }
    }

    /// Sparse points in front of cameras that look along z; the last ones are at z = 4.
    fn sparse() -> Vec<DVec3> {
        let at = |i: i32, j: i32| {
            DVec3::new(0.1 * f64::from(i - 5), 0.1 * f64::from(j - 5), 2.0 + 0.2 * f64::from(j))
        };
        (0..11).flat_map(|i| (0..11).map(move |j| at(i, j))).collect()
    }

    /// A single Gaussian of opacity 0.9.
    fn one(mean: [f32; 3], scales: [f32; 3]) -> Gaussians {
        let mut g = zeros(1, 0);
        g.means[0] = mean;
        g.log_scales[0] = scales.map(math::ln);
        g.quaternions[0] = [2.0, 0.0, 0.0, 0.0];
        g.opacity_logits[0] = logit(0.9);
        g
    }

    fn held(cameras: &[Camera], mut g: Gaussians) -> ([f32; 3], f32, bool) {
        let settings = Unseen::default();
        let bounding_views = BoundingViews::new(cameras, &sparse(), settings.beyond);
        let before = g.clone();
        bounding_views.hold_back(&mut g, &settings);
        let same = before.log_scales == g.log_scales && before.opacity_logits == g.opacity_logits;
        let opacity = 1.0 / (1.0 + math::exp(-g.opacity_logits[0]));
        (g.log_scales[0].map(math::exp), opacity, !same)
    }

    fn in_a_row(spacing: f64) -> Vec<Camera> {
        (-2..=2)
            .map(|i| {
                let eye = DVec3::new(spacing * f64::from(i), 0.0, 0.0);
                camera(eye, eye + DVec3::Z)
            })
            .collect()
    }

    fn close(a: [f32; 3], b: [f32; 3]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-4 * b)
    }

    #[test]
    fn a_streak_that_only_one_direction_shows_is_shortened() {
        let streak = || one([0.0, 0.0, 3.0], [0.01, 0.02, 0.5]);
        let (scales, opacity, changed) = held(&in_a_row(0.05), streak());
        assert!(close(scales, [0.01, 0.02, 0.06]), "{scales:?}");
        assert!((opacity - 0.9).abs() < 1e-6 && changed);
        // Views from several directions see its length.
        let (scales, _, changed) = held(&in_a_row(0.6), streak());
        assert!(close(scales, [0.01, 0.02, 0.5]) && !changed, "{scales:?}");
        // Across the view a Gaussian may have any length.
        let (_, _, changed) = held(&in_a_row(0.05), one([0.0, 0.0, 3.0], [0.5, 0.02, 0.01]));
        assert!(!changed);
        // A single view also bounds the size: 0.05 of 3 · 200/180.
        let (scales, ..) = held(&in_a_row(0.05)[..1], one([0.0, 0.0, 3.0], [0.5, 0.02, 0.01]));
        assert!(close(scales, [0.05 * 3.0 * 200.0 / 180.0, 0.02, 0.01]), "{scales:?}");
    }

    #[test]
    fn fog_beyond_the_last_tracks_and_where_no_view_looks_gets_faint() {
        let cameras = in_a_row(0.6);
        let (scales, opacity, _) = held(&cameras, one([0.0, 0.0, 9.0], [2.0, 0.1, 2.0]));
        let most = 0.05 * 9.0 * 200.0 / 180.0;
        assert!(close(scales, [most, 0.1, most]) && (opacity - 0.5).abs() < 1e-6, "{scales:?} {opacity}");
        // In front of the last tracks nothing changes; behind all cameras only the opacity does.
        assert!(!held(&cameras, one([0.0, 0.0, 3.9], [2.0, 0.1, 2.0])).2);
        let (scales, opacity, changed) = held(&cameras, one([0.0, 0.0, -9.0], [2.0, 0.1, 2.0]));
        assert!(close(scales, [2.0, 0.1, 2.0]) && (opacity - 0.5).abs() < 1e-6 && changed);
        // Faint Gaussians stay unchanged.
        let mut faint = one([0.0, 0.0, -9.0], [2.0, 0.1, 2.0]);
        faint.opacity_logits[0] = -3.0;
        assert!(!held(&cameras, faint).2);
        // Without sparse points no depth counts as far.
        let mut g = one([0.0, 0.0, 90.0], [2.0, 0.1, 2.0]);
        let settings = Unseen::default();
        let before = g.clone();
        BoundingViews::new(&in_a_row(30.0), &[], settings.beyond).hold_back(&mut g, &settings);
        assert_eq!((g.log_scales, g.opacity_logits), (before.log_scales, before.opacity_logits));
    }

    #[test]
    fn the_second_time_changes_nothing_more() {
        let cameras = in_a_row(0.05);
        let settings = Unseen::default();
        let bounding_views = BoundingViews::new(&cameras, &sparse(), settings.beyond);
        // The second one is a needle that is tilted by a tenth of a turn.
        let half = 0.1 * std::f32::consts::PI;
        for quaternion in [[2.0, 0.0, 0.0, 0.0], [math::cos(half), math::sin(half), 0.0, 0.0]] {
            let mut g = one([0.0, 0.0, 3.0], [0.01, 0.02, 0.5]);
            g.quaternions[0] = quaternion;
            bounding_views.hold_back(&mut g, &settings);
            let once = g.clone();
            assert!(once.log_scales[0][2] < math::ln(0.1), "{:?}", once.log_scales);
            bounding_views.hold_back(&mut g, &settings);
            let off = (g.log_scales[0][2] - once.log_scales[0][2]).abs();
            assert!(off < 1e-5, "{off}");
        }
    }
}
