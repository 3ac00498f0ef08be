//! The state of training between two steps: an engine starts from it, and a checkpoint stores it.
//!
//! It consists of plain rows in main memory, the same for every engine, so that a run can continue with
//! another one.

use serde::{Deserialize, Deserializer, Serialize, Serializer};
use use3d_medium::{MediumKind, MediumModel, Tensor};
use use3d_numerics::math;
use use3d_splat::{GaussianGradients, Gaussians};
use use3d_training::EngineError;

use crate::colors::ColorState;
use crate::density::Origin;
use crate::exposure::Exposures;

/// Both moments of every parameter of the Gaussians, stored like the parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Moments {
    /// Means of gradients.
    #[serde(with = "GaussianRows")]
    pub first: Gaussians,
    /// Means of squared gradients.
    #[serde(with = "GaussianRows")]
    pub second: Gaussians,
}

impl Moments {
    /// Moments of zero.
    pub fn new(gaussians: &Gaussians) -> Self {
        let zeros = zeros(gaussians.len(), gaussians.sh_degree);
        Self { first: zeros.clone(), second: zeros }
    }

    /// The moments of the rows of a refined scene: kept Gaussians keep theirs, new ones start with zero.
    /// The rows must come from existing Gaussians.
    pub fn rebuilt(&self, rows: &[Origin]) -> Self {
        let of = |from: &Gaussians| {
            let mut to = zeros(rows.len(), from.sh_degree);
            for (row, origin) in rows.iter().enumerate() {
                let Origin::Kept(i) = *origin else { continue };
                to.means[row] = from.means[i];
                to.log_scales[row] = from.log_scales[i];
                to.quaternions[row] = from.quaternions[i];
                to.opacity_logits[row] = from.opacity_logits[i];
                to.sh[row] = from.sh[i];
            }
            to
        };
        Self { first: of(&self.first), second: of(&self.second) }
    }
}

/// The scale of screen gradients for the size of the images: `(pixels / reference_pixels)^exponent`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GradientScale {
    /// Number of pixels for which the threshold of density control is meant; 0: the scale is always 1.
    pub reference_pixels: u64,
    /// Its exponent, 0 to 1.
    pub exponent: f64,
    /// True if opposite gradients of a Gaussian cancel and radii are kept; else absolute values are summed.
    pub signed: bool,
    /// True if absolute values are summed beside signed ones.
    pub both: bool,
}

impl GradientScale {
    /// The scale for an image with this many pixels.
    pub fn at(&self, pixels: f64) -> f32 {
        match self.reference_pixels {
            0 => 1.0,
            reference => math::powf(pixels / reference as f64, self.exponent) as f32,
        }
    }
}

/// Screen gradients since the last refinement, one row per Gaussian.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Statistics {
    /// Sums of their norms, as [density control](crate::density) scales them. If it compares signed and
    /// absolute ones, the rows of the absolute ones follow.
    pub norms: Vec<f32>,
    /// Renders in which the Gaussian was visible.
    pub renders: Vec<u32>,
    /// Largest radius on the screen, pixels; empty where density control does not ask for it.
    pub radii: Vec<f32>,
}

impl Statistics {
    /// The statistics of `n` Gaussians that were not seen yet.
    pub fn new(n: usize) -> Self {
        Self { norms: vec![0.0; n], renders: vec![0; n], radii: Vec::new() }
    }

    /// Adds one render of `width × height` pixels, which counts as one of `pixels`.
    pub fn gather(
        &mut self,
        gradients: &GaussianGradients,
        width: usize,
        height: usize,
        scale: &GradientScale,
        pixels: f64,
    ) {
        let (at, n) = (scale.at(pixels), self.renders.len());
        let (sx, sy) = (0.5 * at * width as f32, 0.5 * at * height as f32);
        let norm = |screen: &[f32; 2]| {
            let (x, y) = (sx * screen[0], sy * screen[1]);
            (x * x + y * y).sqrt()
        };
        if scale.both {
            self.norms.resize(2 * n, 0.0);
        }
        let (first, absolute) = self.norms.split_at_mut(n);
        let screen = if scale.signed { &gradients.signed_screen } else { &gradients.screen };
        for (i, (screen, &visible)) in screen.iter().zip(&gradients.visible).enumerate() {
            if visible {
                first[i] += norm(screen);
                self.renders[i] += 1;
            }
        }
        let seen = gradients.screen.iter().zip(&gradients.visible);
        for (sum, (screen, _)) in absolute.iter_mut().zip(seen).filter(|(_, (_, visible))| **visible) {
            *sum += norm(screen);
        }
    }

    /// The mean norm of a Gaussian; 0 if it was not seen.
    pub fn mean(&self, gaussian: usize) -> f64 {
        self.mean_of(gaussian, gaussian)
    }

