//! One run that says what there is to know of an adapter: its limits, whether its kernels agree with the
//! processor, whether they give the same bits each time, how long they take, and how many steps of a training
//! it does in a second. No network, minutes at most; the record is one document.

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::Instant;

use serde::Serialize;
use use3d_reconstruct::engine::{Diagnostics, Engine, TrainingState};
use use3d_training::{Drain, EngineError};

use crate::ceilings::{Ceilings, measure, need};
use crate::check::check;
use crate::device::{AdapterReport, Gpu};
use crate::profile::KernelTime;
use crate::stage1::{Stage1, ViewWork};
use crate::twins::{self, Agreement, LossCase, Packed, WaterCase};

/// What is run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BenchPlan {
    /// Sizes of views that kernels are timed at.
    pub sizes: Vec<(usize, usize)>,
    /// Times that each size is run; the first one warms up.
    pub rounds: usize,
    /// Numbers of Gaussians that trainings have at each size.
    pub gaussians: Vec<usize>,
    /// Steps of each training that are timed; as many as there are views warm up.
    pub steps: u64,
    /// Bytes that are copied at once to find out how fast it goes.
    pub copied: u64,
}

/// The record.
#[derive(Clone, Debug, Serialize)]
pub struct BenchRecord {
    /// What the file is.
    pub format: &'static str,
    /// Of its form.
    pub version: u32,
    /// The adapter.
    pub adapter: AdapterRecord,
    /// Which variant of the kernels its trainings take.
    pub variant: String,
    /// What the check at the start says.
    pub check: CheckRecord,
    /// What it does at best.
    pub ceilings: CeilingsRecord,
    /// Kernels beside the processor's functions, and whole steps in every variant.
    pub twins: Vec<TwinRecord>,
    /// Whether three runs give the same bits, in every variant.
    pub determinism: Vec<DeterminismRecord>,
    /// Kernels' times by the device's clock, where it has one that can be read between dispatches.
    pub times: Vec<TimesRecord>,
    /// Trainings of stage 1 on packed scenes: every size with every number of Gaussians.
    pub trainings: Vec<TrainingRecord>,
    /// Seconds that all of it took.
    pub seconds: f64,
}

/// A training of stage 1, everything switched on.
#[derive(Clone, Debug, Serialize)]
pub struct TrainingRecord {
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Gaussians.
    pub gaussians: usize,
    /// Steps that were timed.
    pub steps: u64,
    /// Of them in a second, by the processor's clock, reports waited for; without the device's own clock.
    pub steps_per_second: f64,
    /// Mean loss of the first steps that were timed, one of each view, and of the last.
    pub loss: [f64; 2],
    /// Bytes on the device.
    pub bytes: usize,
    /// What is handed to the device in a step.
    pub submits_per_step: f64,
    /// Dispatches of a step; `None` where the device has no clock to count them by.
    pub dispatches_per_step: Option<f64>,
    /// Per kernel, over a few steps more.
    pub kernels: BTreeMap<&'static str, KernelRecord>,
    /// The view of the last of them; `None` where the device has no clock.
    pub view: Option<ViewRecord>,
    /// Per kernel, what a step of that view needs at least.
    pub roofline: BTreeMap<&'static str, RooflineRecord>,
    /// Mean time of the backward pass in every variant, with every number of pixels to a thread, milliseconds.
    pub backward_milliseconds: BTreeMap<String, f64>,
    /// Why there are no figures: the device has too little memory, say.
    pub refusal: Option<String>,
}

/// An adapter and its limits.
#[derive(Clone, Debug, Serialize)]
pub struct AdapterRecord {
    /// Its name.
    pub name: String,
    /// `discrete`, `integrated`, `virtual`, `software` or `other`.
    pub kind: &'static str,
    /// The interface it is reached through.
    pub backend: String,
    /// Name and version of its driver.
    pub driver: String,
    /// Largest buffer that a kernel can see, bytes.
    pub largest_binding_bytes: u64,
    /// Largest buffer, bytes.
    pub largest_buffer_bytes: u64,
    /// Memory that the threads of a workgroup share, bytes.
    pub workgroup_memory_bytes: u32,
    /// Buffers that a kernel can see.
    pub buffers_per_kernel: u32,
    /// Least and most threads that run in step.
    pub subgroup_threads: [u32; 2],
}

