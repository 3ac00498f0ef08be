//! The loop of stage 1, which decides the order of the work. The engine does the work.

use std::borrow::Cow;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use glam::DVec3;
use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, Capture, Frame, Image};
use use3d_medium::MediumModel;
use use3d_metrics::{Score, fitted_on_other_half, mask_of, psnr, share, ssim};
use use3d_numerics::random::Purpose;
use use3d_numerics::range::OutOfRange;
use use3d_scene::Scene;
use use3d_training::{
    Checkpoints, Drain, EngineError, NonFinite, Observer, Profile, Resumable, Session, SessionEnd, Snapshot,
    Steps, TrainingProgress, ViewOrder,
};

use crate::bounds::most_gaussians;
use crate::colors::ColorState;
use crate::completion::Holes;
use crate::density::{self, Draws, GrowthViews, Refinement};
use crate::engine::{Degrees, Engine, Moments, Statistics, StepPlan, StepReport, TrainingState};
use crate::fingerprint::fingerprint;
use crate::hidden::Masks;
use crate::load::load;
use crate::phases::Phase;
use crate::profile::{StepPart, Stretch};
use crate::report::{Evaluation, FittedScore, LogEntry, ViewScore};
use crate::turns::Update;
use crate::views::{TrainingView, ViewLoader};
use crate::window::Window;
use crate::{
    DepthPrior, Exposure, ExposureStep, FoundWater, Known, ReconstructError, ReconstructParams, Strategy,
    initialise, losses, unknown,
};

/// The prefix of the names of this loop's checkpoints.
const CHECKPOINT: &str = "reconstruct";

/// Largest number of stretches of a run whose step times are reported separately.
const STRETCHES: u64 = 15;

/// The result of stage 1.
#[derive(Clone, Debug)]
pub struct ReconstructOutcome {
    /// The scene.
    pub scene: Scene,
    /// The training log.
    pub log: Vec<LogEntry>,
    /// Held-out scores; `None` if no view is held out.
    pub evaluation: Option<Evaluation>,
    /// Gain per channel of every training view, by name; empty if all have the same exposure.
    pub exposures: Vec<(String, [f32; 3])>,
    /// Number of Gaussians at the start.
    pub initial_gaussians: usize,
    /// Time per part of a step in this process, if the engine measures it.
    pub profile: Profile<StepPart>,
    /// The growth of a step with the scene, over the course of the run.
    pub growth: Vec<Stretch>,
    /// Approximate bytes of parameters, moments, views and buffers at the end; 0 if the engine does not
    /// report it.
    pub memory: usize,
}

impl ReconstructOutcome {
    /// The training log, one JSON object per line.
    pub fn log_lines(&self) -> String {
        self.log.iter().map(|entry| entry.to_json() + "\n").collect()
    }
}

/// Everything a checkpoint holds.
#[derive(Serialize, Deserialize)]
pub(crate) struct RunState<'a> {
    fingerprint: [u8; 32],
    /// Updates done.
    pub(crate) step: u64,
    initial: usize,
    pub(crate) engine: Cow<'a, TrainingState>,
    pub(crate) log: Cow<'a, [LogEntry]>,
    window: Window,
}

impl Resumable for RunState<'_> {
    fn fingerprint(&self) -> &[u8; 32] {
        &self.fingerprint
    }

    fn step(&self) -> u64 {
        self.step
    }
}

