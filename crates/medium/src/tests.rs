//! Compares with goldens and finite differences, and compares the vector code with its plain form.

use glam::{DMat3, DVec3};
use use3d_capture::{Camera, DepthNetwork, Formation, Image, Intrinsics, Lattice, MediumMaps, Pose};
use use3d_golden::{Case, Part};
use use3d_numerics::random::{Purpose, Stream};

use crate::{
    MediumGlobal, MediumKind, MediumMlp, MediumModel, MediumPerView, MediumRbf, MediumSeasplat, MediumStart,
    MediumUir, directional,
};

fn case_camera(case: &Case<'_>) -> Camera {
    let rotation = case.rotations()[0];
    let o = case.f64("in.o");
    Camera {
        intrinsics: case.intrinsics(),
        // The stored rotation is orthonormal to f32 only; this puts the centre exactly at `o`.
        pose: Pose { rotation, translation: -(rotation.transpose().inverse() * DVec3::from_slice(&o)) },
    }
}

fn case_model(case: &Case<'_>) -> MediumRbf {
    let flat = case.f32("in.coeffs");
    MediumRbf {
        centers: case.rows("in.centers"),
        log_widths: case.f32("in.log_widths"),
        coefficients: flat
            .chunks_exact(144)
            .map(|c| bytemuck::pod_read_unaligned(bytemuck::cast_slice(c)))
            .collect(),
        top_k: case.count("top_k"),
    }
}

/// The share of each anchor in the water around a camera.
fn weights(rbf: &MediumRbf, camera: &Camera) -> Vec<f64> {
    let mut weights = vec![0.0; rbf.centers.len()];
    for (k, w) in rbf.selection(camera) {
        weights[k] = w;
    }
    weights
}

#[test]
fn golden_medium() {
    let part = Part::math("medium");
    for case in part.cases() {
        let (camera, rbf) = (case_camera(&case), case_model(&case));
        let lattice = Lattice::full(&camera.intrinsics);
        case.check_f64("out.weights", &weights(&rbf, &camera));
        case.check("out.agg", bytemuck::cast_slice(&rbf.aggregate(&camera)));
        let model = MediumModel::Rbf(rbf);
        let degree = case.count("degree");
        let mut maps = MediumMaps::zeros(1, 1);
        model.maps(&camera, &lattice, degree, &mut maps);
        let named = |maps: &MediumMaps| {
            [
                ("c_m", maps.color.clone()),
                ("beta_bs", maps.backscatter.clone()),
                ("beta_attn", maps.attenuation.clone()),
            ]
        };
        for (name, map) in named(&maps) {
            case.check_planes(&format!("out.{name}"), map.data());
        }
        for (pull, outputs) in case.pulls() {
            let d_map = |name: &str| {
                if !outputs.iter().any(|o| o == name) {
                    return Image::new(lattice.width(), lattice.height());
                }
                let (w, h, data) = case.planes(&format!("cot.{name}"));
                Image::from_planes(w, h, data).unwrap()
            };
            let d_maps = MediumMaps {
                color: d_map("c_m"),
                backscatter: d_map("beta_bs"),
                attenuation: d_map("beta_attn"),
                formation: Formation::default(),
                network: None,
            };
            let mut gradient = model.zeros_like();
            model.backward(&camera, &lattice, degree, &maps, &d_maps, &mut gradient);
            let MediumModel::Rbf(gradient) = gradient else { unreachable!() };
            case.check(&format!("grad.{pull}.centers"), bytemuck::cast_slice(&gradient.centers));
            case.check(&format!("grad.{pull}.log_widths"), &gradient.log_widths);
            case.check(&format!("grad.{pull}.coeffs"), bytemuck::cast_slice(&gradient.coefficients));
        }
    }
}

