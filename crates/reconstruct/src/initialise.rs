//! The Gaussians from which training starts.
//!
//! There is one Gaussian per sparse point: its colour as the constant coefficient, an isotropic size equal
//! to the mean distance to its three nearest other points, a uniformly random rotation, and the opacity of
//! the settings. Equal points count as one neighbour, so that a heap of duplicates does not make Gaussians of
//! size zero.
//! A capture with fewer than 100 points gets random ones in the space that its cameras see. If there are
//! more points than Gaussians allowed, a random choice of them is kept.

use glam::DVec3;
use kdtree::KdTree;
use kdtree::distance::squared_euclidean;
use rayon::prelude::*;
use use3d_capture::{Camera, Capture};
use use3d_numerics::math;
use use3d_numerics::order::Ascending;
use use3d_numerics::random::{Purpose, Stream};
use use3d_numerics::spherical_harmonics::C0;
use use3d_splat::{Gaussians, NEAR};

use crate::{FoundWater, ReconstructError, ReconstructParams};

/// Smallest number of sparse points that is enough for a start.
pub(crate) const FEWEST_POINTS: usize = 100;
const NEIGHBOURS: usize = 3;
/// Sizes are clamped to this range, normalised scene units.
const SMALLEST: f64 = 1e-5;
const LARGEST: f64 = 2.0;

/// Makes the initial Gaussians, at most `most`. They have the colours behind the water where these are
/// known. Messages for the user go to `notice`.
pub(crate) fn gaussians(
    capture: &Capture,
    found: Option<&FoundWater>,
    params: &ReconstructParams,
    most: usize,
    mut notice: impl FnMut(&str),
) -> Result<Gaussians, ReconstructError> {
    let cameras: Vec<Camera> = capture.training_views().map(|v| v.camera).collect();
    let finite = capture.points.iter().enumerate().filter(|(_, p)| p.position.is_finite());
    let color = |i: usize, seen: [f64; 3]| found.map_or(seen, |found| found.color(i, seen));
    let mut points: Vec<(DVec3, [f64; 3])> =
        finite.map(|(i, p)| (p.position, color(i, p.color.map(|c| f64::from(c) / 255.0)))).collect();
    if points.len() < capture.points.len() {
        notice(&format!(
            "{} sparse points are not finite and are left out",
            capture.points.len() - points.len()
        ));
    }
    let in_front = |p: &DVec3| cameras.iter().any(|c| c.project(*p).is_some_and(|(_, z)| z > NEAR));
    if !points.is_empty() && !points.par_iter().any(|(p, _)| in_front(p)) {
        return Err(ReconstructError::PointsBehindCameras { points: points.len(), views: cameras.len() });
    }
    if points.len() > most {
        notice(&format!(
            "{most} of {} sparse points are kept, chosen at random: a scene begins with at most its cap of Gaussians (`max_gaussians`)",
            points.len()
        ));
        points = choose(&points, most, params.seed);
    }
    if points.len() < FEWEST_POINTS.min(most) {
        let added = random_points(&cameras, &points, params, most - points.len());
        notice(&format!(
            "the capture has only {} sparse points; {} random ones are added where the cameras look \
             (`random_points`)",
            points.len(),
            added.len()
        ));
        points.extend(added);
    }
    let positions: Vec<DVec3> = points.iter().map(|p| p.0).collect();
    let spacing = spacing(&positions);
    let stream = Stream::new(params.seed, Purpose::new("initial rotations"), 0);
    let mut gaussians = Gaussians::empty(params.sh_degree);
    let logit = crate::density::logit(params.initial_opacity);
    for (i, ((position, color), spacing)) in points.iter().zip(&spacing).enumerate() {
        let mut sh = [[0.0; 3]; 16];
        sh[0] = color.map(|c| ((c - 0.5) / f64::from(C0)) as f32);
        gaussians.means.push(position.as_vec3().to_array());
        gaussians.log_scales.push([math::ln(spacing.clamp(SMALLEST, LARGEST)) as f32; 3]);
        gaussians.quaternions.push(rotation(&stream, i as u64));
        gaussians.opacity_logits.push(logit);
        gaussians.sh.push(sh);
    }
    Ok(gaussians)
}

/// Chooses `most` of the points and keeps their order. Any part of a file may belong to one part of the
/// scene, so the choice is random and not every n-th point.
fn choose<T: Copy>(points: &[T], most: usize, seed: u64) -> Vec<T> {
    let stream = Stream::new(seed, Purpose::new("points kept"), 0);
    let mut kept = stream.permutation(points.len());
    kept.truncate(most);
    kept.sort_unstable();
    kept.into_iter().map(|i| points[i]).collect()
}

/// A uniformly random unit quaternion: four normals over their length.
pub(crate) fn rotation(stream: &Stream, index: u64) -> [f32; 4] {
    let q: [f64; 4] = std::array::from_fn(|k| stream.normal(4 * index + k as u64));
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-12);
    q.map(|v| (v / norm) as f32)
}

