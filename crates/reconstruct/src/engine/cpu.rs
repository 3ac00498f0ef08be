//! The engine on the processor: the reference.

use std::borrow::Cow;

use use3d_capture::{Camera, Image, Lattice, MediumMaps};
use use3d_medium::{MediumModel, Role};
use use3d_numerics::adam::Adam;
use use3d_splat::{
    Colors, GaussianGradients, Gaussians, Gradients, Options, Prepared, Rasterizer, RenderGradients,
    Rendered, ViewOf,
};
use use3d_training::{Drain, EngineError, Profile};

use super::{Degrees, Engine, Moves, Statistics, StepPlan, StepReport, TrainingState};
use crate::colors::restore;
use crate::density::{self, Draws, Origin, Survey};
use crate::exposure::{expose, expose_backward};
use crate::losses::{Loss, LossTerm, Losses, Observation, TERMS, ViewGradients};
use crate::profile::StepPart;
use crate::views::{Target, TrainingView};

/// The engine's name in messages.
const NAME: &str = "cpu";

/// Parameters, moments and every buffer of a step, in main memory. A step is complete when the call
/// returns.
pub struct CpuEngine {
    state: TrainingState,
    views: Vec<TrainingView>,
    /// Reports that were not drained yet.
    reports: Vec<StepReport>,
    losses: Losses,
    medium_gradient: MediumModel,
    buffers: Buffers,
    profile: Profile<StepPart>,
}

/// Intermediate results of a step; the memory is reused from step to step.
#[derive(Default)]
struct Buffers {
    target: Target,
    maps: MediumMaps,
    prepared: Prepared,
    rasterizer: Rasterizer,
    rendered: Rendered,
    /// The rendered image with the view's gain.
    exposed: Image,
    exposure_gradient: [f64; 3],
    /// The scene's constant coefficients, while the Gaussians have those that the view shows.
    own_colors: Vec<[f32; 3]>,
    color_gradient: Vec<f32>,
    gradients: GaussianGradients,
    map_gradients: MediumMaps,
}

impl Default for CpuEngine {
    /// An engine without views and with an empty scene.
    fn default() -> Self {
        Self::with_terms(TERMS)
    }
}

impl CpuEngine {
    /// An engine that minimises other terms: a plan needs one weight for each of their values, in this
    /// order.
    pub fn with_terms(terms: &[LossTerm]) -> Self {
        Self {
            state: TrainingState::new(Gaussians::empty(0), MediumModel::None, &[]),
            views: Vec::new(),
            reports: Vec::new(),
            losses: Losses::new(terms),
            medium_gradient: MediumModel::None,
            buffers: Buffers::default(),
            profile: Profile::default(),
        }
    }

    /// An uploaded view.
    fn view(&self, index: usize) -> Result<&TrainingView, EngineError> {
        self.views.get(index).ok_or_else(|| EngineError::Request {
            engine: NAME,
            what: format!("view {index} was not uploaded; there are {}", self.views.len()),
        })
    }

