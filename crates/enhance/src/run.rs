//! The loop of stage 2.

use std::path::Path;

use serde::{Deserialize, Serialize};
use use3d_numerics::adam::Adam;
use use3d_numerics::random::Purpose;
use use3d_scene::Scene;
use use3d_training::guard::first_non_finite;
use use3d_training::{Checkpoints, NonFinite, Observer, Pace, Progress, Resumable, ViewOrder};
use use3d_ubaf::Enhancement;
use use3d_ubaf::water::ratios;

use crate::engine::{Engine, StepLosses};
use crate::fingerprint::fingerprint;
use crate::report::{LogEntry, Outcome, Report, ViewReport};
use crate::view::{EnhanceView, Guidance};
use crate::{EnhanceError, EnhanceParams, Start};

const VIEWS: Purpose = Purpose::new("stage 2 views");
/// What the names of this loop's checkpoints begin with.
const CHECKPOINT: &str = "enhance";

/// Everything that a later step depends on.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct State {
    fingerprint: [u8; 32],
    /// Steps done.
    step: u64,
    parameters: Vec<f32>,
    first_moment: Vec<f32>,
    second_moment: Vec<f32>,
    log: Vec<LogEntry>,
    /// Sums over the current window of the log.
    window: [f64; 7],
    windowed: u64,
    before: Vec<crate::ViewErrors>,
}

impl Resumable for State {
    fn fingerprint(&self) -> &[u8; 32] {
        &self.fingerprint
    }

    fn step(&self) -> u64 {
        self.step
    }
}

/// Learns the enhanced appearance of a reconstructed scene.
///
/// `views` are the training views, in the scene's frame. With a `checkpoint_dir`, the state is saved there every
/// `checkpoint_every` steps and when the observer asks to stop; a later call with the same inputs goes on from it with the same
/// bits as an uninterrupted run. The scene's Gaussians and medium come back untouched.
pub fn enhance(
    scene: &Scene,
    views: &[EnhanceView],
    guidance: Guidance<'_>,
    params: &EnhanceParams,
    checkpoint_dir: Option<&Path>,
    observer: &mut dyn Observer,
) -> Result<Outcome, EnhanceError> {
    let mut engine = Engine::new(scene, views, guidance, params, observer)?;
    let digest = fingerprint(scene, views, guidance, &engine.views, params)?;
    let checkpoints = checkpoint_dir.map(|dir| Checkpoints::new(dir, CHECKPOINT, &digest, params.iterations));
    let mut state = match resume(checkpoints.as_ref(), observer)? {
        Some(state) if state.parameters.len() == engine.field.parameters.len() => state,
        _ => State::new(digest, &mut engine, params)?,
    };
    engine.field.parameters.copy_from_slice(&state.parameters);

    let mut order = ViewOrder::new(params.seed, VIEWS, views.len());
    let mut gradient = vec![0.0f32; engine.field.parameters.len()];
    let mut display = Display::start();
    while state.step < params.iterations {
        let index = order.view(state.step);
        let losses = engine.step(index)?;
        let (step, name) = (state.step, &views[index].name);
        let wrong = |what: &str, at| NonFinite { step, view: name.clone(), what: what.into(), index: at };
        if !losses.total.is_finite() {
            return Err(wrong("loss", None).into());
        }
        engine.gradient().round_into(&mut gradient);
        if let Some(at) = first_non_finite(&gradient) {
            return Err(wrong("gradient", Some(at)).into());
        }
        state.update(&mut engine, &gradient, params);
        engine.end_step();
        if let Some(at) = first_non_finite(&engine.field.parameters) {
            return Err(wrong("parameter", Some(at)).into());
        }
        state.step += 1;
        state.record(&losses, params);
        observer.progress(&display.progress(
            state.step,
            losses.total,
            params.iterations,
            scene.gaussians.len(),
        ));

        let stop = observer.should_stop() && state.step < params.iterations;
        if let Some(checkpoints) = &checkpoints
            && (stop || state.step % params.checkpoint_every == 0 || state.step == params.iterations)
        {
            state.parameters.copy_from_slice(&engine.field.parameters);
            checkpoints.save(state.step, &state)?;
        }
        if stop {
            return Err(EnhanceError::Stopped { step: state.step });
        }
    }
    // Only here, after the last checkpoint: a longer run that goes on from it still collects for this line.
    if state.windowed > 0 {
        state.end_window();
    }
    finish(scene, views, guidance, &mut engine, state)
}

/// The furthest state that this run can go on from.
fn resume(
    checkpoints: Option<&Checkpoints>,
    observer: &mut dyn Observer,
) -> Result<Option<State>, EnhanceError> {
    let Some(checkpoints) = checkpoints else { return Ok(None) };
    let found = checkpoints.load::<State>()?;
    let going_on = found.state.as_ref().map(|state| format!("going on from step {}", state.step));
    for message in found.notices.into_iter().chain(going_on) {
        tracing::info!("{message}");
        observer.notice(&message);
    }
    Ok(found.state)
}

