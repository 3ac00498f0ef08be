//! Start points between tracked points, where surfaces are smooth and points are sparse.
//!
//! A tiled floor or an even wall has hardly any features, so few points are triangulated on it. Gaussians
//! that start only at tracked points leave holes there, above all where the surface has the colour of the
//! water, because the water then explains the picture without a surface. Between three tracked points that
//! one view sees side by side there is a surface in most cases. So for every training view:
//!
//! ```text
//! corners   the pixels (x, y) where the view saw tracked points, z their depths; Delaunay triangles of them
//! kept      1/80 of the width < longest side < 1/4 of the width,   z_max ≤ 1.25 z_min
//! samples   the pixels of a grid with 80 cells along the width; with barycentric weights w_k of a triangle
//!           1/z = Σ_k w_k / z_k,   since the inverse depth of a plane is linear in the image
//! ```
//!
//! A sample is left out where the mask excludes it, where its colour differs from those of all corners (by
//! more than [`UNLIKE`]; a gap between two corals shows the background), and where known water has absorbed
//! all but [`SWALLOWED`] of the light. Samples are merged by voxels, whose edge is the power of two next to
//! the size of a grid cell at the sample's depth. A voxel becomes a start point under two conditions. At
//! least two views have samples in it or beside it (one view if there is only one), and no tracked point
//! and no finer voxel lies in it. Its position and colour are the means of its samples.
//!
//! If `beyond` is set, the cells that no triangle covers are sampled too, at the depth of the
//! [plane of the nearest tracked points](crate::planes), and their colours are compared with those of these
//! points.
//!
//! Depths are in the normalised frame, colours in display range. The points are a function of the
//! arguments, in an order that does not depend on the number of threads.

use std::collections::{BTreeMap, BTreeSet};

use delaunator::{Point, triangulate};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use use3d_capture::{Camera, Pixels, Raster};
use use3d_numerics::math;
use use3d_splat::NEAR;

use crate::planes::{self, Anchor};
use crate::views::TrainingView;
use crate::{FoundWater, Known};

/// Number of cells of the grid of samples along a view's width.
const CELLS: f64 = 80.0;
/// Largest side of a triangle, as a share of the width.
const LONGEST: f64 = 0.25;
/// Largest ratio of two depths of a triangle.
const STEEPEST: f64 = 1.25;
/// Largest distance of a sample's colour from the range of its corners' colours, display range.
const UNLIKE: f64 = 0.12;
/// Smallest share of light that must arrive from a sample in the clearest channel.
const SWALLOWED: f64 = 0.1;
/// Number of views whose samples are in memory at the same time.
const TOGETHER: usize = 16;
/// Largest number of start points between the points of a capture with few points. Other captures get at
/// most [`TIMES`] times the number of their points.
const AT_LEAST: usize = 20_000;
/// See [`AT_LEAST`].
const TIMES: usize = 2;

/// The largest number of start points between this many tracked points.
pub(crate) fn most_between(points: usize) -> usize {
    AT_LEAST.max(points.saturating_mul(TIMES))
}

/// A start point that was not tracked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Between {
    /// Position in the normalised frame.
    pub(crate) position: DVec3,
    /// Start colour, display range: behind the water if the water is known.
    pub(crate) color: [f64; 3],
}

/// A pixel of a triangle.
#[derive(Clone, Copy, Debug)]
struct TriangleSample {
    position: DVec3,
    color: [f64; 3],
    voxel: Voxel,
}

/// A cube with edge 2^level, at integer coordinates; finer levels come first in the order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Voxel {
    level: i32,
    at: [i64; 3],
}

impl Voxel {
    fn of(position: DVec3, level: i32) -> Self {
        let edge = math::powi(2.0, level);
        Self { level, at: (position / edge).to_array().map(|v| v.floor() as i64) }
    }

    /// The surrounding cube with twice the edge.
    fn parent(self) -> Self {
        Self { level: self.level + 1, at: self.at.map(|v| v.div_euclid(2)) }
    }
}

/// The points merged in a voxel.
#[derive(Clone, Copy, Debug, Default)]
struct Merged {
    position: DVec3,
    color: DVec3,
    count: f64,
}

/// The number of views that have samples in a voxel, and the last of them.
#[derive(Clone, Copy, Debug)]
struct SeenBy {
    last: usize,
    views: usize,
}

