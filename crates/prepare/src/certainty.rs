//! This module computes how well the images of a model determine the focal length of each camera.
//!
//! Let every keypoint be off by one pixel, independently. The least squares that placed cameras and points
//! then have the normal matrix `H = Σ JᵀJ` over all keypoints. `J` has the derivatives of a pixel by the pose
//! of its image (6), by `ln f` and two radial terms of its camera (3), and by its point (3). The points are
//! eliminated: with an orthonormal basis `Q` of what a shift of the point does to its pixels, Schur's
//! complement is `S = A − Σ Jᵀ Q Qᵀ J` with `A = Σ JᵀJ`, both by poses and lenses. The standard error of
//! `ln f` is the root of its diagonal entry in `S⁻¹`. It says by which share the focal length may be off.
//!
//! * A swim straight ahead or sideways without a turn leaves `f` free: any `f` fits, with depths to match.
//! * A model may be moved, turned and scaled without any change of pixels. A part in 10⁹ of the diagonal of
//!   `A` is added to that of `S`, so that it can be factored; `f` does not depend on this.
//! * Real errors are larger than this figure, since a lens is never the model's exactly. It ranks paths.
//!
//! Limits: of many images, 250 in a row are taken, which can only enlarge the figure. Points are evenly
//! chosen.

use std::collections::{BTreeMap, BTreeSet};

use glam::{DMat3, DVec3};
use use3d_io_colmap::{Model, ModelImage};
use use3d_numerics::cholesky::Factor;
use use3d_survey::Lens;

/// The most images that are taken.
const IMAGES: usize = 250;
/// The most pairs of keypoints of a point that are added up, over all points.
const PAIRS: usize = 500_000;
/// The fewest points from which anything is said.
const POINTS: usize = 50;
/// The parameters of an image, and those of a camera.
const POSE: usize = 6;
const LENS: usize = 3;
/// The share of the diagonal of `A` that is added.
const DAMPING: f64 = 1e-9;

/// A keypoint: the columns of its image and of its camera, and the derivatives of its pixel.
struct Sight {
    columns: [usize; POSE + LENS],
    /// By pose and lens.
    frame: [[f64; POSE + LENS]; 2],
    /// By the position of its point.
    point: [DVec3; 2],
}

/// The derivatives of the pixel of `position`: by pose (turn, then shift, in the camera's frame), `ln f`
/// and two radial terms, and by the position. `None` behind the camera.
fn derivatives(
    rotation: DMat3,
    translation: DVec3,
    lens: &Lens,
    position: DVec3,
) -> Option<([[f64; POSE + LENS]; 2], [DVec3; 2])> {
    let at = rotation * position + translation;
    if at.z <= 0.0 {
        return None;
    }
    let (u, v) = (at.x / at.z, at.y / at.z);
    let ((x, y), by_ray) = lens.project_with_jacobian(u, v);
    if !(x.is_finite() && y.is_finite() && by_ray.iter().flatten().all(|d| d.is_finite())) {
        return None;
    }
    let bent = [x - lens.principal[0], y - lens.principal[1]];
    let [u_bent, v_bent] = [0, 1].map(|i| bent[i] / lens.focal[i]);
    let r2 = u_bent * u_bent + v_bent * v_bent;
    let (mut frame, mut point) = ([[0.0; POSE + LENS]; 2], [DVec3::ZERO; 2]);
    for row in 0..2 {
        let [du, dv] = by_ray[row];
        let by_at = DVec3::new(du, dv, -(du * u + dv * v)) / at.z;
        let turn = at.cross(by_at);
        let lens = [bent[row], bent[row] * r2, bent[row] * r2 * r2];
        frame[row] = [turn.x, turn.y, turn.z, by_at.x, by_at.y, by_at.z, lens[0], lens[1], lens[2]];
        point[row] = rotation.transpose() * by_at;
    }
    Some((frame, point))
}