    /// Computes the loss of one view and stores all gradients in the buffers.
    pub(crate) fn differentiate(&mut self, view: usize, plan: &StepPlan) -> Result<Loss, EngineError> {
        self.view(view)?;
        let (given, needed) = (plan.weights.len(), self.losses.values());
        if given != needed {
            let what = format!("the plan has {given} weights of the loss, expected {needed}");
            return Err(EngineError::Request { engine: NAME, what });
        }
        let (b, state) = (&mut self.buffers, &mut self.state);
        let profile = &mut self.profile;
        profile.start();
        let camera = self.views[view].target(plan.divisor, &mut b.target);
        let lattice = Lattice::full(&camera.intrinsics);
        profile.lap(StepPart::Target);
        let water = !state.medium.is_none();
        if water {
            state.medium.maps(&camera, &lattice, plan.degrees.water, &mut b.maps);
        }
        let maps = water.then_some(&b.maps);
        let gain = plan.exposure.map(|_| state.exposures.gain(view));
        profile.lap(StepPart::Water);
        if plan.colors.is_some() {
            state.colors.show(Some(view), &mut state.gaussians, &mut b.own_colors);
        }
        b.prepared.prepare(&state.gaussians, &camera, &lattice, Colors::Sh { degree: plan.degrees.colors });
        profile.lap(StepPart::Project);
        let options = Options {
            depth_gradient: plan.depth_gradient,
            layers: self.losses.read_clear(&plan.weights),
            water_only: plan.moves == Moves::Water && plan.colors.is_none(),
            signed_screen: plan.gather.is_some_and(|scale| scale.signed),
        };
        b.rasterizer.forward(&b.prepared, maps, &options, &mut b.rendered);
        profile.lap(StepPart::Compose);
        let shown = match gain {
            Some(gain) => {
                expose(&b.rendered.image, gain, &mut b.exposed);
                &b.exposed
            }
            None => &b.rendered.image,
        };
        let mut loss = self.losses.evaluate(
            &Observation {
                step: plan.step,
                camera: &camera,
                image: shown,
                clear: b.rendered.layers.as_ref().map(|layers| &layers.clear),
                depth: &b.rendered.depth,
                accumulation: &b.rendered.accumulation,
                water: maps,
                target: &b.target,
                gaussians: &state.gaussians,
                prepared: &b.prepared,
            },
            &plan.weights,
        );
        let ViewGradients { image, clear, depth, accumulation, .. } = &mut self.losses.gradients;
        let image = image.or_zeros(shown.width(), shown.height());
        if let Some(gain) = gain {
            b.exposure_gradient = expose_backward(&b.exposed, gain, image);
        }
        profile.lap(StepPart::Loss);
        let d_rendered = RenderGradients {
            image,
            depth: depth.get(),
            accumulation: accumulation.get(),
            clear: clear.get(),
        };
        b.rasterizer.backward(
            &b.prepared,
            ViewOf { gaussians: &state.gaussians, camera: &camera },
            maps,
            &options,
            &d_rendered,
            Gradients { gaussians: &mut b.gradients, medium: water.then_some(&mut b.map_gradients) },
        );
        if let Some(colors) = &plan.colors {
            restore(&mut state.gaussians, &b.own_colors);
            loss.total += colors.weight
                * state.colors.backward(
                    view,
                    colors.weight,
                    &state.gaussians,
                    &b.own_colors,
                    &mut b.gradients,
                    &mut b.color_gradient,
                );
        }
        self.losses.gradients.add_scales(&mut b.gradients.log_scales);
        profile.lap(StepPart::ComposeBackward);
        if water {
            self.losses.gradients.add_water(&mut b.map_gradients);
            self.medium_gradient.clear();
            state.medium.backward(
                &camera,
                &lattice,
                plan.degrees.water,
                &b.maps,
                &b.map_gradients,
                &mut self.medium_gradient,
            );
        }
        profile.lap(StepPart::WaterBackward);
        Ok(loss)
    }

    /// The gradients that [`CpuEngine::differentiate`] computed.
    #[cfg(test)]
    pub(crate) fn gradients(&self) -> (&GaussianGradients, &MediumModel) {
        (&self.buffers.gradients, &self.medium_gradient)
    }

    /// The gradient of the colour field that [`CpuEngine::differentiate`] computed.
    #[cfg(test)]
    pub(crate) fn color_gradient(&self) -> &[f32] {
        &self.buffers.color_gradient
    }

    /// The view that [`CpuEngine::differentiate`] rendered.
    #[cfg(test)]
    pub(crate) fn rendered(&self) -> &Rendered {
        &self.buffers.rendered
    }

    fn update_medium(&mut self, plan: &StepPlan) -> bool {
        let rates = &plan.rates;
        let TrainingState { medium, medium_moments: [first, second], .. } = &mut self.state;
        let mut finite = true;
        if plan.network_clip > 0.0 {
            self.medium_gradient.clip(Role::Network, plan.network_clip);
        }
        medium.update(&self.medium_gradient, |role, offset, values, gradient| {
            let rate = match role {
                Role::Constant => rates.medium_constant,
                Role::Directional | Role::Anchor => rates.medium_directional,
                Role::Network => rates.medium_network,
            };
            let range = offset..offset + values.len();
            let (m, v) = (&mut first[range.clone()], &mut second[range]);
            Adam::SPLATTING.update(plan.water_updates + 1, rate, values, gradient, m, v);
            finite &= values.iter().all(|v| v.is_finite());
        });
        finite
    }

