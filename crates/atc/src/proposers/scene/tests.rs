//! Tests of the allowed and forbidden effects of a scene's grade.

use use3d_capture::{Image, Map};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};

use super::*;

const SIZE: (usize, usize) = (80, 45);

/// A view of random patches: `colour` computes a patch's radiance from three uniform numbers, `t` its
/// transmittance from its column's position in `[0, 1)`.
fn view(seed: u64, colour: impl Fn([f64; 3]) -> [f64; 3], t: impl Fn(f64) -> f64) -> SceneView {
    let draw = Stream::new(seed, Purpose::new("scene proposer"), 0);
    let (w, h) = SIZE;
    let (mut clear, mut arriving) = (Image::new(w, h), Image::new(w, h));
    for y in 0..h {
        for x in 0..w {
            let patch = (y / 5 * 100 + x / 5) as u64;
            let c = colour([0, 1, 2].map(|k| draw.uniform(3 * patch + k)));
            clear.set_pixel(x, y, c.map(|v| v as f32));
            let t = t(x as f64 / w as f64);
            arriving.set_pixel(x, y, [0.5, 1.0, 0.9].map(|k| (k * t) as f32));
        }
    }
    SceneView { clear, accumulation: Map::filled(w, h, 1.0), arriving }
}

fn survey(views: &[SceneView]) -> SceneProposer {
    let mut survey = SceneSurvey::default();
    views.iter().for_each(|v| survey.add(v).unwrap());
    survey.finish()
}

/// Typical surfaces: warm on average, and of many colours.
fn warm(u: [f64; 3]) -> [f64; 3] {
    let light = 0.15 + 0.5 * u[0];
    let tint = [0.12 + 0.5 * (u[1] - 0.5), 0.03, -0.15 + 0.5 * (u[2] - 0.5)];
    tint.map(|t| light * math::exp(t))
}

fn cast(by: [f64; 3]) -> impl Fn([f64; 3]) -> [f64; 3] {
    move |u| {
        let c = warm(u);
        std::array::from_fn(|k| c[k] * math::exp(by[k]))
    }
}

fn several(colour: impl Fn([f64; 3]) -> [f64; 3]) -> Vec<SceneView> {
    (0..6).map(|seed| view(seed, &colour, |x| 0.9 - 0.5 * x)).collect()
}

#[test]
fn grey_stays_grey_and_usual_colours_are_left_alone() {
    let grey = several(|u| [0.1 + 0.7 * u[0]; 3]);
    let proposer = survey(&grey);
    assert_eq!(proposer.findings.balance, [1.0; 3]);
    let out = proposer.propose(&grey[0]).unwrap();
    let spread = |p: usize| {
        let x: [f32; 3] = std::array::from_fn(|c| out.plane(c)[p]);
        (x[0] - x[1]).abs().max((x[2] - x[1]).abs())
    };
    assert!((0..out.pixels()).all(|p| spread(p) < 1e-5));
    assert_eq!(survey(&several(warm)).findings.balance, [1.0; 3]);
}

#[test]
fn a_cast_of_all_sure_pixels_is_mostly_taken_off_within_bounds() {
    for by in [[-0.3, 0.05, 0.25], [-0.2, 0.25, -0.05], [0.3, -0.3, 0.0]] {
        let found = survey(&several(cast(by))).findings;
        let left: [f64; 3] = std::array::from_fn(|c| by[c] + math::ln(found.balance[c]));
        assert!(dot(left, left).sqrt() < 0.55 * dot(by, by).sqrt(), "{by:?}: {found:?}");
        // The geometric mean of the gains is one, because white balance must not change brightness.
        assert!(found.balance.iter().map(|g| math::ln(*g)).sum::<f64>().abs() < 1e-9);
    }
    let strong = survey(&several(cast([-1.2, 0.4, 0.8]))).findings;
    assert!(strong.balance.iter().all(|g| (1.0 / 1.5 - 1e-9..=1.5 + 1e-9).contains(g)), "{strong:?}");
    assert!(strong.balance[0] > 1.4, "{strong:?}");
}

