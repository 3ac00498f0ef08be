//! The calibrator: corrects the proposals of a 2D enhancer towards those of paired data.
//!
//! It consists of two small networks in residual form ([`Head`]). The *global head* maps 18 source
//! descriptors and the proposal's global operator (12) to a calibrated global operator. The *local head*
//! works cell by cell, without neighbours. Its inputs are 6 cell descriptors, the 18 source descriptors,
//! the proposal's global (12) and local operator (6), and one more global operator (12); its output is a
//! calibrated local operator. The last input is the global head's own prediction in training, and the scene
//! consensus in use. Both heads are trained on paired images in operator space ([`train`]) and frozen
//! afterwards.
//!
//! The recipe is R18: Smooth-L1 with corner ½ on errors in interquartile units, AdamW at 2·10⁻⁴ with a
//! cosine decay to 5 %, joint gradient norm at most 10, 750 steps of 128 pairs and 4096 cells, or fewer
//! steps if held-out pairs are better with fewer. Known limit: people chose the paired "ground truth" of
//! underwater enhancement among results of older methods, and the calibrator learns their taste.

mod artifact;
mod dataset;
mod evaluate;
mod head;
mod mlp;
mod params;
mod product;
mod released;
mod statistics;
mod stopping;
mod training;

#[cfg(test)]
mod golden_tests;

use serde::{Deserialize, Serialize};

use crate::error::AtcError;
use crate::extractor::{
    Affine, Descriptors, ExtractorSettings, GLOBAL_DESCRIPTOR, LOCAL_DESCRIPTOR, Transition,
};
use crate::proposers::ProposerId;
use mlp::Trace;

pub use dataset::{Dataset, PairExample, PairImages, Skipped};
pub use evaluate::{ErrorChange, HeldOutReport, TransitionErrors, evaluate, held_out};
pub use head::Head;
pub use mlp::{Linear, Mlp};
pub use params::{CalibratorParams, LastLayer, METHOD_PAIRS, Scales};
pub use released::ReleasedConfig;
pub use statistics::{CONDITION_FLOOR, RANGE_FLOOR, SCALE_FLOOR, Statistics};
pub use stopping::train;

/// Conditions of the global head: descriptor 18, proposal 12.
pub const GLOBAL_CONDITION: usize = GLOBAL_DESCRIPTOR + 12;
/// Conditions of the local head: cell 6, descriptor 18, proposal global 12, proposal local 6, global 12.
pub const LOCAL_CONDITION: usize = LOCAL_DESCRIPTOR + GLOBAL_DESCRIPTOR + 12 + 6 + 12;

/// Usual scales of a global operator's row: half the interquartile ranges of residuals of synthetic pairs.
const USUAL_GLOBAL: [f32; 4] = [0.3, 0.3, 0.3, 0.15];
/// Usual scales of a local operator, chosen in the same way.
const USUAL_LOCAL: [f32; 6] = [0.08, 0.08, 0.08, 0.03, 0.03, 0.03];

/// The origin of a calibrator.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Provenance {
    /// The pairs, in the caller's words (folders, or a dataset's name).
    pub data: String,
    /// Number of pairs used in the fit.
    pub pairs: usize,
    /// Number of cells used in the fit.
    pub cells: usize,
    /// Number of optimiser steps.
    pub steps: u64,
    /// The seed of initialisation and sampling.
    pub seed: u64,
    /// Loss of the last step, interquartile units.
    pub loss: f64,
    /// The effect of a fit to a part of the pairs on the other pairs.
    pub held_out: Option<HeldOutReport>,
    /// The tool's version.
    pub tool: String,
}

/// A trained, frozen calibrator.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibrator {
    /// The extractor settings with which it was fitted; scenes use the same (R17).
    pub extractor: ExtractorSettings,
    /// The proposer it was fitted for (R25).
    pub proposer: ProposerId,
    /// Global head, 30 → 12.
    pub global: Head,
    /// Local head, 54 → 6.
    pub local: Head,
    /// The calibrator's origin.
    pub provenance: Provenance,
}

