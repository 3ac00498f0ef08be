//! The loop of stage 2.

use std::path::Path;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use use3d_numerics::random::Purpose;
use use3d_scene::Scene;
use use3d_training::{
    Checkpoints, Drain, EngineError, NonFinite, Observer, Resumable, Session, SessionEnd, Snapshot, Steps,
    TrainingProgress, ViewOrder,
};
use use3d_ubaf::water::ratios;
use use3d_ubaf::{Enhancement, Field, OUTPUTS, ObjectPass};

use crate::engine::{Coverage, FieldEngine, FieldPlan, FieldState, Reading, check_inputs, initial_field};
use crate::fingerprint::fingerprint;
use crate::losses::Values;
use crate::report::{EnhanceOutcome, LogEntry, Report, ViewReport};
use crate::views::{EnhanceView, Guidance};
use crate::window::Window;
use crate::{EnhanceError, EnhanceParams, Start, ViewErrors};

const VIEWS: Purpose = Purpose::new("stage 2 views");
/// The prefix of the names of this loop's checkpoints.
const CHECKPOINT: &str = "enhance";

/// All data on which later steps depend.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct EnhanceState {
    fingerprint: [u8; 32],
    /// Steps done.
    step: u64,
    engine: FieldState,
    log: Vec<LogEntry>,
    window: Window,
    before: Vec<Values>,
}

impl Resumable for EnhanceState {
    fn fingerprint(&self) -> &[u8; 32] {
        &self.fingerprint
    }

    fn step(&self) -> u64 {
        self.step
    }
}

/// Learns the enhanced appearance of a reconstructed scene, with an engine that was made for this scene,
/// these views and this guidance.
///
/// `views` are the training views, in the scene's frame. With a `checkpoint_dir`, the state is saved there
/// every `checkpoint_every` steps and when the observer requests a stop. A later call with the same inputs
/// continues from it, with the same bits as an uninterrupted run. The scene's Gaussians and medium are
/// returned unchanged. If the guidance asks for no change, no step is done: the field stays the identity.
pub fn enhance(
    scene: &Scene,
    views: &[EnhanceView],
    guidance: Guidance<'_>,
    params: &EnhanceParams,
    engine: &mut dyn FieldEngine,
    checkpoint_dir: Option<&Path>,
    observer: &mut dyn Observer,
) -> Result<EnhanceOutcome, EnhanceError> {
    check_inputs(scene, views, guidance, params)?;
    let fingerprint = fingerprint(scene, views, guidance, params)?;
    let steps = if guidance.asks_for_no_change() { 0 } else { params.iterations };
    let session = Session {
        steps,
        checkpoints: checkpoint_dir.map(|dir| Checkpoints::new(dir, CHECKPOINT, &fingerprint, steps)),
        every_steps: params.checkpoint_every,
        every_minutes: f64::INFINITY,
    };
    let mut run = EnhanceRun {
        scene,
        views,
        guidance,
        params,
        order: ViewOrder::new(params.seed, VIEWS, views.len()),
        engine,
        fingerprint,
        step: 0,
        log: Vec::new(),
        window: Window::default(),
        before: Vec::new(),
        smooth_loss: None,
    };
    if !run.resume(&session, observer)? {
        run.begin()?;
    }
    if let SessionEnd::Stopped { step, saved } = session.run(run.step, &mut run, observer)? {
        return Err(EnhanceError::Interrupted { step, steps, saved });
    }
    run.finish()
}

/// A run between its first and last step.
struct EnhanceRun<'a> {
    scene: &'a Scene,
    views: &'a [EnhanceView],
    guidance: Guidance<'a>,
    params: &'a EnhanceParams,
    order: ViewOrder,
    engine: &'a mut dyn FieldEngine,
    fingerprint: [u8; 32],
    /// Steps done.
    step: u64,
    log: Vec<LogEntry>,
    window: Window,
    before: Vec<ViewErrors>,
    /// For the progress display; not part of the result.
    smooth_loss: Option<f64>,
}

impl EnhanceRun<'_> {
    /// The trained field in the form that a scene stores.
    fn enhancement(&self, field: Field, centre: [f32; OUTPUTS]) -> Enhancement {
        let (appearance, kept_water) = (self.guidance.appearance(), self.guidance.kept_water());
        Enhancement { field, centre, appearance, kept_water }
    }
}

