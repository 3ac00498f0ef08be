//! The extent of a scene: the region that a visitor wants to see, without the few Gaussians that are far
//! away.

use glam::DVec3;
use use3d_capture::Camera;
use use3d_numerics::math;
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

/// The size of a Gaussian for the eye, where no photograph says how much it shows: opacity times area.
pub(crate) fn size(gaussians: &Gaussians, i: usize) -> f32 {
    let area = math::exp(2.0 / 3.0 * gaussians.log_scales[i].iter().sum::<f32>());
    area / (1.0 + math::exp(-gaussians.opacity_logits[i]))
}

/// Number of Gaussians with which a page begins.
const FIRST: usize = 1 << 15;

/// The Gaussians in the order of the file, and the number of those with which a page begins: the ones of the
/// greatest `weight`. Each of the two groups is in the order of a space-filling curve, so that neighbours in
/// space are neighbours in the file. Such a file compresses better, and a graphics card uses its cache
/// better.
pub(crate) fn file_order(gaussians: &Gaussians, weight: impl Fn(usize) -> f32) -> (Vec<u32>, usize) {
    let n = gaussians.len();
    let mut ranked: Vec<u32> = (0..n as u32).collect();
    if n > FIRST {
        ranked.sort_by(|a, b| weight(*b as usize).total_cmp(&weight(*a as usize)).then(a.cmp(b)));
    }
    let (first, rest) = ranked.split_at_mut(n.min(FIRST));
    sort_along_curve(gaussians, first);
    sort_along_curve(gaussians, rest);
    (ranked, n.min(FIRST))
}

/// All Gaussians along the curve.
pub(crate) fn along_curve(gaussians: &Gaussians) -> Vec<u32> {
    let mut all: Vec<u32> = (0..gaussians.len() as u32).collect();
    sort_along_curve(gaussians, &mut all);
    all
}

fn sort_along_curve(gaussians: &Gaussians, indices: &mut [u32]) {
    let [low, high] = bounds(gaussians);
    let spread = |v: u32| {
        // Puts two zeros between the ten bits of `v`.
        (0..10).fold(0u32, |sum, bit| sum | (((v >> bit) & 1) << (3 * bit)))
    };
    indices.sort_by_cached_key(|i| {
        let mean = &gaussians.means[*i as usize];
        let code = (0..3).fold(0u32, |code, axis| {
            let side = (high[axis] - low[axis]).max(1e-9);
            let at = ((f64::from(mean[axis]) - low[axis]) / side * 1023.0).clamp(0.0, 1023.0);
            code | (spread(at as u32) << axis)
        });
        (code, *i)
    });
}
