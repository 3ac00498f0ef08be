//! Measures the speed of rendering and of its gradient, and prints a table: `cargo bench -p use3d-splat`.
//!
//! * The machine's limit: fused multiply-adds per second, and the dense micro-kernel, a tile-sized set of
//!   Gaussians in which every tested pair contributes, all in the first-level cache.
//! * 1400×933 pixels with 50 k, 200 k and 1 M Gaussians that have a trained scene's distribution of sizes.
//! * The bar: the reef capture at 1280×720 with its sparse points as initialised Gaussians (found through
//!   `USE3D_DATA`), or a synthetic scene of the same statistics.
//!
//! With the argument `bar` only the bar is measured. Every time is the best of several runs.

use std::time::Instant;

use fearless_simd::{Level, Simd, SimdBase, SimdFloat, dispatch, f32x16};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use use3d_capture::{Camera, Image, Intrinsics, Lattice, MediumMaps, Pose, world_direction};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{
    Colors, GaussianGradients, Gaussians, Gradients, Options, Prepared, Rasterizer, RenderGradients,
    Rendered, ViewOf,
};

fn main() {
    let only_bar = std::env::args().any(|a| a == "bar");
    let level = format!("{:?}", Level::new());
    let level = level.split('(').next().unwrap_or_default().to_string();
    println!(
        "instruction set {level}, {} cores",
        std::thread::available_parallelism().map_or(1, usize::from)
    );
    let limit = Limit::measure();
    println!(
        "limit, one thread: {:.0} GFLOP/s fused multiply-add; dense micro-kernel, ns per pair: \
         under water {:.3} forward, {:.3} forward+backward; without water {:.3}, {:.3}",
        limit.gflops, limit.water[0], limit.water[1], limit.plain[0], limit.plain[1]
    );
    println!(
        "(the same with a medium as rough as noise: {:.3} forward, {:.3} forward+backward)\n",
        limit.rough[0], limit.rough[1]
    );
    let (name, gaussians, cameras) = bar_scene();
    table_head();
    Case { name, gaussians, cameras, repeats: 7 }.run(&limit);
    if only_bar {
        return;
    }
    for (count, pixels) in [(50_000, 7.0), (200_000, 4.0), (1_000_000, 2.0)] {
        let (gaussians, camera) = trained_scene(count, pixels, 1400, 933);
        let name = format!("trained-like, {} k", count / 1000);
        Case { name, gaussians, cameras: vec![camera], repeats: 5 }.run(&limit);
    }
}

fn table_head() {
    println!(
        "| scene | mode | threads | prepare ms | forward ms | fwd+bwd ms | raster Gpair/s | share of limit | contributing/px | tested/contributing | entries | scratch MiB | bytes/Gaussian |"
    );
    println!("|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|");
}

struct Case {
    name: String,
    gaussians: Gaussians,
    cameras: Vec<Camera>,
    repeats: usize,
}

/// Milliseconds that the parts of one frame take.
#[derive(Clone, Copy, Default)]
struct Times {
    prepare: f64,
    forward: f64,
    backward: f64,
}

impl Case {
    fn run(&self, limit: &Limit) {
        let pairs: Vec<_> = self
            .cameras
            .iter()
            .map(|camera| {
                let mut view = Prepared::new();
                view.prepare(
                    &self.gaussians,
                    camera,
                    &Lattice::full(&camera.intrinsics),
                    Colors::Sh { degree: 3 },
                );
                view.pairs()
            })
            .collect();
        let pixels: f64 =
            self.cameras.iter().map(|c| (c.intrinsics.width * c.intrinsics.height) as f64).sum();
        let contributing = pairs.iter().map(|p| p.contributing).sum::<u64>() as f64;
        let tested = pairs.iter().map(|p| p.tested).sum::<u64>() as f64;
        let entries = pairs.iter().map(|p| p.entries).sum::<u64>() / pairs.len() as u64;
        for (mode, water, dense) in [("water", true, limit.water[1]), ("vanilla", false, limit.plain[1])] {
            for threads in [1, 2] {
                let pool =
                    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
                let (times, memory) = pool.install(|| self.time(water));
                let raster = (times.forward + times.backward) * 1e-3 * self.cameras.len() as f64;
                let n = self.gaussians.len();
                println!(
                    "| {} | {mode} | {threads} | {:.1} | {:.1} | {:.1} | {:.2} | {:.0} % | {:.1} | {:.2} | {entries} | {:.0} | {:.0} |",
                    self.name,
                    times.prepare,
                    times.prepare + times.forward,
                    times.prepare + times.forward + times.backward,
                    contributing / raster * 1e-9,
                    100.0 * contributing * dense * 1e-9 / threads as f64 / raster,
                    contributing / pixels,
                    tested / contributing,
                    memory as f64 / f64::from(1 << 20),
                    memory as f64 / n as f64,
                );
            }
        }
    }

