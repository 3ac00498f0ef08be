//! A packed scene with photographs, made from random draws, for comparing and timing whole steps.

use use3d_atc::consensus::{LocalConsensus, Targets};
use use3d_atc::extractor::ExtractorSettings;
use use3d_atc::proposers::ProposerId;
use use3d_capture::{
    Appearance, Camera, FileName, Frame, Intrinsics, KeptWater, Map, Pixels, Pose, Raster, View,
};
use use3d_enhance::EnhanceView;
use use3d_medium::{MediumModel, MediumRbf};
use use3d_numerics::math;
use use3d_reconstruct::engine::{StepPlan, StepRates, TrainingState};
use use3d_reconstruct::{LoadedView, ReconstructParams, TrainingView};
use use3d_scene::Scene;
use use3d_splat::Gaussians;
use use3d_training::EngineError;

use super::draws;
use crate::device::NAME;

/// Targets for this number of Gaussians that no scene needs to reach: one global operator in every view,
/// and local ones of some size.
pub fn targets(gaussians: usize, views: &[EnhanceView], appearance: Appearance) -> Targets {
    let operator = std::array::from_fn(|i| 0.02 * (i as f64 - 5.0));
    Targets {
        extractor: ExtractorSettings::default(),
        proposer: ProposerId::default(),
        appearance,
        kept_water: KeptWater::ALL,
        scene: operator,
        dispersion: 0.0,
        global_scales: [0.2; 12],
        local_scales: [0.1; 6],
        views: views.iter().map(|view| (view.name.clone(), operator)).collect(),
        state: LocalConsensus {
            mean: (0..gaussians).map(|i| std::array::from_fn(|q| 1e-2 * ((i + q) % 7) as f32)).collect(),
            weight: vec![1.0; gaussians],
            count: vec![3; gaussians],
        },
    }
}

/// A scene and its views, described by their sizes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SceneSize {
    /// Number of pixels across.
    pub width: usize,
    /// Number of pixels down.
    pub height: usize,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Number of views.
    pub views: usize,
    /// The seed of its draws.
    pub seed: u64,
}

impl SceneSize {
    /// The initial state of a run on it. Gaussians fill a slab in front of the cameras, each a few pixels
    /// wide. With enough Gaussians, about fifty lie in front of a pixel.
    pub fn state(&self) -> TrainingState {
        let (n, stream) = (self.gaussians, draws("packed scene", self.seed));
        let uniform = |i: usize, k: u64| stream.uniform(64 * i as u64 + k) as f32;
        let normal = |i: usize, k: u64| stream.normal(64 * i as u64 + k) as f32;
        let mut gaussians = Gaussians::empty(3);
        // About as wide as the distance between neighbours.
        let width = math::ln(0.9f32 / math::powf((n.max(1)) as f32, 1.0 / 3.0));
        for i in 0..n {
            gaussians.means.push([
                3.2 * (uniform(i, 0) - 0.5),
                2.2 * (uniform(i, 1) - 0.5),
                1.5 + 1.5 * uniform(i, 2),
            ]);
            gaussians.log_scales.push(std::array::from_fn(|k| width + 0.4 * normal(i, 3 + k as u64)));
            gaussians.quaternions.push(std::array::from_fn(|k| normal(i, 6 + k as u64)));
            gaussians.opacity_logits.push(-1.5 + normal(i, 10));
            gaussians.sh.push(std::array::from_fn(|band| {
                let spread = if band == 0 { 0.8 } else { 0.1 };
                std::array::from_fn(|c| spread * normal(i, 11 + (3 * band + c) as u64))
            }));
        }
        TrainingState::new(gaussians, MediumModel::Rbf(MediumRbf::new(8, 4)), &[])
    }

    /// The initial state as a finished scene.
    pub fn scene(&self) -> Scene {
        let TrainingState { gaussians, medium, .. } = self.state();
        Scene { gaussians, frame: Frame::IDENTITY, medium, medium_degree: 3, enhancement: None }
    }

