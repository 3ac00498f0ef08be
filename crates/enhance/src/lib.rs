//! Stage 2: the reconstructed scene learns a persistent enhanced appearance, its geometry untouched.
//!
//! Each step renders one training view with the field's colours and water. The extractor `E` computes the
//! transition from the stage-1 render of the same view to this render, and the loss draws the transition
//! towards the fixed targets:
//!
//! ```text
//! (t, Δ) = E(sg(I_rec), I⁺)      e_g = (t - t̄)/s_g      e_ℓ = (Δ - mean Δ - Δ̄)/s_ℓ
//! L = λ_g mean φ(e_g) + λ_ℓ Σ_p W_p mean φ(e_ℓ,p) / Σ_p W_p + λ_tv TV          φ: Smooth-L1
//! ```
//!
//! Only the field's parameters are learnt. Everything that does not depend on them is computed once per
//! view: projection and tile lists, base colours, the frozen water, the extractor's source, the rasterised
//! local target.
//!
//! Targets define the appearance of their transitions. *With water*, renders are full images and the field
//! grades the water too. *In clear radiance*, both renders are `Σ wᵢ cᵢ`, without water; then nothing
//! defines the enhanced water, its part of the field gets no gradient, and the enhanced scene keeps stage
//! 1's water.
//!
//! Approximation: a step renders a view only at the pixels nearest to those of an image of
//! [`sample_side`](EnhanceParams::sample_side) pixels on its long side, instead of all that the extractor's
//! resize to 384 weighs. Source and render are sampled alike, so equal images still have the identity
//! transition. Operators are means over many pixels, for which a tenth of them is enough. The final errors
//! are measured with the whole resize.
//!
//! [`enhance`] is the loop; a [`FieldEngine`](engine::FieldEngine), which the caller chooses, does the work
//! of its steps. The crate `render` draws the enhanced scene.

pub mod engine;
mod error;
mod fingerprint;
#[cfg(test)]
mod golden_tests;
mod labels;
pub mod losses;
mod params;
mod profile;
mod report;
mod run;
mod views;
mod window;

pub use error::EnhanceError;
pub use labels::{LabelSource, PseudoLabels};
pub use losses::{Realised, global_loss, local_loss, smooth_l1};
pub use params::{EnhanceParams, Objective, PixelLoss, Start};
pub use profile::StepPart;
pub use report::{EnhanceOutcome, LogEntry, Report, ViewErrors, ViewReport};
pub use run::enhance;
pub use views::{EnhanceView, Guidance};