    /// Returns the best times of the repeats, averaged over the cameras, and the bytes of memory held.
    fn time(&self, water: bool) -> (Times, usize) {
        let mut rasterizer = Rasterizer::new();
        let (mut view, mut out) = (Prepared::new(), Rendered::new());
        let (mut grads, mut maps) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
        let mut mean = Times::default();
        for camera in &self.cameras {
            let lattice = Lattice::full(&camera.intrinsics);
            let medium = smooth_medium(camera);
            let medium = water.then_some(&medium);
            let image = random_derivative(&camera.intrinsics);
            let d_rendered = RenderGradients { image: &image, depth: None, accumulation: None, clear: None };
            let mut runs = Vec::new();
            for repeat in 0..=self.repeats {
                let start = Instant::now();
                view.prepare(&self.gaussians, camera, &lattice, Colors::Sh { degree: 3 });
                let prepared = Instant::now();
                rasterizer.forward(&view, medium, &Options::default(), &mut out);
                let forward = Instant::now();
                let medium_grads = water.then_some(&mut maps);
                rasterizer.backward(
                    &view,
                    ViewOf { gaussians: &self.gaussians, camera },
                    medium,
                    &Options::default(),
                    &d_rendered,
                    Gradients { gaussians: &mut grads, medium: medium_grads },
                );
                let ms = |a: Instant, b: Instant| (b - a).as_secs_f64() * 1e3;
                // The first run allocates memory and is not counted.
                if repeat > 0 {
                    runs.push([ms(start, prepared), ms(prepared, forward), ms(forward, Instant::now())]);
                }
            }
            let n = self.cameras.len() as f64;
            mean.prepare += best(&runs, 0) / n;
            mean.forward += best(&runs, 1) / n;
            mean.backward += best(&runs, 2) / n;
        }
        (mean, view.memory() + rasterizer.memory())
    }
}

/// The time of the fastest run, because other work on the machine only ever adds time.
fn best(runs: &[[f64; 3]], part: usize) -> f64 {
    runs.iter().map(|r| r[part]).fold(f64::INFINITY, f64::min)
}

/// The most that this machine can do in one thread.
struct Limit {
    gflops: f64,
    /// Nanoseconds per pair of the dense micro-kernel: forward, forward + backward.
    water: [f64; 2],
    rough: [f64; 2],
    plain: [f64; 2],
}

impl Limit {
    fn measure() -> Self {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread pool");
        pool.install(|| {
            let gflops = (0..5).map(|_| multiply_adds()).fold(0.0, f64::max);
            Self { gflops, water: dense(Some(true)), rough: dense(Some(false)), plain: dense(None) }
        })
    }
}

/// GFLOP/s of independent fused multiply-adds in registers.
fn multiply_adds() -> f64 {
    #[inline(always)]
    fn run<S: Simd>(simd: S, rounds: usize) -> f32 {
        let (a, b) = (f32x16::splat(simd, 0.999_999), f32x16::splat(simd, 1e-7));
        let mut x: [f32x16<S>; 10] = std::array::from_fn(|i| f32x16::splat(simd, i as f32));
        for _ in 0..rounds {
            for x in &mut x {
                *x = x.mul_add(a, b);
            }
        }
        x.iter().map(|x| x.to_array().iter().sum::<f32>()).sum()
    }
    let rounds = 2_000_000;
    let start = Instant::now();
    let sum = dispatch!(Level::new(), simd => run(simd, std::hint::black_box(rounds)));
    std::hint::black_box(sum);
    rounds as f64 * 10.0 * 32.0 / start.elapsed().as_secs_f64() * 1e-9
}

