//! Compares the extractor with the golden cases, and checks its own properties.

use std::sync::Arc;

use use3d_atc::extractor::{Affine, ExtractorSettings, Form, Geometry, SourceImage, Workspace, center};
use use3d_capture::Image;
use use3d_golden::{Case, Part};
use use3d_numerics::math;

fn image(case: &Case<'_>, tensor: &str) -> Image {
    let (w, h, planes) = case.planes(tensor);
    Image::from_planes(w, h, planes).expect("the golden image has its stated size")
}

fn settings(case: &Case<'_>) -> ExtractorSettings {
    let form = match case.config()["form"].as_str() {
        Some("log") => Form::Log,
        Some("linear") => Form::Linear,
        other => panic!("{}: unknown form {other:?}", case.name()),
    };
    ExtractorSettings { long_side: case.count("long_side"), cells: case.count("grid_long"), form }
}

fn cells(case: &Case<'_>, tensor: &str) -> Vec<[f64; 6]> {
    case.f64(tensor).chunks_exact(6).map(|c| c.try_into().expect("six numbers")).collect()
}

#[test]
fn golden_values() {
    for case in Part::math("extractor").cases() {
        let (a, b) = (image(&case, "in.a"), image(&case, "in.b"));
        let source = SourceImage::from_image(&a, &settings(&case)).unwrap();
        let mut workspace = Workspace::default();
        let transition = source.forward(&b, &mut workspace).unwrap().clone();
        case.check_f64("out.t", &transition.global);
        case.check_f64("out.delta", transition.local.as_flattened());
        let gains: Vec<f64> = transition
            .local
            .iter()
            .flat_map(|c| match source.geometry.settings.form {
                Form::Log => [math::exp(c[0]), math::exp(c[1]), math::exp(c[2])],
                Form::Linear => [c[0] + 1.0, c[1] + 1.0, c[2] + 1.0],
            })
            .collect();
        let stated = case.f64("out.gain");
        for (ours, golden) in gains.iter().zip(stated) {
            assert!((ours - golden.max(0.05)).abs() <= case.tolerance("out.gain"));
        }
        let mut centered = transition.local.clone();
        center(&mut centered);
        case.check_f64("out.centered", centered.as_flattened());
        case.check_f64("out.confidence", &source.confidence(&workspace));
        let descriptors = source.descriptors();
        case.check_f64("out.global_descriptor", &descriptors.global);
        case.check_f64("out.local_descriptor", descriptors.local.as_flattened());
    }
}

/// The gradient at all pixels: that at the pixels that are read, and zero everywhere else.
fn backward(source: &SourceImage, global: &Affine, local: &[[f64; 6]], workspace: &mut Workspace) -> Image {
    let mut on_lattice = Image::new(0, 0);
    source.backward_on_lattice(global, local, workspace, &mut on_lattice).unwrap();
    let mut full = Image::new(source.geometry.size.0, source.geometry.size.1);
    for (j, &y) in source.geometry.rows.iter().enumerate() {
        for (i, &x) in source.geometry.columns.iter().enumerate() {
            full.set_pixel(x, y, on_lattice.pixel(i, j));
        }
    }
    full
}

#[test]
fn golden_gradients() {
    for case in Part::math("extractor").cases() {
        let (a, b) = (image(&case, "in.a"), image(&case, "in.b"));
        let source = SourceImage::from_image(&a, &settings(&case)).unwrap();
        let mut workspace = Workspace::default();
        source.forward(&b, &mut workspace).unwrap();
        let mut pulled = 0;
        for (pull, outputs) in case.pulls() {
            let mut global = [0.0; 12];
            let mut local = vec![[0.0; 6]; workspace.transition.local.len()];
            for output in outputs {
                match output.as_str() {
                    "t" => global = case.f64("cot.t").try_into().expect("twelve numbers"),
                    "delta" => local = cells(&case, "cot.delta"),
                    "centered" => {
                        local = cells(&case, "cot.centered");
                        center(&mut local);
                    }
                    other => panic!("{}: no gradient through {other}", case.name()),
                }
            }
            let gradient = backward(&source, &global, &local, &mut workspace);
            case.check_planes(&format!("grad.{pull}.b"), gradient.data());
            pulled += 1;
        }
        assert!(pulled > 0, "{}: no pulls", case.name());
    }
}

