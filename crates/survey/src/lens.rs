//! The map from rays to pixels and back, for the lenses of every program that is read.
//!
//! A ray of the camera frame is written as its point `(u, v) = (x/z, y/z)` on the plane `z = 1`. It lands on
//! the pixel
//!
//! ```text
//! x = fx u' + skew v' + cx
//! y = fy v' + cy
//! ```
//!
//! with the bent point `(u', v')`. The bend is a *projection* followed by a *distortion*:
//!
//! * projection: perspective (`u' = u`), equidistant (the point is moved to radius `θ = atan r`), equisolid
//!   (radius `2 sin(θ/2)`), field-of-view (`r' = atan(2 r tan(ω/2)) / ω`), division (`r = r' / (1 + k r'²)`,
//!   its nearer root), or enhanced unified (`u' = u / (α √(β r² + 1) + 1 - α)`, with `α` in `[0, 1]` and
//!   `β > 0`);
//! * distortion: `D(u) = u·radial(|u|²) + tangential(p1, p2) (1 + g1 r² + g2 r⁴) + prism(s1, s2)`, with
//!   OpenCV's order of `p1` and `p2` and a polynomial or rational radial factor. Fisheye lenses apply it to
//!   the point that the projection moved.
//!
//! The inverse is Newton's method on `D` with the exact Jacobian (by [`Jet`]) and step halving, then the
//! closed inverse of the projection. A pixel that no ray in front of the camera reaches, or that lies beyond
//! the fold of a distortion polynomial, has no inverse. A ray that a division lens with `k > 0` does not see
//! (`4 k r² > 1`) lands nowhere, on NaN.
//!
//! Limit: rays at 90° or more from the axis (`z ≤ 0`) have no point on the plane; no pinhole could show them
//! either.

use serde::{Deserialize, Serialize};
use use3d_capture::Intrinsics;
use use3d_numerics::math;

use crate::jet::{Jet, Real};

/// The rule by which a ray's point is moved before the distortion.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub enum Projection {
    /// `r' = r`: every pinhole and every lens that keeps straight lines nearly straight.
    #[default]
    Perspective,
    /// `r' = θ = atan r`.
    Equidistant,
    /// `r' = 2 sin(θ/2)`.
    Equisolid,
    /// `r' = atan(2 r tan(ω/2)) / ω`.
    FieldOfView {
        /// The field of view, radians.
        omega: f64,
    },
    /// `r = r' / (1 + k r'²)`, the nearer root.
    Division {
        /// The coefficient.
        k: f64,
    },
    /// `u' = u / (α √(β r² + 1) + 1 - α)`.
    Unified {
        /// The share of the sphere, in `[0, 1]`.
        alpha: f64,
        /// The stretch of the sphere, above 0.
        beta: f64,
    },
}

/// `u·(1 + n1 r² + n2 r⁴ + … + n6 r¹²) / (1 + d1 r² + d2 r⁴ + d3 r⁶)` and the tangential and prism terms.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Distortion {
    /// `n1` to `n6`: the radial polynomial's coefficients of `r²` to `r¹²`.
    pub numerator: [f64; 6],
    /// `d1` to `d3`: the coefficients of a rational factor's denominator; all 0 for a polynomial.
    pub denominator: [f64; 3],
    /// OpenCV's `p1` (with `r² + 2 v²` along y) and `p2` (with `r² + 2 u²` along x).
    pub tangential: [f64; 2],
    /// `g1`, `g2`: the tangential terms are multiplied by `1 + g1 r² + g2 r⁴`.
    pub tangential_growth: [f64; 2],
    /// `s1`, `s2`: the prism adds `s1 r²` along x and `s2 r²` along y.
    pub prism: [f64; 2],
    /// Prism terms with `r⁴`, where tangential and prism terms are taken at the point that the radial factor
    /// has moved; `None` where they are taken at the point itself.
    pub after_radial: Option<[f64; 2]>,
}

