//! Compares stage 2 with the processor's engine.

use use3d_atc::consensus::Targets;
use use3d_capture::{Appearance, Frame, Image, Lattice, MediumMaps, Pose};
use use3d_enhance::engine::{
    CpuFieldEngine, FieldEngine, FieldPlan, FieldReport, FieldState, Reading, Reference, References,
};
use use3d_enhance::{EnhanceParams, EnhanceView, Guidance, Objective, PseudoLabels, ViewErrors};
use use3d_medium::{MediumKind, MediumModel, MediumStart};
use use3d_numerics::random::{Purpose, Stream};
use use3d_scene::Scene;
use use3d_splat::{Options, Prepared, Rasterizer, Rendered};
use use3d_training::{Drain, EngineError, Silent};
use use3d_ubaf::{Field, ObjectPass, ViewWater, WaterPass};

use super::{Stage2, initial_field};
use crate::test_support::{camera, cloud, relative, same_bits_elsewhere, software};
use crate::twins::{self, Waves};

const WIDTH: usize = 56;
const HEIGHT: usize = 44;

fn views() -> Vec<EnhanceView> {
    let view = |i: usize| {
        let mut camera = camera(WIDTH, HEIGHT);
        camera.pose = Pose::look_at(
            glam::DVec3::new(0.3 * i as f64 - 0.3, 0.1, -0.4),
            glam::DVec3::new(0.0, 0.1, 3.0),
            -glam::DVec3::Y,
        );
        EnhanceView { name: format!("{i}.png"), camera }
    };
    (0..3).map(view).collect()
}

fn scene(n: usize, kind: MediumKind) -> Scene {
    let mut medium =
        MediumModel::start(kind, &MediumStart { anchors: 5, top_k: 3, seed: 4, views: Vec::new() }).unwrap();
    let stream = Stream::new(9, Purpose::new("water for stage 2"), 0);
    let values: Vec<f32> = (0..).zip(medium.flat()).map(|(i, v)| v + 0.1 * stream.normal(i) as f32).collect();
    assert!(medium.set_flat(&values));
    let gaussians = cloud(n, -2.5, 0.5);
    Scene { gaussians, frame: Frame::IDENTITY, medium, medium_degree: 3, enhancement: None }
}

fn targets(scene: &Scene, appearance: Appearance) -> Targets {
    twins::targets(scene.gaussians.len(), &views(), appearance)
}

fn params() -> EnhanceParams {
    EnhanceParams { sample_side: 24, centre_sample: 100, seed: 3, ..EnhanceParams::default() }
}

fn moved(scene: &Scene, guidance: Guidance<'_>, params: &EnhanceParams) -> Field {
    twins::moved(scene, guidance, params).unwrap()
}

fn plan(step: u64) -> FieldPlan {
    FieldPlan { step, rate: 1e-3, transport_rate: 2e-4 }
}

/// Compares groups of arrays in the layout of the field's parameters.
fn compare(what: &str, field: &Field, ours: &[f32], cpu: &[f32], bar: f64) {
    for (name, range) in twins::groups(field) {
        let error = relative(&ours[range.clone()], &cpu[range]);
        // The guide has four sums over all lookups, of gradients with either sign.
        let bar = if name == "guide" { 2.0 * bar } else { bar };
        assert!(error <= bar, "{what}: {name} off by {error:.1e}");
    }
}

