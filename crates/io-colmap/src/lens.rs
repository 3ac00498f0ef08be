//! COLMAP's camera models: the pixel of a ray on the sensor, and the ray of a pixel.
//!
//! A ray of the camera frame is written as its point `(u, v) = (x/z, y/z)` on the plane `z = 1`. Its pixel is
//! `(fx u' + cx, fy v' + cy)` with the bent point `(u', v')`. Bending is a *projection* followed by a
//! *distortion*:
//!
//! * projection: perspective (`u' = u`), equidistant (the point is moved to radius `θ = atan r`),
//!   field-of-view (`r' = atan(2 r tan(ω/2)) / ω`), division (`r = r' / (1 + k r'²)`, its nearer root), or
//!   enhanced unified (`u' = u / (α √(β r² + 1) + 1 - α)`, with `α` in `[0, 1]` and `β > 0`);
//! * distortion: `D(u) = u·radial(|u|²) + tangential(p1, p2) + prism(s1, s2)`, as in OpenCV, with the
//!   polynomial or rational radial factor of each model. The fisheye models apply their polynomial to the
//!   equidistant point. RAD_TAN_THIN_PRISM_FISHEYE evaluates the tangential and prism terms at the point
//!   after the radial factor.
//!
//! Ids, names and parameter order are those of COLMAP 4.2 (its `doc/cameras.rst` and camera files). The
//! inverse is Newton's method on `D` with the exact Jacobian (by [`Jet`]) and step halving, then the closed
//! inverse of the projection. A pixel has no inverse if no ray in front of the camera reaches it, or if it is
//! beyond the fold of a distortion polynomial. A ray that a division lens with `k > 0` does not see (`4 k r²
//! > 1`) has no pixel: the result is NaN.
//!
//! EQUIRECTANGULAR (id 17) is not among the lenses: a panorama has rays in all directions, and no pinhole can
//! show them.
//!
//! Limit: rays at 90° or more from the axis (`z ≤ 0`) have no point on the plane. No pinhole can show them
//! either.

use use3d_capture::Intrinsics;
use use3d_numerics::math;

use crate::jet::{Jet, Real};

/// A camera model of COLMAP, with its id and name in COLMAP's files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum LensModel {
    /// `f, cx, cy`
    SimplePinhole,
    /// `fx, fy, cx, cy`
    Pinhole,
    /// `f, cx, cy, k`
    SimpleRadial,
    /// `f, cx, cy, k1, k2`
    Radial,
    /// `fx, fy, cx, cy, k1, k2, p1, p2`
    OpenCv,
    /// `fx, fy, cx, cy, k1, k2, k3, k4`
    OpenCvFisheye,
    /// `fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6`
    FullOpenCv,
    /// `fx, fy, cx, cy, omega`
    Fov,
    /// `f, cx, cy, k`
    SimpleRadialFisheye,
    /// `f, cx, cy, k1, k2`
    RadialFisheye,
    /// `fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1`
    ThinPrismFisheye,
    /// `fx, fy, cx, cy, k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3`
    RadTanThinPrismFisheye,
    /// `f, cx, cy, k`
    SimpleDivision,
    /// `fx, fy, cx, cy, k`
    Division,
    /// `f, cx, cy`
    SimpleFisheye,
    /// `fx, fy, cx, cy`
    Fisheye,
    /// `fx, fy, cx, cy, alpha, beta`: the enhanced unified camera model
    Eucm,
}

use LensModel as M;

impl LensModel {
    /// All models, in the order of their ids 0 to 16.
    pub const ALL: [Self; 17] = [
        M::SimplePinhole,
        M::Pinhole,
        M::SimpleRadial,
        M::Radial,
        M::OpenCv,
        M::OpenCvFisheye,
        M::FullOpenCv,
        M::Fov,
        M::SimpleRadialFisheye,
        M::RadialFisheye,
        M::ThinPrismFisheye,
        M::RadTanThinPrismFisheye,
        M::SimpleDivision,
        M::Division,
        M::SimpleFisheye,
        M::Fisheye,
        M::Eucm,
    ];

    /// The name and the id of COLMAP's model of panoramas, which is not supported as a lens.
    pub(crate) const PANORAMA: (&str, i32) = ("EQUIRECTANGULAR", 17);

