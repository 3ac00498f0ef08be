//! Tests the loop on a small scene: it starts at the identity, reaches its targets, repeats with the same
//! bits, and survives a kill.

mod common;

use common::{Labels, draw, mini, quick, targets, taught};
use use3d_atc::consensus::Targets;
use use3d_capture::{Appearance, KeptWater, Lattice};
use use3d_enhance::engine::{CpuFieldEngine, FieldEngine, FieldState, Reading};
use use3d_enhance::losses::TERMS;
use use3d_enhance::{
    EnhanceError, EnhanceOutcome, EnhanceParams, EnhanceView, Guidance, LogEntry, Objective, PixelLoss,
    PseudoLabels, Start,
};
use use3d_medium::{MediumGlobal, MediumModel};
use use3d_numerics::math;
use use3d_numerics::spherical_harmonics::C0;
use use3d_render::{Look, Renderer};
use use3d_scene::Scene;
use use3d_splat::Rendered;
use use3d_training::{Observer, Silent, TrainingProgress};

/// Enhances on the processor.
fn enhance(
    scene: &Scene,
    views: &[EnhanceView],
    guidance: Guidance<'_>,
    params: &EnhanceParams,
    checkpoints: Option<&std::path::Path>,
    observer: &mut dyn Observer,
) -> Result<EnhanceOutcome, EnhanceError> {
    let mut engine = CpuFieldEngine::new(scene, views, guidance, params, observer)?;
    use3d_enhance::enhance(scene, views, guidance, params, &mut engine, checkpoints, observer)
}

/// An observer that stops after some steps and stores its notices.
struct Watcher {
    stop_after: u64,
    seen: u64,
    notices: Vec<String>,
}

impl Watcher {
    fn new(stop_after: u64) -> Self {
        Self { stop_after, seen: 0, notices: Vec::new() }
    }
}

impl Observer for Watcher {
    fn progress(&mut self, progress: &TrainingProgress) {
        self.seen = progress.step;
    }

    fn notice(&mut self, message: &str) {
        self.notices.push(message.into());
    }

    fn should_stop(&self) -> bool {
        self.seen >= self.stop_after
    }
}

#[test]
fn it_starts_at_the_identity() {
    let (scene, views) = mini();
    let wanted = targets(&scene, &taught(&scene), &views);
    // Every pixel is sampled, so that the render can be compared with the whole view.
    let params = EnhanceParams { sample_side: 0, ..quick(1) };
    let mut engine =
        CpuFieldEngine::new(&scene, &views, Guidance::Targets(&wanted), &params, &mut Silent).unwrap();
    let rms = (wanted.scene.iter().map(|t| math::powi(t / 0.2, 2)).sum::<f64>() / 12.0).sqrt();
    for (index, view) in views.iter().enumerate() {
        let errors = engine.evaluate(index, Reading::Sampled).unwrap();
        // The realised operator is zero, so the error is the target itself.
        let error = errors.of("global").unwrap().error;
        assert!((error - rms).abs() < 1e-6, "{error} {rms}");
        let stage1 = draw(&scene, Look::Reconstruction, &view.camera);
        let plus = &engine.rendered().image;
        for (a, b) in plus.data().iter().zip(stage1.data()) {
            assert!((a - b).abs() < 1e-6, "{a} {b}");
        }
    }
}

#[test]
fn targets_that_ask_for_no_change_are_met_without_a_step() {
    let (scene, views) = mini();
    let mut wanted = targets(&scene, &taught(&scene), &views);
    assert!(!wanted.ask_for_no_change());
    wanted.scene = [0.0; 12];
    assert!(!wanted.ask_for_no_change(), "a local operator is left");
    wanted.state.mean.fill([0.0; 6]);
    let mut watcher = Watcher::new(u64::MAX);
    let outcome =
        enhance(&scene, &views, Guidance::Targets(&wanted), &quick(50), None, &mut watcher).unwrap();
    assert_eq!((watcher.seen, outcome.log.len()), (0, 0));
    for view in &views {
        let images = [Look::Reconstruction, Look::Enhanced { strength: 1.0 }]
            .map(|l| draw(&outcome.scene, l, &view.camera));
        assert!(images[0].data().iter().zip(images[1].data()).all(|(a, b)| (a - b).abs() < 1e-6));
    }
}