/// A tiled pool in white light and a grey one in blue light look the same, so no cast is removed.
#[test]
fn the_colour_of_a_scene_of_one_surface_is_no_cast() {
    let blue = [-0.33, 0.11, 0.22];
    let tiles = |u: [f64; 3]| {
        let (light, line) = (0.2 + 0.6 * u[0], u[1] < 0.06);
        if line { [light; 3] } else { blue.map(|b| light * math::exp(b)) }
    };
    let found = survey(&several(tiles)).findings;
    assert!(found.kinds < 1.3 && found.balance == [1.0; 3], "{found:?}");
    let varied = survey(&several(cast(blue))).findings;
    assert!(varied.kinds > KINDS && varied.trusted > 0.8, "{varied:?}");
}

#[test]
fn kinds_of_surface_are_counted_by_their_colours() {
    let of = |n: usize| -> Vec<Coloured> {
        (0..3000).map(|i| ([0.3 * (i % n) as f64, 0.0, 0.0], 1.0 + (i % 5) as f64)).collect()
    };
    assert_eq!(kinds(&[]), 1.0);
    assert_eq!(kinds(&of(1)), 1.0);
    for n in [2, 4, 7] {
        assert!((kinds(&of(n)) / n as f64 - 1.0).abs() < 0.02, "{n}: {}", kinds(&of(n)));
    }
}

/// The same mean colour is trusted less if the views differ more about it.
#[test]
fn what_views_disagree_about_is_trusted_less() {
    let mean = [-0.2, 0.05, 0.15];
    let trusted = |error| balance(mean, error).1;
    assert!(trusted(0.0) > trusted(0.1) && trusted(0.1) > trusted(0.2) && trusted(0.2) > 0.0);
    assert_eq!(trusted(1.0), 0.0);
    let alike: Vec<_> = (0..8).map(|_| vec![([0.1, 0.0, -0.1], 100.0)]).collect();
    assert_eq!(standard_error(&alike, [0.1, 0.0, -0.1]), 0.0);
    let mixed: Vec<_> =
        (0..8).map(|k| vec![(if k % 2 == 0 { [0.2; 3] } else { [-0.2; 3] }, 100.0)]).collect();
    // Eight views count as two; centred medians of a grey are zero, so only the mean's own deviation is
    // left.
    let error = standard_error(&mixed, [0.3, 0.0, -0.3]);
    assert!((error - (0.06f64 / 2.0).sqrt()).abs() < 1e-9, "{error}");
}

#[test]
fn brightness_brings_the_bright_end_up_and_does_not_clip() {
    for seed in 0..12 {
        let draw = Stream::new(seed, Purpose::new("brightness"), 1);
        let (low, high) = (0.05 + 0.2 * draw.uniform(0), 0.3 + 0.7 * draw.uniform(1));
        // A few lights, which are the bright end of some scenes.
        let lights = 0.02 * draw.uniform(2);
        let views = several(|u| {
            let light = low + (high - low) * u[0];
            let light = if u[1] < lights { 1.0 } else { light };
            [light * 1.0, light * 0.9, light * 0.8]
        });
        let proposer = survey(&views);
        let found = &proposer.findings;
        assert!((BRIGHTNESS[0]..=BRIGHTNESS[1]).contains(&found.brightness), "{found:?}");
        let (mut over, mut all, mut bright) = (0, 0, 0.0f32);
        for view in &views {
            let out = proposer.propose(view).unwrap();
            for p in 0..out.pixels() {
                let largest = (0..3).fold(0.0f32, |m, c| m.max(out.plane(c)[p]));
                over += usize::from(largest > 1.0);
                all += 1;
                bright = bright.max(largest);
            }
        }
        assert!(over as f64 <= 0.005 * f64::from(all), "seed {seed}: {over} of {all}, {found:?}");
        // Dim scenes become brighter: up to the wanted end, or as far as the bound allows.
        assert!(
            bright > 0.8 || found.brightness > 1.45 || lights > 0.003,
            "seed {seed}: {bright}, {found:?}"
        );
    }
}

