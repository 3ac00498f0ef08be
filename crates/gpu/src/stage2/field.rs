//! The field on the device: parameters with Adam's moments, a view's colours and water under them, and the
//! backward pass.
//!
//! ```text
//! lookup ─▶ grade ─▶ recolor, water ─▶ (the view is drawn and compared: the image's gradient)
//!   ─▶ colours, recolor backward, water backward ─▶ totals ─▶ table ─▶ lookup backward
//!   ─▶ units, nodes ─▶ totals ─▶ gradient ─▶ Adam
//! ```
//!
//! A lookup is a row of `sites`: a listed Gaussian, or one of the sixteen rows of the water's table, which
//! are looked up at the camera with fixed guides. So water and objects share the field's kernels. One
//! thread per hidden unit sums the gradients of the decoder's weights over a block of lookups, and one
//! thread per node those of the factors. There are at most 256 blocks, and their number follows from the
//! number of lookups alone.

use bytemuck::{Pod, Zeroable};
use use3d_enhance::engine::{FieldPlan, FieldState};
use use3d_numerics::adam::Adam;
use use3d_training::EngineError;
use use3d_ubaf::{OUTPUTS, Shape, water};

use super::frozen::FrozenView;
use super::kernels::{
    COLOR_SUMS, FieldKernels, GRADE, GUIDE_SUMS, LOOKUPS, NONE, Of, WATER_SPAN, WATER_SUMS,
};
use super::weights::{FrozenWeights, PairLists};
use crate::buffer::Array;
use crate::device::Gpu;
use crate::kernel::bound;
use crate::raster::{DeviceCompositor, Outputs, WATER_PLANES};
use crate::rows::Float4;

/// Largest number of blocks of the sums over lookups.
const BLOCKS: usize = 256;

/// The struct of `field.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
struct Constants {
    resolution: u32,
    width: u32,
    listed: u32,
    centred: u32,
    lookups: u32,
    pixels: u32,
    per_block: u32,
    blocks: u32,
    hidden_weight: u32,
    hidden_bias: u32,
    output_weight: u32,
    output_bias: u32,
    guide: u32,
    affine: u32,
    transport: u32,
    parameters: u32,
    unit_groups: u32,
    node_groups: u32,
    lookup_groups: u32,
    water_groups: u32,
    adam: [f32; 4],
}

impl Constants {
    /// The constants of a view, for a step or without one.
    fn new(shape: Shape, view: &FrozenView, plan: Option<&FieldPlan>) -> Self {
        let rows = if view.water.is_some() { water::ROWS } else { 0 };
        let lookups = view.listed + rows;
        let per_block = lookups.div_ceil(BLOCKS).next_multiple_of(LOOKUPS).max(LOOKUPS);
        let word = |n: usize| n as u32;
        let adam = plan.map_or([0.0; 4], |plan| {
            let scalars = |rate| Adam::SPLATTING.scalars(plan.step + 1, rate);
            let (field, ratios) = (scalars(plan.rate), scalars(plan.transport_rate));
            [field.step_size, ratios.step_size, field.root, 0.0]
        });
        Self {
            resolution: word(shape.resolution),
            width: word(shape.width),
            listed: word(view.listed),
            centred: word(view.centred),
            lookups: word(lookups),
            pixels: word(view.pixels()),
            per_block: word(per_block),
            blocks: word(lookups.div_ceil(per_block)),
            hidden_weight: word(shape.hidden_weight().start),
            hidden_bias: word(shape.hidden_bias().start),
            output_weight: word(shape.output_weight().start),
            output_bias: word(shape.output_bias().start),
            guide: word(shape.guide().start),
            affine: word(shape.affine().start),
            transport: word(shape.transport().start),
            parameters: word(shape.parameters()),
            unit_groups: word(shape.width.div_ceil(LOOKUPS)),
            node_groups: word((4 * shape.resolution).div_ceil(LOOKUPS)),
            lookup_groups: word(lookups.div_ceil(LOOKUPS)),
            water_groups: word(if rows == 0 { 0 } else { view.pixels().div_ceil(WATER_SPAN) }),
            adam,
        }
    }
}

/// A field of one shape on the device.
#[derive(Debug)]
pub(super) struct DeviceField {
    shape: Shape,
    kernels: FieldKernels,
    constants: Array<Constants>,
    /// The constants of the prepared view.
    now: Constants,
    /// Parameters, first and second moments.
    pub(super) state: Array<f32>,
    pub(super) gradient: Array<f32>,
    /// Gradient of the loss's terms that read the field itself.
    pub(super) of_field: Array<f32>,
    pub(super) status: Array<u32>,
    pub(super) raw: Array<f32>,
    pub(super) grade: Array<f32>,
    slopes: Array<f32>,
    /// The codes of lookups, and the gradients with respect to them.
    codes: Array<f32>,
    by_codes: Array<f32>,
    records: Array<Float4>,
    totals: Array<f32>,
    of_mean: Array<Float4>,
    of_colors: Array<f32>,
    of_water: Array<f32>,
    of_guide: Array<f32>,
    of_parameters: Array<f32>,
    /// The enhanced water, in the form that the compositor reads.
    pub(super) water: Array<f32>,
}

