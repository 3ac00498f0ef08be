//! The record of one run of the benchmark.

use std::collections::BTreeMap;

use serde::Serialize;
use use3d_gpu::AdapterReport;

/// The record.
#[derive(Clone, Debug, Default, Serialize)]
pub struct BenchRecord {
    /// The name of the file's format.
    pub format: &'static str,
    /// The version of the format.
    pub version: u32,
    /// The adapter.
    pub adapter: AdapterReport,
    /// The description of NVIDIA's driver by itself, if there is one.
    pub driver_text: Option<String>,
    /// The width of the subgroups with which kernels run; `None` if there is no such width.
    pub subgroup_width: Option<u32>,
    /// The variant of the kernels that its trainings use.
    pub variant: String,
    /// The result of the check at the start.
    pub check: Option<CheckRecord>,
    /// The kernels that the check compiled, by name.
    pub compiled: BTreeMap<&'static str, CompiledRecord>,
    /// The highest rates of the device.
    pub ceilings: Option<CeilingsRecord>,
    /// Comparisons of kernels with the processor's functions, and of whole steps in every variant.
    pub twins: Vec<TwinRecord>,
    /// Comparisons of the bits of three runs, in every variant.
    pub determinism: Vec<DeterminismRecord>,
    /// Times of the kernels by the device's clock, if it has one that can be read between dispatches.
    pub times: Vec<TimesRecord>,
    /// Trainings of stage 1 on packed scenes: every size with every number of Gaussians.
    pub trainings: Vec<TrainingRecord>,
    /// The parts that failed; if the device was lost, the last of these, after which nothing was tried.
    pub failed: Vec<FailedRecord>,
    /// The parts for which there was no time.
    pub left_out: Vec<String>,
    /// True if everything was tried for which there was time; false in the file of a running or interrupted
    /// benchmark.
    pub complete: bool,
    /// Duration of the whole run, seconds.
    pub seconds: f64,
}

/// The compilation of the kernels of one name.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct CompiledRecord {
    /// Number of different texts.
    pub texts: u32,
    /// Time of all of them, each by the clock of its thread, milliseconds.
    pub milliseconds: f64,
}

/// A part of the benchmark that failed.
#[derive(Clone, Debug, Serialize)]
pub struct FailedRecord {
    /// The part.
    pub section: String,
    /// The reason.
    pub why: String,
}

/// A training of stage 1 with all features on, and one of stage 2 on its initial scene.
#[derive(Clone, Debug, Default, Serialize)]
pub struct TrainingRecord {
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Number of timed steps.
    pub steps: u64,
    /// These steps per second, by the processor's clock, including the wait for reports.
    pub steps_per_second: f64,
    /// Time of the same steps in which the device worked, by its own clock, per step, milliseconds; `None`
    /// if it has no clock.
    pub busy_milliseconds_per_step: Option<f64>,
    /// The share of the same steps' time in which the device was idle.
    pub idle_share: Option<f64>,
    /// Mean loss of the first timed steps, one of each view, and of the last ones.
    pub loss: [f64; 2],
    /// Number of bytes on the device.
    pub bytes: usize,
    /// Number of submits per step.
    pub submits_per_step: f64,
    /// Number of dispatches per step; `None` if the device has no clock to count them.
    pub dispatches_per_step: Option<f64>,
    /// Record of each kernel, over a few more steps.
    pub kernels: BTreeMap<&'static str, KernelRecord>,
    /// The view of the last of these steps; `None` if the device has no clock.
    pub view: Option<ViewRecord>,
    /// Smallest possible time of each kernel in a step of that view.
    pub roofline: BTreeMap<&'static str, RooflineRecord>,
    /// Mean time of the backward pass in every variant, with every number of pixels per thread,
    /// milliseconds.
    pub backward_milliseconds: BTreeMap<String, f64>,
    /// Time of a refinement that replaces every twentieth Gaussian by two: survey and rebuilt scene, by the
    /// processor's clock, milliseconds.
    pub refinement_milliseconds: Option<f64>,
    /// The training of stage 2.
    pub enhancement: Option<EnhancementRecord>,
    /// The reason why all numbers, or those of kernels, are missing, for example too little memory on the
    /// device.
    pub refusal: Option<String>,
}

/// A training of stage 2 with transition targets, whose extractor runs on the processor.
#[derive(Clone, Debug, Serialize)]
pub struct EnhancementRecord {
    /// Number of timed steps.
    pub steps: u64,
    /// These steps per second, by the processor's clock.
    pub steps_per_second: f64,
    /// Mean loss of the first timed steps, one of each view, and of the last ones.
    pub loss: [f64; 2],
}

/// The check at the start.
#[derive(Clone, Debug, Serialize)]
pub struct CheckRecord {
    /// True if the adapter passed.
    pub passed: bool,
    /// The reason why it did not pass.
    pub refusal: Option<String>,
    /// Duration in seconds, including the compilation of kernels.
    pub seconds: f64,
}

/// One comparison.
#[derive(Clone, Debug, Serialize)]
pub struct TwinRecord {
    /// The case, described by its numbers.
    pub case: String,
    /// The compared quantity.
    pub what: String,
    /// The difference; `None` if a value is not finite.
    pub error: Option<f64>,
    /// The largest allowed difference.
    pub bar: f64,
    /// True if the difference is allowed.
    pub holds: bool,
}

/// Three runs of the same work.
#[derive(Clone, Debug, Serialize)]
pub struct DeterminismRecord {
    /// The variant of the kernels.
    pub variant: String,
    /// A digest of each run's bits.
    pub digests: Vec<String>,
    /// True if all digests are equal.
    pub same: bool,
}

/// Kernels at one size.
#[derive(Clone, Debug, Serialize)]
pub struct TimesRecord {
    /// Pixels across and down.
    pub size: [usize; 2],
    /// Record of each kernel.
    pub kernels: BTreeMap<&'static str, KernelRecord>,
}

/// The highest rates of a device, measured by two kernels that do nothing else.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct CeilingsRecord {
    /// Bytes read and written per second by a copy, 10⁹.
    pub copy_gigabytes_per_second: f64,
    /// Operations per second by multiply-adds in single precision, two operations each, 10⁹.
    pub multiply_add_gigaflops: f64,
    /// Number of bytes copied at once; fewer if memory was short.
    pub copied_bytes: u64,
}

/// The amount of work in a view.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ViewRecord {
    /// Number of Gaussians on the screen.
    pub visible: usize,
    /// Number of (tile, Gaussian) entries.
    pub entries: usize,
    /// Mean number of Gaussians that a pixel tests before it stops.
    pub tested_per_pixel: f64,
    /// Mean number of these that contribute to the pixel.
    pub live_per_pixel: f64,
    /// Number of entries of the longest list of a tile.
    pub longest_list: usize,
    /// The largest number of Gaussians that a pixel tests.
    pub deepest_pixel: usize,
}

/// A kernel's smallest possible time, and the share of its measured time.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct RooflineRecord {
    /// Bytes of a step, every buffer once, 10⁶.
    pub megabytes: f64,
    /// Operations of a step, 10⁶.
    pub megaflops: f64,
    /// Smallest possible time for these at the device's highest rates, milliseconds.
    pub least_milliseconds: f64,
    /// This time divided by the measured time; a buffer that stays in the device's caches can bring it
    /// above 1.
    pub share: f64,
}

/// One kernel.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct KernelRecord {
    /// Number of timed dispatches.
    pub dispatches: u64,
    /// Mean time of one dispatch, milliseconds.
    pub milliseconds: f64,
}
