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
//! Ids, names and parameter order are those of COLMAP 4.2 (its `doc/cameras.rst` and camera files).
//! [`Lens`] computes the bend and its inverse.
//!
//! EQUIRECTANGULAR (id 17) is not among the lenses: a panorama has rays in all directions, and no pinhole can
//! show them.
//!
//! Limit: rays at 90° or more from the axis (`z ≤ 0`) have no point on the plane. No pinhole can show them
//! either.

use use3d_survey::{Distortion, Lens, Projection};

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

    fn row(self) -> &'static ModelRow {
        &MODELS[self as usize]
    }

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
        self.row().0
    }

    /// The model of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.name() == name)
    }

    /// Number of its parameters.
    pub fn parameter_count(self) -> usize {
        self.focal_lengths() + 2 + self.row().2
    }

    /// Number of its focal lengths: 1 if one serves both axes.
    pub(crate) fn focal_lengths(self) -> usize {
        self.row().1
    }

    /// The lens of this model with COLMAP's parameters, pixels; `None` if their number is wrong.
    pub fn lens(self, parameters: &[f64]) -> Option<Lens> {
        if parameters.len() != self.parameter_count() {
            return None;
        }
        let (focals, fisheye) = (self.focal_lengths(), self.row().3);
        let (focal, rest) = parameters.split_at(focals);
        let (principal, k) = rest.split_at(2);
        let projection = match self {
            M::Fov => Projection::FieldOfView { omega: k[0] },
            // As their parameter goes to 0, these models approach the perspective one.
            M::SimpleDivision | M::Division if k[0] != 0.0 => Projection::Division { k: k[0] },
            M::Eucm if k[0] != 0.0 => Projection::Unified { alpha: k[0], beta: k[1] },
            _ if fisheye => Projection::Equidistant,
            _ => Projection::Perspective,
        };
        let mut d = Distortion::default();
        match self {
            M::SimplePinhole | M::Pinhole | M::Fov | M::SimpleFisheye | M::Fisheye => {}
            M::SimpleDivision | M::Division | M::Eucm => {}
            M::SimpleRadial | M::Radial | M::SimpleRadialFisheye | M::RadialFisheye | M::OpenCvFisheye => {
                d.numerator[..k.len()].copy_from_slice(k);
            }
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
                d.tangential = [k[7], k[6]];
                d.prism = [k[8], k[10]];
                d.after_radial = Some([k[9], k[11]]);
            }
        }
        let pinhole = Lens::pinhole([focal[0], focal[focals - 1]], [principal[0], principal[1]]);
        Some(Lens { projection, distortion: d, ..pinhole })
    }
}

/// A model's name, the number of its focal lengths, the number of its parameters after the principal point,
/// and true for a fisheye.
type ModelRow = (&'static str, usize, usize, bool);

/// The rows of all models, by id.
const MODELS: [ModelRow; 17] = [
    ("SIMPLE_PINHOLE", 1, 0, false),
    ("PINHOLE", 2, 0, false),
    ("SIMPLE_RADIAL", 1, 1, false),
    ("RADIAL", 1, 2, false),
    ("OPENCV", 2, 4, false),
    ("OPENCV_FISHEYE", 2, 4, true),
    ("FULL_OPENCV", 2, 8, false),
    ("FOV", 2, 1, false),
    ("SIMPLE_RADIAL_FISHEYE", 1, 1, true),
    ("RADIAL_FISHEYE", 1, 2, true),
    ("THIN_PRISM_FISHEYE", 2, 8, true),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12, true),
    ("SIMPLE_DIVISION", 1, 1, false),
    ("DIVISION", 2, 1, false),
    ("SIMPLE_FISHEYE", 1, 0, true),
    ("FISHEYE", 2, 0, true),
    ("EUCM", 2, 2, false),
];

#[cfg(test)]
#[path = "../tests/common/lenses.rs"]
pub(crate) mod lenses;

#[cfg(test)]
mod tests {
    use super::lenses::example;
    use super::*;
    use use3d_numerics::math;

