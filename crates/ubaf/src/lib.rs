//! The Underwater Bilateral Appearance Field (U-BAF): a small 4D field that recolours a frozen scene.
//!
//! A Gaussian at `x` with stage-1 colour `c̄` is looked up at `(x, γ(c̄))`. The field returns a local
//! log-gain `a` and bias `b` (three channels each), and the enhanced radiance is
//! `c⁺(ω) = exp(a) ⊙ (A c(ω) + b_g) + b`, with one scene-global affine `(A, b_g)`. The water is recoloured
//! by the same field, queried at the camera with the water's colour as guide, and two bounded ratios scale
//! attenuation and backscatter. This crate uses no images, files or training loop: its inputs and outputs
//! are slices.
//!
//! Reading order: [`field`] (the parameters) → `guide` and `sites` (the coordinates of a Gaussian's lookup)
//! → `kernel` (code and decoder, forward and backward, 16 Gaussians at a time; `test_plain` has the twin)
//! → [`objects`] (constant mode, Gaussian colours) → [`water`] (guide table, medium maps, transport) →
//! [`variation`] → [`enhancement`] (the trained field, ready to render).

pub mod enhancement;
pub mod field;
pub mod field_box;
#[cfg(test)]
mod golden_tests;
mod guide;
mod kernel;
pub mod objects;
mod recolor;
mod sites;
pub mod tensors;
#[cfg(test)]
mod test_plain;
#[cfg(test)]
mod tests;
pub mod variation;
pub mod water;

pub use enhancement::Enhancement;
pub use field::{Field, FieldError, Gradient, Shape};
pub use field_box::FieldBox;
pub use objects::ObjectPass;
pub use sites::Sites;
pub use tensors::TensorError;
pub use water::{ViewWater, WaterPass};

/// Outputs of the decoder: log-gain RGB, then bias RGB.
pub const OUTPUTS: usize = 6;