/// Reconstructs an underwater scene from a capture with an engine that has no views yet.
///
/// The water starts from known water, is held for `medium_hold` of the run, and is then learnt at
/// `medium_release` of its rates. Gains start from known gains.
///
/// Views are loaded once, through `loader`, at the size of their cameras. With a `checkpoint_dir` the run
/// writes checkpoints there and continues from the furthest one that belongs to the same capture and
/// parameters, even if a run of another length wrote it; the result is the same to the last bit.
/// Checkpoints of other runs in the folder are not touched. The last checkpoint stays there after the run;
/// the caller stores the outcome and then removes the folder.
pub fn reconstruct(
    capture: &Capture,
    known: &Known,
    loader: &ViewLoader<'_>,
    params: &ReconstructParams,
    engine: &mut dyn Engine,
    checkpoint_dir: Option<&Path>,
    observer: &mut dyn Observer,
) -> Result<ReconstructOutcome, ReconstructError> {
    params.validate().map_err(ReconstructError::Parameter)?;
    capture.validate()?;
    if let [only] = capture.split.train[..] {
        return Err(ReconstructError::OneView { view: capture.views[only].name.to_string() });
    }
    let sizes = capture.training_views().map(|view| &view.camera.intrinsics);
    let pixels: usize = sizes.map(|k| k.width * k.height).sum();
    let params = &params.sized(pixels as f64 / capture.split.train.len().max(1) as f64);
    let most = most_gaussians(capture, params);
    let start = known.water.as_ref().and_then(|found| Some((found, found.model(params)?)));
    let found = start.as_ref().map(|(found, _)| *found);
    let views = load(capture, loader, params, observer)?;
    let gaussians = initialise::gaussians(capture, found, params, most, |message| observer.notice(message))?;
    let initial = gaussians.len();
    let cameras: Vec<_> = views.train.iter().map(|v| v.camera).collect();
    let water = match start {
        Some((_, model)) => model,
        None => MediumModel::start(params.medium, &params.medium_start(&cameras)).map_err(|wrong| {
            ReconstructError::Parameter(OutOfRange::new("medium", params.medium.name(), wrong.to_string()))
        })?,
    };
    let masks = if params.hidden_below > 0.0 { Masks::new(&views.train) } else { Masks::default() };
    let completes = params.complete_at > 0 && params.depth_prior != DepthPrior::Off;
    let holes = if completes { Holes::new(&views.train) } else { Holes::default() };
    let growth_views = GrowthViews::new(&views.train, &params.densify);
    let exposes = params.exposure == Exposure::PerView;
    let gain = |view: &usize| known.gains.get(*view).copied().unwrap_or([1.0; 3]);
    let gains: Vec<[f64; 3]> = capture.split.train.iter().map(gain).collect();
    let gains_used = exposes.then_some(&gains);
    let fingerprint = fingerprint(capture, found, gains_used, params, &views);
    let names: Vec<String> = views.train.iter().map(|v| v.name.clone()).collect();
    for (index, view) in views.train.into_iter().enumerate() {
        if engine.upload(view)? != index {
            return Err(ReconstructError::EngineInUse);
        }
    }
    let mut state = TrainingState::new(gaussians, water, if exposes { &gains } else { &[] });
    state.colors = ColorState::new(params.color_field, names.len(), params.seed);
    engine.load(state)?;
    let mut run = ReconstructRun {
        params,
        frame: capture.frame,
        phases: params.phases(found.is_some()),
        least_water_degree: found.map_or(0, |_| FoundWater::DEGREE.min(params.sh_degree)),
        order: ViewOrder::new(params.seed, Purpose::new("training views"), names.len()),
        names,
        held_out: views.test,
        engine,
        fingerprint,
        initial,
        gaussians: initial,
        first: 0,
        step: 0,
        log: Vec::new(),
        window: Window::default(),
        most,
        masks,
        holes,
        growth_views,
        unit: if params.densify.strategy == Strategy::Signed { extent(&cameras) } else { 1.0 },
        cameras,
        cap_reported: false,
        growth: Vec::new(),
    };
    let session = Session {
        steps: params.updates(),
        checkpoints: checkpoint_dir
            .map(|dir| Checkpoints::new(dir, CHECKPOINT, &fingerprint, params.updates())),
        every_steps: params.checkpoint_steps,
        every_minutes: params.checkpoint_minutes,
    };
    let done = run.resume(&session, observer)?;
    if let SessionEnd::Stopped { step, saved } = session.run(done, &mut run, observer)? {
        return Err(ReconstructError::Interrupted { step, steps: params.updates(), saved });
    }
    run.finish(capture, observer)
}

/// The extent of cameras: 1.1 times the largest distance of one from their mean, scene units.
fn extent(cameras: &[Camera]) -> f64 {
    let centres: Vec<_> = cameras.iter().map(|camera| camera.pose.center()).collect();
    let mean = centres.iter().copied().sum::<DVec3>() / centres.len().max(1) as f64;
    1.1 * centres.iter().map(|centre| centre.distance(mean)).fold(0.0, f64::max)
}

