//! Adam on the Gaussians, and all steps that lead to it: the sums of their records, the projection's
//! derivative, and the statistics of density control.
//!
//! ```text
//! sums of long runs ─▶ update of the geometry ─▶ update of the colours
//! ```
//!
//! One thread sums the records of a Gaussian. A run of more than [`BLOCK`] records is summed block by block
//! before. The colours are 48 of the 59 numbers of a Gaussian. They have a kernel of their own, which moves
//! them in the order of memory; between the two lie the colour's gradient and the direction, six floats.

use use3d_numerics::adam::Adam;
use use3d_reconstruct::engine::StepRates;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::chunks::CHUNK;
use crate::constants::{CONSTANTS, CONSTANTS_BINDING, StepConstants, counts};
use crate::device::Gpu;
use crate::kernel::{Access, Binding, Constant, Kernel, ROWS, Spec, U32S, bound, read, write};
use crate::lists::{HARMONICS, Lists, PROJECTION};
use crate::rows::Float4;
use crate::scene::DeviceScene;

/// Threads of a workgroup.
const THREADS: u32 = 128;
/// Number of records that are summed in one go.
const BLOCK: u32 = 64;
/// Number of floats between the two kernels per Gaussian: the colour's gradient, and the direction from which
/// it was seen.
pub(crate) const COLOR_PULL: usize = 6;

fn update() -> Spec {
    Spec {
        name: "update",
        threads: THREADS,
        bindings: vec![
            CONSTANTS_BINDING,
            counts::SHARED,
            RUNS,
            (Access::Read, "records", ROWS),
            (Access::Read, "splats", ROWS),
            (Access::Write, "geometry", ROWS),
            (Access::Write, "geometry_first", ROWS),
            (Access::Write, "geometry_second", ROWS),
            (Access::Write, "statistics", "array<vec2<u32>>"),
            write("color_pull"),
        ],
        constants: constants(),
        parts: vec![CONSTANTS, HARMONICS, PROJECTION, ADAM, include_str!("update/update.wgsl")],
    }
}

const RUNS: Binding = (Access::Read, "runs", "array<vec2<u32>>");
const ADAM: &str = include_str!("update/adam.wgsl");

fn constants() -> Vec<(&'static str, Constant)> {
    let mut all = counts::constants();
    all.push(("BLOCK", Constant::Count(BLOCK)));
    all
}

fn long_runs() -> Spec {
    Spec {
        name: "sums of long runs",
        threads: THREADS,
        bindings: vec![counts::READ, RUNS, (Access::Read, "owners", U32S), (Access::Write, "records", ROWS)],
        constants: constants(),
        parts: vec![include_str!("update/long_runs.wgsl")],
    }
}

fn colors() -> Spec {
    Spec {
        name: "update of colours",
        threads: THREADS,
        bindings: vec![
            CONSTANTS_BINDING,
            CHUNK,
            counts::SHARED,
            read("color_pull"),
            (Access::Write, "colors", ROWS),
            (Access::Write, "colors_first", ROWS),
            (Access::Write, "colors_second", ROWS),
        ],
        constants: counts::constants(),
        parts: vec![CONSTANTS, HARMONICS, ADAM, include_str!("update/colors.wgsl")],
    }
}

fn finish() -> Spec {
    Spec {
        name: "finish",
        threads: 1,
        bindings: vec![CONSTANTS_BINDING, counts::WRITE, (Access::Write, "ends", "array<vec4<u32>>")],
        constants: counts::constants(),
        parts: vec![CONSTANTS, include_str!("update/finish.wgsl")],
    }
}

fn limit() -> Spec {
    Spec {
        name: "limit opacity",
        threads: THREADS,
        bindings: vec![
            (Access::Uniform, "ceiling", "Ceiling"),
            (Access::Write, "geometry", ROWS),
            (Access::Write, "geometry_first", ROWS),
            (Access::Write, "geometry_second", ROWS),
        ],
        constants: vec![],
        parts: vec![
            "struct Ceiling { count: u32, logit: f32, pad0: u32, pad1: u32 }",
            include_str!("update/limit.wgsl"),
        ],
    }
}