/// The reference with which the processor compares view `index`.
fn reference(scene: &Scene, guidance: Guidance<'_>, params: &EnhanceParams, index: usize) -> Reference {
    let view = &views()[index];
    let mut references = References::new(scene, guidance, params.sample_side);
    let lattice = references.lattice(&view.camera).unwrap();
    let draw = |rasterizer: &mut Rasterizer, image: &mut Image| {
        let (mut colors, mut prepared, mut rendered) = (Vec::new(), Prepared::new(), Rendered::new());
        scene.project(&view.camera, &lattice, |_| (), &mut colors, &mut prepared);
        let mut maps = MediumMaps::zeros(0, 0);
        // As the processor's engine draws it, to the last bit: the extractor amplifies differences.
        rasterizer.trim(&mut prepared);
        let shown = guidance.look_through(scene, &view.camera, &lattice, &mut maps);
        rasterizer.forward(&prepared, shown.then_some(&maps), &Options::default(), &mut rendered);
        std::mem::swap(image, &mut rendered.image);
    };
    references.of(index, view, draw, None).unwrap()
}

/// Runs steps from the processor's states, each judged alone: as a whole, and the device's part with the
/// processor's gradient of the image. The extractor's gradient amplifies the last digits of a render a
/// hundredfold.
fn teacher_forced(scene: &Scene, guidance: Guidance<'_>, params: &EnhanceParams) {
    let Some(gpu) = software() else { return };
    let views = views();
    let mut cpu = CpuFieldEngine::new(scene, &views, guidance, params, &mut Silent).unwrap();
    let mut ours = Stage2::new(&gpu, scene, &views, guidance, params, &mut Silent).unwrap();
    let mut field = moved(scene, guidance, params);
    for step in 0..4 {
        let view = (step % 3) as usize;
        // The moments belong to this step only: the first ones are the gradient times a constant.
        let start = FieldState::new(&field);
        cpu.load(start.clone()).unwrap();
        ours.load(start.clone()).unwrap();
        ours.drawing.device.poison(&gpu);
        ours.drawing.compositor.poison(&gpu);
        cpu.step(view, &plan(step)).unwrap();
        ours.step(view, &plan(step)).unwrap();
        assert!(relative(ours.drawing.image.data(), cpu.rendered().image.data()) <= 1e-5);
        let (found, expected) = (ours.drain(Drain::All).unwrap(), cpu.drain(Drain::All).unwrap());
        let ([found], [expected]) = (&found[..], &expected[..]) else { panic!("one report each") };
        assert_eq!((found.step, found.view, found.non_finite), (step, view, None));
        let (a, b) = (&found.losses, &expected.losses);
        assert!((a.total - b.total).abs() <= 1e-5 * b.total, "{found:?} {expected:?}");
        for (a, b) in a.values.iter().zip(&b.values) {
            assert_eq!(a.is_some(), b.is_some(), "{found:?} {expected:?}");
            let (a, b) = (a.unwrap_or_default(), b.unwrap_or_default());
            assert!((a.loss - b.loss).abs() <= 1e-5 * b.loss, "{found:?} {expected:?}");
            assert!((a.error - b.error).abs() <= 1e-5 * b.error, "{found:?} {expected:?}");
        }
        let expected = cpu.save().unwrap();
        compare("whole step", &field, &ours.save().unwrap().first, &expected.first, 1e-3);
        let mut d_image = Image::new(0, 0);
        let (reference, drawn) = (reference(scene, guidance, params, view), &cpu.rendered().image);
        ours.measure.losses(&reference, &ours.goals, drawn, Some(&mut d_image)).unwrap();
        ours.load(start).unwrap();
        let frozen = ours.kept.get(view).unwrap();
        ours.drawing.draw(frozen, Some(&plan(step))).unwrap();
        ours.drawing.learn(frozen, &ours.goals, &d_image).unwrap();
        let found = ours.save().unwrap();
        compare("gradient", &field, &found.first, &expected.first, 1e-5);
        compare("its square", &field, &found.second, &expected.second, 2e-5);
        field.parameters = expected.parameters;
    }
    for reading in [Reading::Sampled, Reading::Whole] {
        let start = FieldState::new(&field);
        cpu.load(start.clone()).unwrap();
        ours.load(start).unwrap();
        let (a, b) = (ours.evaluate(1, reading).unwrap(), cpu.evaluate(1, reading).unwrap());
        let error = |e: ViewErrors| {
            let loss = || e.of("pixels").unwrap_or_default().loss;
            e.of("global").map_or_else(loss, |global| global.error)
        };
        assert!((error(a) - error(b)).abs() <= 1e-5 * error(b), "{a:?} {b:?}");
        assert!(relative(&ours.centre().unwrap(), &cpu.centre().unwrap()) <= 1e-5);
    }
    assert_eq!(ours.coverage(), cpu.coverage());
}