    /// Its views for stage 2, which consist of names and cameras.
    pub fn enhance_views(&self) -> Result<Vec<EnhanceView>, EngineError> {
        let view = |(index, camera)| EnhanceView { name: format!("{index}.png"), camera };
        Ok(self.cameras()?.into_iter().enumerate().map(view).collect())
    }

    /// The cameras of its photographs.
    pub fn cameras(&self) -> Result<Vec<Camera>, EngineError> {
        Ok(self.training_views()?.iter().map(|view| view.camera_over(1).0).collect())
    }

    /// Its photographs, with masks and depth priors.
    pub fn training_views(&self) -> Result<Vec<TrainingView>, EngineError> {
        (0..self.views).map(|index| self.view(index)).collect()
    }

    fn view(&self, index: usize) -> Result<TrainingView, EngineError> {
        let (width, height) = (self.width, self.height);
        let (w, h, n) = (width as f64, height as f64, width * height);
        let stream = draws("packed photographs", self.seed + 1000 * index as u64);
        let wave = |i: usize| {
            let (x, y) = ((i % width) as f32 / width as f32, (i % n / width) as f32 / height as f32);
            let shade = math::sin(9.0 * x + (i / n) as f32) * math::cos(7.0 * y + index as f32);
            110.0 + 60.0 * shade + 25.0 * (stream.uniform(i as u64) as f32 - 0.5)
        };
        let pixels = (0..3 * n).map(|i| wave(i).clamp(0.0, 255.0) as u8).collect();
        let prior = (0..n).map(|i| 0.2 + stream.uniform((4 * n + i) as u64) as f32).collect();
        let mask = (0..n).map(|i| if i % width < width / 16 { 0.0 } else { 1.0 }).collect();
        let turn = |k: u64| 0.2 * (stream.uniform((6 * n) as u64 + k) - 0.5);
        let rotation = glam::DMat3::from_euler(glam::EulerRot::XYZ, turn(0), turn(1), turn(2));
        let pose = Pose::from_center(rotation, glam::DVec3::new(turn(3), turn(4), turn(5)));
        let intrinsics = Intrinsics { width, height, fx: 0.9 * w, fy: 0.9 * w, cx: 0.5 * w, cy: 0.5 * h };
        let failed = |what: String| EngineError::Request { engine: NAME, what };
        let missing = || failed(format!("a packed view of {width} x {height} pixels"));
        let name = FileName::new(&format!("{index}.png")).map_err(|e| failed(e.to_string()))?;
        let loaded = LoadedView {
            pixels: Pixels::Eight(Raster::from_planes(width, height, pixels).ok_or_else(missing)?),
            mask: Some(Map::from_planes(width, height, mask).ok_or_else(missing)?),
            depth_prior: Some(Map::from_planes(width, height, prior).ok_or_else(missing)?),
        };
        let view = View {
            name,
            id: 1 + index as u32,
            image: Default::default(),
            mask: None,
            depth_prior: None,
            camera: Camera { intrinsics, pose },
        };
        let (view, _) = TrainingView::new(&view, loaded).map_err(|e| failed(e.to_string()))?;
        Ok(view)
    }

    /// The plan of a step of the method with all features on.
    pub fn plan(step: u64) -> StepPlan {
        let params = ReconstructParams::default();
        let r = &params.learning_rates;
        StepPlan {
            rates: StepRates {
                means: r.means.0,
                sh_constant: r.sh_constant.0,
                sh_directional: r.sh_directional.0,
                opacity: r.opacity.0,
                scales: r.scales.0,
                quaternions: r.quaternions.0,
                medium_constant: r.medium_constant.0,
                medium_directional: r.medium_directional.0,
                medium_network: r.medium_network.0,
            },
            gather: Some(params.densify.gradient_scale()),
            ..StepPlan::at_full_size(&params, step)
        }
    }
}
