//! The owner of the field: the loop decides *what* is done, and an engine does it.
//!
//! An engine is made for one scene, its training views and their guidance, which are constant. It holds the
//! field's parameters, Adam's moments and every buffer of a step, in main memory or on another device; the
//! loop uses `&mut dyn FieldEngine`.
//!
//! ```text
//! load a state ─▶ evaluate every view ─▶ step, step, … ─▶ drain reports ─▶ evaluate ─▶ centre, save
//!                                                          └─ now and then: save (checkpoints)
//! ```
//!
//! As in stage 1, a call of `step` may return before the step is done; all other calls take effect after
//! it.

mod cpu;
mod measure;
mod state;

use serde::{Deserialize, Serialize};
use use3d_capture::Appearance;
use use3d_scene::Scene;
use use3d_training::{Drain, EngineError, Profile};
use use3d_ubaf::{Field, FieldBox, OUTPUTS};

pub use cpu::CpuFieldEngine;
#[cfg(test)]
pub(crate) use cpu::Step;
pub use measure::{Goals, Measure};
pub use state::FieldState;

pub use crate::losses::StepLosses;
use crate::profile::StepPart;
use crate::report::ViewErrors;
use crate::views::{EnhanceView, Guidance};
pub use crate::views::{Reference, References, centred};
use crate::{EnhanceError, EnhanceParams, Objective};

/// The settings of one step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldPlan {
    /// The step, from 0.
    pub step: u64,
    /// Learning rate of the field.
    pub rate: f64,
    /// Learning rate of the two transport ratios.
    pub transport_rate: f64,
}

/// The result of a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FieldReport {
    /// The step, from 0.
    pub step: u64,
    /// The view's index.
    pub view: usize,
    /// The losses.
    pub losses: StepLosses,
    /// The first array that was not finite, and its first bad element. The state is then useless, and steps
    /// requested later may be left out.
    pub non_finite: Option<(&'static str, Option<usize>)>,
}

/// The choice of pixels of a view that are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reading {
    /// The pixels that the steps render.
    Sampled,
    /// All pixels that the extractor weighs; for pseudo-labels those of the steps.
    Whole,
}

/// The share of the views that an engine keeps in memory and renders.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// Number of views whose constants are kept in memory; the others are prepared again in each of their
    /// steps.
    pub views_in_memory: usize,
    /// Number of pixels of all views that the steps render, as a share of all their pixels.
    pub rendered_share: f64,
}

/// The work of training stage 2. See the [module](self) for the order of calls.
pub trait FieldEngine {
    /// Sets the state from which the next step starts: a [new](FieldState::new) one or one that any engine
    /// saved. The state of [another field](FieldState::check) is refused.
    fn load(&mut self, state: FieldState) -> Result<(), EngineError>;

    /// The state after all steps requested so far.
    fn save(&mut self) -> Result<FieldState, EngineError>;

    /// Requests one step on a view: render, losses, gradient, Adam.
    fn step(&mut self, view: usize, plan: &FieldPlan) -> Result<(), EngineError>;

    /// The reports of steps, each once, in the order of the requests.
    fn drain(&mut self, which: Drain) -> Result<Vec<FieldReport>, EngineError>;

    /// Measures the distance of a view from its reference.
    fn evaluate(&mut self, view: usize, reading: Reading) -> Result<ViewErrors, EngineError>;

    /// The constant mode of the present field over the Gaussians that define it (R22).
    fn centre(&mut self) -> Result<[f32; OUTPUTS], EngineError>;

    /// The share of the views that it keeps in memory and renders.
    fn coverage(&self) -> Coverage;

    /// Time spent per part of a step. It never enters a result; an engine that does not measure it keeps the
    /// default.
    fn profile(&self) -> Profile<StepPart> {
        Profile::default()
    }
}

/// The field at the start of a run, at the identity: its sizes and seed come from the parameters, its box
/// lies around the scene.
pub fn initial_field(
    scene: &Scene,
    guidance: Guidance<'_>,
    params: &EnhanceParams,
) -> Result<Field, EnhanceError> {
    // The field is looked up at the cameras for water, and so near the anchors; for clear radiance it is
    // looked up at the Gaussians alone.
    let anchors = match scene.medium.anchors() {
        Some(anchors) if guidance.appearance() == Appearance::Water => anchors.centers,
        _ => &[],
    };
    let bounds = FieldBox::of_scene(&scene.gaussians.means, anchors);
    Ok(Field::identity(params.shape(), bounds, params.seed)?)
}

/// Checks that stage 2 can learn from this scene, these views, this guidance and these parameters.
pub fn check_inputs(
    scene: &Scene,
    views: &[EnhanceView],
    guidance: Guidance<'_>,
    params: &EnhanceParams,
) -> Result<(), EnhanceError> {
    params.validate().map_err(EnhanceError::Parameter)?;
    check_guidance(guidance, params.objective)?;
    if scene.gaussians.is_empty() {
        return Err(EnhanceError::EmptyScene);
    }
    if views.is_empty() {
        return Err(EnhanceError::NoViews);
    }
    if let Some(targets) = guidance.targets() {
        targets.check_scene(&scene.gaussians)?;
    }
    Ok(())
}

fn check_guidance(guidance: Guidance<'_>, objective: Objective) -> Result<(), EnhanceError> {
    let (objective, by_labels) = match objective {
        Objective::Full => ("full", false),
        Objective::GlobalOnly => ("global-only", false),
        Objective::LocalOnly => ("local-only", false),
        Objective::PseudoLabels => ("pseudo-labels", true),
    };
    if by_labels == guidance.targets().is_none() {
        return Ok(());
    }
    let needed = if by_labels { "enhanced images of the training views" } else { "transition targets" };
    Err(EnhanceError::Guidance { objective, needed })
}
