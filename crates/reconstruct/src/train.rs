//! The loop of stage 1: what happens when. The work is the engine's.

use std::borrow::Cow;
use std::path::Path;
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use use3d_capture::{Capture, MediumMaps, View};
use use3d_medium::{MediumGlobal, MediumMlp, MediumModel, MediumRbf};
use use3d_metrics::{Score, fitted_on_other_half, mask_of, psnr, ssim};
use use3d_numerics::random::Purpose;
use use3d_scene::Scene;
use use3d_splat::Rendered;
use use3d_training::{Checkpoints, NonFinite, Observer, Pace, Profile, Progress, Resumable, ViewOrder};

use crate::bounds::most_gaussians;
use crate::engine::{CpuEngine, Engine, EngineState, RefineSettings, StepRates, StepReport, StepSettings};
use crate::profile::{StepPart, Stretch};
use crate::record::{Evaluation, FittedScore, LogEntry, ViewScore, plot};
use crate::views::{Dropped, TrainingView, ViewLoader};
use crate::{
    DepthPrior, Exposure, ExposureStep, FoundWater, Known, Medium, ReconstructError, ReconstructParams,
    initialise,
};

/// What the names of this loop's checkpoints begin with.
const CHECKPOINT: &str = "reconstruct";

/// Most stretches of a run whose step times are told apart.
const STRETCHES: u64 = 15;

/// The most by which a short run multiplies the rates of the water.
const MOST_COMPRESSED: f64 = 10.0;

/// What stage 1 leaves.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The scene.
    pub scene: Scene,
    /// The training log.
    pub log: Vec<LogEntry>,
    /// Held-out scores; `None` if no view is held out.
    pub evaluation: Option<Evaluation>,
    /// Gain per channel of every training view, by name; empty where all were taken with one exposure.
    pub exposures: Vec<(String, [f32; 3])>,
    /// Gaussians at the start.
    pub initial_gaussians: usize,
    /// Time per part of a step, of this process.
    pub profile: Profile<StepPart>,
    /// The same over the course of the run: how a step grows with the scene.
    pub growth: Vec<Stretch>,
    /// Bytes of parameters, moments, views and buffers at the end, about.
    pub memory: usize,
}

impl Outcome {
    /// The training log, one JSON object per line.
    pub fn log_lines(&self) -> String {
        self.log.iter().map(|entry| entry.to_json() + "\n").collect()
    }

    /// Loss, PSNR and number of Gaussians over the steps, as SVG.
    pub fn plot(&self) -> String {
        plot(&self.log)
    }
}

/// Everything a checkpoint holds.
#[derive(Serialize, Deserialize)]
struct RunState<'a> {
    fingerprint: [u8; 32],
    step: u64,
    initial: usize,
    engine: EngineState<'a>,
    log: Cow<'a, [LogEntry]>,
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

/// Sums since the last log line, and the smoothed numbers that a person sees.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
struct Window {
    steps: u64,
    loss: f64,
    reg_l1: f64,
    reg_ms_ssim: f64,
    depth: (f64, u64),
    psnr: (f64, u64),
    smooth_loss: Option<f64>,
    smooth_psnr: Option<f64>,
}

impl Window {
    fn add(&mut self, report: &StepReport) {
        self.steps += 1;
        self.loss += report.loss;
        self.reg_l1 += report.reg_l1;
        self.reg_ms_ssim += report.reg_ms_ssim;
        if let Some(psnr) = report.psnr {
            self.psnr = (self.psnr.0 + psnr, self.psnr.1 + 1);
        }
        if let Some(depth) = report.depth_loss {
            self.depth = (self.depth.0 + depth, self.depth.1 + 1);
        }
        let smooth = |old: Option<f64>, new: f64| Some(old.map_or(new, |old| 0.97 * old + 0.03 * new));
        self.smooth_loss = smooth(self.smooth_loss, report.loss);
        self.smooth_psnr = report.psnr.map_or(self.smooth_psnr, |psnr| smooth(self.smooth_psnr, psnr));
    }

