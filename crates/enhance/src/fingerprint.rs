//! The identity of a run, by which its checkpoints are recognised: a digest of everything that affects a
//! step.

use use3d_scene::Scene;

use crate::losses::TERMS;
use crate::views::{EnhanceView, Guidance};
use crate::{EnhanceError, EnhanceParams};

/// Computes the digest. It does not contain the length of the training, the frequency of saving, the memory
/// limit and the device, because they may change between two sessions of one run. It contains the frequency
/// of log lines, because the log is part of the result.
pub(crate) fn fingerprint(
    scene: &Scene,
    views: &[EnhanceView],
    guidance: Guidance<'_>,
    params: &EnhanceParams,
) -> Result<[u8; 32], EnhanceError> {
    let mut hash = blake3::Hasher::new();
    let defaults = EnhanceParams::default();
    let shaping = EnhanceParams {
        iterations: defaults.iterations,
        checkpoint_every: defaults.checkpoint_every,
        cache_mib: defaults.cache_mib,
        engine: defaults.engine,
        ..params.clone()
    };
    hash.update(format!("{shaping:?}").as_bytes());
    // A state has one entry per term of the loss.
    for row in TERMS {
        hash.update(row.name.as_bytes());
        hash.update(&[0]);
    }
    let g = &scene.gaussians;
    hash.update(&(g.len() as u64).to_le_bytes());
    hash.update(&[g.sh_degree as u8, scene.medium_degree as u8, scene.medium.kind() as u8]);
    for rows in [&g.means, &g.log_scales] {
        hash.update(bytemuck::cast_slice(rows));
    }
    hash.update(bytemuck::cast_slice(&g.quaternions));
    hash.update(bytemuck::cast_slice(&g.opacity_logits));
    hash.update(bytemuck::cast_slice(&g.sh));
    hash.update(bytemuck::cast_slice(&scene.medium.flat()));
    let top_k = scene.medium.anchors().map_or(0, |anchors| anchors.top_k);
    hash.update(&(top_k as u64).to_le_bytes());
    for view in views {
        hash.update(&(view.name.len() as u64).to_le_bytes());
        hash.update(view.name.as_bytes());
        let (k, pose) = (&view.camera.intrinsics, &view.camera.pose);
        for v in [k.width as f64, k.height as f64, k.fx, k.fy, k.cx, k.cy]
            .into_iter()
            .chain(pose.rotation.to_cols_array())
            .chain(pose.translation.to_array())
        {
            hash.update(&v.to_le_bytes());
        }
    }
    match guidance {
        Guidance::Targets(targets) => {
            hash.update(&targets.to_bytes()?);
        }
        Guidance::Labels(labels) => {
            for pixels in labels.views() {
                hash.update(bytemuck::cast_slice(pixels.data()));
            }
        }
    }
    Ok(*hash.finalize().as_bytes())
}
