//! The adapters of this machine, the choice of one, and its device.
//!
//! The driver's loader is opened at run time, so the program can be built and started on machines without
//! any. Processors that act as graphics cards (software adapters) are slower than the engine for
//! processors. They are used only if they are requested by name.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use use3d_training::EngineError;

pub(crate) use crate::adapter::listed;
pub use crate::adapter::{AdapterReport, DeviceError};
use crate::compiled::CompiledKernels;
use crate::profile::{self, Clock, Timed};
use crate::rows::{COLORS, Float4, SPLAT};
use crate::selection::{CudaVariables, once, order};
use crate::variant::Variant;

/// The engine's name in messages.
pub(crate) const NAME: &str = "gpu";

/// Largest number of bytes of photographs on a device whose memory is not known.
const VIEWS: u64 = 3 << 29;

/// Longest wait for a card. At most fifty steps are under way, each of milliseconds.
const LONGEST_WAIT: Duration = Duration::from_secs(600);

fn instance() -> wgpu::Instance {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::VULKAN | wgpu::Backends::METAL | wgpu::Backends::DX12;
    wgpu::Instance::new(descriptor)
}

/// All adapters of this machine, the most suitable first.
pub(crate) fn found() -> Vec<AdapterChoice> {
    let adapters = pollster::block_on(instance().enumerate_adapters(wgpu::Backends::all()));
    let mut all: Vec<_> = adapters.into_iter().map(|a| (AdapterReport::of(&a), a)).collect();
    all.sort_by_key(|(report, _)| report.rank());
    let reports: Vec<AdapterReport> = all.iter().map(|(report, _)| report.clone()).collect();
    let kept = once(&reports);
    let all = all.into_iter().enumerate().filter(|(at, _)| kept.contains(at)).map(|(_, both)| both);
    let (mut reports, adapters): (Vec<AdapterReport>, Vec<wgpu::Adapter>) = all.unzip();
    // If the variables cannot be followed, nothing is hidden; `environment_note` has the reason.
    let _ = CudaVariables::read().hide(&mut reports);
    reports.into_iter().zip(adapters).map(|(report, adapter)| AdapterChoice { report, adapter }).collect()
}

/// The reason why the environment's choice among these adapters is ignored, if it is.
pub fn environment_note(reports: &[AdapterReport]) -> Option<String> {
    CudaVariables::read().hide(&mut reports.to_vec()).err()
}

/// All adapters of this machine, the most suitable first.
pub fn adapters() -> Vec<AdapterReport> {
    found().into_iter().map(|choice| choice.report).collect()
}

/// Returns the first that can be opened, and the errors of those before it; all errors if none can.
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

/// An adapter that may be opened any number of times.
#[derive(Debug)]
pub(crate) struct AdapterChoice {
    pub(crate) report: AdapterReport,
    adapter: wgpu::Adapter,
}

/// Returns the first of the adapters with this `name` for which `take` succeeds, together with the errors
/// of those before it. If none succeeds, returns the single error, or `several` of all errors.
pub(crate) fn take_first<E: From<DeviceError> + std::fmt::Display>(
    name: Option<&str>,
    take: impl Fn(&AdapterChoice) -> Result<Gpu, E>,
    several: impl FnOnce(Vec<E>) -> E,
) -> Result<Gpu, E> {
    let all = found();
    let reports: Vec<AdapterReport> = all.iter().map(|found| found.report.clone()).collect();
    match first(order(&reports, name)?, |at| take(&all[at])) {
        Ok((mut gpu, refusals)) => {
            gpu.refused_before = refusals.iter().map(ToString::to_string).collect();
            Ok(gpu)
        }
        Err(mut refusals) if refusals.len() == 1 => Err(refusals.remove(0)),
        Err(refusals) => Err(several(refusals)),
    }
}

/// Errors of the device since the last check.
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
    /// The adapter.
    pub adapter: AdapterReport,
    trouble: Arc<Mutex<Trouble>>,
    /// The kernels that were compiled for it.
    pub(crate) kernels: Arc<CompiledKernels>,
    /// Counts freed buffers, so that no bindings to them are kept.
    generation: Arc<AtomicU64>,
    /// Times every dispatch or pass, if requested.
    pub(crate) clock: Option<Arc<Clock>>,
    /// Counts the submits.
    submits: Arc<AtomicU64>,
    /// The variant of the kernels made for it.
    pub variant: Variant,
    /// The width of its subgroups, if it has subgroup operations and one width.
    pub width: Option<u32>,
    /// The reason why it has portable kernels although it supports others.
    fallback: Option<Arc<str>>,
    /// The reasons why adapters that were tried before it were not used.
    pub refused_before: Arc<[String]>,
    /// Number of bytes of the existing buffers.
    held: Arc<AtomicU64>,
    /// The largest number of bytes of buffers so far.
    peak: Arc<AtomicU64>,
}

