//! The photographs' evidence about each Gaussian: in which directions they saw it, and how far away it was.
//!
//! A photograph sees a Gaussian whose weights in it, summed over a small picture, reach [`SEEN`]. With unit
//! directions `d_v` from these cameras to the Gaussian and distances `s_v`, a Gaussian has
//!
//! ```text
//! m = Σ d_v / |Σ d_v|      θ = max_v ∠(m, d_v) + 0.4 min(1, (n − 1) / 6)      s = 1.1 max_v s_v
//! ```
//!
//! where `n` photographs saw it: more of them say more about its other sides. The page lets a Gaussian fade
//! in directions outside the cone `(m, θ)`, where needles and floating pieces would show, and in front of it
//! draws no more water than that of the distance `s`. A Gaussian is *loose* if two photographs or fewer saw
//! it, or if no photograph saw one of its ends; the page lets it fade beyond the distance as well. So the
//! pictures at the photographs' places stay as they are.

use glam::{DQuat, DVec3};
use rayon::prelude::*;
use use3d_capture::{Camera, Lattice};
use use3d_numerics::math;
use use3d_scene::Scene;
use use3d_splat::{Gaussians, Prepared, Rasterizer};

/// Longest side of the pictures, pixels.
const SIDE: f64 = 320.0;
/// Sum of weights from which on a Gaussian counts as seen, pixels.
const SEEN: f32 = 0.05;
/// Fewest photographs that say anything about all others.
const FEWEST: usize = 3;
/// Most photographs that are drawn: one bit each.
const MOST: usize = 128;
/// The cone of a Gaussian is wider by this angle, radians, if `MANY` photographs and one saw it.
const WIDER: f64 = 0.4;
const MANY: f64 = 6.0;
/// Number of photographs up to which a Gaussian is loose, and its mark in the byte of the angle.
const FEW: u32 = 2;
const LOOSE: u8 = 128;
/// A distance has the byte `round(18 (ln s + 7))`, at least 1; 0 is a Gaussian that no photograph saw.
const FAR: [f64; 2] = [18.0, 7.0];
/// The distance may be larger at the edge of a Gaussian than at its centre.
const SLACK: f64 = 1.1;

/// The evidence about all Gaussians of a scene.
pub(crate) struct Evidence {
    /// Direction (octahedral, two bytes), half angle of the cone in steps of π/127 with 128 for a loose one,
    /// distance.
    pub(crate) bytes: Vec<[u8; 4]>,
    /// Sums of the weights in all photographs.
    pub(crate) weights: Vec<f32>,
}

impl Evidence {
    /// The evidence of photographs by these cameras; `None` for too few.
    pub(crate) fn of(scene: &Scene, cameras: &[Camera]) -> Option<Self> {
        if cameras.len() < FEWEST {
            return None;
        }
        let chosen: Vec<&Camera> = cameras.iter().step_by(cameras.len().div_ceil(MOST)).collect();
        let n = scene.gaussians.len();
        let (mut weights, mut seen) = (vec![0.0f32; n], vec![0u128; n]);
        let (mut prepared, mut rasterizer) = (Prepared::new(), Rasterizer::new());
        let (mut colors, mut sums) = (Vec::new(), vec![0.0; n]);
        for (v, camera) in chosen.iter().enumerate() {
            let k = &camera.intrinsics;
            let factor = (SIDE / k.width.max(k.height) as f64).min(1.0);
            let side = |pixels: usize| ((pixels as f64 * factor).round() as usize).max(1);
            let (width, height) = (side(k.width), side(k.height));
            let (sx, sy) = (width as f64 / k.width as f64, height as f64 / k.height as f64);
            let small = Camera { intrinsics: k.scaled(sx, sy, width, height), pose: camera.pose };
            let lattice = Lattice::full(&small.intrinsics);
            scene.project(&small, &lattice, |_| (), &mut colors, &mut prepared);
            rasterizer.splat_adjoint(&prepared, 1, &vec![1.0; width * height], &mut sums);
            for ((sum, weight), seen) in sums.iter().zip(&mut weights).zip(&mut seen) {
                *weight += sum;
                *seen |= u128::from(*sum >= SEEN) << v;
            }
        }
        let eyes: Vec<DVec3> = chosen.iter().map(|camera| camera.pose.center()).collect();
        let all = chosen.len() == cameras.len();
        let of_one = |(i, (mean, seen)): (usize, (&[f32; 3], &u128))| {
            let (mean, seen) = (DVec3::from_array(mean.map(f64::from)), *seen);
            let rays =
                eyes.iter().enumerate().filter(|(v, _)| seen >> v & 1 == 1).map(|(_, eye)| mean - *eye);
            match (of_rays(&rays.collect::<Vec<_>>()), all) {
                (Some(mut bytes), _) => {
                    let ends = ends(&scene.gaussians, i);
                    let inside = |end: &DVec3| chosen.iter().any(|camera| is_inside(camera, *end));
                    if seen.count_ones() <= FEW || !ends.iter().all(inside) {
                        bytes[2] |= LOOSE;
                    }
                    bytes
                }
                (None, true) => [0; 4],
                // Another photograph may have seen it.
                (None, false) => [0, 0, 127, 255],
            }
        };
        let bytes = scene.gaussians.means.par_iter().zip(&seen).enumerate().map(of_one).collect();
        Some(Self { bytes, weights })
    }
}

