//! The water on the device: maps of a view, gradients from the sums that the forward pass took along every
//! ray, and Adam.
//!
//! ```text
//! mix ─▶ look ─▶ (the view is drawn, the loss differentiated) ─▶ gather ─▶ total ─▶ spread ─▶ learn
//! ```
//!
//! The formulas are those of `use3d_medium`. Supported are the kinds that consist of spherical harmonics
//! (`rbf`, `global`), and no water. Water that is a network is refused; the processor's engine supports it.
//!
//! The water in front of a pixel enters the compositor as `2^(−k z)` with `k = β |d| log₂e`, where |d| is the
//! length of the pixel's ray at z = 1. So `e` needs no other map, and `∂β = ∂k · log₂e · |d|`.

#[cfg(test)]
mod tests;

use bytemuck::{Pod, Zeroable};
use use3d_capture::{Camera, Formation};
use use3d_medium::{MediumModel, Role};
use use3d_numerics::adam::Adam;
use use3d_numerics::spherical_harmonics::bands;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::constants::counts;
use crate::device::{Gpu, NAME};
use crate::kernel::{Access, Binding, Constant, Kernel, SUM, Spec, U32S, bound, read, write};
use crate::raster::WATER_PLANES;

/// Number of pixels that a workgroup sums.
const SPAN: usize = 1024;
/// Number of coefficients in one set.
const COEFFICIENTS: usize = 144;
/// Camera coordinates are clamped to ± this value, normalised scene units (R4).
const QUERY_LIMIT: f64 = 1.5;

/// The view's constants, in the form that `shared.wgsl` reads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Uniform {
    width: u32,
    height: u32,
    pixels: u32,
    bands: u32,
    anchors: u32,
    shared_by: u32,
    groups: u32,
    parameters: u32,
    to_world: [[f32; 4]; 3],
    lens: [f32; 4],
    adam: [f32; 4],
}

/// The water with all buffers of its kernels.
#[derive(Debug)]
pub(crate) struct DeviceWater {
    /// In the order of [`specs`].
    kernels: [Kernel; 6],
    uniform: Array<Uniform>,
    /// Parameters, first and second moments.
    state: Array<f32>,
    slope: Array<f32>,
    mixed: Array<f32>,
    by_mixed: Array<f32>,
    partial: Array<f32>,
    /// `c_m`, and `k` of attenuation and of backscatter: 3 P each.
    pub(crate) maps: Array<f32>,
    /// The model; its parameters equal the device's only after [`DeviceWater::read`].
    model: MediumModel,
    anchors: usize,
    shared_by: usize,
    constants: Uniform,
}

const WATER: Binding = (Access::Uniform, "water", "Water");

