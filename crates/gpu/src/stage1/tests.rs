//! Compares the engine with the processor's: step by step from the same states, alone over many steps, and
//! after errors.

use std::path::PathBuf;

use use3d_capture::{FileName, Map, Pixels, Raster, View};
use use3d_medium::{MediumKind, MediumModel, MediumStart};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_reconstruct::engine::{CpuEngine, GradientScale, Moves, StepRates};
use use3d_reconstruct::{ExposureStep, LoadedView};

use super::*;
use crate::profile::Timed;
use crate::test_support::{camera, cloud, relative, same_bits_elsewhere, software};
use crate::twins::SceneSize;

const RATES: StepRates = StepRates {
    means: 1e-3,
    sh_constant: 2e-3,
    sh_directional: 2e-4,
    opacity: 2e-2,
    scales: 5e-3,
    quaternions: 1e-3,
    medium_constant: 2e-3,
    medium_directional: 1e-3,
    medium_network: 0.0,
};

const SIZE: [usize; 2] = [56, 44];

/// Three views: with a prior, with a mask, and with neither. Photographs are smooth, so that there is
/// something to learn.
fn views() -> Vec<TrainingView> {
    let [width, height] = SIZE;
    let stream = Stream::new(3, Purpose::new("views for an engine"), 0);
    (0..3u32)
        .map(|i| {
            let mut camera = camera(width, height);
            camera.pose.translation.x += 0.1 * f64::from(i);
            let pixel = |k: usize| {
                let (x, y) = ((k % width) as f64, (k / width % height) as f64);
                110.0
                    + 60.0 * math::sin(0.2 * x + f64::from(i)) * math::cos(0.15 * y)
                    + 8.0 * stream.uniform((k as u64) << 3)
            };
            let data = (0..3 * width * height).map(|k| pixel(k) as u8).collect();
            let map = |f: &dyn Fn(usize) -> f32| {
                Map::from_planes(width, height, (0..width * height).map(f).collect())
            };
            let loaded = LoadedView {
                pixels: Pixels::Eight(Raster::from_planes(width, height, data).unwrap()),
                mask: if i == 1 { map(&|k| f32::from(k % width > 6)) } else { None },
                depth_prior: if i == 0 { map(&|k| 0.3 + (k % 17) as f32 * 0.05) } else { None },
            };
            let view = View {
                name: FileName::new(&format!("{i}.png")).unwrap(),
                id: i,
                image: PathBuf::new(),
                mask: None,
                depth_prior: None,
                camera,
            };
            TrainingView::new(&view, loaded).unwrap().0
        })
        .collect()
}

fn state(n: usize, log_scale: f32) -> TrainingState {
    let start = MediumStart { anchors: 5, top_k: 3, seed: 4, views: Vec::new() };
    let mut water = MediumModel::start(MediumKind::Rbf, &start).unwrap();
    let stream = Stream::new(9, Purpose::new("water for an engine"), 0);
    let values: Vec<f32> = (0..).zip(water.flat()).map(|(i, v)| v + 0.05 * stream.normal(i) as f32).collect();
    assert!(water.set_flat(&values));
    TrainingState::new(cloud(n, log_scale, 0.5), water, &[[1.0; 3], [1.1, 0.9, 1.0], [0.8; 3]])
}

/// Weights of the three terms that have kernels; the others have none.
fn weights() -> Vec<f64> {
    let names = use3d_reconstruct::losses::names();
    names.enumerate().map(|(k, _)| [0.8, 0.2, 0.1].get(k).copied().unwrap_or(0.0)).collect()
}

fn plan(step: u64) -> StepPlan {
    StepPlan {
        step,
        moves: Moves::All,
        water_updates: step,
        divisor: if step % 5 == 4 { 2 } else { 1 },
        degrees: Degrees { colors: (step as usize / 2).min(3), water: (step as usize / 3).min(3) },
        rates: RATES,
        weights: weights(),
        depth_gradient: step % 4 != 3,
        network_clip: 0.0,
        colors: None,
        exposure: Some(ExposureStep { rate: 1e-3, weight: 1e-2 }),
        gather: (step % 3 != 2).then_some(GradientScale {
            reference_pixels: 1000,
            exponent: 0.5,
            signed: false,
            both: false,
        }),
    }
}

