//! One step of stage 2: field → colours and water → compositor → extractor → losses, and all the way back.
//!
//! Gradients reach the field's parameters only; Gaussians, medium, targets and the stage-1 render are constants. The engine owns
//! every buffer, so that a step allocates nothing once the largest view was seen.

use use3d_atc::extractor::{Affine, Workspace};
use use3d_capture::{Appearance, Image, MediumMaps};
use use3d_scene::Scene;
use use3d_splat::{Options, Rasterizer, Rendered};
use use3d_training::{Observer, Profile};
use use3d_ubaf::objects::guide_color;
use use3d_ubaf::{Field, FieldBox, Gradient, ObjectPass, WaterPass, variation};

use crate::objective::{Realised, global_loss, local_loss};
use crate::params::{Objective, PixelLoss};
use crate::profile::StepPart;
use crate::report::ViewErrors;
use crate::view::{EnhanceView, Frozen, Guidance, Lookups, Preparer, Reference, ViewConstants};
use crate::{EnhanceError, EnhanceParams};

/// The losses of one step.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepLosses {
    /// Weighted total.
    pub total: f64,
    /// Global term.
    pub global: Realised,
    /// Local term.
    pub local: Realised,
    /// Pseudo-label term.
    pub pixels: f64,
    /// Total variation of the factors.
    pub variation: f64,
}

/// What a step aims at, apart from the view's own reference.
#[derive(Clone, Debug)]
pub(crate) struct Goals {
    pub(crate) operator: Affine,
    pub(crate) global_scales: [f64; 12],
    pub(crate) local_scales: [f64; 6],
    pub(crate) lambda_global: f64,
    pub(crate) lambda_local: f64,
    pub(crate) lambda_variation: f64,
    pub(crate) pixel_loss: PixelLoss,
}

impl Goals {
    fn new(guidance: Guidance<'_>, params: &EnhanceParams) -> Self {
        let (lambda_global, lambda_local) = params.transition_weights();
        let (operator, global_scales, local_scales) = match guidance {
            Guidance::Targets(t) => (t.scene, t.global_scales, t.local_scales),
            Guidance::Labels(_) => ([0.0; 12], [1.0; 12], [1.0; 6]),
        };
        Self {
            operator,
            global_scales,
            local_scales,
            lambda_global,
            lambda_local,
            lambda_variation: params.lambda_variation,
            pixel_loss: params.pixel_loss,
        }
    }
}

/// The buffers of a step.
pub(crate) struct Step {
    pub(crate) objects: ObjectPass,
    water: WaterPass,
    pub(crate) enhanced_water: MediumMaps,
    /// Enhanced colours of the Gaussians that the view lists.
    pub(crate) colors: Vec<[f32; 3]>,
    /// The same at their places among all.
    placed: Vec<[f32; 3]>,
    d_colors: Vec<[f32; 3]>,
    d_water: MediumMaps,
    rasterizer: Rasterizer,
    pub(crate) rendered: Rendered,
    workspace: Workspace,
    cells: Vec<[f64; 6]>,
    d_cells: Vec<[f64; 6]>,
    d_image: Image,
    pub(crate) gradient: Gradient,
    pub(crate) profile: Profile<StepPart>,
}

impl Step {
    pub(crate) fn new(field: &Field, objects: ObjectPass) -> Self {
        Self {
            objects,
            water: WaterPass::new(),
            enhanced_water: MediumMaps::zeros(0, 0),
            colors: Vec::new(),
            placed: Vec::new(),
            d_colors: Vec::new(),
            d_water: MediumMaps::zeros(0, 0),
            rasterizer: Rasterizer::new(),
            rendered: Rendered::new(),
            workspace: Workspace::new(),
            cells: Vec::new(),
            d_cells: Vec::new(),
            d_image: Image::new(0, 0),
            gradient: Gradient::new(field.shape()),
            profile: Profile::default(),
        }
    }

    /// The enhanced render of a view on its lattice, into `self.rendered`.
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