impl From<&AdapterReport> for AdapterRecord {
    fn from(report: &AdapterReport) -> Self {
        Self {
            name: report.name.clone(),
            kind: report.kind,
            backend: report.backend.clone(),
            driver: report.driver.clone(),
            largest_binding_bytes: report.binding,
            largest_buffer_bytes: report.buffer,
            workgroup_memory_bytes: report.workgroup,
            buffers_per_kernel: report.buffers,
            subgroup_threads: report.subgroup,
        }
    }
}

/// The check at the start.
#[derive(Clone, Debug, Serialize)]
pub struct CheckRecord {
    /// Whether the adapter passed.
    pub passed: bool,
    /// Why not.
    pub refusal: Option<String>,
    /// Seconds it took, kernels compiled included.
    pub seconds: f64,
}

/// One comparison.
#[derive(Clone, Debug, Serialize)]
pub struct TwinRecord {
    /// The case, by its numbers.
    pub case: String,
    /// Of what.
    pub what: String,
    /// How far apart; `None` where a value is not finite.
    pub error: Option<f64>,
    /// The most it may be.
    pub bar: f64,
    /// Whether it holds.
    pub holds: bool,
}

/// Three runs of the same work.
#[derive(Clone, Debug, Serialize)]
pub struct DeterminismRecord {
    /// In which variant.
    pub variant: String,
    /// A digest of each run's bits.
    pub digests: Vec<String>,
    /// Whether they are one.
    pub same: bool,
}

/// Kernels at one size.
#[derive(Clone, Debug, Serialize)]
pub struct TimesRecord {
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Per kernel.
    pub kernels: BTreeMap<&'static str, KernelRecord>,
}

/// What a device does at best, by two kernels that do nothing else.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct CeilingsRecord {
    /// Bytes read and written in a second by a copy, 10⁹.
    pub copy_gigabytes_per_second: f64,
    /// Operations in a second by multiply-adds in single precision, two each, 10⁹.
    pub multiply_add_gigaflops: f64,
}

impl From<Ceilings> for CeilingsRecord {
    fn from(Ceilings { bytes, flops }: Ceilings) -> Self {
        Self { copy_gigabytes_per_second: 1e-9 * bytes, multiply_add_gigaflops: 1e-9 * flops }
    }
}

/// How much there is to do in a view.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ViewRecord {
    /// Gaussians on the screen.
    pub visible: usize,
    /// (tile, Gaussian) entries.
    pub entries: usize,
    /// Gaussians that a pixel looks at before it stops, mean.
    pub tested_per_pixel: f64,
    /// Of them, those with a part in it.
    pub live_per_pixel: f64,
}

impl From<&ViewWork> for ViewRecord {
    fn from(work: &ViewWork) -> Self {
        let per_pixel = |pairs: u64| pairs as f64 / work.pixels.max(1) as f64;
        Self {
            visible: work.visible,
            entries: work.entries,
            tested_per_pixel: per_pixel(work.tested),
            live_per_pixel: per_pixel(work.live),
        }
    }
}

/// A kernel beside what it needs at least.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct RooflineRecord {
    /// Bytes of a step, every buffer once, 10⁶.
    pub megabytes: f64,
    /// Operations of a step, 10⁶.
    pub megaflops: f64,
    /// Least milliseconds for these, by what the device does at best.
    pub least_milliseconds: f64,
    /// That over the time that the kernel took; a buffer that stays in the device's caches can bring it above 1.
    pub share: f64,
}

/// One kernel.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct KernelRecord {
    /// Dispatches that were timed.
    pub dispatches: u64,
    /// Mean time of one, milliseconds.
    pub milliseconds: f64,
}

fn cases(width: usize, height: usize) -> (LossCase, WaterCase) {
    (
        LossCase { width, height, seed: 3, mask: true, prior: true, gains: true },
        WaterCase { width, height, seed: 3, anchors: 8, top_k: 4, degree: 3 },
    )
}