#[test]
fn golden_water_of_single_views() {
    let part = Part::math("marinestd");
    let case = part.cases().into_iter().find(|case| case.name() == "per_view").unwrap();
    let numbers: Vec<[f32; 3]> = case.rows("in.numbers");
    let model = MediumModel::PerView(MediumPerView {
        centers: case.rows("in.centers"),
        axes: case.rows("in.axes"),
        numbers: numbers.as_chunks::<3>().0.to_vec(),
    });
    let at = |name: &str| DVec3::from_slice(&case.f64(name));
    let mut camera = camera(&Stream::new(1, Purpose::new("one pixel"), 0), 4, 4);
    let (eye, axis) = (at("in.center"), at("in.axis"));
    camera.pose = Pose::look_at(eye, eye + axis, DVec3::Z);
    let lattice = Lattice::subset(&[1], &[2]).unwrap();
    let mut maps = MediumMaps::zeros(1, 1);
    model.maps(&camera, &lattice, 0, &mut maps);
    let images = [&maps.color, &maps.attenuation, &maps.backscatter];
    case.check("out.maps", &images.map(|image| image.pixel(0, 0)).concat());
    let [color, attenuation, backscatter] = case.rows::<3>("cot.maps")[..] else { panic!("three maps") };
    let image = |values: [f32; 3]| Image::from_planes(1, 1, values.to_vec()).unwrap();
    let d_maps = MediumMaps {
        color: image(color),
        backscatter: image(backscatter),
        attenuation: image(attenuation),
        formation: Formation::default(),
        network: None,
    };
    let mut gradient = model.zeros_like();
    model.backward(&camera, &lattice, 0, &maps, &d_maps, &mut gradient);
    case.check("grad.maps.numbers", &gradient.flat());
}

#[test]
fn a_training_view_is_its_own_nearest_one_and_water_of_views_needs_views() {
    let poses: Vec<Pose> =
        (0..6).map(|k| camera(&Stream::new(k, Purpose::new("views"), 0), 4, 4).pose).collect();
    let start = |views| MediumStart { anchors: 1, top_k: 1, seed: 0, views };
    let mut model = MediumModel::start(MediumKind::PerView, &start(poses.clone())).unwrap();
    let flat: Vec<f32> = (0..54).map(|i| (i / 9) as f32).collect();
    assert!(model.set_flat(&flat));
    let mut camera = camera(&Stream::new(0, Purpose::new("views"), 0), 4, 4);
    let mut maps = MediumMaps::zeros(1, 1);
    for (k, pose) in poses.into_iter().enumerate() {
        camera.pose = pose;
        model.maps(&camera, &Lattice::full(&camera.intrinsics), 0, &mut maps);
        let expected = use3d_numerics::functions::scalar::sigmoid(k as f32);
        assert!(maps.color.data().iter().all(|v| *v == expected), "view {k}");
    }
    let refused = MediumModel::start(MediumKind::PerView, &start(Vec::new())).unwrap_err().to_string();
    assert!(refused.contains("no training views"), "{refused}");
    assert!(MediumModel::from_tensors(MediumKind::PerView, 0, &crate::Tensors::new()).is_err());
}

#[test]
fn golden_nine_numbers() {
    let part = Part::math("seasplat");
    let case = part.cases().into_iter().find(|case| case.name() == "water").unwrap();
    let numbers = case.rows("in.numbers").try_into().unwrap();
    let model = MediumModel::Seasplat(MediumSeasplat { numbers });
    let size = (case.count("width"), case.count("height"));
    let (camera, lattice) =
        (camera(&Stream::new(1, Purpose::new("a view"), 0), size.0, size.1), Lattice::size(size.0, size.1));
    let mut maps = MediumMaps::zeros(0, 0);
    model.maps(&camera, &lattice, 1, &mut maps);
    for (q, name) in ["c_m", "beta_bs", "beta_attn"].into_iter().enumerate() {
        let map = [&maps.color, &maps.backscatter, &maps.attenuation][q];
        case.check_planes(&format!("out.{name}"), map.data());
        let mut d_maps = MediumMaps::zeros(size.0, size.1);
        let (w, h, cot) = case.planes(&format!("cot.{name}"));
        *[&mut d_maps.color, &mut d_maps.backscatter, &mut d_maps.attenuation][q] =
            Image::from_planes(w, h, cot).unwrap();
        let mut gradient = model.zeros_like();
        model.backward(&camera, &lattice, 1, &maps, &d_maps, &mut gradient);
        case.check(&format!("grad.{name}.numbers"), &gradient.flat());
    }
}

