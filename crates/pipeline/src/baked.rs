//! The difference between a look with water and the file that it was baked into.

use use3d_capture::{Camera, Frame, Image, Lattice};
use use3d_medium::MediumModel;
use use3d_metrics::{MetricError, mean_ciede2000};
use use3d_render::{InWater, Look, Mode, RenderError, Renderer, Rendering, SceneRenderer};
use use3d_scene::Scene;
use use3d_splat::Rendered;

/// Number of cameras at which the two are compared, evenly chosen.
const CAMERAS: usize = 12;
/// The longest side of the compared pictures, pixels.
const SIDE: usize = 400;

/// Mean colour differences (ΔE00) between pictures of the scene and of the baked file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Difference {
    /// Over all compared cameras.
    pub mean: f64,
    /// At the camera where it is largest.
    pub worst: f64,
}

/// The error of a comparison of two pictures.
#[derive(Debug, thiserror::Error)]
pub enum DifferenceError {
    /// The scene cannot be drawn.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The pictures cannot be compared.
    #[error(transparent)]
    Metric(#[from] MetricError),
}

/// Draws both at up to twelve of `cameras` (in the scene's frame) and compares the pictures as a screen shows
/// them.
///
/// # Errors
/// Returns the errors of drawing and of the comparison.
pub fn difference(
    scene: &Scene,
    look: Look,
    water: f32,
    baked: &InWater,
    cameras: &[Camera],
) -> Result<Difference, DifferenceError> {
    let file = Scene {
        gaussians: baked.gaussians.clone(),
        frame: Frame::IDENTITY,
        medium: MediumModel::None,
        medium_degree: 0,
        enhancement: None,
    };
    let mut in_scene = Renderer::new(scene, look)?.with_water(water)?;
    let mut in_file = Renderer::new(&file, Look::Reconstruction)?;
    let (mut sum, mut worst) = (0.0, 0.0f64);
    let mut drawn = Rendered::new();
    let compared = small(cameras);
    for camera in &compared {
        let lattice = Lattice::full(&camera.intrinsics);
        let mut picture = |renderer: &mut Renderer<'_>| -> Result<Image, RenderError> {
            renderer.render(camera, &lattice, false, &mut drawn)?;
            Ok(drawn.image.map(|v| v.clamp(0.0, 1.0)))
        };
        let apart = mean_ciede2000(&picture(&mut in_scene)?, &picture(&mut in_file)?)?;
        sum += apart;
        worst = worst.max(apart);
    }
    Ok(Difference { mean: sum / compared.len().max(1) as f64, worst })
}

/// Up to twelve of the cameras, evenly chosen, for small pictures.
fn small(cameras: &[Camera]) -> Vec<Camera> {
    let count = cameras.len().min(CAMERAS);
    (0..count).map(|k| cameras[k * cameras.len() / count].no_larger_than(SIDE)).collect()
}

/// Counts the colour values of looks that are too strong in their scene, and those cut off at white.
#[derive(Clone, Copy, Debug, Default)]
pub struct CutOff {
    white: usize,
    all: usize,
}

impl CutOff {
    /// Counts the pictures of modes that are too strong in a scene.
    pub fn add(&mut self, scene: &Scene, modes: &[Mode], pictures: &[Rendering]) {
        for (mode, picture) in modes.iter().zip(pictures) {
            if let (true, Rendering::Color(image)) = (mode.is_too_strong(scene), picture) {
                self.white += image.data().iter().filter(|value| **value >= 1.0).count();
                self.all += image.data().len();
            }
        }
    }

    /// The share that is cut off; `None` without such pictures.
    pub fn share(&self) -> Option<f64> {
        (self.all > 0).then(|| self.white as f64 / self.all as f64)
    }
}

/// Counts them for a look in up to twelve small pictures.
///
/// # Errors
/// Returns the error of drawing.
pub fn cut_off(scene: &Scene, mode: Mode, cameras: &[Camera]) -> Result<CutOff, RenderError> {
    let (mut renderer, mut cut_off) = (SceneRenderer::new(scene, 1.0)?, CutOff::default());
    for camera in small(cameras) {
        cut_off.add(scene, &[mode], &renderer.render(&camera, &[mode])?);
    }
    Ok(cut_off)
}