/// All kernels of this module.
pub(crate) fn specs() -> [Spec; 5] {
    [update(), long_runs(), colors(), finish(), limit()]
}

/// The kernels.
#[derive(Debug)]
pub(crate) struct UpdateKernels {
    /// In the order of [`specs`].
    kernels: [Kernel; 5],
    /// The constants of the opacity ceiling: the number of Gaussians, and the bits of the logit.
    ceiling: Array<[u32; 4]>,
}

impl UpdateKernels {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        Ok(Self { kernels: Kernel::all(gpu, &specs())?, ceiling: Array::uniform(gpu, "opacity ceiling")? })
    }

    /// Records one update of every Gaussian. `color_pull` has room for [`COLOR_PULL`] floats of each.
    pub(crate) fn record(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        constants: &Array<StepConstants>,
        counts: &Array<u32>,
        lists: &Lists,
        records: &Array<Float4>,
        color_pull: &Array<f32>,
        scene: &DeviceScene,
    ) {
        let DeviceScene { values, first, second, statistics, .. } = scene;
        let [update, long_runs, update_colors, ..] = &self.kernels;
        let n = scene.count;
        let entries = if n == 0 { 0 } else { lists.capacity() };
        let Lists { runs, splats, owners, .. } = lists;
        long_runs.record(pass, entries, bound![*counts, *runs, *owners, *records]);
        let mut buffers = bound![*constants, *counts, *runs, *records, *splats];
        buffers.extend(bound![values.geometry, first.geometry, second.geometry, *statistics, *color_pull]);
        update.record(pass, n, buffers);
        let moments = first.colors.over(n).zip(second.colors.over(n));
        for ((chunk, count), ((first, _), (second, _))) in values.colors.over(n).zip(moments) {
            let mut buffers = bound![*constants, chunk.place, *counts, *color_pull];
            buffers.extend(bound![chunk.floats, first.floats, second.floats]);
            update_colors.record(pass, count, buffers);
        }
    }

    /// Records a step's end: a value that is not finite stops later updates, and the step's status is
    /// stored.
    pub(crate) fn record_finish(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        constants: &Array<StepConstants>,
        counts: &Array<u32>,
        ends: &Array<[u32; 4]>,
    ) {
        let [_, _, _, finish, _] = &self.kernels;
        finish.record_groups(pass, 1, bound![*constants, *counts, *ends]);
    }

    /// Records the kernel that lowers opacities to a logit.
    pub(crate) fn record_limit(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass<'_>,
        scene: &DeviceScene,
        logit: f32,
    ) {
        self.ceiling.write(gpu, 0, &[[scene.count as u32, logit.to_bits(), 0, 0]]);
        let DeviceScene { values, first, second, .. } = scene;
        let [.., limit] = &self.kernels;
        let buffers = bound![self.ceiling, values.geometry, first.geometry, second.geometry];
        limit.record(pass, scene.count, buffers);
    }
}

impl StepConstants {
    /// Sets Adam's scalars for step `step` (from 0).
    pub(crate) fn set_rates(&mut self, step: u64, rates: &StepRates) {
        let Adam { beta1, beta2, epsilon, .. } = Adam::SPLATTING;
        let scalars = |rate| Adam::SPLATTING.scalars(step + 1, rate);
        let size = |rate| scalars(rate).step_size;
        self.adam = [beta1 as f32, beta2 as f32, scalars(0.0).root, epsilon as f32];
        self.rates = [rates.means, rates.scales, rates.quaternions, rates.opacity].map(size);
        self.color_rates = [size(rates.sh_constant), size(rates.sh_directional), 0.0, 0.0];
    }
}