impl State {
    fn new(
        fingerprint: [u8; 32],
        engine: &mut Engine<'_>,
        params: &EnhanceParams,
    ) -> Result<Self, EnhanceError> {
        let n = engine.field.parameters.len();
        let before = (0..engine.views.len()).map(|v| engine.evaluate(v)).collect::<Result<_, _>>()?;
        if params.start == Start::Operator {
            engine.start_at_the_operator();
        }
        Ok(Self {
            fingerprint,
            step: 0,
            parameters: engine.field.parameters.clone(),
            first_moment: vec![0.0; n],
            second_moment: vec![0.0; n],
            log: Vec::new(),
            window: [0.0; 7],
            windowed: 0,
            before,
        })
    }

    /// Adam with a constant learning rate per group.
    fn update(&mut self, engine: &mut Engine<'_>, gradient: &[f32], params: &EnhanceParams) {
        let transport = engine.field.shape().transport();
        let groups =
            [(0..transport.start, params.learning_rate), (transport, params.transport_learning_rate)];
        for (range, rate) in groups {
            Adam::SPLATTING.update(
                self.step + 1,
                rate,
                &mut engine.field.parameters[range.clone()],
                &gradient[range.clone()],
                &mut self.first_moment[range.clone()],
                &mut self.second_moment[range],
            );
        }
    }

    fn record(&mut self, losses: &StepLosses, params: &EnhanceParams) {
        let values = [
            losses.total,
            losses.global.loss,
            losses.local.loss,
            losses.pixels,
            losses.variation,
            losses.global.error,
            losses.local.error,
        ];
        for (sum, v) in self.window.iter_mut().zip(values) {
            *sum += v;
        }
        self.windowed += 1;
        if self.step.is_multiple_of(params.log_every) {
            self.end_window();
        }
    }

    /// The log line of the steps since the last one.
    fn end_window(&mut self) {
        let [loss, global, local, pixels, variation, global_error, local_error] =
            self.window.map(|sum| sum / self.windowed as f64);
        self.log.push(LogEntry {
            step: self.step,
            loss,
            global,
            local,
            pixels,
            variation,
            global_error,
            local_error,
        });
        self.window = [0.0; 7];
        self.windowed = 0;
    }
}

fn finish(
    scene: &Scene,
    views: &[EnhanceView],
    guidance: Guidance<'_>,
    engine: &mut Engine<'_>,
    state: State,
) -> Result<Outcome, EnhanceError> {
    let mut reports = Vec::with_capacity(views.len());
    // Operators are measured as the extractor reads an image. Labels keep their sample: making them again would cost a proposal per
    // view, and before and after must be of the same pixels.
    let mut whole = match guidance {
        Guidance::Targets(_) => Some(engine.whole(guidance)),
        Guidance::Labels(_) => None,
    };
    for (index, view) in views.iter().enumerate() {
        let after = match &mut whole {
            Some(whole) => engine.evaluate_with(whole, index, view)?,
            None => engine.evaluate(index)?,
        };
        reports.push(ViewReport { name: view.name.clone(), before: state.before[index], after });
    }
    let centre = engine.centre();
    let mut scene_affine = engine.field.affine();
    for (r, row) in scene_affine.iter_mut().enumerate() {
        row[r] += 1.0;
    }
    let report = Report {
        views: reports,
        views_in_memory: engine.views_in_memory(),
        transport_ratios: ratios(&engine.field, 1.0),
        scene_affine,
        rendered_share: engine.rendered_share(),
    };
    let enhancement = Enhancement { field: engine.field.clone(), centre, appearance: engine.appearance() };
    let scene = Scene { enhancement: Some(enhancement), ..scene.clone() };
    Ok(Outcome { scene, log: state.log, report, profile: engine.profile().clone() })
}

/// Pace and smoothed loss for progress displays; not part of the result.
struct Display {
    pace: Pace,
    loss: Option<f64>,
}

impl Display {
    fn start() -> Self {
        Self { pace: Pace::start(), loss: None }
    }

    fn progress(&mut self, step: u64, loss: f64, steps: u64, gaussians: usize) -> Progress {
        let smooth = self.loss.map_or(loss, |old| 0.95 * old + 0.05 * loss);
        self.loss = Some(smooth);
        self.pace.step(1.0);
        Progress {
            step,
            steps,
            loss: Some(smooth),
            psnr: None,
            gaussians: Some(gaussians),
            steps_per_second: self.pace.steps_per_second(),
            seconds_left: self.pace.seconds_for((steps - step) as f64),
        }
    }
}
