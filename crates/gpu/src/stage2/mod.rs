//! Stage 2 on a graphics card: [`Stage2`] is an engine of `use3d_enhance`, and `CpuFieldEngine` is its twin.
//!
//! Geometry is frozen, so a view's splats and lists are made once and kept on the device up to the limit
//! `cache_mib`. A step looks the field up, draws the view on its sparse lattice, and computes the gradient
//! of the field and Adam, all on the device. Between the two halves the lattice's pixels, some ten thousand
//! numbers, pass through main memory: the extractor solves its systems in f64, which cards do not have, and
//! is the processor's own function ([`Measure`]). So a step waits for the device once. The status of a
//! step's second half is read with the next step's first half, or by a call to drain, save or evaluate.

mod field;
mod frozen;
mod kernels;
#[cfg(test)]
mod tests;
mod weights;

use use3d_capture::{Appearance, Camera, Formation, Image, Lattice};
use use3d_enhance::engine::{
    Coverage, FieldEngine, FieldPlan, FieldReport, FieldState, Goals, Measure, Reading, Reference,
    References, centred, check_inputs, initial_field,
};
use use3d_enhance::{EnhanceError, EnhanceParams, EnhanceView, Guidance, ViewErrors};
use use3d_scene::Scene;
use use3d_training::{Drain, EngineError, Observer};
use use3d_ubaf::{Field, Gradient, OUTPUTS, ObjectPass};

use crate::buffer::{Array, read_together};
use crate::device::{Gpu, NAME};
use crate::kernel::submit;
use crate::raster::{DeviceCompositor, Outputs};
use field::DeviceField;
use frozen::{Freezer, FrozenView};
use kernels::{BAD_GRADIENT, BAD_PARAMETER, NONE};

pub(crate) use kernels::{colors as colors_backward, specs};

/// The small constants of a view.
#[derive(Debug)]
struct KnownView {
    view: EnhanceView,
    lattice: Lattice,
    reference: Reference,
}

/// The large constants of views: those that are kept, and the last ones that were made in addition.
#[derive(Debug, Default)]
struct Kept {
    views: Vec<Option<FrozenView>>,
    spare: Option<(usize, FrozenView)>,
}

impl Kept {
    fn get(&self, index: usize) -> Option<&FrozenView> {
        let spare = self.spare.as_ref().filter(|(of, _)| *of == index).map(|(_, view)| view);
        self.views.get(index).and_then(Option::as_ref).or(spare)
    }
}

/// The buffers and kernels that draw a view under the present field.
#[derive(Debug)]
struct FieldDrawing {
    gpu: Gpu,
    compositor: DeviceCompositor,
    /// The gradient of the image.
    pull: Array<f32>,
    device: DeviceField,
    /// The field as it was last read.
    field: Field,
    /// The gradient of the terms that read the field, and its rounded form for the device.
    of_field: Gradient,
    rounded: Vec<f32>,
    /// The render that was last read.
    image: Image,
}

impl FieldDrawing {
    /// Makes a view's constants; its stage-1 render is read into `image`.
    fn freeze(
        &mut self,
        freezer: &mut Freezer<'_>,
        camera: &Camera,
        lattice: &Lattice,
        guidance: Guidance<'_>,
    ) -> Result<FrozenView, EngineError> {
        let Self { gpu, compositor, field, .. } = self;
        let view = freezer.freeze(compositor, field, camera, lattice, guidance)?;
        let pixels = compositor.image.read(gpu, 3 * view.pixels())?;
        self.take(&view, &pixels);
        Ok(view)
    }

    fn take(&mut self, view: &FrozenView, pixels: &[f32]) {
        self.image.resize(view.size.0, view.size.1);
        self.image.data_mut().copy_from_slice(pixels);
    }

