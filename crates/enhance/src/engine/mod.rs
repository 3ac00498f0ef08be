//! Who owns the field: the loop decides *what* happens, an engine does it.
//!
//! An engine is made for one scene, its training views and their guidance, which are constant. It holds
//! the field's parameters, Adam's moments and every buffer of a step, here or on another device; the loop
//! works on `&mut dyn FieldEngine`.
//!
//! ```text
//! load a state ─▶ evaluate every view ─▶ step, step, … ─▶ drain reports ─▶ evaluate ─▶ centre, save
//!                                                          └─ now and then: save (checkpoints)
//! ```
//!
//! As in stage 1, a step may only be *asked for*; whatever else is asked comes after it.

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

/// What one step does.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FieldPlan {
    /// The step, from 0.
    pub step: u64,
    /// Learning rate of the field.
    pub rate: f64,
    /// Learning rate of the two transport ratios.
    pub transport_rate: f64,
}

/// What came of a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FieldReport {
    /// The step, from 0.
    pub step: u64,
    /// The view's index.
    pub view: usize,
    /// The losses.
    pub losses: StepLosses,
    /// What was not finite, and its first bad element. The state is then of no use, and steps
    /// asked for later may be left out.
    pub non_finite: Option<(&'static str, Option<usize>)>,
}

/// Which pixels of a view are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Reading {
    /// Those that the steps render.
    Sampled,
    /// All that the extractor weighs; for pseudo-labels those of the steps.
    Whole,
}

/// How much an engine keeps and renders of the views.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// Views whose constants are kept in memory; the others are prepared anew in each of their steps.
    pub views_in_memory: usize,
    /// Pixels of all views that the steps render, as a share of all their pixels.
    pub rendered_share: f64,
}

/// Does the work of training stage 2. See the [module](self) for the order of calls.
pub trait FieldEngine: FieldDiagnostics {
    /// Takes the state that the next step starts from: a [new](FieldState::new) one or one that was saved, by
    /// whichever engine. One of [another field](FieldState::check) is refused.
    fn load(&mut self, state: FieldState) -> Result<(), EngineError>;

    /// The state after every step that was asked for.
    fn save(&mut self) -> Result<FieldState, EngineError>;

    /// Asks for one step on a view: render, losses, gradient, Adam.
    fn step(&mut self, view: usize, plan: &FieldPlan) -> Result<(), EngineError>;

    /// The reports of steps, in the order in which they were asked for, each once.
    fn drain(&mut self, which: Drain) -> Result<Vec<FieldReport>, EngineError>;

    /// How far a view is from its reference.
    fn evaluate(&mut self, view: usize, reading: Reading) -> Result<ViewErrors, EngineError>;

    /// The constant mode of the present field over the Gaussians that define it (R22).
    fn centre(&mut self) -> Result<[f32; OUTPUTS], EngineError>;

    /// How much it keeps and renders of the views.
    fn coverage(&self) -> Coverage;
}

/// What an engine may tell of its work besides. Nothing here enters a result, and an engine that
/// knows none of it keeps the default.
pub trait FieldDiagnostics {
    /// Time spent per part of a step.
    fn profile(&self) -> Profile<StepPart> {
        Profile::default()
    }
}

/// The field that a run starts from, at the identity: sizes and seed as the parameters
/// say, its box around the scene.
pub fn initial_field(
    scene: &Scene,
    guidance: Guidance<'_>,
    params: &EnhanceParams,
) -> Result<Field, EnhanceError> {
    // The water asks at the cameras, and so near the anchors; clear radiance is
    // asked for at the Gaussians alone.
    let anchors = match scene.medium.anchors() {
        Some(anchors) if guidance.appearance() == Appearance::Water => anchors.centers,
        _ => &[],
    };
    let bounds = FieldBox::of_scene(&scene.gaussians.means, anchors);
    Ok(Field::identity(params.shape(), bounds, params.seed)?)
}

/// Whether scene, views, guidance and parameters are such that stage 2 can learn from them.
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
    if let Guidance::Targets(targets) = guidance {
        targets.check_scene(&scene.gaussians)?;
    }
    Ok(())
}

fn check_guidance(guidance: Guidance<'_>, objective: Objective) -> Result<(), EnhanceError> {
    let (objective, needed, fits) = match objective {
        Objective::Full => ("full", "transition targets", matches!(guidance, Guidance::Targets(_))),
        Objective::GlobalOnly => {
            ("global-only", "transition targets", matches!(guidance, Guidance::Targets(_)))
        }
        Objective::LocalOnly => {
            ("local-only", "transition targets", matches!(guidance, Guidance::Targets(_)))
        }
        Objective::PseudoLabels => (
            "pseudo-labels",
            "enhanced images of the training views",
            matches!(guidance, Guidance::Labels(_)),
        ),
    };
    if fits { Ok(()) } else { Err(EnhanceError::Guidance { objective, needed }) }
}