/// What one size's kernels say, with the case that each belongs to.
fn run_twins(gpu: &Gpu, size: (usize, usize)) -> Result<Vec<(String, Agreement)>, EngineError> {
    let (loss, water) = cases(size.0, size.1);
    let mut all: Vec<_> = twins::losses(gpu, &loss)?.into_iter().map(|a| (format!("{loss:?}"), a)).collect();
    all.extend(twins::water(gpu, &water)?.into_iter().map(|a| (format!("{water:?}"), a)));
    Ok(all)
}

/// Views of a training here.
const VIEWS: usize = 4;
/// Seconds that a measurement of what a device does at best takes at least.
const LEAST: f64 = 0.02;
/// Steps whose kernels are timed by the device's clock.
const PROFILED: u64 = 20;

/// Stage 1 on a packed scene, a step of each view done.
fn begun(gpu: &Gpu, scene: &Packed) -> Result<Stage1, EngineError> {
    let mut engine = Stage1::new(gpu)?;
    for view in scene.training_views()? {
        engine.upload(view)?;
    }
    engine.load(scene.state())?;
    go_on(&mut engine, scene, 0..scene.views as u64)?;
    Ok(engine)
}

/// Losses of some steps, waited for.
fn go_on(engine: &mut Stage1, scene: &Packed, steps: Range<u64>) -> Result<Vec<f64>, EngineError> {
    for step in steps {
        engine.step((step % scene.views.max(1) as u64) as usize, &Packed::plan(step))?;
    }
    let reports = engine.drain(Drain::All)?;
    match reports.iter().find_map(|report| report.non_finite) {
        Some((what, _)) => {
            Err(EngineError::Failed(format!("{what} of a packed scene are not finite").into()))
        }
        None => Ok(reports.into_iter().map(|report| report.loss).collect()),
    }
}

/// Everything that a training has, as bits.
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

/// Means over the kernels' dispatches.
fn kernel_records(times: BTreeMap<&'static str, KernelTime>) -> BTreeMap<&'static str, KernelRecord> {
    let record = |time: KernelTime| KernelRecord {
        dispatches: time.dispatches,
        milliseconds: 1e3 * time.seconds / time.dispatches.max(1) as f64,
    };
    times.into_iter().map(|(name, time)| (name, record(time))).collect()
}

/// Kernels of `steps` steps beside what they need at least.
fn roofline(
    kernels: &BTreeMap<&'static str, KernelRecord>,
    steps: u64,
    work: &ViewWork,
    ceilings: &Ceilings,
) -> BTreeMap<&'static str, RooflineRecord> {
    let record = |(name, kernel): (&&'static str, &KernelRecord)| {
        let needed = need(name, work)?;
        let least = 1e3 * ceilings.least(needed);
        let taken = kernel.milliseconds * kernel.dispatches as f64 / steps.max(1) as f64;
        let [bytes, flops] = needed;
        let share = if taken > 0.0 { least / taken } else { 0.0 };
        let record = RooflineRecord {
            megabytes: 1e-6 * bytes,
            megaflops: 1e-6 * flops,
            least_milliseconds: least,
            share,
        };
        Some((*name, record))
    };
    kernels.iter().filter_map(record).collect()
}

