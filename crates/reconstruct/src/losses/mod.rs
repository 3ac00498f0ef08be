//! The loss of stage 1: a weighted sum of terms, each a file of this folder and a row of [`TERMS`].
//!
//! ```text
//! L = Σ weight · value        over the terms that have a value for the view
//! ```
//!
//! A row defines a term's names and weights; the weights of a step, the lines of the log and the sum itself
//! follow from the table. A term reads the rendered view and its photograph ([`Observation`]), writes its
//! values before their weights, and adds the gradients of its weighted sum with respect to the rasters that
//! it read ([`ViewGradients`]).

mod background;
mod backscatter;
mod clear_colors;
mod depth;
mod far;
mod flatness;
mod gradients;
mod inverse_depth;
mod photometric;
mod ranking;
mod smoothness;

use use3d_capture::{Camera, Image, Map, MediumMaps};
use use3d_splat::{Gaussians, Prepared};

pub use depth::{DEPTH_SCALE, DepthPriorLoss, FEWEST_PIXELS};
pub use gradients::{Slot, ViewGradients};
pub use photometric::{PhotometricLoss, PhotometricValue};

use crate::{ReconstructParams, Target};

/// Every term, in the order in which values are summed and reported: those of the method, then those of the
/// methods it is compared with.
pub const TERMS: &[LossTerm] = &[
    photometric::TERM,
    depth::TERM,
    photometric::ONE_LEVEL,
    photometric::PLAIN,
    ranking::TERM,
    smoothness::TERM,
    smoothness::BY_PRIOR,
    smoothness::NORMALISED,
    far::TERM,
    backscatter::TERM,
    clear_colors::TERM,
    background::TERM,
    inverse_depth::TERM,
    flatness::TERM,
];

/// Number of values of the method's own terms. A log has these in every line, and others where they have a
/// value.
pub(crate) const OWN_VALUES: usize = 3;

/// A row of the table: the names and weights of a term's values, and the term.
#[derive(Clone, Copy, Debug)]
pub struct LossTerm {
    /// The term's values: usually one; several if they are computed in one pass.
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

/// The input of a term for a view in a step. All rasters have the step's size.
#[derive(Clone, Copy, Debug)]
pub struct Observation<'a> {
    /// The step, from 0.
    pub step: u64,
    /// The camera at the step's size.
    pub camera: &'a Camera,
    /// The rendered view through water and, if views have gains, with its gain. It is compared with the
    /// photograph.
    pub image: &'a Image,
    /// The view without water, `Σ w c`, if a term with a weight [reads](Term::reads_clear) it.
    pub clear: Option<&'a Image>,
    /// Its expected depth along the optical axis, scene units; 0 where nothing is hit.
    pub depth: &'a Map,
    /// Its accumulated weight, in `[0, 1)`.
    pub accumulation: &'a Map,
    /// The water of each pixel; `None` for a scene without water.
    pub water: Option<&'a MediumMaps>,
    /// The photograph, the pixels of it that count, and other known data of the view.
    pub target: &'a Target,
    /// The Gaussians.
    pub gaussians: &'a Gaussians,
    /// Those of them that reach the view.
    pub prepared: &'a Prepared,
}

/// A term of the loss, with its buffers.
pub trait Term: Send {
    /// True if the term reads the clear image.
    fn reads_clear(&self) -> bool {
        false
    }

    /// Writes the term's values, before their weights, into `values`: `None` if the view has no data for
    /// one. Adds to `gradients` those of their weighted sum. `weights` has one entry per value, and not all
    /// of them are 0.
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    );

    /// Mean squared error of the last view over the pixels that count, for a PSNR, if the term measures it.
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
    /// Values before their weights, in the table's order; `None` if a term was left out or has no value for
    /// the view.
    pub values: Vec<Option<f64>>,
    /// Mean squared error over the pixels that count, if a term measures it.
    pub squared_error: Option<f64>,
}

/// All terms of an engine, with the gradients that they computed.
pub(crate) struct Losses {
    terms: Vec<(usize, Box<dyn Term>)>,
    pub(crate) gradients: ViewGradients,
}

impl Losses {
    pub(crate) fn new(table: &[LossTerm]) -> Self {
        let terms = table.iter().map(|row| (row.values.len(), (row.term)())).collect();
        Self { terms, gradients: ViewGradients::default() }
    }

    /// Number of values of all terms together.
    pub(crate) fn values(&self) -> usize {
        self.terms.iter().map(|(values, _)| values).sum()
    }

    /// True if a term with a weight reads the clear image.
    pub(crate) fn read_clear(&self, weights: &[f64]) -> bool {
        let mut at = 0;
        self.terms.iter().any(|(count, term)| {
            let range = at..at + *count;
            at = range.end;
            term.reads_clear() && weights[range].iter().any(|w| *w != 0.0)
        })
    }

    /// Computes the loss of a view; `weights` has one entry per value. Its gradients replace those of the
    /// last call.
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