    /// The mean absolute norm of a Gaussian, if it is summed beside the signed one.
    pub fn absolute_mean(&self, gaussian: usize) -> f64 {
        self.mean_of(self.renders.len() + gaussian, gaussian)
    }

    fn mean_of(&self, row: usize, gaussian: usize) -> f64 {
        match (self.norms.get(row), self.renders[gaussian]) {
            (None, _) | (_, 0) => 0.0,
            (Some(sum), n) => f64::from(*sum) / f64::from(n),
        }
    }
}

/// Parameters, moments and statistics of a run between two steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainingState {
    /// The version of this record's format, [`TrainingState::VERSION`].
    pub version: u32,
    /// The Gaussians, N of them.
    #[serde(with = "GaussianRows")]
    pub gaussians: Gaussians,
    /// Their moments, N rows each.
    pub moments: Moments,
    /// Their statistics, N rows.
    pub statistics: Statistics,
    /// The water.
    #[serde(with = "water")]
    pub medium: MediumModel,
    /// First and second moments of the water's [flat](MediumModel::flat) parameters.
    pub medium_moments: [Vec<f32>; 2],
    /// The training views' gains; empty if all views have the same exposure.
    pub exposures: Exposures,
    /// The colour field.
    pub colors: ColorState,
}

impl TrainingState {
    /// The current version of this record's format.
    pub const VERSION: u32 = 5;

    /// The state at the start of a run: these Gaussians, this water, and these gains of the training views
    /// (positive; empty if no view has one).
    pub fn new(gaussians: Gaussians, medium: MediumModel, gains: &[[f64; 3]]) -> Self {
        let count = medium.parameter_count();
        Self {
            version: Self::VERSION,
            moments: Moments::new(&gaussians),
            statistics: Statistics::new(gaussians.len()),
            gaussians,
            medium,
            medium_moments: [vec![0.0; count], vec![0.0; count]],
            exposures: Exposures::new(gains),
            colors: ColorState::default(),
        }
    }

    /// Checks that the version is the current one and that all lengths agree with each other and with the
    /// number of training views.
    pub fn check(&self, views: usize) -> Result<(), EngineError> {
        let wrong = |what: String| Err(EngineError::State(what));
        if self.version != Self::VERSION {
            let (found, known) = (self.version, Self::VERSION);
            return wrong(format!("it is of version {found}, expected {known}; start from the beginning"));
        }
        let n = self.gaussians.len();
        for (what, rows) in [
            ("Gaussians", &self.gaussians),
            ("first moments", &self.moments.first),
            ("second moments", &self.moments.second),
        ] {
            let lengths = [
                rows.means.len(),
                rows.log_scales.len(),
                rows.quaternions.len(),
                rows.opacity_logits.len(),
                rows.sh.len(),
            ];
            if lengths.iter().any(|l| *l != n) {
                return wrong(format!("its {what} have {lengths:?} rows, expected {n} in every array"));
            }
        }
        if self.gaussians.sh_degree > 3 {
            return wrong(format!("its colours have degree {}, expected 0 to 3", self.gaussians.sh_degree));
        }
        let statistics = [self.statistics.norms.len(), self.statistics.renders.len()];
        let radii = self.statistics.radii.len();
        if statistics[1] != n || ![n, 2 * n].contains(&statistics[0]) || ![0, n].contains(&radii) {
            return wrong(format!("its statistics have {statistics:?} rows, expected {n}"));
        }
        let (count, moments) = (self.medium.parameter_count(), self.medium_moments.each_ref().map(Vec::len));
        if moments != [count; 2] {
            return wrong(format!("the water's moments have {moments:?} values, expected {count}"));
        }
        self.exposures.log_gains.check("gains", 3, views)?;
        self.colors.check(views)
    }
}

/// `n` Gaussians with every parameter zero.
pub(crate) fn zeros(n: usize, sh_degree: usize) -> Gaussians {
    Gaussians {
        sh_degree,
        means: vec![[0.0; 3]; n],
        log_scales: vec![[0.0; 3]; n],
        quaternions: vec![[0.0; 4]; n],
        opacity_logits: vec![0.0; n],
        sh: vec![[[0.0; 3]; 16]; n],
    }
}

/// The stored form of Gaussians, because `splat` has no file formats.
#[derive(Serialize, Deserialize)]
#[serde(remote = "Gaussians")]
struct GaussianRows {
    sh_degree: usize,
    means: Vec<[f32; 3]>,
    log_scales: Vec<[f32; 3]>,
    quaternions: Vec<[f32; 4]>,
    opacity_logits: Vec<f32>,
    sh: Vec<[[f32; 3]; 16]>,
}

/// The stored form of the water: its kind and its tensors.
mod water {
    use super::*;

    #[derive(Serialize, Deserialize)]
    struct Stored {
        kind: String,
        top_k: usize,
        tensors: Vec<(String, Vec<usize>, Vec<f32>)>,
    }

