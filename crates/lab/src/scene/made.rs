//! A scene with the statistics of a trained one, from a seed: Gaussians of about a pixel on a bumpy ground
//! seen from above its edge, drawn out along one axis, most of them opaque.

use std::error::Error;

use use3d_capture::{Camera, FileName, Frame, Intrinsics, Lattice, MediumMaps, Pixels, Pose, Raster, View};
use use3d_medium::{MediumModel, MediumStart};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_reconstruct::{LoadedView, ReconstructParams};
use use3d_scene::{Compositor, Scene};
use use3d_splat::{Gaussians, Options, Rendered};

/// A made scene, and a photograph of it.
pub(super) fn made(
    count: usize,
    (width, height): (usize, usize),
) -> Result<(Scene, View, LoadedView), Box<dyn Error + Send + Sync>> {
    let stream = Stream::new(5, Purpose::new("bench scene"), 0);
    let (w, h) = (width as f64, height as f64);
    let focal = 0.8 * w;
    let intrinsics = Intrinsics { width, height, fx: focal, fy: focal, cx: 0.5 * w, cy: 0.5 * h };
    let camera = Camera { intrinsics, pose: Pose::IDENTITY };
    // Gaussians are about a pixel wide if there are 122,000 of them at 640×360. In other scenes the size is
    // such that as many lie on every pixel.
    let pixels = 0.66 * (w * h / 230_400.0 * 122_000.0 / count.max(1) as f64).sqrt();
    let mut gaussians = Gaussians::empty(3);
    for i in 0..count as u64 {
        let z = |k: u64| stream.normal(i * 128 + k);
        let uniform = |k: u64| stream.uniform(i * 256 + 128 + k);
        let (u, v) = ((uniform(0) * 1.1 - 0.55) * w, (uniform(1) * 1.1 - 0.55) * h);
        let ground = 1.0 + 0.15 * math::sin(7.0 * u / w) + 0.1 * math::cos(9.0 * v / h) - 0.6 * v / h;
        let depth = ground * (1.0 + 0.05 * z(0)).max(0.3);
        gaussians.means.push([(u * depth / focal) as f32, (v * depth / focal) as f32, depth as f32]);
        let size = math::ln(pixels * depth / focal) + 0.5 * z(1);
        let long = 0.9 + 0.9 * z(2);
        gaussians.log_scales.push([size + long, size, size - 0.8].map(|v| v as f32));
        gaussians.quaternions.push(std::array::from_fn(|k| z(5 + k as u64) as f32));
        gaussians.opacity_logits.push((3.6 + 2.2 * z(9)) as f32);
        gaussians.sh.push(std::array::from_fn(|k| {
            let spread = if k == 0 { 0.6 } else { 0.05 };
            std::array::from_fn(|c| (spread * z(10 + (3 * k + c) as u64)) as f32)
        }));
    }
    let ReconstructParams { medium, anchors, top_k, .. } = ReconstructParams::default();
    let start = MediumStart { anchors, top_k, seed: 5, views: vec![camera.pose] };
    let medium = MediumModel::start(medium, &start)?;
    let scene = Scene { gaussians, frame: Frame::IDENTITY, medium, medium_degree: 3, enhancement: None };
    let (lattice, mut maps) = (Lattice::full(&intrinsics), MediumMaps::zeros(0, 0));
    scene.look_through(&camera, &lattice, &mut maps);
    let (mut compositor, mut out) = (Compositor::default(), Rendered::new());
    compositor.prepare(&scene, &camera, &lattice, |_| {});
    compositor.draw(Some(&maps), &Options::default(), &mut out);
    // Noise, so that the losses have something to do.
    let noise = |i: usize| 6.0 * (stream.uniform(i as u64) as f32 - 0.5);
    let bytes = out.image.data().iter().enumerate();
    let bytes = bytes.map(|(i, v)| (255.0 * v + noise(i)).clamp(0.0, 255.0) as u8).collect();
    let pixels = Raster::from_planes(width, height, bytes).ok_or("a photograph of the made scene")?;
    let view = View {
        name: FileName::new("made.png")?,
        id: 1,
        image: Default::default(),
        mask: None,
        depth_prior: None,
        camera,
    };
    Ok((scene, view, LoadedView { pixels: Pixels::Eight(pixels), mask: None, depth_prior: None }))
}
