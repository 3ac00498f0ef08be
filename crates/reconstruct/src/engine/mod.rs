//! Who owns the parameters: the loop decides *what* happens, an engine does it.
//!
//! An engine holds the Gaussians, the water, Adam's moments, the density statistics and every buffer of a step. The loop never touches
//! a per-Gaussian array, so that an engine on another device can take this one's place.

mod adam;
mod cpu;
pub(crate) mod density;
mod state;

use use3d_capture::{Camera, MediumMaps};
use use3d_medium::MediumModel;
use use3d_splat::{Gaussians, Rendered};
use use3d_training::Profile;

pub use cpu::CpuEngine;
pub use state::{EngineState, GaussianArrays};

use crate::exposure::ExposureStep;
use crate::profile::StepPart;
use crate::views::TrainingView;

/// This step's learning rates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepRates {
    /// Centres.
    pub means: f64,
    /// Constant colour coefficients.
    pub sh_constant: f64,
    /// Directional colour coefficients.
    pub sh_directional: f64,
    /// Opacity logits.
    pub opacity: f64,
    /// Log scales.
    pub scales: f64,
    /// Quaternions.
    pub quaternions: f64,
    /// The water's constant coefficients.
    pub medium_constant: f64,
    /// The water's directional coefficients and anchors.
    pub medium_directional: f64,
    /// The network water's weights.
    pub medium_network: f64,
}

/// What one step does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepSettings {
    /// The step, from 0.
    pub step: u64,
    /// Image divisor.
    pub divisor: usize,
    /// Active spherical-harmonics degree of Gaussians and water.
    pub degree: usize,
    /// Learning rates.
    pub rates: StepRates,
    /// Weight of the depth term; 0 leaves it out.
    pub depth_weight: f64,
    /// Whether gradients flow through ray distances (R2).
    pub depth_gradient: bool,
    /// How the view's gain is learnt; `None`: every gain is one.
    pub exposure: Option<ExposureStep>,
    /// Whether screen gradients are gathered for density control, and for how many pixels its threshold is meant (0: not scaled).
    pub gather: Option<u64>,
}

/// What came of a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    /// The whole loss.
    pub loss: f64,
    /// Reg-L1.
    pub reg_l1: f64,
    /// Reg-MS-SSIM.
    pub reg_ms_ssim: f64,
    /// The depth term, where the view has a prior.
    pub depth_loss: Option<f64>,
    /// PSNR of the rendered view over the pixels that count, dB; `None` where it has no finite one.
    pub psnr: Option<f64>,
    /// What was not finite, and its first bad element.
    pub non_finite: Option<(&'static str, Option<usize>)>,
}

/// What one refinement does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RefineSettings {
    /// The step, from 0: keys the random draws.
    pub step: u64,
    /// Seed of the run.
    pub seed: u64,
    /// Whether Gaussians are split and duplicated.
    pub grow: bool,
    /// Mean absolute screen gradient above which they are.
    pub gradient_threshold: f64,
    /// Largest standard deviation of a duplicate.
    pub split_scale: f64,
    /// Factor by which a split's children are smaller.
    pub shrink: f64,
    /// Opacity below which Gaussians are removed.
    pub cull_opacity: f64,
    /// Standard deviation above which they are removed.
    pub cull_scale: f64,
    /// Culling leaves at least this many.
    pub floor: usize,
    /// Growth leaves at most this many.
    pub most: usize,
    /// Whether Adam's moments of the water's coefficients start anew.
    pub reset_medium: bool,
}

/// What came of a refinement.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RefineReport {
    /// Gaussians replaced by two smaller ones.
    pub split: usize,
    /// Gaussians that got a twin.
    pub duplicated: usize,
    /// Gaussians removed.
    pub culled: usize,
    /// Gaussians that would have been removed, but for the floor.
    pub spared: usize,
    /// Gaussians that would have been split or duplicated, but for the cap.
    pub held_back: usize,
}

/// Does the work of training.
pub trait Engine {
    /// Takes a training view; its index.
    fn upload(&mut self, view: TrainingView) -> usize;
    /// Lets every uploaded view have a gain per channel, starting from these (positive, one row per view).
    fn expose(&mut self, gains: &[[f64; 3]]);
    /// The views' gains as they are; empty where they have none.
    fn exposures(&self) -> Vec<[f32; 3]>;
    /// Number of Gaussians.
    fn gaussians(&self) -> usize;
    /// One step on an uploaded view: render, loss, gradients, Adam.
    fn step(&mut self, view: usize, settings: &StepSettings) -> StepReport;
    /// Splits, duplicates and removes Gaussians; statistics start anew.
    fn refine(&mut self, settings: &RefineSettings) -> RefineReport;
    /// Density statistics start anew, without a refinement.
    fn forget_statistics(&mut self);
    /// Lowers opacities to a ceiling and zeroes their moments.
    fn limit_opacity(&mut self, ceiling: f64);
    /// Renders a camera with the present state; `water` receives the medium's maps.
    fn render(&mut self, camera: &Camera, degree: usize, out: &mut Rendered, water: &mut MediumMaps);
    /// (pixel, Gaussian) pairs that contribute to an uploaded view with the present state, about: counted at every fourth pixel both
    /// ways.
    fn contributing_pairs(&mut self, view: usize, divisor: usize, degree: usize) -> f64;
    /// Everything a checkpoint needs.
    fn state(&self) -> EngineState<'_>;
    /// Takes a checkpoint's state; `false` (nothing changed) if it does not fit.
    fn restore(&mut self, state: &EngineState<'_>) -> bool;
    /// The scene as it is.
    fn download(&self) -> (Gaussians, MediumModel);
    /// Time spent per part of a step.
    fn profile(&self) -> &Profile<StepPart>;
    /// Bytes of parameters, moments, views and buffers, about.
    fn memory(&self) -> usize;
}
