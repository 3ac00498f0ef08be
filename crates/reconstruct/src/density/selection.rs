//! Selection by opacity after growth, with a pressure as in natural selection for Gaussians (Deng et al. 2025).
//!
//! Growth ends with more Gaussians than wanted. From then on a term of the opacity logits `v`
//!
//! ```text
//! L = w (mean v + 20)²,        ∂L/∂v_i = 2 w (mean v + 20) / N
//! ```
//!
//! competes every few steps with the gradients of the pictures. It pulls all logits down alike, and Adam
//! divides a Gaussian's gradients by their root mean square: the pressure hardly moves a Gaussian whose own
//! gradients are larger, and lowers others by whole steps. So those fade that the pictures miss least. The
//! gradient is added to the moments between two steps, as Adam would add it in a step without any other, so
//! every engine selects alike.

use use3d_numerics::adam::Adam;
use use3d_numerics::math;
use use3d_numerics::sums;

use crate::ReconstructParams;
use crate::engine::TrainingState;

/// The opacity below which Gaussians are removed during selection and after it.
pub(crate) const SURVIVES: f64 = 1e-3;
/// Minus the logit to which all are pulled.
const DEPTH: f64 = 20.0;

/// Adds the gradient of the pressure to the moments of the opacities.
pub(crate) fn press(state: &mut TrainingState, weight: f64) {
    let logits = &state.gaussians.opacity_logits;
    let n = logits.len().max(1) as f64;
    let mean = sums::sum(logits.len(), |i| f64::from(logits[i])) / n;
    let gradient = 2.0 * weight * (mean + DEPTH) / n;
    let Adam { beta1, beta2, .. } = Adam::SPLATTING;
    let add = [(1.0 - beta1) * gradient, (1.0 - beta2) * math::powi(gradient, 2)].map(|v| v as f32);
    state.moments.first.opacity_logits.iter_mut().for_each(|m| *m += add[0]);
    state.moments.second.opacity_logits.iter_mut().for_each(|v| *v += add[1]);
}

impl ReconstructParams {
    /// True if opacities are under selection at a step of a scene with this many Gaussians.
    pub(crate) fn selects(&self, step: u64, gaussians: usize) -> bool {
        let d = &self.densify;
        d.enabled
            && d.selection_weight > 0.0
            && (self.densify_end()..self.selection_end()).contains(&step)
            && gaussians > d.selection_budget
    }

    /// The step at which selection ends.
    pub(crate) fn selection_end(&self) -> u64 {
        (self.densify.selection_until * self.course() as f64).round() as u64
    }
}

#[cfg(test)]
mod tests {
    use use3d_medium::MediumModel;

    use super::*;
    use crate::Densify;
    use crate::engine::zeros;

    /// A state of Gaussians with these logits.
    fn state(logits: &[f32]) -> TrainingState {
        let mut gaussians = zeros(logits.len(), 0);
        gaussians.opacity_logits.copy_from_slice(logits);
        TrainingState::new(gaussians, MediumModel::None, &[])
    }

    #[test]
    fn the_pressure_is_the_gradient_of_its_term_as_adam_adds_it() {
        let (logits, weight) = ([2.0f32, -1.0, 0.5, 6.0], 3e-3);
        let term = |logits: [f32; 4]| {
            let mean = logits.iter().map(|v| f64::from(*v)).sum::<f64>() / 4.0;
            weight * (mean + 20.0) * (mean + 20.0)
        };
        let mut pressed = state(&logits);
        press(&mut pressed, weight);
        for i in 0..4 {
            let moved = |by: f32| {
                let mut logits = logits;
                logits[i] += by;
                term(logits)
            };
            let gradient = (moved(1e-2) - moved(-1e-2)) / 2e-2;
            let (mut p, mut m, mut v) = ([logits[i]], [0.0f32], [0.0f32]);
            Adam::SPLATTING.update(1, 0.1, &mut p, &[gradient as f32], &mut m, &mut v);
            let near = |a: f32, b: f32| (a - b).abs() < 1e-3 * b.abs();
            let moments = &pressed.moments;
            assert!(
                near(moments.first.opacity_logits[i], m[0]) && near(moments.second.opacity_logits[i], v[0])
            );
        }
        assert_eq!(pressed.gaussians.opacity_logits, logits);
    }

    #[test]
    fn those_fade_whose_own_gradients_are_weak() {
        let mut s = state(&[1.0, 1.0]);
        s.moments.second.opacity_logits = vec![1e-4, 1e-12];
        for step in 2000..2050 {
            press(&mut s, 2e-5);
            let (first, second) = (&mut s.moments.first.opacity_logits, &mut s.moments.second.opacity_logits);
            Adam::SPLATTING.update(step, 0.1, &mut s.gaussians.opacity_logits, &[0.0; 2], first, second);
        }
        let logits = s.gaussians.opacity_logits;
        assert!(logits[0] > 0.8 && logits[1] < -3.0, "{logits:?}");
    }

    #[test]
    fn selection_lasts_from_the_end_of_growth_to_its_own_or_until_enough_are_gone() {
        let densify =
            Densify { selection_weight: 1e-3, selection_budget: 500, until: 0.5, ..Densify::default() };
        let mut params = ReconstructParams { densify, ..ReconstructParams::default() };
        let selects = |step| params.selects(step, 501);
        assert_eq!([1499, 1500, 2309, 2310].map(selects), [false, true, true, false]);
        assert!(!params.selects(1500, 500));
        let at = |step| params.refine_settings(false, (step, 1.0), 200, 9000);
        assert_eq!((at(1500).cull_opacity, at(1500).floor, at(1500).keep_most), (SURVIVES, 500, usize::MAX));
        assert_eq!((at(2350).cull_opacity, at(2350).floor, at(2350).keep_most), (SURVIVES, 500, 500));
        params.densify.selection_weight = 0.0;
        assert!(!params.selects(1500, 501));
        assert_eq!(params.refine_settings(false, (1500, 1.0), 200, 9000).floor, 100);
    }
}
