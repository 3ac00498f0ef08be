//! Measures the time of each medium for a view of 640×360 pixels: a forward and a backward pass, as in a
//! training step.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use use3d_capture::{Camera, Intrinsics, Lattice, MediumMaps, Pose};
use use3d_medium::{MediumGlobal, MediumMlp, MediumModel, MediumRbf};

fn media(c: &mut Criterion) {
    let intrinsics = Intrinsics { width: 640, height: 360, fx: 500.0, fy: 500.0, cx: 320.0, cy: 180.0 };
    let camera = Camera { intrinsics, pose: Pose::IDENTITY };
    let lattice = Lattice::full(&intrinsics);
    let mut group = c.benchmark_group("640x360, forward and backward");
    group.sample_size(10);
    for model in [
        MediumModel::Rbf(MediumRbf::new(8, 4)),
        MediumModel::Global(MediumGlobal::default()),
        MediumModel::Mlp(MediumMlp::new(1)),
    ] {
        let mut maps = MediumMaps::zeros(640, 360);
        let mut gradient = model.zeros_like();
        group.bench_function(model.kind().name(), |b| {
            b.iter(|| {
                model.maps(&camera, &lattice, 3, &mut maps);
                gradient.clear();
                model.backward(&camera, &lattice, 3, &maps, &maps, &mut gradient);
                black_box(&gradient);
            });
        });
    }
    group.finish();
}

criterion_group!(benches, media);
criterion_main!(benches);
