//! Compares a step of stage 2 on the device's engine with the processor's, from the same state.
//!
//! The views are compared with labels, pixel by pixel. The extractor, which transition targets need, is on
//! the processor in both engines, and amplifies the last digits of a render a hundredfold.

use std::error::Error;
use std::ops::Range;

use use3d_capture::Image;
use use3d_enhance::engine::{CpuFieldEngine, FieldEngine, FieldPlan, FieldState, initial_field};
use use3d_enhance::{EnhanceError, EnhanceParams, Guidance, LabelSource, Objective, PseudoLabels};
use use3d_numerics::math;
use use3d_scene::Scene;
use use3d_training::{Drain, EngineError, Silent};
use use3d_ubaf::Field;

use super::{Agreement, SceneSize, draws};
use crate::device::Gpu;
use crate::stage2::Stage2;

/// Seed of the field that steps begin with.
const FIELD: u64 = 5;

/// Labels that no enhancement of the scene can reach.
pub(crate) struct Waves {
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl LabelSource for Waves {
    fn label(&self, index: usize) -> Result<Image, Box<dyn Error + Send + Sync>> {
        let value = |i: usize| 0.5 + 0.4 * math::sin(0.1 * (i + index) as f64);
        let planes = (0..3 * self.width * self.height).map(|i| value(i) as f32).collect();
        Image::from_planes(self.width, self.height, planes).ok_or_else(|| "no pixels".into())
    }
}

/// Converts an error of stage 2 into one of the engine.
pub fn failed(error: EnhanceError) -> EngineError {
    match error {
        EnhanceError::Engine(error) => error,
        other => EngineError::Failed(Box::new(other)),
    }
}

/// A field far from the identity, so that every parameter has a gradient. Near the identity the features of
/// all Gaussians are alike, and little of a sum is left once the mean is removed, so both engines would
/// compare only rounding.
pub(crate) fn moved(
    scene: &Scene,
    guidance: Guidance<'_>,
    params: &EnhanceParams,
) -> Result<Field, EnhanceError> {
    let mut field = initial_field(scene, guidance, params)?;
    let stream = draws("a field for stage 2", FIELD);
    for (p, i) in field.parameters.iter_mut().zip(0..) {
        *p += 0.3 * stream.normal(i) as f32;
    }
    Ok(field)
}

/// The groups of a field's parameters, and their ranges.
pub(crate) fn groups(field: &Field) -> [(&'static str, Range<usize>); 8] {
    let shape = field.shape();
    [
        ("factors", shape.factors()),
        ("hidden weights", shape.hidden_weight()),
        ("hidden biases", shape.hidden_bias()),
        ("output weights", shape.output_weight()),
        ("output biases", shape.output_bias()),
        ("guide", shape.guide()),
        ("affine", shape.affine()),
        ("transport", shape.transport()),
    ]
}

/// Compares a step of every view of a packed scene: the loss, the gradients by groups of the field's
/// parameters, and the mean that is removed from its outputs.
///
/// # Errors
/// The device's driver failed.
pub fn field(gpu: &Gpu, scene: &SceneSize) -> Result<Vec<Agreement>, EngineError> {
    let SceneSize { width, height, .. } = *scene;
    let views = scene.enhance_views()?;
    let packed = scene.scene();
    let params = EnhanceParams {
        objective: Objective::PseudoLabels,
        sample_side: 0,
        seed: scene.seed,
        ..EnhanceParams::default()
    };
    let labels = PseudoLabels::new(&Waves { width, height }, &views, &params).map_err(failed)?;
    let guidance = Guidance::Labels(&labels);
    let mut field = moved(&packed, guidance, &params).map_err(failed)?;
    let mut ours = CpuFieldEngine::new(&packed, &views, guidance, &params, &mut Silent).map_err(failed)?;
    let mut device = Stage2::new(gpu, &packed, &views, guidance, &params, &mut Silent).map_err(failed)?;
    let groups = groups(&field);
    let mut all = Vec::new();
    for index in 0..views.len() {
        // The moments belong to this step only: the first ones are the gradient times a constant.
        let start = FieldState::new(&field);
        let plan = FieldPlan { step: index as u64, rate: 1e-3, transport_rate: 2e-4 };
        let mut losses = [0.0; 2];
        for (loss, engine) in losses.iter_mut().zip([&mut device as &mut dyn FieldEngine, &mut ours]) {
            engine.load(start.clone())?;
            engine.step(index, &plan)?;
            *loss = engine.drain(Drain::All)?.first().map_or(f64::NAN, |report| report.losses.total);
        }
        let [found, expected] = losses;
        all.push(Agreement::of_values("stage 2: loss", found, expected, 1e-4 * expected.abs()));
        let (found, expected) = (device.save()?, ours.save()?);
        for (what, range) in &groups {
            let what = format!("stage 2: gradients of {what}");
            all.push(Agreement::of(what, &found.first[range.clone()], &expected.first[range.clone()], 1e-4));
        }
        let centres = (device.centre()?, ours.centre()?);
        all.push(Agreement::of("stage 2: mean that is removed", &centres.0, &centres.1, 1e-4));
        field.parameters = expected.parameters;
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::software;

    #[test]
    fn a_step_of_stage_2_agrees_in_every_group() {
        let Some(gpu) = software() else { return };
        let scene = SceneSize { width: 48, height: 32, gaussians: 150, views: 2, seed: 1 };
        let found = field(&gpu, &scene).unwrap();
        assert_eq!(found.len(), 20);
        for agreement in &found {
            assert!(agreement.error <= 0.1 * agreement.bar, "{agreement:?}");
        }
    }
}
