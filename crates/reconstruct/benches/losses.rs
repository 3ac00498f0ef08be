//! Measures the fused photometric loss and the depth term at the sizes of a training step.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use use3d_capture::{Image, Map};
use use3d_numerics::math;
use use3d_reconstruct::losses::{DepthPriorLoss, PhotometricLoss};

fn losses(c: &mut Criterion) {
    for (w, h) in [(640usize, 360usize), (1280, 720), (1400, 933)] {
        let values = |phase: f32| {
            let value = |i: usize| 0.4 + 0.3 * math::sin((i % 977) as f32 * 0.031 + phase);
            Image::from_planes(w, h, (0..3 * w * h).map(value).collect()).expect("the planes have that size")
        };
        let (prediction, target) = (values(0.0), values(0.1));
        let mut gradient = Image::new(w, h);
        let mut loss = PhotometricLoss::new(0.2);
        c.bench_function(&format!("photometric {w}x{h}"), |b| {
            b.iter(|| black_box(loss.evaluate(&prediction, &target, None, &mut gradient)));
        });
        let map = |phase: f32| {
            let value = |i: usize| 1.5 + math::cos((i % 811) as f32 * 0.017 + phase);
            Map::from_planes(w, h, (0..w * h).map(value).collect()).expect("the plane has that size")
        };
        let (depth, prior) = (map(0.0), map(0.4));
        let mut gradient = Map::new(w, h);
        c.bench_function(&format!("depth {w}x{h}"), |b| {
            b.iter(|| black_box(DepthPriorLoss.evaluate(&depth, &prior, 0.1, &mut gradient)));
        });
    }
}

criterion_group!(benches, losses);
criterion_main!(benches);
