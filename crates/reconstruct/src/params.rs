//! All numbers of stage 1, with the method's values as defaults.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::Camera;
use use3d_medium::{MediumKind, MediumStart};
use use3d_numerics::math;
use use3d_numerics::range::{OutOfRange, at_least, not_negative, positive, within};
use use3d_training::EngineChoice;

use crate::colors::ColorField;
use crate::densify::Densify;
use crate::{Priors, Turns};

/// The largest divisor of the image pyramid.
pub(crate) const MOST_DIVISOR: usize = 1024;

/// The source of depth priors (R14).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum DepthPrior {
    /// The capture's own files if it has a depth folder, else Depth Anything V2 if its weights are in the
    /// models folder, else no depth term, which the run reports.
    #[default]
    Auto,
    /// No depth term.
    Off,
    /// Files beside the images; if there are none, no depth term, which the run reports.
    Folder,
    /// Made by Depth Anything V2 before training.
    DepthAnythingV2,
}

/// The knowledge of the water before training.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum MediumPrior {
    /// `tracks` for water that can start from them and is learnt from the photographs, else `off`.
    #[default]
    Auto,
    /// None: the water starts as in the paper and is learnt from the first step on.
    Off,
    /// The water that the capture's tracks determine; if they do not, as `off`, and the log says why. For
    /// the `rbf`, `global` and `image` waters.
    Tracks,
}

/// Differences in exposure and white balance between the photographs of one scene.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Exposure {
    /// All views show the scene with one exposure, as in the method.
    #[default]
    Off,
    /// Every training view has a gain per channel, learnt with the scene and left out of renders;
    /// held-out views are also scored after a gain that is fitted on their other half.
    PerView,
}

/// The comparison of a rendered view with its photograph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Photometric {
    /// Absolute error and MS-SSIM with three levels, both relative to the rendered light.
    #[default]
    RegMsSsim,
    /// Absolute error and SSIM, both relative to the rendered light.
    RegSsim,
    /// Absolute error and SSIM of the images themselves.
    Ssim,
}

/// The images from which a scene is learnt. The loop itself is the same; the code that loads the views
/// reads this.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Images {
    /// The photographs.
    #[default]
    Captured,
    /// Each photograph enhanced separately, for comparison: differences between such images end up in the
    /// scene.
    Proposed,
}

/// A learning rate that decays log-linearly over the run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Rate(
    /// The rate at the first step.
    pub f64,
    /// The rate at the last step.
    pub f64,
);

impl Rate {
    /// The rate at `step` of `steps`.
    pub fn at(self, step: u64, steps: u64) -> f64 {
        use3d_numerics::adam::exponential_decay(self.0, self.1, step, steps)
    }
}

/// Learning rates of the parameters of a colour field, first and last.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ColorRates {
    /// Rate of the features of places.
    pub grid: Rate,
    /// Rate of the weights of networks.
    pub network: Rate,
    /// Rate of the numbers of views.
    pub code: Rate,
}

impl Default for ColorRates {
    fn default() -> Self {
        Self { grid: Rate(1e-2, 1e-4), network: Rate(1e-3, 1.5e-4), code: Rate(2e-3, 2e-4) }
    }
}

/// Adam's learning rates, first and last, per group of parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LearningRates {
    /// Rate of centres, normalised scene units.
    pub means: Rate,
    /// Rate of constant colour coefficients.
    pub sh_constant: Rate,
    /// Rate of directional colour coefficients.
    pub sh_directional: Rate,
    /// Rate of opacity logits.
    pub opacity: Rate,
    /// Rate of log scales.
    pub scales: Rate,
    /// Rate of quaternions.
    pub quaternions: Rate,
    /// Rate of the water's constant coefficients. Rates of the water are for a whole `schedule`; a
    /// compressed run multiplies them by the factor by which it is shorter, at most tenfold.
    pub medium_constant: Rate,
    /// Rate of the water's directional coefficients, anchor centres and log widths.
    pub medium_directional: Rate,
    /// Rate of the weights of the `mlp` water.
    pub medium_network: Rate,
    /// Rates of the colour field.
    pub color_field: ColorRates,
    /// Rate of the views' log-gains, if `exposure` allows them; a compressed run multiplies it like those
    /// of the water.
    pub exposure: Rate,
}

