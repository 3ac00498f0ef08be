//! Light through a tile's Gaussians and the water, forward and backward.
//!
//! In the forward pass, one thread per pixel runs the processor's compositor in the telescoped form, and
//! sums the values for the water's gradients along the ray (`Σ w e_b`, `Σ w z c e_a`, `Σ w z e_b`). In the
//! portable backward pass, one thread per Gaussian of a round of 64 runs in a diagonal over the tile's
//! pixels. It uses neither subgroups nor float atomics, so its bits depend on no width. If a device has
//! subgroup operations, there is a second backward pass ([`Variant::Subgroups`]): threads hold pixels, and
//! subgroup operations sum up the values of a Gaussian.

use use3d_training::EngineError;

use crate::buffer::Array;
use crate::constants::{CONSTANTS, CONSTANTS_BINDING, StepConstants};
use crate::device::Gpu;
use crate::kernel::{Access, Binding, Constant, Kernel, ROWS, Spec, U32S, bound, read, write};
use crate::lists::ViewLists;
use crate::rows::Float4;
use crate::variant::{EACH, Variant, WIDTHS};

/// Number of threads of the forward pass: the pixels of a tile.
const FORWARD: u32 = 256;
/// Number of threads of the portable backward pass: the Gaussians of a round.
const BACKWARD: u32 = 64;
/// Number of pixels of a tile.
const PIXELS: u32 = 256;

/// The WGSL text that both passes share.
pub(crate) const SHARED: &str = include_str!("raster/shared.wgsl");

/// The bindings of a view's tiles that passes read; [`ViewLists`] in this order.
pub(crate) const TILE: [Binding; 6] = [
    CONSTANTS_BINDING,
    read("axes"),
    (Access::Read, "starts", U32S),
    (Access::Read, "lists", U32S),
    (Access::Read, "owners", U32S),
    (Access::Read, "splats", ROWS),
];
/// The water in front of every pixel: see [`DeviceCompositor`].
pub(crate) const WATER: Binding = read("water");
/// Number of planes of the water: `c_m`, and `k` of attenuation and of backscatter with `e = 2^(−k z)`.
pub(crate) const WATER_PLANES: usize = 9;

/// The first plane of each section of [`DeviceCompositor::kept`], and the number of its planes; as in
/// `shared.wgsl`.
pub(crate) mod kept {
    pub(crate) const ACCUMULATION: usize = 0;
    /// Three images of three planes each: `Σ w e_b`, `Σ w z c e_a`, `Σ w z e_b`; or object, clear and far.
    pub(crate) const SUMS: [usize; 3] = [1, 4, 7];
    /// The entry of its tile's list at which a pixel stopped; 2³¹ − 1 if it did not stop.
    pub(crate) const STOP: usize = 11;
    /// Number of planes for a picture, for one with layers, and for a training.
    pub(crate) const PICTURE: usize = 1;
    pub(crate) const LAYERS: usize = 10;
    pub(crate) const TRAINING: usize = 13;
}