fn with_views<E: Engine>(mut engine: E) -> E {
    for view in views() {
        engine.upload(view).unwrap();
    }
    engine
}

fn compare(step: u64, gpu: &TrainingState, cpu: &TrainingState, bar: f64) {
    let (g, c) = (&gpu.moments.first, &cpu.moments.first);
    let flat = |values: &[[f32; 3]]| values.as_flattened().to_vec();
    for (what, ours, theirs) in [
        ("means", flat(&g.means), flat(&c.means)),
        ("log scales", flat(&g.log_scales), flat(&c.log_scales)),
        ("quaternions", g.quaternions.as_flattened().to_vec(), c.quaternions.as_flattened().to_vec()),
        ("opacities", g.opacity_logits.clone(), c.opacity_logits.clone()),
        ("colours", flat(g.sh.as_flattened()), flat(c.sh.as_flattened())),
        ("water", gpu.medium_moments[0].clone(), cpu.medium_moments[0].clone()),
        ("gains", gpu.exposures.log_gains.first.clone(), cpu.exposures.log_gains.first.clone()),
        ("statistics", gpu.statistics.norms.clone(), cpu.statistics.norms.clone()),
    ] {
        let error = relative(&ours, &theirs);
        assert!(error <= bar, "step {step}: {what} off by {error:.1e}");
    }
    assert_eq!(gpu.exposures.log_gains.steps, cpu.exposures.log_gains.steps);
}

#[test]
fn every_step_from_the_same_state_is_the_processors() {
    let Some(gpu) = software() else { return };
    let (mut ours, mut cpu) = (with_views(Stage1::new(&gpu).unwrap()), with_views(CpuEngine::default()));
    let mut state = state(300, -2.5);
    for step in 0..10 {
        let view = (step % 3) as usize;
        cpu.load(state.clone()).unwrap();
        ours.load(state).unwrap();
        cpu.step(view, &plan(step)).unwrap();
        ours.step(view, &plan(step)).unwrap();
        let (found, expected) = (ours.drain(Drain::All).unwrap(), cpu.drain(Drain::All).unwrap());
        let ([found], [expected]) = (&found[..], &expected[..]) else { panic!("one report each") };
        assert_eq!((found.step, found.view, found.non_finite), (step, view, None));
        assert!((found.loss - expected.loss).abs() <= 1e-5 * expected.loss, "{found:?} {expected:?}");
        assert!((found.psnr.unwrap() - expected.psnr.unwrap()).abs() < 1e-4, "{found:?} {expected:?}");
        for (a, b) in found.values.iter().zip(&expected.values) {
            assert_eq!(a.is_some(), b.is_some(), "{found:?} {expected:?}");
            let (a, b) = (a.unwrap_or(0.0), b.unwrap_or(0.0));
            assert!((a - b).abs() < 2e-5 * b.abs().max(0.1), "{found:?} {expected:?}");
        }
        state = cpu.save().unwrap().into_owned();
        compare(step, &ours.save().unwrap(), &state, 1e-5);
    }
}