impl Default for LearningRates {
    fn default() -> Self {
        Self {
            means: Rate(1.6e-4, 5e-5),
            sh_constant: Rate(5e-3, 5e-4),
            sh_directional: Rate(5e-4, 5e-5),
            opacity: Rate(0.1, 0.1),
            scales: Rate(1e-2, 5e-3),
            quaternions: Rate(2e-3, 1e-3),
            medium_constant: Rate(2.5e-3, 2.5e-4),
            medium_directional: Rate(1.25e-4, 1.25e-5),
            medium_network: Rate(1e-3, 1.5e-4),
            color_field: ColorRates::default(),
            exposure: Rate(2e-3, 2e-4),
        }
    }
}

/// The parameters of stage 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReconstructParams {
    /// Training steps, one view each.
    pub iterations: u64,
    /// Steps over which rates, resolution, degrees and density control run their course. A shorter run
    /// compresses them; a longer one continues with their last values, so that its first steps are those of
    /// the shorter run.
    pub schedule: u64,
    /// The images from which the scene is learnt.
    pub images: Images,
    /// The model of the water.
    pub medium: MediumKind,
    /// Number of anchors of the `rbf` water.
    pub anchors: usize,
    /// Number of anchors that share a view.
    pub top_k: usize,
    /// The prior knowledge from which the water starts.
    pub medium_prior: MediumPrior,
    /// Share of the run, 0 to 1, for which water that was found beforehand is held.
    pub medium_hold: f64,
    /// Factor of the water's rates after that, 0 to 1.
    pub medium_release: f64,
    /// Differences between views in exposure and white balance.
    pub exposure: Exposure,
    /// Strength with which the views' gains are drawn to one: λ of `λ/2 · (ln gain)²` in the loss.
    pub exposure_weight: f64,
    /// A change of the scene's colours from view to view.
    pub color_field: ColorField,
    /// Weight of its regulariser.
    pub color_weight: f64,
    /// Share of the run, 0 to 1, for which the field is learnt beside the scene and changes nothing else.
    pub color_alone: f64,
    /// The source of depth priors.
    pub depth_prior: DepthPrior,
    /// Weight of the depth term.
    pub depth_weight: f64,
    /// Weight of the depth-ranking term: near patches of the prior must be near in the scene. It ends with
    /// density control's growth.
    pub ranking_weight: f64,
    /// Weight of the smoothness of depth except at edges.
    pub smoothness_weight: f64,
    /// True if edges near the camera are those of the depth prior; else all are those of the photograph.
    pub smoothness_by_prior: bool,
    /// True if depths are normalised to 0 to 1 in each view for it.
    pub smoothness_normalised: bool,
    /// Steps after each ceiling of opacity without the smoothness term.
    pub smoothness_pause: u64,
    /// Weight of the distance between inverse depth and the depth prior, in the units of the inverse depth.
    pub inverse_depth_weight: f64,
    /// Weight of the variation of inverse depth between neighbouring pixels. It begins after the warm-up.
    pub variation_weight: f64,
    /// Weight of the Gaussians' mean smallest standard deviation: they become flat.
    pub flatness_weight: f64,
    /// The step after which holes of the sparse model are filled by the depth prior. 0: never.
    pub complete_at: u64,
    /// Weights of priors on water, clear colours and background.
    pub priors: Priors,
    /// Turns in which the water or the colours move alone.
    pub turns: Turns,
    /// True if gradients flow through the ray distances of the water's terms (R2).
    pub depth_gradient: bool,
    /// The comparison of a rendered view with its photograph.
    pub photometric: Photometric,
    /// Share of the run, 0 to 1, for which errors are not relative to the rendered light.
    pub plain_until: f64,
    /// Weight λ of its structure against its absolute error.
    pub structure_weight: f64,
    /// Degree of the Gaussians' and the water's spherical harmonics, 0 to 3.
    pub sh_degree: usize,
    /// Share of the run after which the active degree grows by one, repeatedly.
    pub sh_every: f64,
    /// Image divisors (1 to 1024), each with the share of the run from which it holds (R11); the first
    /// starts at 0. Empty: half size, then full size from a share that grows with the photographs, which is
    /// 0.3 at 320×180 pixels, 0.4 at 640×360, and 0.5 at 1280×720.
    pub resolution_schedule: Vec<(f64, usize)>,
    /// Opacity of the initial Gaussians.
    pub initial_opacity: f64,
    /// Number of random initial Gaussians if the capture has fewer than 100 sparse points.
    pub random_points: usize,
    /// Adam's learning rates.
    pub learning_rates: LearningRates,
    /// Largest norm of the gradient of the `mlp` water's weights. 0: any.
    pub network_clip: f64,
    /// Density control.
    pub densify: Densify,
    /// Transmission of the water, 0 to 1, at which half of a Gaussian's colour channel counts as known. Less
    /// known channels fade into the others after the last step, so that far red is no fog. 0: never.
    pub unknown_below: f64,
    /// After the last step Gaussians are removed of which the training views show less than this share, 0 to
    /// 1, because masks hide the rest. 0: never.
    pub hidden_below: f64,
    /// Largest number of Gaussians, including the initial ones: of more sparse points a random choice is
    /// kept. 0: one for every eight pixels of the training views or four for every sparse point, whichever
    /// is more; from 250,000 to four million.
    pub max_gaussians: usize,
    /// Seed of every random draw. Not read from settings: the caller sets it.
    #[serde(skip)]
    pub seed: u64,
    /// Steps between held-out evaluations (0: only at the end).
    pub evaluate_every: u64,
    /// Steps between lines of the training log.
    pub log_every: u64,
    /// Largest number of steps between checkpoints.
    pub checkpoint_steps: u64,
    /// Largest number of minutes between checkpoints.
    pub checkpoint_minutes: f64,
    /// The device that computes: `cpu`, `gpu` (the best graphics card), `gpu:NAME` (any part of an
    /// adapter's name), or `auto`: a graphics card that passes its check and supports all parameters, else
    /// the processor. Results of different devices are kept apart.
    #[schemars(with = "String")]
    pub engine: EngineChoice,
}