/// Computes the start points between the tracked points of the training views, and `beyond` them if that is
/// set. `views` are in the order of `indices`, which are the views' indices in the capture, as in the
/// tracks. No start point lies in the voxel of a point in `sparse`.
pub(crate) fn between(
    views: &[TrainingView],
    indices: &[usize],
    known: &Known,
    sparse: &[DVec3],
    beyond: bool,
) -> Vec<Between> {
    let corners = corners(views, indices, known);
    let (mut merged, mut seen) = (BTreeMap::<Voxel, Merged>::new(), BTreeMap::<Voxel, SeenBy>::new());
    for first in (0..views.len()).step_by(TOGETHER) {
        let some = first..(first + TOGETHER).min(views.len());
        let samples: Vec<Vec<TriangleSample>> = some
            .clone()
            .into_par_iter()
            .map(|view| {
                let gain = known.gains.get(indices[view]).copied().unwrap_or([1.0; 3]);
                samples(&views[view], gain, &corners[view], known.water.as_ref(), beyond)
            })
            .collect();
        for (view, samples) in some.zip(samples) {
            for sample in samples {
                let of = merged.entry(sample.voxel).or_default();
                of.position += sample.position;
                of.color += DVec3::from(sample.color);
                of.count += 1.0;
                let by = seen.entry(sample.voxel.parent()).or_insert(SeenBy { last: view, views: 1 });
                if by.last != view {
                    *by = SeenBy { last: view, views: by.views + 1 };
                }
            }
        }
    }
    let agreeing = 2.min(views.len());
    merged.retain(|voxel, _| seen[&voxel.parent()].views >= agreeing);
    let mut points: Vec<Between> = Vec::new();
    let mut taken = BTreeSet::new();
    let mut level = None;
    for (voxel, of) in &merged {
        if level != Some(voxel.level) {
            level = Some(voxel.level);
            taken.clear();
            let finer = points.iter().map(|p| p.position);
            taken.extend(sparse.iter().copied().chain(finer).map(|p| Voxel::of(p, voxel.level)));
        }
        if !taken.contains(voxel) {
            let color = (of.color / of.count).to_array();
            points.push(Between { position: of.position / of.count, color });
        }
    }
    points
}

/// A tracked point in a view.
#[derive(Clone, Copy, Debug)]
struct Corner {
    at: DVec2,
    depth: f64,
    /// The weight of the colour behind the water, 0 to 1 per channel.
    sure: [f64; 3],
}

/// The tracked points of every training view.
fn corners(views: &[TrainingView], indices: &[usize], known: &Known) -> Vec<Vec<Corner>> {
    let places: BTreeMap<usize, usize> = indices.iter().enumerate().map(|(at, view)| (*view, at)).collect();
    let mut corners = vec![Vec::new(); views.len()];
    for (point, track) in known.tracks.iter().enumerate() {
        let sure = known.water.as_ref().map_or([0.0; 3], |water| water.sure(point));
        for sighting in &track.sightings {
            let Some(&at) = places.get(&sighting.view) else { continue };
            let Some((_, depth)) = views[at].camera.project(track.position) else { continue };
            let k = &views[at].camera.intrinsics;
            let inside = |v: f64, size: usize| v >= 0.0 && v < size as f64;
            if depth > NEAR
                && depth.is_finite()
                && inside(sighting.x, k.width)
                && inside(sighting.y, k.height)
            {
                corners[at].push(Corner { at: DVec2::new(sighting.x, sighting.y), depth, sure });
            }
        }
    }
    corners
}

