//! Kernels: WGSL composed of a header, shared parts and a body; their bindings and dispatches.
//!
//! A [`Spec`] is plain data: the buffers that a kernel binds and their access, its constants, and its text.
//! The declarations of its bindings are written from the same list as its bind group layout, so the two
//! always agree. Specs are checked without a device (the test below runs through all of them); a [`Kernel`]
//! is a spec compiled for a device.
//!
//! Every kernel has one bind group, with bindings in the order of its list, and one entry point `main`. The
//! header defines
//!
//! ```text
//! WG                          threads of a workgroup
//! group_of(wid, nwg) -> u32   number of the workgroup in a grid that may have two dimensions ([`grid`])
//! is_bad(x) -> bool           true if a float is infinite or NaN, by its bits: WGSL may lose `x != x`
//! ```

use std::fmt::Write as _;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use use3d_training::EngineError;

use crate::compiled::CompiledText;
use crate::device::Gpu;

/// Largest number of workgroups in one dimension of a grid.
const SIDE: u64 = 65_535;

#[cfg(test)]
thread_local! {
    /// A smaller side for the grids that this thread makes, so that small scenes have grids of two
    /// dimensions.
    pub(crate) static SIDE_IN_TESTS: std::cell::Cell<u64> = const { std::cell::Cell::new(SIDE) };
}

/// See [`SIDE`].
fn side() -> u64 {
    #[cfg(test)]
    return SIDE_IN_TESTS.get();
    #[cfg(not(test))]
    SIDE
}

/// The access of a kernel to a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Access {
    /// A small constant.
    Uniform,
    /// Read only.
    Read,
    /// Read and written.
    Write,
}

/// A buffer that a kernel binds: its access, its name, and its type in WGSL.
pub(crate) type Binding = (Access, &'static str, &'static str);

/// An array of floats, the type of many bindings.
pub(crate) const F32S: &str = "array<f32>";
/// An array of unsigned integers.
pub(crate) const U32S: &str = "array<u32>";
/// An array of rows of four floats.
pub(crate) const ROWS: &str = "array<vec4<f32>>";

/// A binding of floats that a kernel reads.
pub(crate) const fn read(name: &'static str) -> Binding {
    (Access::Read, name, F32S)
}

/// A binding of floats that a kernel writes.
pub(crate) const fn write(name: &'static str) -> Binding {
    (Access::Write, name, F32S)
}

/// The value of a constant in a kernel's text.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Constant {
    /// An unsigned integer.
    Count(u32),
    /// A boolean switch.
    Switch(bool),
    /// A float, written so that its bits come back.
    Real(f32),
}

