//! Benchmarks an adapter in one run: its limits, the agreement of its kernels with the processor, the
//! equality of their bits between runs, their times, and the number of training steps per second. It uses
//! no network; after a given time it begins no further part. The record is one document.
//!
//! A card may be available for a short time only, or hang in one kernel. So each failure is recorded and
//! the other parts still run, and the record is passed on after every part. Only a lost device ends the
//! benchmark.

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::{Duration, Instant};

use use3d_capture::Appearance;
use use3d_enhance::engine::{FieldEngine, FieldPlan, FieldState, initial_field};
use use3d_enhance::{EnhanceParams, Guidance};
use use3d_gpu::measure::{Ceilings, KernelTime, Timed, ViewWork, ceilings};
use use3d_gpu::twins::{self, Agreement, LossCase, SceneSize, WaterCase};
use use3d_gpu::{CheckError, Gpu, Stage1, Stage2, check};
use use3d_reconstruct::density::{Draws, Origin};
use use3d_reconstruct::engine::{Engine, TrainingState};
use use3d_training::{Drain, EngineError, Silent};

use super::read::FORMAT;
use super::records::{
    BenchRecord, CeilingsRecord, CheckRecord, CompiledRecord, DeterminismRecord, EnhancementRecord,
    FailedRecord, KernelRecord, RooflineRecord, TimesRecord, TrainingRecord, TwinRecord, ViewRecord,
};
use super::work::{least, need};

/// The plan of a benchmark.
#[derive(Clone, Debug, PartialEq)]
pub struct BenchPlan {
    /// Sizes of views at which kernels are timed.
    pub sizes: Vec<(usize, usize)>,
    /// Number of runs of each size; the first one warms up.
    pub rounds: usize,
    /// Numbers of Gaussians of the trainings at each size.
    pub gaussians: Vec<usize>,
    /// Number of timed steps of each training; as many steps as there are views warm up.
    pub steps: u64,
    /// Number of steps of the training at the middle size with the middle number of Gaussians, if it
    /// differs.
    pub long: Option<u64>,
    /// Number of bytes copied at once to measure the copy rate; fewer if memory is short.
    pub copied: u64,
    /// The seconds after which no further times or trainings are begun; `None` for no limit.
    pub seconds: Option<f64>,
}

impl BenchPlan {
    /// The plan for a card: all of it takes minutes. Software needs as long for a few steps. `steps` replaces
    /// the numbers of steps.
    pub fn new(
        gpu: &Gpu,
        (sizes, gaussians): (Vec<(usize, usize)>, Vec<usize>),
        rounds: usize,
        steps: Option<u64>,
        minutes: usize,
    ) -> Self {
        let (steps, long) = match (steps, gpu.adapter.is_software()) {
            (Some(steps), _) => (steps, None),
            (None, false) => (200, Some(1000)),
            (None, true) => (10, None),
        };
        // A size that every adapter can bind, and larger than its caches.
        let copied = 128 << 20;
        Self { sizes, rounds, gaussians, steps, long, copied, seconds: Some(60.0 * minutes as f64) }
    }

    /// The scene of the step that is compared at full size: the largest view with the most Gaussians.
    fn large(&self) -> Option<SceneSize> {
        let (width, height) = self.sizes.iter().copied().max_by_key(|(width, height)| width * height)?;
        let gaussians = self.gaussians.iter().copied().max()?;
        Some(SceneSize { width, height, gaussians, views: 1, seed: 11 })
    }

    /// The scenes of the trainings, with their numbers of steps.
    fn trainings(&self) -> Vec<(SceneSize, u64)> {
        let middle = (self.sizes.len() / 2, self.gaussians.len() / 2);
        let mut all = Vec::new();
        for (i, &(width, height)) in self.sizes.iter().enumerate() {
            for (k, &gaussians) in self.gaussians.iter().enumerate() {
                let long = self.long.filter(|_| (i, k) == middle);
                let scene = SceneSize { width, height, gaussians, views: VIEWS, seed: 7 };
                all.push((scene, long.unwrap_or(self.steps)));
            }
        }
        all
    }
}

