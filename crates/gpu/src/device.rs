//! Which adapters there are, which one is taken, and a device of it.
//!
//! The driver's loader is opened at run time, so the program builds and starts on machines without any.
//! Processors that pretend to be graphics cards (software adapters) are slower than the engine for processors
//! and are taken only when they are asked for by name.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use use3d_training::EngineError;

use crate::profile::{self, Clock, Timed};
use crate::scene::{COLORS, Row, SPLAT};
use crate::variant::Variant;

/// The engine's name in messages.
pub(crate) const NAME: &str = "gpu";

/// What every adapter must offer at least.
const STORAGE_BUFFERS: u32 = 16;
const WORKGROUP_BYTES: u32 = 20 * 1024;
const BINDING_BYTES: u64 = 128 << 20;

/// Bytes that wgpu takes of a device at once when it is opened, at most: a block of its allocator for buffers
/// and one for what passes through main memory.
const OPENING: u64 = 192 << 20;

/// Why there is no device.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DeviceError {
    /// Nothing to choose from.
    #[error("{NOTHING}")]
    None,
    /// Only software adapters, and none was named.
    #[error(
        "no graphics card was found, only software adapters: {}; name one to use it all the same (`--engine gpu:{}`), or use the processor (`--engine cpu`)", .found.join(", "), first_word(.found)
    )]
    OnlySoftware {
        /// Their names.
        found: Vec<String>,
    },
    /// No adapter has such a name.
    #[error("no adapter's name has `{name}` in it{}", others(.found))]
    Named {
        /// What was asked for.
        name: String,
        /// The adapters' names.
        found: Vec<String>,
    },
    /// An adapter that cannot run the kernels.
    #[error(
        "the adapter `{adapter}` has {found} {what}, {needed} are needed; update its driver or use another engine"
    )]
    Limit {
        /// Its name.
        adapter: String,
        /// Of what it has too little.
        what: &'static str,
        /// How much it has.
        found: u64,
        /// How much is needed.
        needed: u64,
    },
    /// The driver did not open it.
    #[error(
        "the adapter `{adapter}` could not be opened: {reason}; free some of its memory if that is short (opening takes up to {} MiB of it), update its driver, or use another engine", OPENING >> 20
    )]
    Open {
        /// Its name.
        adapter: String,
        /// What the driver said.
        reason: String,
    },
    /// Several were tried.
    #[error("{}", listed(.0))]
    Several(Vec<DeviceError>),
}

/// What is said where no adapter answers.
const NOTHING: &str = "no graphics card was found: neither Vulkan's loader (`libvulkan.so.1`, package `libvulkan1`) nor another driver answered; install the card's driver, or use the processor (`--engine cpu`)";

/// The adapters that there are instead of one that was named.
fn others(found: &[String]) -> String {
    if found.is_empty() { format!(": {NOTHING}") } else { format!("; there are: {}", found.join(", ")) }
}

/// Why each of several adapters is not to be used.
pub(crate) fn listed(refusals: &[impl std::fmt::Display]) -> String {
    let each = refusals.iter().zip(1..).map(|(refusal, at)| format!("({at}) {refusal}"));
    let each: Vec<String> = each.collect();
    format!("none of {} adapters can be used: {}", each.len(), each.join("; "))
}

fn first_word(names: &[String]) -> &str {
    names.first().and_then(|name| name.split_whitespace().next()).unwrap_or("NAME")
}

/// An adapter as a person is told of it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterReport {
    /// Its name.
    pub name: String,
    /// `discrete`, `integrated`, `virtual`, `software` or `other`.
    pub kind: &'static str,
    /// The interface it is reached through, such as `vulkan`.
    pub backend: String,
    /// Name and version of its driver.
    pub driver: String,
    /// Largest buffer that a kernel can see, bytes.
    pub binding: u64,
    /// Largest buffer, bytes.
    pub buffer: u64,
    /// Memory that the threads of a workgroup share, bytes.
    pub workgroup: u32,
    /// Buffers that a kernel can see.
    pub buffers: u32,
    /// Least and most threads that run in step.
    pub subgroup: [u32; 2],
    /// Why it cannot be used, if it cannot.
    pub refusal: Option<DeviceError>,
}

