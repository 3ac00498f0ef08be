//! Perspective projection of a 3D Gaussian to a 2D one (EWA splatting; Zwicker et al. 2001), and its
//! derivative.
//!
//! With `X = R μ + t = (x, y, z)` and `Σ = R(q) S S R(q)ᵀ`; a Gaussian is kept only if `near ≤ z ≤ far`:
//!
//! ```text
//! mean2d = (fx x/z + cx, fy y/z + cy)
//! tx = z clamp(x/z, −cx/fx − mx, (W−cx)/fx + mx),  mx = 0.3 (W/2)/fx      (ty likewise)
//! J  = [[fx/z, 0, −fx tx/z²], [0, fy/z, −fy ty/z²]]
//! cov2d = J R Σ Rᵀ Jᵀ + 0.3 I                                             pixels²
//! ```
//!
//! The clamp bounds only the Jacobian; where it is active, `tx` depends on `z` alone. The derivative is
//! that of the expressions as written. All inner calculations are f64, because the determinant of a
//! needle's covariance cancels in f32. Everything is written over [`Number`]: passes run it on eight
//! Gaussians in lanes, and on one `f64` it is the plain twin.

use use3d_capture::Camera;
use use3d_numerics::number::{Number, exp};

/// Nearest depth drawn, scene units.
pub const NEAR: f64 = 0.01;
/// Farthest depth drawn, scene units.
pub const FAR: f64 = 1e4;
/// Added to both diagonal entries of the projected covariance, pixels², so that no Gaussian is much thinner
/// than a pixel.
pub const BLUR: f64 = 0.3;

/// A camera in the form that the projection uses.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Projector {
    /// World-to-camera rotation, row-major.
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    /// Limits of `x/z` and `y/z` in the Jacobian: low, high.
    limit_x: [f64; 2],
    limit_y: [f64; 2],
}

/// The raw geometry of a Gaussian.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ellipsoid<V> {
    pub(crate) mean: [V; 3],
    pub(crate) log_scale: [V; 3],
    pub(crate) quaternion: [V; 4],
}

/// A projected Gaussian, or the gradient with respect to it (`xy` counted once).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Projection<V> {
    /// Centre, pixels.
    pub(crate) mean: [V; 2],
    /// Depth along the optical axis.
    pub(crate) z: V,
    /// Covariance `xx, xy, yy`, pixels², blur included.
    pub(crate) cov: [V; 3],
}

/// Intermediate values that forward and backward share.
struct Shared<V: Number> {
    /// Centre in the camera's frame.
    x: [V; 3],
    inverse_z: V,
    /// `x/z` and `y/z`, and the same within the limits.
    ray: [V; 2],
    slope: [V; 2],
    /// `fx/z` and `fy/z`.
    zoom: [V; 2],
    /// Unit quaternion and one over the norm of the raw one.
    unit: [V; 4],
    inverse_norm: V,
    scale: [V; 3],
    /// Rotation of the Gaussian, row-major.
    turn: [[V; 3]; 3],
    /// `J R`.
    jr: [[V; 3]; 2],
    /// `J R R(q) S`: columns are the projected semi-axes of the Gaussian.
    axes: [[V; 3]; 2],
}

#[inline(always)]
fn dot<V: Number>(a: [V; 3], b: [V; 3]) -> V {
    a[2].mul_add(b[2], a[1].mul_add(b[1], a[0] * b[0]))
}

#[inline(always)]
fn fill<V: Number>(v: V, row: [f64; 3]) -> [V; 3] {
    [v.fill(row[0]), v.fill(row[1]), v.fill(row[2])]
}

#[inline(always)]
fn product<V: Number>(a: [V; 3], b: [V; 3]) -> [V; 3] {
    [a[0] * b[0], a[1] * b[1], a[2] * b[2]]
}

#[inline(always)]
fn transpose<V: Copy>([a, b, c]: [[V; 3]; 3]) -> [[V; 3]; 3] {
    [[a[0], b[0], c[0]], [a[1], b[1], c[1]], [a[2], b[2], c[2]]]
}

/// `M v` for a row-major matrix.
#[inline(always)]
fn matrix_vector<V: Number>(m: [[V; 3]; 3], v: [V; 3]) -> [V; 3] {
    [dot(m[0], v), dot(m[1], v), dot(m[2], v)]
}

/// `factor · a + other · b`.
#[inline(always)]
fn blend<V: Number>(factor: V, a: [V; 3], other: V, b: [V; 3]) -> [V; 3] {
    [
        factor.mul_add(a[0], other * b[0]),
        factor.mul_add(a[1], other * b[1]),
        factor.mul_add(a[2], other * b[2]),
    ]
}