/// Nanoseconds per pair where every pair contributes: 128 Gaussians that cover 128×128 pixels.
fn dense(medium: Option<bool>) -> [f64; 2] {
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
    let smooth = smooth_medium(&camera);
    let mut maps = smooth.clone();
    let s = Stream::new(1, Purpose::new("rough medium"), 0);
    for (i, v) in maps.backscatter.data_mut().iter_mut().enumerate() {
        *v *= 0.5 + s.uniform(i as u64) as f32;
    }
    let medium = medium.map(|is_smooth| if is_smooth { &smooth } else { &maps });
    let mut view = Prepared::new();
    view.prepare(&gaussians, &camera, &Lattice::full(&camera.intrinsics), Colors::Sh { degree: 0 });
    let pairs = view.pairs();
    assert!(pairs.contributing as f64 > 0.99 * (side * side * count) as f64, "not dense: {pairs:?}");
    let (mut rasterizer, mut out) = (Rasterizer::new(), Rendered::new());
    let (mut grads, mut medium_grads) = (GaussianGradients::default(), MediumMaps::zeros(0, 0));
    let image = random_derivative(&camera.intrinsics);
    let d_rendered = RenderGradients { image: &image, depth: None, accumulation: None, clear: None };
    let mut runs = Vec::new();
    for _ in 0..25 {
        let start = Instant::now();
        rasterizer.forward(&view, medium, &Options::default(), &mut out);
        let forward = start.elapsed().as_secs_f64();
        let medium_grads = medium.is_some().then_some(&mut medium_grads);
        let options = Options::default();
        rasterizer.backward(
            &view,
            ViewOf { gaussians: &gaussians, camera: &camera },
            medium,
            &options,
            &d_rendered,
            Gradients { gaussians: &mut grads, medium: medium_grads },
        );
        runs.push([forward, start.elapsed().as_secs_f64(), 0.0]);
    }
    [0, 1].map(|part| best(&runs, part) * 1e9 / pairs.contributing as f64)
}

fn random_derivative(k: &Intrinsics) -> Image {
    let data = (0..3 * k.width * k.height).map(|i| math::sin((i % 977) as f32 * 0.013)).collect();
    Image::from_planes(k.width, k.height, data).expect("three planes")
}

/// Water as a medium model produces it: degree-2 functions of the ray's world direction.
fn smooth_medium(camera: &Camera) -> MediumMaps {
    let k = &camera.intrinsics;
    let mut maps = MediumMaps::zeros(k.width, k.height);
    for y in 0..k.height {
        for x in 0..k.width {
            let [u, v, w] = world_direction(camera, x as f64 + 0.5, y as f64 + 0.5);
            let f = |base: f32, c: usize| base * (1.0 + 0.2 * u + 0.3 * v * w + 0.1 * (c as f32) * u * u);
            maps.color.set_pixel(x, y, std::array::from_fn(|c| f(0.2 + 0.15 * c as f32, c)));
            maps.backscatter.set_pixel(x, y, std::array::from_fn(|c| f(0.20 - 0.03 * c as f32, c)));
            maps.attenuation.set_pixel(x, y, std::array::from_fn(|c| f(0.25 - 0.07 * c as f32, c)));
        }
    }
    maps
}

/// Gaussians on a bumpy surface seen from above, of log-normal size with the given median standard deviation
/// in pixels, anisotropic, of mixed opacity.
fn trained_scene(count: usize, pixels: f64, width: usize, height: usize) -> (Gaussians, Camera) {
    let s = Stream::new(5, Purpose::new("bench scene"), 0);
    let focal = 0.9 * width as f64;
    let camera = Camera {
        intrinsics: Intrinsics {
            width,
            height,
            fx: focal,
            fy: focal,
            cx: width as f64 / 2.0,
            cy: height as f64 / 2.0,
        },
        pose: Pose::IDENTITY,
    };
    let mut out = Gaussians::empty(3);
    for i in 0..count as u64 {
        let z = |k: u64| s.normal(i * 128 + k);
        let uniform = |k: u64| s.uniform(i * 256 + 128 + k);
        let (u, v) =
            ((uniform(0) * 1.15 - 0.575) * width as f64, (uniform(1) * 1.15 - 0.575) * height as f64);
        let surface =
            3.0 + 1.2 * math::sin(u * 0.004) + 0.9 * math::cos(v * 0.006) + 3.0 * (v / height as f64 + 0.5);
        let depth = (surface * (1.0 + 0.08 * z(0))).max(0.5);
        out.means.push([(u * depth / focal) as f32, (v * depth / focal) as f32, depth as f32]);
        let size = math::ln(pixels * depth / focal) + 0.7 * z(1);
        out.log_scales.push(std::array::from_fn(|k| (size + 0.6 * z(2 + k as u64)) as f32));
        out.quaternions.push(std::array::from_fn(|k| z(5 + k as u64) as f32));
        out.opacity_logits.push((-0.3 + 1.8 * z(9)) as f32);
        out.sh.push(std::array::from_fn(|k| {
            std::array::from_fn(|c| (if k == 0 { 0.8 } else { 0.1 } * z(10 + (3 * k + c) as u64)) as f32)
        }));
    }
    (out, camera)
}