#[test]
fn losses_fall_and_the_realised_operators_reach_the_targets() {
    let (scene, views) = mini();
    let teacher = taught(&scene);
    let wanted = targets(&scene, &teacher, &views);
    let train: Vec<_> =
        views.iter().enumerate().filter(|(i, _)| i % 4 != 0).map(|(_, v)| v.clone()).collect();
    let run = |objective, steps| {
        let params = EnhanceParams { objective, ..quick(steps) };
        enhance(&scene, &train, Guidance::Targets(&wanted), &params, None, &mut Silent).unwrap()
    };
    let full = run(Objective::Full, 300);
    let (first, last) = (&full.log[0], &full.log[full.log.len() - 1]);
    let at = TERMS.iter().position(|row| row.name == "global").unwrap();
    let global = |line: &LogEntry| line.terms[at].loss;
    // The teacher's local part is too fine for the field's 16 nodes in so few steps; its global part is
    // not.
    assert!(last.loss < 0.5 * first.loss && global(last) < 0.1 * global(first), "{first:?} {last:?}");
    let (before, after) = full.report.errors("global").unwrap();
    assert!(after < 0.3 * before, "global {before} -> {after}");
    let (local_before, local_after) = full.report.errors("local").unwrap();
    assert!(local_after < 0.9 * local_before, "local {local_before} -> {local_after}");
    // Geometry, radiance and water are unchanged.
    assert_eq!(full.scene.gaussians, scene.gaussians);
    assert_eq!(full.scene.medium, scene.medium);
    // Views that were not used in training come near the teacher too.
    let distance = |a: &use3d_capture::Image, b: &use3d_capture::Image| {
        a.data().iter().zip(b.data()).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>()
            / a.data().len() as f64
    };
    for view in views.iter().step_by(4) {
        let goal = draw(&teacher, Look::Enhanced { strength: 1.0 }, &view.camera);
        let start = distance(&draw(&scene, Look::Reconstruction, &view.camera), &goal);
        let end = distance(&draw(&full.scene, Look::Enhanced { strength: 1.0 }, &view.camera), &goal);
        assert!(end < 0.5 * start, "{}: {start} -> {end}", view.name);
    }
    // The ablations do not change the other term.
    let global_only = run(Objective::GlobalOnly, 120);
    let local_only = run(Objective::LocalOnly, 120);
    assert!(global_only.report.errors("global").unwrap().1 < 0.3 * before);
    assert!(
        local_only.report.errors("global").unwrap().1 > 0.5 * before,
        "no global pull: {:?}",
        local_only.report.errors("global").unwrap()
    );
    assert!(global_only.report.errors("local").unwrap().1 > local_only.report.errors("local").unwrap().1);
}

/// An image is linear in its colours, so an affine of the colours is an affine of the image. The remaining
/// global error comes from pixels whose accumulation is not one. Tested in clear radiance and with water.
#[test]
fn the_scene_s_affine_at_the_global_target_nearly_meets_it() {
    let (scene, views) = mini();
    let mut wanted = targets(&scene, &taught(&scene), &views);
    for appearance in [Appearance::Clear, Appearance::Water] {
        wanted.appearance = appearance;
        let run = |start, objective, iterations| {
            let params = EnhanceParams { start, objective, ..quick(iterations) };
            enhance(&scene, &views, Guidance::Targets(&wanted), &params, None, &mut Silent).unwrap().report
        };
        let (identity, operator) = (Start::Identity, Start::Operator);
        let begun = run(operator, Objective::Full, 0);
        let (before, after) = begun.errors("global").unwrap();
        assert!(after < 0.3 * before, "{appearance:?}: global {before} -> {after}");
        assert_eq!(
            begun.errors("global").unwrap().0,
            run(identity, Objective::Full, 0).errors("global").unwrap().0
        );
        // The field's local part then has nothing to learn and unlearn: the local targets are nearer after
        // the same number of steps.
        let local = |start| run(start, Objective::Full, 60).errors("local").unwrap().1;
        assert!(local(operator) < local(identity), "{appearance:?}: {} {}", local(operator), local(identity));
        // An objective without a global term starts at the identity.
        let alone = run(operator, Objective::LocalOnly, 0).errors("global").unwrap();
        assert!((alone.0 - alone.1).abs() < 1e-6, "{alone:?}");
    }
}

