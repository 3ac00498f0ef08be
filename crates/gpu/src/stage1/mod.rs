//! Stage 1 on a graphics card: [`Stage1`] is an engine of `use3d_reconstruct`, and `CpuEngine` is its twin.
//!
//! A step is one submit, and the call returns before it is done. Its report stays on the device until the
//! reports are drained, so that the card never waits for the processor. An error sets a word that stops
//! every later update, so the later steps change nothing. If a view had more entries than room, more room
//! is made and the same steps are requested again. A step is a function of its plan, so the run continues
//! as if there had been room from the start.

mod counted;
mod forecast;
mod step;
mod stored;
mod targets;
#[cfg(test)]
mod tests;

use std::borrow::Cow;
use std::collections::VecDeque;

use use3d_capture::{Camera, Image};
use use3d_medium::MediumModel;
use use3d_reconstruct::density::{self, Draws, Origin, Survey};
use use3d_reconstruct::engine::{Degrees, Engine, Moves, StepPlan, StepReport, TrainingState};
use use3d_reconstruct::{ColorState, Exposures, TrainingView, ViewParameters};
use use3d_splat::Gaussians;
use use3d_training::guard::first_non_finite;
use use3d_training::{Drain, EngineError};

use crate::buffer::Array;
use crate::constants::{StepConstants, counts};
use crate::device::{Gpu, NAME};
use crate::kernel::{Spec, compile, submit};
use crate::lists::Lists;
use crate::losses::Losses;
use crate::per_view::PerView;
use crate::raster::{DeviceCompositor, kept};
use crate::rebuild::RebuildKernel;
use crate::rows::Float4;
use crate::scene::DeviceScene;
use crate::update::UpdateKernels;
use crate::variant::Variant;
use crate::water::DeviceWater;
pub use counted::ViewWork;
pub use forecast::training_bytes;
use stored::Unpacked;
pub(crate) use stored::unpack;
use targets::Targets;

/// Number of reports for which there is room on the device.
const RING: usize = 256;
/// Number of steps under way before their reports are waited for: the device has enough work, and little is
/// done twice after an overflow.
const UNDER_WAY: usize = 50;
/// Number of floats of a report.
const REPORT: usize = 16;
/// The name of the views' gains on the device and in messages.
const GAINS: &str = "the views' gains";

/// Every kernel that a training on a device of this variant may use.
fn all_specs(variant: Variant) -> Vec<Spec> {
    [
        &crate::sort::specs()[..],
        &crate::lists::specs(),
        &crate::raster::specs_of([variant]),
        &crate::update::specs(),
        &[crate::rebuild::gather()],
        &crate::losses::specs(),
        &crate::water::specs(),
        &[unpack()],
    ]
    .concat()
}

/// A step that was requested and not reported yet.
#[derive(Debug)]
struct Asked {
    view: usize,
    plan: StepPlan,
    /// Its index in the ring of reports.
    slot: usize,
}

/// Stage 1's engine on a device.
#[derive(Debug)]
pub struct Stage1 {
    gpu: Gpu,
    update: UpdateKernels,
    rebuild: RebuildKernel,
    targets: Targets,
    scene: DeviceScene,
    lists: Lists,
    compositor: DeviceCompositor,
    losses: Losses,
    water: Option<DeviceWater>,
    gains: PerView,
    /// The floats of a step's view.
    unpacked: Unpacked,
    image_slope: Array<f32>,
    depth_slope: Array<f32>,
    records: Array<Float4>,
    /// The gradients of the Gaussians' colours.
    color_pull: Array<f32>,
    constants: Array<StepConstants>,
    counts: Array<u32>,
    /// The counts of renders, which do not stop the training.
    render_counts: Array<u32>,
    reports: Array<f32>,
    ends: Array<[u32; 4]>,
    asked: VecDeque<Asked>,
    slot: usize,
    done: Vec<StepReport>,
    /// The shapes that a survey read, kept as long as they are the scene's.
    surveyed: Option<Gaussians>,
}

impl Stage1 {
    /// An engine without views and with an empty scene.
    pub fn new(gpu: &Gpu) -> Result<Self, EngineError> {
        compile(gpu, &all_specs(gpu.variant))?;
        Ok(Self {
            update: UpdateKernels::new(gpu)?,
            rebuild: RebuildKernel::new(gpu)?,
            targets: Targets::default(),
            scene: DeviceScene::new(gpu)?,
            lists: Lists::new(gpu)?,
            compositor: DeviceCompositor::new(gpu)?,
            losses: Losses::new(gpu)?,
            water: None,
            gains: PerView::new(gpu, GAINS, &ViewParameters::default())?,
            unpacked: Unpacked::new(gpu)?,
            image_slope: Array::new(gpu, "slopes of the image", 1)?,
            depth_slope: Array::new(gpu, "slopes of depth", 1)?,
            records: Array::new(gpu, "records", 1)?,
            color_pull: Array::new(gpu, "gradients of colours", 1)?,
            constants: Array::uniform(gpu, "constants")?,
            counts: Array::new(gpu, "counts", counts::WORDS)?,
            render_counts: Array::new(gpu, "counts of a render", counts::WORDS)?,
            reports: Array::new(gpu, "reports", REPORT * RING)?,
            ends: Array::new(gpu, "ends of steps", RING)?,
            asked: VecDeque::new(),
            slot: 0,
            done: Vec::new(),
            surveyed: None,
            gpu: gpu.clone(),
        })
    }