fn camera(stream: &Stream, width: usize, height: usize) -> Camera {
    let n = |i: u64| stream.normal(900 + i);
    let eye = DVec3::new(n(0), n(1), n(2)) * 0.6;
    Camera {
        intrinsics: Intrinsics {
            width,
            height,
            fx: width as f64 * 0.9,
            fy: width as f64,
            cx: width as f64 * 0.47,
            cy: height as f64 * 0.55,
        },
        pose: Pose::look_at(eye, DVec3::new(n(3), n(4), n(5)) + DVec3::splat(3.0), DVec3::Z),
    }
}

fn random_model(stream: &Stream, kind: MediumKind) -> MediumModel {
    let n = |i: u64| stream.normal(i) as f32;
    let coefficients = |from: u64| {
        // Red is bright and green is clamped everywhere, so that no pixel lies near the clamp's kink.
        let mut a: crate::Coefficients = std::array::from_fn(|q| {
            std::array::from_fn(|b| std::array::from_fn(|c| 0.4 * n(from + (q * 48 + b * 3 + c) as u64)))
        });
        a[0][0] = [14.0, -16.0, 12.0];
        a
    };
    match kind {
        MediumKind::None => MediumModel::None,
        MediumKind::Global => MediumModel::Global(MediumGlobal { coefficients: coefficients(0) }),
        MediumKind::Image => MediumModel::Image(MediumGlobal { coefficients: coefficients(0) }),
        MediumKind::Seasplat => {
            // One exponent is negative: it counts as zero, and has no gradient.
            let numbers = std::array::from_fn(|q| std::array::from_fn(|c| 0.6 + 0.1 * n((3 * q + c) as u64)));
            let mut water = MediumSeasplat { numbers };
            water.numbers[2][1] = -0.4;
            MediumModel::Seasplat(water)
        }
        MediumKind::Rbf => MediumModel::Rbf(MediumRbf {
            centers: (0..5).map(|k| std::array::from_fn(|a| 0.7 * n(5000 + k * 3 + a as u64))).collect(),
            log_widths: (0..5).map(|k| -0.3 + 0.2 * n(6000 + k)).collect(),
            coefficients: (0..5).map(|k| coefficients(1000 * k)).collect(),
            top_k: 3,
        }),
        MediumKind::PerView => {
            let views =
                (0..4).map(|k| camera(&Stream::new(k, Purpose::new("views"), 0), 4, 4).pose).collect();
            let start = MediumStart { anchors: 1, top_k: 1, seed: 0, views };
            let mut model = MediumModel::start(kind, &start).unwrap();
            let flat: Vec<f32> = (0..model.parameter_count()).map(|i| 0.7 * n(300 + i as u64)).collect();
            assert!(model.set_flat(&flat));
            model
        }
        MediumKind::Mlp => {
            let mut network = MediumMlp::new(stream.bits(0));
            for b in network.biases.iter_mut().flatten() {
                *b = 0.1;
            }
            MediumModel::Mlp(network)
        }
        MediumKind::Uir => {
            let mut water = MediumModel::Uir(MediumUir::new(stream.bits(0)));
            let moved: Vec<f32> =
                water.flat().iter().enumerate().map(|(i, v)| v + 0.2 * n(i as u64)).collect();
            assert!(water.set_flat(&moved));
            water
        }
    }
}

fn random_maps(stream: &Stream, width: usize, height: usize) -> MediumMaps {
    let image = |from: u64| {
        let values = (0..3 * width * height).map(|i| stream.normal(from + i as u64) as f32).collect();
        Image::from_planes(width, height, values).unwrap()
    };
    MediumMaps {
        color: image(10_000),
        backscatter: image(30_000),
        attenuation: image(50_000),
        formation: Formation::default(),
        network: None,
    }
}

fn dot(a: &MediumMaps, b: &MediumMaps) -> f64 {
    let images = [(&a.color, &b.color), (&a.backscatter, &b.backscatter), (&a.attenuation, &b.attenuation)];
    let pairs = images.iter().flat_map(|(x, y)| x.data().iter().zip(y.data()));
    let numbers = a.network.iter().zip(&b.network).flat_map(|(x, y)| x.values().zip(y.values()));
    pairs.chain(numbers).map(|(&x, &y)| f64::from(x) * f64::from(y)).sum()
}

