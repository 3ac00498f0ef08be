//! Tests the estimate on observations made with known water: exact results, changes that must not matter,
//! and inputs that must be refused.

use glam::DVec3;
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_water::{
    Observation, OpenWater, PointColor, Sights, Verdict, Water, WaterParams, estimate, estimate_sizes,
    shows_air,
};

/// The water and the views of a test.
#[derive(Clone, Copy)]
struct Truth {
    attenuation: [f64; 3],
    backscatter: [f64; 3],
    /// `B(d) = veil (1 + slope · d)`.
    veil: [f64; 3],
    slope: DVec3,
    noise: f64,
    /// Standard deviation of the logarithm of the views' gains.
    gains: f64,
    points: usize,
}

const SEA: Truth = Truth {
    attenuation: [0.40, 0.15, 0.12],
    backscatter: [0.30, 0.16, 0.13],
    veil: [0.15, 0.45, 0.55],
    slope: DVec3::new(0.1, 0.0, 0.6),
    noise: 0.0,
    gains: 0.0,
    points: 500,
};

const VIEWS: usize = 12;

struct Made {
    observations: Vec<Observation>,
    positions: Vec<DVec3>,
    radiances: Vec<[f64; 3]>,
    gains: Vec<[f64; 3]>,
}

/// A swim along y over points on uneven ground; about every second view sees each point.
fn make(truth: &Truth) -> Made {
    let draw = |purpose, i: usize| Stream::new(7, Purpose::new(purpose), i as u64);
    let mut gains: Vec<[f64; 3]> = (0..VIEWS)
        .map(|v| std::array::from_fn(|c| math::exp(truth.gains * draw("gain", v).normal(c as u64))))
        .collect();
    for c in 0..3 {
        let mean = gains.iter().map(|g| math::ln(g[c])).sum::<f64>() / VIEWS as f64;
        gains.iter_mut().for_each(|g| g[c] /= math::exp(mean));
    }
    let mut made = Made { observations: vec![], positions: vec![], radiances: vec![], gains };
    for point in 0..truth.points {
        let d = draw("point", point);
        let position =
            DVec3::new(6.0 * d.uniform(0) - 3.0, 4.0 + 8.0 * d.uniform(1), 1.5 * d.uniform(2) - 2.0);
        let radiance: [f64; 3] = std::array::from_fn(|c| 0.04 + 0.8 * d.uniform(3 + c as u64));
        for view in 0..VIEWS {
            let center = DVec3::new(0.4 * math::sin(view as f64), 0.6 * view as f64 - 3.0, 0.1 * view as f64);
            if d.uniform(20 + view as u64) < 0.4 {
                continue;
            }
            let (distance, direction) = ((position - center).length(), (position - center).normalize());
            let value = std::array::from_fn(|c| {
                let veil = truth.veil[c] * (1.0 + truth.slope.dot(direction)).max(0.0);
                let clean = radiance[c] * math::exp(-truth.attenuation[c] * distance)
                    + veil * (1.0 - math::exp(-truth.backscatter[c] * distance));
                made.gains[view][c] * clean + truth.noise * d.normal((100 + 3 * view + c) as u64)
            });
            made.observations.push(Observation {
                point,
                view,
                distance,
                direction,
                value,
                spread: [0.02; 3],
            });
        }
        made.positions.push(position);
        made.radiances.push(radiance);
    }
    made
}

fn solve(made: &Made, params: &WaterParams) -> Water {
    let sights = Sights { points: made.observations.clone(), open: vec![] };
    estimate(&sights, made.positions.len(), &made.positions, VIEWS, params)
}

fn near(found: f64, truth: f64, relative: f64, what: &str) {
    assert!((found / truth - 1.0).abs() < relative, "{what}: {found} in place of {truth}");
}

#[test]
fn without_noise_everything_is_recovered() {
    let made = make(&SEA);
    let water = solve(&made, &WaterParams::default());
    for (c, w) in water.channels.iter().enumerate() {
        assert_eq!(w.verdict, Verdict::Found, "channel {c}: {w:?}");
        near(w.attenuation.value, SEA.attenuation[c], 2e-3, "attenuation");
        near(w.backscatter.value, SEA.backscatter[c], 1e-2, "backscatter");
        near(w.veil_constant, SEA.veil[c], 1e-2, "veil");
        near(w.veil_slope[2], SEA.veil[c] * SEA.slope.z, 2e-2, "slope");
        assert!(w.attenuation.error < 0.01 * w.attenuation.value && w.explained > 0.9);
    }
    for (found, truth) in water.radiances.iter().zip(&made.radiances) {
        let found = found.expect("every point was seen");
        assert!((0..3).all(|c| (found[c].value - truth[c]).abs() < 0.01), "{found:?} {truth:?}");
    }
    assert!(water.gains.iter().flatten().all(|g| *g == 1.0), "there are none to find");
}