    fn refused<T>(&self, what: String) -> Result<T, EngineError> {
        Err(EngineError::Request { engine: NAME, what })
    }

    /// The water in the form that the compositor reads.
    fn water_planes(&self) -> Option<&Array<f32>> {
        self.water.as_ref().map(|water| &water.maps)
    }

    /// Makes room for one and a half times the entries of a view that needs `most`.
    fn make_room(&mut self, most: usize) -> Result<(), EngineError> {
        let entries = most + most / 2;
        self.lists.grow(&self.gpu, entries)?;
        self.records.grow(&self.gpu, 3 * self.lists.capacity())?;
        Ok(())
    }

    /// Waits for the requested steps and reads their reports.
    fn settle(&mut self) -> Result<(), EngineError> {
        while !self.asked.is_empty() {
            let ends = self.ends.read(&self.gpu, RING)?;
            let reports = self.reports.read(&self.gpu, REPORT * RING)?;
            while let Some(asked) = self.asked.front() {
                let [stop, step, bad, _] = ends[asked.slot];
                if stop == counts::OVERFLOW && step == asked.plan.step as u32 {
                    // The later steps changed nothing, but they counted the entries that their views need.
                    let most = self.counts.read(&self.gpu, counts::WORDS)?[counts::MOST];
                    self.make_room(most as usize)?;
                    self.again()?;
                    break;
                }
                let numbers = &reports[REPORT * asked.slot..][..REPORT];
                let mut report = step::report(asked, numbers, self.targets.views[asked.view].prior.is_some());
                if stop != 0 {
                    report.non_finite = Some(self.not_finite(bad)?);
                    // The steps requested after it changed nothing.
                    self.asked.clear();
                } else {
                    self.asked.pop_front();
                }
                self.done.push(report);
            }
        }
        Ok(())
    }

    /// Requests again the steps that an overflow left undone.
    fn again(&mut self) -> Result<(), EngineError> {
        self.counts.write(&self.gpu, 0, &[0; counts::WORDS]);
        let asked: Vec<Asked> = self.asked.drain(..).collect();
        for Asked { view, plan, .. } in asked.iter().rev() {
            if plan.exposure.is_some() {
                self.gains.undo(*view);
            }
        }
        for Asked { view, plan, .. } in asked {
            self.ask(view, plan)?;
        }
        Ok(())
    }

    /// Returns the first array that the bits of a stop describe, and the index of its first bad value.
    fn not_finite(&self, bad: u32) -> Result<(&'static str, Option<usize>), EngineError> {
        if bad & (1 << 7) != 0 {
            return Ok(("the loss", None));
        }
        let Gaussians { means, log_scales, quaternions, opacity_logits, sh, .. } =
            self.scene.gaussians(&self.gpu)?;
        let arrays: [(&'static str, &[f32]); 5] = [
            ("means", means.as_flattened()),
            ("log scales", log_scales.as_flattened()),
            ("quaternions", quaternions.as_flattened()),
            ("opacity logits", &opacity_logits),
            ("colour coefficients", sh.as_flattened().as_flattened()),
        ];
        if let Some((_, (name, values))) = arrays.iter().enumerate().find(|(at, _)| bad & (1 << at) != 0) {
            return Ok((name, first_non_finite(values)));
        }
        match &self.water {
            Some(water) if bad & (1 << 5) != 0 => {
                let (model, _) = water.read(&self.gpu)?;
                Ok(("the water's parameters", first_non_finite(&model.flat())))
            }
            _ => Ok((GAINS, None)),
        }
    }
}

impl Engine for Stage1 {
    fn upload(&mut self, view: TrainingView) -> Result<usize, EngineError> {
        self.gpu.check()?;
        // The first steps may be smaller than the view, and the last ones are not.
        let lens = &view.camera.intrinsics;
        self.gpu.fits("values of pixels", (4 * kept::TRAINING * lens.width * lens.height) as u64)?;
        self.targets.views.push(view);
        Ok(self.targets.views.len() - 1)
    }

    fn load(&mut self, state: TrainingState) -> Result<(), EngineError> {
        state.check(self.targets.views.len())?;
        if !state.colors.is_off() {
            return self.refused(format!(
                "the colour field `{}` runs only on the processor",
                state.colors.field.name()
            ));
        }
        self.asked.clear();
        self.done.clear();
        self.surveyed = None;
        let TrainingState { gaussians, moments, statistics, medium, medium_moments, exposures, .. } = &state;
        self.water = DeviceWater::new(&self.gpu, medium, [&medium_moments[0], &medium_moments[1]])?;
        self.gains = PerView::new(&self.gpu, GAINS, &exposures.log_gains)?;
        self.gpu.forget_bindings();
        self.scene.write(&self.gpu, gaussians, moments, statistics)?;
        self.counts.write(&self.gpu, 0, &[0; counts::WORDS]);
        self.make_room(0)?;
        self.gpu.check()
    }

