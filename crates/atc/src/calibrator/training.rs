//! Fits the two heads to a data set of pairs (R18).
//!
//! The fit is deterministic: initialisation and every sampled row are functions of (seed, purpose, step,
//! index), and all sums have a fixed order. So the same data and parameters give the same bits on any
//! number of threads.

use use3d_numerics::adam::Adam;
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};

use super::head::{Head, HeadBatch};
use super::mlp::{Mlp, Trace};
use super::stopping::Stop;
use super::{
    Calibrator, CalibratorParams, Dataset, GLOBAL_CONDITION, LOCAL_CONDITION, LastLayer, Provenance,
    RANGE_FLOOR, Scales, Statistics, push_local_condition,
};
use crate::error::AtcError;
use crate::extractor::Affine;
use crate::progress::{LoopPosition, ProgressCallback, report};

/// Fewest pairs to which a calibrator is fitted; fewer show nothing about the variation of transitions.
const FEWEST_PAIRS: usize = 2;
/// Largest number of cells that enter the statistics.
const STATISTICS_CELLS: usize = 100_000;

/// The data set as flat rows.
#[derive(Default)]
struct DatasetRows {
    /// `[pairs][30]`, raw.
    global_conditions: Vec<f32>,
    global_proposals: Vec<f32>,
    global_targets: Vec<f32>,
    /// `[cells][54]`, raw; the last 12 are the pair's true global operator.
    local_conditions: Vec<f32>,
    local_proposals: Vec<f32>,
    local_targets: Vec<f32>,
    confidence: Vec<f32>,
    /// Index of the pair of each cell.
    pair: Vec<usize>,
}

impl DatasetRows {
    fn new(dataset: &Dataset) -> Self {
        let cells: usize = dataset.examples.iter().map(|e| e.cells.len()).sum();
        let local_conditions = Vec::with_capacity(LOCAL_CONDITION * cells);
        let mut rows = Self { local_conditions, ..Self::default() };
        let extend = |to: &mut Vec<f32>, from: &[f64]| to.extend(from.iter().map(|&v| v as f32));
        for (index, example) in dataset.examples.iter().enumerate() {
            extend(&mut rows.global_conditions, &example.descriptor);
            extend(&mut rows.global_conditions, &example.proposal);
            extend(&mut rows.global_proposals, &example.proposal);
            extend(&mut rows.global_targets, &example.target);
            for cell in &example.cells {
                push_local_condition(
                    &mut rows.local_conditions,
                    &cell.descriptor,
                    &example.descriptor,
                    &example.proposal,
                    &cell.proposal,
                    &example.target,
                );
                extend(&mut rows.local_proposals, &cell.proposal);
                extend(&mut rows.local_targets, &cell.target);
                rows.confidence.push(cell.confidence as f32);
                rows.pair.push(index);
            }
        }
        rows
    }

    fn cells(&self) -> usize {
        self.pair.len()
    }
}