#[test]
fn noise_and_outliers_move_it_little_and_its_errors_say_how_much() {
    let mut made = make(&Truth { noise: 0.01, ..SEA });
    for o in made.observations.iter_mut().step_by(15) {
        o.value = [0.9, 0.1, 0.5];
    }
    let water = solve(&made, &WaterParams::default());
    for (c, w) in water.channels.iter().enumerate() {
        near(w.attenuation.value, SEA.attenuation[c], 0.1, "attenuation");
        let off = (w.attenuation.value - SEA.attenuation[c]).abs() / w.attenuation.error;
        assert!(off < 4.0, "channel {c} is off by {off:.1} standard errors: {w:?}");
        assert!(math::hypot(w.noise[0], 0.02 * w.noise[1]) < 0.02, "{:?}", w.noise);
    }
}

#[test]
fn the_unit_of_length_does_not_matter() {
    let made = make(&Truth { noise: 0.005, ..SEA });
    let mut scaled = make(&Truth { noise: 0.005, ..SEA });
    for o in &mut scaled.observations {
        o.distance *= 20.0;
    }
    let (a, b) = (solve(&made, &WaterParams::default()), solve(&scaled, &WaterParams::default()));
    for (x, y) in a.channels.iter().zip(&b.channels) {
        near(y.attenuation.value, x.attenuation.value / 20.0, 1e-6, "attenuation");
        near(y.attenuation.error, x.attenuation.error / 20.0, 1e-4, "its error");
        near(y.backscatter.value, x.backscatter.value / 20.0, 1e-6, "backscatter");
        near(y.veil.value, x.veil.value, 1e-6, "veil");
        assert_eq!(x.verdict, y.verdict);
    }
}

#[test]
fn neither_the_order_of_observations_nor_of_points_nor_the_threads_matter() {
    let made = make(&Truth { noise: 0.005, points: 300, ..SEA });
    let params = WaterParams::default();
    let reference = solve(&made, &params);
    let order = Stream::new(3, Purpose::new("order"), 0).permutation(made.positions.len());
    let mut shuffled = Made { observations: vec![], positions: made.positions.clone(), ..make(&SEA) };
    for (old, &new) in order.iter().enumerate() {
        shuffled.positions[new] = made.positions[old];
    }
    shuffled.observations =
        made.observations.iter().rev().map(|o| Observation { point: order[o.point], ..*o }).collect();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build().unwrap();
    let found = pool.install(|| solve(&shuffled, &params));
    assert_eq!(found.channels, reference.channels, "to the last bit");
    assert_eq!(found.radiances[order[5]], reference.radiances[5]);
}

#[test]
fn gains_of_the_views_are_found_where_they_are_and_not_where_they_are_not() {
    let made = make(&Truth { noise: 0.003, gains: 0.12, ..SEA });
    let water = solve(&made, &WaterParams::default());
    for c in 0..3 {
        let product: f64 = water.gains.iter().map(|g| math::ln(g[c])).sum();
        assert!(product.abs() < 1e-6, "their geometric mean is 1");
        for (found, truth) in water.gains.iter().zip(&made.gains) {
            near(found[c], truth[c], 0.06, "gain");
        }
        near(water.channels[c].attenuation.value, SEA.attenuation[c], 0.15, "attenuation");
        assert!(water.channels[c].gains_explain > 0.5);
    }
    let held = solve(&made, &WaterParams { gains: false, ..WaterParams::default() });
    assert!(held.gains.iter().flatten().all(|g| *g == 1.0));
    let none = solve(&make(&Truth { noise: 0.01, ..SEA }), &WaterParams::default());
    assert!(none.gains.iter().flatten().all(|g| *g == 1.0));
    assert!(none.channels.iter().all(|w| w.gains_explain < 0.1), "{:?}", none.channels[0].gains_explain);
}

