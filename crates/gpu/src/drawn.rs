//! Views of Gaussians that are drawn and not trained.

use use3d_capture::{Camera, Lattice};
use use3d_splat::Gaussians;
use use3d_training::EngineError;

use crate::buffer::Array;
use crate::constants::{StepConstants, counts};
use crate::device::Gpu;
use crate::kernel::submit;
use crate::lists::Lists;
use crate::raster::{DeviceCompositor, Outputs};
use crate::rows::Float4;
use crate::scene::Parameters;

/// Gaussians on a device that are drawn and not trained, and the lists of one view of them.
#[derive(Debug)]
pub(crate) struct DrawnScene {
    pub(crate) gpu: Gpu,
    pub(crate) parameters: Parameters,
    /// Number of Gaussians.
    pub(crate) count: usize,
    pub(crate) lists: Lists,
    /// The constants of the view.
    pub(crate) constants: Array<StepConstants>,
    pub(crate) counts: Array<u32>,
}

impl DrawnScene {
    /// Copies the Gaussians to a device; `counts` names the buffer of the counts in messages.
    pub(crate) fn new(gpu: &Gpu, gaussians: &Gaussians, counts: &'static str) -> Result<Self, EngineError> {
        Ok(Self {
            parameters: Parameters::of(gpu, gaussians)?,
            count: gaussians.len(),
            lists: Lists::new(gpu)?,
            constants: Array::uniform(gpu, "constants")?,
            counts: Array::new(gpu, counts, counts::WORDS)?,
            gpu: gpu.clone(),
        })
    }

    /// Draws a view in this water, and makes more room for entries if needed. `degree` is that of the
    /// colours' harmonics; without it, the colours are given, three numbers each. There is a record for each
    /// entry in `records`, if they are requested.
    pub(crate) fn draw(
        &mut self,
        compositor: &mut DeviceCompositor,
        (camera, lattice): (&Camera, &Lattice),
        degree: Option<usize>,
        water: Option<&Array<f32>>,
        mut records: Option<&mut Array<Float4>>,
        outputs: Outputs,
    ) -> Result<StepConstants, EngineError> {
        let Self { gpu, parameters, count, lists, constants: uniform, counts } = self;
        compositor.grow(gpu, lattice.width() * lattice.height(), outputs)?;
        loop {
            let room = lists.capacity();
            let mut constants = StepConstants::on(camera, lattice, *count, degree.unwrap_or(0), room);
            if degree.is_none() {
                constants.counts[1] = 0;
            }
            lists.prepare(gpu, &constants, lattice)?;
            if let Some(records) = &mut records {
                records.grow(gpu, room)?;
            }
            uniform.write(gpu, 0, &[constants]);
            counts.write(gpu, 0, &[0; counts::WORDS]);
            submit(gpu, "view", |pass| {
                let tiles = constants.tiles();
                lists.record(pass, uniform, *count, tiles, parameters, counts, records.as_deref());
                compositor.record_forward(pass, uniform, tiles, &lists.drawn(), water, outputs);
            })?;
            if lists.had_room(gpu, counts)? {
                return Ok(constants);
            }
        }
    }
}
