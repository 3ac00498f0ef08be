//! Measures the time of the field at a million Gaussians, and of the water at a stage-2 lattice.

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use use3d_capture::MediumMaps;
use use3d_numerics::random::{Purpose, Stream};
use use3d_ubaf::water::ViewWater;
use use3d_ubaf::{Field, FieldBox, Gradient, ObjectPass, Shape, WaterPass};

fn field() -> Field {
    let draw = Stream::new(1, Purpose::new("bench"), 0);
    let mut field = Field::identity(Shape::default(), FieldBox::UNIT, 1).expect("the default shape is valid");
    for (i, p) in field.parameters.iter_mut().enumerate() {
        *p += 0.1 * draw.normal(i as u64) as f32;
    }
    field
}

fn rows(n: usize, purpose: &'static str) -> Vec<[f32; 3]> {
    let draw = Stream::new(2, Purpose::new(purpose), 0);
    (0..n).map(|i| std::array::from_fn(|k| 2.0 * draw.uniform((3 * i + k) as u64) as f32 - 1.0)).collect()
}

fn objects(c: &mut Criterion) {
    let n = 1_000_000;
    let field = field();
    let (means, dc, base, d) = (rows(n, "means"), rows(n, "dc"), rows(n, "base"), rows(n, "d"));
    let mut pass = ObjectPass::new(&field, &means, dc.iter().copied());
    let mut gradient = Gradient::new(field.shape());
    let mut colors = Vec::new();
    let mut group = c.benchmark_group("1M Gaussians");
    group.sample_size(10);
    group.bench_function("forward", |b| {
        b.iter(|| {
            pass.forward(&field);
            pass.colors(&field, &base, &mut colors);
            black_box(colors[0])
        });
    });
    group.bench_function("forward and backward", |b| {
        b.iter(|| {
            pass.forward(&field);
            pass.colors(&field, &base, &mut colors);
            gradient.clear();
            pass.backward(&field, &base, &d, &mut gradient);
            black_box(gradient.values[0])
        });
    });
    group.finish();
}

fn water(c: &mut Criterion) {
    let field = field();
    let mut maps = MediumMaps::zeros(768, 512);
    let draw = Stream::new(3, Purpose::new("maps"), 0);
    for (i, v) in maps.color.data_mut().iter_mut().enumerate() {
        *v = draw.uniform(i as u64) as f32;
    }
    let water = ViewWater::new(maps.clone());
    let mut pass = WaterPass::default();
    let mut out = MediumMaps::zeros(0, 0);
    let mut gradient = Gradient::new(field.shape());
    c.bench_function("water 768x512, forward and backward", |b| {
        b.iter(|| {
            pass.forward(&field, [0.1, 0.2, 0.3], &water, 1.0, &mut out);
            pass.backward(&field, [0.1, 0.2, 0.3], &water, &maps, &mut gradient);
            black_box(gradient.values[0])
        });
    });
}

criterion_group!(benches, objects, water);
criterion_main!(benches);