impl AdapterReport {
    fn of(adapter: &wgpu::Adapter) -> Self {
        let (info, limits) = (adapter.get_info(), adapter.limits());
        let kind = match info.device_type {
            wgpu::DeviceType::DiscreteGpu => "discrete",
            wgpu::DeviceType::IntegratedGpu => "integrated",
            wgpu::DeviceType::VirtualGpu => "virtual",
            wgpu::DeviceType::Cpu => "software",
            wgpu::DeviceType::Other => "other",
        };
        let mut report = Self {
            name: info.name,
            kind,
            backend: info.backend.to_string(),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_string(),
            binding: limits.max_storage_buffer_binding_size,
            buffer: limits.max_buffer_size,
            workgroup: limits.max_compute_workgroup_storage_size,
            buffers: limits.max_storage_buffers_per_shader_stage,
            subgroup: [info.subgroup_min_size, info.subgroup_max_size],
            refusal: None,
        };
        report.refusal = report.check().err();
        report
    }

    /// Whether it is a processor.
    pub fn is_software(&self) -> bool {
        self.kind == "software"
    }

    fn check(&self) -> Result<(), DeviceError> {
        for (what, found, needed) in [
            ("storage buffers per kernel", self.buffers.into(), u64::from(STORAGE_BUFFERS)),
            ("bytes of workgroup memory", self.workgroup.into(), u64::from(WORKGROUP_BYTES)),
            ("bytes in the largest binding", self.binding, BINDING_BYTES),
        ] {
            if found < needed {
                return Err(DeviceError::Limit { adapter: self.name.clone(), what, found, needed });
            }
        }
        Ok(())
    }

    /// Cards before chips, chips before what a machine of others lends, software last.
    fn rank(&self) -> usize {
        ["discrete", "integrated", "virtual", "other", "software"]
            .iter()
            .position(|kind| *kind == self.kind)
            .unwrap_or(usize::MAX)
    }
}

fn instance() -> wgpu::Instance {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
    wgpu::Instance::new(descriptor)
}

fn enumerate() -> Vec<(AdapterReport, wgpu::Adapter)> {
    let adapters = pollster::block_on(instance().enumerate_adapters(wgpu::Backends::all()));
    let mut all: Vec<_> = adapters.into_iter().map(|a| (AdapterReport::of(&a), a)).collect();
    all.sort_by_key(|(report, _)| report.rank());
    all
}

/// All adapters of this machine, the likeliest first.
pub fn adapters() -> Vec<AdapterReport> {
    enumerate().into_iter().map(|(report, _)| report).collect()
}

/// Which of some adapters are meant, in the order in which they are tried: those of exactly this name in any
/// case, else those with the name in theirs; without a name all that are no software.
fn order(reports: &[AdapterReport], name: Option<&str>) -> Result<Vec<usize>, DeviceError> {
    let found = || reports.iter().map(|report| report.name.clone()).collect::<Vec<_>>();
    let all = |fits: &dyn Fn(&AdapterReport) -> bool| {
        (0..reports.len()).filter(|at| fits(&reports[*at])).collect::<Vec<_>>()
    };
    let Some(name) = name else {
        let cards = all(&|report| !report.is_software());
        return match (cards.is_empty(), reports.is_empty()) {
            (false, _) => Ok(cards),
            (true, true) => Err(DeviceError::None),
            (true, false) => Err(DeviceError::OnlySoftware { found: found() }),
        };
    };
    let wanted = name.to_lowercase();
    // Else a card whose name begins another's could never be reached.
    let exact = all(&|report| report.name.to_lowercase() == wanted);
    let fitting = if exact.is_empty() { all(&|r| r.name.to_lowercase().contains(&wanted)) } else { exact };
    if fitting.is_empty() {
        return Err(DeviceError::Named { name: name.to_string(), found: found() });
    }
    Ok(fitting)
}

