//! The world by measured places of cameras: positions in metres, or depths below the surface.

use glam::{DMat3, DQuat, DVec3};
use use3d_capture::World;

/// Rotations of the eigenvalue method; a symmetric matrix of four rows needs a handful.
const SWEEPS: usize = 60;

/// A world by measured positions.
#[derive(Clone, Debug)]
pub struct PositionsFit {
    /// The world.
    pub world: World,
    /// The root mean square of the distances that are left, metres.
    pub left: f64,
    /// One standard error of the metres of a unit, as a share of them.
    pub error: f64,
}

/// The similarity that takes `(model, metres)` pairs onto each other with the least squares. `None` with
/// fewer than three pairs and where they lie on one line.
///
/// The rotation is the unit quaternion with the largest eigenvalue of Horn's matrix of the correlations. The
/// standard error counts the `3n − 7` coordinates that are left after a similarity's seven parameters.
pub fn fit_positions(pairs: &[(DVec3, DVec3)], source: String) -> Option<PositionsFit> {
    if pairs.len() < 3 {
        return None;
    }
    let n = pairs.len() as f64;
    let mean = pairs.iter().fold((DVec3::ZERO, DVec3::ZERO), |m, p| (m.0 + p.0 / n, m.1 + p.1 / n));
    let centred: Vec<(DVec3, DVec3)> = pairs.iter().map(|p| (p.0 - mean.0, p.1 - mean.1)).collect();
    // m[i][j] is the sum of model_i times metres_j.
    let mut m = [[0.0; 3]; 3];
    for (a, b) in &centred {
        let (a, b) = (a.to_array(), b.to_array());
        (0..9).for_each(|k| m[k / 3][k % 3] += a[k / 3] * b[k % 3]);
    }
    let [[xx, xy, xz], [yx, yy, yz], [zx, zy, zz]] = m;
    let horn = [
        [xx + yy + zz, yz - zy, zx - xz, xy - yx],
        [yz - zy, xx - yy - zz, xy + yx, zx + xz],
        [zx - xz, xy + yx, yy - xx - zz, yz + zy],
        [xy - yx, zx + xz, yz + zy, zz - xx - yy],
    ];
    let (values, vectors) = eigen(horn);
    let mut order = [0, 1, 2, 3];
    order.sort_by(|&a, &b| values[b].total_cmp(&values[a]));
    // On one line any turn about it fits as well: the two largest eigenvalues are equal.
    if values[order[0]] - values[order[1]] <= 1e-6 * values[order[0]].abs() {
        return None;
    }
    let [w, x, y, z] = std::array::from_fn(|row| vectors[row][order[0]]);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w));
    let spread: f64 = centred.iter().map(|p| p.0.length_squared()).sum();
    let scale = centred.iter().map(|(a, b)| b.dot(rotation * *a)).sum::<f64>() / spread;
    if !(scale.is_finite() && scale > 0.0) {
        return None;
    }
    let translation = mean.1 - scale * (rotation * mean.0);
    let left: f64 = centred.iter().map(|(a, b)| (*b - scale * (rotation * *a)).length_squared()).sum();
    let error = (left / (3.0 * n - 7.0) / spread).sqrt() / scale;
    let world = World::of(scale, &rotation, translation, source);
    Some(PositionsFit { world, left: (left / n).sqrt(), error })
}

/// The eigenvalues of a symmetric matrix, and its eigenvectors as columns, by Jacobi's rotations.
fn eigen<const N: usize>(mut a: [[f64; N]; N]) -> ([f64; N], [[f64; N]; N]) {
    let mut v: [[f64; N]; N] = std::array::from_fn(|i| std::array::from_fn(|j| f64::from(u8::from(i == j))));
    for _ in 0..SWEEPS {
        let mut largest = (0, 0, 0.0f64);
        for i in 0..N {
            for j in i + 1..N {
                if a[i][j].abs() > largest.2 {
                    largest = (i, j, a[i][j].abs());
                }
            }
        }
        let (p, q, size) = largest;
        let whole: f64 = (0..N).map(|i| a[i][i].abs()).sum();
        if size <= 1e-16 * whole {
            break;
        }
        // tan of the angle that makes the entry 0, without trigonometry.
        let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
        let t = if theta >= 0.0 { 1.0 } else { -1.0 } / (theta.abs() + (theta * theta + 1.0).sqrt());
        let c = 1.0 / (t * t + 1.0).sqrt();
        let s = t * c;
        for row in a.iter_mut().chain(&mut v) {
            (row[p], row[q]) = (c * row[p] - s * row[q], s * row[p] + c * row[q]);
        }
        for k in 0..N {
            (a[p][k], a[q][k]) = (c * a[p][k] - s * a[q][k], s * a[p][k] + c * a[q][k]);
        }
    }
    (std::array::from_fn(|i| a[i][i]), v)
}

