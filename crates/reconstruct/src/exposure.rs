//! Cameras that expose and balance every view separately: a gain per view and channel, between the scene
//! and its photographs.
//!
//! ```text
//! Ĩ_v = e^{γ_v} ⊙ Î_v            Î_v the rendered view, Ĩ_v is compared with its photograph
//! ∂L/∂Î = e^{γ} ⊙ ∂L/∂Ĩ,         ∂L/∂γ_c = Σ_pixels Ĩ_c ∂L/∂Ĩ_c  +  λ γ_c
//! ```
//!
//! | symbol | meaning | shape |
//! |---|---|---|
//! | γ | log-gain of a training view; starts at 0 or at the value from the capture's tracks | views × 3 |
//! | λ | strength with which gains are drawn to one | 1 |
//!
//! Gains belong to photographs: renders, exports and later stages do not contain them. A gain that all
//! views share is a brightness of the scene, so the mean of γ over the views is kept at 0 per channel. A
//! gain in display range is a gain of linear light to the extent that display values follow a power law.
//! Gains are [parameters of single views](ViewParameters).

use serde::{Deserialize, Serialize};
use use3d_capture::Image;
use use3d_numerics::math;
use use3d_numerics::sums;

use crate::per_view::ViewParameters;

/// The settings by which gains are learnt in a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ExposureStep {
    /// Adam's rate of γ; 0 keeps the gains fixed.
    pub rate: f64,
    /// λ.
    pub weight: f64,
}

/// The log-gains of all training views; no rows if no view has a gain.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Exposures {
    /// γ, three numbers per view.
    pub log_gains: ViewParameters,
}

impl Exposures {
    /// Starts from these gains, which must be positive.
    pub fn new(gains: &[[f64; 3]]) -> Self {
        let logs = gains.as_flattened().iter().map(|v| math::ln(*v) as f32);
        let mut exposures = Self { log_gains: ViewParameters::new(3, logs.collect()) };
        exposures.center();
        exposures
    }

    /// `e^γ` of a view; 1 for a view without a gain.
    pub fn gain(&self, view: usize) -> [f32; 3] {
        self.log_gains.row(view).map_or([1.0; 3], |g| [g[0], g[1], g[2]].map(math::exp))
    }

    /// Gains of all views.
    pub fn gains(&self) -> Vec<[f32; 3]> {
        (0..self.log_gains.views()).map(|v| self.gain(v)).collect()
    }

    /// Makes one Adam step of a view's gains, from `∂L/∂γ` without its λ term.
    pub fn update(&mut self, view: usize, gradient: [f64; 3], step: &ExposureStep) {
        let Some(gains) = self.log_gains.row(view) else { return };
        let gradient: [f32; 3] =
            std::array::from_fn(|c| (gradient[c] + step.weight * f64::from(gains[c])) as f32);
        self.log_gains.update(view, step.rate, &gradient);
        self.center();
    }

    /// Removes the views' common gain.
    fn center(&mut self) {
        let n = self.log_gains.views().max(1) as f64;
        let rows = self.log_gains.values.as_chunks_mut::<3>().0;
        for c in 0..3 {
            let mean = (rows.iter().map(|g| f64::from(g[c])).sum::<f64>() / n) as f32;
            rows.iter_mut().for_each(|g| g[c] -= mean);
        }
    }
}

/// `Ĩ = gain ⊙ Î`.
pub(crate) fn expose(image: &Image, gain: [f32; 3], out: &mut Image) {
    out.resize(image.width(), image.height());
    for c in 0..3 {
        for (o, v) in out.plane_mut(c).iter_mut().zip(image.plane(c)) {
            *o = gain[c] * v;
        }
    }
}

