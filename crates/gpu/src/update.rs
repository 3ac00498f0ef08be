//! Adam on the Gaussians, and all steps that lead to it: the sums of their records, the projection's
//! derivative, and the statistics of density control. It is one kernel, so that no gradient is written to
//! memory.

use bytemuck::{Pod, Zeroable};
use use3d_numerics::adam::Adam;
use use3d_reconstruct::engine::StepRates;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::chunks::CHUNK;
use crate::constants::{CONSTANTS, CONSTANTS_BINDING, StepConstants, counts};
use crate::device::Gpu;
use crate::kernel::{Access, Grid, Kernel, ROWS, Spec, bound, write};
use crate::lists::{HARMONICS, Lists, PROJECTION};
use crate::rows::Float4;
use crate::scene::DeviceScene;

/// Threads of a workgroup.
const THREADS: u32 = 128;

fn update() -> Spec {
    Spec {
        name: "update",
        threads: THREADS,
        bindings: vec![
            CONSTANTS_BINDING,
            CHUNK,
            counts::SHARED,
            (Access::Read, "runs", "array<vec2<u32>>"),
            (Access::Read, "records", ROWS),
            (Access::Read, "splats", ROWS),
            (Access::Write, "geometry", ROWS),
            write("colors"),
            (Access::Write, "geometry_first", ROWS),
            write("colors_first"),
            (Access::Write, "geometry_second", ROWS),
            write("colors_second"),
            (Access::Write, "statistics", "array<vec2<u32>>"),
        ],
        constants: counts::constants(),
        parts: vec![CONSTANTS, HARMONICS, PROJECTION, include_str!("update/update.wgsl")],
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
pub(crate) fn specs() -> Vec<Spec> {
    vec![update(), finish(), limit()]
}

/// The constants of the opacity ceiling.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct Ceiling {
    count: u32,
    logit: f32,
    pad: [u32; 2],
}

/// The kernels.
#[derive(Debug)]
pub(crate) struct UpdateKernels {
    update: Kernel,
    finish: Kernel,
    limit: Kernel,
    ceiling: Array<Ceiling>,
}

impl UpdateKernels {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        Ok(Self {
            update: Kernel::new(gpu, &update())?,
            finish: Kernel::new(gpu, &finish())?,
            limit: Kernel::new(gpu, &limit())?,
            ceiling: Array::uniform(gpu, "opacity ceiling")?,
        })
    }

    /// Records one update of every Gaussian.
    pub(crate) fn record(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        constants: &Array<StepConstants>,
        counts: &Array<u32>,
        lists: &Lists,
        records: &Array<Float4>,
        scene: &DeviceScene,
    ) {
        let DeviceScene { values, first, second, statistics, .. } = scene;
        let n = scene.count;
        let moments = first.colors.over(n).zip(second.colors.over(n));
        for ((chunk, count), ((first_colors, _), (second_colors, _))) in values.colors.over(n).zip(moments) {
            self.update.dispatch(
                pass,
                self.update.grid(count),
                bound![
                    *constants,
                    chunk.place,
                    *counts,
                    lists.runs,
                    *records,
                    lists.splats,
                    values.geometry,
                    chunk.floats,
                    first.geometry,
                    first_colors.floats,
                    second.geometry,
                    second_colors.floats,
                    *statistics,
                ],
            );
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
        self.finish.dispatch(pass, Grid::groups(1), bound![*constants, *counts, *ends]);
    }

    /// Records the kernel that lowers opacities to a logit.
    pub(crate) fn record_limit(
        &self,
        gpu: &Gpu,
        pass: &mut wgpu::ComputePass<'_>,
        scene: &DeviceScene,
        logit: f32,
    ) {
        self.ceiling.write(gpu, 0, &[Ceiling { count: scene.count as u32, logit, pad: [0; 2] }]);
        let DeviceScene { values, first, second, .. } = scene;
        self.limit.dispatch(
            pass,
            self.limit.grid(scene.count),
            bound![self.ceiling, values.geometry, first.geometry, second.geometry],
        );
    }
}

impl StepConstants {
    /// Sets Adam's scalars for step `step` (from 0).
    pub(crate) fn set_rates(&mut self, step: u64, rates: &StepRates) {
        let Adam { beta1, beta2, epsilon, .. } = Adam::SPLATTING;
        let scalars = |rate| Adam::SPLATTING.scalars(step + 1, rate);
        let size = |rate| scalars(rate).step_size();
        self.adam = [beta1 as f32, beta2 as f32, scalars(0.0).root(), epsilon as f32];
        self.rates = [rates.means, rates.scales, rates.quaternions, rates.opacity].map(size);
        self.color_rates = [size(rates.sh_constant), size(rates.sh_directional), 0.0, 0.0];
    }
}
