//! What one run of the benchmark writes down.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::ceilings::Ceilings;
use crate::device::AdapterReport;
use crate::stage1::ViewWork;

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
    pub check: Option<CheckRecord>,
    /// What it does at best.
    pub ceilings: Option<CeilingsRecord>,
    /// Kernels beside the processor's functions, and whole steps in every variant.
    pub twins: Vec<TwinRecord>,
    /// Whether three runs give the same bits, in every variant.
    pub determinism: Vec<DeterminismRecord>,
    /// Kernels' times by the device's clock, where it has one that can be read between dispatches.
    pub times: Vec<TimesRecord>,
    /// Trainings of stage 1 on packed scenes: every size with every number of Gaussians.
    pub trainings: Vec<TrainingRecord>,
    /// What could not be done; where the device was lost, the last of these, after which nothing was tried.
    pub failed: Vec<FailedRecord>,
    /// Whether everything was tried; a file of a run that is under way or was cut off says no.
    pub complete: bool,
    /// Seconds that all of it took.
    pub seconds: f64,
}

/// A part of the benchmark that failed.
#[derive(Clone, Debug, Serialize)]
pub struct FailedRecord {
    /// Which.
    pub section: String,
    /// Why.
    pub why: String,
}

/// A training of stage 1, everything switched on, and one of stage 2 on the scene that it began with.
#[derive(Clone, Debug, Default, Serialize)]
pub struct TrainingRecord {
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Gaussians.
    pub gaussians: usize,
    /// Steps that were timed.
    pub steps: u64,
    /// Of them in a second, by the processor's clock, reports waited for; without the device's own clock.
    pub steps_per_second: f64,
    /// Time of the same steps in which the device was at work by its own clock, per step, milliseconds; `None`
    /// where it has none.
    pub busy_milliseconds_per_step: Option<f64>,
    /// The share of the same steps' time in which it was not.
    pub idle_share: Option<f64>,
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
    /// A refinement that replaces every twentieth Gaussian by two: survey and rebuilt scene, by the processor's
    /// clock, milliseconds.
    pub refinement_milliseconds: Option<f64>,
    /// The training of stage 2.
    pub enhancement: Option<EnhancementRecord>,
    /// Why figures are missing, all or those of kernels: the device has too little memory, say.
    pub refusal: Option<String>,
}

/// A training of stage 2 with transition targets, whose extractor is on the processor.
#[derive(Clone, Debug, Serialize)]
pub struct EnhancementRecord {
    /// Steps that were timed.
    pub steps: u64,
    /// Of them in a second, by the processor's clock.
    pub steps_per_second: f64,
    /// Mean loss of the first steps that were timed, one of each view, and of the last.
    pub loss: [f64; 2],
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
    /// Bytes that were copied at once: fewer where memory was short.
    pub copied_bytes: u64,
}

impl From<Ceilings> for CeilingsRecord {
    fn from(Ceilings { bytes, flops, copied }: Ceilings) -> Self {
        Self {
            copy_gigabytes_per_second: 1e-9 * bytes,
            multiply_add_gigaflops: 1e-9 * flops,
            copied_bytes: copied,
        }
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
