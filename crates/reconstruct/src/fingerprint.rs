//! Whether a checkpoint belongs to this run: a digest of parameters, cameras, points and pixels.

use use3d_capture::Capture;
use use3d_training::EngineChoice;

use crate::bounds::most_gaussians;
use crate::load::Views;
use crate::triangles::Between;
use crate::{FoundWater, ReconstructParams};

/// The digest.
pub(crate) fn fingerprint(
    capture: &Capture,
    found: Option<&FoundWater>,
    gains: Option<&Vec<[f64; 3]>>,
    between: &[Between],
    params: &ReconstructParams,
    views: &Views,
) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    // How often checkpoints are written changes nothing, nor does the length beyond the schedules; the cap
    // counts as what it comes to. A run begun on one engine may go on with another.
    let params = ReconstructParams {
        iterations: params.course(),
        max_gaussians: most_gaussians(capture, params),
        checkpoint_steps: 1,
        checkpoint_minutes: 1.0,
        engine: EngineChoice::Cpu,
        ..params.clone()
    };
    hasher.update(format!("{params:?}").as_bytes());
    for view in views.train.iter().chain(&views.test) {
        hasher.update(format!("{:?}", view.camera).as_bytes());
        view.fingerprint(&mut hasher);
    }
    for point in &capture.points {
        hasher.update(bytemuck::bytes_of(&point.position.to_array()));
        hasher.update(&point.color);
    }
    for point in between {
        hasher.update(bytemuck::bytes_of(&point.position.to_array()));
        hasher.update(bytemuck::bytes_of(&point.color));
    }
    if let Some(found) = found {
        found.fingerprint(&mut hasher);
    }
    if let Some(gains) = gains {
        hasher.update(bytemuck::cast_slice(gains.as_flattened()));
    }
    *hasher.finalize().as_bytes()
}