    /// The log line of the window, which starts anew.
    fn flush(&mut self, step: u64, gaussians: usize, divisor: usize, degree: usize) -> LogEntry {
        let n = self.steps.max(1) as f64;
        let entry = LogEntry::Steps {
            step,
            loss: self.loss / n,
            reg_l1: self.reg_l1 / n,
            reg_ms_ssim: self.reg_ms_ssim / n,
            depth_loss: (self.depth.1 > 0).then(|| self.depth.0 / self.depth.1 as f64),
            psnr: (self.psnr.1 > 0).then(|| self.psnr.0 / self.psnr.1 as f64),
            gaussians,
            divisor,
            degree,
        };
        *self = Self { smooth_loss: self.smooth_loss, smooth_psnr: self.smooth_psnr, ..Self::default() };
        entry
    }
}

/// Reconstructs an underwater scene from a capture.
///
/// Views are loaded once, through `loader`, at the size of their cameras. With a `checkpoint_dir` the run writes checkpoints there
/// and goes on from the furthest one that belongs to the same capture and parameters, also where a run of another length left it;
/// the result is the same to the last bit. Those of other runs in the folder are left alone. The last checkpoint stays there when the
/// run is done: whoever has stored the outcome removes the folder.
pub fn reconstruct(
    capture: &Capture,
    loader: &dyn ViewLoader,
    params: &ReconstructParams,
    checkpoint_dir: Option<&Path>,
    observer: &mut dyn Observer,
) -> Result<Outcome, ReconstructError> {
    reconstruct_in(capture, &Known::default(), loader, params, checkpoint_dir, observer)
}

/// As [`reconstruct`], with what is known beforehand. Known water is where the water starts; it is held for
/// `medium_hold` of the run, and learnt at `medium_release` of its rates from then on. Known gains are where gains start.
pub fn reconstruct_in(
    capture: &Capture,
    known: &Known,
    loader: &dyn ViewLoader,
    params: &ReconstructParams,
    checkpoint_dir: Option<&Path>,
    observer: &mut dyn Observer,
) -> Result<Outcome, ReconstructError> {
    params.validate().map_err(ReconstructError::Parameter)?;
    capture.validate()?;
    if let [only] = capture.split.train[..] {
        return Err(ReconstructError::OneView { view: capture.views[only].name.to_string() });
    }
    let most = most_gaussians(capture, params);
    let start = known.water.as_ref().and_then(|found| Some((found, found.model(params)?)));
    let found = start.as_ref().map(|(found, _)| *found);
    let least_water_degree = found.map_or(0, |_| FoundWater::DEGREE.min(params.sh_degree));
    let gaussians = initialise::gaussians(capture, found, params, most, |message| observer.notice(message))?;
    let initial = gaussians.len();
    let water = start.map_or_else(|| water(params), |(_, model)| model);
    let mut engine = CpuEngine::new(gaussians, water, params.structure_weight);
    engine.keep_water_degree(least_water_degree);
    let views = load(capture, loader, params, observer)?;
    let exposes = params.exposure == Exposure::PerView;
    let gains: Vec<[f64; 3]> = match known.gains.is_empty() {
        true => vec![[1.0; 3]; capture.split.train.len()],
        false => capture.split.train.iter().map(|view| known.gains[*view]).collect(),
    };
    let fingerprint = fingerprint(capture, found, exposes.then_some(&gains), params, &views);
    let names: Vec<String> = views.train.iter().map(|v| v.name.clone()).collect();
    for view in views.train {
        engine.upload(view);
    }
    if exposes {
        engine.expose(&gains);
    }
    let mut run = Run {
        params,
        holds_water: found.is_some(),
        observer,
        names,
        held_out: views.test,
        engine: &mut engine,
        checkpoints: checkpoint_dir
            .map(|dir| Checkpoints::new(dir, CHECKPOINT, &fingerprint, params.iterations)),
        fingerprint,
        initial,
        step: 0,
        log: Vec::new(),
        window: Window::default(),
        most,
        cap_told: false,
        growth: Vec::new(),
    };
    run.resume()?;
    run.go()?;
    let evaluation = run.evaluate();
    let (log, growth) = (std::mem::take(&mut run.log), std::mem::take(&mut run.growth));
    let exposures = std::mem::take(&mut run.names).into_iter().zip(run.engine.exposures()).collect();
    let initial_gaussians = run.initial;
    let (gaussians, medium) = engine.download();
    let last_degree = params.active_degree(params.iterations.saturating_sub(1));
    let medium_degree = last_degree.max(least_water_degree);
    let scene = Scene { gaussians, frame: capture.frame, medium, medium_degree, enhancement: None };
    let (profile, memory) = (engine.profile().clone(), engine.memory());
    Ok(Outcome { scene, log, evaluation, exposures, initial_gaussians, profile, growth, memory })
}

