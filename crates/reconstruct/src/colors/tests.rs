//! Tests of colour fields as a part of training.

use super::*;

#[test]
fn a_field_goes_through_a_checkpoint_and_another_number_of_views_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let file = use3d_training::CheckpointFile::new(dir.path(), "colors");
    let mut state = ColorState::new(ColorField::Caustics, 3, 9);
    let gradient: Vec<f32> = (0..state.values.len()).map(|i| (i % 5) as f32 - 2.0).collect();
    let before = state.values.clone();
    assert!(state.update(0, [1e-2, 1e-3, 0.0], &gradient));
    file.save(&state).unwrap();
    let read: ColorState = file.load().unwrap().unwrap();
    assert_eq!(read, state);
    read.check(3).unwrap();
    assert!(read.check(4).unwrap_err().to_string().contains("`caustics` of 3 views"));
    // Every role has its own rate: grids come first, and codes last.
    let moved = |i: usize| (state.values[i] - before[i]).abs();
    assert!((moved(0) - 1e-2).abs() < 1e-6 && moved(state.values.len() - 1) == 0.0);
    ColorState::default().check(7).unwrap();
    assert!(ColorState::default().is_off());
}

#[test]
fn a_field_is_learnt_alone_for_its_share_of_the_run() {
    let mut params = ReconstructParams { iterations: 900, schedule: 900, ..ReconstructParams::default() };
    assert_eq!(params.color_step(0), None);
    (params.color_field, params.color_alone) = (ColorField::Caustics, 1.0 / 3.0);
    let alone = |step| params.color_step(step).map(|colors| colors.alone);
    assert_eq!([0, 299, 300, 899].map(alone), [Some(true), Some(true), Some(false), Some(false)]);
    let rates = params.color_step(0).unwrap().rates;
    let expected = [1e-2, 1e-3, 2e-3];
    assert!(rates.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{rates:?}");
}