    /// Runs Adam and the statistics after [`CpuEngine::differentiate`]; returns the first array that was
    /// not finite.
    fn update(&mut self, view: usize, plan: &StepPlan) -> Option<(&'static str, Option<usize>)> {
        self.profile.start();
        let state = &mut self.state;
        let mut non_finite = None;
        if plan.moves != Moves::Water {
            non_finite = state.moments.update(
                (plan.step, plan.moves),
                &plan.rates,
                plan.degrees.colors,
                &mut state.gaussians,
                &self.buffers.gradients,
            );
        }
        let flows = matches!(plan.moves, Moves::All | Moves::Water);
        if flows && !self.update_medium(plan) && non_finite.is_none() {
            let index = use3d_training::guard::first_non_finite(&self.state.medium.flat());
            non_finite = Some(("the water's parameters", index));
        }
        let state = &mut self.state;
        if let Some(exposure) = &plan.exposure
            && matches!(plan.moves, Moves::All | Moves::Gaussians)
        {
            state.exposures.update(view, self.buffers.exposure_gradient, exposure);
            if !state.exposures.log_gains.is_finite() && non_finite.is_none() {
                non_finite = Some(("the views' gains", None));
            }
        }
        if let Some(colors) = &plan.colors
            && !state.colors.update(plan.step, colors.rates, &self.buffers.color_gradient)
            && non_finite.is_none()
        {
            non_finite = Some(("the colour field", None));
        }
        self.profile.lap(StepPart::Adam);
        if let Some(scale) = plan.gather {
            let image = &self.buffers.rendered.image;
            let (width, height) = (image.width(), image.height());
            // Pixels are counted at full size for every divisor: the pyramid's larger gradients are part of
            // the method.
            let pixels = (width * plan.divisor) as f64 * (height * plan.divisor) as f64;
            state.statistics.gather(&self.buffers.gradients, width, height, &scale, pixels);
            if scale.signed {
                state.statistics.radii.resize(state.gaussians.len(), 0.0);
                self.buffers.prepared.raise_radii(&mut state.statistics.radii);
            }
        }
        self.profile.lap(StepPart::Density);
        self.profile.steps += 1;
        non_finite
    }
}

impl Engine for CpuEngine {
    fn upload(&mut self, view: TrainingView) -> Result<usize, EngineError> {
        self.views.push(view);
        Ok(self.views.len() - 1)
    }

    fn load(&mut self, state: TrainingState) -> Result<(), EngineError> {
        state.check(self.views.len())?;
        self.medium_gradient = state.medium.zeros_like();
        self.state = state;
        self.reports.clear();
        Ok(())
    }

