//! The engine on the processor, the reference. A step runs field → colours and water → compositor →
//! extractor → losses, and then all of it backward.
//!
//! Gradients are computed for the field's parameters only; Gaussians, medium, targets and the stage-1
//! render are constants. The engine owns every buffer, so that a step allocates nothing after the largest
//! view has occurred.

use use3d_capture::{Image, MediumMaps};
use use3d_numerics::adam::Adam;
use use3d_scene::Scene;
use use3d_splat::{Options, Rasterizer, Rendered};
use use3d_training::guard::first_non_finite;
use use3d_training::{Drain, EngineError, Observer, Profile};
use use3d_ubaf::{Field, Gradient, OUTPUTS, ObjectPass, WaterPass};

use super::{
    Coverage, FieldEngine, FieldPlan, FieldReport, FieldState, Goals, Measure, Reading, StepLosses,
    check_inputs, initial_field,
};
use crate::profile::StepPart;
use crate::report::ViewErrors;
use crate::views::{EnhanceView, Frozen, Guidance, Lookups, Preparer, ViewConstants};
use crate::{EnhanceError, EnhanceParams};

/// The engine's name in messages.
const NAME: &str = "cpu";

/// The buffers of a step.
pub(crate) struct Step {
    pub(crate) objects: ObjectPass,
    water: WaterPass,
    pub(crate) enhanced_water: MediumMaps,
    /// Enhanced colours of the Gaussians that the view lists.
    pub(crate) colors: Vec<[f32; 3]>,
    /// The enhanced colours at their positions among all Gaussians.
    placed: Vec<[f32; 3]>,
    d_colors: Vec<[f32; 3]>,
    d_water: MediumMaps,
    rasterizer: Rasterizer,
    pub(crate) rendered: Rendered,
    measure: Measure,
    d_image: Image,
    pub(crate) gradient: Gradient,
    pub(crate) profile: Profile<StepPart>,
}

impl Step {
    pub(crate) fn new(field: &Field, objects: ObjectPass) -> Self {
        Self {
            objects,
            water: WaterPass::default(),
            enhanced_water: MediumMaps::zeros(0, 0),
            colors: Vec::new(),
            placed: Vec::new(),
            d_colors: Vec::new(),
            d_water: MediumMaps::zeros(0, 0),
            rasterizer: Rasterizer::new(),
            rendered: Rendered::new(),
            measure: Measure::default(),
            d_image: Image::new(0, 0),
            gradient: Gradient::new(field.shape()),
            profile: Profile::default(),
        }
    }

    /// Renders the enhanced view on its lattice, into `self.rendered`.
    pub(crate) fn render(&mut self, field: &Field, view: &ViewConstants, frozen: &mut Frozen) {
        self.objects.move_to(&frozen.listed.sites);
        self.objects.forward(field);
        self.objects.colors(field, &frozen.base, &mut self.colors);
        let count = frozen.prepared.gaussians();
        frozen.prepared.set_colors(frozen.listed.scatter(&self.colors, count, &mut self.placed));
        self.profile.lap(StepPart::Field);
        let water = frozen.water.as_ref().map(|water| {
            self.water.forward(field, view.center, water, 1.0, &mut self.enhanced_water);
            &self.enhanced_water
        });
        self.profile.lap(StepPart::Water);
        self.rasterizer.forward(&frozen.prepared, water, &Options::default(), &mut self.rendered);
        self.profile.lap(StepPart::Compose);
    }

    /// Computes the losses of the rendered view, and their gradient with respect to the image if
    /// `differentiate`.
    pub(crate) fn losses(
        &mut self,
        view: &ViewConstants,
        goals: &Goals,
        differentiate: bool,
    ) -> Result<StepLosses, EnhanceError> {
        let d_image = differentiate.then_some(&mut self.d_image);
        let losses = self.measure.losses(&view.reference, goals, &self.rendered.image, d_image)?;
        self.profile.lap(StepPart::Loss);
        Ok(losses)
    }

    /// The transition that the last `losses` extracted from the render.
    #[cfg(test)]
    pub(crate) fn transition(&self) -> &use3d_atc::extractor::Transition {
        self.measure.transition()
    }

    /// Computes the whole gradient, into `self.gradient`; `render` and `losses` of the same view must come
    /// just before.
    pub(crate) fn backward(&mut self, field: &Field, view: &ViewConstants, frozen: &Frozen, goals: &Goals) {
        self.gradient.clear();
        self.d_colors.resize(frozen.prepared.gaussians(), [0.0; 3]);
        let image = &self.rendered.image;
        self.d_water.resize(image.width(), image.height());
        self.rasterizer.backward_colors(
            &frozen.prepared,
            frozen.water.as_ref().map(|_| &self.enhanced_water),
            &self.d_image,
            &mut self.d_colors,
            &mut self.d_water,
        );
        self.profile.lap(StepPart::ComposeBackward);
        let d_colors = frozen.listed.gather(&self.d_colors, &mut self.colors);
        self.objects.backward(field, &frozen.base, d_colors, &mut self.gradient);
        goals.field_backward(field, &mut self.gradient);
        self.profile.lap(StepPart::FieldBackward);
        if let Some(water) = &frozen.water {
            self.water.backward(field, view.center, water, &self.d_water, &mut self.gradient);
        }
        self.profile.lap(StepPart::WaterBackward);
    }
}