#[test]
fn many_steps_on_its_own_go_where_the_processors_go_and_runs_change_engines() {
    let Some(gpu) = software() else { return };
    let (mut ours, mut cpu) = (with_views(Stage1::new(&gpu).unwrap()), with_views(CpuEngine::default()));
    ours.load(state(200, -2.5)).unwrap();
    cpu.load(state(200, -2.5)).unwrap();
    let mean = |reports: &[StepReport]| reports.iter().map(|r| r.loss).sum::<f64>() / reports.len() as f64;
    let run = |engine: &mut dyn Engine, steps: std::ops::Range<u64>| {
        for step in steps {
            engine.step((step % 3) as usize, &StepPlan { divisor: 1, ..plan(step) }).unwrap();
        }
        engine.drain(Drain::All).unwrap()
    };
    let (a, b) = (run(&mut ours, 0..200), run(&mut cpu, 0..200));
    assert_eq!((a.len(), b.len()), (200, 200));
    let (first, last, cpu_last) = (mean(&a[..20]), mean(&a[180..]), mean(&b[180..]));
    assert!(last < 0.9 * first && (last - cpu_last).abs() < 1e-3 * cpu_last, "{first} {last} {cpu_last}");
    // A state moves from the card to the processor and back.
    let (ours_state, cpu_state) = (ours.save().unwrap().into_owned(), cpu.save().unwrap().into_owned());
    cpu.load(ours_state).unwrap();
    ours.load(cpu_state).unwrap();
    let (a, b) = (run(&mut ours, 200..206), run(&mut cpu, 200..206));
    assert!((mean(&a) - mean(&b)).abs() < 2e-2 * mean(&b), "{} {}", mean(&a), mean(&b));
}

#[test]
fn requests_between_steps_are_the_processors() {
    let Some(gpu) = software() else { return };
    let (mut ours, mut cpu) = (with_views(Stage1::new(&gpu).unwrap()), with_views(CpuEngine::default()));
    cpu.load(state(150, -2.5)).unwrap();
    for step in 0..3 {
        cpu.step(step as usize, &plan(step)).unwrap();
    }
    let start = cpu.save().unwrap().into_owned();
    ours.load(start).unwrap();
    assert!(ours.survey().unwrap() == cpu.survey().unwrap());
    let rows = [Origin::Kept(3), Origin::Kept(0), Origin::Twin(5), Origin::Child(7, 0), Origin::Child(7, 1)];
    let draws = Draws { seed: 1, step: 2, shrink: 1.6, ..Draws::default() };
    for engine in [&mut ours as &mut dyn Engine, &mut cpu] {
        engine.rebuild(&rows, &draws).unwrap();
        engine.limit_opacity(0.3).unwrap();
        engine.forget_water_moments().unwrap();
        let wrong = engine.rebuild(&[Origin::Kept(9)], &draws).unwrap_err().to_string();
        assert!(wrong.contains("Gaussian 9; there are 5"), "{wrong}");
        let wrong = engine.step(7, &plan(0)).unwrap_err().to_string();
        assert!(wrong.contains("view 7") && wrong.contains("there are 3"), "{wrong}");
    }
    assert!(ours.save().unwrap() == cpu.save().unwrap());
    let (mut a, mut b) = (Image::new(0, 0), Image::new(0, 0));
    let camera = camera(33, 70);
    let degrees = Degrees { colors: 2, water: 1 };
    ours.render(&camera, degrees, &mut a).unwrap();
    cpu.render(&camera, degrees, &mut b).unwrap();
    assert!(relative(a.data(), b.data()) < 1e-5, "{:.1e}", relative(a.data(), b.data()));
}

#[test]
fn what_a_survey_read_counts_for_nothing_once_the_scene_is_another() {
    let Some(gpu) = software() else { return };
    let rebuilt = |asked: [bool; 2]| {
        let mut ours = with_views(Stage1::new(&gpu).unwrap());
        ours.load(state(150, -2.5)).unwrap();
        for (change, asked) in asked.into_iter().enumerate() {
            if asked {
                ours.survey().unwrap();
            }
            match change {
                0 => ours.step(0, &plan(0)).unwrap(),
                _ => ours.limit_opacity(0.3).unwrap(),
            }
        }
        let draws = Draws { seed: 1, step: 2, shrink: 1.6, ..Draws::default() };
        ours.rebuild(&[Origin::Child(7, 0), Origin::Twin(5)], &draws).unwrap();
        ours.save().unwrap().into_owned()
    };
    let expected = rebuilt([false; 2]);
    assert!(rebuilt([true, false]) == expected && rebuilt([false, true]) == expected);
}

