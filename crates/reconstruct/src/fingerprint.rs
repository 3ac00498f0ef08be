//! The identity of a run, by which its checkpoints are recognised: a digest of parameters, cameras, points
//! and pixels.

use use3d_capture::Capture;
use use3d_training::EngineChoice;

use crate::bounds::most_gaussians;
use crate::load::Views;
use crate::{FoundWater, ReconstructParams};

/// Computes the digest.
pub(crate) fn fingerprint(
    capture: &Capture,
    found: Option<&FoundWater>,
    gains: Option<&Vec<[f64; 3]>>,
    params: &ReconstructParams,
    views: &Views,
) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    // The frequency of checkpoints does not change the result, and neither does the length beyond the
    // schedules; the cap is replaced by the number that it results in. A run begun on one engine may
    // continue on another.
    let params = ReconstructParams {
        iterations: params.course(),
        max_gaussians: most_gaussians(capture, params),
        // It acts after the last checkpoint.
        unknown_below: 0.0,
        checkpoint_steps: 1,
        checkpoint_minutes: 1.0,
        engine: EngineChoice::Cpu,
        ..params.clone()
    };
    hasher.update(format!("{params:?}").as_bytes());
    for views in [&views.train, &views.test] {
        // A view that is moved from training to the held-out ones changes the digest.
        hasher.update(&(views.len() as u64).to_le_bytes());
        for view in views {
            hasher.update(format!("{:?}", view.camera).as_bytes());
            view.fingerprint(&mut hasher);
        }
    }
    for point in &capture.points {
        hasher.update(bytemuck::bytes_of(&point.position.to_array()));
        hasher.update(&point.color);
    }
    if let Some(found) = found {
        hasher.update(format!("{found:?}").as_bytes());
    }
    if let Some(gains) = gains {
        hasher.update(bytemuck::cast_slice(gains.as_flattened()));
    }
    *hasher.finalize().as_bytes()
}
