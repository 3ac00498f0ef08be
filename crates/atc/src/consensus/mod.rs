//! The consensus: computes fixed targets for the scene from one proposal per view.
//!
//! Every captured view is proposed, extracted and calibrated separately ([`Recorder`]). The views' global
//! operators become one scene operator ([`global_consensus`]). Under that, each view's local operators are
//! calibrated, centred, lifted to the Gaussians and fused ([`Lift`], [`LocalConsensus`]). Stage 2 learns
//! only from the result, [`Targets`]: one global operator, one local operator per Gaussian, and the scales
//! in which errors are measured. Pixels are needed once, and for one view at a time.

mod global;
mod local;
mod order;
mod preview;
mod rasterise;
mod targets;
mod views;

pub use global::{GlobalConsensus, PROBES, global_consensus, refit, response};
pub use local::{Adjoint, Lift, LocalConsensus, SUPPORTING_VIEWS};
pub use order::{OrderEffect, order_effect};
pub use preview::{Preview, apply_transition, side_by_side};
pub use rasterise::{ViewTarget, support_map, view_target};
pub use targets::Targets;
pub use views::{Proposals, Recorder, ViewInput, ViewRecord};

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::{Appearance, KeptWater};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};

use crate::calibrator::Calibrator;
use crate::error::AtcError;
use crate::extractor::Affine;
use crate::progress::{LoopPosition, ProgressCallback, report};
use crate::proposers::ProposerId;

/// Parameters of the targets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TargetsParams {
    /// Fuse the views a second time in a shuffled order and report how much the targets depend on it. This
    /// doubles the cost of the lifting.
    pub measure_order: bool,
    /// Seed of that shuffle. Not read from settings: the caller sets it.
    #[serde(skip)]
    pub seed: u64,
}

impl Default for TargetsParams {
    fn default() -> Self {
        Self { measure_order: false, seed: 42 }
    }
}

/// The consensus's data on one view.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ViewReport {
    /// Its name.
    pub name: String,
    /// Its calibrated global operator.
    pub candidate: Affine,
    /// Distance of its responses to the probes from the consensus.
    pub distance: f64,
    /// Root mean square of its centred local operators, in units of `s_ℓ`.
    pub local: f64,
}

/// The findings of the consensus.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TargetsReport {
    /// The views, in the order of fusion.
    pub views: Vec<ViewReport>,
    /// The median of the views' distances.
    pub dispersion: f64,
    /// Number of Gaussians in the scene.
    pub gaussians: usize,
    /// Number of Gaussians with a target.
    pub supported: usize,
    /// The dependence of the targets on the order of the views, if it was measured.
    pub order: Option<OrderEffect>,
    /// The proposer of the proposals.
    #[serde(default)]
    pub proposer: ProposerId,
    /// The kind of images that the transitions connect.
    #[serde(default)]
    pub appearance: Appearance,
    /// The share of the stage-1 water in those images.
    #[serde(default, skip_serializing_if = "KeptWater::is_all")]
    pub kept_water: KeptWater,
    /// True if a calibrator corrected any proposal.
    #[serde(default)]
    pub calibrated: bool,
}

/// Builds the targets of a scene from records of its views, in capture order. `appearance` and `kept_water`
/// describe the water in the images of the records.
pub fn targets_from_records(
    lift: &mut Lift<'_>,
    records: &[ViewRecord],
    (appearance, kept_water): (Appearance, KeptWater),
    proposer: ProposerId,
    calibrator: &Calibrator,
    params: &TargetsParams,
    watch: &mut ProgressCallback<'_>,
) -> Result<(Targets, TargetsReport), AtcError> {
    let candidates: Vec<Affine> = records.iter().map(|r| r.candidate).collect();
    let global = global_consensus(&candidates).ok_or(AtcError::NoViews)?;
    let capture_order: Vec<usize> = (0..records.len()).collect();
    let state = fuse_views(lift, records, &capture_order, calibrator, &global.operator, watch)?;
    let targets = Targets {
        extractor: calibrator.extractor.clone(),
        proposer: proposer.clone(),
        appearance,
        kept_water,
        scene: global.operator,
        dispersion: global.dispersion,
        global_scales: calibrator.global_scales(),
        local_scales: calibrator.local_scales(),
        views: records.iter().map(|r| (r.name.clone(), r.candidate)).collect(),
        state,
    };
    let order = if params.measure_order && records.len() > 1 {
        let stream = Stream::new(params.seed, Purpose::new("shuffled view order"), 0);
        let shuffled = stream.permutation(records.len());
        let other = fuse_views(lift, records, &shuffled, calibrator, &global.operator, watch)?;
        Some(order_effect(&targets.state, &other, &targets.local_scales))
    } else {
        None
    };
    let mut views = Vec::with_capacity(records.len());
    for (record, &distance) in records.iter().zip(&global.distances) {
        let cells = record.local(calibrator, &global.operator)?;
        let square: f64 =
            cells.iter().flat_map(|c| (0..6).map(|k| math::powi(c[k] / targets.local_scales[k], 2))).sum();
        views.push(ViewReport {
            name: record.name.clone(),
            candidate: record.candidate,
            distance,
            local: (square / (6 * cells.len()) as f64).sqrt(),
        });
    }
    let report = TargetsReport {
        views,
        dispersion: global.dispersion,
        gaussians: lift.gaussians(),
        supported: (0..lift.gaussians()).filter(|&i| targets.state.supported(i)).count(),
        order,
        proposer,
        appearance,
        kept_water,
        calibrated: calibrator.corrects() != [false; 2],
    };
    Ok((targets, report))
}

/// Lifts and fuses the local operators of some views, in the given order of their records.
pub fn fuse_views(
    lift: &mut Lift<'_>,
    records: &[ViewRecord],
    order: &[usize],
    calibrator: &Calibrator,
    scene: &Affine,
    watch: &mut ProgressCallback<'_>,
) -> Result<LocalConsensus, AtcError> {
    let mut state = LocalConsensus::new(lift.gaussians());
    let scales = calibrator.local_scales();
    for (index, &which) in order.iter().enumerate() {
        report(watch, LoopPosition::Lift { index, views: order.len() })?;
        let record = &records[which];
        let cells = record.local(calibrator, scene)?;
        lift.run(&record.camera, record.grid, &cells)?;
        state.fuse(lift, &scales);
    }
    Ok(state)
}