impl Distortion {
    fn apply<T: Real>(&self, u: T, v: T) -> (T, T) {
        let r2 = u * u + v * v;
        let [n1, n2, n3, n4, n5, n6] = self.numerator;
        let mut radial = r2 * (r2 * (r2 * (r2 * (r2 * (r2 * n6 + n5) + n4) + n3) + n2) + n1) + 1.0;
        if self.denominator != [0.0; 3] {
            let [d1, d2, d3] = self.denominator;
            radial = radial / (r2 * (r2 * (r2 * d3 + d2) + d1) + 1.0);
        }
        let moved = (u * radial, v * radial);
        let (u, v) = if self.after_radial.is_some() { moved } else { (u, v) };
        let (uu, uv, vv) = (u * u, u * v, v * v);
        let r2 = uu + vv;
        let ([p1, p2], [s1, s2]) = (self.tangential, self.prism);
        let mut du = uv * (2.0 * p1) + (r2 + uu * 2.0) * p2;
        let mut dv = uv * (2.0 * p2) + (r2 + vv * 2.0) * p1;
        if self.tangential_growth != [0.0; 2] {
            let [g1, g2] = self.tangential_growth;
            let growth = r2 * (r2 * g2 + g1) + 1.0;
            (du, dv) = (du * growth, dv * growth);
        }
        (du, dv) = (du + r2 * s1, dv + r2 * s2);
        if let Some([t1, t2]) = self.after_radial {
            (du, dv) = (du + r2 * r2 * t1, dv + r2 * r2 * t2);
        }
        (moved.0 + du, moved.1 + dv)
    }

    /// Solves `apply(u) = target`; `None` where it has no solution before the fold.
    fn invert(&self, target: (f64, f64)) -> Option<(f64, f64)> {
        if *self == Self::default() {
            return Some(target);
        }
        let residual = |u: f64, v: f64| {
            let (a, b) = self.apply(u, v);
            (a - target.0, b - target.1)
        };
        let (mut u, mut v) = target;
        let (mut ru, mut rv) = residual(u, v);
        let goal = 1e-14 * (1.0 + math::hypot(target.0, target.1));
        for _ in 0..100 {
            let norm = math::hypot(ru, rv);
            if norm <= goal {
                break;
            }
            let ([a, b], det) = self.jacobian(u, v);
            let step_u = (b[1] * ru - a[1] * rv) / det;
            let step_v = (a[0] * rv - b[0] * ru) / det;
            if !(step_u.is_finite() && step_v.is_finite()) {
                return None;
            }
            // Halve the step until the residual shrinks; if it never does, rounding has been reached.
            let mut share = 1.0;
            loop {
                let (nu, nv) = (u - share * step_u, v - share * step_v);
                let (pu, pv) = residual(nu, nv);
                if math::hypot(pu, pv) < norm {
                    (u, v, ru, rv) = (nu, nv, pu, pv);
                    break;
                }
                share *= 0.5;
                if share < 1e-9 {
                    return self.accept(u, v, norm, goal);
                }
            }
        }
        self.accept(u, v, math::hypot(ru, rv), goal)
    }

    /// A solution counts if it is exact to about 1e-11 and nothing folds between the axis and it.
    fn accept(&self, u: f64, v: f64, residual: f64, goal: f64) -> Option<(f64, f64)> {
        let unfolded = (1..=16).all(|i| {
            let share = f64::from(i) / 16.0;
            self.jacobian(u * share, v * share).1 > 0.0
        });
        (residual <= 1000.0 * goal && unfolded).then_some((u, v))
    }

    /// The derivatives of both coordinates of the bent point, and their determinant.
    fn jacobian(&self, u: f64, v: f64) -> ([[f64; 2]; 2], f64) {
        let (ju, jv) = Jet::inputs(u, v);
        let (a, b) = self.apply(ju, jv);
        ([a.by, b.by], a.by[0] * b.by[1] - a.by[1] * b.by[0])
    }
}

/// A lens, ready to bend rays. Lengths in pixels of the image that it belongs to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Lens {
    /// Focal lengths `fx`, `fy`.
    pub focal: [f64; 2],
    /// Pixels along x per unit of `v'`: 0 for nearly every camera.
    pub skew: f64,
    /// Principal point `cx`, `cy`.
    pub principal: [f64; 2],
    /// The first half of the bend.
    pub projection: Projection,
    /// The second half of the bend.
    pub distortion: Distortion,
}