    /// Draws a view, reads render and parameters, and returns the status of the step before.
    fn draw(&mut self, view: &FrozenView, plan: Option<&FieldPlan>) -> Result<[u32; 2], EngineError> {
        let Self { gpu, compositor, device, .. } = self;
        device.prepare(gpu, view, plan)?;
        compositor.grow(gpu, view.pixels(), Outputs::Training)?;
        submit(gpu, "a view under the field", |pass| {
            device.record_forward(pass, view);
            device.record_image(pass, view, compositor);
        })?;
        let image = (compositor.image.raw(), 3 * view.pixels());
        let parameters = (device.state.raw(), self.field.parameters.len());
        let [pixels, values, status] = read_together(gpu, [image, parameters, (device.status.raw(), 2)])?;
        self.take(view, bytemuck::cast_slice(&pixels));
        self.field.parameters.copy_from_slice(bytemuck::cast_slice(&values));
        Ok([status[0], status[1]])
    }

    /// Computes the gradient of the field from that of the last drawn render, adds that of the terms that
    /// read the field itself, and runs Adam's step.
    fn learn(&mut self, view: &FrozenView, goals: &Goals, d_image: &Image) -> Result<(), EngineError> {
        let Self { gpu, compositor, device, pull, field, of_field, rounded, .. } = self;
        of_field.clear();
        goals.field_backward(field, of_field);
        of_field.round_into(rounded);
        device.of_field.write(gpu, 0, rounded);
        pull.grow(gpu, d_image.data().len())?;
        pull.write(gpu, 0, d_image.data());
        submit(gpu, "the field's step", |pass| {
            device.record_backward(pass, view, &compositor.kept, pull);
            device.record_update(pass);
        })
    }
}

/// Stage 2's engine on a device.
pub struct Stage2<'a> {
    scene: &'a Scene,
    guidance: Guidance<'a>,
    goals: Goals,
    freezer: Freezer<'a>,
    drawing: FieldDrawing,
    views: Vec<KnownView>,
    kept: Kept,
    measure: Measure,
    d_image: Image,
    /// Makes references with every pixel that the extractor weighs; created when it is needed.
    whole: Option<References<'a>>,
    /// The last step, until its status is known.
    pending: Option<FieldReport>,
    done: Vec<FieldReport>,
    /// True after a failed step: later steps change nothing.
    stopped: bool,
}

impl<'a> Stage2<'a> {
    /// Prepares every view once, and starts at the identity. Views whose constants exceed
    /// `params.cache_mib` on the device are prepared again when needed; the observer gets a notice.
    pub fn new(
        gpu: &Gpu,
        scene: &'a Scene,
        views: &[EnhanceView],
        guidance: Guidance<'a>,
        params: &EnhanceParams,
        observer: &mut dyn Observer,
    ) -> Result<Self, EnhanceError> {
        check_inputs(scene, views, guidance, params)?;
        let kind = scene.medium.kind();
        if guidance.appearance() == Appearance::Water && kind.formation() != Formation::PerGaussian {
            let name = kind.name();
            let what = format!(
                "the water `{name}` is laid over finished images, which only the processor does; use \
                 `--engine cpu`"
            );
            return Err(EngineError::Request { engine: NAME, what }.into());
        }
        let field = initial_field(scene, guidance, params)?;
        let g = &scene.gaussians;
        let sites = ObjectPass::new(&field, &g.means, g.sh.iter().map(|sh| sh[0])).sites().clone();
        let device = DeviceField::new(gpu, field.shape())?;
        device.write(gpu, &FieldState::new(&field));
        let mut engine = Self {
            scene,
            guidance,
            goals: Goals::new(guidance, params),
            freezer: Freezer::new(gpu, scene, sites, centred(g.len(), params.centre_sample))?,
            drawing: FieldDrawing {
                gpu: gpu.clone(),
                compositor: DeviceCompositor::new(gpu)?,
                pull: Array::new(gpu, "slopes of the image", 1)?,
                device,
                of_field: Gradient::new(field.shape()),
                rounded: vec![0.0; field.parameters.len()],
                field,
                image: Image::new(0, 0),
            },
            views: Vec::with_capacity(views.len()),
            kept: Kept::default(),
            measure: Measure::default(),
            d_image: Image::new(0, 0),
            whole: None,
            pending: None,
            done: Vec::new(),
            stopped: false,
        };
        let mut references = References::new(scene, guidance, params.sample_side);
        let mut room = params.cache_mib.saturating_mul(1 << 20);
        for (index, view) in views.iter().enumerate() {
            let lattice = references.lattice(&view.camera)?;
            let frozen = engine.freeze(&view.camera, &lattice)?;
            let drawn = &mut engine.drawing.image;
            let reference = references.of(index, view, |_, image| std::mem::swap(image, drawn), None)?;
            engine.views.push(KnownView { view: view.clone(), lattice, reference });
            // Views are kept in the order in which they come, as on the processor.
            let bytes = frozen.bytes();
            let fits = bytes <= room;
            room -= if fits { bytes } else { 0 };
            engine.kept.views.push(fits.then_some(frozen));
        }
        let stays = engine.coverage().views_in_memory;
        if stays < views.len() {
            observer.notice(&format!(
                "the constants of {stays} of {} views fit {} MiB on the device; the others are prepared again in every step (raise `cache_mib` to avoid that)",
                views.len(),
                params.cache_mib
            ));
        }
        Ok(engine)
    }

