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
//! needle's covariance cancels in f32. A Gaussian still costs the same as in scalar f32, and the results
//! are correctly rounded to f32 accuracy.

use use3d_capture::Camera;
use use3d_numerics::math;

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

/// A projected Gaussian.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Projection {
    /// Centre, pixels.
    pub(crate) mean: [f64; 2],
    /// Depth along the optical axis.
    pub(crate) z: f64,
    /// Covariance `xx, xy, yy`, pixels², blur included.
    pub(crate) cov: [f64; 3],
}

/// The gradient with respect to one Gaussian's raw geometry.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct GeometryGradient {
    pub(crate) mean: [f64; 3],
    pub(crate) log_scale: [f64; 3],
    pub(crate) quaternion: [f64; 4],
}

/// Intermediate values that forward and backward share.
struct Shared {
    x: [f64; 3],
    /// `tx/z` and `ty/z`; true for each axis whose clamp is inactive.
    slope: [f64; 2],
    free: [bool; 2],
    /// Unit quaternion and the norm of the raw one.
    unit: [f64; 4],
    norm: f64,
    scale: [f64; 3],
    /// Rotation of the Gaussian, row-major.
    turn: [[f64; 3]; 3],
    /// `J R R(q)`: columns are the projected unit axes of the Gaussian.
    axes: [[f64; 3]; 2],
    /// `J R`.
    jr: [[f64; 3]; 2],
}

fn rotation_of(q: [f64; 4]) -> [[f64; 3]; 3] {
    let [w, x, y, z] = q;
    [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
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
    fn camera_frame(&self, mean: [f32; 3]) -> [f64; 3] {
        let m = mean.map(f64::from);
        std::array::from_fn(|r| {
            let row = self.rotation[r];
            row[0] * m[0] + row[1] * m[1] + row[2] * m[2] + self.translation[r]
        })
    }

    #[inline(always)]
    fn frame(&self, x: [f64; 3], log_scale: [f32; 3], quaternion: [f32; 4]) -> Shared {
        let z = x[2];
        let clamp = |v: f64, [low, high]: [f64; 2]| (v.max(low).min(high), v > low && v < high);
        let (sx, free_x) = clamp(x[0] / z, self.limit_x);
        let (sy, free_y) = clamp(x[1] / z, self.limit_y);
        let q = quaternion.map(f64::from);
        let norm = (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]).sqrt();
        let unit = q.map(|v| v / norm);
        let turn = rotation_of(unit);
        let r = &self.rotation;
        let (jx, jy) = (self.fx / z, self.fy / z);
        let jr = [
            std::array::from_fn(|c| jx * (r[0][c] - sx * r[2][c])),
            std::array::from_fn(|c| jy * (r[1][c] - sy * r[2][c])),
        ];
        let axes = jr.map(|row: [f64; 3]| {
            std::array::from_fn(|c| row[0] * turn[0][c] + row[1] * turn[1][c] + row[2] * turn[2][c])
        });
        let scale = log_scale.map(|v| math::exp(f64::from(v)));
        Shared { x, slope: [sx, sy], free: [free_x, free_y], unit, norm, scale, turn, axes, jr }
    }

    /// Projects one Gaussian; `None` if it is outside the depth range or its projection is not a finite
    /// Gaussian.
    #[inline(always)]
    pub(crate) fn project(
        &self,
        mean: [f32; 3],
        log_scale: [f32; 3],
        quaternion: [f32; 4],
    ) -> Option<Projection> {
        let x = self.camera_frame(mean);
        let z = x[2];
        if !(NEAR..=FAR).contains(&z) {
            return None;
        }
        let f = self.frame(x, log_scale, quaternion);
        let [a, b] = f.axes;
        let s = f.scale.map(|v| v * v);
        let dot = |p: [f64; 3], q: [f64; 3]| s[0] * p[0] * q[0] + s[1] * p[1] * q[1] + s[2] * p[2] * q[2];
        let cov = [dot(a, a) + BLUR, dot(a, b), dot(b, b) + BLUR];
        let mean = [self.fx * (x[0] / z) + self.cx, self.fy * (x[1] / z) + self.cy];
        let finite = mean.iter().chain(&cov).all(|v| v.abs() < 1e30);
        finite.then_some(Projection { mean, z, cov })
    }

    /// Computes the gradient of the geometry from those of `mean2d` (pixels), `z` and `cov2d` (`xx`, `xy`
    /// counted once, `yy`).
    #[inline(always)]
    pub(crate) fn backward(
        &self,
        mean: [f32; 3],
        log_scale: [f32; 3],
        quaternion: [f32; 4],
        d_mean: [f64; 2],
        d_z: f64,
        d_cov: [f64; 3],
    ) -> GeometryGradient {
        let f = self.frame(self.camera_frame(mean), log_scale, quaternion);
        let z = f.x[2];
        let [a, b] = f.axes;
        let s2 = f.scale.map(|v| v * v);
        // cov = Σ_k s_k² u_k u_kᵀ with u_k = (a_k, b_k).
        let d_axes: [[f64; 3]; 2] = [
            std::array::from_fn(|k| s2[k] * (2.0 * d_cov[0] * a[k] + d_cov[1] * b[k])),
            std::array::from_fn(|k| s2[k] * (d_cov[1] * a[k] + 2.0 * d_cov[2] * b[k])),
        ];
        let log_scale = std::array::from_fn(|k| {
            2.0 * s2[k] * (d_cov[0] * a[k] * a[k] + d_cov[1] * a[k] * b[k] + d_cov[2] * b[k] * b[k])
        });
        // axes = jr · turn.
        let d_jr: [[f64; 3]; 2] = std::array::from_fn(|r| {
            std::array::from_fn(|c| {
                let t = f.turn[c];
                d_axes[r][0] * t[0] + d_axes[r][1] * t[1] + d_axes[r][2] * t[2]
            })
        });
        let d_turn: [[f64; 3]; 3] = std::array::from_fn(|r| {
            std::array::from_fn(|c| f.jr[0][r] * d_axes[0][c] + f.jr[1][r] * d_axes[1][c])
        });
        let quaternion = unit_quaternion_backward(&f, &d_turn);
        // jr_x = (fx/z)(r₀ − sx r₂); sx = x/z where free, a constant where clamped.
        let r = &self.rotation;
        let dot3 = |p: [f64; 3], q: [f64; 3]| p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
        let focal = [self.fx, self.fy];
        let mut d_x = [0.0, 0.0, d_z];
        for i in 0..2 {
            let d_slope = -(focal[i] / z) * dot3(d_jr[i], r[2]);
            // d(fx/z)/dz · (r − s r₂) = −jr/z
            d_x[2] -= dot3(d_jr[i], f.jr[i]) / z;
            if f.free[i] {
                d_x[i] += d_slope / z;
                d_x[2] -= d_slope * f.slope[i] / z;
            }
            d_x[i] += d_mean[i] * focal[i] / z;
            d_x[2] -= d_mean[i] * focal[i] * f.x[i] / (z * z);
        }
        let mean = std::array::from_fn(|c| r[0][c] * d_x[0] + r[1][c] * d_x[1] + r[2][c] * d_x[2]);
        GeometryGradient { mean, log_scale, quaternion }
    }
}