    /// Losses of the rendered view, and their gradient in the image if `differentiate`.
    pub(crate) fn losses(
        &mut self,
        view: &ViewConstants,
        goals: &Goals,
        differentiate: bool,
    ) -> Result<StepLosses, EnhanceError> {
        let mut losses = StepLosses::default();
        match &view.reference {
            Reference::Transition(source, target) => {
                let realised = source.forward_on_lattice(&self.rendered.image, &mut self.workspace)?;
                let mut d_operator = [0.0; 12];
                losses.global = global_loss(
                    &realised.global,
                    &goals.operator,
                    &goals.global_scales,
                    goals.lambda_global,
                    &mut d_operator,
                );
                self.cells.clear();
                self.cells.extend_from_slice(&realised.local);
                losses.local = local_loss(
                    &mut self.cells,
                    &target.local,
                    &target.weight,
                    &goals.local_scales,
                    goals.lambda_local,
                    &mut self.d_cells,
                );
                if differentiate {
                    self.d_image.resize(self.rendered.image.width(), self.rendered.image.height());
                    source.backward_on_lattice(
                        &d_operator,
                        &self.d_cells,
                        &mut self.workspace,
                        &mut self.d_image,
                    )?;
                }
            }
            Reference::Label(label) => {
                let image = &self.rendered.image;
                self.d_image.resize(image.width(), image.height());
                let scale = 1.0 / image.data().len().max(1) as f64;
                let mut total = 0.0;
                let pixels = image.data().iter().zip(label.data()).zip(self.d_image.data_mut());
                for ((&value, &wanted), d) in pixels {
                    let e = f64::from(value) - f64::from(wanted) / 65535.0;
                    let (term, slope) = match goals.pixel_loss {
                        PixelLoss::L1 => (e.abs(), if e == 0.0 { 0.0 } else { e.signum() }),
                        PixelLoss::L2 => (e * e, 2.0 * e),
                    };
                    total += term;
                    *d = (slope * scale) as f32;
                }
                losses.pixels = total * scale;
            }
        }
        losses.total =
            goals.lambda_global * losses.global.loss + goals.lambda_local * losses.local.loss + losses.pixels;
        self.profile.lap(StepPart::Loss);
        Ok(losses)
    }

    /// The transition that the last `losses` read off the render.
    #[cfg(test)]
    pub(crate) fn transition(&self) -> &use3d_atc::extractor::Transition {
        self.workspace.transition()
    }

    /// The whole gradient, into `self.gradient`; needs `render` and `losses` of the same view just before.
    pub(crate) fn backward(
        &mut self,
        field: &Field,
        view: &ViewConstants,
        frozen: &Frozen,
        lambda_variation: f64,
    ) {
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
        variation::backward(field, lambda_variation, &mut self.gradient);
        self.profile.lap(StepPart::FieldBackward);
        if let Some(water) = &frozen.water {
            self.water.backward(field, view.center, water, &self.d_water, &mut self.gradient);
        }
        self.profile.lap(StepPart::WaterBackward);
    }
}

/// Stage 2's state that does not fit a checkpoint: the frozen scene as every view sees it, the field, the buffers.
pub struct Engine<'a> {
    pub(crate) field: Field,
    pub(crate) views: Vec<ViewConstants>,
    goals: Goals,
    step: Step,
    store: Store<'a>,
}