/// More entries than there is room for at first: the steps are repeated with more room, and nothing else
/// differs.
#[test]
fn steps_that_found_no_room_are_done_again() {
    let Some(gpu) = software() else { return };
    let (mut ours, mut cpu) = (with_views(Stage1::new(&gpu).unwrap()), with_views(CpuEngine::default()));
    let state = state(2600, 0.5);
    ours.load(state.clone()).unwrap();
    cpu.load(state).unwrap();
    let before = ours.lists.capacity();
    for step in 0..3 {
        ours.step(step as usize, &plan(step)).unwrap();
        cpu.step(step as usize, &plan(step)).unwrap();
    }
    let (a, b) = (ours.drain(Drain::All).unwrap(), cpu.drain(Drain::All).unwrap());
    assert!(ours.lists.capacity() > before, "there was room from the start");
    assert_eq!(a.iter().map(|r| r.step).collect::<Vec<_>>(), [0, 1, 2]);
    for (a, b) in a.iter().zip(&b) {
        assert!((a.loss - b.loss).abs() < 1e-3 * b.loss, "{a:?} {b:?}");
    }
    assert_eq!(ours.save().unwrap().exposures.log_gains.steps, cpu.save().unwrap().exposures.log_gains.steps);
}

/// All features of a step are on: a mask or a prior, gains, water, statistics.
#[test]
fn a_step_is_one_submit_of_at_most_sixty_dispatches() {
    let Some(gpu) = software() else { return };
    let gpu = gpu.timed(Timed::Dispatches);
    let mut ours = with_views(Stage1::new(&gpu).unwrap());
    ours.load(state(60, -2.5)).unwrap();
    for (step, view) in [0, 1, 2, 0, 1, 2].into_iter().enumerate() {
        let before = gpu.submits();
        ours.step(view, &StepPlan { divisor: 1, ..plan(step as u64) }).unwrap();
        assert_eq!(gpu.submits() - before, 1);
        ours.drain(Drain::All).unwrap();
        let mut times = std::collections::BTreeMap::new();
        gpu.read_times(&mut times).unwrap();
        let dispatches: u64 = times.values().map(|time| time.dispatches).sum();
        // Views of more than 255 tiles are sorted by one more digit, which needs three dispatches.
        assert!((30..=60 - 3).contains(&dispatches), "{dispatches}: {times:?}");
    }
}

#[test]
fn what_is_not_finite_is_named_and_stops_the_steps_after_it() {
    let Some(gpu) = software() else { return };
    let mut ours = with_views(Stage1::new(&gpu).unwrap());
    let mut broken = state(50, -2.5);
    broken.moments.first.quaternions[31][2] = f32::NAN;
    ours.load(broken).unwrap();
    for step in 0..3 {
        ours.step(0, &plan(step)).unwrap();
    }
    let reports = ours.drain(Drain::All).unwrap();
    assert_eq!(reports.len(), 1);
    assert_eq!(reports[0].non_finite, Some(("quaternions", Some(4 * 31 + 2))));
}

/// Too many Gaussians, and too many entries of a view: the error contains the array that is too long, its
/// length, and the limit.
#[test]
fn what_no_binding_holds_is_refused_with_its_size() {
    let Some(gpu) = software() else { return };
    let tight = gpu.clone().binding(100_000);
    let view = views().swap_remove(0);
    let refused = Stage1::new(&tight).unwrap().upload(view).unwrap_err().to_string();
    assert!(
        refused.contains("values of pixels would take") && refused.contains("at most 100000"),
        "{refused}"
    );
    let tight = gpu.clone().binding(130_000);
    let mut ours = with_views(Stage1::new(&tight).unwrap());
    let refused = ours.load(state(2750, 0.5)).unwrap_err().to_string();
    assert!(
        refused.contains("132000 bytes") && refused.contains("at most 130000: 2708 Gaussians"),
        "{refused}"
    );
    let tight = gpu.binding(900_000);
    let mut ours = with_views(Stage1::new(&tight).unwrap());
    // The former state is still there.
    ours.load(state(18_750, 0.5)).unwrap();
    let rows: Vec<_> = (0..18_750).chain([3]).map(Origin::Kept).collect();
    let refused = ours
        .rebuild(&rows, &Draws { seed: 1, step: 2, shrink: 1.6, ..Draws::default() })
        .unwrap_err()
        .to_string();
    assert!(refused.contains("18751 Gaussians") && refused.contains("max_gaussians"), "{refused}");
    assert_eq!(ours.save().unwrap().gaussians.len(), 18_750);
    ours.load(state(2600, 0.5)).unwrap();
    ours.step(0, &StepPlan { divisor: 1, ..plan(0) }).unwrap();
    let refused = ours.drain(Drain::All).unwrap_err().to_string();
    assert!(refused.contains("records would take") && refused.contains("at most 900000"), "{refused}");
}

