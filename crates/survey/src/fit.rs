//! The world by measured places of cameras: positions in metres, or depths below the surface.

use glam::{DMat3, DQuat, DVec3};
use use3d_capture::World;

/// Rotations of the eigenvalue method; a symmetric matrix of four rows needs a handful.
const SWEEPS: usize = 60;
/// Triples of positions that are tried to find false ones.
const TRIPLES: usize = 200;
/// A false position is at least this many times the largest error of the others beside their fit.
const FALSE: f64 = 3.0;
/// A fit that leaves less than this share of the errors of another is far better.
const BETTER: f64 = 0.35;

/// A world by measured positions.
#[derive(Clone, Debug)]
pub struct PositionsFit {
    /// The world.
    pub world: World,
    /// The root mean square of the distances that are left, metres, without the false ones.
    pub left: f64,
    /// One standard error of the metres of a unit, as a share of them.
    pub error: f64,
    /// Indices of positions that contradict all others and are left out.
    pub false_ones: Vec<usize>,
    /// True if the positions fit far better as their own mirror image.
    pub mirrored: bool,
}

/// The similarity that takes `(model, metres)` pairs onto each other with the least squares. `None` with
/// fewer than three pairs and where they lie on one line. The pairs are in the order of the swim.
///
/// Errors of receivers wander: those of neighbours are nearly equal. The errors `r_i` that are left are
/// taken as a random walk with the variance `q` per step and axis, and independent errors with the variance
/// `p`. Differences over `m` steps have the variance `m q + 2 p`, which gives `q`. With the turned positions
/// `a_i` about their mean, `A = Σ ‖a_i‖²` and `S_k = Σ_{i ≥ k} a_i`, the variance of the scale is
/// `(p A + q Σ_k ‖S_k‖²) / A²`. `p` is bounded by the errors' own variance, which counts the `3n − 7`
/// coordinates that are left after a similarity's seven parameters.
///
/// `floor` is an error in metres that all positions of a swim may share along it, so that it does not show in
/// `r_i`: some metres for GPS, 0 for measured positions. It adds `floor / √(A / n)` in quadrature.
///
/// A position is false if it is far beside the similarity that most positions agree on, and if the others fit
/// much better without it. At most a tenth can be false.
pub fn fit_positions(pairs: &[(DVec3, DVec3)], floor: f64, source: String) -> Option<PositionsFit> {
    let mut false_ones = Vec::new();
    let mut fit = Similarity::of(pairs)?;
    if let Some(others) = agreeing(pairs, &fit) {
        let kept: Vec<_> = others.iter().map(|i| pairs[*i]).collect();
        false_ones = (0..pairs.len()).filter(|i| !others.contains(i)).collect();
        fit = Similarity::of(&kept)?;
    }
    let mirror: Vec<_> =
        pairs.iter().map(|(at, metres)| (*at, *metres * DVec3::new(1.0, 1.0, -1.0))).collect();
    let doubtful = fit.left() > 0.01 * fit.scale * fit.spread().sqrt();
    let mirrored =
        doubtful && Similarity::of(&mirror).is_some_and(|other| other.left() < BETTER * fit.left());
    let world = World::of(fit.scale, &fit.rotation, fit.translation, source);
    Some(PositionsFit { world, left: fit.left(), error: fit.error(floor), false_ones, mirrored })
}

/// A similarity that was fitted to pairs.
struct Similarity {
    rotation: DMat3,
    scale: f64,
    translation: DVec3,
    /// The turned model positions about their mean, and the errors that are left, metres.
    pairs: Vec<(DVec3, DVec3)>,
}

impl Similarity {
    /// The fit with the least squares. The rotation is the unit quaternion with the largest eigenvalue of
    /// Horn's matrix of the correlations.
    fn of(pairs: &[(DVec3, DVec3)]) -> Option<Self> {
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
        let pairs = centred.iter().map(|(a, b)| (rotation * *a, *b - scale * (rotation * *a))).collect();
        Some(Self { rotation, scale, translation, pairs })
    }

