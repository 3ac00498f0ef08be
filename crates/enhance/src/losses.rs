//! The losses of stage 2 and their derivatives, with the reductions of the paper's supplementary.
//!
//! `φ(x) = ½x²` for `|x| < 1`, `|x| - ½` otherwise.
//! Global: mean over the 12 parameters of `φ((t - t̄)/s_g)`.
//! Local: with `Δ̃ = Δ -` its plain mean over all cells, `Σ_p W_p mean_q φ((Δ̃_pq - Δ̄_pq)/s_q) / max(Σ_p W_p, 1e-6)`; the target is
//! not centred again. Without support the local loss is 0. All in f64.

use serde::{Deserialize, Serialize};
use use3d_atc::extractor::{Affine, center};

/// Smallest divisor of the local loss.
const SUPPORT_FLOOR: f64 = 1e-6;
/// Smallest scale that errors are divided by.
const SCALE_FLOOR: f64 = 1e-4;

/// Smooth-L1 with β = 1: value and derivative.
#[inline]
pub fn smooth_l1(x: f64) -> (f64, f64) {
    if x.abs() < 1.0 { (0.5 * x * x, x) } else { (x.abs() - 0.5, x.signum()) }
}

/// A term's value and how far the realised operator is from the target, in units of the paired data's spread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Realised {
    /// The loss.
    pub loss: f64,
    /// Root mean square of the normalised errors (weighted by support for the local term).
    pub error: f64,
}

/// The global term; `cotangent` receives `weight · ∂L/∂t`.
pub fn global_loss(
    realised: &Affine,
    target: &Affine,
    scales: &[f64; 12],
    weight: f64,
    cotangent: &mut Affine,
) -> Realised {
    let (mut loss, mut square) = (0.0, 0.0);
    for q in 0..12 {
        let scale = scales[q].max(SCALE_FLOOR);
        let e = (realised[q] - target[q]) / scale;
        let (value, slope) = smooth_l1(e);
        loss += value;
        square += e * e;
        cotangent[q] = weight * slope / scale / 12.0;
    }
    Realised { loss: loss / 12.0, error: (square / 12.0).sqrt() }
}

/// The local term. `cells` are the realised operators, not centred, and are centred in place; `cotangent` receives `weight · ∂L/∂Δ` of
/// the operators before centring. All three lists have one entry per cell.
pub fn local_loss(
    cells: &mut [[f64; 6]],
    target: &[[f64; 6]],
    support: &[f64],
    scales: &[f64; 6],
    weight: f64,
    cotangent: &mut Vec<[f64; 6]>,
) -> Realised {
    center(cells);
    let total: f64 = support.iter().sum();
    let divisor = total.max(SUPPORT_FLOOR);
    let (mut loss, mut square) = (0.0, 0.0);
    cotangent.clear();
    cotangent.resize(cells.len(), [0.0; 6]);
    for (p, bar) in cotangent.iter_mut().enumerate() {
        for q in 0..6 {
            let scale = scales[q].max(SCALE_FLOOR);
            let e = (cells[p][q] - target[p][q]) / scale;
            let (value, slope) = smooth_l1(e);
            loss += support[p] * value / 6.0;
            square += support[p] * e * e / 6.0;
            bar[q] = weight * support[p] / divisor * slope / scale / 6.0;
        }
    }
    center(cotangent);
    Realised { loss: loss / divisor, error: (square / divisor).sqrt() }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use use3d_numerics::random::{Purpose, Stream};

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(20))]
        #[test]
        fn derivatives_are_differences(seed in 0u64..1 << 40, cells in 1usize..30) {
            let draw = Stream::new(seed, Purpose::new("objective"), 0);
            let n = |i: usize| draw.normal(i as u64);
            let t: Affine = std::array::from_fn(n);
            let target: Affine = std::array::from_fn(|i| n(100 + i));
            let scales: [f64; 12] = std::array::from_fn(|i| 0.2 + n(200 + i).abs());
            let mut bar = [0.0; 12];
            global_loss(&t, &target, &scales, 1.7, &mut bar);
            let h = 1e-6;
            for q in 0..12 {
                let at = |d: f64| {
                    let mut moved = t;
                    moved[q] += d;
                    1.7 * global_loss(&moved, &target, &scales, 1.7, &mut [0.0; 12]).loss
                };
                prop_assert!(((at(h) - at(-h)) / (2.0 * h) - bar[q]).abs() < 1e-5);
            }
            let rows = |at: usize| -> Vec<[f64; 6]> {
                (0..cells).map(|p| std::array::from_fn(|q| n(at + 6 * p + q))).collect()
            };
            let (delta, wanted) = (rows(1000), rows(2000));
            let support: Vec<f64> = (0..cells).map(|p| draw.uniform(5000 + p as u64)).collect();
            let scales: [f64; 6] = std::array::from_fn(|i| 0.2 + n(300 + i).abs());
            let mut bar = Vec::new();
            local_loss(&mut delta.clone(), &wanted, &support, &scales, 0.6, &mut bar);
            for p in 0..cells {
                for q in 0..6 {
                    let at = |d: f64| {
                        let mut moved = delta.clone();
                        moved[p][q] += d;
                        0.6 * local_loss(&mut moved, &wanted, &support, &scales, 0.6, &mut Vec::new()).loss
                    };
                    prop_assert!(((at(h) - at(-h)) / (2.0 * h) - bar[p][q]).abs() < 1e-5);
                }
            }
        }
    }

    #[test]
    fn nothing_seen_is_no_loss_and_no_gradient() {
        let mut bar = Vec::new();
        let mut cells = vec![[1.0; 6], [3.0; 6]];
        let r = local_loss(&mut cells, &[[9.0; 6]; 2], &[0.0; 2], &[1.0; 6], 1.0, &mut bar);
        assert_eq!((r.loss, r.error), (0.0, 0.0));
        assert!(bar.iter().flatten().all(|&b| b == 0.0));
    }
}