impl Steps for EnhanceRun<'_> {
    type Error = EnhanceError;

    fn step(&mut self, step: u64, _observer: &mut dyn Observer) -> Result<(), EnhanceError> {
        let (rate, transport_rate) = (self.params.learning_rate, self.params.transport_learning_rate);
        self.engine.step(self.order.view(step), &FieldPlan { step, rate, transport_rate })?;
        self.drain(Drain::Ready)?;
        self.step = step + 1;
        if self.step.is_multiple_of(self.params.log_every) {
            self.end_window()?;
        }
        Ok(())
    }

    fn save(&mut self, done: u64, checkpoints: &Checkpoints) -> Result<(), EnhanceError> {
        // Never checkpoint a state that is not finite.
        self.drain(Drain::All)?;
        let state = EnhanceState {
            fingerprint: self.fingerprint,
            step: done,
            engine: self.engine.save()?,
            log: self.log.clone(),
            window: self.window.clone(),
            before: self.before.iter().map(|errors| errors.0).collect(),
        };
        Ok(checkpoints.save(done, &state)?)
    }

    /// The [`Scene`] with its enhancement so far. The centre is the mean over all Gaussians and not over
    /// those that define it, which the engine has: reading it from the engine would discard data that the
    /// engine holds for the next step.
    fn view(&mut self) -> Result<Option<Snapshot>, EnhanceError> {
        let mut field = initial_field(self.scene, self.guidance, self.params)?;
        let state = self.engine.save()?;
        state.check(field.parameters.len())?;
        field.parameters = state.parameters;
        let g = &self.scene.gaussians;
        let mut pass = ObjectPass::new(&field, &g.means, g.sh.iter().map(|sh| sh[0]));
        pass.forward(&field);
        let centre = pass.mean;
        let enhancement = self.enhancement(field, centre);
        Ok(Some(Arc::new(Scene { enhancement: Some(enhancement), ..self.scene.clone() })))
    }

    fn shown(&self) -> TrainingProgress {
        TrainingProgress {
            loss: self.smooth_loss,
            gaussians: Some(self.scene.gaussians.len()),
            ..TrainingProgress::default()
        }
    }
}

impl EnhanceRun<'_> {
    /// Resumes from the furthest state that belongs to this run, if there is one.
    fn resume(&mut self, session: &Session, observer: &mut dyn Observer) -> Result<bool, EnhanceError> {
        let Some(state) = session.furthest::<EnhanceState>(observer) else { return Ok(false) };
        match self.engine.load(state.engine) {
            Err(EngineError::State(why)) => {
                observer.notice(&format!(
                    "the checkpoint does not fit this scene ({why}); starting from the beginning"
                ));
                return Ok(false);
            }
            other => other?,
        }
        session.tell_resumed(state.step, observer);
        (self.step, self.log, self.window) = (state.step, state.log, state.window);
        self.before = state.before.into_iter().map(ViewErrors).collect();
        Ok(true)
    }

    /// Measures every view at the identity, then sets the start of the run.
    fn begin(&mut self) -> Result<(), EnhanceError> {
        let mut field = initial_field(self.scene, self.guidance, self.params)?;
        self.engine.load(FieldState::new(&field))?;
        let views = 0..self.views.len();
        self.before = views.map(|v| self.engine.evaluate(v, Reading::Sampled)).collect::<Result<_, _>>()?;
        let (lambda_global, _) = self.params.transition_weights();
        if let Guidance::Targets(targets) = self.guidance
            && self.params.start == Start::Operator
            && lambda_global > 0.0
        {
            let affine = field.shape().affine();
            field.parameters[affine].iter_mut().zip(targets.scene).for_each(|(p, t)| *p = t as f32);
            self.engine.load(FieldState::new(&field))?;
        }
        Ok(())
    }

    /// Reads the engine's reports of steps.
    fn drain(&mut self, which: Drain) -> Result<(), EnhanceError> {
        for report in self.engine.drain(which)? {
            if let Some((what, index)) = report.non_finite {
                let view = self.views.get(report.view).map(|view| view.name.clone()).unwrap_or_default();
                return Err(NonFinite { step: report.step, view, what: what.into(), index }.into());
            }
            self.window.add(&report.losses);
            let loss = report.losses.total;
            self.smooth_loss = Some(self.smooth_loss.map_or(loss, |old| 0.95 * old + 0.05 * loss));
        }
        Ok(())
    }

    /// Ends the window and adds its log line.
    fn end_window(&mut self) -> Result<(), EnhanceError> {
        self.drain(Drain::All)?;
        self.log.push(self.window.flush(self.step));
        Ok(())
    }

    /// Completes the run after the last step.
    fn finish(mut self) -> Result<EnhanceOutcome, EnhanceError> {
        // This happens only here, after the last checkpoint: a longer run that continues from it still
        // collects data for this line.
        self.drain(Drain::All)?;
        if self.window.steps > 0 {
            self.end_window()?;
        }
        // Operators are measured as the extractor reads an image.
        let mut reports = Vec::with_capacity(self.views.len());
        for (index, (view, before)) in self.views.iter().zip(&self.before).enumerate() {
            let after = self.engine.evaluate(index, Reading::Whole)?;
            reports.push(ViewReport { name: view.name.clone(), before: *before, after });
        }
        let centre = self.engine.centre()?;
        let mut field = initial_field(self.scene, self.guidance, self.params)?;
        let state = self.engine.save()?;
        state.check(field.parameters.len())?;
        field.parameters = state.parameters;
        let mut scene_affine = field.affine();
        for (r, row) in scene_affine.iter_mut().enumerate() {
            row[r] += 1.0;
        }
        let Coverage { views_in_memory, rendered_share } = self.engine.coverage();
        let transport_ratios = ratios(&field, 1.0);
        let report =
            Report { views: reports, views_in_memory, transport_ratios, scene_affine, rendered_share };
        let enhancement = self.enhancement(field, centre);
        let scene = Scene { enhancement: Some(enhancement), ..self.scene.clone() };
        Ok(EnhanceOutcome { scene, log: self.log, report, profile: self.engine.profile() })
    }
}