impl Default for ReconstructParams {
    fn default() -> Self {
        Self {
            iterations: 3000,
            schedule: 15_000,
            images: Images::Captured,
            medium: MediumKind::default(),
            anchors: 8,
            top_k: 4,
            medium_prior: MediumPrior::Auto,
            medium_hold: 0.5,
            medium_release: 0.3,
            exposure: Exposure::Off,
            exposure_weight: 0.02,
            color_field: ColorField::Off,
            color_weight: 1.0,
            color_alone: 0.0,
            depth_prior: DepthPrior::Auto,
            depth_weight: 0.1,
            ranking_weight: 0.0,
            smoothness_weight: 0.0,
            smoothness_by_prior: false,
            smoothness_normalised: false,
            smoothness_pause: 0,
            inverse_depth_weight: 0.0,
            variation_weight: 0.0,
            flatness_weight: 0.0,
            complete_at: 0,
            priors: Priors::default(),
            turns: Turns::default(),
            depth_gradient: true,
            photometric: Photometric::RegMsSsim,
            plain_until: 0.0,
            structure_weight: 0.2,
            sh_degree: 3,
            sh_every: 1.0 / 15.0,
            resolution_schedule: vec![(0.0, 2), (0.2, 1)],
            initial_opacity: 0.1,
            random_points: 10_000,
            learning_rates: LearningRates::default(),
            network_clip: 0.0,
            densify: Densify::default(),
            unknown_below: 0.05,
            hidden_below: 0.1,
            max_gaussians: 0,
            seed: 42,
            evaluate_every: 0,
            log_every: 100,
            checkpoint_steps: 1000,
            checkpoint_minutes: 3.0,
            engine: EngineChoice::Cpu,
        }
    }
}

/// The steps of a month at a hundred per second.
const MOST_STEPS: u64 = 200_000_000;
/// More random points than the training of any scene can hold.
const MOST_POINTS: u64 = 10_000_000;