impl Lens {
    /// A pinhole.
    pub fn pinhole(focal: [f64; 2], principal: [f64; 2]) -> Self {
        Self { focal, principal, ..Self::default() }
    }

    /// The same lens on an image scaled by `sx`, `sy`.
    pub fn scaled(&self, sx: f64, sy: f64) -> Self {
        Self {
            focal: [self.focal[0] * sx, self.focal[1] * sy],
            skew: self.skew * sx,
            principal: [self.principal[0] * sx, self.principal[1] * sy],
            ..*self
        }
    }

    /// True if rays are not bent at all.
    pub fn is_pinhole(&self) -> bool {
        self.projection == Projection::Perspective
            && self.distortion == Distortion::default()
            && self.skew == 0.0
    }

    /// The pinhole with this lens's focal lengths and principal point.
    pub fn intrinsics(&self, width: usize, height: usize) -> Intrinsics {
        let ([fx, fy], [cx, cy]) = (self.focal, self.principal);
        Intrinsics { width, height, fx, fy, cx, cy }
    }

    fn bend<T: Real>(&self, u: T, v: T) -> (T, T) {
        let (u, v) = match self.projection {
            Projection::Perspective => (u, v),
            Projection::Equidistant => radially(u, v, 1.0, Real::atan),
            Projection::Equisolid => {
                // 2 sin(θ/2) / r without the division that is 0 over 0 on the axis: √(2 / (s (s + 1))), with
                // s = √(1 + r²) = 1 / cos θ.
                let s = (u * u + v * v + 1.0).sqrt();
                let factor = (s * (s + 1.0) * 0.5).sqrt();
                (u / factor, v / factor)
            }
            Projection::FieldOfView { omega } => {
                // As ω goes to 0 the model goes to the perspective one.
                let stretch = 2.0 * math::tan(0.5 * omega);
                if stretch.abs() < 1e-9 {
                    (u, v)
                } else {
                    radially(u, v, stretch / omega, |r| (r * stretch).atan() * (1.0 / omega))
                }
            }
            Projection::Division { k } => {
                let root = ((u * u + v * v) * (-4.0 * k) + 1.0).sqrt() + 1.0;
                (u * 2.0 / root, v * 2.0 / root)
            }
            Projection::Unified { alpha, beta } => {
                let depth = ((u * u + v * v) * beta + 1.0).sqrt() * alpha + (1.0 - alpha);
                (u / depth, v / depth)
            }
        };
        self.distortion.apply(u, v)
    }

    /// The pixel that a ray's point `(x/z, y/z)` lands on.
    pub fn project(&self, u: f64, v: f64) -> (f64, f64) {
        let (a, b) = self.bend(u, v);
        (self.focal[0] * a + self.sheared(b) + self.principal[0], self.focal[1] * b + self.principal[1])
    }

    /// `skew v'`, and 0 without skew even where `v'` is not finite.
    fn sheared(&self, b: f64) -> f64 {
        if self.skew == 0.0 { 0.0 } else { self.skew * b }
    }

    /// The pixel and its Jacobian: `[[∂x/∂u, ∂x/∂v], [∂y/∂u, ∂y/∂v]]`.
    pub fn project_with_jacobian(&self, u: f64, v: f64) -> ((f64, f64), [[f64; 2]; 2]) {
        let (ju, jv) = Jet::inputs(u, v);
        let (a, b) = self.bend(ju, jv);
        let pixel = (
            self.focal[0] * a.value + self.sheared(b.value) + self.principal[0],
            self.focal[1] * b.value + self.principal[1],
        );
        let along_x = [0, 1].map(|i| a.by[i] * self.focal[0] + self.sheared(b.by[i]));
        (pixel, [along_x, b.by.map(|d| d * self.focal[1])])
    }