/// Dim cells, near the floor of the fit's energy: two cells of 8 × 8 samples, so that the samples are the
/// pixels. The expected gain `g` and bias `b` minimise `Σ (g x' + b − y)² + ρ n m₂ (g − 1)² + ρ n b²`, with
/// `n = 64`, `ρ = 1/100` and `m₂ = max(mean x'², 1/10000)`, so they solve
///
/// ```text
/// | Σ x'² + ρ n m₂   Σ x'    | | g |   | Σ x' y + ρ n m₂ |
/// | Σ x'             n + ρ n | | b | = | Σ y            |
/// ```
///
/// which Cramer's rule does here in float64; `x'` is the found global operator applied to the source.
#[test]
fn dim_cells_follow_the_normal_equations_with_the_floor_of_their_energy() {
    let settings = ExtractorSettings { long_side: 16, cells: 2, form: Form::Linear };
    let (mut below, mut near) = (0, 0);
    for brightness in [0.004f32, 0.011, 0.014, 0.02, 0.03, 0.06] {
        let (mut a, mut b) = (Image::new(16, 16), Image::new(16, 16));
        for y in 0..16 {
            for x in 0..16 {
                let wave = |k: usize| 1.0 + 0.3 * math::sin((x * (k + 1) + 2 * y + 5 * k) as f32);
                a.set_pixel(x, y, std::array::from_fn(|c| brightness * wave(c)));
                b.set_pixel(x, y, std::array::from_fn(|c| brightness * (1.5 * wave(c) + 0.8 * wave(c + 3))));
            }
        }
        let source = SourceImage::from_image(&a, &settings).unwrap();
        let mut workspace = Workspace::default();
        let found = source.forward(&b, &mut workspace).unwrap().clone();
        assert_eq!(found.local.len(), 4);
        for (cell, operator) in found.local.iter().enumerate() {
            for c in 0..3 {
                let (n, rho) = (64.0, 0.01);
                let [mut x1, mut x2, mut xy, mut y1] = [0.0f64; 4];
                for i in 0..64 {
                    let (px, py) = (cell % 2 * 8 + i % 8, cell / 2 * 8 + i / 8);
                    let v = a.pixel(px, py).map(f64::from);
                    let t = &found.global[4 * c..4 * c + 4];
                    let x = v[c] + t[0] * v[0] + t[1] * v[1] + t[2] * v[2] + t[3];
                    let y = f64::from(b.pixel(px, py)[c]);
                    (x1, x2, xy, y1) = (x1 + x, x2 + x * x, xy + x * y, y1 + y);
                }
                let energy = (x2 / n).max(1e-4);
                below += usize::from(x2 / n < 1e-4);
                near += usize::from(x2 / n > 1.05e-4 && x2 / n < 1e-3);
                let ridge = rho * n * energy;
                let (p, q, r) = (x2 + ridge, x1, n + rho * n);
                let determinant = p * r - q * q;
                let gain = ((xy + ridge) * r - q * y1) / determinant;
                let bias = (p * y1 - q * (xy + ridge)) / determinant;
                let error = (operator[c] + 1.0 - gain).abs().max((operator[3 + c] - bias).abs());
                assert!(error < 1e-9, "{brightness}, cell {cell}, channel {c}: {error:e}");
            }
        }
    }
    assert!(below >= 12 && near >= 12, "{below} cells below the floor, {near} up to ten times above");
}

/// A smooth random image with some noise, colours in about [0.05, 0.95].
fn random_image(width: usize, height: usize, seed: u64) -> Image {
    use use3d_numerics::random::{Purpose, Stream};
    let stream = Stream::new(seed, Purpose::new("extractor test image"), 0);
    let mut image = Image::new(width, height);
    for c in 0..3 {
        let k: Vec<f64> = (0..6).map(|i| stream.uniform((c * 6 + i) as u64)).collect();
        for y in 0..height {
            for x in 0..width {
                let (u, v) = (x as f64 / width as f64, y as f64 / height as f64);
                let wave = math::sin(6.0 * k[0] * u + 9.0 * k[1] * v + 6.0 * k[2]) * 0.25;
                let noise = stream.uniform((100 + (c * height + y) * width + x) as u64) * 0.2;
                image.plane_mut(c)[y * width + x] = (0.3 + 0.2 * k[3] + wave + noise) as f32;
            }
        }
    }
    image
}