/// The gradients that a model of a kind reads: coefficients of a depth network are shown and not used.
fn read_by(kind: MediumKind, stream: &Stream, mut d_maps: MediumMaps) -> MediumMaps {
    if kind == MediumKind::Uir {
        d_maps.backscatter.data_mut().fill(0.0);
        d_maps.attenuation.data_mut().fill(0.0);
        let mut network = DepthNetwork::default();
        network.values_mut().enumerate().for_each(|(i, v)| *v = 50.0 * stream.normal(i as u64) as f32);
        d_maps.network = Some(Box::new(network));
    }
    d_maps
}

#[test]
fn golden_water_of_3d_uir() {
    let part = Part::math("uir");
    let case = part.cases().into_iter().find(|case| case.name() == "water").unwrap();
    let names = [
        "constants",
        "code_weight",
        "code_bias",
        "depth_weight",
        "hidden_weight",
        "hidden_bias",
        "output_weight",
        "output_bias",
    ];
    let mut model = MediumModel::Uir(MediumUir::new(0));
    let given: Vec<f32> = names.iter().flat_map(|name| case.f32(&format!("in.{name}"))).collect();
    assert!(model.set_flat(&given));
    let rotation = DMat3::from_cols_slice(&case.f64("in.rotation")).transpose();
    let intrinsics = Intrinsics { width: 1, height: 1, fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
    let center = DVec3::from_slice(&case.f64("in.center"));
    let camera = Camera { intrinsics, pose: Pose { rotation, translation: -(rotation * center) } };
    let (lattice, mut maps) = (Lattice::full(&intrinsics), MediumMaps::zeros(0, 0));
    model.maps(&camera, &lattice, 3, &mut maps);
    let numbers =
        |maps: &MediumMaps| -> Vec<f32> { maps.network.as_ref().unwrap().values().copied().collect() };
    case.check("out.color", maps.color.data());
    case.check("out.network", &numbers(&maps));
    let mut d_maps = MediumMaps::zeros(1, 1);
    d_maps.color.data_mut().copy_from_slice(&case.f32("cot.color"));
    let mut d_network = DepthNetwork::default();
    d_network.values_mut().zip(case.f32("cot.network")).for_each(|(value, given)| *value = given);
    d_maps.network = Some(Box::new(d_network));
    let mut gradient = model.zeros_like();
    model.backward(&camera, &lattice, 3, &maps, &d_maps, &mut gradient);
    for (name, (_, values)) in names.iter().zip(gradient.groups()) {
        case.check(&format!("grad.all.{name}"), values);
    }
}

#[test]
fn gradients_agree_with_finite_differences() {
    for seed in 0..3 {
        let stream = Stream::new(seed, Purpose::new("medium finite differences"), 0);
        let camera = camera(&stream, 37, 19);
        let lattice = Lattice::full(&camera.intrinsics);
        for &kind in MediumKind::ALL {
            let d_maps = read_by(kind, &stream, random_maps(&stream, 37, 19));
            for degree in [0, 1, 3] {
                let mut model = random_model(&stream, kind);
                let mut maps = MediumMaps::zeros(1, 1);
                model.maps(&camera, &lattice, degree, &mut maps);
                let mut gradient = model.zeros_like();
                model.backward(&camera, &lattice, degree, &maps, &d_maps, &mut gradient);
                // Each group is checked at its own scale, so that a small one is not hidden by the largest
                // gradient.
                let mut ends = Vec::new();
                for (_, group) in gradient.groups() {
                    ends.push(ends.last().copied().unwrap_or(0) + group.len());
                }
                let starts = [0].into_iter().chain(ends.iter().copied());
                let groups: Vec<(usize, usize)> = starts.zip(ends.iter().copied()).collect();
                let (parameters, gradient) = (model.flat(), gradient.flat());
                let scale_of = |(from, to): (usize, usize)| {
                    gradient[from..to].iter().fold(0.0f32, |m, g| m.max(g.abs()))
                };
                // Derivatives along random directions in each group, so that every parameter takes part.
                for (probe, &(from, to)) in groups.iter().enumerate() {
                    let scale = scale_of((from, to));
                    let direction: Vec<f32> = (0..parameters.len())
                        .map(|i| match (from..to).contains(&i) {
                            true => stream.normal(probe as u64 * 100_000 + 70_000 + i as u64) as f32,
                            false => 0.0,
                        })
                        .collect();
                    let expected: f64 =
                        gradient.iter().zip(&direction).map(|(&g, &d)| f64::from(g) * f64::from(d)).sum();
                    let mut at = |h: f32| {
                        let moved: Vec<f32> =
                            parameters.iter().zip(&direction).map(|(p, d)| p + h * d).collect();
                        assert!(model.set_flat(&moved));
                        model.maps(&camera, &lattice, degree, &mut maps);
                        dot(&maps, &d_maps)
                    };
                    // Three steps cancel the cubic and the fifth term (Romberg), so that the smallest one can
                    // exceed the rounding of the sum. Larger groups move as far altogether.
                    let step = 3e-2 * (3.0 / (to - from) as f32).sqrt().min(1.0);
                    let mut central = |h: f32| (at(h) - at(-h)) / (2.0 * f64::from(h));
                    let [fine, middle, coarse] = [step, 2.0 * step, 4.0 * step].map(&mut central);
                    let (near, far) = ((4.0 * fine - middle) / 3.0, (4.0 * middle - coarse) / 3.0);
                    let numeric = (16.0 * near - far) / 15.0;
                    let norm = ((to - from) as f64).sqrt() * f64::from(scale);
                    let error = (numeric - expected).abs();
                    assert!(
                        error <= 2e-3 * norm.max(expected.abs()),
                        "{kind:?} degree {degree}, {from} to {to}: {numeric} against {expected}"
                    );
                }
                // Derivatives with respect to single parameters of every group.
                let singles = groups.iter().flat_map(|&(from, to)| {
                    let step = (to - from) / 11 + 1;
                    (from..to).step_by(step).map(move |index| (index, (from, to)))
                });
                for (index, group) in singles {
                    let (g, scale) = (gradient[index], scale_of(group));
                    let mut at = |h: f32| {
                        let mut moved = parameters.clone();
                        moved[index] += h;
                        assert!(model.set_flat(&moved));
                        model.maps(&camera, &lattice, degree, &mut maps);
                        dot(&maps, &d_maps)
                    };
                    let numeric = (at(1e-2) - at(-1e-2)) / 2e-2;
                    let error = (numeric - f64::from(g)).abs();
                    assert!(
                        error <= 1e-2 * f64::from(scale),
                        "{kind:?} parameter {index}: {numeric} against {g}"
                    );
                }
            }
        }
    }
}

#[test]
fn the_vector_code_agrees_with_the_plain_form_on_any_lattice() {
    let stream = Stream::new(9, Purpose::new("medium lattices"), 0);
    for (width, height) in [(1, 1), (15, 3), (16, 8), (17, 9), (50, 33)] {
        let camera = camera(&stream, width.max(4) * 2, height.max(4) * 2);
        let columns: Vec<usize> = (0..width).map(|i| i * 2).collect();
        let rows: Vec<usize> = (0..height).map(|i| i * 2 + 1).collect();
        let lattice = Lattice::subset(&columns, &rows).unwrap();
        for degree in 0..=3 {
            let MediumModel::Global(global) = random_model(&stream, MediumKind::Global) else {
                unreachable!()
            };
            let plain = directional::forward_plain(&global.coefficients, &camera, &lattice, degree);
            let mut fast = MediumMaps::zeros(3, 2);
            MediumModel::Global(global).maps(&camera, &lattice, degree, &mut fast);
            for (a, b) in [
                (&plain.color, &fast.color),
                (&plain.backscatter, &fast.backscatter),
                (&plain.attenuation, &fast.attenuation),
            ] {
                assert_eq!((a.width(), a.height()), (b.width(), b.height()));
                for (x, y) in a.data().iter().zip(b.data()) {
                    assert!((x - y).abs() < 4e-6, "{x} against {y}");
                }
            }
        }
    }
}

#[test]
fn the_same_bits_on_any_number_of_threads() {
    let stream = Stream::new(4, Purpose::new("medium threads"), 0);
    let camera = camera(&stream, 70, 90);
    let lattice = Lattice::full(&camera.intrinsics);
    let d_maps = random_maps(&stream, 70, 90);
    for kind in [MediumKind::Rbf, MediumKind::Mlp, MediumKind::PerView] {
        let model = random_model(&stream, kind);
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let mut maps = MediumMaps::zeros(1, 1);
                model.maps(&camera, &lattice, 3, &mut maps);
                let mut gradient = model.zeros_like();
                model.backward(&camera, &lattice, 3, &maps, &d_maps, &mut gradient);
                (maps, gradient)
            })
        };
        let one = run(1);
        for threads in [2, 5] {
            assert!(one == run(threads), "{kind:?} differs on {threads} threads");
        }
    }
}