/// The water at the start.
fn water(params: &ReconstructParams) -> MediumModel {
    match params.medium {
        Medium::Rbf => MediumModel::Rbf(MediumRbf::new(params.anchors, params.top_k)),
        Medium::Mlp => MediumModel::Mlp(MediumMlp::new(params.seed)),
        Medium::Global => MediumModel::Global(MediumGlobal::new()),
        Medium::None => MediumModel::None,
    }
}

struct Views {
    train: Vec<TrainingView>,
    test: Vec<TrainingView>,
}

/// Loads every view once; priors without information are named.
fn load(
    capture: &Capture,
    loader: &dyn ViewLoader,
    params: &ReconstructParams,
    observer: &mut dyn Observer,
) -> Result<Views, ReconstructError> {
    let mut one = |view: &View, training: bool| -> Result<TrainingView, ReconstructError> {
        let mut loaded = loader
            .load(view)
            .map_err(|message| ReconstructError::Load { view: view.name.to_string(), message })?;
        if params.depth_prior == DepthPrior::Off || !training {
            loaded.depth_prior = None;
        }
        let (packed, dropped) = TrainingView::new(view, loaded)?;
        if let Some(dropped) = dropped {
            let why = match dropped {
                Dropped::EmptyPrior => "has no finite positive pixel",
                Dropped::ConstantPrior => "is the same everywhere",
            };
            observer.notice(&format!(
                "view `{}`: its depth prior {why}; it is left out of the depth term",
                view.name
            ));
        }
        Ok(packed)
    };
    let train = capture.training_views().map(|v| one(v, true)).collect::<Result<Vec<_>, _>>()?;
    let test = capture.test_views().map(|v| one(v, false)).collect::<Result<Vec<_>, _>>()?;
    check_masks(&train, &test, observer)?;
    let with_prior = train.iter().filter(|v| v.has_prior()).count();
    if params.depth_prior != DepthPrior::Off && params.depth_weight > 0.0 && with_prior < train.len() {
        let message = match with_prior {
            0 => "no training view has a depth prior: the depth term is off".to_string(),
            n => format!(
                "only {n} of {} training views have a depth prior; the depth term is off for the others",
                train.len()
            ),
        };
        observer.notice(&message);
    }
    Ok(Views { train, test })
}

/// A view of which nothing counts teaches and judges nothing: said, and refused where no training view is left.
fn check_masks(
    train: &[TrainingView],
    test: &[TrainingView],
    observer: &mut dyn Observer,
) -> Result<(), ReconstructError> {
    for (views, what) in [(train, "training"), (test, "held-out")] {
        let blank: Vec<&str> = views.iter().filter(|v| v.counts_nothing()).map(|v| v.name.as_str()).collect();
        let Some(first) = blank.first() else { continue };
        if blank.len() == views.len() && what == "training" {
            return Err(ReconstructError::NothingCounts { views: views.len() });
        }
        observer.notice(&format!(
            "the mask of {} of {} {what} views (first: `{first}`) leaves no pixel: they count for nothing; masks are white where pixels count",
            blank.len(),
            views.len()
        ));
    }
    Ok(())
}

