//! Measures the extractor as stage 2 calls it: value and gradient for one 1400 × 933 view, on the lattice
//! that the resize reads.

use std::hint::black_box;
use std::sync::Arc;

use criterion::{Criterion, criterion_group, criterion_main};
use use3d_atc::extractor::{ExtractorSettings, Geometry, SourceImage, Workspace};
use use3d_capture::Image;
use use3d_numerics::math;

fn image(width: usize, height: usize, phase: f32) -> Image {
    let data = (0..3 * width * height).map(|i| 0.5 + 0.4 * math::sin(i as f32 * 0.013 + phase)).collect();
    Image::from_planes(width, height, data).expect("three planes")
}

fn extractor(criterion: &mut Criterion) {
    let geometry = Arc::new(Geometry::new(1400, 933, &ExtractorSettings::default()).expect("good settings"));
    let (w, h) = (geometry.columns.len(), geometry.rows.len());
    let source = SourceImage::on_lattice(&geometry, &image(w, h, 0.0)).expect("finite");
    let target = image(w, h, 0.4);
    let mut workspace = Workspace::default();
    let mut gradient = Image::new(0, 0);
    criterion.bench_function("forward, 1400x933 lattice", |b| {
        b.iter(|| source.forward_on_lattice(black_box(&target), &mut workspace).expect("same size").global);
    });
    let local = vec![[0.1; 6]; workspace.transition.local.len()];
    criterion.bench_function("forward and backward, 1400x933 lattice", |b| {
        b.iter(|| {
            source.forward_on_lattice(black_box(&target), &mut workspace).expect("same size");
            source.backward_on_lattice(&[0.1; 12], &local, &mut workspace, &mut gradient).expect("same grid");
        });
    });
    criterion.bench_function("source, 1400x933 lattice", |b| {
        b.iter(|| SourceImage::on_lattice(&geometry, black_box(&target)).expect("finite"));
    });
}

criterion_group!(benches, extractor);
criterion_main!(benches);
