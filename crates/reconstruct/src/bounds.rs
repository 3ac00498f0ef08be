//! How many Gaussians a run may have, and the memory that it takes.
//!
//! Both follow from the capture and the parameters alone, never from the machine: a scene is the same wherever it is made. Without a
//! `max_gaussians` the bound is
//!
//! ```text
//! clamp( max(pixels of the training views / 8, 4 × initial points), 250 000, 4 000 000 )
//! ```
//!
//! It is there to end growth that has gone wrong, not to shape a scene: eight pixels for every Gaussian is several times what scenes
//! reach by themselves.

use use3d_capture::Capture;

use crate::ReconstructParams;
use crate::initialise::FEWEST_POINTS;

const PIXELS_PER_GAUSSIAN: usize = 8;
const GROWTH: usize = 4;
const FEWEST: usize = 250_000;
const MOST: usize = 4_000_000;

/// Parameters, gradients, two moments, statistics, what is projected and listed of a Gaussian.
const BYTES_TO_BEGIN: u64 = 1500;
/// The same in a scene that has grown, with the state while a checkpoint is read.
const BYTES_WHEN_GROWN: u64 = 2500;
/// The images, maps and gradients of a step, per pixel of the largest view.
const BYTES_PER_PIXEL: u64 = 4 * (3 * 9 + 6);
/// A stored pixel, at least.
const BYTES_PER_STORED_PIXEL: u64 = 3;

/// Gaussians that the capture starts with before the bound holds: one per finite sparse point, random ones where those are few.
pub(crate) fn initial_gaussians(capture: &Capture, params: &ReconstructParams) -> usize {
    let points = capture.points.iter().filter(|p| p.position.is_finite()).count();
    if points < FEWEST_POINTS { points.saturating_add(params.random_points) } else { points }
}

/// The most Gaussians that a run on this capture may have, the initial ones included.
pub fn most_gaussians(capture: &Capture, params: &ReconstructParams) -> usize {
    if params.max_gaussians > 0 {
        return params.max_gaussians;
    }
    let pixels = capture.training_views().map(|v| v.camera.intrinsics.width * v.camera.intrinsics.height);
    let by_pixels = pixels.fold(0usize, usize::saturating_add) / PIXELS_PER_GAUSSIAN;
    let by_points = initial_gaussians(capture, params).saturating_mul(GROWTH);
    by_pixels.max(by_points).clamp(FEWEST, MOST)
}

/// What a run takes, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryNeed {
    /// To begin.
    pub start: u64,
    /// With as many Gaussians as it may have.
    pub most: u64,
}

/// About how much memory a run on this capture takes.
pub fn memory_need(capture: &Capture, params: &ReconstructParams) -> MemoryNeed {
    let pixels = |index: &usize| {
        let k = &capture.views[*index].camera.intrinsics;
        (k.width as u64).saturating_mul(k.height as u64)
    };
    let views = || capture.split.train.iter().chain(&capture.split.test);
    let stored = views().map(pixels).fold(0, u64::saturating_add).saturating_mul(BYTES_PER_STORED_PIXEL);
    let step = views().map(pixels).max().unwrap_or(0).saturating_mul(BYTES_PER_PIXEL);
    let most = most_gaussians(capture, params);
    let initial = initial_gaussians(capture, params).min(most);
    let of = |gaussians: usize, each: u64| {
        (gaussians as u64).saturating_mul(each).saturating_add(stored).saturating_add(step)
    };
    MemoryNeed { start: of(initial, BYTES_TO_BEGIN), most: of(most, BYTES_WHEN_GROWN) }
}

#[cfg(test)]
mod tests {
    use glam::DVec3;
    use use3d_capture::{Camera, Capture, Frame, Intrinsics, Pose, SparsePoint, Split, View};

    use super::*;

    fn capture(views: usize, width: usize, height: usize, points: usize) -> Capture {
        let intrinsics = Intrinsics { width, height, fx: 9.0, fy: 9.0, cx: 4.0, cy: 3.0 };
        let view = |i: usize| View {
            name: use3d_capture::FileName::numbered(i),
            id: i as u32,
            image: std::path::PathBuf::new(),
            mask: None,
            depth_prior: None,
            camera: Camera { intrinsics, pose: Pose::IDENTITY },
        };
        let point = SparsePoint { position: DVec3::ONE, color: [9; 3], error: 0.5, track_length: 3 };
        Capture {
            name: "bounds".into(),
            views: (0..views).map(view).collect(),
            points: vec![point; points],
            split: Split { train: (0..views).collect(), test: Vec::new() },
            frame: Frame::IDENTITY,
        }
    }

    #[test]
    fn the_bound_is_the_capture_s_and_far_above_what_scenes_reach() {
        let params = ReconstructParams::default();
        let of = |views, w, h, points| most_gaussians(&capture(views, w, h, points), &params);
        // The synthetic reef of 48 views, 42 for training: 227 000 and 623 000 Gaussians at these sizes.
        assert_eq!(of(42, 640, 360, 20_091), 42 * 640 * 360 / 8);
        assert_eq!(of(42, 1280, 720, 20_091), MOST);
        assert_eq!(of(7, 96, 64, 2_000), FEWEST);
        assert_eq!(of(7, 96, 64, 200_000), 800_000);
        assert_eq!(of(7, 96, 64, 3_000_000), MOST);
        let given = ReconstructParams { max_gaussians: 1000, ..params };
        assert_eq!(most_gaussians(&capture(7, 96, 64, 3_000_000), &given), 1000);
    }

    #[test]
    fn memory_grows_with_the_initial_points_and_the_bound() {
        let params = ReconstructParams::default();
        let small = memory_need(&capture(7, 96, 64, 2_000), &params);
        let dense = memory_need(&capture(7, 96, 64, 1_000_000), &params);
        assert!(small.start < 10_000_000 && dense.start > 1_500_000_000, "{small:?} {dense:?}");
        assert!(dense.most > dense.start);
        let bounded = ReconstructParams { max_gaussians: 1000, ..params };
        assert!(memory_need(&capture(7, 96, 64, 1_000_000), &bounded).start < 10_000_000);
    }
}