fn cases(width: usize, height: usize) -> (LossCase, WaterCase) {
    (
        LossCase { width, height, seed: 3, mask: true, prior: true, gains: true },
        WaterCase { width, height, seed: 3, anchors: 8, top_k: 4, degree: 3 },
    )
}

/// Runs the kernels of one size; returns each agreement with its case.
fn run_twins(gpu: &Gpu, size: (usize, usize)) -> Result<Vec<(String, Agreement)>, EngineError> {
    let (loss, water) = cases(size.0, size.1);
    let mut all: Vec<_> = twins::losses(gpu, &loss)?.into_iter().map(|a| (format!("{loss:?}"), a)).collect();
    all.extend(twins::water(gpu, &water)?.into_iter().map(|a| (format!("{water:?}"), a)));
    Ok(all)
}

/// Number of views of a training.
const VIEWS: usize = 4;
/// Shortest time in seconds of a measurement of the device's highest rate.
const LEAST: f64 = 0.02;
/// Number of steps whose kernels are timed by the device's clock.
const PROFILED: u64 = 20;
/// Time for which steps are done before those that are timed kernel by kernel.
const WARM_UP: Duration = Duration::from_millis(100);
/// Number of steps after which the clock of whole steps is read: half of its places, because steps may be
/// done twice.
const READ: usize = 1000;

/// Starts stage 1 on a packed scene and does one step of each view.
fn begun(gpu: &Gpu, scene: &SceneSize) -> Result<Stage1, EngineError> {
    let mut engine = Stage1::new(gpu)?;
    for view in scene.training_views()? {
        engine.upload(view)?;
    }
    engine.load(scene.state())?;
    go_on(&mut engine, scene, 0..scene.views as u64)?;
    Ok(engine)
}

/// Runs some steps, waits for them, and returns their losses.
fn go_on(engine: &mut Stage1, scene: &SceneSize, steps: Range<u64>) -> Result<Vec<f64>, EngineError> {
    for step in steps {
        engine.step((step % scene.views.max(1) as u64) as usize, &SceneSize::plan(step))?;
    }
    let reports = engine.drain(Drain::All)?;
    if let Some((what, _)) = reports.iter().find_map(|report| report.non_finite) {
        return Err(EngineError::Failed(format!("{what} of a packed scene are not finite").into()));
    }
    Ok(reports.into_iter().map(|report| report.loss).collect())
}

/// Computes a digest of the bits of a training's whole state.
fn digest(state: &TrainingState) -> String {
    let mut hasher = blake3::Hasher::new();
    for g in [&state.gaussians, &state.moments.first, &state.moments.second] {
        let arrays: [&[f32]; 5] = [
            g.means.as_flattened(),
            g.log_scales.as_flattened(),
            g.quaternions.as_flattened(),
            &g.opacity_logits,
            g.sh.as_flattened().as_flattened(),
        ];
        for values in arrays {
            hasher.update(bytemuck::cast_slice(values));
        }
    }
    let water = [&state.medium.flat(), &state.medium_moments[0], &state.medium_moments[1]];
    for values in water.into_iter().chain([&state.statistics.norms]) {
        hasher.update(bytemuck::cast_slice(values));
    }
    hasher.finalize().to_hex().to_string()
}