/// The description of a kernel.
#[derive(Clone, Debug)]
pub(crate) struct Spec {
    /// Its name in messages and profiles.
    pub(crate) name: &'static str,
    /// Threads of a workgroup.
    pub(crate) threads: u32,
    /// Its buffers, in the order of the bindings.
    pub(crate) bindings: Vec<Binding>,
    /// Constants of this variant.
    pub(crate) constants: Vec<(&'static str, Constant)>,
    /// The shared parts of its text, then its own.
    pub(crate) parts: Vec<&'static str>,
}

impl Spec {
    /// The whole text.
    pub(crate) fn source(&self) -> String {
        let mut text = String::from(HEADER);
        // Writing to a string does not fail.
        let _ = writeln!(text, "const WG: u32 = {}u;", self.threads);
        for (name, value) in &self.constants {
            let _ = match value {
                Constant::Count(v) => writeln!(text, "const {name}: u32 = {v}u;"),
                Constant::Switch(v) => writeln!(text, "const {name}: bool = {v};"),
                Constant::Real(v) => writeln!(text, "const {name}: f32 = {v:?}f;"),
            };
        }
        for (at, (access, name, kind)) in self.bindings.iter().enumerate() {
            let space = match access {
                Access::Uniform => "uniform",
                Access::Read => "storage, read",
                Access::Write => "storage, read_write",
            };
            let _ = writeln!(text, "@group(0) @binding({at}) var<{space}> {name}: {kind};");
        }
        for part in &self.parts {
            #[cfg(test)]
            let part = &*crate::driver_tests::without_barrier(part);
            text.push_str(part);
            text.push('\n');
        }
        text
    }
}

const HEADER: &str = "
fn group_of(wid: vec3<u32>, nwg: vec3<u32>) -> u32 { return wid.y * nwg.x + wid.x; }
fn is_bad(x: f32) -> bool { return (bitcast<u32>(x) & 0x7f800000u) == 0x7f800000u; }
";

/// The text of `sum_of_group(value, lane)`: a sum over the workgroup in a fixed order.
pub(crate) const SUM: &str = include_str!("sum.wgsl");

/// The sides of a grid of at least `groups` workgroups: in rows of 65,535 if there are more, so that a kernel
/// must ignore those beyond its end.
fn grid(groups: usize) -> [u32; 2] {
    let (groups, side) = (groups as u64, side());
    if groups <= side { [groups as u32, 1] } else { [side as u32, groups.div_ceil(side).min(SIDE) as u32] }
}

/// The bind groups of a kernel by their buffers, and the generation of these buffers.
#[derive(Debug, Default)]
struct Bindings {
    generation: u64,
    groups: Vec<(Vec<wgpu::Buffer>, wgpu::BindGroup)>,
}

/// Largest number of bind groups that a kernel keeps.
const KEPT: usize = 64;

/// Largest number of kernels that are compiled at the same time; a driver's compiler takes much memory.
const COMPILERS: usize = 16;

/// Compiles the kernels that are not compiled yet, each text once, on all processors.
pub(crate) fn compile(gpu: &Gpu, specs: &[Spec]) -> Result<(), EngineError> {
    let mut missing: Vec<(String, &Spec)> = Vec::new();
    for spec in specs {
        let text = spec.source();
        if gpu.kernels.find(&text).is_none() && missing.iter().all(|(other, _)| *other != text) {
            missing.push((text, spec));
        }
    }
    let next = AtomicUsize::new(0);
    let processors = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = processors.min(COMPILERS).min(missing.len());
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                while let Some((text, spec)) = missing.get(next.fetch_add(1, Ordering::Relaxed)) {
                    let started = Instant::now();
                    let compiled = spec.compile(&gpu.device, text);
                    gpu.kernels.keep(text.clone(), compiled, spec.name, started.elapsed().as_secs_f64());
                }
            });
        }
    });
    // The device does not say which of them failed.
    gpu.check().inspect_err(|_| gpu.kernels.forget(missing.iter().map(|(text, _)| text)))
}

/// Creates the module of a kernel. A release leaves out the checks at run time that wgpu adds: a counter in
/// every loop, and a comparison for every index. Builds with debug assertions, such as those of the tests,
/// have them; divisions are guarded in both.
#[expect(unsafe_code, reason = "wgpu has no safe function that leaves out the checks of its own programs")]
fn module(device: &wgpu::Device, descriptor: wgpu::ShaderModuleDescriptor<'_>) -> wgpu::ShaderModule {
    let mut checks = wgpu::ShaderRuntimeChecks::checked();
    checks.bounds_checks = cfg!(debug_assertions);
    checks.force_loop_bounding = cfg!(debug_assertions);
    // SAFETY: the texts are this program's own. Every loop ends after a number of rounds that is known when
    // it begins. Indices stay within their arrays: the tests run every kernel with the checks, and compare it
    // with the processor's function.
    unsafe { device.create_shader_module_trusted(descriptor, checks) }
}

