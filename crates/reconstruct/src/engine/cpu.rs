//! The engine on the processor: the reference.

use use3d_capture::{Camera, Image, Lattice, Map, MediumMaps};
use use3d_medium::{MediumModel, Role};
use use3d_numerics::adam::Adam;
use use3d_splat::{
    Colors, Cotangents, GaussianGradients, Gaussians, Options, Prepared, Rasterizer, Rendered,
};
use use3d_training::Profile;

use super::adam::Moments;
use super::density::{self, Origin, Statistics};
use super::{Engine, EngineState, RefineReport, RefineSettings, StepReport, StepSettings};
use crate::exposure::{Exposures, expose, expose_backward};
use crate::losses::{DepthPriorLoss, PhotometricLoss, PhotometricValue};
use crate::profile::StepPart;
use crate::views::{Target, TrainingView};

/// Parameters, moments and every buffer of a step, in main memory.
pub struct CpuEngine {
    gaussians: Gaussians,
    moments: Moments,
    statistics: Statistics,
    medium: MediumModel,
    /// The water's degree is never below this.
    least_water_degree: usize,
    /// First and second moments of the water's flat parameters.
    medium_moments: [Vec<f32>; 2],
    exposures: Exposures,
    views: Vec<TrainingView>,
    buffers: Buffers,
    profile: Profile<StepPart>,
}

/// What a step computes on the way; kept from step to step.
struct Buffers {
    target: Target,
    maps: MediumMaps,
    prepared: Prepared,
    rasterizer: Rasterizer,
    rendered: Rendered,
    photometric: PhotometricLoss,
    /// The rendered image with the view's gain.
    exposed: Image,
    image_gradient: Image,
    exposure_gradient: [f64; 3],
    depth_gradient: Map,
    gradients: GaussianGradients,
    map_gradients: MediumMaps,
    medium_gradient: MediumModel,
}

impl CpuEngine {
    /// An engine that starts from these Gaussians and this water.
    pub fn new(gaussians: Gaussians, medium: MediumModel, structure_weight: f64) -> Self {
        let n = gaussians.len();
        let count = medium.parameter_count();
        Self {
            moments: Moments::new(&gaussians),
            statistics: Statistics::new(n),
            medium_moments: [vec![0.0; count], vec![0.0; count]],
            exposures: Exposures::default(),
            views: Vec::new(),
            buffers: Buffers {
                target: Target::default(),
                maps: MediumMaps::zeros(0, 0),
                prepared: Prepared::new(),
                rasterizer: Rasterizer::new(),
                rendered: Rendered::new(),
                photometric: PhotometricLoss::new(structure_weight),
                exposed: Image::new(0, 0),
                image_gradient: Image::new(0, 0),
                exposure_gradient: [0.0; 3],
                depth_gradient: Map::new(0, 0),
                gradients: GaussianGradients::new(n),
                map_gradients: MediumMaps::zeros(0, 0),
                medium_gradient: medium.zeros_like(),
            },
            gaussians,
            medium,
            least_water_degree: 0,
            profile: Profile::default(),
        }
    }

    /// Lets the water have at least this degree of spherical harmonics (0 to 3), whatever is active.
    pub(crate) fn keep_water_degree(&mut self, degree: usize) {
        self.least_water_degree = degree;
    }