#[test]
fn every_step_in_water_is_the_processors() {
    let scene = scene(300, MediumKind::Rbf);
    let targets = targets(&scene, Appearance::Water);
    teacher_forced(&scene, Guidance::Targets(&targets), &params());
    // With every pixel that the extractor weighs, and a mean over all Gaussians.
    let whole = EnhanceParams { sample_side: 0, centre_sample: 0, ..params() };
    teacher_forced(&scene, Guidance::Targets(&targets), &whole);
}

/// Clear radiance, water that is a network, pseudo-labels, and fields of other sizes.
#[test]
fn every_step_elsewhere_is_the_processors() {
    let scene = scene(300, MediumKind::Mlp);
    let clear = targets(&scene, Appearance::Clear);
    let small = EnhanceParams { resolution: 2, rank: 1, width: 5, ..params() };
    teacher_forced(&scene, Guidance::Targets(&clear), &small);
    let params = EnhanceParams { resolution: 20, rank: 16, width: 130, ..params() };
    let water = targets(&scene, Appearance::Water);
    teacher_forced(&scene, Guidance::Targets(&water), &params);
    let params = EnhanceParams { objective: Objective::PseudoLabels, rank: 3, ..params };
    let labels = PseudoLabels::new(&Waves { width: WIDTH, height: HEIGHT }, &views(), &params).unwrap();
    teacher_forced(&scene, Guidance::Labels(&labels), &params);
}

/// Compares the field's own kernels with the corresponding functions.
#[test]
fn the_field_is_the_processors_at_every_count_of_lookups() {
    let Some(gpu) = software() else { return };
    for (n, rank, width) in [(1, 8, 64), (63, 1, 65), (64, 16, 3), (65, 8, 64), (700, 5, 200)] {
        let scene = scene(n, MediumKind::Rbf);
        let targets = targets(&scene, Appearance::Water);
        let guidance = Guidance::Targets(&targets);
        let params = EnhanceParams { rank, width, centre_sample: 0, ..params() };
        let (views, field) = (views(), moved(&scene, guidance, &params));
        let mut ours = Stage2::new(&gpu, &scene, &views, guidance, &params, &mut Silent).unwrap();
        ours.load(FieldState::new(&field)).unwrap();
        let view = ours.kept.get(1).unwrap();
        ours.drawing.draw(view, None).unwrap();
        let g = &scene.gaussians;
        let mut pass = ObjectPass::new(&field, &g.means, g.sh.iter().map(|sh| sh[0]));
        pass.forward(&field);
        let raw = ours.drawing.device.raw.read(&gpu, 6 * n).unwrap();
        let expected = pass.locals([0.0; 6]);
        let error = relative(&raw, expected.as_flattened());
        assert!(error <= 1e-5, "{n} lookups: outputs off by {error:.1e}");
        let mean = ours.drawing.device.grade.read(&gpu, 6).unwrap();
        assert!(relative(&mean, &pass.mean) <= 1e-5, "{n} lookups: {mean:?} {:?}", pass.mean);
        let camera = views[1].camera;
        let lattice: &Lattice = &ours.views[1].lattice;
        let (mut maps, mut enhanced) = (MediumMaps::zeros(0, 0), MediumMaps::zeros(0, 0));
        assert!(scene.look_through(&camera, lattice, &mut maps));
        let center = camera.pose.center().as_vec3().to_array();
        WaterPass::default().forward(&field, center, &ViewWater::new(maps), 1.0, &mut enhanced);
        let color = ours.drawing.device.water.read(&gpu, 3 * view.pixels()).unwrap();
        let error = relative(&color, enhanced.color.data());
        assert!(error <= 1e-5, "{n} lookups: the water's colour off by {error:.1e}");
    }
}

