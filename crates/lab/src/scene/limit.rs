//! The most that the compositor can do on this machine in one thread: Gaussians that cover every pixel of a
//! small image, all in the first-level cache.

use std::time::Instant;

use fearless_simd::Level;
use serde::Serialize;
use use3d_capture::{Camera, Image, Intrinsics, Lattice, MediumMaps, Pose};
use use3d_numerics::math;
use use3d_splat::{
    Colors, GaussianGradients, Gaussians, Gradients, Options, Prepared, Rasterizer, RenderGradients,
    Rendered, ViewOf,
};

/// The limits of one thread, in nanoseconds a pair of pixel and Gaussian, forward and backward.
#[derive(Clone, Debug, Serialize)]
pub struct Limit {
    /// The instruction set.
    pub instructions: String,
    /// In water.
    pub water: f64,
    /// Without water.
    pub dry: f64,
}

impl Limit {
    /// Measures the limits, in a second or two. `None` without a thread pool of its own.
    pub fn measure() -> Option<Self> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().ok()?;
        let instructions = format!("{:?}", Level::new());
        let instructions = instructions.split('(').next().unwrap_or_default().to_string();
        pool.install(|| Some(Self { instructions, water: dense(true)?, dry: dense(false)? }))
    }
}

/// Nanoseconds a pair where every pair contributes: 128 Gaussians that cover 128×128 pixels.
fn dense(water: bool) -> Option<f64> {
    let (side, count) = (128, 128);
    let camera = Camera {
        intrinsics: Intrinsics { width: side, height: side, fx: 900.0, fy: 900.0, cx: 64.0, cy: 64.0 },
        pose: Pose::IDENTITY,
    };
    let mut gaussians = Gaussians::empty(0);
    for i in 0..count {
        let z = 2.0 + 0.05 * i as f32;
        gaussians.means.push([0.01, -0.01, z]);
        gaussians.log_scales.push([math::ln(0.3 * z); 3]);
        gaussians.quaternions.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.opacity_logits.push(-3.4);
        gaussians.sh.push([[0.3; 3]; 16]);
    }
    let smooth = |scale: f32| {
        let value = |i: usize| scale * (1.0 + 0.2 * (i % (side * side)) as f32 / (side * side) as f32);
        Image::from_planes(side, side, (0..3 * side * side).map(value).collect())
    };
    let mut maps = MediumMaps::zeros(side, side);
    (maps.color, maps.backscatter, maps.attenuation) = (smooth(0.3)?, smooth(0.2)?, smooth(0.2)?);
    let medium = water.then_some(&maps);
    let image = Image::from_planes(side, side, (0..3 * side * side).map(|i| math::sin(i as f32)).collect())?;
    let mut view = Prepared::new();
    view.prepare(&gaussians, &camera, &Lattice::full(&camera.intrinsics), Colors::Sh { degree: 0 });
    let pairs = view.pairs().contributing as f64;
    let (mut rasterizer, mut out) = (Rasterizer::new(), Rendered::new());
    let (mut grads, mut d_maps) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
    let d_rendered = RenderGradients { image: &image, depth: None, accumulation: None, clear: None };
    let options = Options::default();
    let mut best = f64::INFINITY;
    for _ in 0..25 {
        let start = Instant::now();
        rasterizer.forward(&view, medium, &options, &mut out);
        let of = ViewOf { gaussians: &gaussians, camera: &camera };
        let into = Gradients { gaussians: &mut grads, medium: water.then_some(&mut d_maps) };
        rasterizer.backward(&view, of, medium, &options, &d_rendered, into);
        best = best.min(start.elapsed().as_secs_f64());
    }
    Some(best * 1e9 / pairs)
}