/// Operators are means over many pixels: a part of them must lead to the same transition of the field,
/// measured with all.
#[test]
fn a_sample_of_the_pixels_teaches_the_same() {
    let (scene, views) = mini();
    let wanted = targets(&scene, &taught(&scene), &views);
    let run = |sample_side| {
        let params = EnhanceParams { sample_side, ..quick(200) };
        enhance(&scene, &views, Guidance::Targets(&wanted), &params, None, &mut Silent).unwrap().report
    };
    let (all, some) = (run(0), run(views[0].camera.intrinsics.width / 2));
    assert!(some.rendered_share < 0.3 && all.rendered_share == 1.0, "{}", some.rendered_share);
    let ((before, with_all), (_, with_some)) =
        (all.errors("global").unwrap(), some.errors("global").unwrap());
    assert!(with_all < 0.3 * before && (with_some - with_all).abs() < 0.1 * before, "{with_all} {with_some}");
    let ((before, with_all), (_, with_some)) = (all.errors("local").unwrap(), some.errors("local").unwrap());
    assert!((with_some - with_all).abs() < 0.1 * before, "{before} {with_all} {with_some}");
    let params = EnhanceParams { sample_side: 3, ..quick(1) };
    let wrong = enhance(&scene, &views, Guidance::Targets(&wanted), &params, None, &mut Silent).unwrap_err();
    assert!(wrong.to_string().contains("sample_side"), "{wrong}");
}

/// The mean over a part of the Gaussians divides the same appearance slightly differently between field and
/// affine.
#[test]
fn a_mean_over_some_gaussians_teaches_the_same() {
    let (scene, views) = mini();
    let wanted = targets(&scene, &taught(&scene), &views);
    let run = |centre_sample| {
        let params = EnhanceParams { centre_sample, ..quick(200) };
        enhance(&scene, &views, Guidance::Targets(&wanted), &params, None, &mut Silent).unwrap()
    };
    let (all, some) = (run(0), run(scene.gaussians.len() / 3));
    assert_ne!(all.scene.enhancement, some.scene.enhancement);
    let ((before, with_all), (_, with_some)) =
        (all.report.errors("global").unwrap(), some.report.errors("global").unwrap());
    assert!((with_some - with_all).abs() < 0.05 * before, "{before} {with_all} {with_some}");
    let ((before, with_all), (_, with_some)) =
        (all.report.errors("local").unwrap(), some.report.errors("local").unwrap());
    assert!((with_some - with_all).abs() < 0.05 * before, "{before} {with_all} {with_some}");
    // The drawn scene is the trained one: the stored centre is that of the steps.
    let params = EnhanceParams { sample_side: 0, centre_sample: scene.gaussians.len() / 3, ..quick(1) };
    let mut engine =
        CpuFieldEngine::new(&scene, &views, Guidance::Targets(&wanted), &params, &mut Silent).unwrap();
    engine.load(FieldState::new(&some.scene.enhancement.as_ref().unwrap().field)).unwrap();
    engine.evaluate(1, Reading::Sampled).unwrap();
    let drawn = draw(&some.scene, Look::Enhanced { strength: 1.0 }, &views[1].camera);
    for (a, b) in engine.rendered().image.data().iter().zip(drawn.data()) {
        assert!((a - b).abs() < 2e-5, "{a} {b}");
    }
}

