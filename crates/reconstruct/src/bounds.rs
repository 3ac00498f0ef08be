//! The largest number of Gaussians that a run may have, and the memory that it takes.
//!
//! Both are computed from the capture and the parameters alone, never from the machine: a scene is the same
//! on every machine. Without a `max_gaussians` the bound is
//!
//! ```text
//! clamp( max(pixels of the training views / 8, 4 × initial points), 250 000, 4 000 000 )
//! ```
//!
//! The bound stops growth that has gone wrong and is not meant to shape a scene: one Gaussian per eight
//! pixels is several times the number that scenes reach without it.

use use3d_capture::{Capture, View};

use crate::ReconstructParams;
use crate::initialise::FEWEST_POINTS;

const PIXELS_PER_GAUSSIAN: u64 = 8;
/// The synthetic reef grew to one Gaussian per 44 training pixels at 640x360, and per 65 at 1280x720.
const PIXELS_PER_LIKELY_GAUSSIAN: u64 = 44;
const GROWTH: usize = 4;
const FEWEST: usize = 250_000;
const MOST: usize = 4_000_000;

/// Bytes per Gaussian at the start: parameters, gradients, two moments, statistics, and the projected and
/// listed data.
const BYTES_TO_BEGIN: u64 = 1500;
/// Bytes per Gaussian in a scene that has grown, with the state while a checkpoint is read.
const BYTES_WHEN_GROWN: u64 = 2500;
/// Bytes per pixel of the largest view, for the images, maps, gradients and buffers of a step. Between
/// 640x360 and 1280x720 at full size the largest resident set grew by 269 (two threads, water of eight
/// anchors).
const BYTES_PER_PIXEL: u64 = 270;
/// Smallest size of a stored pixel, bytes.
const BYTES_PER_STORED_PIXEL: u64 = 3;

/// The properties of a capture that decide the number of Gaussians and the memory.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CaptureSize {
    /// Number of pixels of all views, training and held out.
    pub pixels: u64,
    /// Number of pixels of the training views.
    pub training: u64,
    /// Number of pixels of the largest view.
    pub largest: u64,
    /// Number of finite sparse points.
    pub points: usize,
}

impl CaptureSize {
    /// The size of a capture from its views, each with width, height and true for training, and its number
    /// of sparse points.
    pub fn new(views: impl IntoIterator<Item = ((usize, usize), bool)>, points: usize) -> Self {
        let mut size = Self { points, ..Self::default() };
        for ((width, height), trains) in views {
            let pixels = (width as u64).saturating_mul(height as u64);
            size.pixels = size.pixels.saturating_add(pixels);
            size.training = size.training.saturating_add(if trains { pixels } else { 0 });
            size.largest = size.largest.max(pixels);
        }
        size
    }

    /// Number of Gaussians at the start before the bound applies: one per sparse point, with random ones
    /// added if there are few points.
    pub(crate) fn initial(&self, params: &ReconstructParams) -> usize {
        let points = self.points;
        if points < FEWEST_POINTS { points.saturating_add(params.random_points) } else { points }
    }

    /// Largest number of Gaussians that a run may have, including the initial ones.
    fn most(&self, params: &ReconstructParams) -> usize {
        if params.max_gaussians > 0 {
            return params.max_gaussians;
        }
        let by_pixels = usize::try_from(self.training / PIXELS_PER_GAUSSIAN).unwrap_or(usize::MAX);
        let by_points = self.initial(params).saturating_mul(GROWTH);
        by_pixels.max(by_points).clamp(FEWEST, MOST)
    }

    /// Approximate number of Gaussians in a finished scene of this size; rather too large than too small.
    pub fn likely(&self, params: &ReconstructParams) -> usize {
        let by_pixels = usize::try_from(self.training / PIXELS_PER_LIKELY_GAUSSIAN).unwrap_or(usize::MAX);
        by_pixels.max(self.initial(params)).min(self.most(params))
    }
}

impl From<&Capture> for CaptureSize {
    fn from(capture: &Capture) -> Self {
        let size = |v: &View| (v.camera.intrinsics.width, v.camera.intrinsics.height);
        let views = capture.training_views().map(|v| (size(v), true));
        let views = views.chain(capture.test_views().map(|v| (size(v), false)));
        Self::new(views, capture.points.iter().filter(|p| p.position.is_finite()).count())
    }
}

/// Largest number of Gaussians that a run on this capture may have, including the initial ones.
pub fn most_gaussians(capture: &Capture, params: &ReconstructParams) -> usize {
    CaptureSize::from(capture).most(params)
}

/// The memory that a run takes, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryNeed {
    /// Memory at the start.
    pub start: u64,
    /// Memory with the usual number of Gaussians for scenes of this size: for planning.
    pub likely: u64,
    /// Memory with the largest number of Gaussians that it may have.
    pub most: u64,
}

/// Estimates the memory that a run on a capture of this size takes.
pub fn memory_need(size: &CaptureSize, params: &ReconstructParams) -> MemoryNeed {
    let stored = size.pixels.saturating_mul(BYTES_PER_STORED_PIXEL);
    let step = size.largest.saturating_mul(BYTES_PER_PIXEL);
    let most = size.most(params);
    let of = |gaussians: usize, each: u64| {
        (gaussians as u64).saturating_mul(each).saturating_add(stored).saturating_add(step)
    };
    MemoryNeed {
        start: of(size.initial(params).min(most), BYTES_TO_BEGIN),
        likely: of(size.likely(params), BYTES_WHEN_GROWN),
        most: of(most, BYTES_WHEN_GROWN),
    }
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
        // The synthetic reef of 48 views, 42 for training, has 227 000 and 623 000 Gaussians at these
        // sizes.
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
        let need = |capture: &Capture, params: &ReconstructParams| memory_need(&capture.into(), params);
        let small = need(&capture(7, 96, 64, 2_000), &params);
        let dense = need(&capture(7, 96, 64, 1_000_000), &params);
        assert!(small.start < 10_000_000 && dense.start > 1_500_000_000, "{small:?} {dense:?}");
        assert!(dense.most > dense.start);
        let bounded = ReconstructParams { max_gaussians: 1000, ..params };
        assert!(need(&capture(7, 96, 64, 1_000_000), &bounded).start < 10_000_000);
    }

    #[test]
    fn the_likely_memory_is_near_what_was_measured_and_grows_with_the_pictures() {
        let params = ReconstructParams::default();
        let likely = |width, height| {
            let mut capture = capture(48, width, height, 20_091);
            capture.split = Split::every(48, 8);
            memory_need(&(&capture).into(), &params).likely as f64
        };
        // Largest memory measured for the synthetic reef: 540 MB and 1.37 GB, including the program itself.
        let (small, large) = (likely(640, 360) / 540e6, likely(1280, 720) / 1.37e9);
        assert!((0.9..2.0).contains(&small) && (0.9..2.0).contains(&large), "{small} {large}");
        assert!(likely(1280, 720) > 2.0 * likely(640, 360));
    }
}
