//! Tests of the poses between known frames, and a measurement on real captures.

use glam::{DMat3, DQuat, DVec3};
use use3d_capture::Pose;
use use3d_numerics::math;

use super::{FilmPath, FilmPose, LARGEST_GAP};

fn pose_at(known: &[(f64, Pose)], seconds: f64) -> FilmPose {
    FilmPath::new(known, None).at(seconds)
}

fn turn(axis: DVec3, angle: f64) -> DMat3 {
    DMat3::from_axis_angle(axis.normalize(), angle)
}

/// A camera on a curved path that turns at an uneven speed.
fn swim(t: f64) -> Pose {
    let center = DVec3::new(1.3 * t, 0.4 * math::sin(0.9 * t), 0.2 * t * t);
    let rotation =
        turn(DVec3::Y, 0.5 * math::sin(t)) * turn(DVec3::X, 0.2 * t) * turn(DVec3::Z, -0.1 * t * t);
    Pose::from_center(rotation, center)
}

fn known() -> Vec<(f64, Pose)> {
    [0.0, 0.3, 0.5, 1.1, 1.4, 1.6, 2.3].map(|t| (t, swim(t))).to_vec()
}

/// The distance of centres, and the angle between rotations in radians.
fn apart(a: &Pose, b: &Pose) -> (f64, f64) {
    let way = DQuat::from_mat3(&(a.rotation.transpose() * b.rotation));
    (a.center().distance(b.center()), 2.0 * math::atan2(way.xyz().length(), way.w.abs()))
}

fn pose(known: &[(f64, Pose)], seconds: f64) -> Pose {
    pose_at(known, seconds).pose().unwrap()
}

#[test]
fn known_frames_are_met_exactly_and_nothing_is_extrapolated() {
    let known = known();
    for (seconds, at) in &known {
        let expected = FilmPose::Known { pose: *at, gap_seconds: 0.0, nearest_seconds: 0.0 };
        assert_eq!(pose_at(&known, *seconds), expected);
    }
    for (outside, away) in [(-0.25, 0.25), (2.5, 0.2), (f64::INFINITY, f64::INFINITY)] {
        let FilmPose::Far { nearest_seconds } = pose_at(&known, outside) else { panic!("{outside}") };
        assert!(nearest_seconds == away || (nearest_seconds - away).abs() < 1e-12, "{nearest_seconds}");
    }
    assert_eq!(pose_at(&known, f64::NAN).pose(), None);
    assert_eq!(pose_at(&[], 1.0), FilmPose::Far { nearest_seconds: f64::INFINITY });
    assert!(pose_at(&known[..1], 0.0).pose().is_some() && pose_at(&known[..1], 0.1).pose().is_none());
    let FilmPose::Known { gap_seconds, nearest_seconds, .. } = pose_at(&known, 0.6) else { panic!() };
    assert!((gap_seconds - 0.6).abs() < 1e-12 && (nearest_seconds - 0.1).abs() < 1e-12);
}

#[test]
fn an_even_motion_is_met_exactly_at_uneven_times() {
    let even =
        |t: f64| Pose::from_center(turn(DVec3::new(1.0, 2.0, -1.0), 0.7 * t), DVec3::new(t, -2.0 * t, 0.5));
    let known: Vec<(f64, Pose)> = [0.0, 0.2, 0.9, 1.0, 2.4].map(|t| (t, even(t))).to_vec();
    for i in 0..=240 {
        let t = f64::from(i) * 0.01;
        let (way, angle) = apart(&pose(&known, t), &even(t));
        assert!(way < 1e-12 && angle < 1e-7, "{t}: {way} {angle}");
    }
}

#[test]
fn a_curved_motion_is_met_better_by_more_frames() {
    let error = |step: f64| {
        let known: Vec<(f64, Pose)> =
            (0..=20).map(|i| (f64::from(i) * step, swim(f64::from(i) * step))).collect();
        let t = 10.5 * step;
        apart(&pose(&known, t), &swim(t))
    };
    let (coarse, fine) = (error(0.2), error(0.1));
    assert!(coarse.0 < 2e-4 && coarse.1 < 2e-3, "{coarse:?}");
    assert!(fine.0 < coarse.0 / 4.0 && fine.1 < coarse.1 / 4.0, "{fine:?} {coarse:?}");
}