/// Cells along the horizon, seen by every view.
fn open_water(truth: &Truth) -> Vec<OpenWater> {
    (0..VIEWS * 20)
        .map(|i| {
            let angle = 0.05 * (i / VIEWS) as f64 - 0.5;
            let direction = DVec3::new(math::sin(angle), 1.0, 0.1).normalize();
            let veil = |c: usize| truth.veil[c] * (1.0 + truth.slope.dot(direction));
            OpenWater { view: i % VIEWS, direction, value: std::array::from_fn(veil) }
        })
        .collect()
}

#[test]
fn open_water_tells_the_veil_where_the_tracks_cannot() {
    // Clear water: over these distances the veil is a straight line, and tracks measure only its slope.
    let clear =
        Truth { attenuation: [0.09, 0.03, 0.025], backscatter: [0.03, 0.025, 0.02], noise: 0.004, ..SEA };
    let made = make(&clear);
    let with = |open: Vec<OpenWater>| {
        let sights = Sights { points: made.observations.clone(), open };
        estimate(&sights, made.positions.len(), &made.positions, VIEWS, &WaterParams::default())
    };
    let (without, told) = (with(vec![]), with(open_water(&clear)));
    assert_eq!((without.open, told.open), (0, VIEWS * 20));
    for c in 0..3 {
        let (alone, w) = (&without.channels[c], &told.channels[c]);
        near(w.veil_constant, clear.veil[c], 0.05, "veil");
        near(w.backscatter.value, clear.backscatter[c], 0.2, "backscatter");
        assert!(w.backscatter.error < alone.backscatter.error, "{w:?}, alone {alone:?}");
    }
    // A sky is even and far, and it is not water.
    let air = Truth { attenuation: [0.0; 3], backscatter: [0.0; 3], noise: 0.01, ..SEA };
    let made = make(&air);
    let sights = Sights { points: made.observations.clone(), open: open_water(&SEA) };
    let water = estimate(&sights, made.positions.len(), &made.positions, VIEWS, &WaterParams::default());
    assert!(water.channels.iter().all(|w| w.verdict == Verdict::NoWater), "{:?}", water.channels);
}

#[test]
fn air_has_no_water() {
    let air = Truth { attenuation: [0.0; 3], backscatter: [0.0; 3], noise: 0.01, ..SEA };
    let water = solve(&make(&air), &WaterParams::default());
    for w in &water.channels {
        assert_eq!(w.verdict, Verdict::NoWater, "{w:?}");
        assert!(!w.verdict.usable());
    }
    assert!(!water.grey);
}

#[test]
fn a_grey_haze_is_called_grey() {
    let haze = Truth { attenuation: [0.15; 3], backscatter: [0.15; 3], noise: 0.005, ..SEA };
    assert!(solve(&make(&haze), &WaterParams::default()).grey);
    assert!(!solve(&make(&Truth { noise: 0.005, ..SEA }), &WaterParams::default()).grey);
}

#[test]
fn what_cannot_tell_is_refused() {
    let refused = |made: &Made, params: &WaterParams| {
        let water = solve(made, params);
        assert!(water.channels.iter().all(|w| w.verdict == Verdict::TooFewPoints), "{:?}", water.channels);
        assert!(
            water.channels.iter().all(|w| w.attenuation.value == 0.0 && w.attenuation.error.is_infinite())
        );
        water
    };
    let params = WaterParams::default();
    let nothing = Made { observations: vec![], positions: vec![], radiances: vec![], gains: vec![] };
    refused(&nothing, &params);
    // Every point is always seen from the same distance.
    let mut round = make(&SEA);
    round.observations.iter_mut().for_each(|o| o.distance = 5.0 + 0.3 * (o.view % 2) as f64);
    assert_eq!(refused(&round, &params).points, 0);
    // There is only one view.
    let mut one = make(&SEA);
    one.observations.retain(|o| o.view == 3);
    refused(&one, &params);
    // Without a lower limit, few points are not an error either.
    let mut few = make(&SEA);
    few.observations.retain(|o| o.point < 4);
    let water = solve(&few, &WaterParams { min_points: 0, ..params });
    assert!(water.channels.iter().all(|w| !w.attenuation.value.is_nan()));
    // Meaningless parameters still give finite values.
    let odd = WaterParams { ratio_width: f64::NAN, ..params };
    assert!(solve(&make(&SEA), &odd).channels.iter().all(|w| w.attenuation.value.is_finite()));
    refused(&make(&SEA), &WaterParams { distance_ratio: f64::NAN, ..params });
    // The camera clips one channel everywhere; the other channels are found.
    let mut clipped = make(&Truth { noise: 0.005, ..SEA });
    clipped.observations.iter_mut().for_each(|o| o.value[0] = f64::NAN);
    let water = solve(&clipped, &params);
    assert_eq!(water.channels[0].verdict, Verdict::TooFewPoints);
    assert_eq!(water.channels[1].verdict, Verdict::Found);
}