/// Computes the samples of one view.
fn samples(
    view: &TrainingView,
    gain: [f64; 3],
    corners: &[Corner],
    water: Option<&FoundWater>,
    beyond: bool,
) -> Vec<TriangleSample> {
    let k = view.camera.intrinsics;
    let width = k.width as f64;
    let step = (width / CELLS).max(1.0);
    let points: Vec<Point> = corners.iter().map(|c| Point { x: c.at.x, y: c.at.y }).collect();
    let mut found = Vec::new();
    // The cells inside a triangle, whether they became a sample or not.
    let mut covered = BTreeSet::new();
    let cell = |pixel: DVec2| ((pixel.y / step) as i64, (pixel.x / step) as i64);
    let sample = |pixel: DVec2, inverse: f64, color: [f64; 3], sure: [f64; 3]| {
        let ray = view.camera.ray(pixel.x, pixel.y);
        let pose = &view.camera.pose;
        let position = pose.rotation.transpose() * (ray / inverse - pose.translation);
        let seen: [f64; 3] = std::array::from_fn(|i| color[i] / gain[i]);
        let color = behind(water, &view.camera, position, seen, sure)?;
        let level = math::log2(step / (inverse * k.fx)).round() as i32;
        Some(TriangleSample { position, color, voxel: Voxel::of(position, level) })
    };
    for triangle in triangulate(&points).triangles.chunks_exact(3) {
        let three = [corners[triangle[0]], corners[triangle[1]], corners[triangle[2]]];
        if !smooth(&three, step, LONGEST * width) {
            continue;
        }
        let colors = three.map(|corner| shown(view, corner.at));
        for pixel in grid(&three.map(|c| c.at), step) {
            let Some(weights) = barycentric(&three.map(|c| c.at), pixel) else { continue };
            covered.insert(cell(pixel));
            let color = shown(view, pixel);
            let (Some(color), [Some(a), Some(b), Some(c)]) = (color, colors) else { continue };
            if !alike(color, &[a, b, c]) {
                continue;
            }
            let inverse: f64 = (0..3).map(|i| weights[i] / three[i].depth).sum();
            let sure = std::array::from_fn(|c| (0..3).map(|i| weights[i] * three[i].sure[c]).sum());
            found.extend(sample(pixel, inverse, color, sure));
        }
    }
    if !beyond {
        return found;
    }
    let anchors: Vec<Anchor> = corners.iter().map(|c| Anchor { at: c.at, inverse: 1.0 / c.depth }).collect();
    let colors: Vec<Option<[f64; 3]>> = corners.iter().map(|c| shown(view, c.at)).collect();
    let whole = [DVec2::ZERO, DVec2::new(width, 0.0), DVec2::new(0.0, k.height as f64)];
    for pixel in grid(&whole, step).filter(|pixel| !covered.contains(&cell(*pixel))) {
        let Some((inverse, shares)) = planes::inverse_depth(&anchors, pixel, step, width) else { continue };
        let beside: Vec<[f64; 3]> = shares.iter().filter_map(|(i, _)| colors[*i]).collect();
        let Some(color) = shown(view, pixel).filter(|color| alike(*color, &beside)) else { continue };
        let sure = std::array::from_fn(|c| shares.iter().map(|(i, share)| share * corners[*i].sure[c]).sum());
        found.extend(sample(pixel, inverse, color, sure));
    }
    found
}

/// True if a colour is within the range of others, or at most [`UNLIKE`] outside it.
fn alike(color: [f64; 3], others: &[[f64; 3]]) -> bool {
    (0..3).all(|c| {
        let of = || others.iter().map(|other| other[c]);
        let (low, high) = (of().fold(f64::INFINITY, f64::min), of().fold(f64::NEG_INFINITY, f64::max));
        color[c] >= low - UNLIKE && color[c] <= high + UNLIKE
    })
}

/// True if a triangle is neither too small nor too large nor too steep.
fn smooth(corners: &[Corner; 3], step: f64, longest: f64) -> bool {
    let [a, b, c] = corners;
    let side = a.at.distance(b.at).max(b.at.distance(c.at)).max(c.at.distance(a.at));
    let near = a.depth.min(b.depth).min(c.depth);
    let far = a.depth.max(b.depth).max(c.depth);
    side > step && side < longest && far <= STEEPEST * near
}

/// The pixel positions of the grid in the box around a triangle.
fn grid(corners: &[DVec2; 3], step: f64) -> impl Iterator<Item = DVec2> {
    let [a, b, c] = *corners;
    let (low, high) = (a.min(b).min(c), a.max(b).max(c));
    let range = move |low: f64, high: f64| {
        let first = (low / step - 0.5).ceil() as i64;
        let last = (high / step - 0.5).floor() as i64;
        (first..=last).map(move |i| (i as f64 + 0.5) * step)
    };
    range(low.y, high.y).flat_map(move |y| range(low.x, high.x).map(move |x| DVec2::new(x, y)))
}

/// The weights of a triangle's corners at a point; `None` if the point lies outside.
fn barycentric(corners: &[DVec2; 3], at: DVec2) -> Option<[f64; 3]> {
    let [a, b, c] = *corners;
    let area = (b - a).perp_dot(c - a);
    let weights = [(b - at).perp_dot(c - at), (c - at).perp_dot(a - at), (a - at).perp_dot(b - at)];
    let weights = weights.map(|w| w / area);
    weights.iter().all(|w| *w >= 0.0).then_some(weights)
}

