//! What stage 2 minimises: a weighted sum of terms, each a file of this folder and a row of [`TERMS`].
//!
//! ```text
//! L = Σ weight · value        over the terms that say something of the view
//! ```
//!
//! A row gives a term's name, its weight, and a value with its derivative. Terms differ in what
//! they read ([`Reads`]): the operators that the extractor reads off a render, the rendered
//! pixels, or the field itself. Weights, the sum, the lines of the log, the report of each view
//! and the plot follow from the table.

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

/// Every term of the method, in the order in which values are summed and told.
pub const TERMS: [LossTerm; 4] = [global::TERM, local::TERM, pixels::TERM, variation::TERM];

/// How many there are.
pub const COUNT: usize = TERMS.len();

/// Smallest scale that errors are divided by.
const SCALE_FLOOR: f64 = 1e-4;

/// A row of the table.
#[derive(Clone, Copy, Debug)]
pub struct LossTerm {
    /// Its name in the log and the report; its error, where it measures one, is `NAME_error` in the log.
    pub name: &'static str,
    /// What a plot calls it.
    pub title: &'static str,
    /// Its weight, finite and not negative. A term of weight 0 is told, and pulls at nothing.
    pub weight: fn(&EnhanceParams) -> f64,
    /// What it reads, and its value with the derivative.
    pub reads: Reads,
}

/// What a term reads. Each function returns the value before its weight and *adds*
/// `weight · ∂value` to the gradient.
#[derive(Clone, Copy, Debug)]
pub enum Reads {
    /// The transition from the stage-1 render of a view to its enhanced one, where
    /// the view has transition targets.
    Operators(fn(&Operators<'_>, f64, &mut Transition) -> Realised),
    /// The rendered pixels, where the view has a pseudo-label.
    Pixels(fn(&Pixels<'_>, f64, &mut Image) -> f64),
    /// The field, whatever the view.
    Field {
        /// The value.
        value: fn(&Field) -> f64,
        /// Adds its weighted derivative.
        backward: fn(&Field, f64, &mut Gradient),
    },
}

impl LossTerm {
    /// Whether it says how far a view is from what was aimed at.
    pub fn is_of_views(&self) -> bool {
        !matches!(self.reads, Reads::Field { .. })
    }

    /// Whether it measures an error in units of the paired data's spread.
    pub fn measures_errors(&self) -> bool {
        matches!(self.reads, Reads::Operators(_))
    }
}

/// A term's value and how far the realised operator is from the target, in units of the paired data's spread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Realised {
    /// The loss.
    pub loss: f64,
    /// Root mean square of the normalised errors (weighted by support for the local term);
    /// 0 of a term that measures none.
    pub error: f64,
}

/// One entry per row of the table; `None` where a term has nothing to say.
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
    /// Takes up the value of row `at`.
    pub(crate) fn put(&mut self, at: usize, weight: f64, value: Realised) {
        self.total += weight * value.loss;
        self.values[at] = Some(value);
    }
}

/// The value of the term of that name.
pub fn named(values: &Values, name: &str) -> Option<Realised> {
    TERMS.iter().zip(values).find(|(row, _)| row.name == name).and_then(|(_, value)| *value)
}

/// What a term of operators sees.
#[derive(Clone, Copy, Debug)]
pub struct Operators<'a> {
    /// What the render makes of the stage-1 render; cells are not centred.
    pub realised: &'a Transition,
    /// The view's own target, on the extractor's grid.
    pub target: &'a ViewTarget,
    /// What all views aim at.
    pub goals: &'a Goals,
}

/// What a term of pixels sees.
#[derive(Clone, Copy, Debug)]
pub struct Pixels<'a> {
    /// The render on the view's lattice.
    pub image: &'a Image,
    /// The pseudo-label's pixels there, 16 bit.
    pub label: &'a Raster<u16, 3>,
    /// How the two are compared.
    pub compared: PixelLoss,
}

/// Smooth-L1 with β = 1: value and derivative, `½x²` for `|x| < 1`, `|x| - ½` otherwise.
#[inline]
pub fn smooth_l1(x: f64) -> (f64, f64) {
    if x.abs() < 1.0 { (0.5 * x * x, x) } else { (x.abs() - 0.5, x.signum()) }
}

#[cfg(test)]
mod tests;