/// Turns sparse points into initialised Gaussians: isotropic, with the mean distance to the three nearest
/// neighbours as scale and opacity 0.1.
fn initialised(points: &[(DVec3, [u8; 3])]) -> Gaussians {
    let scales: Vec<f64> = points
        .par_iter()
        .map(|(p, _)| {
            let mut nearest = [f64::INFINITY; 4];
            for (q, _) in points {
                let d = p.distance_squared(*q);
                if d < nearest[3] {
                    nearest[3] = d;
                    nearest.sort_by(f64::total_cmp);
                }
            }
            nearest[1..].iter().map(|d| d.sqrt()).sum::<f64>() / 3.0
        })
        .collect();
    let mut out = Gaussians::empty(3);
    for ((p, color), scale) in points.iter().zip(scales) {
        out.means.push(p.as_vec3().to_array());
        out.log_scales.push([math::ln(scale.max(1e-7)) as f32; 3]);
        out.quaternions.push([1.0, 0.0, 0.0, 0.0]);
        out.opacity_logits.push(math::ln(0.1f32 / 0.9));
        let mut sh = [[0.0; 3]; 16];
        sh[0] = color.map(|v| (f32::from(v) / 255.0 - 0.5) / 0.282_094_8);
        out.sh.push(sh);
    }
    out
}

fn bar_scene() -> (String, Gaussians, Vec<Camera>) {
    if let Some(data) = std::env::var_os("USE3D_DATA") {
        let dir = std::path::Path::new(&data).join("reef_deepreefmap");
        match use3d_import::import(&dir, &use3d_import::ImportParams::default()) {
            Ok(imported) => {
                let capture = imported.capture;
                let points: Vec<_> = capture.points.iter().map(|p| (p.position, p.color)).collect();
                let cameras = [4, 20, 36].map(|i| capture.views[i.min(capture.views.len() - 1)].camera);
                return ("reef 1280x720".into(), initialised(&points), cameras.to_vec());
            }
            Err(error) => println!(
                "the reef capture cannot be read ({error}); a synthetic scene of its statistics instead"
            ),
        }
    } else {
        println!("USE3D_DATA is not set; a synthetic scene of the reef's statistics instead");
    }
    let s = Stream::new(9, Purpose::new("reef-like points"), 0);
    let points: Vec<(DVec3, [u8; 3])> = (0..20_091u64)
        .map(|i| {
            // A rough ground that rises towards the horizon, with points off the ground such as
            // triangulation leaves.
            let (u, v) = ((s.uniform(i * 16 + 4) - 0.5) * 1.9, (s.uniform(i * 16 + 5) - 0.3) * 0.9);
            let ground = 1.6 / (0.35 + v) * (1.0 + 0.15 * math::sin(9.0 * u) * math::cos(7.0 * v));
            let depth = ground.min(8.0) * math::exp(0.02 * s.normal(i * 8));
            (DVec3::new(u * depth, v * depth, depth), [90, 120, 130])
        })
        .collect();
    let camera = Camera {
        intrinsics: Intrinsics { width: 1280, height: 720, fx: 829.0, fy: 829.0, cx: 640.0, cy: 360.0 },
        pose: Pose { rotation: DMat3::IDENTITY, translation: DVec3::ZERO },
    };
    ("reef-like 1280x720".into(), initialised(&points), vec![camera])
}
