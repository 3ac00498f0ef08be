use super::*;
use glam::DVec3;
use use3d_capture::{Intrinsics, Pose};
use use3d_golden::Part;
use use3d_numerics::random::{Purpose, Stream};

/// Converts the gradient with respect to the conic (`xy` counted once) into that of the covariance:
/// `−C G C`.
fn conic_backward(c: [f64; 3], g: [f64; 3]) -> [f64; 3] {
    let (c, g) = ([[c[0], c[1]], [c[1], c[2]]], [[g[0], g[1] / 2.0], [g[1] / 2.0, g[2]]]);
    let entry = |i: usize, j: usize| {
        let mut sum = 0.0;
        for p in 0..2 {
            for q in 0..2 {
                sum -= c[i][p] * g[p][q] * c[q][j];
            }
        }
        sum
    };
    [entry(0, 0), entry(0, 1) + entry(1, 0), entry(1, 1)]
}

/// The projection of one Gaussian, on the plain twin.
fn project(
    projector: &Projector,
    mean: [f32; 3],
    scale: [f32; 3],
    quat: [f32; 4],
) -> Option<Projection<f64>> {
    let (projection, visible) = projector.project(&raw(mean, scale, quat));
    visible.then_some(projection)
}

fn raw(mean: [f32; 3], scale: [f32; 3], quat: [f32; 4]) -> Ellipsoid<f64> {
    Ellipsoid { mean: mean.map(f64::from), log_scale: scale.map(f64::from), quaternion: quat.map(f64::from) }
}

#[test]
fn golden_projection_and_its_gradients() {
    let part = Part::math("projection");
    for case in part.cases() {
        let projector = Projector::new(&case.camera());
        let (means, scales, quats) =
            (case.rows::<3>("in.means"), case.rows::<3>("in.log_scales"), case.rows::<4>("in.quats"));
        let n = means.len();
        let keep = case.f64("out.keep");
        let (mut mean2d, mut z, mut cov, mut conics) = (vec![], vec![], vec![], vec![]);
        for i in 0..n {
            let p = project(&projector, means[i], scales[i], quats[i]);
            assert_eq!(p.is_some(), keep[i] != 0.0, "{}: Gaussian {i}", case.name());
            let zero = Projection { mean: [0.0; 2], z: 0.0, cov: [0.0; 3] };
            let p = p.unwrap_or(zero);
            mean2d.extend(p.mean);
            // The golden file also stores the depth of culled Gaussians.
            z.push(projector.camera_frame(means[i].map(f64::from))[2]);
            cov.extend(p.cov);
            conics.extend(if keep[i] != 0.0 { conic(p.cov) } else { [0.0; 3] });
        }
        case.check_f64("out.mean2d", &mean2d);
        case.check_f64("out.z", &z);
        case.check_f64("out.cov2d", &cov);
        case.check_f64("out.conic", &conics);
        for pull in case.pulls().keys() {
            let (mut dm, mut ds, mut dq) = (vec![], vec![], vec![]);
            let cot = case.f64(&format!("cot.{pull}"));
            for i in 0..n {
                let (mut d_mean, mut d_z, mut d_cov) = ([0.0; 2], 0.0, [0.0; 3]);
                let c: [f64; 3] = conics[3 * i..3 * i + 3].try_into().unwrap();
                match pull.as_str() {
                    "mean2d" => d_mean = cot[2 * i..2 * i + 2].try_into().unwrap(),
                    "z" => d_z = cot[i],
                    "conic" => d_cov = conic_backward(c, cot[3 * i..3 * i + 3].try_into().unwrap()),
                    other => panic!("unknown pull {other}"),
                }
                let g = if keep[i] != 0.0 || pull == "z" {
                    let d = Projection { mean: d_mean, z: d_z, cov: d_cov };
                    projector.backward(&raw(means[i], scales[i], quats[i]), &d)
                } else {
                    raw([0.0; 3], [0.0; 3], [0.0; 4])
                };
                dm.extend(g.mean);
                ds.extend(g.log_scale);
                dq.extend(g.quaternion);
            }
            case.check_f64(&format!("grad.{pull}.means"), &dm);
            case.check_f64(&format!("grad.{pull}.log_scales"), &ds);
            case.check_f64(&format!("grad.{pull}.quats"), &dq);
        }
    }
}