/// Computes means over the kernels' dispatches.
fn kernel_records(times: BTreeMap<&'static str, KernelTime>) -> BTreeMap<&'static str, KernelRecord> {
    let record = |time: KernelTime| KernelRecord {
        dispatches: time.dispatches,
        milliseconds: 1e3 * time.seconds / time.dispatches.max(1) as f64,
    };
    times.into_iter().map(|(name, time)| (name, record(time))).collect()
}

/// Compares the kernels of `steps` steps with their smallest possible times.
fn roofline(
    kernels: &BTreeMap<&'static str, KernelRecord>,
    steps: u64,
    work: &ViewWork,
    ceilings: &Ceilings,
) -> BTreeMap<&'static str, RooflineRecord> {
    let record = |(name, kernel): (&&'static str, &KernelRecord)| {
        let [bytes, flops] = need(name, work)?;
        let least_milliseconds = 1e3 * least(ceilings, [bytes, flops]);
        let taken = kernel.milliseconds * kernel.dispatches as f64 / steps.max(1) as f64;
        let share = if taken > 0.0 { least_milliseconds / taken } else { 0.0 };
        let (megabytes, megaflops) = (1e-6 * bytes, 1e-6 * flops);
        Some((*name, RooflineRecord { megabytes, megaflops, least_milliseconds, share }))
    };
    kernels.iter().filter_map(record).collect()
}

/// Returns the mean loss of the first steps, one of each view, and that of the last ones.
fn ends(losses: &[f64], scene: &SceneSize) -> [f64; 2] {
    let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len().max(1) as f64;
    let few = scene.views.min(losses.len());
    [mean(&losses[..few]), mean(&losses[losses.len() - few..])]
}

/// Times the steps of a packed scene by the processor's clock, and every whole step by the device's.
fn race(gpu: &Gpu, scene: &SceneSize, steps: u64, record: &mut TrainingRecord) -> Result<(), EngineError> {
    let views = scene.views as u64;
    let gpu = &gpu.clone().timed(Timed::Passes);
    let mut engine = begun(gpu, scene)?;
    gpu.read_times(&mut BTreeMap::new())?;
    let (mut times, mut losses) = (BTreeMap::new(), Vec::new());
    let (mut seconds, mut submits) = (0.0, 0);
    let end = views + steps;
    for first in (views..end).step_by(READ) {
        let (started, submitted) = (Instant::now(), gpu.submits());
        for step in first..end.min(first + READ as u64) {
            engine.step((step % views.max(1)) as usize, &SceneSize::plan(step))?;
        }
        submits += gpu.submits() - submitted;
        losses.extend(go_on(&mut engine, scene, 0..0)?);
        seconds += started.elapsed().as_secs_f64();
        gpu.read_times(&mut times)?;
    }
    let per_step = |total: f64| total / steps.max(1) as f64;
    record.steps = steps;
    record.steps_per_second = steps as f64 / seconds;
    record.loss = ends(&losses, scene);
    record.bytes = engine.memory();
    record.submits_per_step = per_step(submits as f64);
    if let Some(KernelTime { seconds: busy, .. }) = times.get("step") {
        record.busy_milliseconds_per_step = Some(1e3 * per_step(*busy));
        record.idle_share = Some((1.0 - busy / seconds).max(0.0));
    }
    Ok(())
}

/// Measures the milliseconds of a refinement that replaces every twentieth Gaussian by two.
fn refine(engine: &mut Stage1, scene: &SceneSize) -> Result<f64, EngineError> {
    let split = |i: &usize| i.is_multiple_of(20);
    let kept = (0..scene.gaussians).filter(|i| !split(i)).map(Origin::Kept);
    let children = (0..scene.gaussians).filter(split).flat_map(|i| [0, 1].map(|k| Origin::Child(i, k)));
    let rows: Vec<Origin> = kept.chain(children).collect();
    let started = Instant::now();
    engine.survey()?;
    engine.rebuild(&rows, &Draws { seed: scene.seed, step: 100, shrink: 1.6, ..Draws::default() })?;
    Ok(1e3 * started.elapsed().as_secs_f64())
}