    fn off(&self, (at, metres): &(DVec3, DVec3)) -> f64 {
        metres.distance(self.scale * (self.rotation * *at) + self.translation)
    }

    fn left(&self) -> f64 {
        (self.pairs.iter().map(|p| p.1.length_squared()).sum::<f64>() / self.pairs.len() as f64).sqrt()
    }

    /// The mean square of the positions about their mean, units of the model.
    fn spread(&self) -> f64 {
        self.pairs.iter().map(|p| p.0.length_squared()).sum::<f64>() / self.pairs.len() as f64
    }

    /// One standard error of the scale, as a share.
    fn error(&self, floor: f64) -> f64 {
        let n = self.pairs.len();
        let free = (3 * n - 7) as f64;
        let spread = self.spread() * n as f64;
        let alone = self.pairs.iter().map(|p| p.1.length_squared()).sum::<f64>() / free;
        let apart = |m: usize| {
            let pairs = self.pairs[m..].iter().zip(&self.pairs);
            let sum: f64 = pairs.map(|(b, a)| b.1.distance_squared(a.1)).sum();
            sum / (3 * (n - m)) as f64 * (3 * n) as f64 / free
        };
        let steps = (n / 6).max(2);
        let walk = if n < 8 { 0.0 } else { ((apart(steps) - apart(1)) / (steps - 1) as f64).max(0.0) };
        let (mut after, mut lever) = (DVec3::ZERO, 0.0);
        for (a, _) in self.pairs[1..].iter().rev() {
            after += *a;
            lever += after.length_squared();
        }
        let variance =
            (alone * spread + walk * lever) / (spread * spread) + floor * floor * n as f64 / spread;
        variance.sqrt() / self.scale
    }
}

