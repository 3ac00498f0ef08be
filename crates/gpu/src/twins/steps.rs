//! Compares whole steps of stage 1, and a refinement, with the processor's engine, from the same state.

use use3d_reconstruct::density::{Draws, Origin};
use use3d_reconstruct::engine::{CpuEngine, Engine, TrainingState};
use use3d_splat::Gaussians;
use use3d_training::{Drain, EngineError};

use super::{Agreement, SceneSize};

/// Compares one step from the same state on both engines: report, moments after it (which are the
/// gradients, from zero), statistics. At the end it compares rows of every kind, moved and made, to the
/// bit.
pub fn step(engine: &mut dyn Engine, scene: &SceneSize) -> Result<Vec<Agreement>, EngineError> {
    let mut ours = CpuEngine::default();
    let state = scene.state();
    for view in scene.training_views()? {
        ours.upload(view.clone())?;
        engine.upload(view)?;
    }
    let mut all = Vec::new();
    ours.load(state.clone())?;
    engine.load(state)?;
    for view in 0..scene.views {
        let plan = SceneSize::plan(view as u64);
        ours.step(view, &plan)?;
        engine.step(view, &plan)?;
        let (expected, found) = (ours.drain(Drain::All)?, engine.drain(Drain::All)?);
        let (Some(expected), Some(found)) = (expected.first(), found.first()) else { continue };
        all.push(Agreement::of_values("loss", found.loss, expected.loss, 1e-4 * expected.loss.abs()));
        compare(engine.save()?.as_ref(), ours.save()?.as_ref(), &mut all);
        // Each step starts from the processor's state, so it is judged alone.
        let state = ours.save()?.into_owned();
        engine.load(state)?;
    }
    let n = scene.gaussians;
    let row = |i: usize| [Origin::Kept(i), Origin::Twin(i), Origin::Child(i, 0), Origin::Child(i, 1)];
    let rows: Vec<Origin> = (0..n).rev().flat_map(|i| row(i).into_iter().take(1 + i % 4)).collect();
    let draws = Draws { seed: scene.seed, step: 100, shrink: 1.6, ..Draws::default() };
    ours.rebuild(&rows, &draws)?;
    engine.rebuild(&rows, &draws)?;
    let (found, expected) = (engine.save()?, ours.save()?);
    let pairs = [
        ("Gaussians", &found.gaussians, &expected.gaussians),
        ("first moments", &found.moments.first, &expected.moments.first),
        ("second moments", &found.moments.second, &expected.moments.second),
    ];
    for (what, device, ours) in pairs {
        let flat = |g: &Gaussians| {
            let vectors = [g.means.as_flattened(), g.log_scales.as_flattened()];
            let rest = [g.quaternions.as_flattened(), &g.opacity_logits, g.sh.as_flattened().as_flattened()];
            vectors.into_iter().chain(rest).flatten().copied().collect::<Vec<f32>>()
        };
        all.push(Agreement::of(format!("rebuilt {what}"), &flat(device), &flat(ours), 0.0));
    }
    Ok(all)
}

/// In a scene with more Gaussians than this number, one of as many may differ because a pair of it and a
/// pixel lies exactly at a threshold.
const ONE_OF: usize = 1_000;
/// The largest allowed error of the others, and of all with them.
const TRIMMED: f64 = 2e-5;
const WITH_ALL: f64 = 1e-3;

/// Compares one step of a scene in which the first `crowd` Gaussians are faint and lie behind one another,
/// all in one tile.
///
/// A pair of pixel and Gaussian exactly at a threshold may be decided otherwise than on the processor. Such
/// a pair changes the gradient of its Gaussian by up to a part in a thousand of the norm of all. With
/// hundreds of millions of pairs there are some. So in a scene with more than 1,000 Gaussians each gradient
/// is compared twice: without the one Gaussian in 1,000 that differs most, and with all.
///
/// # Errors
/// The engine's error.
pub fn large_step(
    engine: &mut dyn Engine,
    scene: &SceneSize,
    crowd: usize,
) -> Result<Vec<Agreement>, EngineError> {
    let (mut ours, mut state) = (CpuEngine::default(), scene.state());
    for i in 0..crowd.min(scene.gaussians) {
        let near = state.gaussians.means[i].map(|v| 0.01 * v);
        state.gaussians.means[i] = [near[0], near[1], 2.0 + near[2]];
        state.gaussians.opacity_logits[i] = -4.5;
        state.gaussians.log_scales[i] = [-4.5; 3];
    }
    let plan = SceneSize::plan(0);
    let mut all = Vec::new();
    for engine in [&mut *engine, &mut ours as &mut dyn Engine] {
        for view in scene.training_views()? {
            engine.upload(view)?;
        }
        engine.load(state.clone())?;
        engine.step(0, &plan)?;
    }
    let (expected, found) = (ours.drain(Drain::All)?, engine.drain(Drain::All)?);
    if let (Some(expected), Some(found)) = (expected.first(), found.first()) {
        all.push(Agreement::of_values("loss", found.loss, expected.loss, 1e-4 * expected.loss.abs()));
    }
    compare(engine.save()?.as_ref(), ours.save()?.as_ref(), &mut all);
    let size = format!("{} x {}, {} Gaussians", scene.width, scene.height, scene.gaussians);
    all.iter_mut().for_each(|agreement| agreement.what = format!("{} at {size}", agreement.what));
    Ok(all)
}