fn spec(
    name: &'static str,
    threads: u32,
    more: &[Binding],
    switches: &[(&'static str, bool)],
    body: &'static str,
) -> Spec {
    Spec {
        name,
        threads,
        bindings: [&TILE[..], &[WATER], more].concat(),
        constants: switches.iter().map(|(name, on)| (*name, Constant::Switch(*on))).collect(),
        parts: vec![CONSTANTS, SHARED, body],
    }
}

/// The outputs of the forward pass besides image, depth and accumulation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Outputs {
    /// No others.
    Picture,
    /// The values for the backward passes.
    Training,
    /// The image's parts, in the buffers of the sums along rays: object, clear, and the water behind the
    /// last Gaussian.
    Layers,
}

const OUTPUTS: [Outputs; 3] = [Outputs::Picture, Outputs::Training, Outputs::Layers];

fn forward(water: bool, outputs: Outputs) -> Spec {
    let more = [write("image"), write("depths"), (Access::Write, "kept", U32S)];
    let switches =
        [("WATER", water), ("TRAIN", outputs == Outputs::Training), ("LAYERS", outputs == Outputs::Layers)];
    spec("forward", FORWARD, &more, &switches, include_str!("raster/forward.wgsl"))
}

fn backward(water: bool, variant: Variant) -> Spec {
    let more = [
        (Access::Read, "kept", U32S),
        read("image_pull"),
        read("depth_pull"),
        (Access::Write, "records", ROWS),
    ];
    let water = [("WATER", water)];
    match variant {
        Variant::Portable => spec("backward", BACKWARD, &more, &water, include_str!("raster/backward.wgsl")),
        Variant::Subgroups { width, pixels } => {
            let body = include_str!("raster/backward_subgroups.wgsl");
            let threads = PIXELS / pixels;
            let mut spec = spec("backward", threads, &more, &water, body);
            // Each thread loads one Gaussian of a round, and its sums lie in workgroup memory.
            let halves = if pixels == 1 || 2 * width > threads { 1 } else { 2 };
            let counts = [("WIDTH", width), ("EACH", pixels), ("HALVES", halves)];
            spec.constants.extend(counts.map(|(name, count)| (name, Constant::Count(count))));
            spec
        }
    }
}

/// All kernels of this module.
pub(crate) fn specs() -> Vec<Spec> {
    let subgroups = WIDTHS.iter().flat_map(|&width| EACH.map(|pixels| Variant::Subgroups { width, pixels }));
    specs_of([Variant::Portable].into_iter().chain(subgroups))
}

/// The kernels that devices of these variants use.
pub(crate) fn specs_of(variants: impl IntoIterator<Item = Variant>) -> Vec<Spec> {
    let both = [false, true];
    let forward = both.iter().flat_map(|w| OUTPUTS.map(|k| forward(*w, k)));
    forward.chain(variants.into_iter().flat_map(|variant| both.map(|w| backward(w, variant)))).collect()
}

/// The kernels, and the values that the forward pass writes for every pixel. Both passes read the water as
/// one buffer of [`WATER_PLANES`].
#[derive(Debug)]
pub(crate) struct DeviceCompositor {
    /// Indexed by water (without, with) and by [`Outputs`].
    forward: [[Kernel; 3]; 2],
    /// Indexed by water (without, with), in the device's variant.
    backward: [Kernel; 2],
    /// Colour planes.
    pub(crate) image: Array<f32>,
    pub(crate) depth: Array<f32>,
    /// All other values of the pixels, in one buffer, because some devices bind only ten in a kernel. Its
    /// sections ([`kept`]) lie one after another in planes of the view's pixels; floats as their bits.
    pub(crate) kept: Array<u32>,
    /// A buffer that is bound instead of absent water.
    nothing: Array<f32>,
}

impl DeviceCompositor {
    pub(crate) fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        let forward = |water| Kernel::all(gpu, &OUTPUTS.map(|outputs| forward(water, outputs)));
        Ok(Self {
            forward: [forward(false)?, forward(true)?],
            backward: Kernel::all(gpu, &[false, true].map(|water| backward(water, gpu.variant)))?,
            image: Array::new(gpu, "image", 1)?,
            depth: Array::new(gpu, "depth", 1)?,
            kept: Array::new(gpu, "values of pixels", 1)?,
            nothing: Array::new(gpu, "no water", 1)?,
        })
    }

    /// Makes room for this number of pixels with these outputs.
    pub(crate) fn grow(&mut self, gpu: &Gpu, pixels: usize, outputs: Outputs) -> Result<(), EngineError> {
        let planes = match outputs {
            Outputs::Picture => kept::PICTURE,
            Outputs::Layers => kept::LAYERS,
            Outputs::Training => kept::TRAINING,
        };
        self.image.grow(gpu, 3 * pixels)?;
        self.depth.grow(gpu, pixels)?;
        self.kept.grow(gpu, planes * pixels)?;
        Ok(())
    }

    /// Number of bytes on the device.
    pub(crate) fn size(&self) -> usize {
        self.image.size() + self.depth.size() + self.kept.size()
    }

    /// Fills everything with NaN.
    #[cfg(test)]
    pub(crate) fn poison(&self, gpu: &Gpu) {
        self.image.poison(gpu);
        self.depth.poison(gpu);
        self.kept.poison(gpu);
    }

    /// The first bindings of both passes: [`TILE`], then the water.
    fn tile(
        &self,
        constants: &Array<StepConstants>,
        drawn: &ViewLists<'_>,
        water: Option<&Array<f32>>,
    ) -> Vec<wgpu::Buffer> {
        let mut buffers = drawn.buffers(constants);
        buffers.extend(bound![*water.unwrap_or(&self.nothing)]);
        buffers
    }

    /// Records the forward pass of `tiles` tiles in this water ([`WATER_PLANES`]). There must be room for
    /// the outputs.
    pub(crate) fn record_forward(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        constants: &Array<StepConstants>,
        tiles: usize,
        drawn: &ViewLists<'_>,
        water: Option<&Array<f32>>,
        outputs: Outputs,
    ) {
        let kernel = &self.forward[usize::from(water.is_some())][outputs as usize];
        let mut buffers = self.tile(constants, drawn, water);
        buffers.extend(bound![self.image, self.depth, self.kept]);
        kernel.record_groups(pass, tiles, buffers);
    }

    /// Records the backward pass: computes every entry's record from the loss's gradients with respect to
    /// image and depth.
    pub(crate) fn record_backward(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        constants: &Array<StepConstants>,
        tiles: usize,
        drawn: &ViewLists<'_>,
        water: Option<&Array<f32>>,
        image_pull: &Array<f32>,
        depth_pull: &Array<f32>,
        records: &Array<Float4>,
    ) {
        let kernel = &self.backward[usize::from(water.is_some())];
        let mut buffers = self.tile(constants, drawn, water);
        buffers.extend(bound![self.kept, *image_pull, *depth_pull, *records]);
        kernel.record_groups(pass, tiles, buffers);
    }
}