    /// A lens, its parameters, and the pixels of two directions.
    type Bent = (LensModel, &'static [f64], [(f64, f64); 2]);
    use proptest::prelude::*;

    #[test]
    fn ids_names_and_counts_are_colmaps() {
        for (i, model) in LensModel::ALL.into_iter().enumerate() {
            assert_eq!(model.id(), i as i32);
            assert_eq!(LensModel::from_id(i as i32), Some(model));
            assert_eq!(LensModel::from_name(model.name()), Some(model));
            assert!(model.lens(&vec![1.0; model.parameter_count() + 1]).is_none());
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
        let lens = M::OpenCv.lens(&[1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.02]).unwrap();
        let (x, y) = lens.project(0.2, 0.1);
        assert!((x - (0.2 + 2.0 * 0.01 * 0.02 + 0.02 * (0.05 + 0.08))).abs() < 1e-15);
        assert!((y - (0.1 + 2.0 * 0.02 * 0.02 + 0.01 * (0.05 + 0.02))).abs() < 1e-15);
        // Equidistant: 45° off the axis lands at f π/4.
        let lens = M::SimpleRadialFisheye.lens(&[100.0, 0.0, 0.0, 0.0]).unwrap();
        assert!((lens.project(1.0, 0.0).0 - 100.0 * std::f64::consts::FRAC_PI_4).abs() < 1e-12);
        // FOV: r' = atan(2 r tan(ω/2)) / ω.
        let lens = M::Fov.lens(&[1.0, 1.0, 0.0, 0.0, 0.8]).unwrap();
        assert!((lens.project(0.0, 0.7).1 - math::atan(1.4 * math::tan(0.4f64)) / 0.8).abs() < 1e-15);
        // FULL_OPENCV's rational factor: k = (k1, k2, p1, p2, k3, k4, k5, k6).
        let lens = M::FullOpenCv.lens(&[1.0, 1.0, 0.0, 0.0, 0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6]).unwrap();
        let r2 = 0.25f64;
        let factor = (1.0 + 0.1 * r2 + 0.2 * r2 * r2 + 0.3 * math::powi(r2, 3))
            / (1.0 + 0.4 * r2 + 0.5 * r2 * r2 + 0.6 * math::powi(r2, 3));
        assert!((lens.project(0.5, 0.0).0 - 0.5 * factor).abs() < 1e-15);
        // THIN_PRISM_FISHEYE's prism adds s r² to the equidistant point.
        let lens = M::ThinPrismFisheye
            .lens(&[1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.01, 0.02])
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
            let lens = model.lens(parameters).unwrap();
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
            assert!(model.lens(parameters).unwrap().is_pinhole(), "{model:?}");
        }
        // 1 + k r'² = 0 at radius 2 of the plane: rays in the image plane.
        let barrel = M::SimpleDivision.lens(&[100.0, 0.0, 0.0, -0.25]).unwrap();
        assert!(barrel.unproject(199.0, 0.0).is_some_and(|(u, _)| u > 100.0));
        assert_eq!(barrel.unproject(201.0, 0.0), None);
        // r' comes back beyond 1/√k = 2, where r = 1.
        let pincushion = M::SimpleDivision.lens(&[100.0, 0.0, 0.0, 0.25]).unwrap();
        assert!((pincushion.unproject(199.9, 0.0).unwrap().0 - 1.0).abs() < 1e-3);
        assert_eq!(pincushion.unproject(201.0, 0.0), None);
        assert!(pincushion.project(1.01, 0.0).0.is_nan());
        // α² β r'² = 1 at radius 1 / 0.8.
        let unified = M::Eucm.lens(&[100.0, 100.0, 0.0, 0.0, 0.8, 1.0]).unwrap();
        assert!(unified.unproject(124.0, 0.0).is_some_and(|(u, _)| u > 10.0));
        assert_eq!(unified.unproject(126.0, 0.0), None);
        assert_eq!(unified.unproject(500.0, 0.0), None);
    }

    #[test]
    fn beyond_the_fold_there_is_no_ray() {
        // r (1 - 0.5 r²) peaks at r = 0.816 with 0.544: nothing lands further out.
        let lens = M::SimpleRadial.lens(&[100.0, 0.0, 0.0, -0.5]).unwrap();
        assert!(lens.unproject(54.0, 0.0).is_some());
        assert_eq!(lens.unproject(55.0, 0.0), None);
        // A fisheye pixel at 90° and more.
        let lens = M::SimpleRadialFisheye.lens(&[100.0, 0.0, 0.0, 0.0]).unwrap();
        assert_eq!(lens.unproject(158.0, 0.0), None);
        assert!((lens.unproject(150.0, 0.0).unwrap().0 - math::tan(1.5f64)).abs() < 1e-9);
    }

    #[test]
    fn a_wide_fov_of_almost_nothing_is_a_pinhole() {
        let lens = M::Fov.lens(&[10.0, 10.0, 0.0, 0.0, 1e-12]).unwrap();
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
