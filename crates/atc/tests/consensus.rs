//! Compares the consensus with the golden cases, and checks its exact properties.

use glam::DVec3;
use use3d_atc::AtcError;
use use3d_atc::calibrator::Calibrator;
use use3d_atc::consensus::{
    Lift, LocalConsensus, Proposals, Recorder, Targets, TargetsParams, TargetsReport, ViewInput, ViewRecord,
    apply_transition, fuse_views, global_consensus, order_effect, refit, response, support_map,
    targets_from_records, view_target,
};
use use3d_atc::extractor::{Affine, Descriptors, ExtractorSettings, Form, Transition};
use use3d_atc::progress::unwatched;
use use3d_atc::proposers::{Fusion, Proposer, ProposerId};
use use3d_capture::{Appearance, Camera, Image, Intrinsics, KeptWater, Pose};
use use3d_golden::{Case, CaseGaussians, Part};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::{Gaussians, Rasterizer};

fn affines(case: &Case<'_>, tensor: &str) -> Vec<Affine> {
    case.f64(tensor).chunks_exact(12).map(|c| c.try_into().expect("twelve numbers")).collect()
}

#[test]
fn golden_scene_operator() {
    let mut checked = 0;
    for case in Part::math("consensus").cases() {
        if !case.has("in.ts") {
            continue;
        }
        let candidates = affines(&case, "in.ts");
        let responses: Vec<f64> = candidates.iter().flat_map(response).collect();
        case.check_f64("out.responses", &responses);
        let found = global_consensus(&candidates).unwrap();
        case.check_f64("out.t_scene", &found.operator);
        case.check_f64("out.median", &response(&found.operator));
        checked += 1;
    }
    assert!(checked > 0, "no case with candidates");
}

fn golden_scene(case: &Case<'_>) -> (Gaussians, Vec<Camera>) {
    let CaseGaussians { means, log_scales, quaternions, opacity_logits, .. } = case.gaussians();
    let sh = vec![[[0.0; 3]; 16]; means.len()];
    let gaussians = Gaussians { sh_degree: 0, means, log_scales, quaternions, opacity_logits, sh };
    let cameras = case.cameras();
    (gaussians, cameras)
}

#[test]
fn golden_lifting_fusion_and_view_targets() {
    let mut checked = 0;
    for case in Part::math("consensus").cases() {
        if !case.has("in.grids") {
            continue;
        }
        checked += 1;
        let (gaussians, cameras) = golden_scene(&case);
        let shape = case.shape("in.grids").to_vec();
        let grid = (shape[2], shape[1]);
        let flat = case.f64("in.grids");
        let grids: Vec<Vec<[f64; 6]>> = flat
            .chunks_exact(grid.0 * grid.1 * 6)
            .map(|g| g.chunks_exact(6).map(|c| c.try_into().expect("six numbers")).collect())
            .collect();
        let scales: [f64; 6] = case.f64("in.s_local").try_into().expect("six scales");
        let mut lift = Lift::new(&gaussians);
        let mut fuse = |order: &[usize], keep: &mut dyn FnMut(f32, [f32; 6])| {
            let mut state = LocalConsensus::new(gaussians.len());
            for &v in order {
                lift.run(&cameras[v], grid, &grids[v]).unwrap();
                for i in 0..gaussians.len() {
                    let (omega, observed) = lift.observation(i);
                    keep(omega, observed);
                }
                state.fuse(&lift, &scales);
            }
            state
        };
        let (mut omegas, mut lifted) = (Vec::new(), Vec::new());
        let forward: Vec<usize> = (0..cameras.len()).collect();
        let state = fuse(&forward, &mut |omega, observed| {
            omegas.push(omega);
            lifted.extend(observed);
        });
        case.check("out.omega", &omegas);
        case.check("out.lifted", &lifted);
        case.check("out.mu", state.mean.as_flattened());
        case.check("out.weight", &state.weight);
        let counts: Vec<f64> = state.count.iter().map(|&c| f64::from(c)).collect();
        case.check_within("out.count", &counts, 0.0);
        let support: Vec<f64> =
            (0..gaussians.len()).map(|i| f64::from(u8::from(state.supported(i)))).collect();
        case.check_f64("out.support", &support);
        let reversed: Vec<usize> = forward.iter().rev().copied().collect();
        let other = fuse(&reversed, &mut |_, _| {});
        case.check("out.mu_reversed", other.mean.as_flattened());

        let target_grid = {
            let shape = case.shape("out.W");
            (shape[1], shape[0])
        };
        let camera = &cameras[case.count("target_view")];
        let seen = view_target(&gaussians, &state, camera, target_grid, &mut Rasterizer::new());
        case.check_f64("out.target", seen.local.as_flattened());
        case.check_f64("out.W", &seen.weight);
    }
    assert!(checked > 0, "no case with grids");
}

