//! Compares the reports of values that are not finite with those of the processor's engine.
//!
//! A compiler may assume that there are no such values, and remove the test for them. Then a training would
//! go on with NaN, and nothing else would notice it. So the check at the start feeds such values.

use use3d_reconstruct::engine::{CpuEngine, Engine, StepPlan, TrainingState};
use use3d_training::{Drain, EngineError};

use super::{Agreement, SceneSize};

/// The change of a step's state or plan that makes a value not finite.
type Spoil = fn(&mut TrainingState, &mut StepPlan);

/// The changes, with their names.
const SPOILT: [(&str, Spoil); 4] = [
    ("a moment that is NaN", |state, _| {
        if let Some(row) = state.moments.first.quaternions.last_mut() {
            row[2] = f32::NAN;
        }
    }),
    ("an infinite moment of a colour", |state, _| {
        if let Some(bands) = state.moments.first.sh.first_mut() {
            bands[1][2] = f32::INFINITY;
        }
    }),
    ("a moment of the water that is NaN", |state, _| {
        if let Some(last) = state.medium_moments[0].last_mut() {
            *last = f32::NAN;
        }
    }),
    ("an infinite loss", |_, plan| {
        if let Some(weight) = plan.weights.iter_mut().find(|weight| **weight != 0.0) {
            *weight = f64::INFINITY;
        }
    }),
];

/// Does one step for each kind of value that is not finite. It agrees if the step's report names the same
/// array and place as the processor's.
///
/// # Errors
/// The engine's error, other than that of a value that is not finite.
pub fn guards(engine: &mut dyn Engine, scene: &SceneSize) -> Result<Vec<Agreement>, EngineError> {
    let mut ours = CpuEngine::default();
    for view in scene.training_views()? {
        ours.upload(view.clone())?;
        engine.upload(view)?;
    }
    let mut all = Vec::new();
    for (what, spoil) in SPOILT {
        let reported = |engine: &mut dyn Engine| {
            let (mut state, mut plan) = (scene.state(), SceneSize::plan(0));
            spoil(&mut state, &mut plan);
            engine.load(state)?;
            engine.step(0, &plan)?;
            Ok::<_, EngineError>(engine.drain(Drain::All)?.first().and_then(|report| report.non_finite))
        };
        let (found, expected) = (reported(engine)?, reported(&mut ours)?);
        let missed = if found.is_some() && found == expected { 0.0 } else { 1.0 };
        all.push(Agreement::of_values(format!("the reports of {what}"), missed, 0.0, 0.0));
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_processor_reports_each_of_them() {
        let scene = SceneSize { width: 48, height: 32, gaussians: 150, views: 1, seed: 1 };
        let found = guards(&mut CpuEngine::default(), &scene).unwrap();
        assert!(found.len() == SPOILT.len() && found.iter().all(Agreement::holds), "{found:?}");
    }

    /// Without the test for values that are not finite, the check fails.
    #[test]
    fn an_engine_that_reports_nothing_fails() {
        struct Blind(CpuEngine);
        impl Engine for Blind {
            fn upload(&mut self, view: use3d_reconstruct::TrainingView) -> Result<usize, EngineError> {
                self.0.upload(view)
            }
            fn load(&mut self, state: TrainingState) -> Result<(), EngineError> {
                self.0.load(state)
            }
            fn save(&mut self) -> Result<std::borrow::Cow<'_, TrainingState>, EngineError> {
                self.0.save()
            }
            fn step(&mut self, view: usize, plan: &StepPlan) -> Result<(), EngineError> {
                self.0.step(view, plan)
            }
            fn drain(
                &mut self,
                which: Drain,
            ) -> Result<Vec<use3d_reconstruct::engine::StepReport>, EngineError> {
                let mut reports = self.0.drain(which)?;
                reports.iter_mut().for_each(|report| report.non_finite = None);
                Ok(reports)
            }
            fn survey(&mut self) -> Result<use3d_reconstruct::density::Survey, EngineError> {
                self.0.survey()
            }
            fn forget_statistics(&mut self) -> Result<(), EngineError> {
                self.0.forget_statistics()
            }
            fn rebuild(
                &mut self,
                rows: &[use3d_reconstruct::density::Origin],
                draws: &use3d_reconstruct::density::Draws,
            ) -> Result<(), EngineError> {
                self.0.rebuild(rows, draws)
            }
            fn limit_opacity(&mut self, ceiling: f64) -> Result<(), EngineError> {
                self.0.limit_opacity(ceiling)
            }
            fn forget_water_moments(&mut self) -> Result<(), EngineError> {
                self.0.forget_water_moments()
            }
            fn render(
                &mut self,
                camera: &use3d_capture::Camera,
                degrees: use3d_reconstruct::engine::Degrees,
                out: &mut use3d_capture::Image,
            ) -> Result<(), EngineError> {
                self.0.render(camera, degrees, out)
            }
        }
        let scene = SceneSize { width: 48, height: 32, gaussians: 150, views: 1, seed: 1 };
        let found = guards(&mut Blind(CpuEngine::default()), &scene).unwrap();
        assert!(found.iter().all(|agreement| !agreement.holds()), "{found:?}");
    }
}