/// The colour of a 3×3 window around a pixel position, display range; `None` if one of its pixels does not
/// count.
fn shown(view: &TrainingView, at: DVec2) -> Option<[f64; 3]> {
    let (width, height) = view.pixels.size();
    let window = |v: f64, size: usize| {
        let middle = (v.floor().max(0.0) as usize).min(size - 1);
        middle.saturating_sub(1)..(middle + 2).min(size)
    };
    let (mut sum, mut count) = ([0.0; 3], 0.0);
    for y in window(at.y, height) {
        for x in window(at.x, width) {
            let counts = |map: &Option<Raster<u8, 1>>| map.as_ref().is_none_or(|m| m.pixel(x, y)[0] >= 128);
            if !counts(&view.mask) || !counts(&view.alpha) {
                return None;
            }
            let color = match &view.pixels {
                Pixels::Eight(raster) => raster.pixel(x, y).map(|v| f64::from(v) / 255.0),
                Pixels::Sixteen(raster) => raster.pixel(x, y).map(|v| f64::from(v) / 65_535.0),
            };
            (0..3).for_each(|c| sum[c] += color[c]);
            count += 1.0;
        }
    }
    Some(sum.map(|v| v / count))
}

/// The colour behind the known water, weighted by its certainty; `None` if too little light arrives to show
/// a surface.
fn behind(
    water: Option<&FoundWater>,
    camera: &Camera,
    position: DVec3,
    seen: [f64; 3],
    sure: [f64; 3],
) -> Option<[f64; 3]> {
    let Some(water) = water else { return Some(seen) };
    let ray = position - camera.pose.center();
    let (distance, direction) = (ray.length(), ray.normalize());
    let arrives = water.attenuation.map(|beta| math::exp(-beta * distance));
    if arrives.iter().all(|t| *t < SWALLOWED) {
        return None;
    }
    Some(std::array::from_fn(|c| {
        let veil = water.veil[c] + DVec3::from(water.veil_slope[c]).dot(direction);
        let haze = veil * (1.0 - math::exp(-water.backscatter[c] * distance));
        let radiance = ((seen[c] - haze) / arrives[c]).clamp(0.0, 1.0);
        sure[c] * radiance + (1.0 - sure[c]) * seen[c]
    }))
}

#[cfg(test)]
mod tests {
    use use3d_capture::{FileName, Intrinsics, Pose, Sighting, Track, View};
    use use3d_numerics::random::{Purpose, Stream};

    use super::*;
    use crate::LoadedView;

    const SIZE: [usize; 2] = [160, 120];

    fn camera(x: f64, z: f64) -> Camera {
        let [width, height] = SIZE;
        let intrinsics = Intrinsics { width, height, fx: 150.0, fy: 150.0, cx: 80.0, cy: 60.0 };
        let eye = DVec3::new(x, 0.0, z);
        Camera { intrinsics, pose: Pose::look_at(eye, eye + DVec3::new(0.0, 0.1, 1.0), -DVec3::Y) }
    }

    /// A view that shows `color` at every pixel.
    fn view(camera: Camera, color: impl Fn(usize, usize) -> [u8; 3], masked: bool) -> TrainingView {
        let [width, height] = SIZE;
        let mut pixels = Raster::new(width, height);
        for y in 0..height {
            for x in 0..width {
                pixels.set_pixel(x, y, color(x, y));
            }
        }
        let name = FileName::new("a.png").unwrap();
        let view = View { name, id: 0, image: "".into(), mask: None, depth_prior: None, camera };
        let mask = masked.then(|| use3d_capture::Map::filled(width, height, 0.0));
        let loaded = LoadedView { pixels: Pixels::Eight(pixels), alpha: None, mask, depth_prior: None };
        TrainingView::new(&view, loaded).unwrap().0
    }

    /// Tracks of these points in all these cameras.
    fn tracks(cameras: &[Camera], points: &[DVec3]) -> Vec<Track> {
        let sighting = |view: usize, p: DVec3| {
            let (at, _) = cameras[view].project(p)?;
            let inside = at.x >= 0.0 && at.x < SIZE[0] as f64 && at.y >= 0.0 && at.y < SIZE[1] as f64;
            inside.then_some(Sighting { view, x: at.x, y: at.y })
        };
        let of = |p: &DVec3| Track {
            position: *p,
            sightings: (0..cameras.len()).filter_map(|v| sighting(v, *p)).collect(),
        };
        points.iter().map(of).collect()
    }