/// The field with its moments, the frozen scene for every view, and the buffers of a step. A step is
/// complete when the call returns.
pub struct CpuFieldEngine<'a> {
    field: Field,
    /// First and second moments of the field's parameters.
    moments: [Vec<f32>; 2],
    list: Vec<EnhanceView>,
    views: Vec<ViewConstants>,
    guidance: Guidance<'a>,
    goals: Goals,
    step: Step,
    /// The gradient in f32, as the input of Adam.
    rounded: Vec<f32>,
    /// Reports that were not drained yet.
    reports: Vec<FieldReport>,
    store: Store<'a>,
    /// Prepares views with every pixel that the extractor weighs; created when it is needed.
    whole: Option<Preparer<'a>>,
}

impl<'a> CpuFieldEngine<'a> {
    /// Prepares every view once, and starts at the identity. Views whose constants exceed
    /// `params.cache_mib` are prepared again when needed; the observer gets a notice.
    pub fn new(
        scene: &'a Scene,
        views: &[EnhanceView],
        guidance: Guidance<'a>,
        params: &EnhanceParams,
        observer: &mut dyn Observer,
    ) -> Result<Self, EnhanceError> {
        check_inputs(scene, views, guidance, params)?;
        let field = initial_field(scene, guidance, params)?;
        let g = &scene.gaussians;
        let objects = ObjectPass::new(&field, &g.means, g.sh.iter().map(|sh| sh[0]));
        let lookups = Lookups::new(objects.sites().clone(), params.centre_sample);
        let mut preparer = Preparer::new(scene, guidance, lookups.clone(), params.sample_side);
        let mut room = params.cache_mib.saturating_mul(1 << 20);
        let (mut constants, mut kept) = (Vec::with_capacity(views.len()), Vec::with_capacity(views.len()));
        for (index, view) in views.iter().enumerate() {
            let (small, large) = preparer.view(index, view, None, true)?;
            constants.push(small);
            // Views are kept in the order in which they come: in shuffled epochs every view is equally
            // likely, so no other policy is better.
            let bytes = large.bytes();
            kept.push((bytes <= room).then_some(large));
            if kept[index].is_some() {
                room -= bytes;
            }
        }
        let stays = kept.iter().flatten().count();
        if stays < views.len() {
            let message = format!(
                "the constants of {stays} of {} views fit {} MiB; the others are prepared again in every step (raise `cache_mib` to avoid that)",
                views.len(),
                params.cache_mib
            );
            tracing::warn!("{message}");
            observer.notice(&message);
        }
        let n = field.parameters.len();
        Ok(Self {
            step: Step::new(&field, objects),
            goals: Goals::new(guidance, params),
            field,
            moments: [vec![0.0; n], vec![0.0; n]],
            list: views.to_vec(),
            views: constants,
            guidance,
            rounded: vec![0.0; n],
            reports: Vec::new(),
            store: Store { scene, guidance, lookups, kept, spare: None },
            whole: None,
        })
    }

    /// The render of the last step or evaluation, on the view's lattice.
    pub fn rendered(&self) -> &Rendered {
        &self.step.rendered
    }

    /// Computes losses and gradient for view `index`.
    pub fn differentiate(&mut self, index: usize) -> Result<StepLosses, EnhanceError> {
        self.step.profile.start();
        let view = &self.views[index];
        let frozen = self.store.of(index, view, &mut self.step.rasterizer);
        self.step.profile.lap(StepPart::Prepare);
        self.step.render(&self.field, view, frozen);
        let mut losses = self.step.losses(view, &self.goals, true)?;
        self.step.backward(&self.field, view, frozen, &self.goals);
        self.goals.of_field(&self.field, &mut losses);
        self.step.profile.lap(StepPart::FieldBackward);
        Ok(losses)
    }

    /// Runs Adam with the gradient of [`CpuFieldEngine::differentiate`] and a constant learning rate per
    /// group; returns the first array that was not finite.
    fn update(&mut self, losses: &StepLosses, plan: &FieldPlan) -> Option<(&'static str, Option<usize>)> {
        if !losses.total.is_finite() {
            return Some(("loss", None));
        }
        self.step.gradient.round_into(&mut self.rounded);
        if let Some(at) = first_non_finite(&self.rounded) {
            return Some(("gradient", Some(at)));
        }
        let transport = self.field.shape().transport();
        let [first, second] = &mut self.moments;
        for (range, rate) in [(0..transport.start, plan.rate), (transport, plan.transport_rate)] {
            Adam::SPLATTING.update(
                plan.step + 1,
                rate,
                &mut self.field.parameters[range.clone()],
                &self.rounded[range.clone()],
                &mut first[range.clone()],
                &mut second[range],
            );
        }
        self.step.profile.lap(StepPart::Adam);
        self.step.profile.stop();
        self.step.profile.steps += 1;
        first_non_finite(&self.field.parameters).map(|at| ("parameter", Some(at)))
    }