/// What a checkpoint must agree with to be gone on from: parameters, cameras, points and pixels.
fn fingerprint(
    capture: &Capture,
    found: Option<&FoundWater>,
    gains: Option<&Vec<[f64; 3]>>,
    params: &ReconstructParams,
    views: &Views,
) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    // How often checkpoints are written changes nothing, nor does the length beyond the schedules; the cap counts as what it comes to.
    let params = ReconstructParams {
        iterations: params.course(),
        max_gaussians: most_gaussians(capture, params),
        checkpoint_steps: 1,
        checkpoint_minutes: 1.0,
        ..params.clone()
    };
    hasher.update(format!("{params:?}").as_bytes());
    for view in views.train.iter().chain(&views.test) {
        hasher.update(format!("{:?}", view.camera).as_bytes());
        view.fingerprint(&mut hasher);
    }
    for point in &capture.points {
        hasher.update(bytemuck::bytes_of(&point.position.to_array()));
        hasher.update(&point.color);
    }
    if let Some(found) = found {
        found.fingerprint(&mut hasher);
    }
    if let Some(gains) = gains {
        hasher.update(bytemuck::cast_slice(gains.as_flattened()));
    }
    *hasher.finalize().as_bytes()
}

/// A run between its first and last step.
struct Run<'a> {
    params: &'a ReconstructParams,
    /// Whether the water was known beforehand.
    holds_water: bool,
    observer: &'a mut dyn Observer,
    names: Vec<String>,
    held_out: Vec<TrainingView>,
    engine: &'a mut CpuEngine,
    checkpoints: Option<Checkpoints>,
    fingerprint: [u8; 32],
    initial: usize,
    step: u64,
    log: Vec<LogEntry>,
    window: Window,
    most: usize,
    cap_told: bool,
    growth: Vec<Stretch>,
}