    fn freeze(&mut self, camera: &Camera, lattice: &Lattice) -> Result<FrozenView, EngineError> {
        self.drawing.freeze(&mut self.freezer, camera, lattice, self.guidance)
    }

    /// Returns an error if there is no such view; otherwise its constants are on the device afterwards.
    fn place(&mut self, view: usize) -> Result<(), EngineError> {
        let count = self.views.len();
        let Some(known) = self.views.get(view) else {
            let what = format!("there is no view {view}, only {count}");
            return Err(EngineError::Request { engine: NAME, what });
        };
        if self.kept.get(view).is_none() {
            let (camera, lattice) = (known.view.camera, known.lattice.clone());
            self.kept.spare = None;
            self.drawing.gpu.forget_bindings();
            let frozen = self.freeze(&camera, &lattice)?;
            self.kept.spare = Some((view, frozen));
        }
        Ok(())
    }

    /// Completes the report of the last step with its `status` from the device.
    fn confirm(&mut self, status: [u32; 2]) {
        let Some(mut report) = self.pending.take() else { return };
        let bad = |at: usize, what| (status[at] != NONE).then(|| (what, Some(status[at] as usize)));
        report.non_finite = bad(BAD_GRADIENT, "gradient").or_else(|| bad(BAD_PARAMETER, "parameter"));
        self.stopped |= report.non_finite.is_some();
        self.done.push(report);
    }

    /// Waits for the last step.
    fn settle(&mut self) -> Result<(), EngineError> {
        if self.pending.is_some() {
            let FieldDrawing { gpu, device, .. } = &self.drawing;
            let status = device.status.read(gpu, 2)?;
            self.confirm([status[0], status[1]]);
        }
        Ok(())
    }

    /// Runs a step on a view whose constants are on the device.
    fn learn(&mut self, index: usize, plan: &FieldPlan) -> Result<(), EngineError> {
        let Some(view) = self.kept.get(index) else { return Ok(()) };
        let status = self.drawing.draw(view, Some(plan))?;
        let reference = &self.views[index].reference;
        let drawn = &self.drawing.image;
        let mut losses =
            self.measure.losses(reference, &self.goals, drawn, Some(&mut self.d_image)).map_err(failed)?;
        self.goals.of_field(&self.drawing.field, &mut losses);
        let finite = losses.total.is_finite();
        let non_finite = (!finite).then_some(("loss", None));
        let report = FieldReport { step: plan.step, view: index, losses, non_finite };
        let before_went_well = status == [NONE; 2];
        if before_went_well && finite {
            self.drawing.learn(view, &self.goals, &self.d_image)?;
        }
        self.confirm(status);
        if !before_went_well {
            return Ok(());
        }
        if finite {
            self.pending = Some(report);
        } else {
            self.done.push(report);
            self.stopped = true;
        }
        Ok(())
    }