/// The first that can be had, and why those before it cannot; every refusal where none can.
fn first<T, E>(
    order: Vec<usize>,
    mut take: impl FnMut(usize) -> Result<T, E>,
) -> Result<(T, Vec<E>), Vec<E>> {
    let mut refusals = Vec::new();
    for at in order {
        match take(at) {
            Ok(taken) => return Ok((taken, refusals)),
            Err(refusal) => refusals.push(refusal),
        }
    }
    Err(refusals)
}

/// An adapter that may be opened, as often as it takes.
#[derive(Debug)]
pub(crate) struct Found {
    pub(crate) report: AdapterReport,
    adapter: wgpu::Adapter,
}

/// All adapters of this machine, the likeliest first.
pub(crate) fn found() -> Vec<Found> {
    enumerate().into_iter().map(|(report, adapter)| Found { report, adapter }).collect()
}

/// The first of the adapters that are meant by `name` that `take` takes, with what it said of those
/// before; what `several` makes of the refusals where there is none.
pub(crate) fn take_first<E: From<DeviceError> + std::fmt::Display>(
    name: Option<&str>,
    take: impl Fn(&Found) -> Result<Gpu, E>,
    several: impl FnOnce(Vec<E>) -> E,
) -> Result<Gpu, E> {
    let all = found();
    let reports: Vec<AdapterReport> = all.iter().map(|found| found.report.clone()).collect();
    match first(order(&reports, name)?, |at| take(&all[at])) {
        Ok((gpu, refusals)) => Ok(gpu.passed_over(refusals.iter().map(ToString::to_string).collect())),
        Err(mut refusals) if refusals.len() == 1 => Err(refusals.remove(0)),
        Err(refusals) => Err(several(refusals)),
    }
}

/// What went wrong on the device since it was last asked.
#[derive(Debug, Default)]
struct Trouble {
    lost: Option<String>,
    memory: Option<String>,
    other: Option<String>,
}

/// An open device. Clones are the same device.
#[derive(Clone, Debug)]
pub struct Gpu {
    pub(crate) device: wgpu::Device,
    pub(crate) queue: wgpu::Queue,
    report: AdapterReport,
    trouble: Arc<Mutex<Trouble>>,
    /// Counts what was let go, so that nothing keeps bindings to it.
    generation: Arc<AtomicU64>,
    /// Times every dispatch, where that was asked for.
    clock: Option<Arc<Clock>>,
    /// Counts what was submitted.
    submits: Arc<AtomicU64>,
    /// How kernels made for it add up.
    variant: Variant,
    /// Why it has portable kernels, where it could have others.
    fallback: Option<Arc<str>>,
    /// Why adapters before it were not taken.
    passed_over: Arc<[String]>,
    /// Bytes of buffers that are there now.
    held: Arc<AtomicU64>,
    /// The most that there were.
    peak: Arc<AtomicU64>,
}

/// Bytes of a buffer, counted as long as it is there.
#[derive(Debug)]
pub(crate) struct Held {
    all: Arc<AtomicU64>,
    bytes: u64,
}

impl Held {
    /// The buffer is gone.
    pub(crate) fn let_go(&mut self) {
        self.all.fetch_sub(std::mem::take(&mut self.bytes), Ordering::Relaxed);
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.let_go();
    }
}

