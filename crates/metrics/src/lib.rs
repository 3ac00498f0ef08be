//! Image quality and consistency formulas: PSNR, SSIM, MS-SSIM, UCIQE, UIQM, CIEDE2000, warping.
//!
//! This crate holds formulas, and the words for a PSNR. Measures that need a trained network (LPIPS,
//! MUSIQ …) are in the crate of the networks and are passed to [`warped_distance`] as a closure. All images
//! are display-referred RGB in `[0, 1]`.
//!
//! * With a reference: [`psnr`], [`psnr_exposure_fitted`], [`affine_fit`], [`fitted_on_other_half`],
//!   [`ssim`], [`ms_ssim`], [`ciede2000`], [`mean_cie1976`], [`StepEdges`].
//! * Without a reference: [`uciqe`], [`uiqm`].
//! * Between views: [`warped_distance`] (flow), [`warped_delta_e`], [`warped_ssim`] (depth).
//!
//! Every measure of a photograph can use a [`Mask`] of the pixels that count; every result becomes a
//! [`Score`], which is finite or has a reason why there is no number.
//!
//! All results are deterministic: long sums are f64 in a fixed order, with the same bits for any number of
//! threads.

mod affine;
mod ciede2000;
mod consistency;
mod edges;
mod error;
#[cfg(test)]
mod golden_tests;
mod halves;
mod lab;
mod mask;
pub mod ms_ssim;
mod psnr;
mod score;
mod ssim;
mod uciqe;
mod uiqm;
mod warp;
mod windows;

pub use affine::{ColourMap, affine_fit, map_colours};
pub use ciede2000::{ciede2000, delta_e_of_lab, mean_ciede2000};
pub use consistency::{
    Consistency, GeometricView, geometric_warp, warped_delta_e, warped_distance, warped_ssim,
};
pub use edges::{EdgeWidth, StepEdge, StepEdges};
pub use error::MetricError;
pub use halves::fitted_on_other_half;
pub use lab::{lab_of_srgb, mean_cie1976};
pub use mask::{blacked_out, counted, mask_of, only_counted, share};
pub use psnr::{
    ExposureFit, LIKENESS, decibels, exposure_gain, likeness_in_words, psnr, psnr_exposure_fitted,
};
pub use score::{Finite, NonFiniteScore, Score};
pub use ssim::{ssim, ssim_map};
pub use uciqe::{UCIQE_VARIANT, Uciqe, uciqe, uciqe_of_8bit};
pub use uiqm::{Uiqm, uiqm, uiqm_of_8bit};
pub use warp::{Flow, ForwardBackward, Mask, Warped, backward_warp, forward_backward};
