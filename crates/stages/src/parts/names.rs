//! Names of files that one stage writes into its artifact and another stage reads.
//!
//! They are in a file of their own, so that the code of a writer is not part of its readers' keys.

/// The paired data in `pairs`.
pub(crate) const DATASET: &str = "dataset.json";
/// The calibrator in `calibrate`.
pub const CALIBRATOR: &str = "calibrator.safetensors";
/// The contact sheet in `reconstruct`.
pub(crate) const CONTACT: &str = "contact.png";
/// The targets in `targets`.
pub const TARGETS: &str = "targets.safetensors";
/// The scores in `evaluate`.
pub const SCORES: &str = "scores.json";
/// The consistency strip in `evaluate`, and its description.
pub const STRIP: (&str, &str) = ("strip.png", "strip.json");
/// The folder in `evaluate` with the held-out photographs enhanced in 2D, by stem.
pub(crate) const ENHANCED_IN_2D: &str = "proposal";
/// The folder in `evaluate` with held-out views without water, for captures that come with their truth.
pub(crate) const TRUE_VIEWS: &str = "truth";
/// The note of `evaluate` with the speed of drawing the scene.
pub const SPEED: &str = "speed";
/// In `reconstruct`: the choices that its parameters left open and the run made.
pub const CHOICES: &str = "choices.json";
/// In `targets`: the origin of the calibrator that corrected the proposals.
pub const CALIBRATED: &str = "calibrator.json";
/// In `reconstruct` and `enhance`: the training cameras, as a list that `use3d render --cameras` reads.
pub const CAMERAS: &str = "cameras.json";
/// In `reconstruct`: the images that the scene was learnt from, and the scores of the held-out views.
pub(crate) const EVALUATION: &str = "evaluation.json";
/// In `reconstruct`: the water estimated from the capture's tracks.
pub(crate) const WATER: &str = "water.json";