impl ReconstructParams {
    /// Checks every range; the error has the first bad parameter's path.
    pub fn validate(&self) -> Result<(), OutOfRange> {
        let share = |path: &str, value: f64| within(path, value, 0.0, 1.0);
        within("iterations", self.iterations, 1, MOST_STEPS)?;
        at_least("schedule", self.schedule, 1)?;
        within("anchors", self.anchors, 1, use3d_medium::MOST_ANCHORS)?;
        at_least("log_every", self.log_every, 1)?;
        at_least("checkpoint_steps", self.checkpoint_steps, 1)?;
        within("random_points", self.random_points as u64, 1, MOST_POINTS)?;
        positive("checkpoint_minutes", self.checkpoint_minutes)?;
        if self.top_k == 0 || self.top_k > self.anchors {
            let expected = format!("1 to anchors, which is {}", self.anchors);
            return Err(OutOfRange::new("top_k", self.top_k, expected));
        }
        within("sh_degree", self.sh_degree, 0, 3)?;
        share("medium_hold", self.medium_hold)?;
        share("medium_release", self.medium_release)?;
        if self.medium_prior == MediumPrior::Tracks {
            if !self.medium.starts_from_harmonics() {
                let able = MediumKind::names(MediumKind::starts_from_harmonics);
                let expected = format!("off with this medium ({able} can start from tracks)");
                return Err(OutOfRange::new("medium_prior", "tracks", expected));
            }
            if self.images == Images::Proposed {
                let expected = "off with images = \"proposed\", as these images no longer have the water of \
                     the photographs";
                return Err(OutOfRange::new("medium_prior", "tracks", expected));
            }
        }
        share("plain_until", self.plain_until)?;
        share("structure_weight", self.structure_weight)?;
        share("initial_opacity", self.initial_opacity)?;
        positive("initial_opacity", self.initial_opacity)?;
        if self.initial_opacity >= 1.0 {
            return Err(OutOfRange::new("initial_opacity", self.initial_opacity, "above 0, below 1"));
        }
        not_negative("depth_weight", self.depth_weight)?;
        not_negative("ranking_weight", self.ranking_weight)?;
        not_negative("smoothness_weight", self.smoothness_weight)?;
        not_negative("inverse_depth_weight", self.inverse_depth_weight)?;
        not_negative("variation_weight", self.variation_weight)?;
        not_negative("flatness_weight", self.flatness_weight)?;
        if self.smoothness_by_prior && self.smoothness_normalised {
            let expected = "false with smoothness_by_prior, whose depths are not normalised";
            return Err(OutOfRange::new("smoothness_normalised", "true", expected));
        }
        not_negative("exposure_weight", self.exposure_weight)?;
        not_negative("color_weight", self.color_weight)?;
        share("color_alone", self.color_alone)?;
        self.priors.validate()?;
        self.turns.validate()?;
        positive("sh_every", self.sh_every)?;
        let schedule = &self.resolution_schedule;
        let starts_at_zero = schedule.first().is_none_or(|s| s.0 == 0.0);
        let ascends = schedule.windows(2).all(|w| w[0].0 < w[1].0);
        let divisors = 1..=MOST_DIVISOR;
        if !starts_at_zero
            || !ascends
            || schedule.iter().any(|s| !divisors.contains(&s.1) || !(0.0..=1.0).contains(&s.0))
        {
            let expected = format!(
                "pairs of (share of the run, divisor), the first at 0, ascending, divisors from 1 to {MOST_DIVISOR}, or none"
            );
            return Err(OutOfRange::new("resolution_schedule", format!("{schedule:?}"), expected));
        }
        self.densify.validate()?;
        not_negative("network_clip", self.network_clip)?;
        share("unknown_below", self.unknown_below)?;
        share("hidden_below", self.hidden_below)?;
        let r = &self.learning_rates;
        for (name, rate) in [
            ("means", r.means),
            ("sh_constant", r.sh_constant),
            ("sh_directional", r.sh_directional),
            ("opacity", r.opacity),
            ("scales", r.scales),
            ("quaternions", r.quaternions),
            ("medium_constant", r.medium_constant),
            ("medium_directional", r.medium_directional),
            ("medium_network", r.medium_network),
            ("color_field.grid", r.color_field.grid),
            ("color_field.network", r.color_field.network),
            ("color_field.code", r.color_field.code),
            ("exposure", r.exposure),
        ] {
            positive(format!("learning_rates.{name}[0]"), rate.0)?;
            positive(format!("learning_rates.{name}[1]"), rate.1)?;
        }
        Ok(())
    }