impl Spec {
    fn compile(&self, device: &wgpu::Device, text: &str) -> CompiledText {
        let descriptor = wgpu::ShaderModuleDescriptor {
            label: Some(self.name),
            source: wgpu::ShaderSource::Wgsl(text.into()),
        };
        let module = module(device, descriptor);
        let entries: Vec<wgpu::BindGroupLayoutEntry> = (0u32..)
            .zip(&self.bindings)
            .map(|(binding, (access, ..))| wgpu::BindGroupLayoutEntry {
                binding,
                visibility: wgpu::ShaderStages::COMPUTE,
                ty: wgpu::BindingType::Buffer {
                    ty: match access {
                        Access::Uniform => wgpu::BufferBindingType::Uniform,
                        Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
                        Access::Write => wgpu::BufferBindingType::Storage { read_only: false },
                    },
                    has_dynamic_offset: false,
                    min_binding_size: None,
                },
                count: None,
            })
            .collect();
        let layout = device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
            label: Some(self.name),
            entries: &entries,
        });
        let pipeline_layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(self.name),
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let pipeline = device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(self.name),
            layout: Some(&pipeline_layout),
            module: &module,
            entry_point: Some("main"),
            // Kernels write before they read, and clearing would cost a barrier per workgroup.
            compilation_options: wgpu::PipelineCompilationOptions {
                constants: &[],
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        });
        CompiledText { pipeline, layout }
    }
}

/// A kernel on a device.
#[derive(Debug)]
pub(crate) struct Kernel {
    gpu: Gpu,
    name: &'static str,
    compiled: CompiledText,
    bindings: Mutex<Bindings>,
    threads: u32,
}

impl Kernel {
    /// A spec's kernel, compiled now if it was not before.
    pub(crate) fn new(gpu: &Gpu, spec: &Spec) -> Result<Self, EngineError> {
        compile(gpu, std::slice::from_ref(spec))?;
        let Some(compiled) = gpu.kernels.find(&spec.source()) else {
            return Err(EngineError::Failed(format!("the kernel `{}` was not compiled", spec.name).into()));
        };
        let (gpu, bindings) = (gpu.clone(), Mutex::default());
        Ok(Self { gpu, name: spec.name, compiled, bindings, threads: spec.threads })
    }

    /// The kernels of these specs, in their order.
    pub(crate) fn all<const N: usize>(gpu: &Gpu, specs: &[Spec; N]) -> Result<[Self; N], EngineError> {
        let kernels: Vec<Self> = specs.iter().map(|spec| Self::new(gpu, spec)).collect::<Result<_, _>>()?;
        kernels.try_into().map_err(|_| EngineError::Failed("a kernel was not compiled".into()))
    }

    /// Records a dispatch for this number of items. The buffers are in the order of the spec's bindings;
    /// without items nothing is recorded.
    pub(crate) fn record(&self, pass: &mut wgpu::ComputePass<'_>, items: usize, buffers: Vec<wgpu::Buffer>) {
        self.record_groups(pass, items.div_ceil(self.threads as usize), buffers);
    }

    /// Like [`Kernel::record`], for this number of workgroups.
    pub(crate) fn record_groups(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        groups: usize,
        buffers: Vec<wgpu::Buffer>,
    ) {
        if groups == 0 {
            return;
        }
        pass.set_pipeline(&self.compiled.pipeline);
        pass.set_bind_group(0, &self.bind(buffers), &[]);
        let clock = self.gpu.clock.as_deref();
        let place = clock.and_then(|clock| clock.before(pass, self.name));
        let [across, down] = grid(groups);
        pass.dispatch_workgroups(across, down, 1);
        if let Some(clock) = clock {
            clock.after(pass, place);
        }
    }