/// Times the steps of stage 2 on a packed scene by the processor's clock, after one step of each view.
fn enhance(gpu: &Gpu, scene: &SceneSize, steps: u64) -> Result<EnhancementRecord, EngineError> {
    let (packed, views) = (scene.scene(), scene.enhance_views()?);
    let targets = twins::targets(scene.gaussians, &views, Appearance::Water);
    let (guidance, params) = (Guidance::Targets(&targets), EnhanceParams::default());
    let mut engine =
        Stage2::new(gpu, &packed, &views, guidance, &params, &mut Silent).map_err(twins::failed)?;
    let field = initial_field(&packed, guidance, &params).map_err(twins::failed)?;
    engine.load(FieldState::new(&field))?;
    let count = scene.views.max(1) as u64;
    let mut go_on = |steps: Range<u64>| {
        for step in steps {
            let (rate, transport_rate) = (params.learning_rate, params.transport_learning_rate);
            let plan = FieldPlan { step, rate, transport_rate };
            engine.step((step % count) as usize, &plan)?;
        }
        engine.drain(Drain::All)
    };
    go_on(0..count)?;
    let started = Instant::now();
    let reports = go_on(count..count + steps)?;
    let seconds = started.elapsed().as_secs_f64();
    if let Some((what, _)) = reports.iter().find_map(|report| report.non_finite) {
        return Err(EngineError::Failed(format!("{what} of a packed scene is not finite").into()));
    }
    let losses: Vec<f64> = reports.iter().map(|report| report.losses.total).collect();
    Ok(EnhancementRecord { steps, steps_per_second: steps as f64 / seconds, loss: ends(&losses, scene) })
}

/// Trains on a packed scene: first timed by the processor's clock, then with the device's clock around
/// every kernel. Results before a failure stay in the record.
fn train(
    gpu: &Gpu,
    scene: &SceneSize,
    steps: u64,
    ceilings: Option<&Ceilings>,
    record: &mut TrainingRecord,
) -> Result<(), EngineError> {
    race(gpu, scene, steps, record)?;
    let views = scene.views as u64;
    let profiled = steps.min(PROFILED);
    let profile = |variant| {
        let timed = gpu.clone().with(variant).timed(Timed::Dispatches);
        let mut engine = begun(&timed, scene)?;
        // A card that had nothing to do runs slowly at first.
        let started = Instant::now();
        while started.elapsed() < WARM_UP {
            go_on(&mut engine, scene, views..views + 1)?;
            timed.read_times(&mut BTreeMap::new())?;
        }
        let mut times = BTreeMap::new();
        for step in views..views + profiled {
            go_on(&mut engine, scene, step..step + 1)?;
            timed.read_times(&mut times)?;
        }
        Ok::<_, EngineError>((times, engine))
    };
    let (times, mut engine) = profile(gpu.variant)?;
    let work = engine.last_view([scene.width, scene.height])?;
    record.refinement_milliseconds = Some(refine(&mut engine, scene)?);
    drop(engine);
    let dispatches: u64 = times.values().map(|time| time.dispatches).sum();
    record.kernels = kernel_records(times);
    if dispatches > 0 {
        record.dispatches_per_step = Some(dispatches as f64 / profiled.max(1) as f64);
        let per_pixel = |pairs: u64| pairs as f64 / work.pixels.max(1) as f64;
        record.view = Some(ViewRecord {
            visible: work.visible,
            entries: work.entries,
            tested_per_pixel: per_pixel(work.tested),
            live_per_pixel: per_pixel(work.live),
            longest_list: work.longest_list,
            deepest_pixel: work.deepest_pixel,
        });
    }
    if let Some(ceilings) = ceilings {
        record.roofline = roofline(&record.kernels, profiled, &work, ceilings);
    }
    for variant in gpu.trials() {
        let own = if variant == gpu.variant { None } else { Some(kernel_records(profile(variant)?.0)) };
        if let Some(kernel) = own.as_ref().unwrap_or(&record.kernels).get("backward") {
            record.backward_milliseconds.insert(variant.to_string(), kernel.milliseconds);
        }
    }
    record.enhancement = Some(enhance(gpu, scene, steps)?);
    Ok(())
}

fn twin_record(case: String, agreement: Agreement) -> TwinRecord {
    let holds = agreement.holds();
    let Agreement { what, error, bar, .. } = agreement;
    TwinRecord { case, what, error: error.is_finite().then_some(error), bar, holds }
}

