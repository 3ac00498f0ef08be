//! The owner of the parameters: the loop decides *what* is done, and an engine does it.
//!
//! An engine holds the Gaussians, the water, Adam's moments, the density statistics and every buffer of a
//! step. It may be in another crate and on another device than the processor: all types of this interface
//! are public and owned or plainly borrowed, and the loop uses `&mut dyn Engine`.
//!
//! ```text
//! upload every view ─▶ load a state ─▶ step, step, … ─▶ drain reports
//!                                       │  now and then
//!                                       ├─▶ survey ─▶ (the loop plans) ─▶ rebuild, limit_opacity
//!                                       ├─▶ render (held-out views)
//!                                       └─▶ save (checkpoints, the result)
//! ```
//!
//! A call of `step` may return before the step is done: an engine on another device may have several steps
//! under way, and reports them when it can. All other calls take effect after the steps that were requested
//! before. So a loop waits for a device only where it needs its numbers: at a line of the log, a
//! refinement, or a checkpoint.
//!
//! An engine may use any arithmetic, but the same engine on the same device must give the same bits for the
//! same requests. An error ends the run; state that was saved before stays valid.

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
pub use state::{GradientScale, Moments, Statistics, TrainingState};

use crate::colors::ColorStep;
use crate::density::{Draws, Origin, Survey};
use crate::exposure::ExposureStep;
use crate::profile::StepPart;
use crate::views::TrainingView;
use crate::{ReconstructParams, losses};

/// This step's learning rates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepRates {
    /// Rate of centres.
    pub means: f64,
    /// Rate of constant colour coefficients.
    pub sh_constant: f64,
    /// Rate of directional colour coefficients.
    pub sh_directional: f64,
    /// Rate of opacity logits.
    pub opacity: f64,
    /// Rate of log scales.
    pub scales: f64,
    /// Rate of quaternions.
    pub quaternions: f64,
    /// Rate of the water's constant coefficients.
    pub medium_constant: f64,
    /// Rate of the water's directional coefficients and anchors.
    pub medium_directional: f64,
    /// Rate of the network water's weights.
    pub medium_network: f64,
}

/// Active degrees of spherical harmonics, 0 to 3.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Degrees {
    /// Degree of the Gaussians' colours.
    pub colors: usize,
    /// Degree of the water.
    pub water: usize,
}

/// The parameters that an update moves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Moves {
    /// All of them.
    #[default]
    All,
    /// Those of Gaussians and views, and not those of the water.
    Gaussians,
    /// The Gaussians' colours alone.
    Colors,
    /// Those of the water alone.
    Water,
}

/// The settings of one step. The same plan on the same state gives the same step, so steps can be repeated.
#[derive(Clone, Debug, PartialEq)]
pub struct StepPlan {
    /// The step, from 0.
    pub step: u64,
    /// The parameters that move.
    pub moves: Moves,
    /// Number of earlier moves of the water, for Adam's corrections.
    pub water_updates: u64,
    /// Image divisor.
    pub divisor: usize,
    /// Active degrees.
    pub degrees: Degrees,
    /// Learning rates.
    pub rates: StepRates,
    /// Weights of the loss's values, in the order of [the table of terms](crate::losses::TERMS); 0 leaves a
    /// value out.
    pub weights: Vec<f64>,
    /// True if gradients flow through ray distances (R2).
    pub depth_gradient: bool,
    /// Largest norm of the gradient of the network water's weights; 0: any.
    pub network_clip: f64,
    /// The settings by which the view's gain is learnt; `None` if every gain is one.
    pub exposure: Option<ExposureStep>,
    /// The settings by which the colour field is learnt; `None` if views show the scene's own colours.
    pub colors: Option<ColorStep>,
    /// The scale of screen gradients for the size of the images; `None` if none are gathered.
    pub gather: Option<GradientScale>,
}

