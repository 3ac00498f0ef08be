//! Helpers that several tests share: engines, scenes, cases.

use glam::DVec3;
use use3d_capture::{Camera, DepthNetwork, Formation, Image, Intrinsics, Lattice, Map, MediumMaps, Pose};
use use3d_golden::{Case, CaseGaussians};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{Colors, Gaussians, Prepared, Rasterizer};

/// Every engine that this machine can run, with its name; the scalar twin comes first.
pub(crate) fn engines() -> Vec<(&'static str, Rasterizer)> {
    let mut engines = vec![
        ("plain", Rasterizer::plain()),
        ("baseline", Rasterizer::with_level(fearless_simd::Level::baseline())),
        ("best", Rasterizer::new()),
    ];
    #[cfg(target_arch = "x86_64")]
    {
        use fearless_simd::Level;
        if let Some(token) = Level::new().as_avx2() {
            engines.push(("avx2", Rasterizer::with_level(Level::Avx2(token))));
        }
        if let Some(token) = Level::new().as_avx512() {
            engines.push(("avx512", Rasterizer::with_level(Level::Avx512(token))));
        }
    }
    engines
}

/// The engines whose multiply-add is fused, which must agree bit for bit.
pub(crate) fn fused_engines() -> Vec<(&'static str, Rasterizer)> {
    engines().into_iter().filter(|(name, _)| matches!(*name, "plain" | "avx2" | "avx512")).collect()
}

/// The Gaussians of a golden case; without colours if the case has none.
pub(crate) fn gaussians_of(case: &Case<'_>) -> Gaussians {
    let CaseGaussians { means, log_scales, quaternions, opacity_logits, sh } = case.gaussians();
    Gaussians { sh_degree: 3, means, log_scales, quaternions, opacity_logits, sh }
}

/// An `[H, W, 3]` tensor.
pub(crate) fn image_of(case: &Case<'_>, tensor: &str) -> Image {
    let (w, h, planes) = case.planes(tensor);
    Image::from_planes(w, h, planes).expect("three channels")
}

/// An `[H, W, 1]` or `[H, W]` tensor.
pub(crate) fn map_of(case: &Case<'_>, tensor: &str) -> Map {
    let (w, h, planes) = case.planes(tensor);
    Map::from_planes(w, h, planes).expect("one channel")
}

/// The medium of a golden case.
pub(crate) fn medium_of(case: &Case<'_>) -> MediumMaps {
    MediumMaps {
        color: image_of(case, "in.c_m"),
        backscatter: image_of(case, "in.beta_bs"),
        attenuation: image_of(case, "in.beta_attn"),
        formation: Formation::default(),
        network: None,
    }
}

/// Every pixel of a camera.
pub(crate) fn lattice(camera: &Camera) -> Lattice {
    Lattice::full(&camera.intrinsics)
}

/// A camera for random scenes: it looks at the origin from four units away, slightly turned.
pub(crate) fn random_camera(width: usize, height: usize) -> Camera {
    let focal = 1.1 * width.max(height) as f64;
    Camera {
        intrinsics: Intrinsics {
            width,
            height,
            fx: focal,
            fy: 1.05 * focal,
            cx: 0.53 * width as f64,
            cy: 0.48 * height as f64,
        },
        pose: Pose::look_at(
            DVec3::new(0.5, -0.3, -4.0),
            DVec3::new(0.05, 0.0, 0.0),
            DVec3::new(0.1, -1.0, 0.0),
        ),
    }
}

/// `n` random Gaussians around the origin; `size` is the natural logarithm of
/// their typical standard deviation.
pub(crate) fn random_gaussians(n: usize, size: f64, seed: u64) -> Gaussians {
    let s = Stream::new(seed, Purpose::new("random Gaussians"), 0);
    let z = |i: usize, k: u64| s.normal(i as u64 * 128 + k);
    let mut out = Gaussians::empty(3);
    for i in 0..n {
        out.means.push(std::array::from_fn(|k| (0.8 * z(i, k as u64)) as f32));
        out.log_scales.push(std::array::from_fn(|k| (size + 0.6 * z(i, 3 + k as u64)) as f32));
        out.quaternions.push(std::array::from_fn(|k| z(i, 6 + k as u64) as f32));
        out.opacity_logits.push((-0.5 + 1.2 * z(i, 10)) as f32);
        out.sh.push(std::array::from_fn(|k| {
            let scale = if k == 0 { 0.8 } else { 0.15 };
            std::array::from_fn(|c| (scale * z(i, 11 + (3 * k + c) as u64)) as f32)
        }));
    }
    out
}

/// Water that varies smoothly over the image, as a medium model's does, or from pixel to pixel.
pub(crate) fn random_medium(width: usize, height: usize, smooth: bool, seed: u64) -> MediumMaps {
    let s = Stream::new(seed, Purpose::new("random medium"), 0);
    let mut out = MediumMaps::zeros(width, height);
    for (q, (image, base)) in
        [(&mut out.color, 0.4), (&mut out.backscatter, 0.25), (&mut out.attenuation, 0.35)]
            .into_iter()
            .enumerate()
    {
        for y in 0..height {
            for x in 0..width {
                let (u, v) = (x as f64 / width as f64 - 0.5, y as f64 / height as f64 - 0.5);
                image.set_pixel(
                    x,
                    y,
                    std::array::from_fn(|c| {
                        let k = (q * 3 + c) as u64;
                        let noise = match smooth {
                            true => 0.3 * math::tanh(s.normal(2 * k) * u + s.normal(2 * k + 1) * v),
                            false => 0.8 * (s.uniform((k << 32) + (y * width + x) as u64) - 0.5),
                        };
                        (base * (1.0 + noise)) as f32
                    }),
                );
            }
        }
    }
    out
}

/// An image of standard normal values.
pub(crate) fn random_image(width: usize, height: usize, seed: u64) -> Image {
    let s = Stream::new(seed, Purpose::new("random image"), 0);
    let data = (0..3 * width * height).map(|i| s.normal(i as u64) as f32).collect();
    Image::from_planes(width, height, data).expect("three planes")
}

/// A map of standard normal values.
pub(crate) fn random_map(width: usize, height: usize, seed: u64) -> Map {
    let s = Stream::new(seed, Purpose::new("random map"), 0);
    let data = (0..width * height).map(|i| s.normal(i as u64) as f32).collect();
    Map::from_planes(width, height, data).expect("one plane")
}

/// `gaussians` prepared for `camera`.
pub(crate) fn prepared(gaussians: &Gaussians, camera: &Camera) -> Prepared {
    let mut out = Prepared::new();
    out.prepare(gaussians, camera, &lattice(camera), Colors::Sh { degree: 3 });
    out
}

/// Water of a depth network with random numbers.
pub(crate) fn random_depth_network(width: usize, height: usize, seed: u64) -> MediumMaps {
    let s = Stream::new(seed, Purpose::new("random depth network"), 0);
    let mut network = DepthNetwork { share: [0.9, 1.0, 0.8], ..DepthNetwork::default() };
    for (i, value) in network.values_mut().enumerate() {
        *value = if i < 9 { 0.2 + 0.6 * s.uniform(i as u64) as f32 } else { 0.5 * s.normal(i as u64) as f32 };
    }
    let network = Some(Box::new(network));
    MediumMaps { formation: Formation::DepthNetwork, network, ..random_medium(width, height, true, seed) }
}
