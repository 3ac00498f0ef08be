//! Compares kernels with their twins, gradients with differences of the f64 twin, and bits across threads
//! and instruction sets.

use fearless_simd::Level;
use proptest::prelude::*;
use use3d_capture::{Image, MediumMaps};
use use3d_numerics::random::{Purpose, Stream};

use crate::guide::{gamma_scalar, signed_log};
use crate::sites::guide_color;
use crate::test_plain::{self as plain, Exact};
use crate::water::ViewWater;
use crate::{Field, FieldBox, Gradient, ObjectPass, Shape, WaterPass, variation};

/// True if the level fuses multiply and add, so that vector code and scalar twins agree bit for bit.
pub(crate) fn fuses(level: Level) -> bool {
    #[cfg(any(target_arch = "x86", target_arch = "x86_64"))]
    return level.as_avx2().is_some();
    #[cfg(not(any(target_arch = "x86", target_arch = "x86_64")))]
    return !level.is_fallback();
}

/// A random scene: field, Gaussians, one camera, its water.
struct Example {
    field: Field,
    means: Vec<[f32; 3]>,
    sh_dc: Vec<[f32; 3]>,
    base: Vec<[f32; 3]>,
    camera: [f32; 3],
    maps: MediumMaps,
    draw: Stream,
}

impl Example {
    fn new(seed: u64, shape: Shape, gaussians: usize, (w, h): (usize, usize)) -> Self {
        let draw = Stream::new(seed, Purpose::new("U-BAF example"), 0);
        let bounds = FieldBox { low: [-1.0, -0.8, -1.2], high: [1.0, 1.1, 0.9] };
        let mut field = Field::identity(shape, bounds, seed).unwrap();
        for (i, p) in field.parameters.iter_mut().enumerate() {
            *p += 0.25 * draw.normal(i as u64) as f32;
        }
        let rows = |n: usize, at: u64, low: f64, high: f64| -> Vec<[f32; 3]> {
            let u = |i: usize| (low + (high - low) * draw.uniform(at + i as u64)) as f32;
            (0..n).map(|i| [u(3 * i), u(3 * i + 1), u(3 * i + 2)]).collect()
        };
        let mut maps = MediumMaps::zeros(w, h);
        for (k, image) in
            [&mut maps.color, &mut maps.backscatter, &mut maps.attenuation].into_iter().enumerate()
        {
            for (i, v) in image.data_mut().iter_mut().enumerate() {
                *v = 0.7 * draw.uniform(10_000_000 + (k << 20 | i) as u64) as f32;
            }
        }
        Self {
            means: rows(gaussians, 1_000_000, -1.3, 1.3),
            sh_dc: rows(gaussians, 2_000_000, -2.5, 2.5),
            base: rows(gaussians, 3_000_000, 0.0, 1.2),
            camera: rows(1, 4_000_000, -1.4, 1.4)[0],
            field,
            maps,
            draw,
        }
    }

    fn derivatives(&self) -> (Vec<[f32; 3]>, MediumMaps) {
        let n = |at: usize| self.draw.normal(20_000_000 + at as u64) as f32;
        let colors = (0..self.means.len()).map(|i| [n(3 * i), n(3 * i + 1), n(3 * i + 2)]).collect();
        let mut maps = MediumMaps::zeros(self.maps.color.width(), self.maps.color.height());
        for (k, image) in
            [&mut maps.color, &mut maps.backscatter, &mut maps.attenuation].into_iter().enumerate()
        {
            for (i, v) in image.data_mut().iter_mut().enumerate() {
                *v = n(1_000_000 + (k << 16 | i));
            }
        }
        (colors, maps)
    }

    fn gradient(&self, level: Level) -> Gradient {
        let (d_colors, d_maps) = self.derivatives();
        let mut objects = ObjectPass::new(&self.field, &self.means, self.sh_dc.iter().copied());
        objects.level = level;
        let water = ViewWater::new(self.maps.clone());
        let mut pass = WaterPass::default();
        pass.level = level;
        let mut out = MediumMaps::zeros(0, 0);
        let mut gradient = Gradient::new(self.field.shape());
        // Runs twice, so that state left over from a step would change the result.
        for _ in 0..2 {
            gradient.clear();
            objects.forward(&self.field);
            objects.backward(&self.field, &self.base, &d_colors, &mut gradient);
            pass.forward(&self.field, self.camera, &water, 1.0, &mut out);
            pass.backward(&self.field, self.camera, &water, &d_maps, &mut gradient);
            variation::backward(&self.field, 3.0, &mut gradient);
        }
        gradient
    }