/// A run between its first and last step.
struct ReconstructRun<'a> {
    params: &'a ReconstructParams,
    /// The frame of the capture and of the scene.
    frame: Frame,
    /// From which share of the run on which groups of parameters move.
    phases: Vec<Phase>,
    /// Smallest active degree of the water.
    least_water_degree: usize,
    order: ViewOrder,
    names: Vec<String>,
    held_out: Vec<TrainingView>,
    engine: &'a mut dyn Engine,
    fingerprint: [u8; 32],
    initial: usize,
    /// Current number of Gaussians.
    gaussians: usize,
    /// The step at which this process began.
    first: u64,
    /// Steps done.
    step: u64,
    log: Vec<LogEntry>,
    window: Window,
    most: usize,
    /// The masks that hide Gaussians.
    masks: Masks,
    /// The views in which holes are looked for.
    holes: Holes,
    /// The views at which growth looks.
    growth_views: GrowthViews,
    /// The cameras of the training views.
    cameras: Vec<Camera>,
    /// The length in which density control and the rate of centres count, scene units.
    unit: f64,
    cap_reported: bool,
    growth: Vec<Stretch>,
}

impl Steps for ReconstructRun<'_> {
    type Error = ReconstructError;

    fn step(&mut self, number: u64, observer: &mut dyn Observer) -> Result<(), ReconstructError> {
        let params = self.params;
        let update = params.update(number);
        let view = self.order.view(number);
        if update.begins_water {
            self.engine.forget_water_moments()?;
        }
        if !update.ends_step {
            // The log has the step's own update alone.
            self.drain(Drain::All)?;
            self.engine.step(view, &self.plan(&update))?;
            return self.check(Drain::All).map(|_| ());
        }
        self.engine.step(view, &self.plan(&update))?;
        self.drain(Drain::Ready)?;
        let done = update.step + 1;
        if done.is_multiple_of(params.iterations.div_ceil(STRETCHES)) || done == params.iterations {
            self.look_at_pace(view)?;
        }
        // Refinements use the state after the step's update.
        self.control_density(observer)?;
        self.step = done;
        if done.is_multiple_of(params.log_every) {
            self.end_window()?;
        }
        let due = params.evaluate_every > 0 && done.is_multiple_of(params.evaluate_every);
        if due && done < params.iterations {
            self.evaluate()?;
        }
        Ok(())
    }

    fn save(&mut self, done: u64, checkpoints: &Checkpoints) -> Result<(), ReconstructError> {
        // Never checkpoint a state that is not finite.
        self.drain(Drain::All)?;
        let state = RunState {
            fingerprint: self.fingerprint,
            step: done,
            initial: self.initial,
            engine: self.engine.save()?,
            log: (&self.log).into(),
            window: self.window.clone(),
        };
        Ok(checkpoints.save(done, &state)?)
    }

    fn work(&self, steps: Range<u64>) -> f64 {
        steps.map(|number| self.params.update_work(number)).sum()
    }

    /// The [`Scene`] as if this were the last step.
    fn view(&mut self) -> Result<Option<Snapshot>, ReconstructError> {
        let medium_degree = self.degrees(self.step.saturating_sub(1)).water;
        let state = self.engine.save()?;
        let (mut gaussians, medium) = (state.gaussians.clone(), state.medium.clone());
        state.colors.settle(&mut gaussians);
        let scene = Scene { gaussians, frame: self.frame, medium, medium_degree, enhancement: None };
        Ok(Some(Arc::new(scene)))
    }

    fn shown(&self) -> TrainingProgress {
        let evaluated = |entry: &LogEntry| match entry {
            LogEntry::Evaluation { psnr, .. } => *psnr,
            _ => None,
        };
        TrainingProgress {
            loss: self.window.smooth_loss,
            psnr: self.window.smooth_psnr,
            held_out_psnr: self.log.iter().rev().find_map(evaluated),
            gaussians: Some(self.gaussians),
            ..TrainingProgress::default()
        }
    }
}

