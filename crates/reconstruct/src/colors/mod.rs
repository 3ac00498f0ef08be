//! Colour fields: functions that change the Gaussians' constant colours for one view before it is composed.
//!
//! ```text
//! h'_i = f(θ, v, x_i, h_i)                      for the view v; rendered are h' and the other bands
//! ∂L/∂θ += ∂f/∂θ ∂L/∂h' + weight ∂R/∂θ          ∂L/∂h = ∂f/∂h ∂L/∂h'
//! ```
//!
//! | symbol | meaning | shape |
//! |---|---|---|
//! | h, h' | constant coefficients of the colours, of the scene and as a view shows them | N × 3 |
//! | x | centres of the Gaussians | N × 3 |
//! | θ | parameters of the field, in runs of one [`ColorRole`] each | any |
//! | R | regulariser of the field | 1 |
//!
//! A field is a file of this folder, a variant of [`ColorField`] and a row of [`ColorField::model`]. Fields
//! belong to photographs. The scene at the end has the colours that [`ColorState::settle`] gives it, and
//! views that are not trained show those too.

mod appearance;
mod caustics;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::adam::Adam;
use use3d_splat::{GaussianGradients, Gaussians};
use use3d_training::EngineError;

/// A change of the scene's colours from view to view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ColorField {
    /// All views show the same colours, as in the method.
    #[default]
    Off,
    /// Light that waves focus on the scene, different in every training view (MarineSTD-GS). It is left out
    /// of the scene.
    Caustics,
    /// Light and white balance of every training view (3D-UIR). The scene at the end has their mean.
    Appearance,
}

impl ColorField {
    fn model(self) -> Option<&'static dyn ColorModel> {
        match self {
            Self::Off => None,
            Self::Caustics => Some(&caustics::CAUSTICS),
            Self::Appearance => Some(&appearance::AppearanceNetwork),
        }
    }

    /// The name in parameters.
    pub fn name(self) -> &'static str {
        match self {
            Self::Off => "off",
            Self::Caustics => "caustics",
            Self::Appearance => "appearance",
        }
    }
}

/// The role of a parameter of a field, by which it gets its learning rate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ColorRole {
    /// A feature of a place in the scene.
    Grid,
    /// A weight or bias of a network.
    Network,
    /// A number of a view.
    Code,
}

/// The settings by which a colour field is learnt in a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColorStep {
    /// Rates of the roles, in their order.
    pub rates: [f64; 3],
    /// Weight of the field's regulariser.
    pub weight: f64,
    /// True if the field is learnt beside the scene: Gaussians and water are learnt without it, and it
    /// changes neither.
    pub alone: bool,
}

/// A kind of field: its code. Its parameters are in [`ColorState`].
trait ColorModel: Sync {
    /// Lengths of the runs of parameters, in order, for this number of views.
    fn groups(&self, views: usize) -> Vec<(ColorRole, usize)>;

    /// The parameters at the start.
    fn start(&self, views: usize, seed: u64) -> Vec<f32>;

    /// Writes h' of every Gaussian, which has h before, into `constants`; `view` is `None` for a view that
    /// is not trained.
    fn show(&self, values: &[f32], view: Option<usize>, means: &[[f32; 3]], constants: &mut [[f32; 3]]);

    /// Returns R. Adds to `gradient` the gradient with respect to θ, and turns the one with respect to h',
    /// which lies in the first coefficients of `d_sh`, into the one with respect to h.
    fn backward(
        &self,
        values: &[f32],
        view: usize,
        means: &[[f32; 3]],
        constants: &[[f32; 3]],
        weight: f64,
        d_sh: &mut [[[f32; 3]; 16]],
        gradient: &mut [f32],
    ) -> f64;
}

/// The colour field of a run, with Adam's moments.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ColorState {
    /// Its kind.
    pub field: ColorField,
    /// Number of training views.
    pub views: usize,
    /// θ.
    pub values: Vec<f32>,
    /// Means of gradients and of squared gradients, like the values.
    pub moments: [Vec<f32>; 2],
}

impl ColorState {
    /// The state at the start of a run.
    pub fn new(field: ColorField, views: usize, seed: u64) -> Self {
        let Some(model) = field.model() else { return Self::default() };
        let values = model.start(views, seed);
        let zeros = vec![0.0; values.len()];
        Self { field, views, values, moments: [zeros.clone(), zeros] }
    }

    /// Checks that all lengths agree with the kind and with the number of training views.
    ///
    /// # Errors
    /// They do not agree.
    pub fn check(&self, views: usize) -> Result<(), EngineError> {
        let lengths = [self.values.len(), self.moments[0].len(), self.moments[1].len()];
        let (expected, known) = match self.field.model() {
            Some(model) => (model.groups(views).iter().map(|(_, count)| count).sum(), self.views == views),
            None => (0, true),
        };
        if known && lengths == [expected; 3] {
            return Ok(());
        }
        Err(EngineError::State(format!(
            "its colour field `{}` of {} views has {lengths:?} numbers, expected {expected} for {views} views",
            self.field.name(),
            self.views
        )))
    }

    /// True if every view shows the scene's own colours.
    pub fn is_off(&self) -> bool {
        self.field == ColorField::Off
    }

    /// Gives the Gaussians the colours that a view shows; `own` receives those of the scene.
    pub(crate) fn show(&self, view: Option<usize>, gaussians: &mut Gaussians, own: &mut Vec<[f32; 3]>) {
        let Some(model) = self.field.model() else { return };
        own.clear();
        own.extend(gaussians.sh.iter().map(|sh| sh[0]));
        model.show(&self.values, view, &gaussians.means, own);
        for (sh, shown) in gaussians.sh.iter_mut().zip(own) {
            std::mem::swap(&mut sh[0], shown);
        }
    }

    /// Gives the scene the colours that remain of it.
    pub(crate) fn settle(&self, gaussians: &mut Gaussians) {
        self.show(None, gaussians, &mut Vec::new());
    }

    /// Returns the regulariser and writes the gradient of the field's parameters. Turns the gradient of the
    /// colours that the view shows into that of the scene's colours, which `gaussians` has again.
    pub(crate) fn backward(
        &self,
        view: usize,
        weight: f64,
        gaussians: &Gaussians,
        own: &[[f32; 3]],
        gradients: &mut GaussianGradients,
        gradient: &mut Vec<f32>,
    ) -> f64 {
        let Some(model) = self.field.model() else { return 0.0 };
        gradient.clear();
        gradient.resize(self.values.len(), 0.0);
        model.backward(&self.values, view, &gaussians.means, own, weight, &mut gradients.sh, gradient)
    }

    /// Makes one Adam step; false if a parameter is not finite afterwards.
    pub(crate) fn update(&mut self, step: u64, rates: [f64; 3], gradient: &[f32]) -> bool {
        let Some(model) = self.field.model() else { return true };
        let [m, v] = &mut self.moments;
        let mut from = 0;
        for (role, count) in model.groups(self.views) {
            let run = from..from + count;
            from = run.end;
            let (m, v) = (&mut m[run.clone()], &mut v[run.clone()]);
            let (values, gradient) = (&mut self.values[run.clone()], &gradient[run]);
            Adam::SPLATTING.update(step + 1, rates[role as usize], values, gradient, m, v);
        }
        self.values.iter().all(|v| v.is_finite())
    }
}

/// Sets the constant coefficients of all Gaussians.
pub(crate) fn restore(gaussians: &mut Gaussians, constants: &[[f32; 3]]) {
    for (sh, constant) in gaussians.sh.iter_mut().zip(constants) {
        sh[0] = *constant;
    }
}

#[cfg(test)]
mod tests;