    /// The id in binary files.
    pub fn id(self) -> i32 {
        self as i32
    }

    /// The model with that id.
    pub fn from_id(id: i32) -> Option<Self> {
        usize::try_from(id).ok().and_then(|i| Self::ALL.get(i)).copied()
    }

    /// The name in text files.
    pub fn name(self) -> &'static str {
        match self {
            M::SimplePinhole => "SIMPLE_PINHOLE",
            M::Pinhole => "PINHOLE",
            M::SimpleRadial => "SIMPLE_RADIAL",
            M::Radial => "RADIAL",
            M::OpenCv => "OPENCV",
            M::OpenCvFisheye => "OPENCV_FISHEYE",
            M::FullOpenCv => "FULL_OPENCV",
            M::Fov => "FOV",
            M::SimpleRadialFisheye => "SIMPLE_RADIAL_FISHEYE",
            M::RadialFisheye => "RADIAL_FISHEYE",
            M::ThinPrismFisheye => "THIN_PRISM_FISHEYE",
            M::RadTanThinPrismFisheye => "RAD_TAN_THIN_PRISM_FISHEYE",
            M::SimpleDivision => "SIMPLE_DIVISION",
            M::Division => "DIVISION",
            M::SimpleFisheye => "SIMPLE_FISHEYE",
            M::Fisheye => "FISHEYE",
            M::Eucm => "EUCM",
        }
    }

    /// The model of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.name() == name)
    }

    /// Number of its parameters.
    pub fn parameter_count(self) -> usize {
        match self {
            M::SimplePinhole | M::SimpleFisheye => 3,
            M::Pinhole | M::SimpleRadial | M::SimpleRadialFisheye | M::SimpleDivision | M::Fisheye => 4,
            M::Radial | M::Fov | M::RadialFisheye | M::Division => 5,
            M::Eucm => 6,
            M::OpenCv | M::OpenCvFisheye => 8,
            M::FullOpenCv | M::ThinPrismFisheye => 12,
            M::RadTanThinPrismFisheye => 16,
        }
    }

    /// True if one focal length serves both axes.
    fn single_focal(self) -> bool {
        matches!(
            self,
            M::SimplePinhole
                | M::SimpleRadial
                | M::Radial
                | M::SimpleRadialFisheye
                | M::RadialFisheye
                | M::SimpleDivision
                | M::SimpleFisheye
        )
    }
}

/// The map of a ray's point before the distortion.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Projection {
    Perspective,
    Equidistant,
    FieldOfView { omega: f64 },
    Division { k: f64 },
    Unified { alpha: f64, beta: f64 },
}

/// `u·(1 + n1 r² + n2 r⁴ + … + n6 r¹²) / (1 + d1 r² + d2 r⁴ + d3 r⁶)` and the tangential and prism terms.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Distortion {
    numerator: [f64; 6],
    denominator: [f64; 3],
    tangential: [f64; 2],
    prism: [f64; 2],
    /// Prism terms with `r⁴`. `Some` means that tangential and prism terms are evaluated at the point after
    /// the radial factor; with `None` they are evaluated at the point itself.
    after_radial: Option<[f64; 2]>,
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
        let mut du = uv * (2.0 * p1) + (r2 + uu * 2.0) * p2 + r2 * s1;
        let mut dv = uv * (2.0 * p2) + (r2 + vv * 2.0) * p1 + r2 * s2;
        if let Some([t1, t2]) = self.after_radial {
            (du, dv) = (du + r2 * r2 * t1, dv + r2 * r2 * t2);
        }
        (moved.0 + du, moved.1 + dv)
    }

    /// Solves `apply(u) = target`; `None` if there is no solution before the fold.
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
            let (ju, jv) = Jet::inputs(u, v);
            let (a, b) = self.apply(ju, jv);
            let det = a.by[0] * b.by[1] - a.by[1] * b.by[0];
            let step_u = (b.by[1] * ru - a.by[1] * rv) / det;
            let step_v = (a.by[0] * rv - b.by[0] * ru) / det;
            if !(step_u.is_finite() && step_v.is_finite()) {
                return None;
            }
            // Halve the step until the residual shrinks; if it never does, the limit of rounding is reached.
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

    /// Accepts a solution if it is exact to about 1e-11 and the lens does not fold between the axis and it.
    fn accept(&self, u: f64, v: f64, residual: f64, goal: f64) -> Option<(f64, f64)> {
        let unfolded = (1..=16).all(|i| {
            let share = f64::from(i) / 16.0;
            self.determinant(u * share, v * share) > 0.0
        });
        (residual <= 1000.0 * goal && unfolded).then_some((u, v))
    }

    fn determinant(&self, u: f64, v: f64) -> f64 {
        let (ju, jv) = Jet::inputs(u, v);
        let (a, b) = self.apply(ju, jv);
        a.by[0] * b.by[1] - a.by[1] * b.by[0]
    }
}