/// The indices of the positions that agree, if a few others are false: the similarity of three positions with
/// the least median error names them.
fn agreeing(pairs: &[(DVec3, DVec3)], all: &Similarity) -> Option<Vec<usize>> {
    let n = pairs.len();
    if n < 6 {
        return None;
    }
    let mut state = 1u64;
    let mut draw = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 33) as usize) % n
    };
    let mut best: Option<(f64, Similarity)> = None;
    for _ in 0..TRIPLES {
        let Some(fit) = Similarity::of(&[0; 3].map(|_| pairs[draw()])) else { continue };
        let mut off: Vec<f64> = pairs.iter().map(|pair| fit.off(pair)).collect();
        let median = *off.select_nth_unstable_by(n / 2, f64::total_cmp).1;
        if best.as_ref().is_none_or(|(least, _)| median < *least) {
            best = Some((median, fit));
        }
    }
    let (_, fit) = best?;
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|a, b| fit.off(&pairs[*a]).total_cmp(&fit.off(&pairs[*b])));
    let of = |kept: &[usize]| Similarity::of(&kept.iter().map(|i| pairs[*i]).collect::<Vec<_>>());
    let core = &order[..n - (n / 10).max(1)];
    let fit = of(core)?;
    let worst = core.iter().map(|i| fit.off(&pairs[*i])).fold(0.0, f64::max);
    let kept: Vec<usize> = (0..n).filter(|i| fit.off(&pairs[*i]) <= FALSE * worst).collect();
    (kept.len() < n && of(&kept)?.left() < BETTER * all.left()).then_some(kept)
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
        let PositionsFit { world, left, .. } = fit_positions(&pairs, 0.0, "test".into()).unwrap();
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
        let PositionsFit { world, left, .. } = fit_positions(&noisy, 0.0, "test".into()).unwrap();
        assert!((world.metres_per_unit / 0.731 - 1.0).abs() < 0.03 && (0.01..0.06).contains(&left), "{left}");
        let line: Vec<_> = pairs.iter().map(|p| (DVec3::X * p.0.x, DVec3::Y * p.0.x)).collect();
        assert!(
            fit_positions(&line, 0.0, String::new()).is_none()
                && fit_positions(&pairs[..2], 0.0, String::new()).is_none()
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
                let fit = fit_positions(&pairs, 0.0, String::new()).unwrap();
                stated += fit.error * fit.error / f64::from(rounds);
                real += use3d_numerics::math::powi(fit.world.metres_per_unit - 1.0, 2) / f64::from(rounds);
            }
            let ratio = (stated / real).sqrt();
            // From eight positions on, errors may wander, and twelve cannot tell that these do not.
            let most = if count < 8 { 1.1 } else { 2.3 };
            assert!((0.9..most).contains(&ratio), "{count} positions: {ratio}");
        }
    }

    /// The share of seeds whose metres are used, and of these the share with true metres within two errors.
    fn walks(count: usize, size: f64, walk: f64, floor: f64) -> (f64, f64) {
        let (mut used, mut right) = (0, 0);
        for seed in 0..SEEDS {
            let mut state = seed * 7_919 + 17;
            let mut normal = || {
                let mut uniform = || {
                    state =
                        state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                    (state >> 11) as f64 / (1u64 << 53) as f64
                };
                (0..12).map(|_| uniform()).sum::<f64>() - 6.0
            };
            let step = walk / (count as f64).sqrt();
            let mut error = DVec3::ZERO;
            let pairs: Vec<_> = (0..count)
                .map(|i| {
                    let t = i as f64 / count as f64;
                    let way = [t, (4.0 * t).fract(), 0.1 * (9.0 * t).fract()];
                    let at = size * DVec3::from_array(way);
                    error += step * DVec3::new(normal(), normal(), 0.6 * normal());
                    (at, at + error)
                })
                .collect();
            let Some(fit) = fit_positions(&pairs, floor, String::new()) else { continue };
            if fit.error <= 0.1 {
                used += 1;
                right += u32::from(
                    (fit.world.metres_per_unit - 1.0).abs() <= 2.0 * fit.error * fit.world.metres_per_unit,
                );
            }
        }
        (f64::from(used) / SEEDS as f64, if used == 0 { 1.0 } else { f64::from(right) / f64::from(used) })
    }
    const SEEDS: u64 = 200;

    #[test]
    fn a_walk_of_gps_fixes_gives_no_metres_of_a_small_swim_and_an_honest_error_of_a_large_one() {
        for count in [12, 48, 200] {
            let (used, right) = walks(count, 6.0, 8.0, 3.0);
            println!("{count} fixes on 6 m: used {used:.3}, right {right:.3}");
            assert!(used <= 0.02);
            for size in [60.0, 120.0, 300.0] {
                let (used, right) = walks(count, size, 8.0, 3.0);
                println!("{count} fixes on {size} m: used {used:.3}, right {right:.3}");
                assert!(right >= 0.95, "{count} fixes, {size} m: {right}");
                assert!(size < 300.0 || used > 0.98, "{count} fixes, {size} m: {used}");
            }
            // Measured positions have no floor, and the wandering is seen all the same.
            let (used, right) = walks(count, 100.0, 8.0, 0.0);
            println!("{count} positions on 100 m: used {used:.3}, right {right:.3}");
            assert!(right >= 0.95, "{count} positions: {right}");
            let (used, _) = walks(count, 6.0, 8.0, 0.0);
            println!("{count} positions on 6 m: used {used:.3}");
            assert!(used <= 0.06);
        }
    }

    #[test]
    fn false_positions_are_left_out_and_a_mirror_image_is_seen() {
        let mut pairs: Vec<_> = places().iter().map(|p| (*p, 0.7 * *p)).collect();
        pairs[5].1 += DVec3::new(3.0, -1.0, 0.0);
        let fit = fit_positions(&pairs, 0.0, String::new()).unwrap();
        assert!(fit.false_ones == [5] && (fit.world.metres_per_unit - 0.7).abs() < 1e-9, "{fit:?}");
        let mirror: Vec<_> = places().iter().map(|p| (*p, DVec3::new(p.y, p.x, p.z))).collect();
        assert!(fit_positions(&mirror, 0.0, String::new()).unwrap().mirrored && !fit.mirrored);
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