/// The kernels compiled so far, and the seconds that this took, by name.
fn compiled(gpu: &Gpu) -> BTreeMap<&'static str, CompiledRecord> {
    let mut all = BTreeMap::new();
    for (name, seconds) in gpu.compile_times() {
        let record: &mut CompiledRecord = all.entry(name).or_default();
        record.texts += 1;
        record.milliseconds += 1e3 * seconds;
    }
    all
}

/// The text in which NVIDIA's driver describes itself, if there is one.
fn driver_text() -> Option<String> {
    std::fs::read_to_string("/proc/driver/nvidia/version").ok().map(|text| text.trim().to_string())
}

/// A running benchmark.
struct BenchRun<'a> {
    gpu: &'a Gpu,
    record: BenchRecord,
    started: Instant,
    /// True if the device is lost.
    lost: bool,
    /// The seconds after which no further part of the rest is begun.
    seconds: Option<f64>,
    stop: &'a dyn Fn() -> bool,
    tell: &'a mut dyn FnMut(&str),
    keep: &'a mut dyn FnMut(&BenchRecord),
}

impl BenchRun<'_> {
    /// Passes the current record to `keep`.
    fn hand_over(&mut self) {
        self.record.seconds = self.started.elapsed().as_secs_f64();
        (self.keep)(&self.record);
    }

    /// True if nothing more can be done: the device is lost, or the user stopped the benchmark.
    fn ended(&self) -> bool {
        self.lost || (self.stop)()
    }

    /// True if there is time for this part; otherwise it is recorded as left out.
    fn has_time(&mut self, name: &str) -> bool {
        let has = self.seconds.is_none_or(|most| self.started.elapsed().as_secs_f64() < most);
        if !has && !self.ended() {
            self.record.left_out.push(name.to_string());
        }
        has
    }

    fn fail(&mut self, section: &str, error: &EngineError) {
        self.lost |= matches!(error, EngineError::DeviceLost { .. });
        self.record.failed.push(FailedRecord { section: section.to_string(), why: error.to_string() });
    }

    /// Runs one part of it; `None` if it failed or the device is lost.
    fn section<T>(&mut self, name: &str, work: impl FnOnce(&Gpu) -> Result<T, EngineError>) -> Option<T> {
        if self.ended() {
            return None;
        }
        (self.tell)(name);
        work(self.gpu).map_err(|error| self.fail(name, &error)).ok()
    }

    fn check(&mut self) {
        (self.tell)("check");
        let (began, said) = (Instant::now(), check(self.gpu));
        if let Err(CheckError::Failed { error, .. }) = &said {
            self.fail("check", error);
        }
        self.record.check = Some(CheckRecord {
            passed: said.is_ok(),
            refusal: said.err().map(|e| e.to_string()),
            seconds: began.elapsed().as_secs_f64(),
        });
        self.record.compiled = compiled(self.gpu);
        self.hand_over();
    }

    /// Compares one step at full size.
    fn large(&mut self, scene: &SceneSize) {
        let SceneSize { width, height, gaussians, .. } = scene;
        let name = format!("a step at {width} x {height} with {gaussians} Gaussians beside the processor's");
        let found = self.section(&name, |gpu| twins::large_step(&mut Stage1::new(gpu)?, scene, 0));
        let case = format!("{scene:?}");
        self.record.twins.extend(found.into_iter().flatten().map(|found| twin_record(case.clone(), found)));
        self.hand_over();
    }

    /// Compares kernels with the processor's functions, and whole steps in every variant.
    fn twins(&mut self) {
        let mut found = Vec::new();
        self.section("kernels beside the processor's functions", |gpu| {
            for size in [(61, 47), (96, 64), (257, 33)] {
                found.extend(run_twins(gpu, size)?);
            }
            let scene = SceneSize { width: 61, height: 47, gaussians: 600, views: 2, seed: 3 };
            for variant in gpu.trials() {
                let mut engine = Stage1::new(&gpu.clone().with(variant))?;
                let case = format!("step, {variant}, {scene:?}");
                found.extend(twins::step(&mut engine, &scene)?.into_iter().map(|a| (case.clone(), a)));
            }
            let further = twins::pictures(gpu, &scene)?.into_iter().chain(twins::field(gpu, &scene)?);
            found.extend(further.map(|a| (format!("{scene:?}"), a)));
            Ok(())
        });
        self.record.twins = found.into_iter().map(|(case, found)| twin_record(case, found)).collect();
        self.hand_over();
    }

    /// Runs the same work three times in every variant.
    fn determinism(&mut self) {
        for variant in self.gpu.variants() {
            let name = format!("the same bits three times, {variant}");
            let digests = self.section(&name, |gpu| {
                let gpu = gpu.clone().with(variant);
                let mut digests = Vec::new();
                for _ in 0..3 {
                    let mut hasher = blake3::Hasher::new();
                    for (case, agreement) in run_twins(&gpu, (96, 64))? {
                        hasher.update(case.as_bytes());
                        hasher.update(&agreement.digest);
                    }
                    let scene = SceneSize { width: 96, height: 64, gaussians: 2000, views: 3, seed: 5 };
                    for agreement in
                        twins::pictures(&gpu, &scene)?.into_iter().chain(twins::field(&gpu, &scene)?)
                    {
                        hasher.update(&agreement.digest);
                    }
                    let mut engine = begun(&gpu, &scene)?;
                    go_on(&mut engine, &scene, 3..12)?;
                    hasher.update(digest(engine.save()?.as_ref()).as_bytes());
                    digests.push(hasher.finalize().to_hex().to_string());
                }
                Ok(digests)
            });
            let Some(digests) = digests else { continue };
            let same = digests.iter().all(|digest| *digest == digests[0]);
            self.record.determinism.push(DeterminismRecord { variant: variant.to_string(), digests, same });
        }
        self.hand_over();
    }

    /// Times the kernels at one size.
    fn times(&mut self, (width, height): (usize, usize), rounds: usize) {
        let name = format!("times at {width} x {height}");
        if !self.has_time(&name) {
            return;
        }
        let kernels = self.section(&name, |gpu| {
            let timed = gpu.clone().timed(Timed::Dispatches);
            let mut kernels = BTreeMap::new();
            for round in 0..rounds.max(2) {
                run_twins(&timed, (width, height))?;
                timed.read_times(&mut kernels)?;
                if round == 0 {
                    kernels.clear();
                }
            }
            Ok(kernel_records(kernels))
        });
        self.record.times.extend(kernels.map(|kernels| TimesRecord { size: [width, height], kernels }));
        self.hand_over();
    }

    fn training(&mut self, scene: &SceneSize, steps: u64, ceilings: Option<&Ceilings>) {
        let SceneSize { width, height, gaussians, .. } = *scene;
        let name = format!("{steps} steps at {width} x {height} with {gaussians} Gaussians");
        if self.ended() || !self.has_time(&name) {
            return;
        }
        (self.tell)(&name);
        let mut record = TrainingRecord { size: [width, height], gaussians, ..TrainingRecord::default() };
        if let Err(error) = train(self.gpu, scene, steps, ceilings, &mut record) {
            record.refusal = Some(error.to_string());
            // Too little memory on this card is a result; smaller trainings may still fit.
            if !matches!(error, EngineError::OutOfMemory { .. }) {
                self.fail(&name, &error);
            }
        }
        self.record.trainings.push(record);
        self.hand_over();
    }
}

