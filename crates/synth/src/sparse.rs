//! Sparse points like those that structure from motion finds: corners seen in several views, with noise,
//! tracks and outliers.
//!
//! Candidates are pixels of strong local contrast. Each is followed through the other views. It is detected
//! in a view if it is inside the picture, not hidden, near enough to stand out from the water, and if a
//! random draw succeeds. A detection has an error of a fraction of a pixel. The triangulated position has an
//! error along the ray of about `σ_px z² / (f b)`, with b the baseline of the track, and sideways of `σ_px z
//! / f`. A small share of the points are mismatches: two detections that agree on a wrong position.

use glam::{DVec2, DVec3};
use use3d_capture::{Camera, FileName, Frame, Image8, Map};
use use3d_io_colmap::{Keypoint, Model, ModelCamera, ModelImage, ModelPoint};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_survey::Lens;

use crate::render::depth_at;
use crate::scene::MeshScene;

/// Standard deviation of a detection, pixels per axis.
pub(crate) const DETECTION: f64 = 0.4;
/// Share of points that are mismatches.
const MISMATCHED: f64 = 0.012;
/// No feature is matched beyond this distance, metres.
const REACH: f32 = 11.0;
/// Shortest track that is kept.
const SHORTEST: usize = 3;

/// A corner in one view.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Corner {
    u: f64,
    v: f64,
    depth: f64,
    color: [u8; 3],
}

/// Picks corners of a view: random pixels, kept by their contrast.
pub(crate) fn corners(image: &Image8, depth: &Map, seed: u64, view: usize, wanted: usize) -> Vec<Corner> {
    let stream = Stream::new(seed, Purpose::new("corners"), view as u64);
    let (w, h) = (image.width(), image.height());
    let mut found = Vec::new();
    if w < 3 || h < 3 {
        return found;
    }
    for i in 0..(40 * wanted) as u64 {
        if found.len() >= wanted {
            break;
        }
        let (x, y) = (1 + stream.below(3 * i, w - 2), 1 + stream.below(3 * i + 1, h - 2));
        let z = depth.pixel(x, y)[0];
        if z <= 0.0 || z > REACH {
            continue;
        }
        let luminance = |x: usize, y: usize| {
            let [r, g, b] = image.pixel(x, y).map(f64::from);
            0.299 * r + 0.587 * g + 0.114 * b
        };
        let (gx, gy) = (luminance(x + 1, y) - luminance(x - 1, y), luminance(x, y + 1) - luminance(x, y - 1));
        if stream.uniform(3 * i + 2) < math::powi(math::hypot(gx, gy) / 50.0, 2) {
            let (u, v) = (x as f64 + 0.5, y as f64 + 0.5);
            found.push(Corner { u, v, depth: f64::from(z), color: image.pixel(x, y) });
        }
    }
    found
}

/// The cameras of a swim in its scene.
#[derive(Clone, Copy)]
pub(crate) struct Swimmer<'a> {
    pub(crate) scene: &'a MeshScene,
    /// In metres.
    pub(crate) cameras: &'a [Camera],
    /// The lens, if it is no pinhole.
    pub(crate) lens: Option<&'a Lens>,
}

impl Swimmer<'_> {
    /// The ray of a pixel in its camera's frame, with unit depth.
    fn ray(&self, camera: &Camera, u: f64, v: f64) -> Option<DVec3> {
        match self.lens {
            None => Some(camera.ray(u, v)),
            Some(lens) => lens.unproject(u, v).map(|(x, y)| DVec3::new(x, y, 1.0)),
        }
    }

    /// The pixel and the depth of a point; `None` at or behind the camera.
    fn project(&self, camera: &Camera, point: DVec3) -> Option<(DVec2, f64)> {
        let (pixel, z) = camera.project(point)?;
        let bent = self.lens.map(|lens| {
            let at = camera.pose.rotation * point + camera.pose.translation;
            DVec2::from(lens.project(at.x / at.z, at.y / at.z))
        });
        Some((bent.unwrap_or(pixel), z))
    }
}

/// The COLMAP model of the capture, whose camera is `camera`. `frame` converts cameras and points to COLMAP's
/// frame.
pub(crate) fn model(
    swimmer: &Swimmer<'_>,
    camera: &ModelCamera,
    names: &[FileName],
    frame: &Frame,
    corners: &[Vec<Corner>],
    seed: u64,
) -> Model {
    let mut model = Model { cameras: vec![camera.clone()], ..Model::default() };
    for (i, (camera, name)) in swimmer.cameras.iter().zip(names).enumerate() {
        model.images.push(ModelImage::at(i as u32 + 1, name.clone(), 1, &frame.apply_pose(&camera.pose)));
    }
    for (home, list) in corners.iter().enumerate() {
        for (number, corner) in list.iter().enumerate() {
            let stream = Stream::new(seed, Purpose::new("track"), ((home as u64) << 32) | number as u64);
            if let Some(point) = track(swimmer, home, corner, &stream) {
                add(&mut model, swimmer, frame, corner.color, &point);
            }
        }
    }
    model
}