#[inline(always)]
fn clamp<V: Number>(v: V, [low, high]: [f64; 2]) -> V {
    let (low, high) = (v.fill(low), v.fill(high));
    V::select(v.less(low), low, V::select(high.less(v), high, v))
}

/// `1 − a · b − c · d`.
#[inline(always)]
fn one_less<V: Number>(a: V, b: V, c: V, d: V) -> V {
    a.fill(1.0) - a.mul_add(b, c * d)
}

#[inline(always)]
fn rotation_of<V: Number>([w, x, y, z]: [V; 4]) -> [[V; 3]; 3] {
    let (x2, y2, z2) = (x + x, y + y, z + z);
    let (xy, xz, yz) = (x * y2, x * z2, y * z2);
    [
        [one_less(y, y2, z, z2), w.mul_add(-z2, xy), w.mul_add(y2, xz)],
        [w.mul_add(z2, xy), one_less(x, x2, z, z2), w.mul_add(-x2, yz)],
        [w.mul_add(-y2, xz), w.mul_add(x2, yz), one_less(x, x2, y, y2)],
    ]
}

impl Projector {
    pub(crate) fn new(camera: &Camera) -> Self {
        let (k, pose) = (&camera.intrinsics, &camera.pose);
        let rotation = std::array::from_fn(|r| std::array::from_fn(|c| pose.rotation.col(c)[r]));
        let limits = |size: usize, focal: f64, centre: f64| {
            let size = size as f64;
            let margin = 0.3 * (size / 2.0) / focal;
            [-(centre / focal + margin), (size - centre) / focal + margin]
        };
        Self {
            rotation,
            translation: pose.translation.to_array(),
            fx: k.fx,
            fy: k.fy,
            cx: k.cx,
            cy: k.cy,
            limit_x: limits(k.width, k.fx, k.cx),
            limit_y: limits(k.height, k.fy, k.cy),
        }
    }

    #[inline(always)]
    fn camera_frame<V: Number>(&self, mean: [V; 3]) -> [V; 3] {
        let ([a, b, c], [x, y, z]) = (self.rotation, self.translation);
        let one = mean[0];
        [dot(fill(one, a), mean) + x, dot(fill(one, b), mean) + y, dot(fill(one, c), mean) + z]
    }

    /// A row of `J R`: `zoom (r − slope r₂)`.
    #[inline(always)]
    fn jacobian_row<V: Number>(&self, row: usize, slope: V, zoom: V) -> [V; 3] {
        let (own, depth) = (fill(zoom, self.rotation[row]), fill(zoom, self.rotation[2]));
        let steep = -(slope * zoom);
        blend(steep, depth, zoom, own)
    }

    #[inline(always)]
    fn shared<V: Number>(&self, g: &Ellipsoid<V>) -> Shared<V> {
        let x = self.camera_frame(g.mean);
        let one = x[2].fill(1.0);
        let inverse_z = one / x[2];
        let ray = [x[0] * inverse_z, x[1] * inverse_z];
        let slope = [clamp(ray[0], self.limit_x), clamp(ray[1], self.limit_y)];
        let [w, i, j, k] = g.quaternion;
        let inverse_norm = one / w.mul_add(w, dot([i, j, k], [i, j, k])).sqrt();
        let unit = [w * inverse_norm, i * inverse_norm, j * inverse_norm, k * inverse_norm];
        let turn = rotation_of(unit);
        let zoom = [inverse_z * self.fx, inverse_z * self.fy];
        let jr = [self.jacobian_row(0, slope[0], zoom[0]), self.jacobian_row(1, slope[1], zoom[1])];
        let [a, b, c] = g.log_scale;
        let scale = [exp(a), exp(b), exp(c)];
        let columns = transpose(turn);
        let axes =
            [product(matrix_vector(columns, jr[0]), scale), product(matrix_vector(columns, jr[1]), scale)];
        Shared { x, inverse_z, ray, slope, zoom, unit, inverse_norm, scale, turn, jr, axes }
    }

    /// Projects a Gaussian; the mask is false if it is outside the depth range or its projection is not a
    /// finite Gaussian.
    #[inline(always)]
    pub(crate) fn project<V: Number>(&self, g: &Ellipsoid<V>) -> (Projection<V>, V::Mask) {
        let f = self.shared(g);
        let z = f.x[2];
        let [a, b] = f.axes;
        let cov = [dot(a, a) + BLUR, dot(a, b), dot(b, b) + BLUR];
        let mean = [f.ray[0] * self.fx + self.cx, f.ray[1] * self.fy + self.cy];
        let mut visible = z.fill(NEAR).at_most(z) & z.at_most(z.fill(FAR));
        for v in [mean[0], mean[1], cov[0], cov[1], cov[2]] {
            visible = visible & (v * v).less(v.fill(1e60));
        }
        (Projection { mean, z, cov }, visible)
    }