    pub(super) fn serialize<S: Serializer>(water: &MediumModel, serializer: S) -> Result<S::Ok, S::Error> {
        let top_k = water.anchors().map_or(0, |anchors| anchors.top_k);
        let tensors = water.to_tensors().into_iter();
        let tensors = tensors.map(|(name, tensor)| (name, tensor.shape, tensor.values)).collect();
        Stored { kind: water.kind().name().to_string(), top_k, tensors }.serialize(serializer)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<MediumModel, D::Error> {
        use serde::de::Error;

        let Stored { kind, top_k, tensors } = Stored::deserialize(deserializer)?;
        let kind = MediumKind::from_name(&kind)
            .ok_or_else(|| D::Error::custom(format!("there is no water of kind `{kind}`")))?;
        let tensors = tensors.into_iter().map(|(name, shape, values)| (name, Tensor { shape, values }));
        MediumModel::from_tensors(kind, top_k, &tensors.collect()).map_err(D::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use use3d_medium::{MediumGlobal, MediumMlp, MediumPerView, MediumRbf, MediumUir};

    use super::*;

    #[test]
    fn screen_gradients_are_scaled_by_half_of_each_side() {
        let gradients = GaussianGradients {
            screen: vec![[0.3, 0.4]; 2],
            signed_screen: vec![[0.3, 0.0]; 2],
            visible: vec![true, false],
            ..GaussianGradients::default()
        };
        let scale = GradientScale { reference_pixels: 50, exponent: 0.5, signed: false, both: false };
        let gathered = |scale: GradientScale| {
            let mut seen = Statistics::new(2);
            seen.gather(&gradients, 20, 10, &scale, 200.0);
            assert_eq!(seen.renders, [1, 0]);
            seen
        };
        let seen = gathered(scale);
        assert!((seen.norms[0] - 52.0f32.sqrt()).abs() < 1e-5, "{:?}", seen.norms);
        assert_eq!((seen.norms.len(), seen.norms[1]), (2, 0.0));
        // Signed ones, and the absolute ones beside them.
        let both = gathered(GradientScale { signed: true, both: true, ..scale });
        assert!((both.mean(0) - 6.0).abs() < 1e-5 && (both.absolute_mean(0) - seen.mean(0)).abs() < 1e-6);
        assert_eq!((both.absolute_mean(1), seen.absolute_mean(0)), (0.0, 0.0));
    }

    fn state(medium: MediumModel) -> TrainingState {
        let mut gaussians = zeros(3, 2);
        gaussians.means[1] = [1.0, -0.0, f32::MIN_POSITIVE];
        gaussians.sh[2][15] = [0.25, 0.5, 0.75];
        let mut state = TrainingState::new(gaussians, medium, &[[1.0; 3], [2.0; 3]]);
        state.moments.second.quaternions[0][3] = 7.0;
        state.statistics.renders[2] = 4;
        state
    }

    #[test]
    fn a_state_goes_through_a_checkpoint_whatever_its_water() {
        let dir = tempfile::tempdir().unwrap();
        let file = use3d_training::CheckpointFile::new(dir.path(), "state");
        let mut rbf = MediumRbf::new(5, 3);
        rbf.log_widths[4] = 0.125;
        let numbers = vec![[[0.5; 3], [-1.0; 3], [2.0; 3]]; 2];
        let (centers, axes) = (vec![[1.0, 2.0, 3.0]; 2], vec![[0.0, 0.6, 0.8]; 2]);
        let waters = [
            MediumModel::None,
            MediumModel::PerView(MediumPerView { centers, axes, numbers }),
            MediumModel::Global(MediumGlobal::default()),
            MediumModel::Rbf(rbf),
            MediumModel::Mlp(MediumMlp::new(9)),
            MediumModel::Uir(MediumUir::new(9)),
        ];
        for water in waters {
            let state = state(water);
            file.save(&state).unwrap();
            let read: TrainingState = file.load().unwrap().unwrap();
            assert!(read == state, "{:?}", state.medium.kind());
            read.check(2).unwrap();
        }
    }

    #[test]
    fn a_state_that_does_not_agree_is_refused_by_what_is_wrong() {
        let good = state(MediumModel::Global(MediumGlobal::default()));
        type Change = (&'static str, fn(&mut TrainingState));
        let changes: [Change; 6] = [
            ("version 2, expected 5", |s| s.version = 2),
            ("first moments", |s| s.moments.first.means.truncate(1)),
            ("Gaussians", |s| s.gaussians.sh.truncate(1)),
            ("statistics", |s| s.statistics.norms.push(0.0)),
            ("the water's moments", |s| s.medium_moments[1].clear()),
            ("degree 4", |s| s.gaussians.sh_degree = 4),
        ];
        for (words, change) in changes {
            let mut state = good.clone();
            change(&mut state);
            let error = state.check(2).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
        assert!(good.check(3).unwrap_err().to_string().contains("gains"));
    }
}