/// The start of the water (R5), by hand: anchors at the corners of the cube, the first axis slowest;
/// `σ = 0.85`, `ln σ = −0.1625189295`; in every direction `c_m = 0.5` and
/// `β = ln(1 + exp(−5 · 0.2820947918)) = 0.2183539`.
#[test]
fn the_start_is_that_of_the_method() {
    let rbf = MediumRbf::new(8, 4);
    assert_eq!(rbf.centers[..3], [[-1.0, -1.0, -1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, -1.0]]);
    assert_eq!((rbf.centers[4], rbf.centers[7]), ([1.0, -1.0, -1.0], [1.0; 3]));
    assert!(rbf.log_widths.iter().all(|l| (l + 0.162_518_93).abs() < 1e-6));
    let mut maps = MediumMaps::zeros(1, 1);
    let camera = camera(&Stream::new(3, Purpose::new("the start"), 0), 6, 5);
    MediumModel::Rbf(rbf).maps(&camera, &Lattice::full(&camera.intrinsics), 3, &mut maps);
    for (image, expected) in
        [(&maps.color, 0.5), (&maps.backscatter, 0.218_354_18), (&maps.attenuation, 0.218_354_18)]
    {
        assert!(image.data().iter().all(|v| (v - expected).abs() < 1e-6));
    }
}