/// Runs the whole benchmark. `tell` receives the name of each part, and `keep` the record after every part.
/// No further part is begun once `stop` returns true.
pub fn bench(
    gpu: &Gpu,
    plan: &BenchPlan,
    stop: &dyn Fn() -> bool,
    mut tell: impl FnMut(&str),
    mut keep: impl FnMut(&BenchRecord),
) -> BenchRecord {
    let record = BenchRecord {
        format: FORMAT,
        version: 7,
        adapter: gpu.adapter.clone(),
        driver_text: driver_text(),
        subgroup_width: gpu.width,
        variant: gpu.kernels(),
        ..BenchRecord::default()
    };
    let started = Instant::now();
    let seconds = plan.seconds;
    let mut bench =
        BenchRun { gpu, record, started, lost: false, seconds, stop, tell: &mut tell, keep: &mut keep };
    bench.check();
    let best = bench.section("what it does at best", |gpu| ceilings(gpu, plan.copied, LEAST));
    bench.record.ceilings = best.map(|Ceilings { bytes, flops, copied }| CeilingsRecord {
        copy_gigabytes_per_second: 1e-9 * bytes,
        multiply_add_gigaflops: 1e-9 * flops,
        copied_bytes: copied,
    });
    bench.twins();
    if let Some(scene) = plan.large() {
        bench.large(&scene);
    }
    bench.determinism();
    // The largest come first, because they may be the last for which there is time.
    for (scene, steps) in plan.trainings().into_iter().rev() {
        bench.training(&scene, steps, best.as_ref());
    }
    for &size in plan.sizes.iter().rev() {
        bench.times(size, plan.rounds);
    }
    bench.record.complete = !bench.ended();
    bench.hand_over();
    bench.record
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Opens the software adapter. Without one the test is skipped with a message, or fails if
    /// `USE3D_REQUIRE_GPU=1`.
    fn software() -> Option<Gpu> {
        match Gpu::open(Some("llvmpipe")) {
            Ok(gpu) => Some(gpu),
            Err(error) => {
                let required = std::env::var_os("USE3D_REQUIRE_GPU").is_some_and(|v| v == "1");
                assert!(!required, "USE3D_REQUIRE_GPU is set: {error}");
                eprintln!("SKIPPED, no software adapter (package mesa-vulkan-drivers): {error}");
                None
            }
        }
    }

    fn plan() -> BenchPlan {
        BenchPlan {
            sizes: vec![(33, 20)],
            rounds: 2,
            gaussians: vec![60],
            steps: 2,
            long: None,
            copied: 1 << 20,
            seconds: None,
        }
    }

    #[test]
    fn the_middle_training_is_the_long_one() {
        let sizes = vec![(10, 10), (20, 20), (30, 30)];
        let plan = BenchPlan { sizes, gaussians: vec![1, 2], steps: 5, long: Some(50), ..plan() };
        let steps: Vec<u64> = plan.trainings().iter().map(|(_, steps)| *steps).collect();
        assert_eq!(steps, [5, 5, 5, 50, 5, 5]);
    }

    #[test]
    fn a_device_that_is_lost_on_the_way_keeps_what_was_found() {
        let Some(gpu) = software() else { return };
        let mut kept = None;
        let record = BenchRecord::default();
        let mut bench = BenchRun {
            gpu: &gpu,
            record,
            started: Instant::now(),
            lost: false,
            seconds: None,
            stop: &|| false,
            tell: &mut |_| (),
            keep: &mut |record| kept = Some(record.clone()),
        };
        bench.check();
        let lost = || EngineError::DeviceLost { engine: "gpu", reason: "destroyed".into() };
        assert!(bench.section::<()>("kernels", |_| Err(lost())).is_none());
        bench.twins();
        bench.training(&plan().trainings()[0].0, 2, None);
        bench.times((33, 20), 2);
        bench.hand_over();
        let kept = kept.unwrap();
        assert!(kept.check.as_ref().is_some_and(|check| check.passed) && kept.twins.is_empty());
        let [failed] = &kept.failed[..] else { panic!("{:?}", kept.failed) };
        assert!(failed.section == "kernels" && failed.why.contains("lost"), "{failed:?}");
        assert!(!kept.complete && kept.trainings.is_empty() && kept.times.is_empty(), "{kept:?}");
    }

    #[test]
    fn after_its_time_or_a_signal_it_begins_nothing_more() {
        let Some(gpu) = software() else { return };
        let plan = BenchPlan { seconds: Some(0.0), ..plan() };
        let record = bench(&gpu, &plan, &|| false, |_| (), |_| ());
        assert!(record.complete && record.trainings.is_empty() && record.times.is_empty(), "{record:?}");
        let expected = ["2 steps at 33 x 20 with 60 Gaussians", "times at 33 x 20"];
        assert!(record.left_out == expected && !record.twins.is_empty(), "{record:?}");
        let record = bench(&gpu, &plan, &|| true, |_| (), |_| ());
        assert!(!record.complete && record.left_out.is_empty() && record.twins.is_empty(), "{record:?}");
    }

    #[test]
    fn a_record_has_all_its_parts() {
        let Some(gpu) = software() else { return };
        let plan = BenchPlan { long: Some(5), ..plan() };
        let (mut told, mut kept) = (Vec::new(), 0);
        let tell = |what: &str| told.push(what.to_string());
        let record = bench(&gpu, &plan, &|| false, tell, |_| kept += 1);
        assert!(record.failed.is_empty() && record.complete && kept == 7, "{kept} {record:?}");
        assert!(
            record.check.as_ref().is_some_and(|check| check.passed)
                && record.determinism.iter().all(|runs| runs.same),
            "{record:?}"
        );
        assert_eq!(record.determinism.len(), 2, "both variants");
        let ceilings = record.ceilings.unwrap();
        assert!(ceilings.copy_gigabytes_per_second > 0.0 && ceilings.copied_bytes == 1 << 20, "{record:?}");
        assert!(record.twins.iter().all(|twin| twin.holds), "{record:?}");
        let kernels = &record.times[0].kernels;
        assert!(kernels.contains_key("gather") && kernels["weigh"].dispatches == 1, "{kernels:?}");
        let [training] = &record.trainings[..] else { panic!("one training") };
        assert!(
            training.steps_per_second > 0.0 && training.loss.iter().all(|loss| *loss > 0.0),
            "{record:?}"
        );
        assert_eq!((training.submits_per_step, training.kernels["update"].dispatches), (1.0, 5));
        // The portable variant, and those with one, two and four pixels per thread.
        assert_eq!(training.backward_milliseconds.len(), 4, "{training:?}");
        let (busy, idle) = (training.busy_milliseconds_per_step.unwrap(), training.idle_share.unwrap());
        assert!(busy > 0.0 && busy <= 1e3 / training.steps_per_second, "{training:?}");
        assert!((0.0..1.0).contains(&idle), "{training:?}");
        assert!(training.refinement_milliseconds.is_some_and(|time| time > 0.0), "{training:?}");
        let enhancement = training.enhancement.as_ref().unwrap();
        assert!(enhancement.steps == 5 && enhancement.steps_per_second > 0.0, "{enhancement:?}");
        assert!(enhancement.loss.iter().all(|loss| *loss > 0.0), "{enhancement:?}");
        let view = training.view.unwrap();
        assert!(view.visible > 0 && view.visible <= 60 && view.entries > 0, "{view:?}");
        assert!(0.0 < view.live_per_pixel && view.live_per_pixel <= view.tested_per_pixel, "{view:?}");
        let needs = &training.roofline;
        assert!(needs.contains_key("backward") && needs.values().all(|need| need.share > 0.0), "{needs:?}");
        assert!(training.dispatches_per_step.is_some_and(|n| n <= 60.0), "{training:?}");
        assert!(record.left_out.is_empty() && record.compiled["update"].texts == 1, "{record:?}");
        assert!(record.twins.iter().any(|twin| twin.what.contains("at 33 x 20, 60 Gaussians")), "{record:?}");
        assert!(told.len() == 8 && serde_json::to_string(&record).unwrap().contains("llvmpipe"));
    }
}
