//! The errors of stage 1.

use use3d_capture::{CameraError, CaptureError};
use use3d_numerics::range::OutOfRange;
use use3d_training::{CheckpointError, EngineError, NonFinite};

/// A reason why there is no reconstruction.
#[derive(Debug, thiserror::Error)]
pub enum ReconstructError {
    /// There is nothing to learn from.
    #[error(transparent)]
    Capture(#[from] CaptureError),
    /// There is only one view, which does not determine a scene.
    #[error(
        "only one training view (`{view}`); a scene needs at least 2 views from different places: add images, or hold out fewer (`split.every`)"
    )]
    OneView {
        /// The view.
        view: String,
    },
    /// A view's camera cannot be used.
    #[error("view `{view}`: {source}")]
    Camera {
        /// The view.
        view: String,
        /// The reason.
        source: CameraError,
    },
    /// A view's pixels could not be loaded.
    #[error("view `{view}`: {source}")]
    Load {
        /// The view.
        view: String,
        /// The loader's error.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// An image, mask or prior has another size than its camera.
    #[error(
        "view `{view}`: its {what} is {found_width}x{found_height} pixels, its camera {width}x{height}; scale the files or the camera (`size`, `image_dir`)"
    )]
    Size {
        /// The view.
        view: String,
        /// `image`, `mask`, `depth prior`.
        what: &'static str,
        /// Width found.
        found_width: usize,
        /// Height found.
        found_height: usize,
        /// The camera's width.
        width: usize,
        /// The camera's height.
        height: usize,
    },
    /// The masks leave no pixel.
    #[error(
        "the masks of all {views} training views leave no pixel: there is nothing to learn from; masks (files and alpha channels) are white where pixels count and black elsewhere: invert them, or remove them"
    )]
    NothingCounts {
        /// Number of training views.
        views: usize,
    },
    /// Points and poses do not belong together.
    #[error(
        "none of the {points} sparse points lies in front of any of the {views} training cameras: poses and points seem to be from different models, or poses are camera-to-world; check the sparse model"
    )]
    PointsBehindCameras {
        /// Number of sparse points.
        points: usize,
        /// Number of training views.
        views: usize,
    },
    /// A parameter is out of range.
    #[error("reconstruct: {0}")]
    Parameter(OutOfRange),
    /// The run diverged.
    #[error(transparent)]
    NonFinite(#[from] NonFinite),
    /// The engine already has the views of another run.
    #[error(
        "the engine is in use already, with the views of another run; give every run an engine of its own"
    )]
    EngineInUse,
    /// The engine failed.
    #[error(transparent)]
    Engine(#[from] EngineError),
    /// The checkpoint could not be written or read.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The observer requested a stop; the checkpoint is written.
    #[error("stopped at step {step} of {steps}{}", if *saved { "; run again to resume" } else { "" })]
    Interrupted {
        /// Number of steps done.
        step: u64,
        /// Total number of steps.
        steps: u64,
        /// True if a checkpoint holds the state.
        saved: bool,
    },
}
