//! One run that says what there is to know of an adapter: its limits, whether its kernels agree with the processor, whether they give the
//! same bits each time, and how long they take. No network, minutes at most; the record is one document.

use std::collections::BTreeMap;
use std::time::Instant;

use serde::Serialize;
use use3d_training::EngineError;

use crate::check::check;
use crate::device::{AdapterReport, Gpu};
use crate::profile::KernelTime;
use crate::twins::{self, Agreement, LossCase, WaterCase};

/// What is run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BenchPlan {
    /// Sizes of views that kernels are timed at.
    pub sizes: Vec<(usize, usize)>,
    /// Times that each size is run; the first one warms up.
    pub rounds: usize,
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
    /// What the check at the start says.
    pub check: CheckRecord,
    /// Kernels beside the processor's functions.
    pub twins: Vec<TwinRecord>,
    /// Whether three runs give the same bits.
    pub determinism: DeterminismRecord,
    /// Kernels' times by the device's clock, where it has one that can be read between dispatches.
    pub times: Vec<TimesRecord>,
    /// Seconds that all of it took.
    pub seconds: f64,
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

    tell("kernels beside the processor's functions");
    let mut twins = Vec::new();
    for size in [(61, 47), (96, 64), (257, 33)] {
        for (case, agreement) in run_twins(gpu, size)? {
            let holds = agreement.holds();
            let Agreement { what, error, bar, .. } = agreement;
            twins.push(TwinRecord { case, what, error: error.is_finite().then_some(error), bar, holds });
        }
    }

    tell("the same bits three times");
    let mut digests = Vec::new();
    for _ in 0..3 {
        let mut hasher = blake3::Hasher::new();
        for (case, agreement) in run_twins(gpu, (96, 64))? {
            hasher.update(case.as_bytes());
            hasher.update(&agreement.digest);
        }
        digests.push(hasher.finalize().to_hex().to_string());
    }
    let same = digests.iter().all(|digest| *digest == digests[0]);

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
        let record = |time: KernelTime| KernelRecord {
            dispatches: time.dispatches,
            milliseconds: 1e3 * time.seconds / time.dispatches.max(1) as f64,
        };
        let kernels = kernels.into_iter().map(|(name, time)| (name, record(time))).collect();
        times.push(TimesRecord { size: [width, height], kernels });
    }
    Ok(BenchRecord {
        format: "3d-use gpu bench",
        version: 1,
        adapter: gpu.adapter().into(),
        check,
        twins,
        determinism: DeterminismRecord { digests, same },
        times,
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
        let plan = BenchPlan { sizes: vec![(33, 20)], rounds: 2 };
        let mut told = Vec::new();
        let record = bench(&gpu, &plan, |what| told.push(what.to_string())).unwrap();
        assert!(record.check.passed && record.determinism.same, "{record:?}");
        assert!(record.twins.iter().all(|twin| twin.holds), "{record:?}");
        let kernels = &record.times[0].kernels;
        assert!(kernels.contains_key("gather") && kernels["weigh"].dispatches == 1, "{kernels:?}");
        assert!(told.len() == 4 && serde_json::to_string(&record).unwrap().contains("llvmpipe"));
    }
}
