//! The loss of stage 2: a weighted sum of terms, each a file of this folder and a row of [`TERMS`].
//!
//! ```text
//! L = Σ weight · value        over the terms that have a value for the view
//! ```
//!
//! A row defines a term's name, its weight, and a value with its derivative. Terms differ in their input
//! ([`Reads`]): the operators that the extractor computes from a render, the rendered pixels, or the field
//! itself. Weights, the sum, the lines of the log, the report of each view and the plot follow from the
//! table.

mod global;
mod local;
mod pixels;
mod variation;

use serde::{Deserialize, Serialize};
use use3d_atc::consensus::ViewTarget;
use use3d_atc::extractor::Transition;
use use3d_capture::{Image, Raster};
use use3d_ubaf::{Field, Gradient};

pub use global::global_loss;
pub use local::local_loss;

use crate::EnhanceParams;
use crate::engine::Goals;
use crate::params::PixelLoss;

/// Every term of the method, in the order in which values are summed and reported.
pub const TERMS: [LossTerm; 4] = [global::TERM, local::TERM, pixels::TERM, variation::TERM];

/// Number of terms.
pub const COUNT: usize = TERMS.len();

/// A row of the table.
#[derive(Clone, Copy, Debug)]
pub struct LossTerm {
    /// Its name in the log and the report; its error, where it measures one, is `NAME_error` in the log.
    pub name: &'static str,
    /// Its name in a plot.
    pub title: &'static str,
    /// Its weight, finite and not negative. A term of weight 0 is reported but has no effect.
    pub weight: fn(&EnhanceParams) -> f64,
    /// Its input, and the functions for its value and derivative.
    pub reads: Reads,
}

/// The input of a term. Each function returns the value before its weight and *adds* `weight · ∂value` to
/// the gradient.
#[derive(Clone, Copy, Debug)]
pub enum Reads {
    /// The transition from the stage-1 render of a view to its enhanced render, if the view has transition
    /// targets.
    Operators(fn(&Operators<'_>, f64, &mut Transition) -> Realised),
    /// The rendered pixels, if the view has a pseudo-label.
    Pixels(fn(&Pixels<'_>, f64, &mut Image) -> f64),
    /// The field, for any view.
    Field {
        /// The value.
        value: fn(&Field) -> f64,
        /// Adds its weighted gradient.
        backward: fn(&Field, f64, &mut Gradient),
    },
}

impl LossTerm {
    /// True if it measures the distance of a view from its goal.
    pub fn is_of_views(&self) -> bool {
        !matches!(self.reads, Reads::Field { .. })
    }

    /// True if it measures an error in units of the paired data's spread.
    pub fn measures_errors(&self) -> bool {
        matches!(self.reads, Reads::Operators(_))
    }
}

/// A term's value, and the distance of the realised operator from the target, in units of the paired data's
/// spread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Realised {
    /// The loss.
    pub loss: f64,
    /// Root mean square of the normalised errors (weighted by support for the local term); 0 for a term
    /// that measures none.
    pub error: f64,
}

/// One entry per row of the table; `None` for a term without a value.
pub type Values = [Option<Realised>; COUNT];

/// The losses of one step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepLosses {
    /// `Σ weight · value`.
    pub total: f64,
    /// Values before their weights, in the table's order.
    pub values: Values,
}

impl StepLosses {
    /// Sets the value of row `at` and adds it to the total.
    pub(crate) fn put(&mut self, at: usize, weight: f64, value: Realised) {
        self.total += weight * value.loss;
        self.values[at] = Some(value);
    }
}

/// The input of a term of operators.
#[derive(Clone, Copy, Debug)]
pub struct Operators<'a> {
    /// The transition from the stage-1 render to the render; cells are not centred.
    pub realised: &'a Transition,
    /// The view's own target, on the extractor's grid.
    pub target: &'a ViewTarget,
    /// The goals of all views.
    pub goals: &'a Goals,
}

/// The input of a term of pixels.
#[derive(Clone, Copy, Debug)]
pub struct Pixels<'a> {
    /// The render on the view's lattice.
    pub image: &'a Image,
    /// The pseudo-label's pixels on this lattice, 16 bit.
    pub label: &'a Raster<u16, 3>,
    /// The comparison of the two.
    pub compared: PixelLoss,
}

/// Smooth-L1 with β = 1: value and derivative, `½x²` for `|x| < 1`, `|x| - ½` otherwise.
#[inline]
pub fn smooth_l1(x: f64) -> (f64, f64) {
    if x.abs() < 1.0 { (0.5 * x * x, x) } else { (x.abs() - 0.5, x.signum()) }
}

#[cfg(test)]
mod tests;
