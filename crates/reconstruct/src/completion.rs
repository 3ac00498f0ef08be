//! Points where the sparse model has holes: Plenodium's point completion, once, early in a training.
//!
//! Every training view is composed at a sixteenth of its size, without water. With the depth prior `x`
//! (disparity-like, divided by its maximum), expected depth `D` and accumulation `A`:
//!
//! ```text
//! known = { A ≥ 0.999, x > ½ }      holes = { A < 0.975, x > ½ }
//! z(x) = a x + b,   the least-squares line through (x, A D) over the known pixels
//! ```
//!
//! Each pixel of a hole becomes a Gaussian at the depth `z(x)` along its ray, with the photograph's colour
//! and the initial opacity. Its size is the smaller of the mean distance to its three nearest neighbours and
//! `4 z / (f_x + f_y)`. Fewer than [`FEWEST`] new points are none. A pixel whose prior is unknown, that does
//! not count, or whose depth comes out below the near plane makes no point.

use use3d_capture::{Camera, Lattice};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_numerics::spherical_harmonics::C0;
use use3d_splat::{Colors, Gaussians, NEAR, Options, Prepared, Rasterizer, Rendered};

use crate::initialise::{rotation, spacing};
use crate::views::{Target, TrainingView};

/// The divisor of the views' sizes.
const DIVISOR: usize = 16;
/// Smallest number of new points.
const FEWEST: usize = 50;
/// Smallest prior of a near pixel.
const NEARBY: f64 = 0.5;
/// Accumulation of a pixel whose depth is known, and below which there is a hole.
const KNOWN: f32 = 0.999;
const HOLE: f32 = 0.975;

/// The training views of a capture with priors, at the size at which holes are looked for.
#[derive(Default)]
pub(crate) struct Holes(Vec<(Camera, Target)>);

/// A new point.
struct Point {
    position: glam::DVec3,
    color: [f32; 3],
    size: f64,
}

impl Holes {
    /// Stores the views that have a prior.
    pub(crate) fn new(views: &[TrainingView]) -> Self {
        let small = |view: &TrainingView| {
            let mut target = Target::default();
            (view.target(DIVISOR, &mut target), target)
        };
        Self(views.iter().filter(|view| view.prior.is_some()).map(small).collect())
    }

    /// The Gaussians that fill the holes of a scene, at most `most`; none if there are too few.
    pub(crate) fn filled(&self, scene: &Gaussians, (opacity, most, seed): (f64, usize, u64)) -> Gaussians {
        let mut out = Gaussians::empty(scene.sh_degree);
        let (mut rasterizer, mut prepared, mut rendered) =
            (Rasterizer::new(), Prepared::new(), Rendered::new());
        let mut points = Vec::new();
        for (camera, target) in &self.0 {
            prepared.prepare(scene, camera, &Lattice::full(&camera.intrinsics), Colors::Sh { degree: 0 });
            rasterizer.forward(&prepared, None, &Options::default(), &mut rendered);
            points.extend(holes(camera, target, &rendered));
        }
        points.truncate(most);
        if points.len() < FEWEST {
            return out;
        }
        let old = scene.means.iter().map(|mean| glam::Vec3::from(*mean).as_dvec3());
        let positions: Vec<glam::DVec3> = old.chain(points.iter().map(|point| point.position)).collect();
        let spacing = spacing(&positions);
        let stream = Stream::new(seed, Purpose::new("rotations of completed points"), 0);
        for (i, (point, distance)) in points.iter().zip(&spacing[scene.len()..]).enumerate() {
            let mut sh = [[0.0; 3]; 16];
            sh[0] = point.color.map(|c| (c - 0.5) / C0);
            out.means.push(point.position.as_vec3().to_array());
            out.log_scales.push([math::ln(distance.min(point.size).max(1e-9)) as f32; 3]);
            out.quaternions.push(rotation(&stream, i as u64));
            out.opacity_logits.push(crate::density::logit(opacity));
            out.sh.push(sh);
        }
        out
    }
}