    /// Computes the gradient with respect to the geometry from that with respect to the projection.
    #[inline(always)]
    pub(crate) fn backward<V: Number>(&self, g: &Ellipsoid<V>, d: &Projection<V>) -> Ellipsoid<V> {
        let f = self.shared(g);
        let [a, b] = f.axes;
        // cov = Σ_k u_k u_kᵀ with u_k = (a_k, b_k), which contain the scale.
        let [xx, xy, yy] = [d.cov[0] * 2.0, d.cov[1], d.cov[2] * 2.0];
        let (d_a, d_b) = (blend(xx, a, xy, b), blend(yy, b, xy, a));
        let (by_a, by_b) = (product(d_a, a), product(d_b, b));
        let log_scale = [by_a[0] + by_b[0], by_a[1] + by_b[1], by_a[2] + by_b[2]];
        // axes = jr · turn · scale.
        let d_axes = [product(d_a, f.scale), product(d_b, f.scale)];
        let [p, q] = f.jr;
        let d_turn = [
            blend(p[0], d_axes[0], q[0], d_axes[1]),
            blend(p[1], d_axes[0], q[1], d_axes[1]),
            blend(p[2], d_axes[0], q[2], d_axes[1]),
        ];
        // jr_x = (fx/z)(r₀ − sx r₂); sx = x/z where free, a constant where clamped.
        let zero = d.z.fill(0.0);
        let limits = [self.limit_x, self.limit_y];
        let [r0, r1, r2] = self.rotation;
        let mut d_x = [zero; 3];
        for i in 0..2 {
            let d_jr = matrix_vector(f.turn, d_axes[i]);
            let [low, high] = limits[i];
            let free = zero.fill(low).less(f.ray[i]) & f.ray[i].less(zero.fill(high));
            let d_slope = V::select(free, -(f.zoom[i] * dot(fill(zero, r2), d_jr)), zero);
            let d_mean = d.mean[i] * f.zoom[i];
            d_x[i] = d_slope.mul_add(f.inverse_z, d_mean);
            // d(fx/z)/dz · (r − s r₂) = −jr/z; d(x/z)/dz = −(x/z)/z.
            d_x[2] = d_x[2] - (dot(d_jr, f.jr[i]) + d_slope.mul_add(f.slope[i], d_mean * f.x[i]));
        }
        d_x[2] = d_x[2].mul_add(f.inverse_z, d.z);
        let mean = matrix_vector(transpose([fill(zero, r0), fill(zero, r1), fill(zero, r2)]), d_x);
        Ellipsoid { mean, log_scale, quaternion: unit_quaternion_backward(&f, &d_turn) }
    }
}

/// Converts the gradient of the rotation matrix into that of the raw quaternion, through the normalisation.
#[inline(always)]
fn unit_quaternion_backward<V: Number>(f: &Shared<V>, d: &[[V; 3]; 3]) -> [V; 4] {
    let [w, x, y, z] = f.unit;
    let (xy, xz, yz) = (d[0][1] + d[1][0], d[0][2] + d[2][0], d[1][2] + d[2][1]);
    let turning = [d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1]];
    let g = [
        dot(turning, [x, y, z]),
        dot([y, z, w], [xy, xz, turning[0]]) - (x + x) * (d[1][1] + d[2][2]),
        dot([x, z, w], [xy, yz, turning[1]]) - (y + y) * (d[0][0] + d[2][2]),
        dot([x, y, w], [xz, yz, turning[2]]) - (z + z) * (d[0][0] + d[1][1]),
    ];
    let along = g[3].mul_add(z, dot([g[0], g[1], g[2]], [w, x, y]));
    let twice = f.inverse_norm * 2.0;
    [
        (g[0] - along * w) * twice,
        (g[1] - along * x) * twice,
        (g[2] - along * y) * twice,
        (g[3] - along * z) * twice,
    ]
}

/// `cov⁻¹` as `xx, xy, yy`.
#[cfg(test)]
fn conic(cov: [f64; 3]) -> [f64; 3] {
    let det = cov[0] * cov[2] - cov[1] * cov[1];
    [cov[2] / det, -cov[1] / det, cov[0] / det]
}

#[cfg(test)]
mod tests;