/// The scale and the direction down by `(model position, depth in metres)` pairs: `depth = w · x + d` with
/// the least squares. The metres of a unit are `|w|`. Returns the world with z up and the surface at `z = 0`,
/// and the standard error of the metres as a share. `None` with fewer than five pairs, and where positions do
/// not fill space.
pub fn fit_depths(pairs: &[(DVec3, f64)], source: String) -> Option<(World, f64)> {
    if pairs.len() < 5 {
        return None;
    }
    let n = pairs.len() as f64;
    let mean = pairs.iter().fold((DVec3::ZERO, 0.0), |m, p| (m.0 + p.0 / n, m.1 + p.1 / n));
    let (mut normal, mut right) = (DMat3::ZERO, DVec3::ZERO);
    for (x, depth) in pairs {
        let x = *x - mean.0;
        normal += DMat3::from_cols(x * x.x, x * x.y, x * x.z);
        right += x * (depth - mean.1);
    }
    let (values, _) = eigen(normal.transpose().to_cols_array_2d());
    let largest = values.iter().copied().fold(0.0, f64::max);
    if values.iter().any(|v| *v <= 1e-8 * largest) {
        return None;
    }
    let inverse = normal.inverse();
    let w = inverse * right;
    let scale = w.length();
    if !(scale.is_finite() && scale > 0.0) {
        return None;
    }
    let left: f64 = pairs.iter().map(|(x, depth)| depth - mean.1 - w.dot(*x - mean.0)).map(|r| r * r).sum();
    let down = w / scale;
    // The variance of |w| is that of w along itself.
    let error = (left / (n - 4.0) * down.dot(inverse * down)).sqrt() / scale;
    let up = -down;
    let side = if up.x.abs() < 0.9 { DVec3::X } else { DVec3::Y };
    let x = (side - up * side.dot(up)).normalize();
    let rotation = DMat3::from_cols(x, up.cross(x), up).transpose();
    let height = -(mean.1 - w.dot(mean.0));
    Some((World::of(scale, &rotation, DVec3::new(0.0, 0.0, height), source), error))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn places() -> Vec<DVec3> {
        (0..12).map(f64::from).map(|i| DVec3::new(0.4 * i, 0.03 * i * i - 1.0, 0.5 * (i % 3.0))).collect()
    }

    #[test]
    fn positions_of_the_size_of_utm_keep_the_millimetre() {
        let turn = DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 2.1);
        let origin = DVec3::new(512_345.678, 4_256_836.521, -12.25);
        let pairs: Vec<(DVec3, DVec3)> =
            places().iter().map(|p| (*p, 0.731 * (turn * *p) + origin)).collect();
        let PositionsFit { world, left, .. } = fit_positions(&pairs, "test".into()).unwrap();
        assert!((world.metres_per_unit / 0.731 - 1.0).abs() < 1e-9 && left < 1e-8, "{world:?} {left}");
        for (model, metres) in &pairs {
            let found = DVec3::from_array(world.apply(model.to_array()));
            assert!((found - *metres).length() < 1e-6, "{found} {metres}");
            assert!((DVec3::from_array(world.invert(found.to_array())) - *model).length() < 1e-6);
        }
        // Errors of a few centimetres are said.
        let noisy: Vec<_> = (0i32..)
            .zip(&pairs)
            .map(|(i, (a, b))| (*a, *b + DVec3::new(0.05 * f64::from(i % 3 - 1), 0.0, 0.0)))
            .collect();
        let PositionsFit { world, left, .. } = fit_positions(&noisy, "test".into()).unwrap();
        assert!((world.metres_per_unit / 0.731 - 1.0).abs() < 0.03 && (0.01..0.06).contains(&left), "{left}");
        let line: Vec<_> = pairs.iter().map(|p| (DVec3::X * p.0.x, DVec3::Y * p.0.x)).collect();
        assert!(
            fit_positions(&line, String::new()).is_none()
                && fit_positions(&pairs[..2], String::new()).is_none()
        );
    }

    #[test]
    fn the_standard_error_of_positions_is_that_of_many_measurements_also_with_three_and_four() {
        // Errors of a receiver, uniform within ±1.
        let mut state = 1u64;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        };
        for (count, rounds) in [(3, 4000), (4, 2000), (12, 500)] {
            let model: Vec<DVec3> = places().iter().step_by(12 / count).copied().take(count).collect();
            let (mut stated, mut real) = (0.0, 0.0);
            for _ in 0..rounds {
                let noise = |p: &DVec3| *p + 0.02 * DVec3::new(random(), random(), random());
                let metres: Vec<DVec3> = model.iter().map(noise).collect();
                let pairs: Vec<_> = model.iter().copied().zip(metres).collect();
                let fit = fit_positions(&pairs, String::new()).unwrap();
                stated += fit.error * fit.error / f64::from(rounds);
                real += use3d_numerics::math::powi(fit.world.metres_per_unit - 1.0, 2) / f64::from(rounds);
            }
            let ratio = (stated / real).sqrt();
            assert!((0.9..1.1).contains(&ratio), "{count} positions: {ratio}");
        }
    }

    #[test]
    fn depths_give_the_scale_and_the_direction_down() {
        let down = DVec3::new(0.1, 0.9, -0.3).normalize();
        let pairs: Vec<(DVec3, f64)> = places().iter().map(|p| (*p, 0.8 * down.dot(*p) + 11.0)).collect();
        let (world, error) = fit_depths(&pairs, "test".into()).unwrap();
        assert!((world.metres_per_unit - 0.8).abs() < 1e-9 && error < 1e-6, "{world:?} {error}");
        for (x, depth) in &pairs {
            assert!((world.apply(x.to_array())[2] + depth).abs() < 1e-9, "z is minus the depth");
        }
        assert!((world.rotation().determinant() - 1.0).abs() < 1e-9);
        // A gauge with a step of 10 cm.
        let coarse: Vec<_> = pairs.iter().map(|(x, d)| (*x, (10.0 * d).round() / 10.0)).collect();
        let (world, error) = fit_depths(&coarse, "test".into()).unwrap();
        let off = (world.metres_per_unit / 0.8 - 1.0).abs();
        assert!(off < 3.0 * error && error < 0.1, "{off} {error}");
        // On one line nothing is known of the other directions.
        let line: Vec<_> = pairs.iter().map(|p| (DVec3::X * p.0.x, p.1)).collect();
        assert!(fit_depths(&line, String::new()).is_none());
    }
}