/// The standard error of the logarithm of each camera's focal length, by id, if every keypoint is off by one
/// pixel. Cameras without points are left out, and all of them if there are only a few points, or if the
/// system cannot be solved.
pub(crate) fn focal_errors(model: &Model) -> BTreeMap<u32, f64> {
    let lenses: Vec<(u32, Lens)> = model.cameras.iter().filter_map(|c| Some((c.id, c.lens()?))).collect();
    let mut images: Vec<&ModelImage> = model.images.iter().collect();
    images.sort_by(|a, b| a.name.cmp(&b.name));
    let spare = images.len().saturating_sub(IMAGES);
    let images = &images[spare / 2..images.len() - spare.div_ceil(2)];
    let size = POSE * images.len() + LENS * lenses.len();
    let sights = sights(model, images, &lenses);
    if sights.len() < POINTS {
        return BTreeMap::new();
    }
    let pairs: usize = sights.values().map(|s| s.len() * s.len()).sum();
    let step = pairs.div_ceil(PAIRS).max(1);
    let mut matrix = vec![0.0; size * size];
    for of_point in sights.values().step_by(step) {
        add(&mut matrix, size, of_point);
    }
    for sight in sights.values().step_by(step).flatten() {
        for (i, column) in sight.columns.iter().enumerate() {
            let [x, y] = [sight.frame[0][i], sight.frame[1][i]];
            matrix[column * size + column] += DAMPING * (x * x + y * y);
        }
    }
    // A column without a point has nothing else.
    (0..size).for_each(|i| matrix[i * size + i] += f64::MIN_POSITIVE);
    let Some(factor) = Factor::new(matrix, size) else { return BTreeMap::new() };
    let column = |camera: usize| POSE * images.len() + LENS * camera;
    let used: BTreeSet<usize> = sights.values().flatten().map(|sight| sight.columns[POSE]).collect();
    let error = |camera: usize| {
        let column = column(camera);
        let mut unit = vec![0.0; size];
        unit[column] = 1.0;
        // Each chosen point stands for `step` points.
        (factor.solve(&unit)[column] / step as f64).sqrt()
    };
    let used = (0..lenses.len()).filter(|camera| used.contains(&column(*camera)));
    used.map(|camera| (lenses[camera].0, error(camera))).collect()
}

/// The keypoints of each point that two of the images have.
fn sights(model: &Model, images: &[&ModelImage], lenses: &[(u32, Lens)]) -> BTreeMap<usize, Vec<Sight>> {
    let index: BTreeMap<u64, usize> = model.points.iter().enumerate().map(|(i, p)| (p.id, i)).collect();
    let mut found: BTreeMap<usize, Vec<Sight>> = BTreeMap::new();
    for (number, image) in images.iter().enumerate() {
        let Some(camera) = lenses.iter().position(|(id, _)| *id == image.camera) else { continue };
        let pose = image.pose();
        let first = [POSE * number, POSE * images.len() + LENS * camera];
        let columns = std::array::from_fn(|i| if i < POSE { first[0] + i } else { first[1] + i - POSE });
        for point in image.keypoints.iter().filter_map(|k| index.get(&k.point)) {
            let position = DVec3::from_array(model.points[*point].position);
            let lens = &lenses[camera].1;
            if let Some((frame, by_point)) = derivatives(pose.rotation, pose.translation, lens, position) {
                found.entry(*point).or_default().push(Sight { columns, frame, point: by_point });
            }
        }
    }
    found.retain(|_, of_point| of_point.len() > 1);
    found
}

/// An orthonormal basis of the pixels that a shift of a point can give: the columns of `Q`, by keypoint.
fn basis(sights: &[Sight]) -> Vec<[DVec3; 2]> {
    let mut q: Vec<[DVec3; 2]> = sights.iter().map(|sight| sight.point).collect();
    for k in 0..3 {
        let norm = |q: &[[DVec3; 2]]| q.iter().flatten().map(|row| row[k] * row[k]).sum::<f64>().sqrt();
        let whole = norm(&q);
        // Twice, because the first time may leave a rest of rounding errors alone.
        for before in (0..2).flat_map(|_| 0..k) {
            let along: f64 = q.iter().flatten().map(|row| row[k] * row[before]).sum();
            q.iter_mut().flatten().for_each(|row| row[k] -= along * row[before]);
        }
        let rest = norm(&q);
        let scale = if rest > 1e-12 * whole { 1.0 / rest } else { 0.0 };
        q.iter_mut().flatten().for_each(|row| row[k] *= scale);
    }
    q
}