/// Turns `∂L/∂Ĩ` into `∂L/∂Î` in place; returns `∂L/∂γ` without its λ term.
pub(crate) fn expose_backward(exposed: &Image, gain: [f32; 3], gradient: &mut Image) -> [f64; 3] {
    std::array::from_fn(|c| {
        let plane = exposed.plane(c);
        let g = gradient.plane_mut(c);
        let sum = sums::sum(plane.len(), |i| f64::from(plane[i]) * f64::from(g[i]));
        g.iter_mut().for_each(|v| *v *= gain[c]);
        sum
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(seed: u32) -> Image {
        let mut image = Image::new(7, 5);
        for (i, v) in image.data_mut().iter_mut().enumerate() {
            *v = 0.2 + 0.6 * (((i as u32 * 37 + seed * 11) % 29) as f32 / 29.0);
        }
        image
    }

    /// `½ Σ (e^γ Î − I)²`, and its gradient with respect to Ĩ.
    fn loss(rendered: &Image, gain: [f32; 3], target: &Image) -> (f64, Image, Image) {
        let mut exposed = Image::new(0, 0);
        expose(rendered, gain, &mut exposed);
        let mut gradient = exposed.clone();
        gradient.data_mut().iter_mut().zip(target.data()).for_each(|(g, t)| *g -= t);
        let sum = gradient.data().iter().map(|g| 0.5 * f64::from(*g) * f64::from(*g)).sum();
        (sum, exposed, gradient)
    }

    #[test]
    fn gradients_are_those_of_differences() {
        let (rendered, target) = (image(1), image(2));
        let logs = [0.2f32, -0.1, 0.05];
        let (_, exposed, mut gradient) = loss(&rendered, logs.map(math::exp), &target);
        let by_gain = expose_backward(&exposed, logs.map(math::exp), &mut gradient);
        let h = 4e-3f32;
        for c in 0..3 {
            let at = |d: f32| {
                let mut moved = logs;
                moved[c] += d;
                loss(&rendered, moved.map(math::exp), &target).0
            };
            let difference = (at(h) - at(-h)) / f64::from(2.0 * h);
            assert!(
                (by_gain[c] - difference).abs() < 5e-3 * difference.abs(),
                "{c}: {} {difference}",
                by_gain[c]
            );
        }
        for i in [0, 40, 100] {
            let at = |d: f32| {
                let mut moved = rendered.clone();
                moved.data_mut()[i] += d;
                loss(&moved, logs.map(math::exp), &target).0
            };
            let difference = (at(h) - at(-h)) / f64::from(2.0 * h);
            assert!((f64::from(gradient.data()[i]) - difference).abs() < 1e-3, "{i}");
        }
    }

    #[test]
    fn the_views_common_gain_is_the_scenes() {
        let mut exposures = Exposures::new(&[[2.0, 1.0, 0.5], [0.5, 1.0, 0.5], [1.0, 1.0, 0.5]]);
        let product = |e: &Exposures, c: usize| e.gains().iter().map(|g| g[c]).product::<f32>();
        for c in 0..3 {
            assert!((product(&exposures, c) - 1.0).abs() < 1e-5);
        }
        let step = ExposureStep { rate: 0.01, weight: 0.0 };
        let before = exposures.gain(0);
        exposures.update(0, [1.0, 0.0, -1.0], &step);
        let after = exposures.gain(0);
        assert!(after[0] < before[0] && after[2] > before[2]);
        assert!((product(&exposures, 2) - 1.0).abs() < 1e-5);
        assert_eq!(exposures.gain(9), [1.0; 3]);
    }

    #[test]
    fn without_evidence_gains_are_drawn_to_one() {
        let mut exposures = Exposures::new(&[[1.5; 3], [1.0 / 1.5; 3]]);
        let step = ExposureStep { rate: 0.01, weight: 0.1 };
        for _ in 0..200 {
            (0..2).for_each(|v| exposures.update(v, [0.0; 3], &step));
        }
        assert!(exposures.gains().as_flattened().iter().all(|g| (g - 1.0).abs() < 0.02), "{exposures:?}");
        assert!(exposures.log_gains.is_finite());
    }
}