/// Records whose local operators have any mean give the golden numbers of the centred ones: the golden grids
/// are centred, here each view's grid and the head add a constant, and the constants must vanish.
#[test]
fn golden_lifting_from_records_whose_operators_are_not_centred() {
    let mut checked = 0;
    for case in Part::math("consensus").cases() {
        if !case.has("in.grids") {
            continue;
        }
        checked += 1;
        let (gaussians, cameras) = golden_scene(&case);
        let shape = case.shape("in.grids").to_vec();
        let grids = case.f64("in.grids");
        let mut calibrator = Calibrator::identity(ExtractorSettings::default(), Fusion.id());
        calibrator.local.residual.range = case.f32("in.s_local");
        calibrator.local.residual.median = vec![0.75, -1.5, 0.5, 2.0, -0.25, 1.0];
        let records: Vec<ViewRecord> = cameras
            .iter()
            .zip(grids.chunks_exact(6 * shape[1] * shape[2]))
            .enumerate()
            .map(|(v, (camera, grid))| {
                let local: Vec<[f64; 6]> = grid
                    .chunks_exact(6)
                    .map(|c| std::array::from_fn(|k| c[k] + 0.5 * (v as f64 - 1.0) * (k as f64 + 1.0)))
                    .collect();
                let descriptors = Descriptors { global: [0.1; 18], local: vec![[0.2; 6]; local.len()] };
                ViewRecord {
                    name: format!("view {v}"),
                    camera: *camera,
                    grid: (shape[2], shape[1]),
                    descriptors,
                    proposal: Transition { global: [0.3; 12], local },
                    candidate: [0.1 * v as f64; 12],
                }
            })
            .collect();
        let (targets, report) = targets_from_records(
            &mut Lift::new(&gaussians),
            &records,
            (Appearance::Water, KeptWater::ALL),
            Fusion.id(),
            &calibrator,
            &TargetsParams::default(),
            &mut unwatched,
        )
        .unwrap();
        case.check("out.mu", targets.state.mean.as_flattened());
        case.check("out.weight", &targets.state.weight);
        let counts: Vec<f64> = targets.state.count.iter().map(|&c| f64::from(c)).collect();
        case.check_within("out.count", &counts, 0.0);
        // sqrt(mean((grid / max(s, 1e-4))²)) of the golden grid itself.
        let scales: Vec<f64> = case.f32("in.s_local").iter().map(|&s| f64::from(s).max(1e-4)).collect();
        for (view, grid) in report.views.iter().zip(grids.chunks_exact(6 * shape[1] * shape[2])) {
            let squares = grid.iter().enumerate().map(|(i, v)| (v / scales[i % 6]) * (v / scales[i % 6]));
            let expected = (squares.sum::<f64>() / grid.len() as f64).sqrt();
            assert!((view.local / expected - 1.0).abs() < 1e-6, "{} for {expected}", view.local);
        }
    }
    assert!(checked > 0, "no case with grids");
}

#[test]
fn one_outlier_of_ten_hardly_moves_the_scene() {
    let stream = Stream::new(4, Purpose::new("candidates"), 0);
    let mut candidates: Vec<Affine> =
        (0..10).map(|v| std::array::from_fn(|k| 0.1 + 0.02 * stream.normal((12 * v + k) as u64))).collect();
    let before = global_consensus(&candidates[..9]).unwrap();
    for far in [1.0, 10.0, 1000.0] {
        candidates[9] = std::array::from_fn(|k| far * (1.0 + 0.1 * k as f64));
        let after = global_consensus(&candidates).unwrap();
        let norm = |a: &[f64], b: &[f64]| -> f64 {
            a.iter().zip(b).map(|(x, y)| math::powi(x - y, 2)).sum::<f64>().sqrt()
        };
        let moved = norm(&response(&after.operator), &response(&before.operator));
        let distance = norm(&response(&candidates[9]), &response(&before.operator));
        assert!(moved < 0.05 * distance, "{moved} of {distance}");
        assert!((after.distances[9] / distance - 1.0).abs() < 0.05 && after.dispersion < 0.5);
    }
    assert!(global_consensus(&[]).is_none());
}

