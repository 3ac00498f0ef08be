//! Flat Gaussians: the scale term of 3D-UIR.
//!
//! ```text
//! L = mean over the Gaussians in view of their smallest standard deviation
//! ```

use use3d_numerics::math;

use super::{LossTerm, LossValue, Observation, Term, ViewGradients};

/// The row of the term.
pub(super) const TERM: LossTerm = LossTerm {
    values: &[LossValue { name: "smallest_scale", weight: |params, _| params.flatness_weight }],
    term: || Box::new(Flatness),
};

/// The term.
#[derive(Clone, Copy, Debug)]
pub(super) struct Flatness;

impl Term for Flatness {
    fn evaluate(
        &mut self,
        seen: &Observation<'_>,
        weights: &[f64],
        values: &mut [Option<f64>],
        gradients: &mut ViewGradients,
    ) {
        let scales = &seen.gaussians.log_scales;
        let d_scales = gradients.log_scales(scales.len());
        let each = weights[0] / seen.prepared.visible().len().max(1) as f64;
        let mut sum = 0.0;
        for i in seen.prepared.visible() {
            let [x, y, z] = scales[i];
            let axis = if x <= y && x <= z { 0 } else { 1 + usize::from(z < y) };
            let smallest = each * math::exp(f64::from(scales[i][axis]));
            sum += smallest;
            d_scales[i][axis] += smallest as f32;
        }
        values[0] = Some(sum / weights[0]);
    }
}