    /// Points on the plane `z = 2.2 + y/4`, at some distance from each other.
    fn plane() -> Vec<DVec3> {
        let stream = Stream::new(3, Purpose::new("points of a plane"), 0);
        let draw = |k: u64| 0.1 * stream.uniform(k);
        (0..12 * 9u64)
            .map(|i| {
                let (x, y) = (
                    (i % 12) as f64 / 6.0 - 1.0 + draw(2 * i),
                    (i / 12) as f64 / 6.0 - 0.7 + draw(2 * i + 1),
                );
                DVec3::new(x, y, 2.2 + 0.25 * y)
            })
            .collect()
    }

    fn cameras() -> Vec<Camera> {
        vec![camera(-0.2, 0.0), camera(0.0, 0.1), camera(0.2, -0.1)]
    }

    fn start(views: &[TrainingView], points: &[DVec3], water: Option<FoundWater>) -> Vec<Between> {
        let cameras: Vec<Camera> = views.iter().map(|v| v.camera).collect();
        let known = Known { tracks: tracks(&cameras, points), water, ..Known::default() };
        let indices: Vec<usize> = (0..views.len()).collect();
        between(views, &indices, &known, points, false)
    }

    fn grey(_: usize, _: usize) -> [u8; 3] {
        [51, 102, 153]
    }

    #[test]
    fn a_plane_is_filled_where_it_lies_once_and_in_its_colour() {
        let views: Vec<TrainingView> = cameras().into_iter().map(|c| view(c, grey, false)).collect();
        let points = plane();
        let found = start(&views, &points, None);
        assert!(found.len() > 300, "{}", found.len());
        for p in &found {
            // Inverse depth is linear over a plane in the image, so points lie on the plane to the last
            // digits.
            assert!((p.position.z - 2.2 - 0.25 * p.position.y).abs() < 1e-9, "{p:?}");
            for (c, wanted) in p.color.iter().zip([0.2, 0.4, 0.6]) {
                assert!((c - wanted).abs() < 1e-9);
            }
        }
        // Samples are merged: there is one per voxel, and none in the voxel of a tracked point.
        let voxels: BTreeSet<Voxel> = found.iter().map(|p| Voxel::of(p.position, -5)).collect();
        assert_eq!(voxels.len(), found.len());
        assert!(points.iter().all(|p| !voxels.contains(&Voxel::of(*p, -5))), "beside tracked points only");
    }

    #[test]
    fn steps_large_gaps_other_colours_and_masks_are_left_alone() {
        let views = |color: fn(usize, usize) -> [u8; 3], masked: bool| -> Vec<TrainingView> {
            cameras().into_iter().map(|c| view(c, color, masked)).collect()
        };
        let plain = views(grey, false);
        let points = plane();
        // A step in depth: there are no points between the two sides.
        let step: Vec<DVec3> =
            points.iter().map(|p| if p.x < 0.0 { *p } else { DVec3::new(p.x, p.y, p.z + 2.0) }).collect();
        let found = start(&plain, &step, None);
        assert!(!found.is_empty());
        for p in &found {
            let off = p.position.z - 2.2 - 0.25 * p.position.y;
            assert!(off.abs() < 1e-6 || (off - 2.0).abs() < 1e-6, "{off}");
        }
        // The points are too far apart.
        let few: Vec<DVec3> = points.iter().copied().step_by(41).collect();
        assert_eq!(start(&plain, &few, None), []);
        // Masked views, and a view that is the only one of several to show the surface.
        assert_eq!(start(&views(grey, true), &points, None), []);
        let mut alone = views(grey, true);
        alone[1] = view(cameras()[1], grey, false);
        assert_eq!(start(&alone, &points, None), []);
        // A gap between the points through which a different colour is visible.
        let middle = DVec3::new(0.0, 0.0, 2.2);
        let around: Vec<DVec3> = points.into_iter().filter(|p| p.distance(middle) > 0.13).collect();
        let through = |c: Camera| {
            let at = c.project(middle).unwrap().0;
            let blue = move |x: usize, y: usize| {
                let off = DVec2::new(x as f64 + 0.5, y as f64 + 0.5).distance(at);
                if off < 6.0 { [51, 102, 250] } else { [51, 102, 153] }
            };
            view(c, blue, false)
        };
        let gap: Vec<TrainingView> = cameras().into_iter().map(through).collect();
        let inside = |found: Vec<Between>| found.iter().any(|p| p.position.distance(middle) < 0.05);
        assert!(inside(start(&plain, &around, None)) && !inside(start(&gap, &around, None)));
        assert_eq!(start(&plain, &[], None), []);
    }