/// Random positions on random pixel rays, grey, at most `most`. Their depths are spread log-uniformly
/// around those of the known points (or around the size of the normalised scene).
fn random_points(
    cameras: &[Camera],
    known: &[(DVec3, [f64; 3])],
    params: &ReconstructParams,
    most: usize,
) -> Vec<(DVec3, [f64; 3])> {
    let stream = Stream::new(params.seed, Purpose::new("random points"), 0);
    let depths = known.iter().flat_map(|(p, _)| cameras.iter().filter_map(|c| c.project(*p).map(|(_, z)| z)));
    let depths = Ascending::of(depths.filter(|z| *z > NEAR));
    let (near, far) = match (depths.at(0.05), depths.at(0.95)) {
        (Some(near), Some(far)) => (0.7 * near, 1.4 * far),
        _ => (0.2, 4.0),
    };
    (0..params.random_points.min(most))
        .map(|i| {
            let draw = |k: u64| stream.uniform(4 * i as u64 + k);
            let camera = &cameras[((draw(0) * cameras.len() as f64) as usize).min(cameras.len() - 1)];
            let k = &camera.intrinsics;
            let depth = near * math::powf(far / near, draw(3));
            let in_camera = camera.ray(draw(1) * k.width as f64, draw(2) * k.height as f64) * depth;
            (camera.pose.rotation.transpose() * (in_camera - camera.pose.translation), [0.5; 3])
        })
        .collect()
}

/// For every point, the mean distance to its three nearest points at other positions.
pub(crate) fn spacing(points: &[DVec3]) -> Vec<f64> {
    // Equal positions count once.
    let mut order: Vec<usize> = (0..points.len()).collect();
    let key = |i: usize| points[i].to_array().map(|v| v + 0.0);
    order.sort_by(|&a, &b| {
        let (a, b) = (key(a), key(b));
        a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])).then(a[2].total_cmp(&b[2]))
    });
    let mut places: Vec<[f64; 3]> = Vec::new();
    let mut place_of = vec![0; points.len()];
    for i in order {
        if places.last() != Some(&key(i)) {
            places.push(key(i));
        }
        place_of[i] = places.len() - 1;
    }
    let by_place = place_spacing(&places);
    place_of.into_iter().map(|p| by_place[p]).collect()
}

/// The mean distance of each of several different places to the three nearest others.
fn place_spacing(places: &[[f64; 3]]) -> Vec<f64> {
    let lone = 0.1;
    let mut tree = KdTree::with_capacity(3, 32);
    // A tree that grows by places in a random order is shallow; the order changes no distance.
    for i in Stream::new(0, Purpose::new("order of places"), 0).permutation(places.len()) {
        // The tree refuses only a place that is not finite. All places here are finite.
        tree.add(places[i], ()).ok();
    }
    let spacing = |place: &[f64; 3]| {
        let nearest = tree.nearest(place, NEIGHBOURS + 1, &squared_euclidean).unwrap_or_default();
        // The nearest is the place itself.
        let others = nearest.get(1..).unwrap_or_default();
        let sum: f64 = others.iter().map(|(d, ())| d.sqrt()).sum();
        if others.is_empty() { lone } else { sum / others.len() as f64 }
    };
    places.par_iter().map(spacing).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spacing_is_the_mean_distance_to_three_neighbours() {
        let stream = Stream::new(1, Purpose::new("spacing"), 0);
        let points: Vec<DVec3> = (0..400u64)
            .map(|i| DVec3::new(stream.normal(3 * i), stream.normal(3 * i + 1), stream.normal(3 * i + 2)))
            .collect();
        let fast = spacing(&points);
        for (i, p) in points.iter().enumerate().step_by(17) {
            let mut d: Vec<f64> = points.iter().map(|q| p.distance(*q)).collect();
            d.sort_unstable_by(f64::total_cmp);
            assert!((fast[i] - (d[1] + d[2] + d[3]) / 3.0).abs() < 1e-9);
        }
    }

    #[test]
    fn heaps_lines_and_planes_of_points_get_a_size() {
        let heap = vec![DVec3::ONE; 5000];
        assert!(spacing(&heap).iter().all(|s| *s == 0.1));
        let line: Vec<DVec3> = (0..3000).map(|i| DVec3::new(0.5, 0.5, f64::from(i / 3))).collect();
        assert!(spacing(&line).iter().all(|s| (1.0..=2.0).contains(s)));
        let mut plane: Vec<DVec3> =
            (0..2500).map(|i| DVec3::new(f64::from(i % 50), 3.0, f64::from(i / 50))).collect();
        plane.extend(vec![DVec3::new(7.0, 3.0, 7.0); 2000]);
        assert!(spacing(&plane).iter().all(|s| (1.0..1.5).contains(s)));
        assert_eq!(spacing(&[DVec3::ZERO, DVec3::X]), [1.0, 1.0]);
    }
}
