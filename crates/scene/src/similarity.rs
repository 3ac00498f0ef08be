//! Transforms Gaussians to another frame: positions, sizes, orientations and the directions of their colours.
//!
//! Under `x' = s (R x) + t` a mean moves, a standard deviation scales by `s`, an orientation rotates by `R`,
//! and a colour seen along `ω` is seen along `Rω`. For the last, the spherical harmonics must be rotated: per
//! band, coefficients become `c'_i = Σ_j ⟨Y_i(R ·), Y_j⟩ c_j`. The inner products are exact: the integrands
//! are polynomials of degree at most six, and four Gauss–Legendre heights times eight longitudes integrate
//! degree seven exactly.

use glam::{DMat3, DQuat, DVec3};
use use3d_capture::Frame;
use use3d_numerics::math;
use use3d_numerics::spherical_harmonics::basis;
use use3d_splat::Gaussians;

/// Heights and weights of four-point Gauss–Legendre quadrature on `[-1, 1]`.
const HEIGHTS: [(f64, f64); 4] = [
    (-0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
    (-0.339_981_043_584_856_26, 0.652_145_154_862_546_2),
    (0.339_981_043_584_856_26, 0.652_145_154_862_546_2),
    (0.861_136_311_594_052_6, 0.347_854_845_137_453_85),
];
const LONGITUDES: usize = 8;

/// `m[i][j] = ⟨Y_i(R ω), Y_j(ω)⟩`: maps coefficients in the old frame to those in the rotated one.
fn turn_bands(rotation: DMat3) -> [[f64; 16]; 16] {
    let mut m = [[0.0; 16]; 16];
    let value = |d: DVec3| basis(3, [d.x as f32, d.y as f32, d.z as f32]);
    for (z, weight) in HEIGHTS {
        let r = (1.0 - z * z).sqrt();
        for k in 0..LONGITUDES {
            let phi = std::f64::consts::TAU * (k as f64 + 0.5) / LONGITUDES as f64;
            let direction = DVec3::new(r * math::cos(phi), r * math::sin(phi), z);
            let (old, new) = (value(direction), value(rotation * direction));
            let area = weight * std::f64::consts::TAU / LONGITUDES as f64;
            for (row, &n) in m.iter_mut().zip(&new) {
                for (cell, &o) in row.iter_mut().zip(&old) {
                    *cell += area * f64::from(n) * f64::from(o);
                }
            }
        }
    }
    m
}

/// `gaussians` transformed by `frame`: from COLMAP's frame to the normalised one.
pub fn apply(gaussians: &Gaussians, frame: &Frame) -> Gaussians {
    transform(gaussians, frame.scale, frame.rotation, |x| frame.apply(x))
}

/// `gaussians` transformed by the inverse of `frame`: back to COLMAP's frame.
pub fn invert(gaussians: &Gaussians, frame: &Frame) -> Gaussians {
    transform(gaussians, 1.0 / frame.scale, frame.rotation.transpose(), |x| frame.invert(x))
}

fn transform(
    gaussians: &Gaussians,
    scale: f64,
    rotation: DMat3,
    point: impl Fn(DVec3) -> DVec3,
) -> Gaussians {
    let turn = DQuat::from_mat3(&rotation);
    let bands = turn_bands(rotation);
    let log_scale = math::ln(scale);
    let mut out = gaussians.clone();
    for mean in &mut out.means {
        let moved = point(DVec3::new(mean[0].into(), mean[1].into(), mean[2].into()));
        *mean = [moved.x as f32, moved.y as f32, moved.z as f32];
    }
    for sizes in &mut out.log_scales {
        *sizes = sizes.map(|v| (f64::from(v) + log_scale) as f32);
    }
    for q in &mut out.quaternions {
        // No normalisation is needed: the product keeps the norm.
        let turned = turn * DQuat::from_xyzw(q[1].into(), q[2].into(), q[3].into(), q[0].into());
        *q = [turned.w as f32, turned.x as f32, turned.y as f32, turned.z as f32];
    }
    for sh in &mut out.sh {
        let old = *sh;
        for i in 1..16 {
            // Bands of different degree do not mix: rows 1..4, 4..9, 9..16.
            let degree = [1, 4, 9, 16].iter().position(|&end| i < end).unwrap_or(3);
            let range = degree * degree..(degree + 1) * (degree + 1);
            sh[i] = std::array::from_fn(|c| {
                range.clone().map(|j| bands[i][j] * f64::from(old[j][c])).sum::<f64>() as f32
            });
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Camera, Intrinsics, Lattice, Pose};
    use use3d_splat::{Colors, Options, Prepared, Rasterizer, Rendered};

    fn render(gaussians: &Gaussians, pose: Pose) -> use3d_capture::Image {
        let intrinsics = Intrinsics { width: 40, height: 30, fx: 40.0, fy: 38.0, cx: 20.0, cy: 15.0 };
        let camera = Camera { intrinsics, pose };
        let mut prepared = Prepared::new();
        prepared.prepare(gaussians, &camera, &Lattice::full(&intrinsics), Colors::Sh { degree: 3 });
        let mut out = Rendered::new();
        Rasterizer::new().forward(&prepared, None, &Options::default(), &mut out);
        out.image
    }

    #[test]
    fn a_moved_scene_seen_by_a_moved_camera_is_the_same_picture() {
        let draw =
            use3d_numerics::random::Stream::new(5, use3d_numerics::random::Purpose::new("similarity"), 0);
        let mut next = (0u64..).map(|i| draw.normal(i) as f32);
        let mut take = || next.next().unwrap();
        let n = 30;
        let gaussians = Gaussians {
            sh_degree: 3,
            means: (0..n).map(|_| [take() * 0.6, take() * 0.5, 3.0 + take() * 0.4]).collect(),
            log_scales: (0..n).map(|_| [-1.8 + 0.3 * take(), -1.8, -2.2]).collect(),
            quaternions: (0..n).map(|_| [take(), take(), take(), take()]).collect(),
            opacity_logits: (0..n).map(|_| take()).collect(),
            sh: (0..n).map(|_| std::array::from_fn(|_| [0.2 * take(), 0.2 * take(), 0.2 * take()])).collect(),
        };
        let frame = Frame {
            scale: 0.4,
            rotation: DMat3::from_axis_angle(DVec3::new(0.48, -0.6, 0.64).normalize(), 1.1),
            translation: DVec3::new(0.3, -0.2, 0.9),
        };
        let pose =
            Pose::look_at(DVec3::new(0.2, 0.1, 0.0), DVec3::new(0.0, 0.0, 3.0), DVec3::new(0.1, -1.0, 0.0));
        let here = render(&gaussians, pose);
        let there = render(&apply(&gaussians, &frame), frame.apply_pose(&pose));
        let back = render(&invert(&apply(&gaussians, &frame), &frame), pose);
        let worst = |a: &use3d_capture::Image, b: &use3d_capture::Image| {
            a.data().iter().zip(b.data()).map(|(x, y)| (x - y).abs()).fold(0.0f32, f32::max)
        };
        assert!(here.data().iter().any(|v| *v > 0.3), "the picture shows something");
        assert!(
            worst(&here, &there) < 4e-3 && worst(&here, &back) < 4e-3,
            "{} {}",
            worst(&here, &there),
            worst(&here, &back)
        );
    }
}