impl Calibrator {
    /// The calibrator that returns every proposal unchanged (unit scales).
    pub fn identity(extractor: ExtractorSettings, proposer: ProposerId) -> Self {
        Self {
            extractor,
            proposer,
            global: Head::identity(GLOBAL_CONDITION, 8, 12),
            local: Head::identity(LOCAL_CONDITION, 8, 6),
            provenance: Provenance::default(),
        }
    }

    /// A calibrator for proposals without pairs: it returns them unchanged. Its scales are those that are
    /// usual for transitions of underwater images, because none were measured.
    pub fn uncalibrated(extractor: ExtractorSettings, proposer: ProposerId) -> Self {
        let mut calibrator = Self::identity(extractor, proposer);
        calibrator.global.residual.range = USUAL_GLOBAL.repeat(3);
        calibrator.local.residual.range = USUAL_LOCAL.to_vec();
        calibrator
    }

    /// True for the global and for the local head if it corrects anything. A head that keeps no share of
    /// its correction returns the proposal.
    pub fn corrects(&self) -> [bool; 2] {
        [&self.global, &self.local].map(Head::corrects)
    }

    /// The scales `s_g` of the global operator's 12 numbers, floored at 10⁻⁴ (R19).
    pub fn global_scales(&self) -> [f64; 12] {
        std::array::from_fn(|k| f64::from(self.global.residual.range[k]).max(SCALE_FLOOR))
    }

    /// The scales `s_ℓ` of a local operator's 6 numbers, floored at 10⁻⁴ (R19).
    pub fn local_scales(&self) -> [f64; 6] {
        std::array::from_fn(|k| f64::from(self.local.residual.range[k]).max(SCALE_FLOOR))
    }

    /// The calibrated global operator of one image.
    pub fn calibrate_global(&self, descriptor: &[f64; GLOBAL_DESCRIPTOR], proposal: &Affine) -> Affine {
        let mut conditions: Vec<f32> = descriptor.iter().chain(proposal).map(|&v| v as f32).collect();
        let mut trace = Trace::default();
        self.global.run(&mut conditions, &mut trace);
        std::array::from_fn(|k| proposal[k] + self.global.residual_of(k, trace.output[k]))
    }

    /// The calibrated local operators of one image under the global operator `scene`. `descriptors` and
    /// `proposal` must have the same grid.
    pub fn calibrate_local(
        &self,
        descriptors: &Descriptors,
        proposal: &Transition,
        scene: &Affine,
    ) -> Result<Vec<[f64; 6]>, AtcError> {
        if descriptors.local.len() != proposal.local.len() {
            return Err(AtcError::artifact(
                "conditions of the local head",
                format!(
                    "{} cells are described, the proposal has {}",
                    descriptors.local.len(),
                    proposal.local.len()
                ),
            ));
        }
        let cells = descriptors.local.iter().zip(&proposal.local);
        Ok(self.corrected(&descriptors.global, &proposal.global, cells, scene))
    }

    /// The calibrated local operators of cells, each with its descriptor and the proposal's operator.
    fn corrected<'a>(
        &self,
        descriptor: &[f64; GLOBAL_DESCRIPTOR],
        proposal: &Affine,
        cells: impl Iterator<Item = (&'a [f64; LOCAL_DESCRIPTOR], &'a [f64; 6])> + Clone,
        global: &Affine,
    ) -> Vec<[f64; 6]> {
        let mut conditions = Vec::new();
        for (cell, operator) in cells.clone() {
            push_local_condition(&mut conditions, cell, descriptor, proposal, operator, global);
        }
        let mut trace = Trace::default();
        self.local.run(&mut conditions, &mut trace);
        let outputs = trace.output.as_chunks::<6>().0;
        cells
            .zip(outputs)
            .map(|((_, p), out)| std::array::from_fn(|k| p[k] + self.local.residual_of(k, out[k])))
            .collect()
    }
}

/// Appends one row of the local head's conditions, in their fixed order.
fn push_local_condition(
    rows: &mut Vec<f32>,
    cell: &[f64; LOCAL_DESCRIPTOR],
    descriptor: &[f64; GLOBAL_DESCRIPTOR],
    proposal_global: &Affine,
    proposal_local: &[f64; 6],
    global: &Affine,
) {
    let parts: [&[f64]; 5] = [cell, descriptor, proposal_global, proposal_local, global];
    rows.extend(parts.into_iter().flatten().map(|&v| v as f32));
}