impl Run<'_> {
    /// Goes on from the checkpoint, if there is one of this run.
    fn resume(&mut self) -> Result<(), ReconstructError> {
        let Some(checkpoints) = &self.checkpoints else { return Ok(()) };
        let found = match checkpoints.load::<RunState<'_>>() {
            Ok(found) => found,
            Err(error) => {
                self.observer.notice(&format!("{error}; starting anew"));
                return Ok(());
            }
        };
        found.notices.iter().for_each(|notice| self.observer.notice(notice));
        let Some(state) = found.state else { return Ok(()) };
        if !self.engine.restore(&state.engine) {
            self.observer.notice("the checkpoint does not fit this scene; starting anew");
            return Ok(());
        }
        self.observer.notice(&format!("going on from step {} of {}", state.step, self.params.iterations));
        self.step = state.step;
        self.initial = state.initial;
        self.log = state.log.into_owned();
        self.window = state.window;
        // A run that ended here measured after its last checkpoint; one that goes on has that line in its log.
        let due = self.params.evaluate_every > 0 && self.step.is_multiple_of(self.params.evaluate_every);
        let measured =
            matches!(self.log.last(), Some(LogEntry::Evaluation { step, .. }) if *step == self.step);
        if due && !measured && self.step < self.params.iterations {
            self.evaluate();
        }
        Ok(())
    }

    fn save(&self) -> Result<(), ReconstructError> {
        if let Some(checkpoints) = &self.checkpoints {
            let state = RunState {
                fingerprint: self.fingerprint,
                step: self.step,
                initial: self.initial,
                engine: self.engine.state(),
                log: (&self.log).into(),
                window: self.window.clone(),
            };
            checkpoints.save(self.step, &state)?;
        }
        Ok(())
    }

    fn go(&mut self) -> Result<(), ReconstructError> {
        let params = self.params;
        let mut order = ViewOrder::new(params.seed, Purpose::new("training views"), self.names.len());
        let first = self.step;
        let mut work_left: f64 = (first..params.iterations).map(|s| params.step_work(s)).sum();
        let mut pace = Pace::start();
        let (mut saved_at, mut saved_step) = (Instant::now(), self.step);
        let stretch = params.iterations.div_ceil(STRETCHES);
        while self.step < params.iterations {
            let view = order.view(self.step);
            self.one_step(view)?;
            let done = self.step + 1;
            if done.is_multiple_of(stretch) || done == params.iterations {
                self.look_at_pace(view, done - first);
            }
            // Refinements look at the state after the step's update.
            self.control_density();
            self.step = done;
            if done.is_multiple_of(params.log_every) {
                self.end_window();
            }
            if params.evaluate_every > 0
                && done.is_multiple_of(params.evaluate_every)
                && done < params.iterations
            {
                self.evaluate();
            }
            let work = params.step_work(done - 1);
            work_left -= work;
            pace.step(work);
            self.observer.progress(&Progress {
                step: done,
                steps: params.iterations,
                loss: self.window.smooth_loss,
                psnr: self.window.smooth_psnr,
                gaussians: Some(self.engine.gaussians()),
                steps_per_second: pace.steps_per_second(),
                seconds_left: pace.seconds_for(work_left),
            });
            let stop = self.observer.should_stop() && done < params.iterations;
            let due = done - saved_step >= params.checkpoint_steps
                || saved_at.elapsed().as_secs_f64() >= 60.0 * params.checkpoint_minutes;
            if due || stop || done == params.iterations {
                self.save()?;
                (saved_at, saved_step) = (Instant::now(), done);
            }
            if stop {
                let saved = self.checkpoints.is_some();
                return Err(ReconstructError::Interrupted { step: done, steps: params.iterations, saved });
            }
        }
        // Only here, after the last checkpoint: a longer run that goes on from it still collects for this line.
        if self.window.steps > 0 {
            self.end_window();
        }
        Ok(())
    }

    /// The log line of the steps since the last one.
    fn end_window(&mut self) {
        let last = self.step.saturating_sub(1);
        let (divisor, degree) = (self.params.divisor(last), self.params.active_degree(last));
        let entry = self.window.flush(self.step, self.engine.gaussians(), divisor, degree);
        self.log.push(entry);
    }

    fn one_step(&mut self, view: usize) -> Result<(), ReconstructError> {
        let (params, step, r) = (self.params, self.step, &self.params.learning_rates);
        let rate = |rate: crate::Rate| rate.at(step, params.course());
        // The water starts far from where it ends and Adam's steps are as long as the rate, whatever the gradient: a compressed run
        // takes longer steps to get as far, within reason. (The Gaussians start where they belong.)
        let compressed = (params.schedule as f64 / params.course() as f64).min(MOST_COMPRESSED);
        let let_go = if self.holds_water { params.water_release(step) } else { 1.0 };
        let water = |rate: crate::Rate| let_go * compressed * rate.at(step, params.course());
        let settings = StepSettings {
            step,
            divisor: params.divisor(step),
            degree: params.active_degree(step),
            rates: StepRates {
                means: rate(r.means),
                sh_constant: rate(r.sh_constant),
                sh_directional: rate(r.sh_directional),
                opacity: rate(r.opacity),
                scales: rate(r.scales),
                quaternions: rate(r.quaternions),
                medium_constant: water(r.medium_constant),
                medium_directional: water(r.medium_directional),
                medium_network: water(r.medium_network),
            },
            depth_weight: if params.depth_prior == DepthPrior::Off { 0.0 } else { params.depth_weight },
            depth_gradient: params.depth_gradient,
            exposure: (params.exposure == Exposure::PerView).then(|| ExposureStep {
                rate: compressed * rate(r.exposure),
                weight: params.exposure_weight,
            }),
            gather: (params.densify.enabled
                && step >= params.densify.statistics_from.min(params.warm_up())
                && step < params.densify_end())
            .then_some(params.densify.reference_pixels),
        };
        let report = self.engine.step(view, &settings);
        if let Some((what, index)) = report.non_finite {
            let view = self.names[view].clone();
            return Err(NonFinite { step, view, what: what.into(), index }.into());
        }
        self.window.add(&report);
        Ok(())
    }

    /// Ends a stretch of the run at this step: `done` steps of this process.
    fn look_at_pace(&mut self, view: usize, done: u64) {
        let (divisor, degree) = (self.params.divisor(self.step), self.params.active_degree(self.step));
        let told: u64 = self.growth.iter().map(|s| s.steps).sum();
        let before: Duration = self.growth.iter().map(|s| s.spent).sum();
        self.growth.push(Stretch {
            step: self.step + 1,
            steps: done - told,
            divisor,
            gaussians: self.engine.gaussians(),
            pairs: 1e-6 * self.engine.contributing_pairs(view, divisor, degree),
            spent: self.engine.profile().spent() - before,
        });
    }

    /// The refinement or the opacity ceiling that is due after this step (R9).
    fn control_density(&mut self) {
        let (params, d, step) = (self.params, &self.params.densify, self.step);
        if !d.enabled || step <= params.warm_up() {
            return;
        }
        let growing = step < params.densify_end();
        let phase = step % d.period;
        if step.is_multiple_of(d.every) {
            // Densification waits after a ceiling; culling alone goes on to the end.
            let pause = d.pause.min(self.names.len() as u64 + d.every);
            if !growing || phase >= pause {
                self.refine(growing);
            } else {
                self.engine.forget_statistics();
            }
        }
        if growing && phase == d.every % d.period {
            self.engine.limit_opacity(d.opacity_ceiling);
            self.log.push(LogEntry::Ceiling { step: step + 1 });
        }
    }

    fn refine(&mut self, growing: bool) {
        let (params, d) = (self.params, &self.params.densify);
        let report = self.engine.refine(&RefineSettings {
            step: self.step,
            seed: params.seed,
            grow: growing,
            gradient_threshold: d.gradient_threshold,
            split_scale: d.split_scale,
            shrink: d.shrink,
            cull_opacity: if growing { d.cull_opacity } else { d.cull_opacity_late },
            cull_scale: d.cull_scale,
            floor: d.floor.max((d.floor_share * self.initial as f64) as usize),
            most: self.most,
            reset_medium: d.reset_medium && growing,
        });
        if report.held_back > 0 && !self.cap_told {
            self.cap_told = true;
            self.observer.notice(&format!(
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
            gaussians: self.engine.gaussians(),
        });
    }

    /// PSNR and SSIM of the held-out views at full size over the pixels that count, also into the log; `None` if there are none.
    fn evaluate(&mut self) -> Option<Evaluation> {
        if self.held_out.is_empty() {
            return None;
        }
        let degree = self.params.active_degree(self.step.saturating_sub(1));
        let (mut rendered, mut water) = (Rendered::new(), MediumMaps::zeros(0, 0));
        let mut scores = Vec::with_capacity(self.held_out.len());
        let mut target = crate::Target::default();
        for view in &self.held_out {
            let camera = view.target(1, &mut target);
            self.engine.render(&camera, degree, &mut rendered, &mut water);
            let image = rendered.image.map(|v| v.clamp(0.0, 1.0));
            let mask = target.mask.as_ref().map(mask_of);
            let measured = |result| Score::measured(result).named(&view.name);
            let fitted = (self.params.exposure == Exposure::PerView).then(|| {
                let image = fitted_on_other_half(&rendered.image, &target.image, mask.as_ref())
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
                fitted,
            });
        }
        let evaluation = Evaluation::of(scores);
        self.log.push(LogEntry::Evaluation {
            step: self.step,
            psnr: evaluation.psnr.value(),
            ssim: evaluation.ssim.value(),
            gaussians: self.engine.gaussians(),
        });
        Some(evaluation)
    }
}
