//! Appearance Transition Consensus (ATC): computes the desired enhancement of a scene, learned from 2D
//! pairs and agreed by all views, as fixed targets for stage 2.
//!
//! ```text
//! pairs ─▶ [proposer] ─▶ [extractor] ─▶ dataset ─▶ [calibrator]
//!                                                       │
//! captured views ─▶ [proposer] ─▶ [extractor] ──────────┴─▶ one candidate per view ─▶ [consensus] ─▶ Targets
//! ```
//!
//! * [`extractor`]: `E(source, target)`, the transition between two images: one global affine and a grid of
//!   gains and biases.
//! * [`proposers`]: 2D enhancers behind one trait, among them [`proposers::Fusion`], which needs no weights.
//! * [`calibrator`]: corrects proposed transitions towards those of paired data.
//! * [`consensus`]: one scene operator, and one local target per Gaussian.
//!
//! This crate does not use files, stages or progress bars: artifacts are bytes, and loops report to a
//! closure ([`progress::ProgressCallback`]). Everything is deterministic on any number of threads.

pub mod calibrator;
pub mod consensus;
mod error;
pub mod extractor;
pub mod kept_water;
pub mod progress;
pub mod proposers;
mod tensors;
mod vectorized;

pub use error::AtcError;