impl ReconstructRun<'_> {
    /// Resumes from the checkpoint, if there is one of this run. Returns the number of updates done.
    fn resume(&mut self, session: &Session, observer: &mut dyn Observer) -> Result<u64, ReconstructError> {
        let Some(state) = session.furthest::<RunState<'_>>(observer) else { return Ok(0) };
        let gaussians = state.engine.gaussians.len();
        match self.engine.load(state.engine.into_owned()) {
            Err(EngineError::State(why)) => {
                observer.notice(&format!(
                    "the checkpoint does not fit this scene ({why}); starting from the beginning"
                ));
                return Ok(0);
            }
            other => other?,
        }
        session.tell_resumed(state.step, observer);
        let Update { step, .. } = self.params.update(state.step);
        (self.first, self.step) = (step, step);
        (self.initial, self.gaussians) = (state.initial, gaussians);
        self.log = state.log.into_owned();
        self.window = state.window;
        // A run that ended at this step was evaluated after its last checkpoint; a run that continues needs
        // that line in its log.
        let due = self.params.evaluate_every > 0 && self.step.is_multiple_of(self.params.evaluate_every);
        let measured =
            matches!(self.log.last(), Some(LogEntry::Evaluation { step, .. }) if *step == self.step);
        if due && !measured && self.step < self.params.iterations {
            self.evaluate()?;
        }
        Ok(state.step)
    }

    /// Completes the run after the last step.
    fn finish(
        mut self,
        capture: &Capture,
        observer: &mut dyn Observer,
    ) -> Result<ReconstructOutcome, ReconstructError> {
        // This happens only here, after the last checkpoint: a longer run that continues from it still
        // collects data for this line.
        self.drain(Drain::All)?;
        self.remove_hidden(observer)?;
        self.fade_unknown()?;
        if self.window.steps > 0 {
            self.end_window()?;
        }
        let evaluation = self.evaluate()?;
        let medium_degree = self.degrees(self.step.saturating_sub(1)).water;
        let (profile, memory) = (self.engine.profile(), self.engine.memory());
        let state = self.engine.save()?;
        let exposures = self.names.into_iter().zip(state.exposures.gains()).collect();
        // A borrowed state belongs to the engine, and an owned one to this run; only the scene is copied.
        let (mut gaussians, medium, colors) = match state {
            Cow::Borrowed(state) => (state.gaussians.clone(), state.medium.clone(), &state.colors),
            Cow::Owned(state) => (state.gaussians, state.medium, &ColorState::default()),
        };
        colors.settle(&mut gaussians);
        let scene = Scene { gaussians, frame: capture.frame, medium, medium_degree, enhancement: None };
        let (log, growth, initial_gaussians) = (self.log, self.growth, self.initial);
        Ok(ReconstructOutcome {
            scene,
            log,
            evaluation,
            exposures,
            initial_gaussians,
            profile,
            growth,
            memory,
        })
    }

    /// Reads the engine's reports of steps into the window of the log.
    fn drain(&mut self, which: Drain) -> Result<(), ReconstructError> {
        let reports = self.check(which)?;
        reports.iter().for_each(|report| self.window.add(report));
        Ok(())
    }

    /// Reads the engine's reports, none of which may have a number that is not finite.
    fn check(&mut self, which: Drain) -> Result<Vec<StepReport>, ReconstructError> {
        let reports = self.engine.drain(which)?;
        for report in &reports {
            if let Some((what, index)) = report.non_finite {
                let view = self.names.get(report.view).cloned().unwrap_or_default();
                return Err(NonFinite { step: report.step, view, what: what.into(), index }.into());
            }
        }
        Ok(reports)
    }

    /// The active degrees in a step.
    fn degrees(&self, step: u64) -> Degrees {
        let colors = self.params.active_degree(step);
        let water = match self.params.has_turns() {
            true if !self.params.has_water(step) => 0,
            true => 3,
            false => colors.max(self.least_water_degree),
        };
        Degrees { colors, water }
    }

    /// Ends the window and adds its log line.
    fn end_window(&mut self) -> Result<(), ReconstructError> {
        self.drain(Drain::All)?;
        let last = self.step.saturating_sub(1);
        let (divisor, degree) = (self.params.divisor(last), self.params.active_degree(last));
        let entry = self.window.flush(self.step, self.gaussians, divisor, degree);
        self.log.push(entry);
        Ok(())
    }

    /// The plan of an update.
    fn plan(&self, update: &Update) -> StepPlan {
        let Update { step, moves, ends_step, water_updates, .. } = *update;
        let params = self.params;
        let (mut rates, gain_rate) = params.rates(&self.phases, step);
        rates.means *= self.unit;
        StepPlan {
            step,
            moves,
            water_updates,
            divisor: params.divisor(step),
            degrees: self.degrees(step),
            rates,
            weights: losses::weights(params, step),
            depth_gradient: params.depth_gradient,
            network_clip: params.network_clip,
            exposure: (params.exposure == Exposure::PerView)
                .then_some(ExposureStep { rate: gain_rate, weight: params.exposure_weight }),
            colors: params.color_step(step),
            gather: (params.densify.enabled
                && ends_step
                && step >= params.densify.statistics_from.min(params.warm_up())
                && step < params.densify_end())
            .then(|| params.densify.gradient_scale()),
        }
    }

    /// Ends a stretch of the run at this step.
    fn look_at_pace(&mut self, view: usize) -> Result<(), ReconstructError> {
        let (divisor, degree) = (self.params.divisor(self.step), self.params.active_degree(self.step));
        let reported: u64 = self.growth.iter().map(|s| s.steps).sum();
        let before: Duration = self.growth.iter().map(|s| s.spent).sum();
        let pairs = self.engine.contributing_pairs(view, divisor, degree)?;
        self.growth.push(Stretch {
            step: self.step + 1,
            steps: self.step + 1 - self.first - reported,
            divisor,
            gaussians: self.gaussians,
            pairs: 1e-6 * pairs.unwrap_or(0.0),
            spent: self.engine.profile().spent().saturating_sub(before),
        });
        Ok(())
    }

    /// Runs the refinement or the opacity ceiling that is due after this step (R9).
    fn control_density(&mut self, observer: &mut dyn Observer) -> Result<(), ReconstructError> {
        let work = self.params.density_work(self.step, self.names.len());
        match work.refinement {
            Some(Refinement::Grow) => self.refine(true, observer)?,
            Some(Refinement::Cull) => self.refine(false, observer)?,
            Some(Refinement::Pause) => self.engine.forget_statistics()?,
            None => {}
        }
        if let Some(ceiling) = work.ceiling {
            self.engine.limit_opacity(ceiling)?;
            self.log.push(LogEntry::Ceiling { step: self.step + 1 });
            self.scatter()?;
        }
        if self.step + 1 == self.params.complete_at {
            self.complete(observer)?;
        }
        Ok(())
    }

    /// Moves nearly transparent Gaussians.
    fn scatter(&mut self) -> Result<(), ReconstructError> {
        let (params, step) = (self.params, self.step);
        if params.densify.noise > 0.0 {
            let strength = params.densify.noise * (params.rates(&self.phases, step).0.means * self.unit);
            self.drain(Drain::All)?;
            self.engine.amend(&mut |scene| density::scatter(scene, strength, params.seed, step))?;
        }
        Ok(())
    }

    /// Fills the holes of the sparse model.
    fn complete(&mut self, observer: &mut dyn Observer) -> Result<(), ReconstructError> {
        self.drain(Drain::All)?;
        let mut state = self.engine.save()?.into_owned();
        let room = self.most.saturating_sub(self.gaussians);
        let new = self.holes.filled(&state.gaussians, (self.params.initial_opacity, room, self.params.seed));
        if new.is_empty() {
            return Ok(());
        }
        let zeros = Moments::new(&new);
        state.moments.first.extend(&zeros.first);
        state.moments.second.extend(&zeros.second);
        state.gaussians.extend(&new);
        self.gaussians = state.gaussians.len();
        state.statistics = Statistics::new(self.gaussians);
        self.engine.load(state)?;
        observer.notice(&format!("filled holes of the sparse model with {} Gaussians", new.len()));
        Ok(())
    }

    /// Removes Gaussians that masks hid from all training views.
    fn remove_hidden(&mut self, observer: &mut dyn Observer) -> Result<(), ReconstructError> {
        if self.masks.is_empty() {
            return Ok(());
        }
        let rows = self.masks.shown(&self.engine.save()?.gaussians, self.params.hidden_below);
        let removed = self.gaussians - rows.len();
        if removed > 0 && !rows.is_empty() {
            self.engine.rebuild(&rows, &self.draws())?;
            self.gaussians = rows.len();
            observer.notice(&format!(
                "removed {removed} Gaussians that masks hide from all training views (`hidden_below`)"
            ));
        }
        Ok(())
    }

    /// Fades colour channels that the water hid from all training views.
    fn fade_unknown(&mut self) -> Result<(), ReconstructError> {
        let below = self.params.unknown_below;
        if below > 0.0 {
            let degree = self.degrees(self.step.saturating_sub(1)).water;
            let water = self.engine.save()?.medium.clone();
            let cameras = &self.cameras;
            self.engine.amend(&mut |gaussians| unknown::fade(gaussians, &water, degree, cameras, below))?;
        }
        Ok(())
    }

    /// The rule for children after this step.
    fn draws(&self) -> Draws {
        let d = &self.params.densify;
        Draws { split: d.split, seed: self.params.seed, step: self.step, shrink: d.shrink }
    }

    /// Adds and removes Gaussians.
    fn refine(&mut self, growing: bool, observer: &mut dyn Observer) -> Result<(), ReconstructError> {
        let (params, d, draws) = (self.params, &self.params.densify, self.draws());
        let settings = params.refine_settings(growing, (self.step, self.unit), self.initial, self.most);
        let mut survey = self.engine.survey()?;
        if growing && d.looks() {
            self.drain(Drain::All)?;
            let degrees = self.degrees(self.step);
            survey.evidence = self.growth_views.evidence(&*self.engine.save()?, degrees, d, &draws);
        }
        let (rows, report) = density::plan(&survey, &settings);
        self.engine.rebuild(&rows, &draws)?;
        self.gaussians = rows.len();
        if d.reset_medium && growing {
            self.engine.forget_water_moments()?;
        }
        if report.held_back > 0 && !self.cap_reported {
            self.cap_reported = true;
            observer.notice(&format!(
                "step {}: the scene has reached its cap of {} Gaussians (`max_gaussians`); only the strongest {} of {} candidates were split or duplicated",
                self.step,
                self.most,
                report.split + report.duplicated,
                report.split + report.duplicated + report.held_back
            ));
        }
        self.log.push(LogEntry::Refine {
            step: self.step + 1,
            split: report.split,
            duplicated: report.duplicated,
            culled: report.culled,
            spared: report.spared,
            held_back: report.held_back,
            gaussians: self.gaussians,
        });
        Ok(())
    }

    /// Measures PSNR and SSIM of the held-out views at full size over the pixels that count, and adds them
    /// to the log; `None` if there are no such views.
    fn evaluate(&mut self) -> Result<Option<Evaluation>, ReconstructError> {
        if self.held_out.is_empty() {
            return Ok(None);
        }
        let degrees = self.degrees(self.step.saturating_sub(1));
        let mut rendered = Image::new(0, 0);
        let mut scores = Vec::with_capacity(self.held_out.len());
        let mut target = crate::Target::default();
        for view in &self.held_out {
            let camera = view.target(1, &mut target);
            self.engine.render(&camera, degrees, &mut rendered)?;
            let image = rendered.map(|v| v.clamp(0.0, 1.0));
            let mask = target.mask.as_ref().map(mask_of);
            let measured = |result| Score::measured(result).named(&view.name);
            let fitted = (self.params.exposure == Exposure::PerView).then(|| {
                let image = fitted_on_other_half(&rendered, &target.image, mask.as_ref())
                    .map(|image| image.map(|v| v.clamp(0.0, 1.0)));
                let of = |score: fn(&_, &_, Option<&_>) -> _| {
                    measured(
                        image
                            .as_ref()
                            .map_err(Clone::clone)
                            .and_then(|i| score(i, &target.image, mask.as_ref())),
                    )
                };
                FittedScore { psnr: of(psnr), ssim: of(ssim) }
            });
            scores.push(ViewScore {
                view: view.name.clone(),
                psnr: measured(psnr(&image, &target.image, mask.as_ref())),
                ssim: measured(ssim(&image, &target.image, mask.as_ref())),
                pixels: share(mask.as_ref()),
                fitted,
            });
        }
        let evaluation = Evaluation::of(scores);
        self.log.push(LogEntry::Evaluation {
            step: self.step,
            psnr: evaluation.psnr.value(),
            ssim: evaluation.ssim.value(),
            gaussians: self.gaussians,
        });
        Ok(Some(evaluation))
    }
}
