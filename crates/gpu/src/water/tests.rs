//! Compares the water on the device with that of the processor.

use use3d_medium::{MediumGlobal, MediumMlp, MediumRbf};

use super::*;
use crate::test_support::software;
use crate::twins::{WaterCase, water};

#[test]
fn the_water_is_that_of_the_processor() {
    let Some(gpu) = software() else { return };
    for (seed, (width, height), (anchors, top_k), degree) in [
        (1, (61, 47), (8, 4), 3),
        (2, (64, 16), (0, 0), 3),
        (3, (1, 1), (1, 1), 0),
        (4, (33, 31), (5, 5), 1),
        (5, (96, 64), (300, 7), 2),
        (6, (32, 32), (8, 1), 3),
    ] {
        let case = WaterCase { width, height, seed, anchors, top_k, degree };
        for found in water(&gpu, &case).unwrap() {
            assert!(found.holds(), "{case:?}: {found:?}");
        }
    }
}

#[test]
fn no_water_needs_nothing_and_a_network_is_refused_by_name() {
    let Some(gpu) = software() else { return };
    assert!(DeviceWater::new(&gpu, &MediumModel::None, [&[], &[]]).unwrap().is_none());
    let (network, over) = (MediumModel::Mlp(MediumMlp::new(1)), MediumModel::Image(MediumGlobal::default()));
    for (model, name) in [(network, "`mlp`"), (over, "`image`")] {
        let moments = vec![0.0; model.parameter_count()];
        let error = DeviceWater::new(&gpu, &model, [&moments, &moments]).unwrap_err().to_string();
        assert!(error.contains(name) && error.contains("--engine cpu"), "{error}");
    }
}

#[test]
fn moments_of_coefficients_are_forgotten_and_those_of_anchors_kept() {
    let Some(gpu) = software() else { return };
    let model = MediumModel::Rbf(MediumRbf::new(8, 4));
    let moments = vec![1.0; model.parameter_count()];
    let water = DeviceWater::new(&gpu, &model, [&moments, &moments]).unwrap().unwrap();
    water.forget_moments(&gpu);
    let (same, both) = water.read(&gpu).unwrap();
    assert!(same == model);
    for moment in both {
        assert!(moment[..32].iter().all(|v| *v == 1.0) && moment[32..].iter().all(|v| *v == 0.0));
    }
}

#[test]
fn a_run_that_has_stopped_changes_nothing() {
    let Some(gpu) = software() else { return };
    let model = MediumModel::Rbf(MediumRbf::new(8, 4));
    let moments = vec![1e-3; model.parameter_count()];
    let water = DeviceWater::new(&gpu, &model, [&moments, &moments]).unwrap().unwrap();
    let mut words = [0u32; counts::WORDS];
    words[counts::STOP] = counts::OVERFLOW;
    let stopped = Array::from(&gpu, "counts", &words).unwrap();
    crate::kernel::submit(&gpu, "update", |pass| water.record_update(pass, &stopped)).unwrap();
    let (same, both) = water.read(&gpu).unwrap();
    assert!(same == model && both.iter().all(|m| *m == moments));
}