    /// The ray's point that lands on a pixel; `None` where no ray in front of the camera does, before the
    /// lens folds.
    pub fn unproject(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let down = (y - self.principal[1]) / self.focal[1];
        let bent = ((x - self.sheared(down) - self.principal[0]) / self.focal[0], down);
        let (u, v) = self.distortion.invert(bent)?;
        let radius = math::hypot(u, v);
        if radius < 1e-300 {
            return Some((u, v));
        }
        let unbent = match self.projection {
            Projection::Perspective => return Some((u, v)),
            Projection::Equidistant => {
                if radius >= std::f64::consts::FRAC_PI_2 - 1e-6 {
                    return None;
                }
                math::tan(radius)
            }
            Projection::Equisolid => {
                // cos θ = 1 - r'²/2 and sin θ = r' √(1 - r'²/4).
                let cos = 1.0 - 0.5 * radius * radius;
                if cos <= 1e-6 {
                    return None;
                }
                radius * (1.0 - 0.25 * radius * radius).sqrt() / cos
            }
            Projection::FieldOfView { omega } => {
                let stretch = 2.0 * math::tan(0.5 * omega);
                if stretch.abs() < 1e-9 {
                    return Some((u, v));
                }
                if (radius * omega).abs() >= std::f64::consts::FRAC_PI_2 - 1e-6 {
                    return None;
                }
                math::tan(radius * omega) / stretch
            }
            Projection::Division { k } => {
                let moved = k * radius * radius;
                // At -1 rays lie in the image plane; at 1 is the root beyond which radii come back.
                if !(-1.0 < moved && moved < 1.0) {
                    return None;
                }
                radius / (1.0 + moved)
            }
            Projection::Unified { alpha, beta } => {
                let (r2, rest) = (radius * radius, 1.0 - alpha);
                let inner = 1.0 - (alpha - rest) * beta * r2;
                let depth = (1.0 - alpha * alpha * beta * r2) / (alpha * inner.sqrt() + rest);
                // NaN where no ray lands, not above 0 where none in front of the camera does.
                if !(inner >= 0.0 && depth > 0.0) {
                    return None;
                }
                radius / depth
            }
        };
        Some((u * (unbent / radius), v * (unbent / radius)))
    }
}

