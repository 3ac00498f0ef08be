//! Who owns the parameters: the loop decides *what* happens, an engine does it.
//!
//! An engine holds the Gaussians, the water, Adam's moments, the density statistics and every buffer of a
//! step. It need not be here, nor on the processor: everything that crosses this seam is public, owned or
//! borrowed plainly, and the loop works on `&mut dyn Engine`.
//!
//! ```text
//! upload every view ─▶ load a state ─▶ step, step, … ─▶ drain reports
//!                                       │  now and then
//!                                       ├─▶ survey ─▶ (the loop plans) ─▶ rebuild, limit_opacity
//!                                       ├─▶ render (held-out views)
//!                                       └─▶ save (checkpoints, the result)
//! ```
//!
//! A step may only be *asked for*: an engine on another device may have several under way, and
//! reports them when it can. Whatever else is asked of it comes after the steps that were asked for
//! before. So a loop never waits for a device, except where it needs its numbers: at a line of the
//! log, a refinement, a checkpoint.
//!
//! Which arithmetic an engine computes with is its own business, but the same engine on the same device gives
//! the same bits for the same requests. An error ends the run; what was saved before stays good.

mod adam;
mod cpu;
mod state;

use std::borrow::Cow;

use use3d_capture::{Camera, Image};
use use3d_splat::Gaussians;
use use3d_training::{Drain, EngineError, Profile};

pub use cpu::CpuEngine;
#[cfg(test)]
pub(crate) use state::zeros;
pub use state::{Moments, Statistics, TrainingState};

use crate::density::{Draws, Origin, Survey};
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

/// Active degrees of spherical harmonics, 0 to 3.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Degrees {
    /// Of the Gaussians' colours.
    pub colors: usize,
    /// Of the water.
    pub water: usize,
}

/// What one step does. The same plan on the same state is the same step, so steps can be asked for again.
#[derive(Clone, Debug, PartialEq)]
pub struct StepPlan {
    /// The step, from 0.
    pub step: u64,
    /// Image divisor.
    pub divisor: usize,
    /// Active degrees.
    pub degrees: Degrees,
    /// Learning rates.
    pub rates: StepRates,
    /// Weights of the loss's values, in the order of [the table of
    /// terms](crate::losses::TERMS); 0 leaves one out.
    pub weights: Vec<f64>,
    /// Whether gradients flow through ray distances (R2).
    pub depth_gradient: bool,
    /// How the view's gain is learnt; `None`: every gain is one.
    pub exposure: Option<ExposureStep>,
    /// Whether screen gradients are gathered for density control, and for how many pixels its
    /// threshold is meant (0: not scaled).
    pub gather: Option<u64>,
}

/// What came of a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    /// The step, from 0.
    pub step: u64,
    /// The view's index.
    pub view: usize,
    /// The whole loss.
    pub loss: f64,
    /// The loss's values before their weights, in the plan's order; `None` where a term
    /// has nothing to say of the view.
    pub values: Vec<Option<f64>>,
    /// PSNR of the rendered view over the pixels that count, dB; `None` where it has no finite one.
    pub psnr: Option<f64>,
    /// What was not finite, and its first bad element. The state is then of no use, and steps
    /// asked for later may be left out.
    pub non_finite: Option<(&'static str, Option<usize>)>,
}

/// Does the work of training stage 1. See the [module](self) for the order of calls.
pub trait Engine: Diagnostics {
    /// Takes a training view: its camera and its pixels as they are stored.
    /// Views count from 0, in this order.
    fn upload(&mut self, view: TrainingView) -> Result<usize, EngineError>;

    /// Takes the state that the next step starts from: a [new](TrainingState::new) one or one that was saved,
    /// by whichever engine. One that [does not agree with itself](TrainingState::check) is refused.
    fn load(&mut self, state: TrainingState) -> Result<(), EngineError>;

    /// The state after every step that was asked for. An engine whose state lies in main memory lends it.
    fn save(&mut self) -> Result<Cow<'_, TrainingState>, EngineError>;

    /// Asks for one step on an uploaded view: render, loss, gradients, Adam.
    fn step(&mut self, view: usize, plan: &StepPlan) -> Result<(), EngineError>;

    /// The reports of steps, in the order in which they were asked for, each once.
    fn drain(&mut self, which: Drain) -> Result<Vec<StepReport>, EngineError>;

    /// What density control needs to know of every Gaussian.
    fn survey(&mut self) -> Result<Survey, EngineError>;

    /// Density statistics start anew.
    fn forget_statistics(&mut self) -> Result<(), EngineError>;

    /// Makes the scene that these rows describe: what is kept keeps its moments, what is new
    /// starts with zero moments, and density statistics start anew.
    /// [`rebuilt`](crate::density::rebuilt) says what every row is.
    fn rebuild(&mut self, rows: &[Origin], draws: &Draws) -> Result<(), EngineError>;

    /// Lowers opacities to a ceiling and zeroes their moments.
    fn limit_opacity(&mut self, ceiling: f64) -> Result<(), EngineError>;

    /// Has means, sizes, rotations and opacities changed in place, after the reports of all steps were drained.
    /// The number of Gaussians, their moments and statistics stay. An engine whose state lies elsewhere fetches
    /// it and takes it back.
    fn amend(&mut self, change: &mut dyn FnMut(&mut Gaussians)) -> Result<(), EngineError> {
        let mut state = self.save()?.into_owned();
        change(&mut state.gaussians);
        self.load(state)
    }

    /// Adam's moments of the water's coefficients (constant and directional) start anew.
    fn forget_water_moments(&mut self) -> Result<(), EngineError>;

    /// Renders a camera with the present state, gains left out.
    fn render(&mut self, camera: &Camera, degrees: Degrees, out: &mut Image) -> Result<(), EngineError>;
}

/// What an engine may tell of its work besides. Nothing here enters a result, and an engine that knows
/// none of it keeps the defaults.
pub trait Diagnostics {
    /// (pixel, Gaussian) pairs that contribute to an uploaded view with the present state, about;
    /// `None` where nobody counts them.
    fn contributing_pairs(
        &mut self,
        _view: usize,
        _divisor: usize,
        _degree: usize,
    ) -> Result<Option<f64>, EngineError> {
        Ok(None)
    }

    /// Time spent per part of a step.
    fn profile(&self) -> Profile<StepPart> {
        Profile::default()
    }

    /// Bytes of parameters, moments, views and buffers, about.
    fn memory(&self) -> usize {
        0
    }
}