#[test]
fn pose_and_velocity_are_continuous() {
    let path = FilmPath::new(&known(), None);
    let at = |t: f64| path.at(t).pose().unwrap();
    let h = 1e-5;
    for t in [0.3, 0.5, 1.1, 1.4, 1.6] {
        let (left, right) = (apart(&at(t - h), &at(t)), apart(&at(t), &at(t + h)));
        assert!((left.0 - right.0).abs() < 1e-3 * right.0, "{t}: {left:?} {right:?}");
        assert!((left.1 - right.1).abs() < 1e-3 * right.1 + 1e-8, "{t}: {left:?} {right:?}");
    }
    for i in 0..2299 {
        let t = f64::from(i) * 1e-3;
        let (way, angle) = apart(&at(t), &at(t + 1e-3));
        assert!(way < 4e-3 && angle < 2e-3, "{t}: {way} {angle}");
        at(t).validate().unwrap();
    }
}

#[test]
fn a_rigid_motion_of_the_world_moves_the_curve_with_it() {
    let (rotation, shift) = (turn(DVec3::new(-1.0, 0.3, 2.0), 2.1), DVec3::new(5.0, -3.0, 0.7));
    let moved =
        |p: &Pose| Pose::from_center(p.rotation * rotation.transpose(), rotation * p.center() + shift);
    let known = known();
    let other: Vec<(f64, Pose)> = known.iter().map(|(t, p)| (*t, moved(p))).collect();
    for i in 0..230 {
        let t = f64::from(i) * 0.01;
        let (way, angle) = apart(&pose(&other, t), &moved(&pose(&known, t)));
        assert!(way < 1e-12 && angle < 1e-7, "{t}: {way} {angle}");
    }
}

#[test]
fn the_sign_of_a_quaternion_does_not_matter() {
    // Between these two, quaternions from matrices change their sign.
    let known = [(0.0, 3.0), (1.0, 3.3)].map(|(t, a)| (t, Pose::from_center(turn(DVec3::Z, a), DVec3::ZERO)));
    let (_, angle) = apart(&pose(&known, 0.5), &Pose::from_center(turn(DVec3::Z, 3.15), DVec3::ZERO));
    assert!(angle < 1e-7, "{angle}");
}

#[test]
fn large_gaps_have_no_pose_and_bend_nothing() {
    let mut known = known();
    known.extend([9.0, 9.4, 9.8].map(|t| (t, swim(t))));
    assert_eq!(pose_at(&known, 5.0), FilmPose::Far { nearest_seconds: 5.0 - 2.3 });
    assert_eq!(pose(&known, 2.0), pose(&known[..7], 2.0));
    assert!(FilmPath::new(&known, Some(10.0)).at(5.0).pose().is_some());
    assert!(FilmPath::new(&known, Some(0.5)).at(0.8).pose().is_none());
    // Poses that are all far apart are used, but a gap of two spacings among them is not.
    let sparse: Vec<(f64, Pose)> = [0.0, 4.0, 8.0, 16.0, 20.0].map(|t| (t, swim(t))).to_vec();
    assert!(pose_at(&sparse, 6.0).pose().is_some() && pose_at(&sparse, 12.0).pose().is_none());
    assert_eq!(FilmPath::default_gap(&[]), LARGEST_GAP);
    // The order of the poses, a time that is there twice, and one that is no number change nothing.
    let mut mixed = known.clone();
    mixed.reverse();
    mixed.extend([(f64::NAN, swim(0.0)), (0.3, swim(0.3))]);
    assert_eq!(pose(&mixed, 0.7), pose(&known, 0.7));
}

mod measured {
    //! The error on real captures, in pixels. Known poses are left out, computed from the others, and
    //! compared.

    use std::path::Path;

    use use3d_capture::{Camera, Intrinsics};
    use use3d_io_colmap::read_model;

    use super::super::*;

    /// A way to compute poses.
    type Way = fn(&[(f64, Pose)], f64) -> Option<Pose>;

    fn linear(known: &[(f64, Pose)], t: f64) -> Option<Pose> {
        let i = known.partition_point(|k| k.0 <= t);
        let (a, b) = (Knot::new(known[i - 1].0, known[i - 1].1), Knot::new(known[i].0, known[i].1));
        let k = Knot::mix(&a, &b, t);
        Some(Pose::from_center(glam::DMat3::from_quat(k.rotation), k.center))
    }

    fn cubic(known: &[(f64, Pose)], t: f64) -> Option<Pose> {
        FilmPath::new(known, Some(f64::INFINITY)).at(t).pose()
    }

    /// The cubic centre with the linear rotation.
    fn cubic_center(known: &[(f64, Pose)], t: f64) -> Option<Pose> {
        Some(Pose::from_center(linear(known, t)?.rotation, cubic(known, t)?.center()))
    }