    /// Measures the distance of a view from its targets, on every pixel that the extractor weighs.
    fn evaluate_whole(&mut self, index: usize) -> Result<ViewErrors, EnhanceError> {
        let (scene, guidance) = (self.scene, self.guidance);
        let camera = self.views[index].view.camera;
        let references = self.whole.get_or_insert_with(|| References::new(scene, guidance, 0));
        let lattice = references.lattice(&camera)?;
        let frozen = self.freeze(&camera, &lattice)?;
        let drawn = &mut self.drawing.image;
        let KnownView { view, reference: known, .. } = &self.views[index];
        let references = self.whole.get_or_insert_with(|| References::new(scene, guidance, 0));
        let reference = references.of(index, view, |_, image| std::mem::swap(image, drawn), Some(known))?;
        self.drawing.draw(&frozen, None)?;
        let losses = self.measure.losses(&reference, &self.goals, &self.drawing.image, None)?;
        drop(frozen);
        self.drawing.gpu.forget_bindings();
        Ok(ViewErrors(losses.values))
    }

    /// Measures the distance of a view from its reference, on the pixels of the steps.
    fn evaluate_sampled(&mut self, index: usize) -> Result<ViewErrors, EnhanceError> {
        let reference = &self.views[index].reference;
        if let Some(view) = self.kept.get(index) {
            self.drawing.draw(view, None)?;
        }
        let losses = self.measure.losses(reference, &self.goals, &self.drawing.image, None)?;
        Ok(ViewErrors(losses.values))
    }
}

impl FieldEngine for Stage2<'_> {
    fn load(&mut self, state: FieldState) -> Result<(), EngineError> {
        state.check(self.drawing.field.parameters.len())?;
        let FieldDrawing { gpu, device, .. } = &self.drawing;
        device.write(gpu, &state);
        (self.pending, self.stopped) = (None, false);
        self.done.clear();
        self.drawing.gpu.check()
    }

    fn save(&mut self) -> Result<FieldState, EngineError> {
        self.settle()?;
        self.drawing.device.read(&self.drawing.gpu)
    }

    fn step(&mut self, view: usize, plan: &FieldPlan) -> Result<(), EngineError> {
        self.place(view)?;
        if self.stopped { Ok(()) } else { self.learn(view, plan) }
    }

    fn drain(&mut self, which: Drain) -> Result<Vec<FieldReport>, EngineError> {
        if which == Drain::All {
            self.settle()?;
        }
        Ok(std::mem::take(&mut self.done))
    }

    fn evaluate(&mut self, view: usize, reading: Reading) -> Result<ViewErrors, EngineError> {
        self.settle()?;
        self.place(view)?;
        match (reading, self.guidance) {
            (Reading::Whole, Guidance::Targets(_)) => self.evaluate_whole(view),
            // Labels keep their sample, because the values before and after must use the same pixels.
            _ => self.evaluate_sampled(view),
        }
        .map_err(failed)
    }

    fn centre(&mut self) -> Result<[f32; OUTPUTS], EngineError> {
        self.settle()?;
        // Every view lists the Gaussians that define it.
        self.place(0)?;
        let mut mean = [0.0; OUTPUTS];
        if let Some(view) = self.kept.get(0) {
            let FieldDrawing { gpu, device, .. } = &mut self.drawing;
            device.prepare(gpu, view, None)?;
            submit(gpu, "the field's mean", |pass| device.record_lookup(pass, view))?;
            mean.copy_from_slice(&device.grade.read(gpu, OUTPUTS)?);
        }
        Ok(mean)
    }

    fn coverage(&self) -> Coverage {
        let (mut rendered, mut all) = (0.0, 0.0);
        for KnownView { view, lattice, .. } in &self.views {
            rendered += (lattice.width() * lattice.height()) as f64;
            all += (view.camera.intrinsics.width * view.camera.intrinsics.height) as f64;
        }
        let views_in_memory = self.kept.views.iter().flatten().count();
        Coverage { views_in_memory, rendered_share: rendered / all }
    }
}

fn failed(error: EnhanceError) -> EngineError {
    match error {
        EnhanceError::Engine(error) => error,
        other => EngineError::Failed(Box::new(other)),
    }
}