impl DeviceField {
    pub(super) fn new(gpu: &Gpu, shape: Shape) -> Result<Self, EngineError> {
        let n = shape.parameters();
        let floats = |what, items| Array::new(gpu, what, items);
        Ok(Self {
            shape,
            kernels: FieldKernels::new(gpu, shape.rank)?,
            constants: Array::uniform(gpu, "the field's constants")?,
            now: Constants::default(),
            state: floats("the field", 3 * n)?,
            gradient: floats("the field's gradient", n)?,
            of_field: floats("slopes of the field's own terms", n)?,
            status: Array::from(gpu, "status", &[NONE; 2])?,
            raw: floats("outputs", 1)?,
            grade: floats("mean, table and ratios", GRADE)?,
            slopes: floats("slopes of outputs", 1)?,
            codes: floats("codes", 1)?,
            by_codes: floats("slopes of codes", 1)?,
            records: Array::new(gpu, "records of colours", 1)?,
            totals: floats("totals", COLOR_SUMS + WATER_SUMS + GUIDE_SUMS)?,
            of_mean: Array::new(gpu, "sums of outputs", 1)?,
            of_colors: floats("sums of colours", 1)?,
            of_water: floats("sums of the water", 1)?,
            of_guide: floats("sums of the guide", 1)?,
            of_parameters: floats("sums of parameters", 1)?,
            water: floats("the enhanced water", 1)?,
        })
    }

    /// Writes parameters and moments, whose number was checked.
    pub(super) fn write(&self, gpu: &Gpu, state: &FieldState) {
        let n = self.shape.parameters();
        for (k, values) in [&state.parameters, &state.first, &state.second].into_iter().enumerate() {
            self.state.write(gpu, k * n, values);
        }
        self.status.write(gpu, 0, &[NONE; 2]);
    }

    /// Waits and reads parameters and moments.
    pub(super) fn read(&self, gpu: &Gpu) -> Result<FieldState, EngineError> {
        let n = self.shape.parameters();
        let values = self.state.read(gpu, 3 * n)?;
        Ok(FieldState {
            version: FieldState::VERSION,
            parameters: values[..n].to_vec(),
            first: values[n..2 * n].to_vec(),
            second: values[2 * n..].to_vec(),
        })
    }

    /// Prepares a view; with a plan, for a step.
    pub(super) fn prepare(
        &mut self,
        gpu: &Gpu,
        view: &FrozenView,
        plan: Option<&FieldPlan>,
    ) -> Result<(), EngineError> {
        self.now = Constants::new(self.shape, view, plan);
        let Constants { lookups, blocks, lookup_groups, water_groups, output_bias, .. } = self.now;
        let [lookups, blocks, groups, water_groups, width] =
            [lookups, blocks, lookup_groups, water_groups, output_bias].map(|n| n as usize);
        let pixels = view.pixels();
        for (array, items) in [
            (&mut self.raw, OUTPUTS * lookups),
            (&mut self.slopes, OUTPUTS * lookups),
            (&mut self.codes, self.shape.rank * lookups),
            (&mut self.by_codes, self.shape.rank * lookups),
            (&mut self.of_colors, COLOR_SUMS * groups),
            (&mut self.of_water, WATER_SUMS * water_groups),
            (&mut self.of_guide, GUIDE_SUMS * groups),
            (&mut self.of_parameters, width * blocks),
            (&mut self.water, WATER_PLANES * pixels),
        ] {
            array.grow(gpu, items)?;
        }
        self.of_mean.grow(gpu, 2 * groups)?;
        self.records.grow(gpu, view.entries)?;
        self.constants.write(gpu, 0, &[self.now]);
        Ok(())
    }

    /// Records the field at every lookup of a view, and the mean that is removed from it.
    pub(super) fn record_lookup(&self, pass: &mut wgpu::ComputePass<'_>, view: &FrozenView) {
        let (k, constants) = (&self.kernels, &self.constants);
        let buffers = bound![*constants, self.state, view.sites, self.raw, self.of_mean];
        k.lookup.record_groups(pass, self.now.lookup_groups as usize, buffers);
        let buffers = bound![*constants, self.state, self.raw, self.of_mean, self.grade];
        k.grade.record_groups(pass, 1, buffers);
    }

    /// Records the colours and the water of a view under the present field.
    pub(super) fn record_forward(&self, pass: &mut wgpu::ComputePass<'_>, view: &FrozenView) {
        self.record_lookup(pass, view);
        let (k, constants) = (&self.kernels, &self.constants);
        let buffers = bound![*constants, self.state, self.raw, self.grade, view.base, view.splats];
        k.recolor.record(pass, view.listed, buffers);
        if let Some(water) = &view.water {
            let buffers = bound![*constants, self.state, self.grade, *water, self.water];
            k.water.record(pass, view.pixels(), buffers);
        }
    }

