//! The global term, for the scene's operator: the mean over its 12 parameters of `φ((t - t̄)/s_g)`, with
//! `φ` the Smooth-L1. In f64.

use use3d_atc::calibrator::SCALE_FLOOR;
use use3d_atc::extractor::{Affine, Transition};

use super::{LossTerm, Operators, Reads, Realised, smooth_l1};

/// The term's row of the table.
pub(super) const TERM: LossTerm = LossTerm {
    name: "global",
    title: "global",
    weight: |params| params.transition_weights().0,
    reads: Reads::Operators(term),
};

fn term(seen: &Operators<'_>, weight: f64, gradient: &mut Transition) -> Realised {
    let mut d_operator = [0.0; 12];
    let Operators { realised, goals, .. } = seen;
    let value = global_loss(&realised.global, &goals.operator, &goals.global_scales, weight, &mut d_operator);
    gradient.global.iter_mut().zip(d_operator).for_each(|(sum, g)| *sum += g);
    value
}

/// The global term; `d_operator` receives `weight · ∂L/∂t`.
pub fn global_loss(
    realised: &Affine,
    target: &Affine,
    scales: &[f64; 12],
    weight: f64,
    d_operator: &mut Affine,
) -> Realised {
    let (mut loss, mut square) = (0.0, 0.0);
    for q in 0..12 {
        let scale = scales[q].max(SCALE_FLOOR);
        let e = (realised[q] - target[q]) / scale;
        let (value, slope) = smooth_l1(e);
        loss += value;
        square += e * e;
        d_operator[q] = weight * slope / scale / 12.0;
    }
    Realised { loss: loss / 12.0, error: (square / 12.0).sqrt() }
}