impl StepPlan {
    /// A step at full size and all degrees, in which Gaussians and water move, without gains, colour field
    /// and statistics. For measurements; the loop makes its own plans.
    pub fn at_full_size(params: &ReconstructParams, step: u64) -> Self {
        Self {
            step,
            moves: Moves::All,
            water_updates: step,
            divisor: 1,
            degrees: Degrees { colors: 3, water: 3 },
            rates: params.rates(&params.phases(false), step).0,
            weights: losses::weights(params, step),
            depth_gradient: params.depth_gradient,
            network_clip: params.network_clip,
            exposure: None,
            colors: None,
            gather: None,
        }
    }
}

/// The result of a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StepReport {
    /// The step, from 0.
    pub step: u64,
    /// The view's index.
    pub view: usize,
    /// The whole loss.
    pub loss: f64,
    /// The loss's values before their weights, in the plan's order; `None` if a term has no value for the
    /// view.
    pub values: Vec<Option<f64>>,
    /// PSNR of the rendered view over the pixels that count, dB; `None` if it is not finite.
    pub psnr: Option<f64>,
    /// The first array that was not finite, and its first bad element. The state is then useless, and steps
    /// requested later may be left out.
    pub non_finite: Option<(&'static str, Option<usize>)>,
}

/// The work of training stage 1. See the [module](self) for the order of calls.
pub trait Engine {
    /// Adds a training view: its camera and its stored pixels. Views count from 0, in this order.
    fn upload(&mut self, view: TrainingView) -> Result<usize, EngineError>;

    /// Sets the state from which the next step starts: a [new](TrainingState::new) one or one that any
    /// engine saved. A state that [is inconsistent](TrainingState::check) is refused.
    fn load(&mut self, state: TrainingState) -> Result<(), EngineError>;

    /// The state after all steps requested so far. An engine whose state lies in main memory lends it.
    fn save(&mut self) -> Result<Cow<'_, TrainingState>, EngineError>;

    /// Requests one step on an uploaded view: render, loss, gradients, Adam.
    fn step(&mut self, view: usize, plan: &StepPlan) -> Result<(), EngineError>;

    /// The reports of steps, each once, in the order of the requests.
    fn drain(&mut self, which: Drain) -> Result<Vec<StepReport>, EngineError>;

    /// Returns the input of density control for every Gaussian.
    fn survey(&mut self) -> Result<Survey, EngineError>;

    /// Resets the density statistics.
    fn forget_statistics(&mut self) -> Result<(), EngineError>;

    /// Makes the scene that these rows describe: kept Gaussians keep their moments, new ones start with
    /// zero moments, and the density statistics are reset. [`rebuilt`](crate::density::rebuilt) defines the
    /// content of every row.
    fn rebuild(&mut self, rows: &[Origin], draws: &Draws) -> Result<(), EngineError>;

    /// Lowers opacities to a ceiling and zeroes their moments.
    fn limit_opacity(&mut self, ceiling: f64) -> Result<(), EngineError>;

    /// Changes any parameters of the Gaussians in place, after the reports of all steps were drained.
    /// The number of Gaussians, their moments and statistics stay. An engine whose state is not in main
    /// memory copies it there and back.
    fn amend(&mut self, change: &mut dyn FnMut(&mut Gaussians)) -> Result<(), EngineError> {
        let mut state = self.save()?.into_owned();
        change(&mut state.gaussians);
        self.load(state)
    }

    /// Resets Adam's moments of the water's coefficients (constant and directional).
    fn forget_water_moments(&mut self) -> Result<(), EngineError>;

    /// Renders a camera with the present state, without gains.
    fn render(&mut self, camera: &Camera, degrees: Degrees, out: &mut Image) -> Result<(), EngineError>;

    // Optional information on the work follows. Nothing of it enters a result; an engine without this
    // information keeps the defaults.

    /// Approximate number of (pixel, Gaussian) pairs that contribute to an uploaded view with the present
    /// state; `None` if they are not counted.
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

    /// Approximate number of bytes of parameters, moments, views and buffers.
    fn memory(&self) -> usize {
        0
    }
}