/// In air nothing was removed from the scene: it stays as the camera exposed it, dim or flat.
#[test]
fn a_scene_without_water_keeps_its_light() {
    let dim = |u: [f64; 3]| [0.3 + 0.1 * u[0]; 3];
    let mut views = several(dim);
    let under_water = survey(&views).findings;
    assert!(under_water.brightness > 1.4 && under_water.contrast > 1.1, "{under_water:?}");
    for view in &mut views {
        view.arriving = Image::filled(SIZE.0, SIZE.1, 1.0);
    }
    let in_air = survey(&views).findings;
    assert_eq!((in_air.brightness, in_air.contrast), (1.0, 1.0));
}

/// Noise where hardly any light arrives is brighter than white; it must make the scene neither darker nor
/// brighter.
#[test]
fn what_is_not_sure_does_not_darken() {
    let views: Vec<SceneView> = (0..6)
        .map(|seed| {
            let mut view = view(seed, warm, |x| if x < 0.5 { 0.9 } else { 0.001 });
            for y in 0..SIZE.1 {
                (SIZE.0 / 2..SIZE.0).for_each(|x| view.clear.set_pixel(x, y, [1.6, 0.3, 1.2]));
            }
            view
        })
        .collect();
    assert_eq!(survey(&views).findings.brightness, 1.0);
}

#[test]
fn contrast_is_for_flat_scenes_only() {
    let range =
        |low: f64, high: f64| survey(&several(move |u| [low + (high - low) * u[0]; 3])).findings.contrast;
    assert_eq!(range(0.05, 0.9), 1.0);
    let mild = range(0.2, 0.62);
    assert!(mild > 1.0 && mild < CONTRAST.1, "{mild}");
    assert_eq!(range(0.4, 0.6), CONTRAST.1);
}

#[test]
fn far_noisy_pixels_do_not_steer_the_balance() {
    let near = |x: f64| if x < 0.5 { 0.8 } else { 0.004 };
    let honest: Vec<_> = (0..6).map(|seed| view(seed, warm, near)).collect();
    let mut noisy = honest.clone();
    let draw = Stream::new(5, Purpose::new("far noise"), 0);
    for (k, view) in noisy.iter_mut().enumerate() {
        for y in 0..SIZE.1 {
            for x in SIZE.0 / 2..SIZE.0 {
                let noise = draw.uniform(((k * SIZE.1 + y) * SIZE.0 + x) as u64) as f32;
                view.clear.set_pixel(x, y, [0.05, 0.9 * noise + 0.1, 0.95]);
            }
        }
    }
    let (one, other) = (survey(&honest).findings, survey(&noisy).findings);
    for c in 0..3 {
        assert!((one.balance[c] - other.balance[c]).abs() < 0.01, "{one:?} {other:?}");
        assert!((one.mean_colour[c] - other.mean_colour[c]).abs() < 0.01, "{one:?} {other:?}");
    }
    // With the same weight as other pixels this noise would change the result.
    for view in &mut noisy {
        view.arriving = Image::filled(SIZE.0, SIZE.1, 0.8);
    }
    assert!(survey(&noisy).findings.balance[0] > one.balance[0] + 0.05);
}

/// The false colour that a wrong attenuation of red causes far away is replaced by the scene's mean. Near
/// colours, and those behind a grey haze, which shifts no colour, stay. Luminance never changes.
#[test]
fn colours_that_a_wrong_attenuation_may_have_made_are_drawn_to_the_mean() {
    let mean = [0.05, 0.03, -0.08];
    let pixel = |colour: [f32; 3], t: [f32; 3]| {
        let view = SceneView {
            clear: Image::from_planes(1, 1, colour.to_vec()).unwrap(),
            accumulation: Map::filled(1, 1, 0.8),
            arriving: Image::from_planes(1, 1, t.map(|t| 0.8 * t).to_vec()).unwrap(),
        };
        let mut image = view.clear.clone();
        draw_to_mean(&mut image, &view, mean);
        image.pixel(0, 0)
    };
    let log = |c: [f32; 3]| centred(c.map(|v| math::ln(f64::from(v))));
    let pink = [0.9, 0.5, 0.45];
    let away = |c: [f32; 3]| {
        let apart: [f64; 3] = std::array::from_fn(|k| log(c)[k] - mean[k]);
        dot(apart, apart).sqrt()
    };
    let mut before = away(pink);
    for red in [0.8, 0.5, 0.2, 0.05] {
        let drawn = pixel(pink, [red, 0.9, 0.9]);
        assert!((luminance(drawn.map(f64::from)) - luminance(pink.map(f64::from))).abs() < 1e-6);
        assert!(away(drawn) < before, "{red}: {drawn:?}");
        before = away(drawn);
    }
    assert!(before < 0.45 * away(pink), "{before}");
    for grey in [1.0, 0.3] {
        assert!((0..3).all(|c| (pixel(pink, [grey; 3])[c] - pink[c]).abs() < 1e-5));
    }
    let near = pixel(pink, [0.85, 0.95, 0.97]);
    assert!(away(near) > 0.98 * away(pink), "{near:?}");
    assert_eq!(pixel([0.0; 3], [0.1, 0.9, 0.9]), [0.0; 3]);
}