fn lock(trouble: &Mutex<Trouble>) -> MutexGuard<'_, Trouble> {
    trouble.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Gpu {
    /// Opens the first adapter that can be opened: of those of the name `name` in any case, else of those whose
    /// names contain it; without a name of all that are no software.
    pub fn open(name: Option<&str>) -> Result<Self, DeviceError> {
        take_first(name, Self::of, DeviceError::Several)
    }

    /// Opens an adapter.
    pub(crate) fn of(Found { report, adapter }: &Found) -> Result<Self, DeviceError> {
        if let Some(refusal) = &report.refusal {
            return Err(refusal.clone());
        }
        let report = report.clone();
        let limits = adapter.limits();
        let wanted = wgpu::Limits {
            max_storage_buffers_per_shader_stage: limits.max_storage_buffers_per_shader_stage.min(32),
            max_compute_workgroup_storage_size: limits.max_compute_workgroup_storage_size.min(32 << 10),
            max_storage_buffer_binding_size: limits.max_storage_buffer_binding_size,
            max_buffer_size: limits.max_buffer_size,
            ..wgpu::Limits::default()
        };
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("use3d"),
            required_features: adapter.features() & (profile::features() | wgpu::Features::SUBGROUP),
            required_limits: wanted.or_worse_values_from(&limits),
            memory_hints: wgpu::MemoryHints::Performance,
            ..Default::default()
        };
        let opened = pollster::block_on(adapter.request_device(&descriptor));
        let (device, queue) =
            opened.map_err(|e| DeviceError::Open { adapter: report.name.clone(), reason: e.to_string() })?;
        let trouble = Arc::new(Mutex::new(Trouble::default()));
        let told = trouble.clone();
        device.set_device_lost_callback(move |reason, message| {
            lock(&told).lost.get_or_insert(format!("{reason:?}: {message}"));
        });
        // Without a handler of ours an error would end the process.
        let told = trouble.clone();
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            let mut told = lock(&told);
            let place = match &error {
                wgpu::Error::OutOfMemory { .. } => &mut told.memory,
                _ => &mut told.other,
            };
            place.get_or_insert(error.to_string());
        }));
        let mut gpu = Self {
            device,
            queue,
            report,
            trouble,
            generation: Arc::default(),
            clock: None,
            submits: Arc::default(),
            variant: Variant::Portable,
            fallback: None,
            passed_over: Arc::from([]),
            held: Arc::default(),
            peak: Arc::default(),
        };
        // Software takes the portable one, whose bits no vector width changes.
        if !gpu.report.is_software()
            && let Some(variant) = gpu.subgroups()
        {
            gpu.variant = variant;
        }
        Ok(gpu)
    }

    /// How kernels made for this device add up.
    pub fn variant(&self) -> Variant {
        self.variant
    }

    /// The same with portable kernels, since those of its variant do not serve.
    #[must_use]
    pub(crate) fn fallen_back(self, why: &str) -> Self {
        let mut gpu = self.with(Variant::Portable);
        gpu.fallback = Some(why.into());
        gpu
    }

    fn passed_over(mut self, refusals: Vec<String>) -> Self {
        self.passed_over = refusals.into();
        self
    }

    /// Why adapters that would have been taken before it were not.
    pub fn refused_before(&self) -> &[String] {
        &self.passed_over
    }

    /// How its kernels add up as a person is told: where they are the portable ones although it has operations
    /// across threads, with the reason.
    pub fn kernels(&self) -> String {
        match &self.fallback {
            Some(why) => format!("{} (with subgroups: {why})", self.variant),
            None => self.variant.to_string(),
        }
    }

    /// The variants that this device can do, the portable one first.
    pub fn variants(&self) -> Vec<Variant> {
        [Variant::Portable].into_iter().chain(self.subgroups()).collect()
    }

    fn subgroups(&self) -> Option<Variant> {
        let has = self.device.features().contains(wgpu::Features::SUBGROUP);
        Variant::of_subgroups(has, self.report.subgroup)
    }

    /// The same with every number of pixels to a thread: what is measured on a card before one is taken.
    pub fn trials(&self) -> Vec<Variant> {
        self.variants().into_iter().flat_map(Variant::each).collect()
    }

    /// The same device for kernels of another variant; the portable one where it cannot do this one.
    #[must_use]
    pub fn with(mut self, variant: Variant) -> Self {
        self.variant = if self.trials().contains(&variant) { variant } else { Variant::Portable };
        self
    }

    /// The adapter.
    pub fn adapter(&self) -> &AdapterReport {
        &self.report
    }

    /// The same device with every dispatch of kernels made for it timed, where the device can.
    pub(crate) fn timed(self) -> Self {
        self.with_clock(Timed::Dispatches)
    }

    /// The same device with every step's pass timed as a whole, where the device can.
    pub(crate) fn timed_steps(self) -> Self {
        self.with_clock(Timed::Passes)
    }

    fn with_clock(mut self, timed: Timed) -> Self {
        if self.device.features().contains(timed.features()) {
            self.clock = Some(Arc::new(Clock::new(&self.device, timed)));
        }
        self
    }

    pub(crate) fn clock(&self) -> Option<&Clock> {
        self.clock.as_deref()
    }

    /// Whether nothing went wrong since the last call.
    pub(crate) fn check(&self) -> Result<(), EngineError> {
        if lock(&self.trouble).other.is_some() {
            // A lost device refuses everything, and says that it is lost when it is waited for.
            let _ = self.device.poll(wgpu::PollType::wait_indefinitely());
        }
        let mut trouble = lock(&self.trouble);
        if let Some(reason) = trouble.lost.clone() {
            return Err(EngineError::DeviceLost { engine: NAME, reason });
        }
        if let Some(what) = trouble.memory.take() {
            return Err(EngineError::OutOfMemory { engine: NAME, what });
        }
        match trouble.other.take() {
            Some(what) => Err(EngineError::Failed(what.into())),
            None => Ok(()),
        }
    }

    /// Hands over what was recorded.
    pub(crate) fn submit(&self, encoder: wgpu::CommandEncoder) {
        self.submits.fetch_add(1, Ordering::Relaxed);
        self.queue.submit([encoder.finish()]);
    }

    /// How often something was submitted.
    pub(crate) fn submits(&self) -> u64 {
        self.submits.load(Ordering::Relaxed)
    }

    /// Waits until everything that was submitted is done.
    pub(crate) fn wait(&self) -> Result<(), EngineError> {
        let polled = self.device.poll(wgpu::PollType::wait_indefinitely());
        self.check()?;
        polled.map(|_| ()).map_err(|e| EngineError::DeviceLost { engine: NAME, reason: e.to_string() })
    }

    /// Counts a buffer.
    pub(crate) fn hold(&self, bytes: u64) -> Held {
        let held = bytes + self.held.fetch_add(bytes, Ordering::Relaxed);
        self.peak.fetch_max(held, Ordering::Relaxed);
        Held { all: self.held.clone(), bytes }
    }

    /// Bytes of all buffers.
    pub(crate) fn held(&self) -> u64 {
        self.held.load(Ordering::Relaxed)
    }

    /// The most bytes that all buffers had since this was asked last.
    #[cfg(test)]
    pub(crate) fn peak(&self) -> u64 {
        self.peak.swap(self.held(), Ordering::Relaxed)
    }

    /// Bytes of the longest buffer that a kernel can see.
    pub(crate) fn longest(&self) -> u64 {
        self.report.binding.min(self.report.buffer)
    }

    /// Most Gaussians whose splats one binding holds.
    pub fn most_gaussians(&self) -> usize {
        (self.longest() / (SPLAT * size_of::<Row>()) as u64) as usize
    }

    /// Gaussians whose colours one binding holds: see [`crate::chunks`].
    pub(crate) fn gaussians_of_chunk(&self) -> usize {
        ((self.longest() / (4 * COLORS as u64)) as usize).max(1)
    }

    /// Refuses a buffer that no kernel could see whole, or that the device cannot hold.
    pub(crate) fn fits(&self, what: &str, bytes: u64) -> Result<(), EngineError> {
        let most = self.longest();
        if bytes <= most {
            return Ok(());
        }
        let name = &self.report.name;
        let what = format!("{what} would take {bytes} bytes, `{name}` binds at most {most}");
        Err(EngineError::OutOfMemory { engine: NAME, what })
    }

    /// Bindings made before this call may be to buffers that are gone.
    pub(crate) fn forget_bindings(&self) {
        self.generation.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn generation(&self) -> u64 {
        self.generation.load(Ordering::Relaxed)
    }

    /// The same device as if it bound no more than so many bytes.
    #[cfg(test)]
    pub(crate) fn binding(mut self, bytes: u64) -> Self {
        self.report.binding = bytes;
        self
    }

    /// As if the driver had had no memory for what it was asked last.
    #[cfg(test)]
    pub(crate) fn run_out_of_memory(&self) {
        lock(&self.trouble).memory = Some("out of memory".into());
    }

    /// As if the driver had given up.
    #[cfg(test)]
    pub(crate) fn lose(&self) {
        self.device.destroy();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(name: &str, kind: &'static str) -> AdapterReport {
        AdapterReport {
            name: name.into(),
            kind,
            backend: "vulkan".into(),
            driver: "d 1".into(),
            binding: 1 << 31,
            buffer: 1 << 31,
            workgroup: 32 << 10,
            buffers: 32,
            subgroup: [8, 8],
            refusal: None,
        }
    }

    #[test]
    fn software_is_taken_by_name_alone() {
        let soft = report("llvmpipe (LLVM 15)", "software");
        let card = report("GeForce RTX 3090", "discrete");
        let both = [card, soft.clone()];
        assert_eq!(order(&both, None), Ok(vec![0]));
        assert_eq!(order(&both, Some("LLVMPIPE")), Ok(vec![1]));
        assert_eq!(order(&both, Some("3090")), Ok(vec![0]));
        let only = order(std::slice::from_ref(&soft), None).unwrap_err().to_string();
        assert!(only.contains("gpu:llvmpipe") && only.contains("--engine cpu"), "{only}");
        for name in [None, Some("vega")] {
            let none = order(&[], name).unwrap_err().to_string();
            assert!(none.contains("libvulkan") && none.contains("--engine cpu"), "{none}");
            assert!(name.is_none_or(|name| none.contains(name)), "{none}");
        }
        let wrong = order(&both, Some("radeon")).unwrap_err().to_string();
        assert!(wrong.contains("radeon") && wrong.contains("3090") && wrong.contains("llvmpipe"), "{wrong}");
    }

    #[test]
    fn a_whole_name_wins_before_a_part_and_every_card_that_fits_is_tried() {
        let all = [
            report("RTX 3090 Ti", "discrete"),
            report("RTX 3090", "discrete"),
            report("RTX 3090", "discrete"),
            report("Radeon", "integrated"),
            report("llvmpipe", "software"),
        ];
        assert_eq!(order(&all, Some("rtx 3090")), Ok(vec![1, 2]));
        assert_eq!(order(&all, Some("rtx 3090 ti")), Ok(vec![0]));
        assert_eq!(order(&all, Some("3090")), Ok(vec![0, 1, 2]));
        assert_eq!(order(&all, None), Ok(vec![0, 1, 2, 3]));
    }

    #[test]
    fn the_first_that_serves_is_taken_and_all_refusals_are_told_where_none_does() {
        let sound = |at: usize| if at == 2 { Ok(at) } else { Err(format!("card {at} is unsound")) };
        let (taken, before) = first(vec![0, 1, 2, 3], sound).unwrap();
        assert_eq!((taken, before.len()), (2, 2));
        let refusals = first(vec![0, 1], sound).unwrap_err();
        let said = listed(&refusals);
        assert!(said.contains("none of 2 adapters") && said.contains("(1) card 0 is unsound"), "{said}");
        assert!(said.contains("(2) card 1 is unsound"), "{said}");
    }

    #[test]
    fn a_limit_that_is_too_low_is_told_with_its_number() {
        let fits = report("large", "integrated");
        for (small, found, needed) in [
            (
                AdapterReport { workgroup: 16 << 10, ..fits.clone() },
                "16384 bytes of workgroup memory",
                "20480",
            ),
            (
                AdapterReport { binding: 64 << 20, ..fits.clone() },
                "67108864 bytes in the largest binding",
                "134217728",
            ),
            (AdapterReport { buffers: 8, ..fits }, "8 storage buffers per kernel", "16"),
        ] {
            let refusal = small.check().unwrap_err().to_string();
            assert!(refusal.contains(found) && refusal.contains(needed), "{refusal}");
        }
    }

    #[test]
    fn a_lost_device_is_an_error_and_no_panic() {
        let Some(gpu) = crate::testing::software() else { return };
        gpu.check().unwrap();
        gpu.lose();
        let error = gpu.wait().unwrap_err();
        assert!(matches!(error, EngineError::DeviceLost { .. }), "{error}");
    }
}