    /// Loss and all gradients of one view, left in the buffers; the value and the depth term.
    pub(crate) fn differentiate(
        &mut self,
        view: usize,
        settings: &StepSettings,
    ) -> (PhotometricValue, Option<f64>) {
        let b = &mut self.buffers;
        let profile = &mut self.profile;
        profile.start();
        let camera = self.views[view].target(settings.divisor, &mut b.target);
        let lattice = Lattice::full(&camera.intrinsics);
        profile.lap(StepPart::Target);
        let water = !self.medium.is_none();
        if water {
            let degree = settings.degree.max(self.least_water_degree);
            self.medium.maps(&camera, &lattice, degree, &mut b.maps);
        }
        let maps = water.then_some(&b.maps);
        let gain = settings.exposure.map(|_| self.exposures.gain(view));
        if let Some(alpha) = &b.target.alpha {
            over_water(&mut b.target.image, alpha, maps, gain.unwrap_or([1.0; 3]));
        }
        profile.lap(StepPart::Water);
        b.prepared.prepare(&self.gaussians, &camera, &lattice, Colors::Sh { degree: settings.degree });
        profile.lap(StepPart::Project);
        let options = Options { depth_gradient: settings.depth_gradient, layers: false };
        b.rasterizer.forward(&b.prepared, maps, &options, &mut b.rendered);
        profile.lap(StepPart::Compose);
        let mask = b.target.mask.as_ref();
        let shown = match gain {
            Some(gain) => {
                expose(&b.rendered.image, gain, &mut b.exposed);
                &b.exposed
            }
            None => &b.rendered.image,
        };
        let value = b.photometric.evaluate(shown, &b.target.image, mask, &mut b.image_gradient);
        if let Some(gain) = gain {
            b.exposure_gradient = expose_backward(&b.exposed, gain, &mut b.image_gradient);
        }
        let depth_loss = match &mut b.target.prior {
            Some(prior) if settings.depth_weight > 0.0 => {
                if let Some(mask) = mask {
                    for (p, m) in prior.data_mut().iter_mut().zip(mask.data()) {
                        if *m < 0.5 {
                            *p = 0.0;
                        }
                    }
                }
                let depth = &b.rendered.depth;
                Some(DepthPriorLoss.evaluate(depth, prior, settings.depth_weight, &mut b.depth_gradient))
            }
            _ => None,
        };
        profile.lap(StepPart::Loss);
        let cotangents = Cotangents {
            image: &b.image_gradient,
            depth: depth_loss.map(|_| &b.depth_gradient),
            accumulation: None,
            clear: None,
        };
        b.rasterizer.backward(
            &b.prepared,
            &self.gaussians,
            &camera,
            maps,
            &options,
            &cotangents,
            &mut b.gradients,
            water.then_some(&mut b.map_gradients),
        );
        profile.lap(StepPart::ComposeBackward);
        if water {
            b.medium_gradient.clear();
            self.medium.backward(
                &camera,
                &lattice,
                settings.degree.max(self.least_water_degree),
                &b.maps,
                &b.map_gradients,
                &mut b.medium_gradient,
            );
        }
        profile.lap(StepPart::WaterBackward);
        (value, depth_loss)
    }

    /// The gradients that [`CpuEngine::differentiate`] left.
    #[cfg(test)]
    pub(crate) fn gradients(&self) -> (&GaussianGradients, &MediumModel) {
        (&self.buffers.gradients, &self.buffers.medium_gradient)
    }

    /// The view that [`CpuEngine::differentiate`] rendered.
    #[cfg(test)]
    pub(crate) fn rendered(&self) -> &Rendered {
        &self.buffers.rendered
    }

    fn update_medium(&mut self, settings: &StepSettings) -> bool {
        let rates = &settings.rates;
        let [first, second] = &mut self.medium_moments;
        let mut finite = true;
        self.medium.update(&self.buffers.medium_gradient, |role, offset, values, gradient| {
            let rate = match role {
                Role::Constant => rates.medium_constant,
                Role::Directional | Role::Anchor => rates.medium_directional,
                Role::Network => rates.medium_network,
            };
            let range = offset..offset + values.len();
            let (m, v) = (&mut first[range.clone()], &mut second[range]);
            Adam::SPLATTING.update(settings.step + 1, rate, values, gradient, m, v);
            finite &= values.iter().all(|v| v.is_finite());
        });
        finite
    }
}