/// Compares first moments, which are gradients times a constant; the second moments follow from them.
fn compare(device: &TrainingState, ours: &TrainingState, all: &mut Vec<Agreement>) {
    let (d, o) = (&device.moments.first, &ours.moments.first);
    for (what, device, ours) in [
        ("gradients of means", d.means.as_flattened(), o.means.as_flattened()),
        ("gradients of log scales", d.log_scales.as_flattened(), o.log_scales.as_flattened()),
        ("gradients of quaternions", d.quaternions.as_flattened(), o.quaternions.as_flattened()),
        ("gradients of opacities", &d.opacity_logits, &o.opacity_logits),
        ("gradients of colours", d.sh.as_flattened().as_flattened(), o.sh.as_flattened().as_flattened()),
        ("gradients of the water", &device.medium_moments[0], &ours.medium_moments[0]),
        ("statistics", &device.statistics.norms, &ours.statistics.norms),
    ] {
        let (gaussians, numbers) = (o.means.len(), ours.len());
        if gaussians <= ONE_OF || numbers % gaussians != 0 || device.len() != numbers {
            all.push(Agreement::of(what, device, ours, 1e-4));
            continue;
        }
        let (near, rest) = without_few(device, ours, numbers / gaussians, gaussians / ONE_OF);
        all.push(Agreement::of(format!("{what} without 1 row of {ONE_OF}"), &near, &rest, TRIMMED));
        all.push(Agreement::of(what, device, ours, WITH_ALL));
    }
}

/// Two arrays without the `few` rows that differ most.
fn without_few(device: &[f32], ours: &[f32], width: usize, few: usize) -> (Vec<f32>, Vec<f32>) {
    let square = |(d, o): (&f32, &f32)| f64::from(d - o) * f64::from(d - o);
    let row = |(d, o): (&[f32], &[f32])| d.iter().zip(o).map(square).sum::<f64>();
    let differences = device.chunks(width).zip(ours.chunks(width)).map(row);
    // A difference that is not a number is put last, so that it is never left out.
    let mut rows: Vec<(usize, f64)> =
        differences.map(|d| if d.is_nan() { -1.0 } else { d }).enumerate().collect();
    rows.sort_by(|a, b| b.1.total_cmp(&a.1));
    let kept = |values: &[f32]| {
        rows[few..].iter().flat_map(|(row, _)| &values[row * width..(row + 1) * width]).copied().collect()
    };
    (kept(device), kept(ours))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The crowd of the check is in one tile, and no pixel stops before its end.
    #[test]
    fn a_crowd_is_in_one_tile_and_is_composed_to_its_end() {
        let Some(gpu) = crate::test_support::software() else { return };
        let (scene, crowd) = (super::super::LARGE, super::super::CROWD);
        let mut engine = crate::stage1::Stage1::new(&gpu).unwrap();
        for found in large_step(&mut engine, &scene, crowd).unwrap() {
            assert!(found.holds(), "{found:?}");
        }
        let work = engine.last_view([scene.width, scene.height]).unwrap();
        assert!(work.longest_list > 256 && scene.width * scene.height > 256 * 256, "{work:?}");
        assert!(work.deepest_pixel > 256 && scene.gaussians >= 600, "{work:?}");
    }

    /// A gradient without its worst rows is judged strictly, and one that is wrong everywhere fails.
    #[test]
    fn a_few_rows_may_differ_and_all_may_not() {
        let ours: Vec<f32> = (0..6000).map(|i| 1.0 + (i % 7) as f32).collect();
        let mut device = ours.clone();
        device[3] += 0.5;
        let (near, rest) = without_few(&device, &ours, 3, 2);
        assert!(near == rest && near.len() == 5994);
        device.iter_mut().for_each(|v| *v *= 1.0001);
        let (near, rest) = without_few(&device, &ours, 3, 2);
        assert!(!Agreement::of("all", &near, &rest, TRIMMED).holds());
        device[1] = f32::NAN;
        let (near, rest) = without_few(&device, &ours, 3, 2);
        assert!(!Agreement::of("all", &near, &rest, 1e3).holds());
    }

    #[test]
    fn an_engine_agrees_with_itself() {
        let scene = SceneSize { width: 48, height: 32, gaussians: 150, views: 2, seed: 1 };
        let found = step(&mut CpuEngine::default(), &scene).unwrap();
        assert_eq!(found.len(), 19);
        assert!(found.iter().all(|agreement| agreement.error == 0.0), "{found:?}");
        // The compared scene is not empty.
        let state = scene.state();
        assert_eq!((state.gaussians.len(), scene.training_views().unwrap().len()), (150, 2));
    }
}