#[test]
fn gradients_agree_with_finite_differences() {
    use use3d_numerics::random::{Purpose, Stream};
    // The last is dim: most cells have an energy between 1e-4 and 1e-3.
    let shapes = [
        ((50, 34), 384, 16, 1.0),
        ((90, 61), 40, 6, 1.0),
        ((9, 70), 33, 5, 1.0),
        ((20, 12), 384, 16, 1.0),
        ((50, 34), 384, 16, 0.04),
    ];
    for (case, ((w, h), long_side, grid, dim)) in shapes.into_iter().enumerate() {
        for form in [Form::Log, Form::Linear] {
            let settings = ExtractorSettings { long_side, cells: grid, form };
            let a = random_image(w, h, 2 * case as u64).map(|v| dim * v);
            let b = random_image(w, h, 2 * case as u64 + 1).map(|v| dim * v);
            let direction = random_image(w, h, 100 + case as u64).map(|v| dim * (v - 0.4));
            let source = SourceImage::from_image(&a, &settings).unwrap();
            let mut workspace = Workspace::default();
            source.forward(&b, &mut workspace).unwrap();
            let stream = Stream::new(9, Purpose::new("cotangents"), case as u64);
            let global: [f64; 12] = std::array::from_fn(|i| stream.normal(i as u64));
            let local: Vec<[f64; 6]> = (0..workspace.transition.local.len())
                .map(|c| std::array::from_fn(|k| stream.normal((100 + 6 * c + k) as u64)))
                .collect();
            let gradient = backward(&source, &global, &local, &mut workspace);
            let analytic: f64 = gradient
                .data()
                .iter()
                .zip(direction.data())
                .map(|(&g, &d)| f64::from(g) * f64::from(d))
                .sum();
            let mut value = |step: f32| -> f64 {
                let moved: Vec<f32> =
                    b.data().iter().zip(direction.data()).map(|(v, d)| v + step * d).collect();
                let moved = Image::from_planes(w, h, moved).unwrap();
                let t = source.forward(&moved, &mut workspace).unwrap();
                let sum = |a: &[f64], b: &[f64]| -> f64 { a.iter().zip(b).map(|(x, y)| x * y).sum() };
                sum(&t.global, &global) + sum(t.local.as_flattened(), local.as_flattened())
            };
            let step = 1.0 / 512.0;
            let numeric = (value(step) - value(-step)) / (2.0 * f64::from(step));
            // The pixels are f32, so the difference quotient itself is accurate to about 1e-4 of the
            // largest term.
            let scale = numeric.abs().max(analytic.abs()).max(1.0);
            assert!(
                (numeric - analytic).abs() < 2e-3 * scale,
                "case {case} {form:?}: {analytic} against {numeric}"
            );
        }
    }
}

#[test]
fn an_image_and_itself_have_the_zero_transition_exactly() {
    for (w, h) in [(64, 48), (500, 333), (3, 5), (1, 1), (20, 700)] {
        let image = random_image(w, h, 5);
        let source = SourceImage::from_image(&image, &ExtractorSettings::default()).unwrap();
        let mut workspace = Workspace::default();
        let transition = source.forward(&image, &mut workspace).unwrap();
        assert_eq!(transition.global, [0.0; 12]);
        assert!(transition.local.iter().all(|c| *c == [0.0; 6]));
    }
}

#[test]
fn a_known_affine_is_recovered_up_to_the_ridge() {
    let image = random_image(96, 64, 3);
    let t: [f64; 12] = [0.3, -0.1, 0.05, 0.02, 0.0, 0.2, 0.1, -0.05, -0.2, 0.1, 0.4, 0.1];
    let mut target = image.clone();
    for y in 0..64 {
        for x in 0..96 {
            let colour = image.pixel(x, y).map(f64::from);
            target.set_pixel(x, y, use3d_atc::extractor::affine_apply(&t, colour).map(|v| v as f32));
        }
    }
    let source = SourceImage::from_image(&image, &ExtractorSettings::default()).unwrap();
    let mut workspace = Workspace::default();
    let found = source.forward(&target, &mut workspace).unwrap();
    let norm = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let ratio = norm(&found.global) / norm(&t);
    // The fit is a contraction towards the identity: shorter, but not much shorter.
    assert!(ratio < 1.0 && ratio > 0.8, "{ratio}");
    // The local operators then have little left to explain.
    let largest = found.local.as_flattened().iter().fold(0.0f64, |m, v| m.max(v.abs()));
    assert!(largest < 0.05, "{largest}");
}

#[test]
fn the_lattice_gives_the_same_bits_as_the_whole_image() {
    let (a, b) = (random_image(700, 467, 1), random_image(700, 467, 2));
    let settings = ExtractorSettings { long_side: 200, ..ExtractorSettings::default() };
    let geometry = Arc::new(Geometry::new(700, 467, &settings).unwrap());
    let sample = |image: &Image| {
        let mut out = Image::new(geometry.columns.len(), geometry.rows.len());
        for (j, &y) in geometry.rows.iter().enumerate() {
            for (i, &x) in geometry.columns.iter().enumerate() {
                out.set_pixel(i, j, image.pixel(x, y));
            }
        }
        out
    };
    assert_eq!(geometry.lattice().width(), geometry.columns.len());
    assert!(geometry.columns.len() <= 400 && geometry.columns.len() < 700);
    let whole = SourceImage::new(&geometry, &a).unwrap();
    let lattice = SourceImage::on_lattice(&geometry, &sample(&a)).unwrap();
    let (mut one, mut two) = (Workspace::default(), Workspace::default());
    let first = whole.forward(&b, &mut one).unwrap();
    let second = lattice.forward_on_lattice(&sample(&b), &mut two).unwrap();
    assert_eq!(first, second);
}