    /// The settings from which the water's model starts.
    pub(crate) fn medium_start(&self, cameras: &[Camera]) -> MediumStart {
        let views = cameras.iter().map(|camera| camera.pose).collect();
        MediumStart { anchors: self.anchors, top_k: self.top_k, seed: self.seed, views }
    }

    /// The steps that the schedules span.
    pub fn course(&self) -> u64 {
        self.iterations.min(self.schedule)
    }

    /// These parameters for photographs of `pixels` pixels each: sets a resolution schedule that is empty.
    #[must_use]
    pub fn sized(&self, pixels: f64) -> Self {
        let mut sized = self.clone();
        if sized.resolution_schedule.is_empty() {
            sized.resolution_schedule = by_size(pixels).to_vec();
        }
        sized
    }

    /// The image divisor at `step`; by the rule for 640×360 pixels if it depends on the photographs.
    pub fn divisor(&self, step: u64) -> usize {
        let rule = by_size(MIDDLE);
        let schedule = match &self.resolution_schedule[..] {
            [] => &rule[..],
            given => given,
        };
        let reached = schedule.iter().rev().find(|s| step as f64 >= s.0 * self.course() as f64);
        reached.map_or(1, |s| s.1)
    }

    /// The cost of a step relative to one on whole images, for estimating the remaining time. The exponent
    /// lies between two measurements: from a quarter to the whole side, a run's steps became five times
    /// slower in a small scene and twelve times in a large one.
    pub(crate) fn step_work(&self, step: u64) -> f64 {
        math::powf(self.divisor(step) as f64, -1.5)
    }

    /// The active spherical-harmonics degree at `step`.
    pub fn active_degree(&self, step: u64) -> usize {
        let every = (self.sh_every * self.course() as f64).round().max(1.0) as u64;
        ((step / every) as usize).min(self.sh_degree)
    }

    /// True if the water starts from the capture's tracks.
    pub fn asks_tracks(&self) -> bool {
        match self.medium_prior {
            MediumPrior::Auto => self.medium.starts_from_harmonics() && self.images == Images::Captured,
            MediumPrior::Tracks => true,
            MediumPrior::Off => false,
        }
    }

    /// True if something reads depth priors.
    pub fn uses_priors(&self) -> bool {
        let weights = [self.depth_weight, self.ranking_weight, self.inverse_depth_weight];
        weights.iter().any(|weight| *weight > 0.0) || self.complete_at > 0 || self.smoothness_by_prior
    }

    /// The step from which no Gaussians are added.
    pub fn densify_end(&self) -> u64 {
        (self.densify.until * self.course() as f64).round() as u64
    }

    /// The opacity below which Gaussians are removed, while growing and afterwards.
    pub fn cull_opacity(&self, growing: bool) -> f64 {
        let d = &self.densify;
        let usual = if growing { d.cull_opacity } else { d.cull_opacity_late };
        if self.is_gentle() { usual.min(0.5 * self.initial_opacity) } else { usual }
    }

    /// True if the run is too short for opacities to rise, or to recover from ceilings.
    pub fn is_gentle(&self) -> bool {
        self.course() < self.densify.gentle_below
    }

    /// The step up to which there is no refinement: the preset, but at most a quarter of a short run.
    pub fn warm_up(&self) -> u64 {
        self.densify.warm_up.min(self.course() / 4)
    }
}

/// Pixels of a photograph of the middle size, 640×360.
const MIDDLE: f64 = 230_400.0;