    fn save(&mut self) -> Result<Cow<'_, TrainingState>, EngineError> {
        self.settle()?;
        let gpu = &self.gpu;
        let (medium, medium_moments) = match &self.water {
            Some(water) => water.read(gpu)?,
            None => (MediumModel::None, [Vec::new(), Vec::new()]),
        };
        Ok(Cow::Owned(TrainingState {
            version: TrainingState::VERSION,
            gaussians: self.scene.gaussians(gpu)?,
            moments: self.scene.moments(gpu)?,
            statistics: self.scene.statistics(gpu)?,
            medium,
            medium_moments,
            exposures: Exposures { log_gains: self.gains.read(gpu)? },
            colors: ColorState::default(),
        }))
    }

    fn step(&mut self, view: usize, plan: &StepPlan) -> Result<(), EngineError> {
        let views = self.targets.views.len();
        if view >= views {
            return self.refused(format!("view {view} was not uploaded; there are {views}"));
        }
        if plan.moves != Moves::All {
            return self.refused("turns of the water or the colours run on the processor alone".into());
        }
        self.surveyed = None;
        if self.asked.len() >= UNDER_WAY {
            self.settle()?;
        }
        self.ask(view, plan.clone())
    }

    fn drain(&mut self, which: Drain) -> Result<Vec<StepReport>, EngineError> {
        if which == Drain::All {
            self.settle()?;
        }
        Ok(std::mem::take(&mut self.done))
    }

    fn survey(&mut self) -> Result<Survey, EngineError> {
        self.settle()?;
        let shapes = self.scene.shapes(&self.gpu)?;
        let survey = Survey::of(&shapes, &self.scene.statistics(&self.gpu)?);
        self.surveyed = Some(shapes);
        Ok(survey)
    }

    fn forget_statistics(&mut self) -> Result<(), EngineError> {
        self.settle()?;
        self.scene.forget_statistics(&self.gpu);
        self.gpu.check()
    }

    /// Everything is done on the device except the shapes of children, so that these are the same for every
    /// engine.
    fn rebuild(&mut self, rows: &[Origin], draws: &Draws) -> Result<(), EngineError> {
        self.settle()?;
        let n = self.scene.count;
        if let Some(row) = rows.iter().position(|row| row.source() >= n) {
            let from = rows[row].source();
            return self.refused(format!("row {row} comes from Gaussian {from}; there are {n}"));
        }
        let shapes = self.surveyed.take();
        let same = |(i, row): (usize, &Origin)| *row == Origin::Kept(i);
        if rows.len() == n && rows.iter().enumerate().all(same) {
            self.scene.forget_statistics(&self.gpu);
            return self.gpu.check();
        }
        let shapes = shapes.map_or_else(|| self.scene.shapes(&self.gpu), Ok)?;
        DeviceScene::refuse_more(&self.gpu, rows.len())?;
        // The records of a step are no longer needed: their memory is used to move the rows.
        self.records.let_go(&self.gpu);
        self.scene.rebuild(&self.gpu, &self.rebuild, &shapes, rows, draws)?;
        self.records.grow(&self.gpu, 3 * self.lists.capacity())?;
        self.gpu.check()
    }

    fn limit_opacity(&mut self, ceiling: f64) -> Result<(), EngineError> {
        self.settle()?;
        self.surveyed = None;
        let (gpu, logit) = (&self.gpu, density::logit(ceiling));
        submit(gpu, "opacity ceiling", |pass| self.update.record_limit(gpu, pass, &self.scene, logit))
    }

    fn forget_water_moments(&mut self) -> Result<(), EngineError> {
        self.settle()?;
        if let Some(water) = &self.water {
            water.forget_moments(&self.gpu);
        }
        self.gpu.check()
    }

    fn render(&mut self, camera: &Camera, degrees: Degrees, out: &mut Image) -> Result<(), EngineError> {
        self.settle()?;
        self.draw(camera, degrees)?;
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let planes = self.compositor.image.read(&self.gpu, 3 * width * height)?;
        out.resize(width, height);
        out.data_mut().copy_from_slice(&planes);
        Ok(())
    }

    fn memory(&self) -> usize {
        let slopes = self.image_slope.size() + self.depth_slope.size();
        let planes = self.compositor.size() + self.unpacked.size() + slopes;
        let water = self.water.as_ref().map_or(0, DeviceWater::memory);
        let records = self.records.size() + self.color_pull.size();
        let step = self.lists.size() + records + self.losses.memory() + water + planes;
        self.scene.size() + step + self.targets.size()
    }
}