/// Adds a point to the lower triangle of `S`: `Jᵀ (I − Q Qᵀ) J`, with `J` by poses and lenses.
fn add(matrix: &mut [f64], size: usize, sights: &[Sight]) {
    let along: Vec<[DVec3; POSE + LENS]> = sights
        .iter()
        .zip(basis(sights))
        .map(|(s, q)| std::array::from_fn(|i| q[0] * s.frame[0][i] + q[1] * s.frame[1][i]))
        .collect();
    for (s, of_s) in sights.iter().zip(&along) {
        for (i, row) in s.columns.iter().enumerate() {
            let line = &mut matrix[row * size..(row + 1) * size];
            for (j, column) in s.columns.iter().enumerate().filter(|(_, column)| *column <= row) {
                line[*column] += s.frame[0][i] * s.frame[0][j] + s.frame[1][i] * s.frame[1][j];
            }
            for (t, of_t) in sights.iter().zip(&along) {
                for (column, other) in t.columns.iter().zip(of_t).filter(|(column, _)| *column <= row) {
                    line[*column] -= of_s[i].dot(*other);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{FileName, Pose};
    use use3d_io_colmap::{Keypoint, LensModel, ModelCamera};
    use use3d_numerics::math;
    use use3d_survey::SurveyPoint;

    use super::*;

    /// A swim of eight images over 60 points, each turned by `turn` times a few degrees.
    fn swim(turn: f64) -> Model {
        let camera = ModelCamera {
            id: 4,
            model: LensModel::Radial,
            width: 320,
            height: 180,
            parameters: vec![250.0, 160.0, 90.0, 0.1, 0.02],
        };
        let wave = |i: usize, k: f64| math::sin(i as f64 * k);
        let points: Vec<SurveyPoint> = (0..60)
            .map(|i| SurveyPoint {
                id: i as u64,
                position: [4.0 * wave(i, 1.3), 1.5 * wave(i, 2.1), 6.0 + 1.2 * wave(i, 0.7)],
                color: [0; 3],
                error: 0.0,
                track: Vec::new(),
            })
            .collect();
        let keypoints: Vec<Keypoint> =
            (0..points.len()).map(|i| Keypoint { x: 0.0, y: 0.0, point: i as u64 }).collect();
        let images = (0..8usize)
            .map(|i| {
                let angles =
                    [0.2 * turn * wave(i, 2.0), 0.3 * turn * wave(i, 1.1), 0.2 * turn * wave(i, 3.0)];
                let rotation = DMat3::from_euler(glam::EulerRot::XYZ, angles[0], angles[1], angles[2]);
                let pose = Pose::from_center(rotation, DVec3::new(0.5 * i as f64 - 2.0, 0.0, 0.0));
                let name = FileName::new(&format!("{i}.png")).unwrap();
                ModelImage { keypoints: keypoints.clone(), ..ModelImage::at(i as u32, name, 4, &pose) }
            })
            .collect();
        Model { cameras: vec![camera], images, points }
    }

    #[test]
    fn derivatives_are_those_of_differences() {
        let lens = swim(1.0).cameras[0].lens().unwrap();
        let rotation = DMat3::from_euler(glam::EulerRot::XYZ, 0.1, -0.2, 0.3);
        let (translation, position) = (DVec3::new(0.2, -0.1, 0.3), DVec3::new(0.7, 0.4, 3.0));
        let (frame, point) = derivatives(rotation, translation, &lens, position).unwrap();
        let pixel = |change: [f64; 12]| {
            let c = |i: usize| DVec3::new(change[i], change[i + 1], change[i + 2]);
            let at = rotation * (position + c(9)) + translation;
            let at = at + c(0).cross(at) + c(3);
            let (x, y) = lens.project(at.x / at.z, at.y / at.z);
            let [x, y] = [x - lens.principal[0], y - lens.principal[1]];
            let [a, b] = [x / lens.focal[0], y / lens.focal[1]];
            let r2 = a * a + b * b;
            [x, y].map(|v| v * (1.0 + change[6] + change[7] * r2 + change[8] * r2 * r2))
        };
        for i in 0..12 {
            let step = |by: f64| pixel(std::array::from_fn(|k| if k == i { by } else { 0.0 }));
            let (up, down) = (step(1e-6), step(-1e-6));
            for row in 0..2 {
                let expected = (up[row] - down[row]) / 2e-6;
                let found = if i < 9 { frame[row][i] } else { point[row][i - 9] };
                assert!((found - expected).abs() < 1e-5 * (1.0 + expected.abs()), "{i}: {found} {expected}");
            }
        }
    }

    #[test]
    fn eliminating_points_gives_the_error_of_the_whole_system() {
        let model = swim(1.0);
        let images: Vec<&ModelImage> = model.images.iter().collect();
        let lenses = [(4, model.cameras[0].lens().unwrap())];
        let frames = POSE * images.len() + LENS;
        let size = frames + 3 * model.points.len();
        let mut whole = vec![0.0; size * size];
        for (point, of_point) in &sights(&model, &images, &lenses) {
            for sight in of_point {
                for row in 0..2 {
                    let own = sight.columns.iter().copied().zip(sight.frame[row]);
                    let by_point = (0..3).map(|i| (frames + 3 * point + i, sight.point[row][i]));
                    let entries: Vec<(usize, f64)> = own.chain(by_point).collect();
                    for (i, a) in &entries {
                        entries.iter().for_each(|(j, b)| whole[i * size + j] += a * b);
                    }
                }
            }
        }
        (0..size).for_each(|i| whole[i * size + i] *= 1.0 + DAMPING);
        let mut unit = vec![0.0; size];
        unit[frames - LENS] = 1.0;
        let expected = Factor::new(whole, size).unwrap().solve(&unit)[frames - LENS].sqrt();
        let found = focal_errors(&model)[&4];
        assert!((found / expected - 1.0).abs() < 1e-3, "{found} {expected}");
    }

    #[test]
    fn a_straight_swim_leaves_the_focal_length_free() {
        let [straight, hardly, turning] = [0.0, 0.02, 1.0].map(|turn| focal_errors(&swim(turn))[&4]);
        assert!(straight > 0.3, "{straight}");
        assert!(turning < 0.02 && turning < 0.2 * hardly, "{turning} {hardly}");
    }
}
