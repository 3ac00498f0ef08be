//! Adam (Kingma & Ba, ICLR 2015) and its decoupled-weight-decay form AdamW, over flat slices.
//!
//! `m ← β₁ m + (1-β₁) g`, `v ← β₂ v + (1-β₂) g²`, `θ ← θ − lr (m / (1-β₁ᵗ)) / (√(v / (1-β₂ᵗ)) + ε)`, element
//! by element, f32 state; the bias corrections are computed in f64. Elements are independent, so any split
//! over threads gives the same bits.

use crate::math;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// The constants of one optimiser.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Adam {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the root of the second moment.
    pub epsilon: f64,
    /// Decoupled weight decay, per unit of learning rate (0: plain Adam).
    pub weight_decay: f64,
}

impl Adam {
    /// The method's setting for both stages: 0.9, 0.999, ε = 1e-15.
    pub const SPLATTING: Self = Self { beta1: 0.9, beta2: 0.999, epsilon: 1e-15, weight_decay: 0.0 };
    /// The calibrator's AdamW: ε = 1e-8, weight decay 1e-4 (R18).
    pub const CALIBRATOR: Self = Self { beta1: 0.9, beta2: 0.999, epsilon: 1e-8, weight_decay: 1e-4 };

    /// One update of `parameters` in place. `step` counts from 1. All slices have one length.
    pub fn update(
        &self,
        step: u64,
        learning_rate: f64,
        parameters: &mut [f32],
        gradient: &[f32],
        m: &mut [f32],
        v: &mut [f32],
    ) {
        let scalars = self.scalars(step, learning_rate);
        const CHUNK: usize = 1 << 14;
        let body = |p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32]| {
            for i in 0..p.len() {
                p[i] = scalars.apply(p[i], g[i], &mut m[i], &mut v[i]);
            }
        };
        if parameters.len() <= CHUNK {
            body(parameters, gradient, m, v);
        } else {
            parameters
                .par_chunks_mut(CHUNK)
                .zip(gradient.par_chunks(CHUNK))
                .zip(m.par_chunks_mut(CHUNK).zip(v.par_chunks_mut(CHUNK)))
                .for_each(|((p, g), (m, v))| body(p, g, m, v));
        }
    }

    /// The per-step scalars, for loops that fuse the update with something else.
    pub fn scalars(&self, step: u64, learning_rate: f64) -> AdamScalars {
        let exponent = i32::try_from(step).unwrap_or(i32::MAX);
        let (c1, c2) = (1.0 - math::powi(self.beta1, exponent), 1.0 - math::powi(self.beta2, exponent));
        AdamScalars {
            beta1: self.beta1 as f32,
            beta2: self.beta2 as f32,
            step_size: (learning_rate / c1) as f32,
            root: (1.0 / c2.sqrt()) as f32,
            epsilon: self.epsilon as f32,
            keep: (1.0 - learning_rate * self.weight_decay) as f32,
        }
    }
}

/// One step's constants in f32.
#[derive(Clone, Copy, Debug)]
pub struct AdamScalars {
    beta1: f32,
    beta2: f32,
    /// The learning rate over the first moment's correction, `lr / (1-β₁ᵗ)`, for code that does the update
    /// without [`AdamScalars::apply`].
    pub step_size: f32,
    /// One over the root of the second moment's correction, `1 / √(1-β₂ᵗ)`.
    pub root: f32,
    epsilon: f32,
    keep: f32,
}

impl AdamScalars {
    /// The updated parameter; moments are updated in place.
    #[inline(always)]
    pub fn apply(&self, parameter: f32, gradient: f32, m: &mut f32, v: &mut f32) -> f32 {
        *m = self.beta1 * *m + (1.0 - self.beta1) * gradient;
        *v = self.beta2 * *v + (1.0 - self.beta2) * gradient * gradient;
        self.keep * parameter - self.step_size * *m / (v.sqrt() * self.root + self.epsilon)
    }
}

/// Exponential (log-linear) decay from `first` to `last` over `steps`: `first^(1-t) last^t`,
/// `t = step / steps` clamped to 1.
pub fn exponential_decay(first: f64, last: f64, step: u64, steps: u64) -> f64 {
    let t = if steps == 0 { 1.0 } else { (step as f64 / steps as f64).min(1.0) };
    math::exp(math::ln(first) * (1.0 - t) + math::ln(last) * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A scalar f64 version of the formula.
    #[test]
    fn agrees_with_the_formula_in_f64() {
        let adam = Adam { weight_decay: 0.01, ..Adam::CALIBRATOR };
        let (mut p, mut m, mut v) = (vec![0.5f32], vec![0.0f32], vec![0.0f32]);
        let (mut rp, mut rm, mut rv) = (0.5f64, 0.0f64, 0.0f64);
        for step in 1..=50u64 {
            let g = math::cos(step as f64 * 0.3);
            adam.update(step, 0.01, &mut p, &[g as f32], &mut m, &mut v);
            rp *= 1.0 - 0.01 * adam.weight_decay;
            rm = 0.9 * rm + 0.1 * g;
            rv = 0.999 * rv + 0.001 * g * g;
            let (mh, vh) = (
                rm / (1.0 - math::powi(0.9f64, step as i32)),
                rv / (1.0 - math::powi(0.999f64, step as i32)),
            );
            rp -= 0.01 * mh / (vh.sqrt() + adam.epsilon);
        }
        assert!((f64::from(p[0]) - rp).abs() < 1e-5, "{} against {rp}", p[0]);
    }

    #[test]
    fn scalars_are_the_corrections_of_their_step() {
        for step in [1u64, 7, 15_000] {
            let scalars = Adam::SPLATTING.scalars(step, 2e-3);
            let (c1, c2) = (1.0 - math::powi(0.9f64, step as i32), 1.0 - math::powi(0.999f64, step as i32));
            assert_eq!((scalars.step_size, scalars.root), ((2e-3 / c1) as f32, (1.0 / c2.sqrt()) as f32));
        }
    }

    #[test]
    fn the_decay_meets_both_ends() {
        assert!((exponential_decay(1e-2, 1e-4, 0, 100) - 1e-2).abs() < 1e-15);
        assert!((exponential_decay(1e-2, 1e-4, 50, 100) - 1e-3).abs() < 1e-15);
        assert!((exponential_decay(1e-2, 1e-4, 200, 100) - 1e-4).abs() < 1e-15);
    }
}