/// Transparent pixels take the water's colour (black without water) as the view's gain shows it.
fn over_water(image: &mut Image, alpha: &Map, maps: Option<&MediumMaps>, gain: [f32; 3]) {
    let n = image.pixels();
    let color = maps.map(|m| m.color.data());
    for (i, value) in image.data_mut().iter_mut().enumerate() {
        let a = alpha.data()[i % n];
        *value = a * *value + (1.0 - a) * color.map_or(0.0, |c| gain[i / n] * c[i]);
    }
}

impl Engine for CpuEngine {
    fn upload(&mut self, view: TrainingView) -> usize {
        self.views.push(view);
        self.views.len() - 1
    }

    fn expose(&mut self, gains: &[[f64; 3]]) {
        self.exposures = Exposures::new(gains);
    }

    fn exposures(&self) -> Vec<[f32; 3]> {
        self.exposures.gains()
    }

    fn gaussians(&self) -> usize {
        self.gaussians.len()
    }

    fn step(&mut self, view: usize, settings: &StepSettings) -> StepReport {
        let (value, depth_loss) = self.differentiate(view, settings);
        let loss = value.total + settings.depth_weight * depth_loss.unwrap_or(0.0);
        let mut report = StepReport {
            loss,
            reg_l1: value.reg_l1,
            reg_ms_ssim: value.reg_ms_ssim,
            depth_loss,
            psnr: use3d_metrics::decibels(value.squared_error).ok(),
            non_finite: None,
        };
        if !loss.is_finite() {
            report.non_finite = Some(("the loss", None));
            return report;
        }
        self.profile.start();
        report.non_finite = self.moments.update(
            settings.step,
            &settings.rates,
            settings.degree,
            &mut self.gaussians,
            &self.buffers.gradients,
        );
        if !self.update_medium(settings) && report.non_finite.is_none() {
            let index = use3d_training::guard::first_non_finite(&self.medium.flat());
            report.non_finite = Some(("the water's parameters", index));
        }
        if let Some(exposure) = &settings.exposure {
            self.exposures.update(view, self.buffers.exposure_gradient, exposure);
            if !self.exposures.is_finite() && report.non_finite.is_none() {
                report.non_finite = Some(("the views' gains", None));
            }
        }
        self.profile.lap(StepPart::Adam);
        if let Some(reference) = settings.gather {
            let image = &self.buffers.rendered.image;
            let (width, height) = (image.width(), image.height());
            // At every divisor as at full size: the pyramid's stronger pulls are part of the method.
            let pixels = (width * settings.divisor) as f64 * (height * settings.divisor) as f64;
            let scale = if reference == 0 { 1.0 } else { (pixels / reference as f64).sqrt() as f32 };
            self.statistics.gather(&self.buffers.gradients, width, height, scale);
        }
        self.profile.lap(StepPart::Density);
        self.profile.steps += 1;
        report
    }

    fn refine(&mut self, settings: &RefineSettings) -> RefineReport {
        self.profile.start();
        let (rows, report) = density::plan(&self.gaussians, &self.statistics, settings);
        if rows.len() != self.gaussians.len() || rows.iter().any(|r| !matches!(r, Origin::Kept(_))) {
            self.gaussians = density::apply(&self.gaussians, &rows, settings);
            let kept: Vec<usize> =
                rows.iter().filter_map(|r| if let Origin::Kept(i) = r { Some(*i) } else { None }).collect();
            let fresh = super::adam::zeros(rows.len() - kept.len(), self.gaussians.sh_degree);
            for moments in [&mut self.moments.first, &mut self.moments.second] {
                *moments = moments.select(&kept);
                moments.extend(&fresh);
            }
        }
        self.statistics = Statistics::new(self.gaussians.len());
        if settings.reset_medium {
            let [first, second] = &mut self.medium_moments;
            let mut offset = 0;
            for (role, values) in self.medium.groups() {
                if matches!(role, Role::Constant | Role::Directional) {
                    first[offset..offset + values.len()].fill(0.0);
                    second[offset..offset + values.len()].fill(0.0);
                }
                offset += values.len();
            }
        }
        self.profile.lap(StepPart::Density);
        report
    }

