//! The local term, for the differences of the cells' operators from the scene's. With `Δ̃ = Δ -` its plain
//! mean over all cells, `Σ_p W_p mean_q φ((Δ̃_pq - Δ̄_pq)/s_q) / max(Σ_p W_p, 1e-6)`, `φ` the Smooth-L1;
//! the target is not centred again. Without support the loss is 0. In f64.

use use3d_atc::calibrator::SCALE_FLOOR;
use use3d_atc::extractor::{Transition, center};

use super::{LossTerm, Operators, Reads, Realised, smooth_l1};

/// Smallest divisor of the loss.
const SUPPORT_FLOOR: f64 = 1e-6;

/// The term's row of the table.
pub(super) const TERM: LossTerm = LossTerm {
    name: "local",
    title: "local",
    weight: |params| params.transition_weights().1,
    reads: Reads::Operators(term),
};

fn term(seen: &Operators<'_>, weight: f64, gradient: &mut Transition) -> Realised {
    let Operators { realised, target, goals } = seen;
    let (mut cells, mut d_cells) = (realised.local.clone(), Vec::new());
    let value =
        local_loss(&mut cells, &target.local, &target.weight, &goals.local_scales, weight, &mut d_cells);
    for (sum, cell) in gradient.local.iter_mut().zip(&d_cells) {
        sum.iter_mut().zip(cell).for_each(|(sum, g)| *sum += g);
    }
    value
}

/// Computes the local term. `cells` are the realised operators, not centred, and are centred in place;
/// `d_cells` receives `weight · ∂L/∂Δ` of the operators before centring. All three lists have one entry per
/// cell.
pub fn local_loss(
    cells: &mut [[f64; 6]],
    target: &[[f64; 6]],
    support: &[f64],
    scales: &[f64; 6],
    weight: f64,
    d_cells: &mut Vec<[f64; 6]>,
) -> Realised {
    center(cells);
    let total: f64 = support.iter().sum();
    let divisor = total.max(SUPPORT_FLOOR);
    let (mut loss, mut square) = (0.0, 0.0);
    d_cells.clear();
    d_cells.resize(cells.len(), [0.0; 6]);
    for (p, d) in d_cells.iter_mut().enumerate() {
        for q in 0..6 {
            let scale = scales[q].max(SCALE_FLOOR);
            let e = (cells[p][q] - target[p][q]) / scale;
            let (value, slope) = smooth_l1(e);
            loss += support[p] * value / 6.0;
            square += support[p] * e * e / 6.0;
            d[q] = weight * support[p] / divisor * slope / scale / 6.0;
        }
    }
    center(d_cells);
    Realised { loss: loss / divisor, error: (square / divisor).sqrt() }
}