/// Half size, then full size: the larger the photographs are, the longer half size shows all that is learnt.
fn by_size(pixels: f64) -> [(f64, usize); 2] {
    let percent = 40.0 + 5.0 * math::log2(pixels.max(1.0) / MIDDLE);
    [(0.0, 2), (percent.round().clamp(20.0, 60.0) / 100.0, 1)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn schedules_are_those_of_the_method_at_fifteen_thousand_steps() {
        let resolution_schedule = vec![(0.0, 4), (0.2, 2), (0.4, 1)];
        let densify = Densify { warm_up: 600, ..Densify::default() };
        let p = ReconstructParams {
            iterations: 15_000,
            resolution_schedule,
            densify,
            ..ReconstructParams::default()
        };
        p.validate().unwrap();
        let divisors = [0, 2999, 3000, 5999, 6000, 14_999].map(|s| p.divisor(s));
        assert_eq!(divisors, [4, 4, 2, 2, 1, 1]);
        assert_eq!([0, 999, 1000, 2000, 3000, 9000].map(|s| p.active_degree(s)), [0, 0, 1, 2, 3, 3]);
        assert_eq!((p.densify_end(), p.warm_up()), (10_000, 600));
        let long = ReconstructParams { iterations: 20_000, ..p.clone() };
        assert_eq!((long.divisor(5999), long.divisor(6000), long.densify_end()), (2, 1, 10_000));
        let short = ReconstructParams { iterations: 1500, ..p };
        assert_eq!((short.divisor(299), short.divisor(300), short.active_degree(100)), (4, 2, 1));
        assert_eq!((short.densify_end(), short.warm_up()), (1000, 375));
    }

    #[test]
    fn a_default_run_sees_the_full_size_after_a_fifth() {
        let p = ReconstructParams::default();
        p.validate().unwrap();
        assert_eq!([0, 599, 600, 2999].map(|s| p.divisor(s)), [2, 2, 1, 1]);
        assert_eq!((p.densify_end(), p.warm_up()), (2000, 300));
    }

    #[test]
    fn without_a_schedule_the_full_size_comes_later_on_larger_photographs() {
        let p = ReconstructParams { resolution_schedule: Vec::new(), ..ReconstructParams::default() };
        p.validate().unwrap();
        assert_eq!([0, 1199, 1200, 2999].map(|s| p.divisor(s)), [2, 2, 1, 1]);
        for (width, height, from) in [(80, 45, 600), (320, 180, 900), (640, 360, 1200), (1280, 720, 1500)] {
            let sized = p.sized((width * height) as f64);
            assert_eq!([0, from - 1, from].map(|s| sized.divisor(s)), [2, 2, 1], "{width}");
        }
        let given = ReconstructParams { resolution_schedule: vec![(0.0, 1)], ..p };
        assert_eq!(given.sized(1e6), given);
    }

    #[test]
    fn short_runs_remove_only_what_has_faded() {
        let of = |iterations| ReconstructParams { iterations, ..ReconstructParams::default() };
        let (short, long) = (of(500), of(15_000));
        assert!(short.is_gentle() && !of(2000).is_gentle() && !long.is_gentle());
        assert_eq!([true, false].map(|growing| short.cull_opacity(growing)), [0.05; 2]);
        assert_eq!([true, false].map(|growing| long.cull_opacity(growing)), [0.5, 0.1]);
        let mut paper = short;
        paper.densify.gentle_below = 0;
        assert_eq!([true, false].map(|growing| paper.cull_opacity(growing)), [0.5, 0.1]);
    }

    #[test]
    fn a_wrong_value_is_named() {
        let wrong = |change: fn(&mut ReconstructParams)| {
            let mut p = ReconstructParams::default();
            change(&mut p);
            p.validate().unwrap_err().to_string()
        };
        assert!(wrong(|p| p.top_k = 9).contains("top_k"));
        assert!(wrong(|p| p.resolution_schedule = vec![(0.0, 1025)]).contains("1 to 1024"));
        assert!(wrong(|p| p.resolution_schedule = vec![(0.1, 1)]).contains("resolution_schedule"));
        assert!(wrong(|p| p.learning_rates.means.1 = f64::NAN).contains("means[1]"));
        assert!(wrong(|p| p.densify.opacity_ceiling = 1.0).contains("opacity_ceiling"));
        assert!(wrong(|p| p.iterations = 0).contains("iterations"));
        assert!(wrong(|p| p.iterations = u64::MAX).contains("iterations"));
        assert!(wrong(|p| p.anchors = 100_000).contains("expected 1 to 4096"));
        assert!(wrong(|p| p.anchors = 1 << 32).contains("anchors"));
        assert!(wrong(|p| p.random_points = usize::MAX).contains("random_points"));
    }
}