    fn forget_statistics(&mut self) {
        self.statistics = Statistics::new(self.gaussians.len());
    }

    fn limit_opacity(&mut self, ceiling: f64) {
        let most = density::logit(ceiling);
        for logit in &mut self.gaussians.opacity_logits {
            *logit = logit.min(most);
        }
        self.moments.first.opacity_logits.fill(0.0);
        self.moments.second.opacity_logits.fill(0.0);
    }

    fn render(&mut self, camera: &Camera, degree: usize, out: &mut Rendered, water: &mut MediumMaps) {
        let lattice = Lattice::full(&camera.intrinsics);
        let b = &mut self.buffers;
        self.medium.maps(camera, &lattice, degree.max(self.least_water_degree), water);
        b.prepared.prepare(&self.gaussians, camera, &lattice, Colors::Sh { degree });
        let maps = (!self.medium.is_none()).then_some(&*water);
        b.rasterizer.forward(&b.prepared, maps, &Options::default(), out);
    }

    fn contributing_pairs(&mut self, view: usize, divisor: usize, degree: usize) -> f64 {
        const EVERY: usize = 4;
        let (camera, _) = self.views[view].camera_over(divisor);
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let some = |n: usize| (0..n).skip(EVERY / 2).step_by(EVERY).collect::<Vec<_>>();
        // An image below three pixels has no such pixel: then all of them.
        let lattice =
            Lattice::subset(&some(width), &some(height)).unwrap_or_else(|| Lattice::full(&camera.intrinsics));
        let prepared = &mut self.buffers.prepared;
        prepared.prepare(&self.gaussians, &camera, &lattice, Colors::Sh { degree });
        let share = (lattice.width() * lattice.height()) as f64 / (width * height) as f64;
        prepared.pairs().contributing as f64 / share
    }

    fn state(&self) -> EngineState<'_> {
        let [first, second] = &self.medium_moments;
        EngineState {
            gaussians: (&self.gaussians).into(),
            first: (&self.moments.first).into(),
            second: (&self.moments.second).into(),
            norms: (&self.statistics.norms).into(),
            renders: (&self.statistics.renders).into(),
            medium: [self.medium.flat().into(), first.into(), second.into()],
            exposures: self.exposures.state(),
        }
    }

    fn restore(&mut self, state: &EngineState<'_>) -> bool {
        let arrays = [&state.gaussians, &state.first, &state.second].map(|a| a.to_gaussians());
        let [Some(gaussians), Some(first), Some(second)] = arrays else { return false };
        let n = gaussians.len();
        let count = self.medium.parameter_count();
        let lengths = [first.len(), second.len(), state.norms.len(), state.renders.len()];
        if lengths.iter().any(|l| *l != n) || state.medium.iter().any(|m| m.len() != count) {
            return false;
        }
        if !self.exposures.restore(&state.exposures) {
            return false;
        }
        let [medium, medium_first, medium_second] = &state.medium;
        self.medium.set_flat(medium);
        self.medium_moments = [medium_first.to_vec(), medium_second.to_vec()];
        self.gaussians = gaussians;
        self.moments = Moments { first, second };
        self.statistics = Statistics { norms: state.norms.to_vec(), renders: state.renders.to_vec() };
        true
    }

    fn download(&self) -> (Gaussians, MediumModel) {
        (self.gaussians.clone(), self.medium.clone())
    }

    fn profile(&self) -> &Profile<StepPart> {
        &self.profile
    }

    fn memory(&self) -> usize {
        let per_gaussian = 4 * (4 * 59 + 4) + 64;
        let pixels = self.buffers.rendered.image.pixels() * 4 * (3 * 9 + 6);
        let views: usize = self.views.iter().map(TrainingView::memory).sum();
        let scratch = self.buffers.prepared.memory() + self.buffers.rasterizer.memory();
        self.gaussians.len() * per_gaussian + pixels + views + scratch
    }
}