/// The bytes of a buffer, counted as long as it exists.
#[derive(Debug)]
pub(crate) struct BufferBytes {
    all: Arc<AtomicU64>,
    bytes: u64,
}

impl BufferBytes {
    /// Stops counting the buffer, after it was freed.
    pub(crate) fn let_go(&mut self) {
        self.all.fetch_sub(std::mem::take(&mut self.bytes), Ordering::Relaxed);
    }
}

impl Drop for BufferBytes {
    fn drop(&mut self) {
        self.let_go();
    }
}

fn lock(trouble: &Mutex<Trouble>) -> MutexGuard<'_, Trouble> {
    trouble.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Gpu {
    /// Opens an adapter, with portable kernels.
    pub(crate) fn opened(AdapterChoice { report, adapter }: &AdapterChoice) -> Result<Self, DeviceError> {
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
        // Without this handler an error would end the process.
        let told = trouble.clone();
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            let mut told = lock(&told);
            let place = match &error {
                wgpu::Error::OutOfMemory { .. } => &mut told.memory,
                _ => &mut told.other,
            };
            place.get_or_insert(error.to_string());
        }));
        Ok(Self {
            device,
            queue,
            adapter: report,
            trouble,
            kernels: Arc::default(),
            generation: Arc::default(),
            clock: None,
            submits: Arc::default(),
            variant: Variant::Portable,
            width: None,
            fallback: None,
            refused_before: Arc::from([]),
            held: Arc::default(),
            peak: Arc::default(),
        })
    }

    /// The same device with portable kernels, because those of its variant failed.
    #[must_use]
    pub(crate) fn fallen_back(self, why: &str) -> Self {
        let mut gpu = self.with(Variant::Portable);
        gpu.fallback = Some(why.into());
        gpu
    }

    /// The variant of its kernels for the user; with the reason if they are portable although it supports
    /// subgroup operations.
    pub fn kernels(&self) -> String {
        match &self.fallback {
            Some(why) => format!("{} (with subgroups: {why})", self.variant),
            None => self.variant.to_string(),
        }
    }

    /// The variants that this device supports, the portable one first.
    pub fn variants(&self) -> Vec<Variant> {
        [Variant::Portable].into_iter().chain(self.subgroups()).collect()
    }

    pub(crate) fn subgroups(&self) -> Option<Variant> {
        self.width.and_then(Variant::of_width)
    }

    /// The supported variants with every number of pixels per thread, for measurements on a card.
    pub fn trials(&self) -> Vec<Variant> {
        self.variants().into_iter().flat_map(Variant::each).collect()
    }

    /// The same device for kernels of another variant; the portable one if it does not support this one.
    #[must_use]
    pub fn with(mut self, variant: Variant) -> Self {
        self.variant = if self.trials().contains(&variant) { variant } else { Variant::Portable };
        self
    }

    /// The same device, which times the work of kernels made for it if it can.
    pub fn timed(mut self, timed: Timed) -> Self {
        if self.device.features().contains(timed.features()) {
            self.clock = Some(Arc::new(Clock::new(&self.device, timed)));
        }
        self
    }

    /// Returns an error if the device reported one since the last call.
    pub(crate) fn check(&self) -> Result<(), EngineError> {
        if lock(&self.trouble).other.is_some() {
            // A lost device refuses everything, and reports the loss only in a wait.
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

    /// The names of the kernels that were compiled for it, and the seconds that the compilation of each took.
    pub fn compile_times(&self) -> Vec<(&'static str, f64)> {
        self.kernels.times()
    }

    /// Submits the recorded commands.
    pub(crate) fn submit(&self, encoder: wgpu::CommandEncoder) {
        self.submits.fetch_add(1, Ordering::Relaxed);
        self.queue.submit([encoder.finish()]);
    }

    /// The number of submits.
    pub fn submits(&self) -> u64 {
        self.submits.load(Ordering::Relaxed)
    }

    /// Waits until all submitted work is done. A card that does not answer for long hangs, and counts as
    /// lost. Software may need longer, and cannot hang.
    pub(crate) fn wait(&self) -> Result<(), EngineError> {
        let timeout = (!self.adapter.is_software()).then_some(LONGEST_WAIT);
        let polled = self.device.poll(wgpu::PollType::Wait { submission_index: None, timeout });
        self.check()?;
        polled.map(|_| ()).map_err(|e| EngineError::DeviceLost { engine: NAME, reason: e.to_string() })
    }

    /// Counts a buffer.
    pub(crate) fn hold(&self, bytes: u64) -> BufferBytes {
        let held = bytes + self.held.fetch_add(bytes, Ordering::Relaxed);
        self.peak.fetch_max(held, Ordering::Relaxed);
        BufferBytes { all: self.held.clone(), bytes }
    }

    /// Number of bytes of all buffers.
    pub(crate) fn held(&self) -> u64 {
        self.held.load(Ordering::Relaxed)
    }

    /// The largest number of bytes of all buffers since the last call.
    #[cfg(test)]
    pub(crate) fn peak(&self) -> u64 {
        self.peak.swap(self.held(), Ordering::Relaxed)
    }

    /// Largest number of bytes of photographs that are kept on the device: a quarter of its own memory, if
    /// that is known. Those beyond it are sent again when they are needed.
    pub(crate) fn view_bytes(&self) -> usize {
        self.adapter.memory.map_or(VIEWS, |bytes| bytes / 4) as usize
    }

    /// Size in bytes of the largest buffer that a kernel can bind.
    pub(crate) fn longest(&self) -> u64 {
        self.adapter.binding.min(self.adapter.buffer)
    }

    /// Largest number of Gaussians whose splats fit into one binding.
    pub fn most_gaussians(&self) -> usize {
        (self.longest() / (SPLAT * size_of::<Float4>()) as u64) as usize
    }

    /// Number of Gaussians whose colours fit into one binding: see [`crate::chunks`].
    pub(crate) fn gaussians_of_chunk(&self) -> usize {
        ((self.longest() / (4 * COLORS as u64)) as usize).max(1)
    }

    /// Returns an error for a buffer that is too large for a binding or for the device.
    pub(crate) fn fits(&self, what: &str, bytes: u64) -> Result<(), EngineError> {
        let most = self.longest();
        if bytes <= most {
            return Ok(());
        }
        let name = &self.adapter.name;
        let what = format!("{what} would take {bytes} bytes, `{name}` binds at most {most}");
        Err(EngineError::OutOfMemory { engine: NAME, what })
    }

    /// Marks older bindings as invalid, because they may refer to buffers that were freed.
    pub(crate) fn forget_bindings(&self) {
        self.generation.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn generation(&self) -> u64 {
        self.generation.load(Ordering::Relaxed)
    }

    /// The same device with kernels for subgroups of another width than it has.
    #[cfg(test)]
    pub(crate) fn of_width_in_tests(mut self, width: u32) -> Self {
        self.variant = Variant::Subgroups { width, pixels: 2 };
        self
    }

    /// The same device with a smaller limit on the bytes of a binding.
    #[cfg(test)]
    pub(crate) fn binding(mut self, bytes: u64) -> Self {
        self.adapter.binding = bytes;
        self
    }

    /// Simulates that the driver had no memory for the last request.
    #[cfg(test)]
    pub(crate) fn run_out_of_memory(&self) {
        lock(&self.trouble).memory = Some("out of memory".into());
    }

    /// Simulates that the driver lost the device.
    #[cfg(test)]
    pub(crate) fn lose(&self) {
        self.device.destroy();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::selection::tests::report;

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
            (AdapterReport { buffers: 8, ..fits }, "8 storage buffers per kernel", "10"),
        ] {
            let refusal = small.check().unwrap_err().to_string();
            assert!(refusal.contains(found) && refusal.contains(needed), "{refusal}");
        }
    }

    #[test]
    fn a_lost_device_is_an_error_and_no_panic() {
        let Some(gpu) = crate::test_support::software() else { return };
        gpu.check().unwrap();
        gpu.lose();
        let error = gpu.wait().unwrap_err();
        assert!(matches!(error, EngineError::DeviceLost { .. }), "{error}");
    }
}