#[test]
fn refitting_the_responses_of_an_operator_returns_it() {
    let stream = Stream::new(5, Purpose::new("operators"), 0);
    for case in 0..20 {
        let t: Affine = std::array::from_fn(|k| stream.normal(12 * case + k as u64));
        for (a, b) in refit(&response(&t)).iter().zip(t) {
            assert!((a - b).abs() < 1e-12);
        }
    }
}

/// A wall of Gaussians at depth 4, and cameras along a line in front of it.
fn wall(count: usize, views: usize, size: (usize, usize)) -> (Gaussians, Vec<Camera>) {
    let stream = Stream::new(7, Purpose::new("wall"), 0);
    let mut gaussians = Gaussians::empty(0);
    for i in 0..count as u64 {
        let u = |k: u64| stream.uniform(8 * i + k) as f32;
        gaussians.means.push([6.0 * u(0) - 3.0, 4.0 * u(1) - 2.0, 3.5 + u(2)]);
        gaussians.log_scales.push([-2.0 + u(3), -2.0 + u(4), -2.0 + u(5)]);
        gaussians.quaternions.push([1.0, u(6), 0.3, u(7)]);
        gaussians.opacity_logits.push(4.0 * u(0) - 1.0);
        gaussians.sh.push([[0.2; 3]; 16]);
    }
    let (w, h) = size;
    let intrinsics = Intrinsics {
        width: w,
        height: h,
        fx: w as f64,
        fy: w as f64,
        cx: w as f64 / 2.0,
        cy: h as f64 / 2.0,
    };
    let cameras = (0..views)
        .map(|v| {
            let eye = DVec3::new(0.3 * v as f64 - 0.5, 0.1 * v as f64, -0.2);
            Camera { intrinsics, pose: Pose::look_at(eye, DVec3::new(0.0, 0.0, 4.0), -DVec3::Y) }
        })
        .collect();
    (gaussians, cameras)
}

#[test]
fn a_constant_map_is_lifted_and_splatted_back_as_that_constant() {
    let (gaussians, cameras) = wall(300, 4, (90, 60));
    let constant = [0.3, -0.1, 0.2, 0.05, -0.02, 0.4];
    let cells = vec![constant; 16 * 11];
    let mut lift = Lift::new(&gaussians);
    let mut state = LocalConsensus::new(gaussians.len());
    for camera in &cameras {
        lift.run(camera, (16, 11), &cells).unwrap();
        state.fuse(&lift, &[1.0; 6]);
    }
    let mut supported = 0;
    for i in 0..gaussians.len() {
        if state.count[i] > 0 {
            for k in 0..6 {
                assert!((f64::from(state.mean[i][k]) - constant[k]).abs() < 2e-5);
            }
        }
        supported += usize::from(state.supported(i));
    }
    assert!(supported > 200, "{supported}");
    let mut rasterizer = Rasterizer::new();
    let seen = view_target(&gaussians, &state, &cameras[1], (16, 11), &mut rasterizer);
    let mut covered = 0;
    for (cell, &weight) in seen.local.iter().zip(&seen.weight) {
        if weight > 0.5 {
            covered += 1;
            // A cell next to a hole mixes the constant with pixels that show nothing.
            assert!((0..6).all(|k| cell[k].abs() <= constant[k].abs() + 1e-5));
        }
    }
    assert!(covered > 20, "{covered}");
    let map = support_map(&gaussians, &state, &cameras[1], &mut rasterizer);
    assert!(map.data().iter().all(|v| (0.0..=1.0).contains(v)));
    assert!(map.data().iter().any(|&v| v > 0.9));
}