/// Trains on a packed scene: first against the processor's clock, then with the device's.
fn train(gpu: &Gpu, scene: &Packed, steps: u64, ceilings: &Ceilings) -> Result<TrainingRecord, EngineError> {
    let views = scene.views as u64;
    let mut engine = begun(gpu, scene)?;
    let (started, submits) = (Instant::now(), gpu.submits());
    for step in views..views + steps {
        engine.step((step % views.max(1)) as usize, &Packed::plan(step))?;
    }
    let submits = gpu.submits() - submits;
    let losses = go_on(&mut engine, scene, 0..0)?;
    let seconds = started.elapsed().as_secs_f64();
    let mean = |losses: &[f64]| losses.iter().sum::<f64>() / losses.len().max(1) as f64;
    let few = scene.views.min(losses.len());
    let bytes = engine.memory();
    drop(engine);

    let profiled = steps.min(PROFILED);
    let profile = |variant| {
        let timed = gpu.clone().with(variant).timed();
        let mut engine = begun(&timed, scene)?;
        timed.read_times(&mut BTreeMap::new())?;
        let mut times = BTreeMap::new();
        for step in views..views + profiled {
            go_on(&mut engine, scene, step..step + 1)?;
            timed.read_times(&mut times)?;
        }
        let work = engine.last_view([scene.width, scene.height])?;
        Ok::<_, EngineError>((times, work))
    };
    let (times, work) = profile(gpu.variant())?;
    let dispatches: u64 = times.values().map(|time| time.dispatches).sum();
    let kernels = kernel_records(times);
    let mut backward_milliseconds = BTreeMap::new();
    for variant in gpu.trials() {
        let own = if variant == gpu.variant() { None } else { Some(kernel_records(profile(variant)?.0)) };
        if let Some(record) = own.as_ref().unwrap_or(&kernels).get("backward") {
            backward_milliseconds.insert(variant.to_string(), record.milliseconds);
        }
    }
    Ok(TrainingRecord {
        size: [scene.width, scene.height],
        gaussians: scene.gaussians,
        steps,
        steps_per_second: steps as f64 / seconds,
        loss: [mean(&losses[..few]), mean(&losses[losses.len() - few..])],
        bytes,
        submits_per_step: submits as f64 / steps.max(1) as f64,
        dispatches_per_step: (dispatches > 0).then(|| dispatches as f64 / profiled.max(1) as f64),
        view: (dispatches > 0).then(|| (&work).into()),
        roofline: roofline(&kernels, profiled, &work, ceilings),
        kernels,
        backward_milliseconds,
        refusal: None,
    })
}