    /// The scalar whose gradient is [`Example::gradient`], computed by the f64 twin.
    fn value(&self, exact: &Exact, d_colors: &[[f32; 3]], d_maps: &MediumMaps) -> f64 {
        let dot = |a: &[f64; 3], d: [f32; 3]| a.iter().zip(d).map(|(a, d)| a * f64::from(d)).sum::<f64>();
        let colors = exact.colors(&self.means, &self.sh_dc, &self.base);
        let mut total: f64 = colors.iter().zip(d_colors).map(|(c, &d)| dot(c, d)).sum();
        let rows = |image: &Image| -> Vec<[f32; 3]> { image.to_interleaved().as_chunks::<3>().0.to_vec() };
        let water = exact.water(self.camera, &rows(&self.maps.color));
        total += water.iter().zip(rows(&d_maps.color)).map(|(c, d)| dot(c, d)).sum::<f64>();
        let pairs =
            [(&self.maps.backscatter, &d_maps.backscatter), (&self.maps.attenuation, &d_maps.attenuation)];
        for ((beta, d), ratio) in pairs.into_iter().zip(exact.ratios()) {
            let dot: f64 = beta.data().iter().zip(d.data()).map(|(b, d)| f64::from(*b) * f64::from(*d)).sum();
            total += ratio * dot;
        }
        total + 3.0 * exact.variation()
    }
}

#[test]
fn the_kernel_has_the_bits_of_its_scalar_twin() {
    for (seed, rank) in [(1, 8), (2, 5), (3, 16), (4, 9)] {
        let e = Example::new(seed, Shape { rank, ..Shape::default() }, 531, (1, 1));
        let mut pass = ObjectPass::new(&e.field, &e.means, e.sh_dc.iter().copied());
        pass.forward(&e.field);
        for (i, local) in pass.locals([0.0; 6]).iter().enumerate() {
            let [x, y, z] = e.field.bounds.normalise(e.means[i]);
            let gamma = gamma_scalar(&e.field.guide(), guide_color(e.sh_dc[i]).map(signed_log));
            let twin = plain::raw(&e.field, [x, y, z, gamma]);
            if fuses(Level::new()) {
                assert_eq!(local.map(f32::to_bits), twin.map(f32::to_bits), "Gaussian {i}");
            } else {
                assert!(local.iter().zip(twin).all(|(a, b)| (a - b).abs() < 1e-4), "Gaussian {i}");
            }
        }
    }
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    let e = Example::new(5, Shape::default(), 9000, (150, 90));
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| e.gradient(Level::new()))
    };
    let one = run(1);
    for threads in [2, 3, 7] {
        assert_eq!(one, run(threads), "{threads} threads");
    }
}