impl<'a> Engine<'a> {
    /// Prepares every view once. Views whose constants do not fit `params.cache_mib` are prepared again when needed; the observer is
    /// told.
    pub fn new(
        scene: &'a Scene,
        views: &[EnhanceView],
        guidance: Guidance<'a>,
        params: &EnhanceParams,
        observer: &mut dyn Observer,
    ) -> Result<Self, EnhanceError> {
        params.validate()?;
        check_guidance(guidance, params.objective)?;
        if scene.gaussians.is_empty() {
            return Err(EnhanceError::EmptyScene);
        }
        if views.is_empty() {
            return Err(EnhanceError::NoViews);
        }
        if let Guidance::Targets(targets) = guidance {
            targets.check_scene(&scene.gaussians)?;
        }
        let appearance = guidance.appearance();
        // The water asks at the cameras, and so near the anchors; clear radiance is asked for at the Gaussians alone.
        let anchors = match &scene.medium {
            use3d_medium::MediumModel::Rbf(rbf) if appearance == Appearance::Water => rbf.centers.as_slice(),
            _ => &[],
        };
        let bounds = FieldBox::of_scene(&scene.gaussians.means, anchors);
        let field = Field::identity(params.shape(), bounds, params.seed)?;
        let guides = scene.gaussians.sh.iter().map(|sh| guide_color(sh[0]));
        let objects =
            ObjectPass::with_guides(use3d_ubaf::Level::new(), &field, &scene.gaussians.means, guides);
        let lookups = Lookups::new(objects.sites().clone(), params.centre_sample);
        let mut preparer = Preparer::new(scene, guidance, lookups.clone(), params.sample_side);
        let mut room = params.cache_mib.saturating_mul(1 << 20);
        let (mut constants, mut kept) = (Vec::with_capacity(views.len()), Vec::with_capacity(views.len()));
        for (index, view) in views.iter().enumerate() {
            let (small, large) = preparer.view(index, view, None, true)?;
            constants.push(small);
            // First come, first kept: in shuffled epochs every view is as likely as any other, so no policy does better.
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
        Ok(Self {
            step: Step::new(&field, objects),
            goals: Goals::new(guidance, params),
            field,
            views: constants,
            store: Store { scene, appearance, lookups, kept, spare: None },
        })
    }

    /// The field.
    pub fn field(&self) -> &Field {
        &self.field
    }

    /// The field, to be changed between steps.
    pub fn field_mut(&mut self) -> &mut Field {
        &mut self.field
    }

    /// Puts the scene's affine at the global target, where there is a global term.
    pub(crate) fn start_at_the_operator(&mut self) {
        if self.goals.lambda_global > 0.0 {
            let affine = self.field.shape().affine();
            self.field.parameters[affine]
                .iter_mut()
                .zip(self.goals.operator)
                .for_each(|(p, t)| *p = t as f32);
        }
    }

    /// `∂L/∂` the field's parameters, of the last [`Engine::step`].
    pub fn gradient(&self) -> &Gradient {
        &self.step.gradient
    }

    /// Views whose large constants are kept.
    pub fn views_in_memory(&self) -> usize {
        self.store.kept.iter().flatten().count()
    }

    /// Rendered pixels of all views over all their pixels.
    pub fn rendered_share(&self) -> f64 {
        let (mut rendered, mut all) = (0.0, 0.0);
        for view in &self.views {
            rendered += (view.lattice.width() * view.lattice.height()) as f64;
            all += (view.camera.intrinsics.width * view.camera.intrinsics.height) as f64;
        }
        rendered / all
    }

    /// Losses and gradient at view `index`.
    pub fn step(&mut self, index: usize) -> Result<StepLosses, EnhanceError> {
        self.step.profile.start();
        let view = &self.views[index];
        let frozen = self.store.of(index, view, &mut self.step.rasterizer);
        self.step.profile.lap(StepPart::Prepare);
        self.step.render(&self.field, view, frozen);
        let mut losses = self.step.losses(view, &self.goals, true)?;
        self.step.backward(&self.field, view, frozen, self.goals.lambda_variation);
        losses.variation = variation::forward(&self.field);
        losses.total += self.goals.lambda_variation * losses.variation;
        self.step.profile.lap(StepPart::FieldBackward);
        Ok(losses)
    }

    /// How far view `index` is from its reference.
    pub fn evaluate(&mut self, index: usize) -> Result<ViewErrors, EnhanceError> {
        let view = &self.views[index];
        let frozen = self.store.of(index, view, &mut self.step.rasterizer);
        self.step.render(&self.field, view, frozen);
        let measured = matches!(&view.reference, Reference::Transition(..));
        let losses = self.step.losses(view, &self.goals, false)?;
        Ok(errors(&losses, measured))
    }

    /// How far view `index` is from its reference, sampled as `whole` does and not as the steps do.
    pub(crate) fn evaluate_with(
        &mut self,
        whole: &mut Preparer<'_>,
        index: usize,
        view: &EnhanceView,
    ) -> Result<ViewErrors, EnhanceError> {
        let local = match &self.views[index].reference {
            Reference::Transition(_, target) => Some(target),
            Reference::Label(_) => None,
        };
        let (constants, mut frozen) = whole.view(index, view, local, false)?;
        self.step.render(&self.field, &constants, &mut frozen);
        let losses = self.step.losses(&constants, &self.goals, false)?;
        Ok(errors(&losses, local.is_some()))
    }

    /// Ends a step: the time since its gradient was the optimiser's.
    pub(crate) fn end_step(&mut self) {
        self.step.profile.lap(StepPart::Adam);
        self.step.profile.stop();
        self.step.profile.steps += 1;
    }

    /// Where the time of the steps went.
    pub fn profile(&self) -> &Profile<StepPart> {
        &self.step.profile
    }

    /// The render of the last [`Engine::step`] or [`Engine::evaluate`], on the view's lattice.
    pub fn rendered(&self) -> &Rendered {
        &self.step.rendered
    }

    /// What pictures are compared in.
    pub(crate) fn appearance(&self) -> Appearance {
        self.store.appearance
    }

    /// Prepares views as the extractor reads an image, every pixel that it weighs.
    pub(crate) fn whole<'s>(&self, guidance: Guidance<'s>) -> Preparer<'s>
    where
        'a: 's,
    {
        Preparer::new(self.store.scene, guidance, self.store.lookups.clone(), 0)
    }