/// A camera model with its parameters, ready to bend rays. Focal lengths are in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lens {
    focal: [f64; 2],
    principal: [f64; 2],
    projection: Projection,
    distortion: Distortion,
}

impl Lens {
    /// The lens of a model with COLMAP's parameters; `None` if their number is wrong.
    pub fn new(model: LensModel, parameters: &[f64]) -> Option<Self> {
        if parameters.len() != model.parameter_count() {
            return None;
        }
        let (focal, principal, k) = if model.single_focal() {
            ([parameters[0]; 2], [parameters[1], parameters[2]], &parameters[3..])
        } else {
            ([parameters[0], parameters[1]], [parameters[2], parameters[3]], &parameters[4..])
        };
        let mut distortion = Distortion::default();
        let d = &mut distortion;
        let projection = match model {
            M::Fov => Projection::FieldOfView { omega: k[0] },
            // As their parameter goes to 0, these models approach the perspective one.
            M::SimpleDivision | M::Division if k[0] != 0.0 => Projection::Division { k: k[0] },
            M::Eucm if k[0] != 0.0 => Projection::Unified { alpha: k[0], beta: k[1] },
            M::OpenCvFisheye
            | M::SimpleRadialFisheye
            | M::RadialFisheye
            | M::ThinPrismFisheye
            | M::RadTanThinPrismFisheye
            | M::SimpleFisheye
            | M::Fisheye => Projection::Equidistant,
            _ => Projection::Perspective,
        };
        match model {
            M::SimplePinhole | M::Pinhole | M::Fov | M::SimpleFisheye | M::Fisheye => {}
            M::SimpleDivision | M::Division | M::Eucm => {}
            M::SimpleRadial | M::SimpleRadialFisheye => d.numerator[0] = k[0],
            M::Radial | M::RadialFisheye => d.numerator[..2].copy_from_slice(k),
            M::OpenCvFisheye => d.numerator[..4].copy_from_slice(k),
            M::OpenCv => {
                d.numerator[..2].copy_from_slice(&k[..2]);
                d.tangential.copy_from_slice(&k[2..]);
            }
            M::FullOpenCv => {
                d.numerator[..3].copy_from_slice(&[k[0], k[1], k[4]]);
                d.denominator.copy_from_slice(&k[5..8]);
                d.tangential.copy_from_slice(&k[2..4]);
            }
            M::ThinPrismFisheye => {
                d.numerator[..4].copy_from_slice(&[k[0], k[1], k[4], k[5]]);
                d.tangential.copy_from_slice(&k[2..4]);
                d.prism.copy_from_slice(&k[6..]);
            }
            M::RadTanThinPrismFisheye => {
                d.numerator.copy_from_slice(&k[..6]);
                // The parameter p0 belongs to x², like OpenCV's p2.
                d.tangential.copy_from_slice(&[k[7], k[6]]);
                d.prism.copy_from_slice(&[k[8], k[10]]);
                d.after_radial = Some([k[9], k[11]]);
            }
        }
        Some(Self { focal, principal, projection, distortion })
    }

    /// Focal lengths `(fx, fy)` and principal point `(cx, cy)`, pixels.
    pub fn pinhole_part(&self) -> ([f64; 2], [f64; 2]) {
        (self.focal, self.principal)
    }

    /// The same lens on an image scaled by `sx`, `sy`.
    pub fn scaled(&self, sx: f64, sy: f64) -> Self {
        Self {
            focal: [self.focal[0] * sx, self.focal[1] * sy],
            principal: [self.principal[0] * sx, self.principal[1] * sy],
            ..*self
        }
    }