    /// Measures the distance of view `index` from its reference: on every pixel that the extractor weighs, or
    /// on the pixels of the steps.
    fn measure(&mut self, index: usize, whole: bool) -> Result<ViewErrors, EnhanceError> {
        let kept = &self.views[index];
        let mut made;
        let (view, frozen) = if whole {
            let (scene, guidance, lookups) = (self.store.scene, self.guidance, &self.store.lookups);
            let whole = self.whole.get_or_insert_with(|| Preparer::new(scene, guidance, lookups.clone(), 0));
            made = whole.view(index, &self.list[index], Some(&kept.reference), false)?;
            (&made.0, &mut made.1)
        } else {
            (kept, self.store.of(index, kept, &mut self.step.rasterizer))
        };
        self.step.render(&self.field, view, frozen);
        Ok(ViewErrors(self.step.losses(view, &self.goals, false)?.values))
    }

    /// Returns an error if there is no such view.
    fn know(&self, view: usize) -> Result<(), EngineError> {
        let count = self.views.len();
        let what = || format!("there is no view {view}, only {count}");
        if view < count { Ok(()) } else { Err(EngineError::Request { engine: NAME, what: what() }) }
    }
}

impl FieldEngine for CpuFieldEngine<'_> {
    fn load(&mut self, state: FieldState) -> Result<(), EngineError> {
        state.check(self.field.parameters.len())?;
        self.field.parameters = state.parameters;
        self.moments = [state.first, state.second];
        self.reports.clear();
        Ok(())
    }

    fn save(&mut self) -> Result<FieldState, EngineError> {
        let [first, second] = self.moments.clone();
        Ok(FieldState {
            version: FieldState::VERSION,
            parameters: self.field.parameters.clone(),
            first,
            second,
        })
    }

    fn step(&mut self, view: usize, plan: &FieldPlan) -> Result<(), EngineError> {
        self.know(view)?;
        let losses = self.differentiate(view).map_err(failed)?;
        let non_finite = self.update(&losses, plan);
        self.reports.push(FieldReport { step: plan.step, view, losses, non_finite });
        Ok(())
    }

    fn drain(&mut self, _which: Drain) -> Result<Vec<FieldReport>, EngineError> {
        Ok(std::mem::take(&mut self.reports))
    }

    fn evaluate(&mut self, view: usize, reading: Reading) -> Result<ViewErrors, EngineError> {
        self.know(view)?;
        // Labels keep their sample, because the values before and after must use the same pixels.
        let whole = reading == Reading::Whole && self.guidance.targets().is_some();
        self.measure(view, whole).map_err(failed)
    }

    fn centre(&mut self) -> Result<[f32; OUTPUTS], EngineError> {
        self.step.objects.move_to(&self.store.lookups.centre());
        self.step.objects.forward(&self.field);
        Ok(self.step.objects.mean)
    }

    fn coverage(&self) -> Coverage {
        let (mut rendered, mut all) = (0.0, 0.0);
        for view in &self.views {
            rendered += (view.lattice.width() * view.lattice.height()) as f64;
            all += (view.camera.intrinsics.width * view.camera.intrinsics.height) as f64;
        }
        Coverage { views_in_memory: self.store.kept.iter().flatten().count(), rendered_share: rendered / all }
    }

    fn profile(&self) -> Profile<StepPart> {
        self.step.profile.clone()
    }
}

fn failed(error: EnhanceError) -> EngineError {
    EngineError::Failed(Box::new(error))
}

/// The large constants of views: those that are kept, and the last ones that were made in addition.
struct Store<'a> {
    scene: &'a Scene,
    guidance: Guidance<'a>,
    lookups: Lookups,
    kept: Vec<Option<Frozen>>,
    spare: Option<(usize, Frozen)>,
}

impl Store<'_> {
    /// The kept constants of view `index`, or the spare ones after making them for this view.
    fn of(&mut self, index: usize, view: &ViewConstants, rasterizer: &mut Rasterizer) -> &mut Frozen {
        if let Some(frozen) = &mut self.kept[index] {
            return frozen;
        }
        let made = match self.spare.take() {
            Some((of, frozen)) if of == index => frozen,
            // They are trimmed like the kept ones: the same Gaussians in the same order give the same bits.
            _ => {
                let Self { scene, guidance, lookups, .. } = self;
                Frozen::new(scene, *guidance, lookups, &view.camera, &view.lattice, Some(rasterizer))
            }
        };
        &mut self.spare.insert((index, made)).1
    }
}