    /// The centripetal centre, as in films through given cameras, with the linear rotation.
    fn centripetal(known: &[(f64, Pose)], t: f64) -> Option<Pose> {
        let i = known.partition_point(|k| k.0 <= t) - 1;
        let c = |j: isize| -> DVec3 {
            let n = known.len() as isize;
            if j < 0 {
                2.0 * known[0].1.center() - known[1].1.center()
            } else if j >= n {
                2.0 * known[known.len() - 1].1.center() - known[known.len() - 2].1.center()
            } else {
                known[j as usize].1.center()
            }
        };
        let p: Vec<DVec3> = (0..4).map(|j| c(i as isize + j - 1)).collect();
        let knot = |a: DVec3, b: DVec3| (b - a).length().sqrt().max(1e-9);
        let mut s = vec![0.0];
        for j in 0..3 {
            s.push(s[j] + knot(p[j], p[j + 1]));
        }
        let u = s[1] + (t - known[i].0) / (known[i + 1].0 - known[i].0) * (s[2] - s[1]);
        let mix = |a: DVec3, b: DVec3, x: f64, y: f64| a + (b - a) * ((u - x) / (y - x));
        let (a, b, c) =
            (mix(p[0], p[1], s[0], s[1]), mix(p[1], p[2], s[1], s[2]), mix(p[2], p[3], s[2], s[3]));
        let center = mix(mix(a, b, s[0], s[2]), mix(b, c, s[1], s[3]), s[1], s[2]);
        Some(Pose::from_center(linear(known, t)?.rotation, center))
    }

    /// The median, and the value that nine tenths do not exceed.
    fn quantiles(mut values: Vec<f64>) -> (f64, f64) {
        values.sort_by(f64::total_cmp);
        (values[values.len() / 2], values[values.len() * 9 / 10])
    }

    #[test]
    fn poses_that_were_left_out_of_real_captures_are_met() {
        let Some(data) = std::env::var_os("USE3D_DATA") else {
            println!("skipped: USE3D_DATA does not name the folder with the real captures");
            return;
        };
        // The number in a name times the frames per number, over the frames per second.
        for (capture, per_second) in [("reef_deepreefmap", 29.97), ("vent_sucre", 25.0 / 12.0)] {
            let model = read_model(&Path::new(&data).join(capture).join("sparse/0")).unwrap();
            let camera = &model.cameras[0];
            let p = &camera.parameters;
            let (width, height) = (camera.width as usize, camera.height as usize);
            let intrinsics = Intrinsics { width, height, fx: p[0], fy: p[1], cx: p[2], cy: p[3] };
            let number = |name: &str| -> f64 {
                let digits: String = name.chars().filter(char::is_ascii_digit).collect();
                digits.parse().unwrap()
            };
            let mut all: Vec<(f64, Pose, Vec<DVec3>)> = model
                .images
                .iter()
                .map(|image| {
                    let seen: std::collections::BTreeSet<u64> =
                        image.keypoints.iter().map(|k| k.point).collect();
                    let points = model.points.iter().filter(|p| seen.contains(&p.id));
                    let points = points.map(|p| DVec3::from_array(p.position)).collect();
                    (number(image.name.as_str()) / per_second, image.pose(), points)
                })
                .collect();
            all.sort_by(|a, b| a.0.total_cmp(&b.0));
            for step in [2, 4, 8] {
                let ways: [(&str, Way); 4] = [
                    ("linear", linear),
                    ("cubic", cubic),
                    ("cubic centre", cubic_center),
                    ("centripetal", centripetal),
                ];
                let mut medians = Vec::new();
                for (name, way) in ways {
                    let mut errors = Vec::new();
                    let mut gaps = Vec::new();
                    for shift in 0..step {
                        let kept = all.iter().skip(shift).step_by(step);
                        let kept: Vec<(f64, Pose)> = kept.map(|a| (a.0, a.1)).collect();
                        for (i, (t, truth, points)) in all.iter().enumerate() {
                            let inside = *t > kept[0].0 && *t < kept[kept.len() - 1].0;
                            if i % step == shift || !inside {
                                continue;
                            }
                            let k = kept.partition_point(|k| k.0 <= *t);
                            gaps.push(kept[k].0 - kept[k - 1].0);
                            let pose = way(&kept, *t).unwrap();
                            let seen =
                                |pose: Pose, x: DVec3| Camera { intrinsics, pose }.project(x).map(|p| p.0);
                            let moved = points
                                .iter()
                                .filter_map(|x| Some(seen(*truth, *x)?.distance(seen(pose, *x)?)));
                            errors.push(quantiles(moved.collect()).0);
                        }
                    }
                    let (median, most) = quantiles(errors);
                    let gap = quantiles(gaps).0;
                    println!("{capture}, gap {gap:.2} s, {name}: median {median:.2} px, 90 % {most:.2} px");
                    medians.push(median);
                }
                assert!(
                    medians[1] < 1.1 * medians[0],
                    "the cubic curve is no worse than the line: {medians:?}"
                );
            }
        }
    }
}