    /// The constant mode of the current field over the Gaussians that define it (R22).
    pub(crate) fn centre(&mut self) -> [f32; use3d_ubaf::OUTPUTS] {
        self.step.objects.move_to(&self.store.lookups.centre());
        self.step.objects.forward(&self.field);
        self.step.objects.mean()
    }
}

/// The large constants of views: those that are kept, and the last one made besides.
struct Store<'a> {
    scene: &'a Scene,
    appearance: Appearance,
    lookups: Lookups,
    kept: Vec<Option<Frozen>>,
    spare: Option<(usize, Frozen)>,
}

impl Store<'_> {
    /// The kept constants of view `index`, or the spare ones made to be its.
    fn of(&mut self, index: usize, view: &ViewConstants, rasterizer: &mut Rasterizer) -> &mut Frozen {
        if let Some(frozen) = &mut self.kept[index] {
            return frozen;
        }
        let made = match self.spare.take() {
            Some((of, frozen)) if of == index => frozen,
            // Trimmed like the kept ones: the same Gaussians in the same order give the same bits.
            _ => {
                let Self { scene, appearance, lookups, .. } = self;
                Frozen::new(scene, *appearance, lookups, &view.camera, &view.lattice, Some(rasterizer))
            }
        };
        &mut self.spare.insert((index, made)).1
    }
}

/// A view's errors; `measured` where it has a transition to be compared with.
fn errors(losses: &StepLosses, measured: bool) -> ViewErrors {
    ViewErrors {
        global: measured.then_some(losses.global),
        local: measured.then_some(losses.local),
        pixels: losses.pixels,
    }
}

fn check_guidance(guidance: Guidance<'_>, objective: Objective) -> Result<(), EnhanceError> {
    let (objective, needed, fits) = match objective {
        Objective::Full => ("full", "transition targets", matches!(guidance, Guidance::Targets(_))),
        Objective::GlobalOnly => {
            ("global-only", "transition targets", matches!(guidance, Guidance::Targets(_)))
        }
        Objective::LocalOnly => {
            ("local-only", "transition targets", matches!(guidance, Guidance::Targets(_)))
        }
        Objective::PseudoLabels => (
            "pseudo-labels",
            "enhanced images of the training views",
            matches!(guidance, Guidance::Labels(_)),
        ),
    };
    if fits { Ok(()) } else { Err(EnhanceError::Guidance { objective, needed }) }
}