#[test]
fn observations_that_make_no_sense_are_left_out() {
    let made = make(&Truth { noise: 0.005, ..SEA });
    let reference = solve(&made, &WaterParams::default());
    let mut bad = make(&Truth { noise: 0.005, ..SEA });
    let some = bad.observations[0];
    bad.observations.extend([
        Observation { distance: f64::NAN, view: 3, ..some },
        Observation { distance: -1.0, view: 4, ..some },
        Observation { distance: f64::INFINITY, view: 5, ..some },
        Observation { direction: DVec3::NAN, view: 6, ..some },
        Observation { point: 1_000_000, ..some },
        Observation { view: VIEWS, ..some },
    ]);
    assert_eq!(solve(&bad, &WaterParams::default()).channels, reference.channels);
}

/// The sky over a castle is even and far behind everything, and it is not water.
#[test]
fn what_is_brighter_than_white_is_no_open_water() {
    let sky = Truth {
        attenuation: [0.15; 3],
        backscatter: [0.04; 3],
        veil: [1.3, 1.4, 1.5],
        slope: DVec3::ZERO,
        noise: 0.004,
        ..SEA
    };
    let made = make(&sky);
    let with = |open: Vec<OpenWater>| {
        let sights = Sights { points: made.observations.clone(), open };
        estimate(&sights, made.positions.len(), &made.positions, VIEWS, &WaterParams::default())
    };
    let told = with(open_water(&sky));
    assert_eq!(told.open, 0);
    assert_eq!(told, with(vec![]));
}

/// The camera clips red to black in open water. The gradient with respect to `ln B` vanishes there, so
/// tracks and cells would agree on no veil at all. The veil is assumed instead, and reported as assumed.
#[test]
fn a_veil_that_the_camera_clipped_is_assumed_and_said_to_be() {
    let dark = Truth { veil: [0.03, 0.45, 0.55], backscatter: [0.40, 0.16, 0.13], noise: 0.004, ..SEA };
    let made = make(&dark);
    let mut open = open_water(&dark);
    open.iter_mut().for_each(|o| o.value[0] = 0.002);
    let with = |open: Vec<OpenWater>| {
        let sights = Sights { points: made.observations.clone(), open };
        estimate(&sights, made.positions.len(), &made.positions, VIEWS, &WaterParams::default())
    };
    let water = with(open.clone());
    let [red, green, _] = &water.channels;
    assert_eq!(water.channels.each_ref().map(|w| w.veil_assumed), [true, false, false]);
    near(red.veil.value, 0.07 * green.veil.value, 0.1, "the veil");
    assert!(red.veil.error > 0.3 * red.veil.value, "it is a guess: {red:?}");
    assert_eq!(red.veil_slope, [0.0; 3]);
    near(red.backscatter.value, red.attenuation.value, 0.1, "backscatter");
    assert!(red.verdict.usable() && red.verdict != Verdict::Found, "{red:?}");
    near(red.attenuation.value, SEA.attenuation[0], 0.1, "red");
    near(green.attenuation.value, SEA.attenuation[1], 0.05, "green");
    // A few dark cells do not count as clipping.
    open.iter_mut().skip(90).for_each(|o| o.value[0] = 0.15);
    assert!(with(open).channels.iter().all(|w| !w.veil_assumed));
}