    fn bind(&self, buffers: Vec<wgpu::Buffer>) -> wgpu::BindGroup {
        let mut kept = self.bindings.lock().unwrap_or_else(PoisonError::into_inner);
        let generation = self.gpu.generation();
        if kept.generation != generation || kept.groups.len() >= KEPT {
            (kept.generation, kept.groups) = (generation, Vec::new());
        }
        if let Some((_, group)) = kept.groups.iter().find(|(of, _)| *of == buffers) {
            return group.clone();
        }
        let entries: Vec<wgpu::BindGroupEntry<'_>> = (0u32..)
            .zip(&buffers)
            .map(|(binding, buffer)| wgpu::BindGroupEntry { binding, resource: buffer.as_entire_binding() })
            .collect();
        let group = self.gpu.device.create_bind_group(&wgpu::BindGroupDescriptor {
            label: Some(self.name),
            layout: &self.compiled.layout,
            entries: &entries,
        });
        kept.groups.push((buffers, group.clone()));
        group
    }
}

/// The buffers of a dispatch: `bound![constants, splats, out]`, each an [`Array`](crate::buffer::Array).
macro_rules! bound {
    ($($buffer:expr),* $(,)?) => {
        vec![$($crate::buffer::Array::raw(&$buffer).clone()),*]
    };
}
pub(crate) use bound;

/// Records dispatches into one pass and submits them.
pub(crate) fn submit(
    gpu: &Gpu,
    what: &'static str,
    record: impl FnOnce(&mut wgpu::ComputePass<'_>),
) -> Result<(), EngineError> {
    let label = Some(what);
    let mut encoder = gpu.device.create_command_encoder(&wgpu::CommandEncoderDescriptor { label });
    {
        let mut pass =
            encoder.begin_compute_pass(&wgpu::ComputePassDescriptor { label, timestamp_writes: None });
        record(&mut pass);
    }
    gpu.submit(encoder);
    gpu.check()
}

#[cfg(test)]
pub(crate) mod tests {
    use wgpu::naga;

    use super::*;

    /// Parses and validates a kernel's text as the driver receives it, without a device.
    pub(crate) fn validate(spec: &Spec) {
        let source = spec.source();
        let module = naga::front::wgsl::parse_str(&source)
            .unwrap_or_else(|e| panic!("{}: {}", spec.name, e.emit_to_string(&source)));
        let flags = naga::valid::ValidationFlags::all();
        let mut validator = naga::valid::Validator::new(flags, naga::valid::Capabilities::SUBGROUP);
        if let Err(e) = validator.validate(&module) {
            panic!("{}: {}", spec.name, e.emit_to_string(&source));
        }
        // The text for a device without subgroup operations must contain none of them.
        let in_step =
            spec.constants.iter().any(|(name, _)| *name == "WIDTH") || spec.name.contains("subgroups");
        assert_eq!(source.contains("subgroup"), in_step, "{}", spec.name);
        let entry = module.entry_points.iter().find(|e| e.name == "main");
        let entry = entry.unwrap_or_else(|| panic!("{} has no entry point `main`", spec.name));
        assert_eq!(entry.workgroup_size, [spec.threads, 1, 1], "{}", spec.name);
        let shared: u32 = module
            .global_variables
            .iter()
            .filter(|(_, v)| v.space == naga::AddressSpace::WorkGroup)
            .map(|(_, v)| module.types[v.ty].inner.size(module.to_ctx()))
            .sum();
        assert!(shared <= 20 * 1024, "{} shares {shared} bytes", spec.name);
        let buffers = spec.bindings.iter().filter(|b| b.0 != Access::Uniform).count();
        assert!(buffers <= 10, "{} sees {buffers} buffers", spec.name);
    }

    #[test]
    fn every_kernel_is_valid() {
        for spec in &crate::specs() {
            validate(spec);
        }
    }

    #[test]
    fn grids_cover_their_items() {
        for count in [0usize, 1, 255, 256, 257, 65_535 * 256, 65_535 * 256 + 1, 40_000_000] {
            let [x, y] = grid(count.div_ceil(256)).map(u64::from);
            let groups = x * y;
            assert!(groups * 256 >= count as u64 && x <= SIDE, "{count}");
            assert!(groups < (count as u64).div_ceil(256) + SIDE, "{count}");
        }
    }
}