    /// True if rays are not bent at all.
    pub fn is_pinhole(&self) -> bool {
        self.projection == Projection::Perspective && self.distortion == Distortion::default()
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
            Projection::FieldOfView { omega } => {
                // As ω goes to 0, the model approaches the perspective one.
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

    /// The pixel of a ray's point `(x/z, y/z)`.
    pub fn project(&self, u: f64, v: f64) -> (f64, f64) {
        let (a, b) = self.bend(u, v);
        (self.focal[0] * a + self.principal[0], self.focal[1] * b + self.principal[1])
    }

    /// The pixel and its Jacobian: `[[∂x/∂u, ∂x/∂v], [∂y/∂u, ∂y/∂v]]`.
    pub fn project_with_jacobian(&self, u: f64, v: f64) -> ((f64, f64), [[f64; 2]; 2]) {
        let (ju, jv) = Jet::inputs(u, v);
        let (a, b) = self.bend(ju, jv);
        let pixel =
            (self.focal[0] * a.value + self.principal[0], self.focal[1] * b.value + self.principal[1]);
        (pixel, [a.by.map(|d| d * self.focal[0]), b.by.map(|d| d * self.focal[1])])
    }

    /// The ray's point for a pixel; `None` if no ray in front of the camera reaches the pixel before the lens
    /// folds.
    pub fn unproject(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let bent = ((x - self.principal[0]) / self.focal[0], (y - self.principal[1]) / self.focal[1]);
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
                // At -1 rays are in the image plane; 1 is the root beyond which radii decrease again.
                if !(-1.0 < moved && moved < 1.0) {
                    return None;
                }
                radius / (1.0 + moved)
            }
            Projection::Unified { alpha, beta } => {
                let (r2, rest) = (radius * radius, 1.0 - alpha);
                let inner = 1.0 - (alpha - rest) * beta * r2;
                let depth = (1.0 - alpha * alpha * beta * r2) / (alpha * inner.sqrt() + rest);
                // NaN if no ray reaches the pixel, not above 0 if no ray in front of the camera does.
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
#[path = "../tests/common/lenses.rs"]
mod lenses;

#[cfg(test)]
mod tests {
    use super::lenses::example;
    use super::*;

    /// A lens, its parameters, and the pixels of two directions.
    type Bent = (LensModel, &'static [f64], [(f64, f64); 2]);
    use proptest::prelude::*;

    #[test]
    fn ids_names_and_counts_are_colmaps() {
        for (i, model) in LensModel::ALL.into_iter().enumerate() {
            assert_eq!(model.id(), i as i32);
            assert_eq!(LensModel::from_id(i as i32), Some(model));
            assert_eq!(LensModel::from_name(model.name()), Some(model));
            assert!(Lens::new(model, &vec![1.0; model.parameter_count() + 1]).is_none());
        }
        assert_eq!(LensModel::from_id(17), None, "a panorama is no lens");
        assert_eq!(LensModel::from_id(-1), None);
    }

    #[test]
    fn hand_computed_bends() {
        // SIMPLE_RADIAL at (0.5, 0): r² = 0.25, factor 1 - 0.12·0.25 = 0.97.
        let (x, y) = example(M::SimpleRadial, 1.0).project(0.5, 0.0);
        assert!((x - (800.0 * 0.5 * 0.97 + 503.0)).abs() < 1e-12 && y == 347.0);
        // OPENCV tangential at (0.2, 0.1) without radial: du = 2 p1 uv + p2 (r² + 2u²), dv = 2 p2 uv + p1 (r²
        // + 2v²).
        let lens = Lens::new(M::OpenCv, &[1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.02]).unwrap();
        let (x, y) = lens.project(0.2, 0.1);
        assert!((x - (0.2 + 2.0 * 0.01 * 0.02 + 0.02 * (0.05 + 0.08))).abs() < 1e-15);
        assert!((y - (0.1 + 2.0 * 0.02 * 0.02 + 0.01 * (0.05 + 0.02))).abs() < 1e-15);
        // Equidistant: 45° off the axis lands at f π/4.
        let lens = Lens::new(M::SimpleRadialFisheye, &[100.0, 0.0, 0.0, 0.0]).unwrap();
        assert!((lens.project(1.0, 0.0).0 - 100.0 * std::f64::consts::FRAC_PI_4).abs() < 1e-12);
        // FOV: r' = atan(2 r tan(ω/2)) / ω.
        let lens = Lens::new(M::Fov, &[1.0, 1.0, 0.0, 0.0, 0.8]).unwrap();
        assert!((lens.project(0.0, 0.7).1 - math::atan(1.4 * math::tan(0.4f64)) / 0.8).abs() < 1e-15);
        // FULL_OPENCV's rational factor: k = (k1, k2, p1, p2, k3, k4, k5, k6).
        let lens =
            Lens::new(M::FullOpenCv, &[1.0, 1.0, 0.0, 0.0, 0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6]).unwrap();
        let r2 = 0.25f64;
        let factor = (1.0 + 0.1 * r2 + 0.2 * r2 * r2 + 0.3 * math::powi(r2, 3))
            / (1.0 + 0.4 * r2 + 0.5 * r2 * r2 + 0.6 * math::powi(r2, 3));
        assert!((lens.project(0.5, 0.0).0 - 0.5 * factor).abs() < 1e-15);
        // THIN_PRISM_FISHEYE's prism adds s r² to the equidistant point.
        let lens =
            Lens::new(M::ThinPrismFisheye, &[1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.02])
                .unwrap();
        let theta = math::atan(0.5f64);
        let (x, y) = lens.project(0.5, 0.0);
        assert!((x - (theta + 0.01 * theta * theta)).abs() < 1e-15);
        assert!((y - 0.02 * theta * theta).abs() < 1e-15);
    }

    /// `img_from_cam` of COLMAP 4.2.1 (`pip install pycolmap==4.2.1`).
    #[test]
    fn bends_are_colmaps() {
        let rays = [(0.5, -0.3), (-0.2, 0.45)];
        let cases: [Bent; 6] = [
            (
                M::RadTanThinPrismFisheye,
                &[
                    500.0, 510.0, 503.0, 347.0, -0.02, 0.01, -0.004, 0.002, -0.0008, 0.0001, 0.002, -0.001,
                    -0.002, 0.0004, 0.003, -0.0006,
                ],
                [(728.7738181889017, 209.09392592819754), (410.58461600576965, 559.3118709434548)],
            ),
            (
                M::SimpleDivision,
                &[800.0, 503.0, 347.0, -0.12],
                [(887.8897108677502, 116.06617347934991), (347.40325677035537, 697.0926722667004)],
            ),
            (
                M::Division,
                &[800.0, 820.0, 503.0, 347.0, 0.1],
                [(917.6117465307057, 92.01377588361606), (338.9195759385336, 725.4104779917568)],
            ),
            (
                M::SimpleFisheye,
                &[500.0, 503.0, 347.0],
                [(729.333863266565, 211.19968204006102), (410.07883613972865, 556.0726186856105)],
            ),
            (
                M::Fisheye,
                &[500.0, 510.0, 503.0, 347.0],
                [(729.333863266565, 208.48367568086223), (410.07883613972865, 560.2540710593227)],
            ),
            (
                M::Eucm,
                &[600.0, 610.0, 503.0, 347.0, 0.6, 1.1],
                [(774.9099419499566, 181.13493541052645), (391.4032293904213, 602.2776127694112)],
            ),
        ];
        for (model, parameters, pixels) in cases {
            let lens = Lens::new(model, parameters).unwrap();
            for ((u, v), (x, y)) in rays.into_iter().zip(pixels) {
                let (px, py) = lens.project(u, v);
                assert!(math::hypot(px - x, py - y) < 1e-9, "{model:?}: {px} {py}, COLMAP {x} {y}");
                let (a, b) = lens.unproject(x, y).unwrap();
                assert!(math::hypot(a - u, b - v) < 1e-9, "{model:?}: {a} {b}");
            }
        }
    }

    #[test]
    fn division_and_unified_lenses_of_nothing_are_pinholes_and_have_an_end() {
        for (model, parameters) in [
            (M::SimpleDivision, &[100.0, 0.0, 0.0, 0.0][..]),
            (M::Division, &[100.0, 100.0, 0.0, 0.0, 0.0]),
            (M::Eucm, &[100.0, 100.0, 0.0, 0.0, 0.0, 1.0]),
        ] {
            assert!(Lens::new(model, parameters).unwrap().is_pinhole(), "{model:?}");
        }
        // 1 + k r'² = 0 at radius 2 of the plane: rays in the image plane.
        let barrel = Lens::new(M::SimpleDivision, &[100.0, 0.0, 0.0, -0.25]).unwrap();
        assert!(barrel.unproject(199.0, 0.0).is_some_and(|(u, _)| u > 100.0));
        assert_eq!(barrel.unproject(201.0, 0.0), None);
        // r' decreases again beyond 1/√k = 2, where r = 1.
        let pincushion = Lens::new(M::SimpleDivision, &[100.0, 0.0, 0.0, 0.25]).unwrap();
        assert!((pincushion.unproject(199.9, 0.0).unwrap().0 - 1.0).abs() < 1e-3);
        assert_eq!(pincushion.unproject(201.0, 0.0), None);
        assert!(pincushion.project(1.01, 0.0).0.is_nan());
        // α² β r'² = 1 at radius 1 / 0.8.
        let unified = Lens::new(M::Eucm, &[100.0, 100.0, 0.0, 0.0, 0.8, 1.0]).unwrap();
        assert!(unified.unproject(124.0, 0.0).is_some_and(|(u, _)| u > 10.0));
        assert_eq!(unified.unproject(126.0, 0.0), None);
        assert_eq!(unified.unproject(500.0, 0.0), None);
    }

    #[test]
    fn beyond_the_fold_there_is_no_ray() {
        // r (1 - 0.5 r²) has its maximum 0.544 at r = 0.816: no ray reaches a larger radius.
        let lens = Lens::new(M::SimpleRadial, &[100.0, 0.0, 0.0, -0.5]).unwrap();
        assert!(lens.unproject(54.0, 0.0).is_some());
        assert_eq!(lens.unproject(55.0, 0.0), None);
        // A fisheye pixel at 90° or more.
        let lens = Lens::new(M::SimpleRadialFisheye, &[100.0, 0.0, 0.0, 0.0]).unwrap();
        assert_eq!(lens.unproject(158.0, 0.0), None);
        assert!((lens.unproject(150.0, 0.0).unwrap().0 - math::tan(1.5f64)).abs() < 1e-9);
    }

    #[test]
    fn a_wide_fov_of_almost_nothing_is_a_pinhole() {
        let lens = Lens::new(M::Fov, &[10.0, 10.0, 0.0, 0.0, 1e-12]).unwrap();
        assert!((lens.project(0.3, 0.2).0 - 3.0).abs() < 1e-9);
    }

    proptest! {
        /// Pixel → ray → pixel to 1e-6 px, over the whole sensor, for every model and strength.
        #[test]
        fn unproject_inverts_project(model in 0..LensModel::ALL.len(), amount in 0.0f64..1.2, x in 0.0f64..1000.0, y in 0.0f64..700.0) {
            let lens = example(LensModel::ALL[model], amount);
            let (u, v) = lens.unproject(x, y).expect("every pixel of these lenses has a ray");
            let (px, py) = lens.project(u, v);
            prop_assert!(math::hypot(px - x, py - y) < 1e-6, "{:?}: off by {}", LensModel::ALL[model], math::hypot(px - x, py - y));
        }

        /// Ray → pixel → ray.
        #[test]
        fn project_inverts_unproject(model in 0..LensModel::ALL.len(), amount in 0.0f64..1.2, u in -0.6f64..0.6, v in -0.4f64..0.4) {
            let lens = example(LensModel::ALL[model], amount);
            let (x, y) = lens.project(u, v);
            let (a, b) = lens.unproject(x, y).unwrap();
            prop_assert!(math::hypot(a - u, b - v) < 1e-9);
        }

        /// The Jacobian against central differences.
        #[test]
        fn the_jacobian_is_that_of_finite_differences(model in 0..LensModel::ALL.len(), amount in 0.0f64..1.2, u in -0.7f64..0.7, v in -0.5f64..0.5) {
            let lens = example(LensModel::ALL[model], amount);
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
