//! One run that says what there is to know of an adapter: its limits, whether its kernels agree with the
//! processor, whether they give the same bits each time, how long they take, and how many steps of a training
//! it does in a second. No network, minutes at most; the record is one document.

mod records;

use std::collections::BTreeMap;
use std::ops::Range;
use std::time::Instant;

use use3d_reconstruct::engine::{Diagnostics, Engine, TrainingState};
use use3d_training::{Drain, EngineError};

use crate::ceilings::{Ceilings, measure, need};
use crate::check::check;
use crate::device::Gpu;
use crate::profile::KernelTime;
use crate::stage1::{Stage1, ViewWork};
use crate::twins::{self, Agreement, LossCase, Packed, WaterCase};
pub use records::{
    AdapterRecord, BenchRecord, CeilingsRecord, CheckRecord, DeterminismRecord, KernelRecord, RooflineRecord,
    TimesRecord, TrainingRecord, TwinRecord, ViewRecord,
};

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
        Ok::<_, EngineError>((times, engine))
    };
    let (times, engine) = profile(gpu.variant())?;
    let work = engine.last_view([scene.width, scene.height])?;
    drop(engine);
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