fn mean(reports: &[FieldReport]) -> f64 {
    reports.iter().map(|r| r.losses.total).sum::<f64>() / reports.len() as f64
}

fn run(engine: &mut dyn FieldEngine, steps: std::ops::Range<u64>) -> Vec<FieldReport> {
    for step in steps {
        engine.step((step % 3) as usize, &plan(step)).unwrap();
    }
    engine.drain(Drain::All).unwrap()
}

#[test]
fn a_hundred_steps_on_its_own_go_where_the_processors_go_and_runs_change_engines() {
    let Some(gpu) = software() else { return };
    let scene = scene(200, MediumKind::Rbf);
    let targets = targets(&scene, Appearance::Water);
    let (guidance, params, views) = (Guidance::Targets(&targets), params(), views());
    let mut cpu = CpuFieldEngine::new(&scene, &views, guidance, &params, &mut Silent).unwrap();
    let mut ours = Stage2::new(&gpu, &scene, &views, guidance, &params, &mut Silent).unwrap();
    let start = FieldState::new(&initial_field(&scene, guidance, &params).unwrap());
    cpu.load(start.clone()).unwrap();
    ours.load(start).unwrap();
    let (a, b) = (run(&mut ours, 0..100), run(&mut cpu, 0..100));
    assert_eq!((a.len(), b.len()), (100, 100));
    let (first, last, cpu_last) = (mean(&a[..20]), mean(&a[80..]), mean(&b[80..]));
    assert!(last < 0.9 * first && (last - cpu_last).abs() < 1e-3 * cpu_last, "{first} {last} {cpu_last}");
    // A state moves from the card to the processor and back.
    let (of_ours, of_cpu) = (ours.save().unwrap(), cpu.save().unwrap());
    cpu.load(of_ours).unwrap();
    ours.load(of_cpu).unwrap();
    let (a, b) = (run(&mut ours, 100..106), run(&mut cpu, 100..106));
    assert!((mean(&a) - mean(&b)).abs() < 2e-3 * mean(&b), "{} {}", mean(&a), mean(&b));
}

/// The state after a few steps with this much memory for views.
fn state_after_steps(gpu: &crate::Gpu, cache_mib: usize) -> (FieldState, Vec<FieldReport>, usize) {
    state_of(gpu, &scene(200, MediumKind::Rbf), cache_mib)
}

/// The state after a few steps on any scene.
fn state_of(gpu: &crate::Gpu, scene: &Scene, cache_mib: usize) -> (FieldState, Vec<FieldReport>, usize) {
    let targets = targets(scene, Appearance::Water);
    let (guidance, views) = (Guidance::Targets(&targets), views());
    let params = EnhanceParams { cache_mib, ..params() };
    let mut ours = Stage2::new(gpu, scene, &views, guidance, &params, &mut Silent).unwrap();
    ours.load(FieldState::new(&moved(scene, guidance, &params))).unwrap();
    let reports = run(&mut ours, 0..5);
    (ours.save().unwrap(), reports, ours.coverage().views_in_memory)
}

#[test]
fn views_that_are_made_again_give_the_same_bytes() {
    let Some(gpu) = software() else { return };
    let (kept, again) = (state_after_steps(&gpu, 64), state_after_steps(&gpu, 0));
    assert_eq!((kept.2, again.2), (3, 0));
    assert!(kept.0 == again.0 && kept.1 == again.1);
}