/// Converts the gradient of the rotation matrix into that of the raw quaternion, through the normalisation.
#[inline(always)]
fn unit_quaternion_backward(f: &Shared, d: &[[f64; 3]; 3]) -> [f64; 4] {
    let [w, x, y, z] = f.unit;
    let g = [
        2.0 * (x * (d[2][1] - d[1][2]) + y * (d[0][2] - d[2][0]) + z * (d[1][0] - d[0][1])),
        2.0 * (-2.0 * x * (d[1][1] + d[2][2])
            + y * (d[0][1] + d[1][0])
            + z * (d[0][2] + d[2][0])
            + w * (d[2][1] - d[1][2])),
        2.0 * (x * (d[0][1] + d[1][0]) - 2.0 * y * (d[0][0] + d[2][2])
            + z * (d[1][2] + d[2][1])
            + w * (d[0][2] - d[2][0])),
        2.0 * (x * (d[0][2] + d[2][0]) + y * (d[1][2] + d[2][1]) - 2.0 * z * (d[0][0] + d[1][1])
            + w * (d[1][0] - d[0][1])),
    ];
    let along = g[0] * w + g[1] * x + g[2] * y + g[3] * z;
    std::array::from_fn(|i| (g[i] - along * f.unit[i]) / f.norm)
}

/// `cov⁻¹` as `xx, xy, yy`.
#[cfg(test)]
fn conic(cov: [f64; 3]) -> [f64; 3] {
    let det = cov[0] * cov[2] - cov[1] * cov[1];
    [cov[2] / det, -cov[1] / det, cov[0] / det]
}

#[cfg(test)]
mod tests;