/// The ends of a Gaussian: two standard deviations from its centre along its longest axis.
fn ends(gaussians: &Gaussians, i: usize) -> [DVec3; 2] {
    let [w, x, y, z] = gaussians.quaternions[i].map(f64::from);
    let sizes = gaussians.log_scales[i].map(|log| math::exp(f64::from(log)));
    let longest = (0..3).fold(0, |best, k| if sizes[k] > sizes[best] { k } else { best });
    let axis = DQuat::from_xyzw(x, y, z, w).normalize() * DVec3::AXES[longest];
    let mean = DVec3::from_array(gaussians.means[i].map(f64::from));
    [mean - 2.0 * sizes[longest] * axis, mean + 2.0 * sizes[longest] * axis]
}

/// True if a point is in the picture of a camera.
fn is_inside(camera: &Camera, point: DVec3) -> bool {
    let k = &camera.intrinsics;
    camera.project(point).is_some_and(|(pixel, _)| {
        (0.0..k.width as f64).contains(&pixel.x) && (0.0..k.height as f64).contains(&pixel.y)
    })
}

/// The bytes of a Gaussian that photographs saw along these rays; `None` without one.
fn of_rays(rays: &[DVec3]) -> Option<[u8; 4]> {
    let farthest = rays.iter().map(|ray| ray.length()).reduce(f64::max)?;
    let units: Vec<DVec3> = rays.iter().map(|ray| ray.normalize_or_zero()).collect();
    let mean = units.iter().sum::<DVec3>().normalize_or(DVec3::Z);
    let more = WIDER * (((rays.len() - 1) as f64) / MANY).min(1.0);
    let angle = more + math::acos(units.iter().map(|unit| mean.dot(*unit)).fold(1.0, f64::min).max(-1.0));
    // Octahedral: the point of |x| + |y| + |z| = 1, with the lower half folded outwards.
    let p = mean / (mean.x.abs() + mean.y.abs() + mean.z.abs());
    let fold =
        |u: f64, v: f64| if p.z < 0.0 { (1.0 - v.abs()) * if u < 0.0 { -1.0 } else { 1.0 } } else { u };
    let byte = |v: f64| (127.5 * (v + 1.0)).round() as u8;
    let far = (FAR[0] * (math::ln(SLACK * farthest) + FAR[1])).round().clamp(1.0, 255.0);
    Some([
        byte(fold(p.x, p.y)),
        byte(fold(p.y, p.x)),
        (angle / std::f64::consts::PI * 127.0).ceil().min(127.0) as u8,
        far as u8,
    ])
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Frame, Intrinsics, Pose};
    use use3d_medium::MediumModel;

    #[test]
    fn a_gaussian_knows_from_where_it_was_seen_and_one_behind_is_unknown() {
        let mut sh = [[0.0; 3]; 16];
        sh[0] = [1.0; 3];
        let scene = Scene {
            gaussians: Gaussians {
                sh_degree: 0,
                // The second is behind all cameras.
                means: vec![[0.0; 3], [0.0, 0.0, -9.0]],
                log_scales: vec![[-1.5; 3]; 2],
                quaternions: vec![[1.0, 0.0, 0.0, 0.0]; 2],
                opacity_logits: vec![3.0; 2],
                sh: vec![sh; 2],
            },
            frame: Frame::IDENTITY,
            medium: MediumModel::None,
            medium_degree: 0,
            enhancement: None,
        };
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0 };
        let cameras: Vec<Camera> = [-1.0, 0.0, 1.0]
            .iter()
            .map(|x| Camera {
                intrinsics,
                pose: Pose::look_at(DVec3::new(*x, 0.0, -4.0), DVec3::ZERO, DVec3::Y),
            })
            .collect();
        assert!(Evidence::of(&scene, &cameras[..2]).is_none(), "two photographs say little");
        let evidence = Evidence::of(&scene, &cameras).expect("three photographs");
        let [x, y, angle, far] = evidence.bytes[0];
        // Along z, with the cone of atan(1/4), wider by a third of 0.4, and 1.1 times the farthest distance.
        assert_eq!((x, y), (128, 128));
        assert!((f64::from(angle) / 127.0 * std::f64::consts::PI - 0.378).abs() < 0.026, "{angle}");
        let far = math::exp(f64::from(far) / FAR[0] - FAR[1]);
        assert!((far / (1.1 * 17.0f64.sqrt()) - 1.0).abs() < 0.03, "{far}");
        assert_eq!(evidence.bytes[1], [0; 4]);
        assert!(evidence.weights[0] > 10.0 && evidence.weights[1] == 0.0);
        // With two photographs, or with an end out of every picture, it is loose.
        let mut long = scene.gaussians.clone();
        long.log_scales[0][0] = 1.0;
        let scene = Scene { gaussians: long, ..scene };
        let evidence = Evidence::of(&scene, &cameras).expect("three photographs");
        assert!(evidence.bytes[0][2] >= LOOSE && angle < LOOSE);
        // Straight away from the z axis: the lower half of the octahedron.
        assert_eq!(of_rays(&[DVec3::NEG_Z]).expect("a ray")[..2], [255, 255]);
        assert_eq!(of_rays(&[]), None);
    }
}
