//! Compares the time of a step of stage 2 with that of the rasterisation of a step of stage 1 (a lower
//! bound of that step, which also has losses, density control and an optimiser).

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use glam::DVec3;
use use3d_atc::consensus::{LocalConsensus, Targets};
use use3d_atc::extractor::ExtractorSettings;
use use3d_atc::proposers::ProposerId;
use use3d_capture::{Appearance, Camera, Frame, Image, Intrinsics, KeptWater, Lattice, MediumMaps, Pose};
use use3d_enhance::engine::CpuFieldEngine;
use use3d_enhance::{EnhanceParams, EnhanceView, Guidance};
use use3d_medium::{MediumModel, MediumRbf};
use use3d_numerics::random::{Purpose, Stream};
use use3d_scene::Scene;
use use3d_splat::{
    Colors, GaussianGradients, Gaussians, Gradients, Options, Prepared, Rasterizer, RenderGradients,
    Rendered, ViewOf,
};
use use3d_training::Silent;

const GAUSSIANS: usize = 100_000;

fn scene() -> Scene {
    let draw = Stream::new(1, Purpose::new("stage 2 bench"), 0);
    let u = |i: usize, k: usize| draw.uniform((i * 80 + k) as u64) as f32;
    let n = GAUSSIANS;
    let gaussians = Gaussians {
        sh_degree: 3,
        means: (0..n).map(|i| [2.0 * u(i, 0) - 1.0, 1.4 * u(i, 1) - 0.7, 0.6 * u(i, 2)]).collect(),
        log_scales: (0..n).map(|i| std::array::from_fn(|k| -5.2 + u(i, 3 + k))).collect(),
        quaternions: (0..n).map(|i| [1.0, u(i, 6), u(i, 7), u(i, 8)]).collect(),
        opacity_logits: (0..n).map(|i| 4.0 * u(i, 9) - 1.0).collect(),
        sh: (0..n)
            .map(|i| std::array::from_fn(|k| std::array::from_fn(|c| 0.3 * (u(i, 10 + 3 * k + c) - 0.5))))
            .collect(),
    };
    Scene {
        gaussians,
        frame: Frame::IDENTITY,
        medium: MediumModel::Rbf(MediumRbf::new(8, 4)),
        medium_degree: 3,
        enhancement: None,
    }
}

fn steps(c: &mut Criterion) {
    let scene = scene();
    let n = scene.gaussians.len();
    let targets = Targets {
        extractor: ExtractorSettings::default(),
        proposer: ProposerId::default(),
        appearance: Appearance::Water,
        kept_water: KeptWater::ALL,
        scene: [0.2, 0.0, 0.0, 0.02, 0.0, 0.1, 0.0, 0.0, 0.0, 0.0, -0.1, 0.0],
        dispersion: 0.0,
        global_scales: [0.2; 12],
        local_scales: [0.1; 6],
        views: Vec::new(),
        state: LocalConsensus {
            mean: scene
                .gaussians
                .means
                .iter()
                .map(|m| [0.1 * m[0], 0.0, 0.0, 0.0, 0.0, 0.02 * m[1]])
                .collect(),
            weight: vec![1.0; n],
            count: vec![3; n],
        },
    };
    for (width, height) in [(480, 320), (1400, 933)] {
        let f = 0.8 * width as f64;
        let intrinsics =
            Intrinsics { width, height, fx: f, fy: f, cx: width as f64 / 2.0, cy: height as f64 / 2.0 };
        let pose = Pose::look_at(DVec3::new(0.0, 0.0, -1.3), DVec3::new(0.0, 0.0, 0.3), -DVec3::Y);
        let camera = Camera { intrinsics, pose };
        let mut group = c.benchmark_group(format!("{width}x{height}, 100k Gaussians"));
        group.sample_size(10);

        let lattice = Lattice::full(&intrinsics);
        let mut maps = MediumMaps::zeros(0, 0);
        scene.medium.maps(&camera, &lattice, 3, &mut maps);
        let (mut prepared, mut rasterizer, mut out) = (Prepared::new(), Rasterizer::new(), Rendered::new());
        let mut gradients = GaussianGradients::new(n);
        let mut medium_gradients = MediumMaps::zeros(width, height);
        let image = Image::filled(width, height, 1e-6);
        let d_rendered = RenderGradients { image: &image, depth: None, accumulation: None, clear: None };
        group.bench_function("stage 1 rasterisation", |b| {
            b.iter(|| {
                prepared.prepare(&scene.gaussians, &camera, &lattice, Colors::Sh { degree: 3 });
                rasterizer.forward(&prepared, Some(&maps), &Options::default(), &mut out);
                rasterizer.backward(
                    &prepared,
                    ViewOf { gaussians: &scene.gaussians, camera: &camera },
                    Some(&maps),
                    &Options::default(),
                    &d_rendered,
                    Gradients { gaussians: &mut gradients, medium: Some(&mut medium_gradients) },
                );
                black_box(gradients.means[0])
            });
        });

        let view = EnhanceView { name: "bench".into(), camera };
        let params = EnhanceParams::default();
        let guidance = Guidance::Targets(&targets);
        let mut engine =
            CpuFieldEngine::new(&scene, &[view], guidance, &params, &mut Silent).expect("a valid scene");
        group.bench_function("stage 2 step", |b| {
            b.iter(|| black_box(engine.differentiate(0).expect("a finite step").total));
        });
        group.finish();
    }
}

criterion_group!(benches, steps);
criterion_main!(benches);
