//! The lens in front of the camera: none, or one that bends straight lines as diving cameras do.
//!
//! The lens is that of a COLMAP camera, so the photographs and their model agree exactly: a pixel is
//! unprojected to its ray, and the ray is cast. No picture is resampled. Every pixel of every lens has a ray,
//! and no lens folds, for any size of image: the parameters are drawn from narrow ranges, and focal lengths
//! follow the longer side.
//!
//! | kind | COLMAP's model | like |
//! |---|---|---|
//! | `radial` | `RADIAL`, k1 0.2 to 0.36, k2 0.17 to 0.23 | an action camera behind a flat port: pincushion |
//! | `opencv` | `OPENCV`, k1 −0.25 to −0.18, k2 0.05 to 0.08, small p1, p2 | a wide lens: barrel |
//! | `fisheye` | `OPENCV_FISHEYE`, 100 degrees along the longer side | a fisheye |

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::Intrinsics;
use use3d_io_colmap::{LensModel, ModelCamera};

use crate::scene::Draws;

/// The lens of a synthetic camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Optics {
    /// A pinhole.
    #[default]
    Pinhole,
    /// Pincushion distortion, as behind a flat port.
    Radial,
    /// Barrel distortion with tangential terms.
    OpenCv,
    /// A fisheye of 100 degrees along the longer side.
    Fisheye,
}

impl Optics {
    /// All lenses.
    pub const ALL: [Self; 4] = [Self::Pinhole, Self::Radial, Self::OpenCv, Self::Fisheye];

    /// Its name in parameter files.
    pub fn name(self) -> &'static str {
        ["pinhole", "radial", "opencv", "fisheye"][self as usize]
    }

    /// The camera of the model, with id 1, for a pinhole of the same size and principal point.
    pub(crate) fn camera(self, pinhole: &Intrinsics, seed: u64) -> ModelCamera {
        let mut draws = Draws::new(seed, "distortion", 0);
        let mut about = |middle: f32, spread: f32| f64::from(middle + draws.about(spread));
        let Intrinsics { width, height, cx, cy, .. } = *pinhole;
        let side = width.max(height) as f64;
        let f = 0.76 * side;
        let (model, parameters) = match self {
            Self::Pinhole => return ModelCamera::pinhole(1, pinhole),
            Self::Radial => (LensModel::Radial, vec![f, cx, cy, about(0.28, 0.08), about(0.2, 0.03)]),
            Self::OpenCv => {
                let (k1, k2) = (about(-0.215, 0.035), about(0.065, 0.015));
                let (p1, p2) = (about(0.0, 0.003), about(0.0, 0.003));
                (LensModel::OpenCv, vec![f, f * about(1.0, 0.002), cx, cy, k1, k2, p1, p2])
            }
            Self::Fisheye => {
                let f = 0.5 * side / 50.0f64.to_radians();
                let (k1, k2) = (about(-0.02, 0.01), about(0.004, 0.002));
                (LensModel::OpenCvFisheye, vec![f, f * about(1.0, 0.002), cx, cy, k1, k2, 0.0, 0.0])
            }
        };
        ModelCamera { id: 1, model, width, height, parameters }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::math;

    #[test]
    fn every_pixel_has_a_ray_and_no_lens_folds() {
        for optics in Optics::ALL {
            assert_eq!(serde_json::to_value(optics).unwrap(), optics.name());
            if optics == Optics::Pinhole {
                continue;
            }
            for (width, height) in [(640, 360), (64, 64), (300, 200), (16, 2000), (200, 300)] {
                for seed in 0..12 {
                    let (w, h) = (width as f64, height as f64);
                    let (cx, cy) = (0.508 * w, 0.492 * h);
                    let pinhole = Intrinsics { width, height, fx: w, fy: w, cx, cy };
                    let lens = optics.camera(&pinhole, seed).lens().unwrap();
                    for i in 0..=40 {
                        let t = f64::from(i) / 40.0;
                        for (x, y) in [(t * w, 0.0), (t * w, h), (0.0, t * h), (w, t * h)] {
                            let (u, v) = lens.unproject(x, y).expect("a ray");
                            let (px, py) = lens.project(u, v);
                            assert!(math::hypot(px - x, py - y) < 1e-6, "{optics:?} {width}x{height}");
                        }
                    }
                    // Directions outside the picture never land inside it.
                    for i in 0..200 {
                        let (sin, cos) = math::sin_cos(f64::from(i) * 0.1);
                        for r in [5.0, 10.0, 1000.0] {
                            let (x, y) = lens.project(r * cos, r * sin);
                            let inside = (0.0..w).contains(&x) && (0.0..h).contains(&y);
                            assert!(!inside, "{optics:?} {width}x{height}: {x} {y}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn lenses_bend_as_much_as_real_ones() {
        let pinhole = Intrinsics { width: 600, height: 400, fx: 456.0, fy: 456.0, cx: 300.0, cy: 200.0 };
        let lens = |optics: Optics| optics.camera(&pinhole, 42).lens().unwrap();
        let corner = |optics| lens(optics).unproject(0.0, 0.0).map(|(u, v)| math::hypot(u, v)).unwrap();
        let straight = corner(Optics::Pinhole);
        assert!(corner(Optics::Radial) < 0.9 * straight, "the corner shows less");
        assert!(corner(Optics::OpenCv) > 1.1 * straight, "the corner shows more");
        let edge = |x: f64| math::atan(lens(Optics::Fisheye).unproject(x, 200.0).unwrap().0).to_degrees();
        let field = edge(600.0) - edge(0.0);
        assert!((98.0..105.0).contains(&field), "{field}");
    }
}