#[test]
fn the_colour_of_far_surfaces_is_drawn_to_what_is_sure_beside_them() {
    let colour = [0.5f32, 0.4, 0.3];
    let (w, h) = SIZE;
    let mut scene = SceneView {
        clear: Image::new(w, h),
        accumulation: Map::filled(w, h, 1.0),
        arriving: Image::filled(w, h, 0.6),
    };
    let far = [(20, 20), (21, 20), (60, 30)];
    for y in 0..h {
        for x in 0..w {
            scene.clear.set_pixel(x, y, colour);
        }
    }
    for (x, y) in far {
        scene.clear.set_pixel(x, y, [0.9, 0.1, 0.1]);
        scene.arriving.set_pixel(x, y, [0.005; 3]);
    }
    let out = calmed(&scene);
    let light = |c: [f32; 3]| luminance(c.map(f64::from));
    for (x, y) in far {
        let (before, after) = (scene.clear.pixel(x, y), out.pixel(x, y));
        assert!((light(before) - light(after)).abs() < 1e-5, "luminance stays");
        let ratio = |c: [f32; 3]| f64::from(c[0]) / light(c);
        assert!((ratio(after) - ratio(colour)).abs() < 0.03, "{after:?}");
    }
    // A sure pixel keeps its own colour.
    let kept = out.pixel(5, 5);
    assert!((0..3).all(|c| (kept[c] - colour[c]).abs() < 0.01), "{kept:?}");
    scene.clear.set_pixel(40, 10, [0.9, 0.1, 0.1]);
    assert!((calmed(&scene).pixel(40, 10)[0] - 0.9).abs() < 0.01);
}

#[test]
fn bits_do_not_depend_on_threads_and_sizes_are_free() {
    let views = several(cast([-0.3, 0.05, 0.25]));
    let run = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let proposer = survey(&views);
            (proposer.findings, proposer.propose(&views[2]).unwrap())
        })
    };
    assert_eq!(run(1), run(3));
    for (w, h) in [(1, 1), (2, 3), (9, 200)] {
        let view = SceneView {
            clear: Image::filled(w, h, 0.4),
            accumulation: Map::filled(w, h, 1.0),
            arriving: Image::filled(w, h, 0.5),
        };
        let out = survey(std::slice::from_ref(&view)).propose(&view).unwrap();
        assert_eq!((out.width(), out.height()), (w, h));
    }
}

#[test]
fn nothing_sure_is_nothing_changed_and_nonsense_is_named() {
    let mut blind = view(1, cast([-0.5, 0.1, 0.4]), |_| 0.0);
    let proposer = survey(std::slice::from_ref(&blind));
    assert_eq!(proposer.findings, SceneFindings::NONE);
    assert_eq!(survey(&[]).findings.balance, [1.0; 3]);
    blind.accumulation = Map::new(3, 3);
    assert!(SceneSurvey::default().add(&blind).unwrap_err().to_string().contains("(3, 3)"));
    let mut broken = view(1, warm, |_| 0.5);
    broken.clear.set_pixel(3, 3, [f32::NAN; 3]);
    assert!(proposer.propose(&broken).unwrap_err().to_string().contains("not finite"));
    assert!(SceneSurvey::default().add(&SceneView { clear: Image::new(0, 0), ..broken }).is_err());
}