/// A veil that is darker than any linear veil in some directions: the fit bends down to zero and no
/// further.
#[test]
fn the_veil_is_negative_in_no_direction_that_was_seen() {
    let steep = Truth { slope: DVec3::new(0.0, 0.0, 3.0), noise: 0.004, ..SEA };
    let made = make(&steep);
    let darkest = |water: &Water| {
        let veils = made.observations.iter().flat_map(|o| {
            let veil = |w: &use3d_water::ChannelWater| {
                (w.veil_constant + DVec3::from_array(w.veil_slope).dot(o.direction)) / w.veil.value
            };
            water.channels.iter().map(veil).collect::<Vec<_>>()
        });
        veils.fold(f64::INFINITY, f64::min)
    };
    let water = solve(&made, &WaterParams::default());
    assert!(darkest(&water) > -0.02, "{}", darkest(&water));
    assert!(water.channels.iter().all(|w| w.verdict.usable()), "{:?}", water.channels);
}

#[test]
fn errors_count_what_the_images_size_changes() {
    let (made, other) = (
        make(&Truth { noise: 0.004, ..SEA }),
        make(&Truth { noise: 0.004, attenuation: [0.40, 0.25, 0.12], ..SEA }),
    );
    let sights = |made: &Made| Sights { points: made.observations.clone(), open: vec![] };
    let sizes = |half: &Made| {
        let both = [sights(&made), sights(half)];
        estimate_sizes(&both, made.positions.len(), &made.positions, VIEWS, &WaterParams::default())
    };
    let alone = solve(&made, &WaterParams::default());
    let (same, moved) = (sizes(&made), sizes(&other));
    assert_eq!(same.channels, alone.channels, "sizes that agree widen nothing");
    let (green, was) = (&moved.channels[1], &alone.channels[1]);
    assert_eq!(green.attenuation.value, was.attenuation.value, "the full size decides");
    assert!((green.attenuation.error - 0.1).abs() < 0.02, "{green:?}");
    assert_eq!(green.verdict, Verdict::NotObservable, "two thirds off is not known");
    assert_eq!(moved.channels[2].verdict, was.verdict);
}

#[test]
fn a_veil_that_is_nearly_white_in_all_channels_is_a_sky() {
    let with = |veil: [f64; 3]| {
        let truth = Truth {
            attenuation: [0.15, 0.16, 0.14],
            backscatter: [0.15; 3],
            veil,
            slope: DVec3::ZERO,
            noise: 0.004,
            ..SEA
        };
        let made = make(&truth);
        let sights = Sights { points: made.observations.clone(), open: open_water(&truth) };
        estimate(&sights, made.positions.len(), &made.positions, VIEWS, &WaterParams::default())
    };
    let sky = with([0.86, 0.93, 0.95]);
    assert!(sky.sky && sky.channels.iter().all(|w| w.verdict == Verdict::NoWater), "{:?}", sky.channels);
    // A veil that is bright in only two channels is that of a lagoon.
    let lagoon = with([0.35, 0.9, 0.95]);
    assert!(!lagoon.sky && lagoon.channels.iter().all(|w| w.verdict.usable()), "{:?}", lagoon.channels);
}

/// Points of every brightness, 1 to 6 units away, seen through `attenuation` and `veil`.
fn point_colors(darkest: f64, attenuation: f64, veil: f64) -> Vec<PointColor> {
    (0..3000)
        .map(|i| {
            let d = Stream::new(11, Purpose::new("glance"), i);
            let distance = 1.0 + 5.0 * d.uniform(0);
            let left = math::exp(-attenuation * distance);
            let color = |c: u64| (darkest + (0.95 - darkest) * d.uniform(c)) * left + veil * (1.0 - left);
            PointColor { distance, value: [1, 2, 3].map(color) }
        })
        .collect()
}

#[test]
fn air_is_told_without_tracks_by_the_darkest_and_the_brightest_points() {
    assert!(shows_air(&point_colors(0.0, 0.0, 0.0)));
    assert!(!shows_air(&point_colors(0.0, 0.15, 0.4)), "far points are lit by a veil");
    assert!(!shows_air(&point_colors(0.0, 0.3, 0.0)), "dark water takes light away");
    assert!(!shows_air(&point_colors(0.2, 0.0, 0.0)), "nothing is dark: not known");
    assert!(!shows_air(&point_colors(0.0, 0.0, 0.0)[..600]), "too few");
    let mut alike = point_colors(0.0, 0.0, 0.0);
    alike.iter_mut().for_each(|g| g.distance = 3.0 + 0.1 * g.distance);
    assert!(!shows_air(&alike), "all as far");
    alike[7].value[1] = f64::NAN;
    alike[8].distance = f64::INFINITY;
    assert!(!shows_air(&alike));
}