    #[test]
    fn colours_are_those_behind_the_water_and_what_it_swallows_is_left_alone() {
        let points = plane();
        let (attenuation, veil) = ([0.4, 0.2, 0.1], [0.1, 0.3, 0.4]);
        let radiance = [0.6, 0.5, 0.4];
        // An even surface of this radiance, as a camera sees it at its pixels.
        let shown = |camera: Camera| {
            view(
                camera,
                |x, y| {
                    let ray = camera.ray(x as f64 + 0.5, y as f64 + 0.5);
                    let pose = &camera.pose;
                    let (d, o) = (pose.rotation.transpose() * ray, pose.center());
                    let t = (2.2 + 0.25 * o.y - o.z) / (d.z - 0.25 * d.y);
                    let arrives = attenuation.map(|b: f64| math::exp(-b * (t * d).length()));
                    std::array::from_fn(|c| {
                        let v = radiance[c] * arrives[c] + veil[c] * (1.0 - arrives[c]);
                        (v * 255.0 + 0.5) as u8
                    })
                },
                false,
            )
        };
        let views: Vec<TrainingView> = cameras().into_iter().map(shown).collect();
        let known = radiance.map(|r| (r, 0.0));
        let water = FoundWater {
            attenuation,
            backscatter: attenuation,
            veil,
            veil_slope: [[0.0; 3]; 3],
            radiances: vec![Some(known); points.len()],
        };
        let found = start(&views, &points, Some(water.clone()));
        assert!(found.len() > 300);
        for p in &found {
            for (c, wanted) in p.color.iter().zip(radiance) {
                assert!((c - wanted).abs() < 0.01, "{c}, not {wanted}");
            }
        }
        // Colours that are not certain are as photographed.
        let unsure = FoundWater { radiances: vec![None; points.len()], ..water };
        let photographed = start(&views, &points, Some(unsure));
        assert_eq!(photographed.len(), found.len());
        assert!(photographed.iter().all(|p| p.color[0] < 0.45), "hazy and dark");
        let thick = FoundWater { attenuation: [9.0, 2.0, 2.0], ..water };
        assert_eq!(start(&views, &points, Some(thick)), []);
    }

    #[test]
    fn the_ground_goes_on_beyond_the_last_points_and_no_further_than_views_agree() {
        let views: Vec<TrainingView> = cameras().into_iter().map(|c| view(c, grey, false)).collect();
        // The right third of the plane has no tracked points.
        let points: Vec<DVec3> = plane().into_iter().filter(|p| p.x < 0.3).collect();
        let indices: Vec<usize> = (0..views.len()).collect();
        let known = |points: &[DVec3]| Known { tracks: tracks(&cameras(), points), ..Known::default() };
        let right = |found: &[Between]| found.iter().filter(|p| p.position.x > 0.45).count();
        let without = between(&views, &indices, &known(&points), &points, false);
        let with = between(&views, &indices, &known(&points), &points, true);
        assert_eq!(right(&without), 0);
        assert!(right(&with) > 100, "{}", right(&with));
        for p in &with {
            assert!((p.position.z - 2.2 - 0.25 * p.position.y).abs() < 1e-9, "{p:?}");
        }
        // Two surfaces, one behind the other, have no common plane.
        let rough: Vec<DVec3> =
            points.iter().enumerate().map(|(i, p)| DVec3::new(p.x, p.y, p.z + (i % 2) as f64)).collect();
        let found = between(&views, &indices, &known(&rough), &rough, true);
        assert!(right(&found) < right(&with) / 10, "{}", right(&found));
    }

    #[test]
    fn any_number_of_threads_gives_the_same_points() {
        let views: Vec<TrainingView> = cameras().into_iter().map(|c| view(c, grey, false)).collect();
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| start(&views, &plane(), None))
        };
        assert_eq!(on(1), on(4));
    }
}
