//! Stage 1: trains an underwater scene from a posed capture.
//!
//! The loop ([`reconstruct`]) owns the schedules and decides *what* is done at every step; an
//! [`engine::Engine`] owns parameters, moments and buffers and does it. The caller chooses the engine:
//! [`engine::CpuEngine`] is the reference, and any other crate may provide one. A step renders one training
//! view through the water, compares it with the photograph ([`losses`]), and changes Gaussians and water by
//! Adam. At intervals Gaussians are split, duplicated and removed (R9), and images grow from half to
//! full size (R11). Everything is a function of capture, parameters and seed: the same bits on any number
//! of threads, and after any number of interruptions.

mod bounds;
mod colors;
mod completion;
mod densify;
pub mod density;
pub mod engine;
mod error;
mod exposure;
mod fingerprint;
mod found;
mod hidden;
mod initialise;
mod load;
pub mod losses;
mod params;
mod peek;
mod per_view;
mod phases;
mod profile;
mod report;
mod run;
mod seasplat;
mod turns;
mod unknown;
mod views;
mod window;

pub use bounds::{CaptureSize, MemoryNeed, memory_need, most_gaussians};
pub use colors::{ColorField, ColorState, ColorStep};
pub use densify::{Candidates, Densify, Strategy};
pub use error::ReconstructError;
pub use exposure::{ExposureStep, Exposures};
pub use found::{FoundWater, Known};
pub use params::{
    ColorRates, DepthPrior, Exposure, Images, LearningRates, MediumPrior, Photometric, Rate,
    ReconstructParams,
};
pub use peek::scene_in_checkpoint;
pub use per_view::ViewParameters;
pub use phases::{Group, Phase};
pub use profile::{StepPart, Stretch, growth};
pub use report::{Evaluation, FittedScore, LogEntry, ViewScore};
pub use run::{ReconstructOutcome, reconstruct};
pub use seasplat::{Priors, Turns};
pub use use3d_medium::MediumKind as Medium;
pub use use3d_training::EngineChoice;
pub use views::{LoadedView, Target, TrainingView, ViewLoader};

#[cfg(test)]
mod tests;