/// Moves a point along its radius: `r → f(r)`, with `f(r)/r → at_zero` on the axis.
fn radially<T: Real>(u: T, v: T, at_zero: f64, f: impl Fn(T) -> T) -> (T, T) {
    let r2 = u * u + v * v;
    if r2.value() < 1e-16 {
        return (u * at_zero, v * at_zero);
    }
    let r = r2.sqrt();
    let factor = f(r) / r;
    (u * factor, v * factor)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// One lens of each kind that no other crate tests: skew, growing tangential terms, equisolid fisheye.
    fn examples(amount: f64) -> [Lens; 3] {
        let distortion = Distortion {
            numerator: [-0.11, 0.06, -0.02, 0.004, 0.0, 0.0].map(|v| v * amount),
            tangential: [0.003 * amount, -0.002 * amount],
            tangential_growth: [0.2 * amount, -0.1 * amount],
            ..Distortion::default()
        };
        let brown = Lens { skew: 4.5, distortion, ..Lens::pinhole([800.0, 810.0], [503.0, 347.0]) };
        let wide =
            Distortion { numerator: [-0.02 * amount, 0.01 * amount, 0.0, 0.0, 0.0, 0.0], ..distortion };
        let fisheye = Lens {
            projection: Projection::Equisolid,
            distortion: wide,
            skew: -3.0,
            ..Lens::pinhole([500.0, 505.0], [497.0, 352.0])
        };
        let plain =
            Lens { projection: Projection::Equisolid, ..Lens::pinhole([500.0, 500.0], [500.0, 350.0]) };
        [brown, fisheye, plain]
    }

    #[test]
    fn hand_computed_bends() {
        // 60° off the axis: 2 sin 30° = 1.
        let [_, _, plain] = examples(1.0);
        let (x, y) = plain.project(math::tan(std::f64::consts::FRAC_PI_3), 0.0);
        assert!((x - 1000.0).abs() < 1e-9 && y == 350.0, "{x} {y}");
        // Skew moves x alone, by skew v'.
        let lens = Lens { skew: 7.0, ..Lens::pinhole([100.0, 200.0], [10.0, 20.0]) };
        assert_eq!(lens.project(0.5, 0.25), (100.0 * 0.5 + 7.0 * 0.25 + 10.0, 200.0 * 0.25 + 20.0));
        assert!(!lens.is_pinhole());
        assert_eq!(lens.scaled(2.0, 3.0).skew, 14.0);
        // The tangential terms grow by 1 + g1 r² + g2 r⁴.
        let distortion =
            Distortion { tangential: [0.01, 0.02], tangential_growth: [2.0, 3.0], ..Distortion::default() };
        let lens = Lens { distortion, ..Lens::pinhole([1.0, 1.0], [0.0, 0.0]) };
        let growth = 1.0 + 2.0 * 0.05 + 3.0 * 0.0025;
        let (x, y) = lens.project(0.2, 0.1);
        assert!((x - 0.2 - growth * (2.0 * 0.01 * 0.02 + 0.02 * (0.05 + 0.08))).abs() < 1e-15);
        assert!((y - 0.1 - growth * (2.0 * 0.02 * 0.02 + 0.01 * (0.05 + 0.02))).abs() < 1e-15);
    }

    #[test]
    fn an_equisolid_lens_ends_at_a_right_angle() {
        let [_, _, plain] = examples(1.0);
        let end = 500.0 * std::f64::consts::SQRT_2;
        assert!(plain.unproject(500.0 + end - 0.1, 350.0).is_some_and(|(u, _)| u > 100.0));
        assert_eq!(plain.unproject(500.0 + end + 0.1, 350.0), None);
        assert_eq!(plain.unproject(2000.0, 350.0), None);
        assert_eq!(plain.unproject(500.0, 350.0), Some((0.0, 0.0)));
    }

    #[test]
    fn json_keeps_every_bit_and_refuses_unknown_fields() {
        let mut lenses = examples(0.7).to_vec();
        let thirds = |n: f64| n / 3.0;
        for projection in [
            Projection::Equidistant,
            Projection::FieldOfView { omega: thirds(2.0) },
            Projection::Division { k: -thirds(0.1) },
            Projection::Unified { alpha: thirds(1.0), beta: thirds(4.0) },
        ] {
            let distortion = Distortion {
                denominator: [thirds(0.1), 1e-300, -0.0],
                prism: [thirds(1e-7), -thirds(1e-9)],
                after_radial: Some([thirds(1.0), thirds(-5.0)]),
                ..Distortion::default()
            };
            lenses.push(Lens { projection, distortion, ..lenses[0] });
        }
        for lens in lenses {
            let json = serde_json::to_string(&lens).unwrap();
            assert_eq!(serde_json::from_str::<Lens>(&json).unwrap(), lens, "{json}");
            for field in ["focal", "projection", "numerator"] {
                let unknown = json.replacen(&format!("\"{field}\""), &format!("\"x\":0,\"{field}\""), 1);
                assert!(serde_json::from_str::<Lens>(&unknown).is_err(), "{unknown}");
            }
        }
    }

    proptest! {
        #[test]
        fn unproject_inverts_project(which in 0usize..3, amount in 0.0f64..1.2, x in 0.0f64..1000.0, y in 0.0f64..700.0) {
            let lens = examples(amount)[which];
            let (u, v) = lens.unproject(x, y).expect("every pixel of these lenses has a ray");
            let (px, py) = lens.project(u, v);
            prop_assert!(math::hypot(px - x, py - y) < 1e-6);
        }

        #[test]
        fn the_jacobian_is_that_of_finite_differences(which in 0usize..3, amount in 0.0f64..1.2, u in -0.7f64..0.7, v in -0.5f64..0.5) {
            let lens = examples(amount)[which];
            let (pixel, jacobian) = lens.project_with_jacobian(u, v);
            prop_assert_eq!(pixel, lens.project(u, v));
            let h = 1e-6;
            let difference = |a: (f64, f64), b: (f64, f64)| [(a.0 - b.0) / (2.0 * h), (a.1 - b.1) / (2.0 * h)];
            let by_u = difference(lens.project(u + h, v), lens.project(u - h, v));
            let by_v = difference(lens.project(u, v + h), lens.project(u, v - h));
            for row in 0..2 {
                prop_assert!((jacobian[row][0] - by_u[row]).abs() < 1e-4);
                prop_assert!((jacobian[row][1] - by_v[row]).abs() < 1e-4);
            }
        }
    }
}
