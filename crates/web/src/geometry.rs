//! The extent of a scene: the region that a visitor wants to see, without the few Gaussians that are far
//! away.

use glam::DVec3;
use use3d_capture::Camera;
use use3d_numerics::order::Ascending;
use use3d_splat::Gaussians;

/// Number of Gaussians sampled for a quantile: more would hardly change it.
const SAMPLE: usize = 20_000;

fn sample(gaussians: &Gaussians) -> impl Iterator<Item = [f32; 3]> + '_ {
    let step = gaussians.len().div_ceil(SAMPLE).max(1);
    gaussians.means.iter().step_by(step).copied()
}

/// Lower and upper corner of the middle nine tenths of the centres, per axis.
pub(crate) fn bounds(gaussians: &Gaussians) -> [[f64; 3]; 2] {
    let axes = [0, 1, 2].map(|axis| Ascending::of(sample(gaussians).map(|m| m[axis])));
    [0.05, 0.95].map(|share| axes.each_ref().map(|axis| axis.below(share).unwrap_or(0.0).into()))
}

/// The median depth of the Gaussians that a camera sees, in scene units; `None` if it sees none.
pub(crate) fn focus(gaussians: &Gaussians, camera: &Camera) -> Option<f64> {
    let (w, h) = (camera.intrinsics.width as f64, camera.intrinsics.height as f64);
    let depths = sample(gaussians)
        .filter_map(|m| camera.project(DVec3::new(m[0].into(), m[1].into(), m[2].into())))
        .filter(|(pixel, _)| (0.0..w).contains(&pixel.x) && (0.0..h).contains(&pixel.y))
        .map(|(_, depth)| depth);
    Ascending::of(depths).below(0.5)
}

/// The Gaussians in the order of a space-filling curve, so that neighbours in space are neighbours in the
/// file. Such a file compresses better, and a graphics card uses its cache better.
pub(crate) fn curve_order(gaussians: &Gaussians) -> Vec<u32> {
    let [low, high] = bounds(gaussians);
    let spread = |v: u32| {
        // Puts two zeros between the ten bits of `v`.
        (0..10).fold(0u32, |sum, bit| sum | (((v >> bit) & 1) << (3 * bit)))
    };
    let code = |m: &[f32; 3]| {
        (0..3).fold(0u32, |code, axis| {
            let side = (high[axis] - low[axis]).max(1e-9);
            let at = ((f64::from(m[axis]) - low[axis]) / side * 1023.0).clamp(0.0, 1023.0);
            code | (spread(at as u32) << axis)
        })
    };
    let mut keyed: Vec<(u32, u32)> = gaussians.means.iter().map(code).zip(0..).collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, i)| i).collect()
}