/// Runs all of it; `tell` hears what is under way.
pub fn bench(gpu: &Gpu, plan: &BenchPlan, mut tell: impl FnMut(&str)) -> Result<BenchRecord, EngineError> {
    let started = Instant::now();
    tell("check");
    let said = check(gpu);
    let check = CheckRecord {
        passed: said.is_ok(),
        refusal: said.err().map(|e| e.to_string()),
        seconds: started.elapsed().as_secs_f64(),
    };

    tell("what it does at best");
    let ceilings = measure(gpu, plan.copied, LEAST)?;
    tell("kernels beside the processor's functions");
    let mut found = Vec::new();
    for size in [(61, 47), (96, 64), (257, 33)] {
        found.extend(run_twins(gpu, size)?);
    }
    for variant in gpu.trials() {
        let scene = Packed { width: 61, height: 47, gaussians: 600, views: 2, seed: 3 };
        let mut engine = Stage1::new(&gpu.clone().with(variant))?;
        let case = format!("step, {variant}, {scene:?}");
        found.extend(twins::step(&mut engine, &scene)?.into_iter().map(|a| (case.clone(), a)));
    }
    let record = |(case, agreement): (String, Agreement)| {
        let holds = agreement.holds();
        let Agreement { what, error, bar, .. } = agreement;
        TwinRecord { case, what, error: error.is_finite().then_some(error), bar, holds }
    };
    let twins = found.into_iter().map(record).collect();

    tell("the same bits three times");
    let mut determinism = Vec::new();
    for variant in gpu.variants() {
        let gpu = gpu.clone().with(variant);
        let mut digests = Vec::new();
        for _ in 0..3 {
            let mut hasher = blake3::Hasher::new();
            for (case, agreement) in run_twins(&gpu, (96, 64))? {
                hasher.update(case.as_bytes());
                hasher.update(&agreement.digest);
            }
            let scene = Packed { width: 96, height: 64, gaussians: 2000, views: 3, seed: 5 };
            let mut engine = begun(&gpu, &scene)?;
            go_on(&mut engine, &scene, 3..12)?;
            hasher.update(digest(engine.save()?.as_ref()).as_bytes());
            digests.push(hasher.finalize().to_hex().to_string());
        }
        let same = digests.iter().all(|digest| *digest == digests[0]);
        determinism.push(DeterminismRecord { variant: variant.to_string(), digests, same });
    }

    let timed = gpu.clone().timed();
    let mut times = Vec::new();
    for &(width, height) in &plan.sizes {
        tell(&format!("times at {width} x {height}"));
        let mut kernels = BTreeMap::new();
        for round in 0..plan.rounds.max(2) {
            run_twins(&timed, (width, height))?;
            let mut own = BTreeMap::new();
            timed.read_times(&mut own)?;
            if round > 0 {
                for (name, time) in own {
                    let all: &mut KernelTime = kernels.entry(name).or_default();
                    all.dispatches += time.dispatches;
                    all.seconds += time.seconds;
                }
            }
        }
        times.push(TimesRecord { size: [width, height], kernels: kernel_records(kernels) });
    }

    let mut trainings = Vec::new();
    for &(width, height) in &plan.sizes {
        for &gaussians in &plan.gaussians {
            tell(&format!("{} steps at {width} x {height} with {gaussians} Gaussians", plan.steps));
            let scene = Packed { width, height, gaussians, views: VIEWS, seed: 7 };
            trainings.push(match train(gpu, &scene, plan.steps, &ceilings) {
                // The others may fit.
                Err(error @ EngineError::OutOfMemory { .. }) => TrainingRecord {
                    size: [width, height],
                    gaussians,
                    steps: 0,
                    steps_per_second: 0.0,
                    loss: [0.0; 2],
                    bytes: 0,
                    submits_per_step: 0.0,
                    dispatches_per_step: None,
                    kernels: BTreeMap::new(),
                    view: None,
                    roofline: BTreeMap::new(),
                    backward_milliseconds: BTreeMap::new(),
                    refusal: Some(error.to_string()),
                },
                trained => trained?,
            });
        }
    }
    Ok(BenchRecord {
        format: "3d-use gpu bench",
        version: 4,
        adapter: gpu.adapter().into(),
        variant: gpu.variant().to_string(),
        check,
        ceilings: ceilings.into(),
        twins,
        determinism,
        times,
        trainings,
        seconds: started.elapsed().as_secs_f64(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::software;

    #[test]
    fn a_record_has_all_its_parts() {
        let Some(gpu) = software() else { return };
        let plan =
            BenchPlan { sizes: vec![(33, 20)], rounds: 2, gaussians: vec![60], steps: 5, copied: 1 << 20 };
        let mut told = Vec::new();
        let record = bench(&gpu, &plan, |what| told.push(what.to_string())).unwrap();
        assert!(record.check.passed && record.determinism.iter().all(|runs| runs.same), "{record:?}");
        assert_eq!(record.determinism.len(), 2, "both variants");
        assert!(record.ceilings.copy_gigabytes_per_second > 0.0, "{record:?}");
        assert!(record.twins.iter().all(|twin| twin.holds), "{record:?}");
        let kernels = &record.times[0].kernels;
        assert!(kernels.contains_key("gather") && kernels["weigh"].dispatches == 1, "{kernels:?}");
        let [training] = &record.trainings[..] else { panic!("one training") };
        assert!(
            training.steps_per_second > 0.0 && training.loss.iter().all(|loss| *loss > 0.0),
            "{record:?}"
        );
        assert_eq!((training.submits_per_step, training.kernels["update"].dispatches), (1.0, 5));
        // The portable one, and one, two and four pixels to a thread.
        assert_eq!(training.backward_milliseconds.len(), 4, "{training:?}");
        let view = training.view.unwrap();
        assert!(view.visible > 0 && view.visible <= 60 && view.entries > 0, "{view:?}");
        assert!(0.0 < view.live_per_pixel && view.live_per_pixel <= view.tested_per_pixel, "{view:?}");
        let needs = &training.roofline;
        assert!(needs.contains_key("backward") && needs.values().all(|need| need.share > 0.0), "{needs:?}");
        assert!(training.dispatches_per_step.is_some_and(|n| n <= 60.0), "{training:?}");
        assert!(told.len() == 6 && serde_json::to_string(&record).unwrap().contains("llvmpipe"));
    }
}