fn spec(
    name: &'static str,
    threads: u32,
    bindings: &[Binding],
    more: &[&'static str],
    text: &'static str,
) -> Spec {
    let mut constants = counts::constants();
    constants.push(("BAD_WATER", Constant::Count(1 << 5)));
    Spec {
        name,
        threads,
        bindings: bindings.to_vec(),
        constants,
        parts: [&[include_str!("shared.wgsl")], more, &[text]].concat(),
    }
}

/// All kernels of the water.
pub(crate) fn specs() -> [Spec; 6] {
    [
        spec("mix", 256, &[WATER, read("parameters"), write("mixed")], &[], include_str!("mix.wgsl")),
        spec("look", 256, &[WATER, read("mixed"), write("maps")], &[], include_str!("look.wgsl")),
        spec(
            "gather",
            128,
            &[WATER, read("maps"), read("image_slope"), (Access::Read, "kept", U32S), write("partial")],
            &[],
            include_str!("gather.wgsl"),
        ),
        spec("total", 128, &[WATER, read("partial"), write("by_mixed")], &[SUM], include_str!("total.wgsl")),
        spec(
            "spread",
            256,
            &[WATER, read("mixed"), read("by_mixed"), read("state"), write("slope")],
            &[SUM],
            include_str!("spread.wgsl"),
        ),
        spec(
            "learn",
            256,
            &[WATER, write("slope"), write("state"), counts::SHARED],
            &[],
            include_str!("learn.wgsl"),
        ),
    ]
}

impl DeviceWater {
    /// Copies a model with Adam's moments to the device; `None` if there is no water. A network is refused.
    pub(crate) fn new(
        gpu: &Gpu,
        model: &MediumModel,
        moments: [&[f32]; 2],
    ) -> Result<Option<Self>, EngineError> {
        if model.is_none() {
            return Ok(None);
        }
        let laid_in_front = model.kind().formation() == Formation::PerGaussian;
        let Some(harmonics) = model.harmonics().filter(|_| laid_in_front) else {
            let what = format!(
                "the water `{}` runs on the processor alone; use `--engine cpu`, or a water of spherical harmonics (medium = \"rbf\" or \"global\")",
                model.kind().name()
            );
            return Err(EngineError::Request { engine: NAME, what });
        };
        let (anchors, shared_by) = harmonics.anchors.map_or((0, 0), |a| (a.centers.len(), a.top_k.max(1)));
        let shared_by = shared_by.min(anchors);
        let values = model.flat();
        let n = values.len();
        if moments.iter().any(|m| m.len() != n) {
            let what = format!("the water has {n} parameters and moments of another number");
            return Err(EngineError::State(what));
        }
        let state: Vec<f32> = values.iter().chain(moments[0]).chain(moments[1]).copied().collect();
        Ok(Some(Self {
            kernels: Kernel::all(gpu, &specs())?,
            uniform: Array::uniform(gpu, "the water's constants")?,
            state: Array::from(gpu, "the water", &state)?,
            slope: Array::from(gpu, "the water's slopes", &vec![0.0; n])?,
            mixed: Array::new(gpu, "the water of a view", COEFFICIENTS + 2 * shared_by)?,
            by_mixed: Array::new(gpu, "slopes of the water of a view", COEFFICIENTS)?,
            partial: Array::new(gpu, "sums of the water", 1)?,
            maps: Array::new(gpu, "the water's maps", 1)?,
            model: model.clone(),
            anchors,
            shared_by,
            constants: Uniform::default(),
        }))
    }

    /// Waits and reads the present model and its moments.
    pub(crate) fn read(&self, gpu: &Gpu) -> Result<(MediumModel, [Vec<f32>; 2]), EngineError> {
        let n = self.model.parameter_count();
        let values = self.state.read(gpu, 3 * n)?;
        let mut model = self.model.clone();
        if !model.set_flat(&values[..n]) {
            return Err(EngineError::State("the water's parameters changed their number".into()));
        }
        Ok((model, [values[n..2 * n].to_vec(), values[2 * n..].to_vec()]))
    }

    /// Resets the moments of the coefficients.
    pub(crate) fn forget_moments(&self, gpu: &Gpu) {
        let n = self.model.parameter_count();
        let mut offset = 0;
        for (role, values) in self.model.groups() {
            if matches!(role, Role::Constant | Role::Directional) {
                for moment in 1..3 {
                    self.state.write(gpu, moment * n + offset, &vec![0.0; values.len()]);
                }
            }
            offset += values.len();
        }
    }

    /// Number of bytes on the device.
    pub(crate) fn memory(&self) -> usize {
        [&self.state, &self.partial, &self.maps].map(Array::size).iter().sum()
    }

    /// Writes the constants of a view and makes room for it. Called before its pass is recorded. `rates`
    /// are Adam's rates of constants and of directions; `step` counts from 0.
    pub(crate) fn prepare(
        &mut self,
        gpu: &Gpu,
        camera: &Camera,
        degree: usize,
        step: u64,
        rates: [f64; 2],
    ) -> Result<(), EngineError> {
        let k = &camera.intrinsics;
        let pixels = k.width * k.height;
        let groups = pixels.div_ceil(SPAN);
        self.maps.grow(gpu, WATER_PLANES * pixels)?;
        self.partial.grow(gpu, COEFFICIENTS * groups)?;
        let to_world = camera.pose.rotation.transpose();
        let here = camera.pose.center().to_array().map(|v| v.clamp(-QUERY_LIMIT, QUERY_LIMIT));
        let row = |axis: usize| {
            let r = to_world.row(axis);
            [r.x as f32, r.y as f32, r.z as f32, here[axis] as f32]
        };
        let [constant, directional] = rates.map(|rate| Adam::SPLATTING.scalars(step + 1, rate));
        self.constants = Uniform {
            width: k.width as u32,
            height: k.height as u32,
            pixels: pixels as u32,
            bands: bands(degree.min(3)) as u32,
            anchors: self.anchors as u32,
            shared_by: self.shared_by as u32,
            groups: groups as u32,
            parameters: self.model.parameter_count() as u32,
            to_world: [row(0), row(1), row(2)],
            lens: [(1.0 / k.fx) as f32, (1.0 / k.fy) as f32, k.cx as f32, k.cy as f32],
            adam: [constant.step_size, directional.step_size, constant.root, 0.0],
        };
        self.uniform.write(gpu, 0, &[self.constants]);
        Ok(())
    }

    /// Records the maps of the view.
    pub(crate) fn record_maps(&self, pass: &mut wgpu::ComputePass<'_>) {
        let [mix, look, ..] = &self.kernels;
        mix.record_groups(pass, 1, bound![self.uniform, self.state, self.mixed]);
        look.record(pass, self.constants.pixels as usize, bound![self.uniform, self.mixed, self.maps]);
    }

    /// Records the gradients with respect to all parameters, computed from the image's gradient and the
    /// values that the forward pass kept (`DeviceCompositor::kept`).
    pub(crate) fn record_backward(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        image_slope: &Array<f32>,
        kept: &Array<u32>,
    ) {
        let [_, _, gather, total, spread, _] = &self.kernels;
        let buffers = bound![self.uniform, self.maps, *image_slope, *kept, self.partial];
        gather.record_groups(pass, self.constants.groups as usize, buffers);
        total.record_groups(pass, COEFFICIENTS, bound![self.uniform, self.partial, self.by_mixed]);
        let buffers = bound![self.uniform, self.mixed, self.by_mixed, self.state, self.slope];
        spread.record_groups(pass, 1, buffers);
    }

    /// Records Adam's step, which reads the gradients and sets them to zero.
    pub(crate) fn record_update(&self, pass: &mut wgpu::ComputePass<'_>, counts: &Array<u32>) {
        let [.., learn] = &self.kernels;
        let buffers = bound![self.uniform, self.slope, self.state, *counts];
        learn.record(pass, self.model.parameter_count(), buffers);
    }

    /// Waits and reads the gradients with respect to all parameters, before [`DeviceWater::record_update`].
    pub(crate) fn slopes(&self, gpu: &Gpu) -> Result<Vec<f32>, EngineError> {
        self.slope.read(gpu, self.model.parameter_count())
    }
}