struct Tracked {
    /// The triangulated position, in metres.
    position: DVec3,
    detections: Vec<(usize, f64, f64)>,
}

fn track(swimmer: &Swimmer<'_>, home: usize, corner: &Corner, stream: &Stream) -> Option<Tracked> {
    let cameras = swimmer.cameras;
    let camera = &cameras[home];
    let exact = camera.pose.center()
        + camera.pose.rotation.transpose() * (corner.depth * swimmer.ray(camera, corner.u, corner.v)?);
    let mismatch = stream.uniform(0) < MISMATCHED;
    let mut detections = Vec::new();
    for (i, other) in cameras.iter().enumerate() {
        let draw = 8 + 8 * i as u64;
        let Some((pixel, z)) = swimmer.project(other, exact) else { continue };
        let (w, h) = (other.intrinsics.width as f64, other.intrinsics.height as f64);
        let inside = pixel.x > 1.0 && pixel.y > 1.0 && pixel.x < w - 1.0 && pixel.y < h - 1.0;
        // Detectors lose features with distance in water, and with changes of scale and angle.
        let change = math::ln(z / corner.depth).abs() + 0.35 * (i.abs_diff(home) as f64 / 6.0);
        let chance = 0.9 * math::exp(-1.2 * change) * (1.0 - z / (1.3 * f64::from(REACH))).max(0.0);
        let detected = i == home || stream.uniform(draw) < chance;
        let enough = mismatch && detections.len() >= 2;
        if !inside || !detected || enough {
            continue;
        }
        let seen = depth_at(swimmer.scene, other, swimmer.lens, (pixel.x, pixel.y));
        if seen.is_some_and(|seen| (f64::from(seen) / z - 1.0).abs() < 0.02) {
            let off = |k: u64| DETECTION * stream.normal(draw + 1 + k);
            detections.push((i, pixel.x + off(0), pixel.y + off(1)));
        }
    }
    let shortest = if mismatch { 2 } else { SHORTEST };
    if detections.len() < shortest {
        return None;
    }
    let along = (exact - camera.pose.center()).normalize();
    let position = if mismatch {
        let stretch = 0.35 + 1.3 * stream.uniform(1);
        let wrong = camera.pose.center() + stretch * (exact - camera.pose.center());
        // The detections agree with the wrong position, because otherwise it would not have been
        // triangulated.
        for (i, x, y) in &mut detections {
            let (pixel, _) = swimmer.project(&cameras[*i], wrong)?;
            let off = |k: u64| DETECTION * stream.normal(4_000_000 + 2 * *i as u64 + k);
            (*x, *y) = (pixel.x + off(0), pixel.y + off(1));
        }
        wrong
    } else {
        let baseline = detections
            .iter()
            .map(|&(i, ..)| cameras[i].pose.center().distance(camera.pose.center()))
            .fold(0.05, f64::max);
        let sigma = DETECTION / (detections.len() as f64).sqrt() * corner.depth / camera.intrinsics.fx;
        let sideways = along.any_orthonormal_vector();
        let depth_error = sigma * (corner.depth / baseline).min(12.0);
        exact
            + depth_error * stream.normal(2) * along
            + sigma * (stream.normal(3) * sideways + stream.normal(4) * along.cross(sideways))
    };
    Some(Tracked { position, detections })
}

fn add(model: &mut Model, swimmer: &Swimmer<'_>, frame: &Frame, color: [u8; 3], point: &Tracked) {
    let id = model.points.len() as u64 + 1;
    let (mut error, mut track) = (0.0, Vec::new());
    for &(view, x, y) in &point.detections {
        let projected = swimmer.project(&swimmer.cameras[view], point.position);
        error += projected.map_or(0.0, |(pixel, _)| math::hypot(pixel.x - x, pixel.y - y));
        let image = &mut model.images[view];
        track.push((image.id, image.keypoints.len() as u32));
        image.keypoints.push(Keypoint { x, y, point: id });
    }
    model.points.push(ModelPoint {
        id,
        position: frame.apply(point.position).to_array(),
        color,
        error: error / point.detections.len() as f64,
        track,
    });
}

/// Keeps about `wanted` points, evenly over the list, with their keypoints.
pub(crate) fn keep(model: &mut Model, wanted: usize) {
    let n = model.points.len();
    if n <= wanted {
        return;
    }
    // Bresenham: point i is kept where the running share increases.
    let stays = |i: usize| (i + 1) * wanted / n > i * wanted / n;
    let mut ids = vec![Keypoint::NONE; n + 1];
    let mut points = Vec::with_capacity(wanted);
    for (i, mut point) in std::mem::take(&mut model.points).into_iter().enumerate() {
        if stays(i) {
            ids[point.id as usize] = points.len() as u64 + 1;
            point.id = points.len() as u64 + 1;
            points.push(point);
        }
    }
    // Keypoints of dropped points remain as unmatched detections, as in a real model.
    for keypoint in model.images.iter_mut().flat_map(|image| &mut image.keypoints) {
        keypoint.point = ids[keypoint.point as usize];
    }
    model.points = points;
}