    /// Records the image of a view and the sums along its rays, after [`DeviceField::record_forward`].
    pub(super) fn record_image(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        view: &FrozenView,
        compositor: &DeviceCompositor,
    ) {
        if let Some(FrozenWeights { sizes, of_pixels: PairLists { firsts, pairs }, .. }) = &view.weights {
            let forward = &self.kernels.frozen_forward[usize::from(view.water.is_some())];
            let DeviceCompositor { image, kept, .. } = compositor;
            let buffers = bound![*sizes, *firsts, *pairs, view.splats, self.water, *image, *kept];
            forward.record(pass, view.pixels(), buffers);
            return;
        }
        let water = view.water.is_some().then_some(&self.water);
        let (drawn, outputs) = (view.drawn(), Outputs::Training);
        compositor.record_forward(pass, &view.constants, view.tiles, &drawn, water, outputs);
    }

    /// Records the gradient, computed from the image's gradient and the values that the forward pass of the
    /// view left in `kept`.
    pub(super) fn record_backward(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        view: &FrozenView,
        kept: &Array<u32>,
        image_pull: &Array<f32>,
    ) {
        let wet = usize::from(view.water.is_some());
        if let Some(FrozenWeights { sizes, of_entries: PairLists { firsts, pairs }, .. }) = &view.weights {
            let mut buffers = bound![*sizes, *firsts, *pairs, view.owners, view.splats];
            buffers.extend(bound![self.water, *image_pull, self.records]);
            self.kernels.frozen_colors[wet].record(pass, view.entries, buffers);
        } else {
            let mut buffers = view.drawn().buffers(&view.constants);
            buffers.extend(bound![self.water, *kept, *image_pull, self.records]);
            self.kernels.colors[wet].record_groups(pass, view.tiles, buffers);
        }
        self.record_from_records(pass, view, kept, image_pull);
    }

    /// Records the gradient starting from the colours' records.
    fn record_from_records(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        view: &FrozenView,
        kept: &Array<u32>,
        image_pull: &Array<f32>,
    ) {
        let Self { kernels: k, constants, state, raw, grade, records, slopes, totals, .. } = self;
        let mut buffers = bound![*constants, *state, *raw, *grade, view.base, view.runs];
        buffers.extend(bound![*records, *slopes, self.of_colors]);
        k.recolor_back.record(pass, view.listed, buffers);
        let total = |pass: &mut wgpu::ComputePass<'_>, of, sums: &Array<f32>, to: &Array<f32>, width| {
            k.total(of).record_groups(pass, width, bound![*constants, *sums, *to]);
        };
        total(pass, Of::Colors, &self.of_colors, totals, COLOR_SUMS);
        let now = &self.now;
        if let Some(water) = &view.water {
            let buffers = bound![*constants, *state, *grade, *water, *image_pull, *kept, self.of_water];
            k.water_back.record_groups(pass, now.water_groups as usize, buffers);
            total(pass, Of::Water, &self.of_water, totals, WATER_SUMS);
            k.table_back.record_groups(pass, 1, bound![*constants, *totals, *grade, *slopes]);
        }
        let mut buffers = bound![*constants, *state, view.sites, *totals, *slopes];
        buffers.extend(bound![self.codes, self.by_codes, self.of_guide]);
        k.lookup_back.record_groups(pass, now.lookup_groups as usize, buffers);
        total(pass, Of::Guide, &self.of_guide, totals, GUIDE_SUMS);
        let buffers = bound![*constants, *state, *slopes, self.codes, self.of_parameters];
        k.units.record_groups(pass, (now.blocks * now.unit_groups) as usize, buffers);
        let buffers = bound![*constants, *state, view.sites, self.by_codes, self.of_parameters];
        k.nodes.record_groups(pass, (now.blocks * now.node_groups) as usize, buffers);
        total(pass, Of::Parameters, &self.of_parameters, &self.gradient, now.output_bias as usize);
        let gradient = &k.gradient[usize::from(view.water.is_some())];
        let mut buffers = bound![*constants, *state, *totals, *grade];
        buffers.extend(bound![self.of_field, self.gradient, self.status]);
        gradient.record(pass, now.parameters as usize, buffers);
    }

    /// Fills everything that a step writes with NaN.
    #[cfg(test)]
    pub(super) fn poison(&self, gpu: &Gpu) {
        for array in [
            &self.gradient,
            &self.raw,
            &self.grade,
            &self.slopes,
            &self.codes,
            &self.by_codes,
            &self.totals,
            &self.of_colors,
            &self.of_water,
            &self.of_guide,
            &self.of_parameters,
            &self.water,
        ] {
            array.poison(gpu);
        }
        self.of_mean.poison(gpu);
        self.records.poison(gpu);
    }

    /// Records Adam's step with the gradient.
    pub(super) fn record_update(&self, pass: &mut wgpu::ComputePass<'_>) {
        let learn = &self.kernels.learn;
        let buffers = bound![self.constants, self.gradient, self.state, self.status];
        learn.record(pass, self.shape.parameters(), buffers);
    }
}