#[test]
fn pseudo_labels_are_reproduced() {
    let (scene, views) = mini();
    let teacher = taught(&scene);
    let labels = Labels { taught: &teacher, views: &views };
    for pixel_loss in [PixelLoss::L1, PixelLoss::L2] {
        let params = EnhanceParams { objective: Objective::PseudoLabels, pixel_loss, ..quick(150) };
        let labels = PseudoLabels::new(&labels, &views, &params).unwrap();
        let out = enhance(&scene, &views, Guidance::Labels(&labels), &params, None, &mut Silent).unwrap();
        let sum =
            |pick: &dyn Fn(&use3d_enhance::ViewReport) -> f64| out.report.views.iter().map(pick).sum::<f64>();
        let (before, after) =
            (sum(&|v| v.before.of("pixels").unwrap().loss), sum(&|v| v.after.of("pixels").unwrap().loss));
        assert!(after < 0.4 * before, "{pixel_loss:?}: {before} -> {after}");
    }
}

/// With a share of the water, stage 2 is that of a scene with correspondingly thinner water, and the
/// enhanced scene shows that water.
#[test]
fn a_share_of_the_water_is_learnt_as_thinner_water() {
    let (scene, views) = mini();
    let even = |beta: f32| {
        let mut model = MediumGlobal::default();
        // softplus(raw) = beta in the constant band of both coefficients.
        let raw = (math::ln(math::exp_m1(f64::from(beta))) / f64::from(C0)) as f32;
        for quantity in 1..3 {
            model.coefficients[quantity] = [[0.0; 3]; 16];
            model.coefficients[quantity][0] = [raw; 3];
        }
        Scene { medium: MediumModel::Global(model), ..scene.clone() }
    };
    let (whole, thin) = (even(0.4), even(0.2));
    let wanted = targets(&thin, &taught(&thin), &views);
    let kept = Targets { kept_water: KeptWater([0.5; 3]), ..wanted.clone() };
    let run = |scene: &Scene, targets: &Targets| {
        enhance(scene, &views, Guidance::Targets(targets), &quick(60), None, &mut Silent).unwrap()
    };
    let (part, all) = (run(&whole, &kept), run(&thin, &wanted));
    let enhancement = part.scene.enhancement.as_ref().unwrap();
    assert_eq!(enhancement.kept_water, KeptWater([0.5; 3]));
    assert_eq!(all.scene.enhancement.as_ref().unwrap().kept_water, KeptWater::ALL);
    let errors = |outcome: &EnhanceOutcome| outcome.report.errors("global").unwrap();
    let ((before, after), (thin_before, thin_after)) = (errors(&part), errors(&all));
    assert!((before - thin_before).abs() < 1e-3 * before, "{before} {thin_before}");
    assert!((after - thin_after).abs() < 0.05 * before, "{after} {thin_after}");
    let enhanced = Look::Enhanced { strength: 1.0 };
    for view in &views {
        let [a, b] = [&part, &all].map(|outcome| draw(&outcome.scene, enhanced, &view.camera));
        let apart = a.data().iter().zip(b.data()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(apart < 0.02, "{}: {apart}", view.name);
    }
    // Strength 0 is the reconstruction with all of its water.
    let camera = &views[0].camera;
    assert_eq!(
        draw(&part.scene, Look::Enhanced { strength: 0.0 }, camera),
        draw(&whole, Look::Reconstruction, camera)
    );
}

/// In clear radiance, stage 2 is that of a scene without its water, and the water of the enhanced scene is
/// stage 1's.
#[test]
fn clear_radiance_is_learnt_without_the_water_and_leaves_it_alone() {
    let (scene, views) = mini();
    let dry = Scene { medium: MediumModel::None, ..scene.clone() };
    let wanted = targets(&dry, &taught(&dry), &views);
    let clear = Targets { appearance: Appearance::Clear, ..wanted.clone() };
    let run = |scene: &Scene, targets: &Targets| {
        enhance(scene, &views, Guidance::Targets(targets), &quick(120), None, &mut Silent).unwrap()
    };
    let (wet, alone) = (run(&scene, &clear), run(&dry, &wanted));
    let learnt = wet.scene.enhancement.as_ref().unwrap();
    assert_eq!(learnt.appearance, Appearance::Clear);
    assert_eq!(learnt.field, alone.scene.enhancement.as_ref().unwrap().field);
    assert_eq!(wet.report.views, alone.report.views);
    assert_eq!(wet.report.transport_ratios, [1.0; 2]);
    let (before, after) = wet.report.errors("global").unwrap();
    assert!(after < 0.4 * before, "global {before} -> {after}");
    // Full images: enhanced objects behind exactly the water of stage 1.
    let lattice = Lattice::full(&views[0].camera.intrinsics);
    let drawn = |look| {
        let (mut renderer, mut out) = (Renderer::new(&wet.scene, look).unwrap(), Rendered::new());
        renderer.render(&views[0].camera, &lattice, true, &mut out).unwrap();
        (renderer.medium().unwrap().clone(), out.layers.unwrap())
    };
    let (stage1, plain) = drawn(Look::Reconstruction);
    let (water, layers) = drawn(Look::Enhanced { strength: 1.0 });
    assert_eq!(water, stage1);
    assert_eq!((&layers.medium, &layers.far), (&plain.medium, &plain.far));
    // Without the water, the image shows exactly what was learnt.
    let without = draw(&alone.scene, Look::Enhanced { strength: 1.0 }, &views[0].camera);
    let farthest =
        layers.clear.data().iter().zip(without.data()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(farthest < 1e-5, "{farthest}");
    assert_ne!(layers.clear, plain.clear);
    // The same targets, declared to be with water, give another result.
    assert_ne!(run(&scene, &wanted).report.views, wet.report.views);
}

fn same(a: &EnhanceOutcome, b: &EnhanceOutcome) {
    assert_eq!(a.scene.enhancement, b.scene.enhancement);
    assert_eq!(a.log_lines(), b.log_lines());
    let errors = |o: &EnhanceOutcome| o.report.views.clone();
    assert_eq!(errors(a), errors(b));
}

#[test]
fn threads_and_memory_do_not_change_a_bit() {
    let (scene, views) = mini();
    let wanted = targets(&scene, &taught(&scene), &views);
    let run = |threads: usize, cache_mib: usize, observer: &mut dyn Observer| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let params = EnhanceParams { cache_mib, centre_sample: 40, ..quick(25) };
        // An observer need not be Send, so the loop runs here, and its parallel parts run in the pool of
        // one call each.
        let mut notices = Vec::new();
        let out = pool.install(|| {
            let mut watcher = Watcher::new(u64::MAX);
            let out =
                enhance(&scene, &views, Guidance::Targets(&wanted), &params, None, &mut watcher).unwrap();
            notices = watcher.notices;
            out
        });
        notices.iter().for_each(|n| observer.notice(n));
        out
    };
    let one = run(1, 512, &mut Silent);
    for threads in [2, 3] {
        same(&one, &run(threads, 512, &mut Silent));
    }
    let mut watcher = Watcher::new(u64::MAX);
    let starved = run(2, 0, &mut watcher);
    same(&one, &starved);
    assert_eq!((one.report.views_in_memory, starved.report.views_in_memory), (views.len(), 0));
    assert!(watcher.notices.iter().any(|n| n.contains("cache_mib")), "{:?}", watcher.notices);
}

#[test]
fn a_killed_run_goes_on_as_if_it_had_not_been() {
    let (scene, views) = mini();
    let wanted = targets(&scene, &taught(&scene), &views);
    let guidance = Guidance::Targets(&wanted);
    let params = EnhanceParams { checkpoint_every: 10, log_every: 7, ..quick(40) };
    let whole = enhance(&scene, &views, guidance, &params, None, &mut Silent).unwrap();

    let dir = tempfile::tempdir().unwrap();
    let stopped =
        enhance(&scene, &views, guidance, &params, Some(dir.path()), &mut Watcher::new(17)).unwrap_err();
    assert!(matches!(stopped, EnhanceError::Interrupted { step: 17, steps: 40, saved: true }), "{stopped}");
    let mut watcher = Watcher::new(u64::MAX);
    let resumed = enhance(&scene, &views, guidance, &params, Some(dir.path()), &mut watcher).unwrap();
    assert!(watcher.notices.iter().any(|n| n.contains("step 17")), "{:?}", watcher.notices);
    same(&whole, &resumed);

    // A run with another parameter is another run, and a damaged file is reported by name; neither
    // continues from the checkpoint.
    let other = EnhanceParams { learning_rate: 4e-3, ..params.clone() };
    let mut watcher = Watcher::new(u64::MAX);
    enhance(&scene, &views, guidance, &other, Some(dir.path()), &mut watcher).unwrap();
    assert!(
        watcher.notices.iter().any(|n| n.contains("starting from the beginning")),
        "{:?}",
        watcher.notices
    );
    for entry in std::fs::read_dir(dir.path()).unwrap() {
        std::fs::write(entry.unwrap().path(), b"3d-use").unwrap();
    }
    let mut watcher = Watcher::new(u64::MAX);
    let anew = enhance(&scene, &views, guidance, &params, Some(dir.path()), &mut watcher).unwrap();
    assert!(
        watcher.notices.iter().any(|n| n.contains("starting from the beginning")),
        "{:?}",
        watcher.notices
    );
    same(&whole, &anew);
}

#[test]
fn going_on_from_the_end_of_a_shorter_run_leaves_no_trace_of_that_end() {
    let (scene, views) = mini();
    let wanted = targets(&scene, &taught(&scene), &views);
    let dir = tempfile::tempdir().unwrap();
    let run = |iterations, dir: Option<&std::path::Path>| {
        let params = EnhanceParams { log_every: 7, ..quick(iterations) };
        enhance(&scene, &views, Guidance::Targets(&wanted), &params, dir, &mut Silent).unwrap()
    };
    let short = run(10, Some(dir.path()));
    // The last line of the shorter run's log covers three steps; that of the longer one covers seven.
    same(&run(16, Some(dir.path())), &run(16, None));
    same(&short, &run(10, Some(dir.path())));
}

#[test]
fn wrong_input_is_named() {
    let (scene, views) = mini();
    let teacher = taught(&scene);
    let wanted = targets(&scene, &teacher, &views);
    let guidance = Guidance::Targets(&wanted);
    let message = |scene: &use3d_scene::Scene, views: &[_], guidance, params: &EnhanceParams| {
        enhance(scene, views, guidance, params, None, &mut Silent).unwrap_err().to_string()
    };
    assert!(message(&scene, &[], guidance, &quick(1)).contains("no training views"));
    let labels = PseudoLabels::new(&Labels { taught: &teacher, views: &views }, &views, &quick(1)).unwrap();
    assert!(message(&scene, &views, Guidance::Labels(&labels), &quick(1)).contains("transition targets"));
    let params = EnhanceParams { objective: Objective::PseudoLabels, ..quick(1) };
    assert!(message(&scene, &views, guidance, &params).contains("enhanced images"));
    // The labels have other pixels, or are those of fewer views.
    let other = EnhanceParams { sample_side: 16, ..params.clone() };
    assert!(message(&scene, &views, Guidance::Labels(&labels), &other).contains("another `sample_side`"));
    let one = PseudoLabels::new(&Labels { taught: &teacher, views: &views }, &views[..1], &params).unwrap();
    assert!(message(&scene, &views, Guidance::Labels(&one), &params).contains("there is none"));
    let params = EnhanceParams { lambda_local: f64::NAN, ..quick(1) };
    assert!(message(&scene, &views, guidance, &params).contains("lambda_local"));
    let params = EnhanceParams { rank: 99, ..quick(1) };
    assert!(message(&scene, &views, guidance, &params).contains("rank"));
    let mut fewer = scene.clone();
    fewer.gaussians = scene.gaussians.select(&[0, 1, 2]);
    assert!(message(&fewer, &views, guidance, &quick(1)).contains("Gaussians"));
    let json = serde_json::json!({ "iterationz": 3 });
    assert!(serde_json::from_value::<EnhanceParams>(json).unwrap_err().to_string().contains("iterationz"));
}