fn difference(a: &[f32], b: &[f32]) -> Vec<f32> {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

fn gather(rows: &[f32], columns: usize, indices: &[usize], out: &mut Vec<f32>) {
    out.clear();
    for &i in indices {
        out.extend_from_slice(&rows[i * columns..(i + 1) * columns]);
    }
}

/// Draws `count` of `available` rows with replacement for `step`; all rows if there are no more than
/// `count`.
fn draw(seed: u64, purpose: Purpose, step: u64, count: usize, available: usize) -> Vec<usize> {
    if available <= count {
        return (0..available).collect();
    }
    let stream = Stream::new(seed, purpose, step);
    (0..count).map(|i| stream.below(i as u64, available)).collect()
}

/// The optimiser's moments of one network's parameters.
struct Moments {
    first: Mlp,
    second: Mlp,
}

impl Moments {
    fn of(mlp: &Mlp) -> Self {
        let mut zeros = mlp.clone();
        clear(&mut zeros);
        Self { first: zeros.clone(), second: zeros }
    }

    fn update(&mut self, step: u64, rate: f64, mlp: &mut Mlp, gradients: &Mlp) {
        let moments = self.first.parameters_mut().zip(self.second.parameters_mut());
        for ((p, g), (m, v)) in mlp.parameters_mut().zip(gradients.parameters()).zip(moments) {
            Adam::CALIBRATOR.update(step, rate, p, g, m, v);
        }
    }
}

fn clear(gradients: &mut Mlp) {
    gradients.parameters_mut().for_each(|g| g.fill(0.0));
}

/// Scales both gradients so that their joint norm is at most `limit`.
fn clip(limit: f64, global: &mut Mlp, local: &mut Mlp) {
    let square = |m: &Mlp| -> f64 { m.parameters().flatten().map(|&g| math::powi(f64::from(g), 2)).sum() };
    let norm = (square(global) + square(local)).sqrt();
    if norm > limit {
        let scale = (limit / norm) as f32;
        for g in global.parameters_mut().chain(local.parameters_mut()).flatten() {
            *g *= scale;
        }
    }
}

/// Computes the statistics and the initial weights of both heads.
fn initial_heads(rows: &DatasetRows, params: &CalibratorParams) -> (Head, Head) {
    let seed = params.seed;
    let head = |[inputs, hidden, outputs]: [usize; 3], purpose, conditions: &[f32], residuals: &[f32]| Head {
        mlp: Mlp::random(inputs, hidden, outputs, seed, purpose),
        condition: Statistics::of(conditions, inputs, RANGE_FLOOR),
        residual: Statistics::of(residuals, outputs, params.scale_floor),
    };
    let sizes = [GLOBAL_CONDITION, params.global_hidden, 12];
    let residuals = difference(&rows.global_targets, &rows.global_proposals);
    let purpose = Purpose::new("calibrator global head");
    let mut global = head(sizes, purpose, &rows.global_conditions, &residuals);
    let purpose = Purpose::new("calibrator statistics");
    let sample = draw(seed, purpose, 0, STATISTICS_CELLS, rows.cells());
    let sampled = |rows: &[f32], columns: usize| {
        let mut out = Vec::new();
        gather(rows, columns, &sample, &mut out);
        out
    };
    let sizes = [LOCAL_CONDITION, params.local_hidden, 6];
    let residuals = sampled(&difference(&rows.local_targets, &rows.local_proposals), 6);
    let conditions = sampled(&rows.local_conditions, LOCAL_CONDITION);
    let mut local = head(sizes, Purpose::new("calibrator local head"), &conditions, &residuals);
    if params.scales == Scales::Operators {
        let floor = params.scale_floor;
        global.residual.range = Statistics::of(&rows.global_targets, 12, floor).range;
        local.residual.range = Statistics::of(&sampled(&rows.local_targets, 6), 6, floor).range;
    }
    if params.last_layer == LastLayer::Zero {
        // Both heads begin as the best constant, the median residual. With a few dozen pairs, the output of a
        // random last layer on other pairs is noise from which the fit may never recover.
        for head in [&mut global, &mut local] {
            let last = &mut head.mlp.layers[2];
            last.weight.fill(0.0);
            last.bias.fill(0.0);
        }
    }
    (global, local)
}

/// The rows of a data set; an error if there are too few to show the variation of transitions.
fn usable_rows(dataset: &Dataset) -> Result<DatasetRows, AtcError> {
    let pairs = dataset.examples.len();
    let rows = DatasetRows::new(dataset);
    if pairs < FEWEST_PAIRS || rows.cells() == 0 {
        return Err(AtcError::TooFewPairs {
            usable: pairs,
            offered: pairs + dataset.skipped.len(),
            needed: FEWEST_PAIRS,
            first_problem: dataset.skipped.first().map(|s| format!("{}: {}", s.name, s.reason)),
        });
    }
    Ok(rows)
}

/// The calibrator that returns every proposal unchanged, with the scales that a fit to this data set would
/// have. The scales depend only on the statistics of the pairs, so no step is taken.
pub(super) fn scales_only(dataset: &Dataset, params: &CalibratorParams) -> Result<Calibrator, AtcError> {
    let rows = usable_rows(dataset)?;
    let (global, local) = initial_heads(&rows, params);
    let mut calibrator = Calibrator::identity(dataset.extractor.clone(), dataset.proposer.clone());
    calibrator.global.residual.range = global.residual.range;
    calibrator.local.residual.range = local.residual.range;
    calibrator.provenance = provenance(dataset, &rows, params, 0);
    Ok(calibrator)
}

/// The provenance of a fit of some steps, without its loss and the origin of the pairs.
fn provenance(dataset: &Dataset, rows: &DatasetRows, params: &CalibratorParams, steps: u64) -> Provenance {
    Provenance {
        pairs: dataset.examples.len(),
        cells: rows.cells(),
        steps,
        seed: params.seed,
        tool: env!("CARGO_PKG_VERSION").to_string(),
        ..Provenance::default()
    }
}

/// Fits a calibrator to all pairs of a data set; nothing is held out. Each head is trained only up to its own
/// last step; `look` receives the calibrator after every step.
pub(super) fn fit_until(
    dataset: &Dataset,
    params: &CalibratorParams,
    stop: Stop,
    watch: &mut ProgressCallback<'_>,
    look: &mut dyn FnMut(u64, &Calibrator),
) -> Result<Calibrator, AtcError> {
    params.validate()?;
    let pairs = dataset.examples.len();
    let rows = usable_rows(dataset)?;
    let (global, local) = initial_heads(&rows, params);
    let mut conditions = rows.global_conditions.clone();
    global.condition.normalise(&mut conditions);
    let (mut global_moments, mut local_moments) = (Moments::of(&global.mlp), Moments::of(&local.mlp));
    let mut calibrator = Calibrator {
        extractor: dataset.extractor.clone(),
        proposer: dataset.proposer.clone(),
        global,
        local,
        provenance: provenance(dataset, &rows, params, params.steps.min(stop.last())),
    };
    let mut global_gradients = global_moments.first.clone();
    let mut local_gradients = local_moments.first.clone();
    let (mut global_trace, mut local_trace) = (Trace::default(), Trace::default());
    let (mut c, mut p, mut t, mut w) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for step in 1..=calibrator.provenance.steps {
        let Calibrator { global, local, .. } = &mut calibrator;
        clear(&mut global_gradients);
        clear(&mut local_gradients);

        // The global head's current prediction for every pair is a condition of the local head, without a
        // gradient.
        global.mlp.forward(&conditions, &mut global_trace);
        let predicted: Vec<Affine> = global_trace
            .output
            .as_chunks::<12>()
            .0
            .iter()
            .zip(&dataset.examples)
            .map(|(out, e)| std::array::from_fn(|k| e.proposal[k] + global.residual_of(k, out[k])))
            .collect();

        let batch = draw(params.seed, Purpose::new("calibrator pairs"), step, params.pairs_per_step, pairs);
        gather(&conditions, GLOBAL_CONDITION, &batch, &mut c);
        gather(&rows.global_proposals, 12, &batch, &mut p);
        gather(&rows.global_targets, 12, &batch, &mut t);
        let samples = HeadBatch { conditions: &c, proposals: &p, targets: &t, weights: None };
        let global_loss = global.loss(&samples, &mut global_trace, &mut global_gradients);

        let purpose = Purpose::new("calibrator cells");
        let batch = draw(params.seed, purpose, step, params.cells_per_step, rows.cells());
        gather(&rows.local_conditions, LOCAL_CONDITION, &batch, &mut c);
        for (row, &cell) in c.chunks_exact_mut(LOCAL_CONDITION).zip(&batch) {
            for (v, &g) in row[LOCAL_CONDITION - 12..].iter_mut().zip(&predicted[rows.pair[cell]]) {
                *v = g as f32;
            }
        }
        local.condition.normalise(&mut c);
        gather(&rows.local_proposals, 6, &batch, &mut p);
        gather(&rows.local_targets, 6, &batch, &mut t);
        gather(&rows.confidence, 1, &batch, &mut w);
        let samples = HeadBatch { conditions: &c, proposals: &p, targets: &t, weights: Some(&w) };
        let local_loss = local.loss(&samples, &mut local_trace, &mut local_gradients);

        let loss = global_loss + local_loss;
        if !loss.is_finite() {
            return Err(AtcError::Diverged { step, loss });
        }
        // A head that has stopped does not change and does not count in the joint norm.
        if step > stop.global {
            clear(&mut global_gradients);
        }
        if step > stop.local {
            clear(&mut local_gradients);
        }
        clip(params.gradient_limit, &mut global_gradients, &mut local_gradients);
        let rate = params.rate(step);
        if step <= stop.global {
            global_moments.update(step, rate, &mut global.mlp, &global_gradients);
        }
        if step <= stop.local {
            local_moments.update(step, rate, &mut local.mlp, &local_gradients);
        }
        calibrator.provenance.loss = loss;
        look(step, &calibrator);
        report(watch, LoopPosition::Step { step, steps: calibrator.provenance.steps, loss })?;
    }
    Ok(calibrator)
}