/// More Gaussians than one binding can hold the colours of.
#[test]
fn gaussians_in_several_chunks_are_enhanced_as_in_one() {
    let Some(gpu) = software() else { return };
    let mut scene = scene(10, MediumKind::Rbf);
    scene.gaussians = cloud(4500, -4.5, 0.5);
    // 2,083 Gaussians per chunk.
    let tight = gpu.clone().binding(400_000);
    assert_eq!(tight.gaussians_of_chunk(), 2083);
    let (one, several) = (state_of(&gpu, &scene, 64), state_of(&tight, &scene, 64));
    assert!(one.0 == several.0 && one.1 == several.1);
}

#[test]
fn what_is_not_finite_is_named_and_stops_the_steps_after_it() {
    let Some(gpu) = software() else { return };
    let scene = scene(50, MediumKind::None);
    let targets = targets(&scene, Appearance::Clear);
    let (guidance, params, views) = (Guidance::Targets(&targets), params(), views());
    let mut ours = Stage2::new(&gpu, &scene, &views, guidance, &params, &mut Silent).unwrap();
    let mut broken = FieldState::new(&moved(&scene, guidance, &params));
    broken.first[70] = f32::NAN;
    ours.load(broken).unwrap();
    let reports = run(&mut ours, 0..3);
    assert_eq!(reports.len(), 1);
    assert_eq!(reports[0].non_finite, Some(("parameter", Some(70))));
    let mut broken = FieldState::new(&moved(&scene, guidance, &params));
    broken.parameters[initial_field(&scene, guidance, &params).unwrap().shape().affine().start] =
        f32::INFINITY;
    ours.load(broken).unwrap();
    let reports = run(&mut ours, 0..3);
    assert_eq!((reports.len(), reports[0].step), (1, 0));
    assert!(reports[0].non_finite.is_some(), "{reports:?}");
    let error = ours.step(7, &plan(0)).unwrap_err().to_string();
    assert!(error.contains("no view 7, only 3"), "{error}");
}

#[test]
fn a_lost_device_is_told_by_the_next_step() {
    let Some(gpu) = software() else { return };
    let scene = scene(50, MediumKind::None);
    let targets = targets(&scene, Appearance::Clear);
    let (guidance, params, views) = (Guidance::Targets(&targets), params(), views());
    let mut ours = Stage2::new(&gpu, &scene, &views, guidance, &params, &mut Silent).unwrap();
    ours.load(FieldState::new(&moved(&scene, guidance, &params))).unwrap();
    ours.step(0, &plan(0)).unwrap();
    gpu.lose();
    let error = ours.step(1, &plan(1)).unwrap_err();
    assert!(matches!(error, EngineError::DeviceLost { .. }), "{error}");
}

/// Prints a digest of a few steps, which [`bits_do_not_depend_on_threads_or_widths`] reads from another
/// process.
#[test]
fn digest_of_a_few_steps() {
    let Some(gpu) = software() else { return };
    let digest = || {
        let (state, reports, _) = state_after_steps(&gpu, 64);
        blake3::hash(format!("{state:?}{reports:?}").as_bytes()).to_hex().to_string()
    };
    let first = digest();
    assert_eq!(first, digest(), "two runs differ");
    println!("\ndigest {first}");
}

#[test]
fn bits_do_not_depend_on_threads_or_widths() {
    if software().is_some() {
        same_bits_elsewhere("stage2::tests::digest_of_a_few_steps");
    }
}

/// Composing from stored weights gives the bits of composing tile by tile, in water and without.
#[test]
fn stored_weights_change_no_bit() {
    let Some(gpu) = software() else { return };
    for kind in [MediumKind::Rbf, MediumKind::None] {
        let scene = scene(300, kind);
        let with = state_of(&gpu, &scene, 64);
        super::weights::MOST_IN_TESTS.set(0);
        let without = state_of(&gpu, &scene, 64);
        super::weights::MOST_IN_TESTS.set(super::weights::MOST);
        assert!(with.0 == without.0 && with.1 == without.1);
    }
}
