//! Names of files that one stage leaves in its artifact and another reads.
//!
//! Apart from the stages that write them, so that a reader is not made of the writer's code.

/// The paired data in `pairs`.
pub(super) const DATASET: &str = "dataset.json";
/// The calibrator in `calibrate`.
pub const CALIBRATOR: &str = "calibrator.safetensors";
/// The contact sheet in `reconstruct`.
pub(super) const CONTACT: &str = "contact.png";
/// The targets in `targets`.
pub const TARGETS: &str = "targets.safetensors";
/// The scores in `evaluate`.
pub const SCORES: &str = "scores.json";
/// The consistency strip in `evaluate`, and what it shows.
pub const STRIP: (&str, &str) = ("strip.png", "strip.json");
/// The folder in `evaluate` with the held-out photographs enhanced in 2D, by stem.
pub(super) const ENHANCED_IN_2D: &str = "proposal";
/// Held-out views without water, of captures that bring their truth.
pub(super) const TRUE_VIEWS: &str = "truth";
/// The note of `evaluate` with how fast the scene is drawn.
pub const SPEED: &str = "speed";
/// In `reconstruct`: what its parameters left open and the run chose.
pub const CHOICES: &str = "choices.json";
/// In `targets`: where the calibrator that corrected the proposals came from.
pub const CALIBRATED: &str = "calibrator.json";
/// In `reconstruct` and `enhance`: the training cameras, as a list that `use3d render --cameras` reads.
pub const CAMERAS: &str = "cameras.json";
/// In `reconstruct`: which images the scene was learnt from, and how held-out ones came out.
pub(super) const EVALUATION: &str = "evaluation.json";
/// In `reconstruct`: what the capture's tracks told of its water.
pub(super) const WATER: &str = "water.json";