#[test]
fn splatting_only_the_pixels_read_gives_what_the_whole_view_gives() {
    let (gaussians, cameras) = wall(200, 3, (120, 83));
    let stream = Stream::new(3, Purpose::new("maps"), 0);
    let mut lift = Lift::new(&gaussians);
    let mut state = LocalConsensus::new(gaussians.len());
    for (v, camera) in cameras.iter().enumerate() {
        let cells: Vec<[f64; 6]> = (0..16 * 11)
            .map(|c| std::array::from_fn(|k| stream.normal((v * 2000 + c * 6 + k) as u64)))
            .collect();
        lift.run(camera, (16, 11), &cells).unwrap();
        state.fuse(&lift, &[0.1; 6]);
    }
    let camera = &cameras[0];
    let (w, h) = (120, 83);
    let mut rasterizer = Rasterizer::new();
    let seen = view_target(&gaussians, &state, camera, (16, 11), &mut rasterizer);
    let support = support_map(&gaussians, &state, camera, &mut rasterizer);
    // The plain computation: bilinear samples of the whole support map.
    for (cell, &weight) in seen.weight.iter().enumerate() {
        let at = |i: usize, n_in: usize, n_out: usize| {
            let x = ((i as f64 + 0.5) * n_in as f64 / n_out as f64 - 0.5).max(0.0);
            let low = x.floor() as usize;
            (low, (low + 1).min(n_in - 1), x - low as f64)
        };
        let (x0, x1, fx) = at(cell % 16, w, 16);
        let (y0, y1, fy) = at(cell / 16, h, 11);
        let s = |x: usize, y: usize| f64::from(support.pixel(x, y)[0]);
        let top = s(x0, y0) * (1.0 - fx) + s(x1, y0) * fx;
        let bottom = s(x0, y1) * (1.0 - fx) + s(x1, y1) * fx;
        assert!((top * (1.0 - fy) + bottom * fy - weight).abs() < 1e-5);
    }
}

fn photograph(width: usize, height: usize, seed: u64) -> Image {
    let stream = Stream::new(seed, Purpose::new("photograph"), 0);
    let mut image = Image::new(width, height);
    for y in 0..height {
        for x in 0..width {
            let noise = stream.uniform((y * width + x) as u64) as f32;
            let v = 0.4
                + 0.2 * math::sin(x as f32 * 0.2 + seed as f32 * 0.3) * math::cos(y as f32 * 0.13)
                + 0.1 * noise;
            image.set_pixel(x, y, [0.3 * v, 0.8 * v, v]);
        }
    }
    image
}

fn inputs(cameras: &[Camera]) -> impl Iterator<Item = Result<ViewInput, AtcError>> {
    cameras.iter().enumerate().map(|(v, camera)| {
        let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
        Ok(ViewInput {
            name: format!("view {v}"),
            camera: *camera,
            image: photograph(w, h, v as u64),
            proposal: None,
        })
    })
}

/// Builds the targets of a scene from photographs.
fn build_targets(
    gaussians: &Gaussians,
    views: impl IntoIterator<Item = Result<ViewInput, AtcError>>,
    proposals: Proposals<'_>,
    calibrator: &Calibrator,
    params: &TargetsParams,
) -> Result<(Targets, TargetsReport), AtcError> {
    calibrator.proposer.require(&proposals.id())?;
    let mut recorder = Recorder::default();
    let mut records = Vec::new();
    for view in views {
        records.push(recorder.record(&view?, proposals, calibrator)?);
    }
    let lift = &mut Lift::new(gaussians);
    let shown = (Appearance::Water, KeptWater::ALL);
    targets_from_records(lift, &records, shown, proposals.id(), calibrator, params, &mut unwatched)
}

#[test]
fn targets_of_a_small_scene_are_whole_deterministic_and_survive_their_file() {
    let (gaussians, cameras) = wall(300, 5, (96, 64));
    let calibrator = Calibrator::identity(ExtractorSettings::default(), Fusion.id());
    let params = TargetsParams { measure_order: true, ..TargetsParams::default() };
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let proposals = Proposals::From(&Fusion);
            build_targets(&gaussians, inputs(&cameras), proposals, &calibrator, &params).unwrap()
        })
    };
    let (targets, report) = run(1);
    assert_eq!((targets.clone(), report.clone()), run(3));
    assert_eq!((report.views.len(), report.gaussians), (5, 300));
    assert!(report.supported > 200);
    let order = report.order.unwrap();
    assert_eq!(order.compared, report.supported);
    // With an identity calibrator each candidate is the proposal's own operator.
    let bytes = targets.to_bytes().unwrap();
    assert_eq!(bytes, targets.to_bytes().unwrap());
    let back = Targets::from_bytes(&bytes).unwrap();
    assert_eq!(back, targets);
    assert!(Targets::from_bytes(&bytes[..bytes.len() - 3]).is_err());
    assert!(Calibrator::from_bytes(&bytes).unwrap_err().to_string().contains("format"));
    let seen = back.view_target(&gaussians, &cameras[2], &mut Rasterizer::new()).unwrap();
    assert_eq!(seen.grid, (16, 11));
    let other = gaussians.select(&[0, 1, 2]);
    assert!(back.view_target(&other, &cameras[2], &mut Rasterizer::new()).is_err());
}