#[cfg(target_arch = "x86_64")]
#[test]
fn instruction_sets_with_fused_multiply_add_give_the_same_bits_and_the_others_nearly() {
    let e = Example::new(6, Shape::default(), 3000, (40, 30));
    let best = e.gradient(Level::new());
    if let Some(avx2) = Level::new().as_avx2() {
        assert_eq!(best, e.gradient(Level::Avx2(avx2)));
    }
    let base = e.gradient(Level::baseline());
    let scale = best.values.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    for (a, b) in best.values.iter().zip(&base.values) {
        assert!((a - b).abs() < 1e-4 * scale, "{a} {b}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn gradients_are_differences_of_the_formulas(
        seed in 0u64..1 << 40,
        resolution in 2usize..20,
        rank in 1usize..=16,
        width in 1usize..24,
        gaussians in 1usize..60,
        size in (1usize..9, 1usize..7),
    ) {
        let shape = Shape { resolution, rank, width };
        let e = Example::new(seed, shape, gaussians, size);
        let gradient = e.gradient(Level::new());
        let (d_colors, d_maps) = e.derivatives();
        let mut exact = Exact::new(&e.field);
        let step = 1e-6;
        let n = shape.parameters();
        let every = (n / 150).max(1);
        // The parameters are the ends of every group and a regular selection of all of them.
        let picks = (0..n).filter(|i| i % every == (seed as usize) % every || *i + 20 > n);
        let mut kinks = 0;
        for i in picks {
            let at = exact.parameters[i];
            let mut value = |x: f64| {
                exact.parameters[i] = x;
                e.value(&exact, &d_colors, &d_maps)
            };
            let middle = value(at);
            let (up, down) = (value(at + step), value(at - step));
            exact.parameters[i] = at;
            // A guide that crosses a node within the step has two different one-sided derivatives; this is
            // the case for very few parameters.
            if ((up - middle) - (middle - down)).abs() > 1e-3 * (up - down).abs().max(1e-6) {
                kinks += 1;
                continue;
            }
            let slope = (up - down) / (2.0 * step);
            let scale = 1.0 + slope.abs() + gaussians as f64 * 0.05;
            prop_assert!(
                (gradient.values[i] - slope).abs() < 5e-4 * scale,
                "parameter {i} of {shape:?}: {} against {slope}", gradient.values[i]
            );
        }
        prop_assert!(kinks < 20, "{kinks} kinks");
    }
}

/// `∂L/∂raw` sums to zero over all Gaussians either way, so a pass over all of them with this input finds
/// the same gradient.
#[test]
fn chosen_sites_do_what_all_do() {
    let e = Example::new(12, Shape::default(), 3000, (1, 1));
    let mut all = ObjectPass::new(&e.field, &e.means, e.sh_dc.iter().copied());
    all.forward(&e.field);
    let raw = all.locals([0.0; 6]);
    let mut listed: Vec<u32> = (0..3000).step_by(4).collect();
    let centred = listed.len();
    listed.extend((0..3000).filter(|i| i % 4 == 1));
    let mut some = ObjectPass::new(&e.field, &e.means, e.sh_dc.iter().copied());
    let sites = std::sync::Arc::new(some.sites().select(&listed, centred));
    some.move_to(&sites);
    some.forward(&e.field);
    assert_eq!(some.sites().len(), listed.len());
    let mean: [f64; 6] = std::array::from_fn(|o| {
        listed[..centred].iter().map(|&i| f64::from(raw[i as usize][o])).sum::<f64>() / centred as f64
    });
    for (o, m) in mean.iter().enumerate() {
        assert!((f64::from(some.mean[o]) - m).abs() < 1e-6);
    }
    for (local, &i) in some.locals([0.0; 6]).iter().zip(&listed) {
        assert_eq!(*local, raw[i as usize]);
    }

    let draw = Stream::new(12, Purpose::new("cotangents"), 0);
    let d: Vec<[f32; 6]> = (0..listed.len())
        .map(|i| std::array::from_fn(|o| 1.0 + draw.normal((6 * i + o) as u64) as f32))
        .collect();
    let mut found = Gradient::new(e.field.shape());
    some.backward_locals(&e.field, &d, &mut found);
    let mut d_raw = vec![[0.0f32; 6]; 3000];
    for o in 0..6 {
        let mean = d.iter().map(|d| f64::from(d[o])).sum::<f64>() / centred as f64;
        for (k, &i) in listed.iter().enumerate() {
            d_raw[i as usize][o] = d[k][o] - if k < centred { mean as f32 } else { 0.0 };
        }
    }
    let mut wanted = Gradient::new(e.field.shape());
    all.backward_locals(&e.field, &d_raw, &mut wanted);
    let size = wanted.values.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    for (i, (a, b)) in found.values.iter().zip(&wanted.values).enumerate() {
        assert!((a - b).abs() < 2e-5 * size, "parameter {i}: {a} {b}");
    }
}

#[test]
fn the_output_bias_shifts_nothing() {
    let e = Example::new(8, Shape::default(), 200, (6, 5));
    let mut shifted = e.field.clone();
    let range = shifted.shape().output_bias();
    shifted.parameters[range].iter_mut().for_each(|b| *b += 0.37);
    let colors = |field: &Field| {
        let mut pass = ObjectPass::new(field, &e.means, e.sh_dc.iter().copied());
        pass.forward(field);
        let mut out = Vec::new();
        pass.colors(field, &e.base, &mut out);
        let water = ViewWater::new(e.maps.clone());
        let mut maps = MediumMaps::zeros(0, 0);
        WaterPass::default().forward(field, e.camera, &water, 1.0, &mut maps);
        (out, maps)
    };
    let ((a, am), (b, bm)) = (colors(&e.field), colors(&shifted));
    for (x, y) in
        a.as_flattened().iter().chain(am.color.data()).zip(b.as_flattened().iter().chain(bm.color.data()))
    {
        assert!((x - y).abs() < 2e-5, "{x} {y}");
    }
}

#[test]
fn permuting_gaussians_permutes_their_colours() {
    let e = Example::new(9, Shape::default(), 100, (1, 1));
    let order: Vec<usize> = (0..100).rev().collect();
    let pick = |v: &[[f32; 3]]| -> Vec<[f32; 3]> { order.iter().map(|&i| v[i]).collect() };
    let run = |means: &[[f32; 3]], dc: &[[f32; 3]], base: &[[f32; 3]]| {
        let mut pass = ObjectPass::new(&e.field, means, dc.iter().copied());
        pass.forward(&e.field);
        let mut out = Vec::new();
        pass.colors(&e.field, base, &mut out);
        out
    };
    let straight = run(&e.means, &e.sh_dc, &e.base);
    let turned = run(&pick(&e.means), &pick(&e.sh_dc), &pick(&e.base));
    for (a, b) in pick(&straight).as_flattened().iter().zip(turned.as_flattened()) {
        assert!((a - b).abs() < 1e-6);
    }
}

#[test]
fn a_scene_without_gaussians_has_no_gradient_and_no_nan() {
    let e = Example::new(10, Shape::default(), 0, (3, 2));
    let mut pass = ObjectPass::new(&e.field, &[], [].into_iter());
    pass.forward(&e.field);
    assert_eq!(pass.mean, [0.0; 6]);
    assert!(e.gradient(Level::new()).values.iter().all(|g| g.is_finite()));
}

#[test]
fn ratios_stay_within_a_factor_of_four() {
    let mut e = Example::new(11, Shape::default(), 1, (1, 1));
    let range = e.field.shape().transport();
    e.field.parameters[range].copy_from_slice(&[50.0, -50.0]);
    let [bs, attn] = crate::water::ratios(&e.field, 1.0);
    assert!((bs - 4.0).abs() < 1e-5 && (attn - 0.25).abs() < 1e-6);
}