    fn save(&mut self) -> Result<Cow<'_, TrainingState>, EngineError> {
        Ok(Cow::Borrowed(&self.state))
    }

    fn step(&mut self, view: usize, plan: &StepPlan) -> Result<(), EngineError> {
        let mut loss = self.differentiate(view, plan)?;
        if plan.colors.is_some_and(|colors| colors.alone) && loss.total.is_finite() {
            // The gradient of the field stays; those of Gaussians and water come from a view without it.
            loss = self.differentiate(view, &StepPlan { colors: None, ..plan.clone() })?;
        }
        let non_finite =
            if loss.total.is_finite() { self.update(view, plan) } else { Some(("the loss", None)) };
        self.reports.push(StepReport {
            step: plan.step,
            view,
            loss: loss.total,
            values: loss.values,
            psnr: loss.squared_error.and_then(|error| use3d_metrics::decibels(error).ok()),
            non_finite,
        });
        Ok(())
    }

    fn drain(&mut self, _which: Drain) -> Result<Vec<StepReport>, EngineError> {
        Ok(std::mem::take(&mut self.reports))
    }

    fn survey(&mut self) -> Result<Survey, EngineError> {
        Ok(Survey::of(&self.state.gaussians, &self.state.statistics))
    }

    fn forget_statistics(&mut self) -> Result<(), EngineError> {
        self.state.statistics = Statistics::new(self.state.gaussians.len());
        Ok(())
    }

    fn rebuild(&mut self, rows: &[Origin], draws: &Draws) -> Result<(), EngineError> {
        self.profile.start();
        let state = &mut self.state;
        let n = state.gaussians.len();
        if let Some(row) = rows.iter().position(|row| row.source() >= n) {
            let from = rows[row].source();
            let what = format!("row {row} comes from Gaussian {from}; there are {n}");
            return Err(EngineError::Request { engine: NAME, what });
        }
        let same = |(i, row): (usize, &Origin)| *row == Origin::Kept(i);
        if rows.len() != n || !rows.iter().enumerate().all(same) {
            state.gaussians = density::rebuilt(&state.gaussians, rows, draws);
            state.moments = state.moments.rebuilt(rows);
        }
        state.statistics = Statistics::new(rows.len());
        self.profile.lap(StepPart::Density);
        Ok(())
    }

    fn limit_opacity(&mut self, ceiling: f64) -> Result<(), EngineError> {
        let most = density::logit(ceiling);
        let state = &mut self.state;
        for logit in &mut state.gaussians.opacity_logits {
            *logit = logit.min(most);
        }
        state.moments.first.opacity_logits.fill(0.0);
        state.moments.second.opacity_logits.fill(0.0);
        Ok(())
    }

    fn amend(&mut self, change: &mut dyn FnMut(&mut Gaussians)) -> Result<(), EngineError> {
        change(&mut self.state.gaussians);
        Ok(())
    }

    fn forget_water_moments(&mut self) -> Result<(), EngineError> {
        let TrainingState { medium, medium_moments: [first, second], .. } = &mut self.state;
        let mut offset = 0;
        for (role, values) in medium.groups() {
            if matches!(role, Role::Constant | Role::Directional) {
                first[offset..offset + values.len()].fill(0.0);
                second[offset..offset + values.len()].fill(0.0);
            }
            offset += values.len();
        }
        Ok(())
    }

    fn render(&mut self, camera: &Camera, degrees: Degrees, out: &mut Image) -> Result<(), EngineError> {
        let lattice = Lattice::full(&camera.intrinsics);
        let (b, state) = (&mut self.buffers, &mut self.state);
        state.medium.maps(camera, &lattice, degrees.water, &mut b.maps);
        state.colors.show(None, &mut state.gaussians, &mut b.own_colors);
        b.prepared.prepare(&state.gaussians, camera, &lattice, Colors::Sh { degree: degrees.colors });
        if !state.colors.is_off() {
            restore(&mut state.gaussians, &b.own_colors);
        }
        let maps = (!state.medium.is_none()).then_some(&b.maps);
        b.rasterizer.forward(&b.prepared, maps, &Options::default(), &mut b.rendered);
        out.clone_from(&b.rendered.image);
        Ok(())
    }

    fn contributing_pairs(
        &mut self,
        view: usize,
        divisor: usize,
        degree: usize,
    ) -> Result<Option<f64>, EngineError> {
        const EVERY: usize = 4;
        let (camera, _) = self.view(view)?.camera_over(divisor);
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let some = |n: usize| (0..n).skip(EVERY / 2).step_by(EVERY).collect::<Vec<_>>();
        // An image with fewer than three pixels along a side has no such pixel, so all pixels are used.
        let lattice =
            Lattice::subset(&some(width), &some(height)).unwrap_or_else(|| Lattice::full(&camera.intrinsics));
        let prepared = &mut self.buffers.prepared;
        prepared.prepare(&self.state.gaussians, &camera, &lattice, Colors::Sh { degree });
        let share = (lattice.width() * lattice.height()) as f64 / (width * height) as f64;
        Ok(Some(prepared.pairs().contributing as f64 / share))
    }

    fn profile(&self) -> Profile<StepPart> {
        self.profile.clone()
    }

    fn memory(&self) -> usize {
        let per_gaussian = 4 * (4 * 59 + 4) + 64;
        let pixels = self.buffers.rendered.image.pixels() * 4 * (3 * 9 + 6);
        let views: usize = self.views.iter().map(TrainingView::memory).sum();
        let scratch = self.buffers.prepared.memory() + self.buffers.rasterizer.memory();
        self.state.gaussians.len() * per_gaussian + pixels + views + scratch
    }
}