#[test]
fn finite_differences_agree_on_random_gaussians() {
    let s = Stream::new(11, Purpose::new("projection finite differences"), 0);
    let camera = Camera {
        intrinsics: Intrinsics { width: 60, height: 40, fx: 55.0, fy: 58.0, cx: 31.0, cy: 18.5 },
        pose: Pose::look_at(
            DVec3::new(0.3, -0.2, -4.0),
            DVec3::new(0.1, 0.0, 0.0),
            DVec3::new(0.0, -1.0, 0.1),
        ),
    };
    let projector = Projector::new(&camera);
    for i in 0..50 {
        let n = |k: u64| s.normal(i * 32 + k) as f32;
        // Every fifth Gaussian lies far to the side, where the Jacobian's clamp is active.
        let side = if i % 5 == 0 { 6.0 } else { 0.7 };
        let mut p: [f32; 10] =
            [side * n(0), 0.7 * n(1), n(2), n(3) - 1.5, n(4) - 1.5, n(5) - 1.5, n(6), n(7), n(8), n(9)];
        let split = |p: &[f32; 10]| ([p[0], p[1], p[2]], [p[3], p[4], p[5]], [p[6], p[7], p[8], p[9]]);
        let cot: [f64; 6] = std::array::from_fn(|k| s.normal(i * 32 + 16 + k as u64));
        let loss = |p: &[f32; 10]| {
            let (m, l, q) = split(p);
            let r = project(&projector, m, l, q).unwrap();
            r.mean[0] * cot[0]
                + r.mean[1] * cot[1]
                + r.z * cot[2]
                + r.cov[0] * cot[3]
                + r.cov[1] * cot[4]
                + r.cov[2] * cot[5]
        };
        let (m, l, q) = split(&p);
        let d = Projection { mean: [cot[0], cot[1]], z: cot[2], cov: [cot[3], cot[4], cot[5]] };
        let g = projector.backward(&raw(m, l, q), &d);
        let gradient: Vec<f64> = g.mean.into_iter().chain(g.log_scale).chain(g.quaternion).collect();
        let size = gradient.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        for k in 0..10 {
            let (old, h) = (p[k], 2e-3f32);
            p[k] = old + h;
            let (up, high) = (loss(&p), p[k]);
            p[k] = old - h;
            let (down, low) = (loss(&p), p[k]);
            p[k] = old;
            let numeric = (up - down) / (f64::from(high) - f64::from(low));
            assert!(
                (numeric - gradient[k]).abs() < 2e-4 * size,
                "Gaussian {i}, parameter {k}: {numeric} against {}",
                gradient[k]
            );
        }
    }
}

#[test]
fn what_is_no_gaussian_is_culled() {
    let camera = Camera {
        intrinsics: Intrinsics { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0 },
        pose: Pose::IDENTITY,
    };
    let projector = Projector::new(&camera);
    let one = [1.0, 0.0, 0.0, 0.0];
    assert!(project(&projector, [0.0, 0.0, 1.0], [-2.0; 3], one).is_some());
    for (mean, scale, quat) in [
        ([f32::NAN, 0.0, 1.0], [-2.0; 3], one),
        ([0.0, 0.0, f32::NAN], [-2.0; 3], one),
        ([f32::INFINITY, 0.0, 1.0], [-2.0; 3], one),
        ([0.0, 0.0, 1.0], [f32::NAN; 3], one),
        ([0.0, 0.0, 1.0], [f32::INFINITY; 3], one),
        ([0.0, 0.0, 1.0], [1e30; 3], one),
        ([0.0, 0.0, 1.0], [-2.0; 3], [0.0; 4]),
        ([0.0, 0.0, 1.0], [-2.0; 3], [f32::NAN, 0.0, 0.0, 1.0]),
        ([0.0, 0.0, -1.0], [-2.0; 3], one),
        ([0.0, 0.0, 1e-42], [-2.0; 3], one),
    ] {
        assert!(project(&projector, mean, scale, quat).is_none(), "{mean:?} {scale:?} {quat:?}");
    }
    assert!(project(&projector, [0.0, 0.0, 1.0], [f32::NEG_INFINITY; 3], [1e-42, 0.0, 0.0, 0.0]).is_some());
}
