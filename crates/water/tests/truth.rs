//! A synthetic capture with known water. Its camera, noise, blur, detection errors and mismatches differ
//! from those that the model assumes.

use use3d_capture::{Image, Map};
use use3d_import::{ImportParams, import, load_pixels};
use use3d_synth::{CaptureParams, write_capture};
use use3d_water::{ObserveError, Verdict, Water, WaterParams, estimate, observe_sizes};

fn solve(dir: &std::path::Path, images: &str) -> Water {
    let imported = import(dir, &ImportParams::default()).unwrap();
    let tracks = imported.tracks();
    let cameras: Vec<_> = imported.capture.views.iter().map(|v| v.camera).collect();
    let load = |view: usize| -> Result<Option<(Image, Option<Map>)>, ObserveError> {
        let mut view = imported.capture.views[view].clone();
        view.image = dir.join(images).join(&view.name);
        Ok(Some((load_pixels(&view).unwrap().to_image(), None)))
    };
    let [observations, _] = observe_sizes(&cameras, &tracks, load).unwrap();
    let positions: Vec<_> = tracks.iter().map(|t| t.position).collect();
    let mut water = estimate(&observations, tracks.len(), &positions, cameras.len(), &WaterParams::default());
    for w in &mut water.channels {
        w.attenuation.value *= imported.capture.frame.scale;
        w.backscatter.value *= imported.capture.frame.scale;
    }
    water
}

#[test]
fn a_reef_has_the_water_it_was_photographed_through_and_none_without() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("reef");
    let params = CaptureParams {
        views: 16,
        width: 240,
        height: 135,
        points: 2500,
        detail: 0.3,
        depth_priors: false,
        ..CaptureParams::default()
    };
    let truth = write_capture(&params, &out, &mut |_, _| ()).unwrap().water.expect("the method's own water");
    let water = solve(&out, "images");
    for (c, w) in water.channels.iter().enumerate() {
        assert!(w.verdict.usable(), "channel {c}: {w:?}");
        for (what, found, truth) in [
            ("attenuation", w.attenuation.value, truth.attenuation[c]),
            ("backscatter", w.backscatter.value, truth.backscatter[c]),
        ] {
            let off = found / f64::from(truth) - 1.0;
            assert!(off.abs() < 0.25, "{what} of channel {c} is off by {:.0} %", 100.0 * off);
        }
    }
    assert!(!water.grey);
    let dry = solve(&out, "truth/clean");
    assert!(dry.channels.iter().all(|w| !w.verdict.usable()), "{:?}", dry.channels);
}

#[test]
fn a_camera_that_exposes_each_view_on_its_own_is_not_taken_for_water() {
    let dir = tempfile::tempdir().unwrap();
    let attenuation = |auto_exposure: f32| {
        let out = dir.path().join(format!("reef {auto_exposure}"));
        let params = CaptureParams {
            views: 20,
            width: 240,
            height: 135,
            points: 2500,
            detail: 0.3,
            depth_priors: false,
            seed: 1,
            physics: use3d_synth::Physics::Spectral,
            water: use3d_synth::WaterType::Ii,
            white_balance: 0.5,
            auto_exposure,
            ..CaptureParams::default()
        };
        write_capture(&params, &out, &mut |_, _| ()).unwrap();
        let water = solve(&out, "images");
        water.channels.each_ref().map(|w| w.attenuation.value)
    };
    let (one, each) = (attenuation(0.0), attenuation(1.0));
    for c in 0..3 {
        let off = each[c] / one[c] - 1.0;
        assert!(off.abs() < 0.3, "channel {c}: {each:?} in place of {one:?}");
    }
}

#[test]
fn air_has_no_water_whatever_the_camera_does() {
    let dir = tempfile::tempdir().unwrap();
    for (seed, backlight) in [(2, 0.0), (3, 0.0), (4, 1.0)] {
        let out = dir.path().join(format!("air {seed}"));
        let params = CaptureParams {
            views: 20,
            width: 240,
            height: 135,
            points: 2500,
            detail: 0.3,
            depth_priors: false,
            seed,
            physics: use3d_synth::Physics::Spectral,
            air: true,
            white_balance: 0.5,
            auto_exposure: if backlight > 0.0 { 1.0 } else { 0.5 },
            backlight,
            ..CaptureParams::default()
        };
        write_capture(&params, &out, &mut |_, _| ()).unwrap();
        let water = solve(&out, "images");
        for w in &water.channels {
            assert_eq!(w.verdict, Verdict::NoWater, "seed {seed}: {w:?}");
        }
    }
}