/// Two anchors far narrower than the floor `σ = 1e-4`, at distances 1e-4 and 2e-4 of the camera: affinities
/// −1/2 and −2, so the nearer one has the share `1 / (1 + exp(−3/2)) = 0.8175744762`.
#[test]
fn widths_have_the_floor_of_the_method() {
    let mut rbf = MediumRbf::new(2, 2);
    rbf.log_widths = vec![-20.0; 2];
    rbf.centers = vec![[0.0, 2e-4, 0.0], [1e-4, 0.0, 0.0]];
    let mut camera = camera(&Stream::new(3, Purpose::new("a narrow anchor"), 0), 6, 5);
    camera.pose.translation = DVec3::ZERO;
    let shares = weights(&rbf, &camera);
    assert!((shares[1] - 0.817_574_476_2).abs() < 1e-5, "{shares:?}");
}

#[test]
fn anchor_weights_sum_to_one_over_at_most_k() {
    for seed in 0..20 {
        let stream = Stream::new(seed, Purpose::new("medium weights"), 0);
        let MediumModel::Rbf(rbf) = random_model(&stream, MediumKind::Rbf) else { unreachable!() };
        let weights = weights(&rbf, &camera(&stream, 8, 8));
        assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-12);
        assert!(weights.iter().filter(|&&w| w > 0.0).count() <= rbf.top_k);
    }
}

#[test]
fn tensors_come_back_and_damaged_ones_are_named() {
    let stream = Stream::new(6, Purpose::new("medium tensors"), 0);
    for &kind in MediumKind::ALL {
        let model = random_model(&stream, kind);
        let tensors = model.to_tensors();
        assert_eq!(MediumModel::from_tensors(kind, 3, &tensors).unwrap(), model);
        assert_eq!(MediumKind::from_name(kind.name()), Some(kind));
        for name in tensors.keys() {
            let mut damaged = tensors.clone();
            damaged.get_mut(name).unwrap().values[0] = f32::NAN;
            let error = MediumModel::from_tensors(kind, 3, &damaged).unwrap_err().to_string();
            assert!(error.contains(name.as_str()), "{error}");
            damaged.get_mut(name).unwrap().shape.push(2);
            assert!(MediumModel::from_tensors(kind, 3, &damaged).is_err());
            damaged.remove(name);
            assert!(MediumModel::from_tensors(kind, 3, &damaged).is_err());
        }
    }
    let rbf = random_model(&stream, MediumKind::Rbf).to_tensors();
    assert!(MediumModel::from_tensors(MediumKind::Rbf, 6, &rbf).is_err());
    assert!(MediumModel::from_tensors(MediumKind::Rbf, 0, &rbf).is_err());
}