#[test]
fn the_same_bits_on_any_number_of_threads() {
    let (a, b) = (random_image(500, 333, 1), random_image(500, 333, 2));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let source = SourceImage::from_image(&a, &ExtractorSettings::default()).unwrap();
            let mut workspace = Workspace::default();
            let transition = source.forward(&b, &mut workspace).unwrap().clone();
            let local = vec![[0.3; 6]; transition.local.len()];
            let gradient = backward(&source, &[0.1; 12], &local, &mut workspace);
            (transition, gradient, source.descriptors())
        })
    };
    let one = run(1);
    assert_eq!(one, run(2));
    assert_eq!(one, run(5));
}

#[test]
fn bad_images_are_errors() {
    let settings = ExtractorSettings::default();
    let mut bad = random_image(20, 10, 1);
    bad.plane_mut(1)[7] = f32::NAN;
    assert!(SourceImage::from_image(&bad, &settings).unwrap_err().to_string().contains("not finite"));
    assert!(SourceImage::from_image(&Image::new(0, 4), &settings).is_err());
    assert!(ExtractorSettings { cells: 1, ..ExtractorSettings::default() }.validate().is_err());
    let source = SourceImage::from_image(&random_image(20, 10, 1), &settings).unwrap();
    let mut workspace = Workspace::default();
    assert!(source.forward(&Image::new(3, 0), &mut workspace).is_err());
    assert!(source.forward_on_lattice(&random_image(21, 10, 1), &mut workspace).is_err());
    source.forward(&random_image(20, 10, 2), &mut workspace).unwrap();
    let mut gradient = Image::new(0, 0);
    assert!(source.backward_on_lattice(&[0.0; 12], &[[0.0; 6]; 3], &mut workspace, &mut gradient).is_err());
}

/// A sampled view has the same grid, reads pixels of the whole one, and gives nearly the same transition
/// for a smooth pair.
#[test]
fn a_sampled_view_has_nearly_the_same_transition() {
    let settings = ExtractorSettings::default();
    let wave = |w: usize, h: usize, k: f32| {
        let mut image = Image::new(w, h);
        for y in 0..h {
            for x in 0..w {
                let (u, v) = (x as f32 / w as f32, y as f32 / h as f32);
                let t = |c: f32| 0.5 + 0.3 * math::sin(7.0 * u + c) * math::cos(5.0 * v - c);
                image.set_pixel(x, y, [math::powf(t(0.0), k), t(1.0), k * t(2.0)]);
            }
        }
        image
    };
    let (source, target) = (wave(640, 360, 1.0), wave(640, 360, 0.8));
    let whole = Geometry::new(640, 360, &settings).unwrap();
    let (lattice, geometry) = whole.sampled(192).unwrap().unwrap();
    assert_eq!(((lattice.width(), lattice.height()), geometry.grid), ((192, 108), whole.grid));
    let pick = |image: &Image| {
        let mut out = Image::new(lattice.width(), lattice.height());
        for (y, &v) in lattice.rows().iter().enumerate() {
            for (x, &u) in lattice.columns().iter().enumerate() {
                out.set_pixel(x, y, image.pixel(u as usize, v as usize));
            }
        }
        out
    };
    let transition = |geometry: Geometry, source: &Image, target: &Image| {
        let mut workspace = Workspace::default();
        let source = SourceImage::on_lattice(&Arc::new(geometry), source).unwrap();
        source.forward_on_lattice(target, &mut workspace).unwrap().clone()
    };
    let some = transition(geometry, &pick(&source), &pick(&target));
    let all = SourceImage::from_image(&source, &settings).unwrap();
    let mut workspace = Workspace::default();
    let all = all.forward(&target, &mut workspace).unwrap();
    for (a, b) in some.global.iter().zip(&all.global) {
        assert!((a - b).abs() < 5e-3, "{a} {b}");
    }
    // More samples than pixels of the extractor's own resize are not taken, and no pixel is taken twice.
    assert_eq!(whole.sampled(4000).unwrap().unwrap().1.working, whole.working);
    assert!(Geometry::new(5, 5, &settings).unwrap().sampled(192).unwrap().is_none());
    assert!(whole.sampled(2).is_err());
}
