//! Computes one global operator for the scene from one candidate per view.
//!
//! Candidates are compared by their effect and not by their coefficients. Each is applied to ten fixed
//! colours (black, three greys, the primaries, their complements). The 30 response numbers of the views
//! have a geometric median `Y_sc = argmin_Y Σ_v ‖Y − Y_v‖`, found by Weiszfeld's iteration from the
//! component-wise lower median (R20). A least-squares affine through probes and median response is the
//! scene operator. Every response is affine in the probes, and each iterate is a weighted mean of
//! responses, so that fit is exact: a change of coordinates.
//!
//! A geometric median breaks down only when half of the views do. All sums are in f64.

use serde::{Deserialize, Serialize};
use use3d_numerics::order::Ascending;

use crate::extractor::global::invert_positive_definite;
use crate::extractor::{Affine, affine_apply};

/// The probe colours, in their fixed order.
pub const PROBES: [[f64; 3]; 10] = [
    [0.0, 0.0, 0.0],
    [0.18, 0.18, 0.18],
    [0.5, 0.5, 0.5],
    [1.0, 1.0, 1.0],
    [1.0, 0.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [1.0, 1.0, 0.0],
    [1.0, 0.0, 1.0],
    [0.0, 1.0, 1.0],
];

/// Length of a response vector.
const RESPONSE: usize = 3 * PROBES.len();
/// Largest number of Weiszfeld updates.
const ITERATIONS: usize = 32;
/// Smallest distance used as a divisor: 64 units in the last place of 1 in f32.
const DISTANCE_FLOOR: f64 = 64.0 * f32::EPSILON as f64;
/// An update shorter than this ends the iteration.
const STOP: f64 = 1e-6;

/// The response of an operator to the probes, unclamped, probe by probe.
pub fn response(operator: &Affine) -> [f64; RESPONSE] {
    let mut out = [0.0; RESPONSE];
    for (probe, colour) in PROBES.iter().zip(out.as_chunks_mut::<3>().0) {
        *colour = affine_apply(operator, *probe);
    }
    out
}

fn distance(a: &[f64; RESPONSE], b: &[f64; RESPONSE]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (x - y) * (x - y)).sum::<f64>().sqrt()
}

/// The geometric median of one or more response vectors.
fn geometric_median(points: &[[f64; RESPONSE]]) -> [f64; RESPONSE] {
    let median = |k: usize| Ascending::of(points.iter().map(|p| p[k])).below(0.5).unwrap_or(0.0);
    let mut centre: [f64; RESPONSE] = std::array::from_fn(median);
    for _ in 0..ITERATIONS {
        let mut sum = [0.0; RESPONSE];
        let mut total = 0.0;
        for point in points {
            let weight = 1.0 / distance(point, &centre).max(DISTANCE_FLOOR);
            total += weight;
            for (s, v) in sum.iter_mut().zip(point) {
                *s += weight * v;
            }
        }
        let next = sum.map(|s| s / total);
        let moved = distance(&next, &centre);
        centre = next;
        if moved <= STOP {
            break;
        }
    }
    centre
}

/// The operator whose responses are nearest to `response` in the least-squares sense.
pub fn refit(response: &[f64; RESPONSE]) -> Affine {
    let mut normal = [[0.0; 4]; 4];
    let mut right = [[0.0; 4]; 3];
    for (probe, colour) in PROBES.iter().zip(response.as_chunks::<3>().0) {
        let feature = [probe[0], probe[1], probe[2], 1.0];
        for i in 0..4 {
            for j in 0..4 {
                normal[i][j] += feature[i] * feature[j];
            }
            for c in 0..3 {
                right[c][i] += feature[i] * (colour[c] - probe[c]);
            }
        }
    }
    // The probes span the colours, so the normal matrix is a constant that is far from singular.
    let inverse = invert_positive_definite(&normal).unwrap_or_default();
    std::array::from_fn(|k| (0..4).map(|j| inverse[k % 4][j] * right[k / 4][j]).sum())
}

/// The scene's global operator, and the distances of the views from it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GlobalConsensus {
    /// The scene operator minus the identity.
    pub operator: Affine,
    /// For each view, the distance of its responses from the consensus, a norm over 30 display values.
    pub distances: Vec<f64>,
    /// The (lower) median of the distances.
    pub dispersion: f64,
}

/// The consensus of one candidate per view; `None` without views.
pub fn global_consensus(candidates: &[Affine]) -> Option<GlobalConsensus> {
    if candidates.is_empty() {
        return None;
    }
    let responses: Vec<[f64; RESPONSE]> = candidates.iter().map(response).collect();
    let median = geometric_median(&responses);
    let distances: Vec<f64> = responses.iter().map(|r| distance(r, &median)).collect();
    let dispersion = Ascending::of(distances.iter().copied()).below(0.5)?;
    Some(GlobalConsensus { operator: refit(&median), distances, dispersion })
}
