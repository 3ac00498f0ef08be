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