/// More Gaussians than one binding can hold the colours of: steps, refinement, opacity ceiling and a
/// picture are the same to the bit as if one binding held them all.
#[test]
fn gaussians_in_several_chunks_are_trained_as_in_one() {
    let Some(gpu) = software() else { return };
    let run = |gpu: &Gpu, chunks: usize| {
        let mut ours = with_views(Stage1::new(gpu).unwrap());
        ours.load(state(10_000, -4.5)).unwrap();
        assert_eq!(ours.scene.first.colors.over(10_000).count(), chunks);
        for step in 0..3 {
            ours.step(step as usize, &plan(step)).unwrap();
        }
        let rows: Vec<_> = (0..9000).map(Origin::Kept).chain((0..400).map(Origin::Twin)).collect();
        ours.rebuild(&rows, &Draws { seed: 1, step: 2, shrink: 1.6, ..Draws::default() }).unwrap();
        ours.limit_opacity(0.3).unwrap();
        ours.step(1, &StepPlan { divisor: 1, ..plan(3) }).unwrap();
        let reports = ours.drain(Drain::All).unwrap();
        assert_eq!(reports.len(), 4);
        let mut image = Image::new(0, 0);
        ours.render(&camera(33, 70), Degrees { colors: 2, water: 1 }, &mut image).unwrap();
        (reports, ours.save().unwrap().into_owned(), image)
    };
    // 4,687 Gaussians per chunk.
    let (one, several) = (run(&gpu, 1), run(&gpu.clone().binding(900_000), 3));
    assert!(one == several);
}

#[test]
fn a_lost_device_is_told_by_the_next_step() {
    let Some(gpu) = software() else { return };
    let mut ours = with_views(Stage1::new(&gpu).unwrap());
    ours.load(state(50, -2.5)).unwrap();
    ours.step(0, &plan(0)).unwrap();
    gpu.lose();
    let error = ours.step(1, &plan(1)).and_then(|()| ours.drain(Drain::All).map(|_| ())).unwrap_err();
    assert!(matches!(error, EngineError::DeviceLost { .. }), "{error}");
    let error = ours.save().unwrap_err();
    assert!(matches!(error, EngineError::DeviceLost { .. }), "{error}");
}

/// Prints a digest of a few steps, which [`bits_do_not_depend_on_threads_or_widths`] reads from another
/// process.
#[test]
fn digest_of_a_few_steps() {
    let Some(gpu) = software() else { return };
    let digest = || {
        let mut ours = with_views(Stage1::new(&gpu).unwrap());
        ours.load(state(200, -2.5)).unwrap();
        for step in 0..6 {
            ours.step((step % 3) as usize, &plan(step)).unwrap();
        }
        let reports = format!("{:?}", ours.drain(Drain::All).unwrap());
        // Every digit of every number is included.
        let state = format!("{:?}", ours.save().unwrap());
        let mut sum = 0xcbf2_9ce4_8422_2325u64;
        for byte in reports.bytes().chain(state.bytes()) {
            sum = (sum ^ u64::from(byte)).wrapping_mul(0x100_0000_01b3);
        }
        sum
    };
    let first = digest();
    assert_eq!(first, digest(), "two runs differ");
    println!("\ndigest {first:016x}");
}

#[test]
fn bits_do_not_depend_on_threads_or_widths() {
    if software().is_some() {
        same_bits_elsewhere("stage1::tests::digest_of_a_few_steps");
    }
}