/// The points of the holes of a view.
fn holes(camera: &Camera, target: &Target, rendered: &Rendered) -> Vec<Point> {
    let Some(prior) = &target.prior else { return Vec::new() };
    let nearest = f64::from(prior.data().iter().copied().fold(0.0, f32::max));
    let near = |i: usize| Some(f64::from(prior.data()[i]) / nearest).filter(|x| *x > NEARBY);
    let weight = rendered.accumulation.data();
    let line = (0..weight.len()).filter(|i| weight[*i] >= KNOWN).filter_map(|i| {
        let depth = f64::from(weight[i]) * f64::from(rendered.depth.data()[i]);
        Some((near(i)?, depth))
    });
    let Some((slope, offset)) = fitted(&line.collect::<Vec<_>>()) else { return Vec::new() };
    let (k, width) = (&camera.intrinsics, prior.width());
    let hole = |i: usize| {
        let depth = slope * near(i)? + offset;
        let (u, v) = ((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let seen = camera.ray(u, v) * depth;
        (depth > NEAR).then(|| Point {
            position: camera.pose.rotation.transpose() * (seen - camera.pose.translation),
            color: target.image.pixel(i % width, i / width),
            size: 4.0 * depth / (k.fx + k.fy),
        })
    };
    (0..weight.len()).filter(|i| weight[*i] < HOLE).filter_map(hole).collect()
}

/// Slope and offset of the least-squares line through points; `None` if their first numbers are all equal.
fn fitted(points: &[(f64, f64)]) -> Option<(f64, f64)> {
    let n = points.len() as f64;
    let mean = |of: fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>() / n;
    let (x, y) = (mean(|p| p.0), mean(|p| p.1));
    let about = |of: &dyn Fn(&(f64, f64)) -> f64| points.iter().map(of).sum::<f64>();
    let square = about(&|p| (p.0 - x) * (p.0 - x));
    let slope = about(&|p| (p.0 - x) * (p.1 - y)) / square;
    (square > 0.0).then_some((slope, y - slope * x))
}

#[cfg(test)]
mod tests {
    use use3d_capture::{Image, Intrinsics, Map, Pose};

    use super::*;
    use crate::engine::zeros;

    /// A wall at depth 2 over the left half of a view; the prior says that the right half is as near.
    fn half_a_wall() -> (Gaussians, Holes) {
        let n = 28 * 14;
        let mut wall = zeros(n, 0);
        for i in 0..n {
            let (column, row) = ((i % 14) as f32, (i / 14) as f32);
            wall.means[i] = [-1.35 + 0.1 * column, 1.35 - 0.1 * row, 2.0 + 0.01 * row];
            wall.log_scales[i] = [math::ln(0.08f32); 3];
            wall.quaternions[i] = [1.0, 0.0, 0.0, 0.0];
            wall.opacity_logits[i] = 5.0;
        }
        let intrinsics = Intrinsics { width: 24, height: 24, fx: 20.0, fy: 20.0, cx: 12.0, cy: 12.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let mut prior = Map::filled(24, 24, 1.0);
        (0..24 * 24).for_each(|i| prior.set_pixel(i % 24, i / 24, [1.0 - 0.01 * (i / 24) as f32]));
        let image = Image::new(24, 24).map(|_| 0.75);
        (wall, Holes(vec![(camera, Target { image, mask: None, prior: Some(prior) })]))
    }

    #[test]
    fn holes_are_filled_at_the_depth_of_the_line_and_nothing_else_is() {
        let (wall, views) = half_a_wall();
        let new = views.filled(&wall, (0.1, 10_000, 1));
        assert!((200..340).contains(&new.len()), "{}", new.len());
        assert_eq!(new.validate(), Ok(()));
        for i in 0..new.len() {
            let [x, y, z] = new.means[i];
            assert!(x > -0.05, "the wall is no hole: {x}");
            // The wall is deeper towards the top, where the prior is larger.
            assert!((z - 2.11).abs() < 0.2 && y.abs() < 1.4, "{z}");
            assert!((f64::from(new.sh[i][0][0] * C0) - 0.25).abs() < 1e-6);
            assert!(new.log_scales[i][0] <= math::ln(4.0 * z / 40.0) + 1e-5);
            assert!((new.opacity_logits[i] - crate::density::logit(0.1)).abs() < 1e-6);
        }
        assert_eq!(views.filled(&wall, (0.1, 60, 1)).len(), 60);
        assert!(views.filled(&wall, (0.1, 49, 1)).is_empty(), "a few points are none");
        assert!(Holes::default().filled(&wall, (0.1, 1000, 1)).is_empty());
    }

    #[test]
    fn the_line_is_the_one_of_least_squares() {
        let (slope, offset) = fitted(&[(0.0, 1.0), (1.0, 2.0), (2.0, 6.0)]).unwrap();
        assert!((slope - 2.5).abs() < 1e-12 && (offset - 0.5).abs() < 1e-12);
        assert_eq!(fitted(&[(1.0, 1.0), (1.0, 2.0)]), None);
        assert_eq!(fitted(&[]), None);
    }
}
