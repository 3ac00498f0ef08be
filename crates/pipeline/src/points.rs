//! Shows a capture as a scene: its sparse points as small round Gaussians, in air.

use use3d_capture::Capture;
use use3d_medium::MediumModel;
use use3d_numerics::order::median;
use use3d_numerics::spherical_harmonics::C0;
use use3d_scene::Scene;
use use3d_splat::Gaussians;

use crate::WorkError;

/// A point's size, as a share of the median distance of the points from their centre.
const SIZE: f64 = 0.004;
/// Nearly opaque.
const OPACITY_LOGIT: f32 = 4.0;

/// Converts the points of a capture to a scene.
///
/// # Errors
/// A capture without points; the message does not name it.
pub fn scene(capture: &Capture) -> Result<Scene, WorkError> {
    let places: Vec<glam::DVec3> = capture.points.iter().map(|p| p.position).collect();
    let count = places.len();
    if count == 0 {
        return Err(WorkError::input(
            "this capture has no sparse points, so there is nothing to show yet; `use3d reconstruct` makes \
             a scene from it",
        ));
    }
    let middle = places.iter().sum::<glam::DVec3>() / count as f64;
    let usual = median(places.iter().map(|p| (*p - middle).length())).unwrap_or(0.0);
    let size = (SIZE * usual).max(1e-6);
    let harmonics = |rgb: [u8; 3]| {
        let mut sh = [[0.0; 3]; 16];
        sh[0] = rgb.map(|v| (f32::from(v) / 255.0 - 0.5) / C0);
        sh
    };
    let gaussians = Gaussians {
        sh_degree: 0,
        means: places.iter().map(|p| p.as_vec3().to_array()).collect(),
        log_scales: vec![[use3d_numerics::math::ln(size) as f32; 3]; count],
        quaternions: vec![[1.0, 0.0, 0.0, 0.0]; count],
        opacity_logits: vec![OPACITY_LOGIT; count],
        sh: capture.points.iter().map(|p| harmonics(p.color)).collect(),
    };
    Ok(Scene {
        gaussians,
        frame: capture.frame,
        medium: MediumModel::None,
        medium_degree: 0,
        enhancement: None,
    })
}
