//! What stage 1 minimises: a weighted sum of terms, each a file of this folder and a row of [`TERMS`].
//!
//! ```text
//! L = Σ weight · value        over the terms that say something of the view
//! ```
//!
//! A row gives a term's names and weights; weights of a step, the lines of the log and the sum itself follow
//! from the table. A term sees the view as it was rendered and as it was photographed ([`Observation`]), says
//! its values before their weights, and gives the derivatives of its weighted sum with respect to whatever it
//! read of the render ([`ViewGradients`]).

mod depth;
mod gradients;
mod photometric;

use use3d_capture::{Camera, Image, Map, MediumMaps};

pub use depth::{DEPTH_SCALE, DepthPriorLoss, FEWEST_PIXELS};
pub use gradients::{Slot, ViewGradients};
pub use photometric::{PhotometricLoss, PhotometricValue};

use crate::{ReconstructParams, Target};

/// Every term of the method, in the order in which values are summed and told.
pub const TERMS: &[LossTerm] = &[photometric::TERM, depth::TERM];

/// A row of the table: what a term's values are called and weigh, and the term.
#[derive(Clone, Copy, Debug)]
pub struct LossTerm {
    /// Its values: usually one, more where several are computed in one pass.
    pub values: &'static [LossValue],
    /// Makes the term with its buffers.
    pub term: fn() -> Box<dyn Term>,
}

/// A value of a term.
#[derive(Clone, Copy, Debug)]
pub struct LossValue {
    /// Its name in the log.
    pub name: &'static str,
    /// Its weight at a step of a run with these parameters, finite and not negative; 0 leaves it out.
    pub weight: fn(&ReconstructParams, u64) -> f64,
}

/// What a term sees of a view in a step. All rasters have the step's size.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a> {
    /// The step, from 0.
    pub step: u64,
    /// The camera at the step's size.
    pub camera: &'a Camera,
    /// The rendered view through water and, where views have gains, with its gain: what
    /// a photograph is compared with.
    pub image: &'a Image,
    /// Its expected depth along the optical axis, scene units; 0 where nothing is hit.
    pub depth: &'a Map,
    /// Its accumulated weight, in `[0, 1)`.
    pub accumulation: &'a Map,
    /// The water of each pixel; `None` for a scene without water.
    pub water: Option<&'a MediumMaps>,
    /// The photograph, what of it counts, and what else is known of the view.
    pub target: &'a Target,
}

/// A term of the loss, with its buffers.
pub trait Term: Send {
    /// Writes the term's values, before their weights, into `values`: `None` where the view gives no
    /// reason for one. Gives `gradients` the derivatives of their weighted sum. `weights` has one
    /// entry per value, not all of them 0.
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    );

    /// Mean squared error of the last view over the pixels that count, for a PSNR, where
    /// the term measures it on the way.
    fn squared_error(&self) -> Option<f64> {
        None
    }
}

/// Names of all values, in the table's order.
pub fn names() -> impl Iterator<Item = &'static str> {
    TERMS.iter().flat_map(|row| row.values).map(|value| value.name)
}

/// Weights of all values at a step, in the table's order.
pub fn weights(params: &ReconstructParams, step: u64) -> Vec<f64> {
    TERMS.iter().flat_map(|row| row.values).map(|value| (value.weight)(params, step)).collect()
}

/// The loss of one view.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Loss {
    /// `Σ weight · value`.
    pub total: f64,
    /// Values before their weights, in the table's order; `None` where a term was left out or
    /// has nothing to say of the view.
    pub values: Vec<Option<f64>>,
    /// Mean squared error over the pixels that count, where a term measures it.
    pub squared_error: Option<f64>,
}

/// Terms at work, with the derivatives that they left.
pub(crate) struct Losses {
    terms: Vec<(usize, Box<dyn Term>)>,
    pub(crate) gradients: ViewGradients,
}

impl Losses {
    pub(crate) fn new(table: &[LossTerm]) -> Self {
        let terms = table.iter().map(|row| (row.values.len(), (row.term)())).collect();
        Self { terms, gradients: ViewGradients::default() }
    }

    /// Values of all terms together.
    pub(crate) fn values(&self) -> usize {
        self.terms.iter().map(|(values, _)| values).sum()
    }

    /// The loss of a view; `weights` has one entry per value. Its derivatives
    /// replace those that were left before.
    pub(crate) fn evaluate(&mut self, seen: &Observation<'_>, weights: &[f64]) -> Loss {
        self.gradients.forget();
        let mut loss = Loss { values: vec![None; weights.len()], ..Loss::default() };
        let mut at = 0;
        for (count, term) in &mut self.terms {
            let range = at..at + *count;
            at = range.end;
            let weights = &weights[range.clone()];
            if weights.iter().all(|w| *w == 0.0) {
                continue;
            }
            term.evaluate(seen, weights, &mut loss.values[range], &mut self.gradients);
            loss.squared_error = loss.squared_error.or(term.squared_error());
        }
        for (weight, value) in weights.iter().zip(&loss.values) {
            loss.total += weight * value.unwrap_or(0.0);
        }
        loss
    }
}

#[cfg(test)]
mod tests;