#[test]
fn the_same_order_has_no_order_effect_and_another_has_one() {
    let (gaussians, cameras) = wall(200, 5, (96, 64));
    let calibrator = Calibrator::identity(ExtractorSettings::default(), Fusion.id());
    let mut recorder = Recorder::default();
    let records: Vec<_> = inputs(&cameras)
        .map(|view| recorder.record(&view.unwrap(), Proposals::From(&Fusion), &calibrator).unwrap())
        .collect();
    let scene = [0.0; 12];
    let fuse = |order: &[usize]| {
        fuse_views(&mut Lift::new(&gaussians), &records, order, &calibrator, &scene, &mut unwatched).unwrap()
    };
    let (one, two) = (fuse(&[0, 1, 2, 3, 4]), fuse(&[4, 2, 0, 1, 3]));
    let same = order_effect(&one, &one, &[0.05; 6]);
    assert_eq!((same.percentile_95, same.within_tenth), (0.0, 1.0));
    let shuffled = order_effect(&one, &two, &[0.05; 6]);
    assert!(shuffled.percentile_95 > 0.0 && shuffled.compared > 100);
    assert_eq!(one.count, two.count);
}

#[test]
fn what_does_not_fit_is_named() {
    let (gaussians, cameras) = wall(20, 2, (48, 32));
    let other = ProposerId { name: "nu2net".into(), digest: "abc".into() };
    let calibrator = Calibrator::identity(ExtractorSettings::default(), other.clone());
    let build = |views: Vec<Result<ViewInput, AtcError>>, proposals: Proposals<'_>| {
        let params = TargetsParams::default();
        build_targets(&gaussians, views, proposals, &calibrator, &params).unwrap_err()
    };
    let mismatch = build(inputs(&cameras).collect(), Proposals::From(&Fusion)).to_string();
    assert!(mismatch.contains("nu2net") && mismatch.contains("fusion"), "{mismatch}");
    let given = Proposals::Given(&other);
    let missing = build(inputs(&cameras).collect(), given).to_string();
    assert!(missing.contains("view 0") && missing.contains("nu2net"), "{missing}");
    assert_eq!(build(Vec::new(), given), AtcError::NoViews);
    let mut wrong_size = inputs(&cameras).next().unwrap().unwrap();
    wrong_size.image = photograph(47, 32, 0);
    assert!(build(vec![Ok(wrong_size)], given).to_string().contains("47x32"));
}

#[test]
fn a_transition_is_applied_as_its_formula_says() {
    let image = photograph(12, 10, 3);
    let global: Affine = [0.2, -0.1, 0.05, 0.0, 0.3, 0.1, -0.2, 0.0, 0.1, 0.02, -0.03, 0.04];
    let cell = [0.3, -0.2, 0.1, 0.05, -0.04, 0.06];
    for (form, gain) in [(Form::Log, [0.3, -0.2, 0.1].map(math::exp)), (Form::Linear, [1.3, 0.8, 1.1])] {
        let all = apply_transition(&image, &global, (3, 2), &[cell; 6], form);
        let scene = apply_transition(&image, &global, (3, 2), &[], form);
        for (x, y) in [(0, 0), (11, 9), (5, 4), (3, 8)] {
            let c: [f64; 3] = image.pixel(x, y).map(f64::from);
            for k in 0..3 {
                let t = &global[4 * k..][..4];
                let wide = c[k] + t[0] * c[0] + t[1] * c[1] + t[2] * c[2] + t[3];
                let own = gain[k] * wide + cell[3 + k];
                let [wide_found, found] = [&scene, &all].map(|i| f64::from(i.pixel(x, y)[k]));
                assert!((wide_found - wide).abs() < 1e-6 && (found - own).abs() < 1e-6, "{k}: {own} {found}");
            }
        }
    }
}