/// Bytes on the device besides the views, and the estimate.
fn memory(scene: &SceneSize) -> [u64; 2] {
    let Some(gpu) = software() else { return [1, 1] };
    let mut ours = Stage1::new(&gpu).unwrap();
    for view in scene.training_views().unwrap() {
        ours.upload(view).unwrap();
    }
    ours.load(scene.state()).unwrap();
    for view in 0..scene.views {
        ours.step(view, &SceneSize::plan(view as u64)).unwrap();
    }
    ours.drain(Drain::All).unwrap();
    let entries = ours.counts.read(&gpu, counts::WORDS).unwrap()[counts::MOST] as usize;
    let forecast = training_bytes(scene.gaussians, scene.width * scene.height, entries);
    [(ours.memory() - ours.targets.size()) as u64, forecast]
}

fn assert_forecast(scene: &SceneSize) {
    let [found, forecast] = memory(scene);
    assert!(found <= forecast && forecast <= found + found / 20 + (4 << 20), "{found}, forecast {forecast}");
}

#[test]
fn memory_is_what_was_forecast() {
    assert_forecast(&SceneSize { width: 320, height: 240, gaussians: 300, views: 1, seed: 2 });
    assert_forecast(&SceneSize { width: 64, height: 48, gaussians: 9000, views: 1, seed: 2 });
}

/// A photograph of eight megapixels. [`memory_is_what_was_forecast`] always runs the same check at small
/// sizes; this one uses the largest size that cameras commonly have and keeps two cores busy for three
/// minutes. Run `cargo test -p use3d-gpu eight_megapixels -- --ignored` after a change of the data on a
/// device.
#[test]
#[ignore = "three minutes on a software adapter; the same check at small sizes always runs"]
fn eight_megapixels_take_what_was_forecast() {
    assert_forecast(&SceneSize { width: 3264, height: 2448, gaussians: 2000, views: 1, seed: 2 });
}

/// Grids of two dimensions have more workgroups than there is work. The results are the same in every bit.
#[test]
fn grids_of_two_dimensions_give_the_same_bits() {
    let Some(gpu) = software() else { return };
    let scene = SceneSize { width: 96, height: 64, gaussians: 2000, views: 2, seed: 5 };
    let run = || {
        let mut digests = Vec::new();
        for variant in gpu.variants() {
            let mut engine = Stage1::new(&gpu.clone().with(variant)).unwrap();
            let found = crate::twins::step(&mut engine, &scene).unwrap();
            digests.extend(found.into_iter().map(|agreement| agreement.digest));
        }
        let further = crate::twins::pictures(&gpu, &scene).unwrap().into_iter();
        let further = further.chain(crate::twins::field(&gpu, &scene).unwrap());
        digests.extend(further.map(|agreement| agreement.digest));
        digests
    };
    let expected = run();
    crate::kernel::SIDE_IN_TESTS.set(7);
    let found = run();
    assert!(found == expected);
}

/// More pixels than one round of the sums over workgroups.
#[test]
fn large_views_agree_with_the_processor() {
    let Some(gpu) = software() else { return };
    let (width, height) = (650, 410);
    let loss = crate::twins::LossCase { width, height, seed: 3, mask: true, prior: true, gains: true };
    let water = crate::twins::WaterCase { width, height, seed: 3, anchors: 8, top_k: 4, degree: 3 };
    let found = crate::twins::losses(&gpu, &loss).unwrap().into_iter();
    for agreement in found.chain(crate::twins::water(&gpu, &water).unwrap()) {
        assert!(agreement.holds(), "{agreement:?}");
    }
}

/// A kernel is compiled once for each text, whatever uses it.
#[test]
fn every_text_is_compiled_once() {
    let Some(gpu) = software() else { return };
    let first = Stage1::new(&gpu).unwrap();
    let compiled = gpu.kernels.times().len();
    let second = Stage1::new(&gpu).unwrap();
    assert_eq!(gpu.kernels.times().len(), compiled);
    drop((first, second));
    crate::check(&gpu).unwrap();
    assert_eq!(gpu.kernels.times().len(), gpu.kernels.texts());
}
