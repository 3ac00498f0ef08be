//! The figures of a capture: what each view sees, how sharp it is, and how its colours differ from its
//! neighbour's.
//!
//! Exposure and white balance are compared on points that two neighbouring views share, since their other
//! contents differ. The change of exposure is the median of `log2(Y_b / Y_a)` of the light `Y` over the
//! shared points, in stops, and that of the white balance the median change of `R/G` and of `B/G`, as a
//! share.

use std::collections::BTreeMap;

use glam::DVec3;
use serde::Serialize;
use use3d_capture::{Capture, Image, Image8, Intrinsics, Map, Reach, Track, View, reaches};
use use3d_io_image::shrunk;
use use3d_numerics::math;
use use3d_numerics::order::{Ascending, median};

use crate::above::main_line;
use crate::agreement::ModelAgreement;

/// The longer side of the pictures in which sharpness is measured, pixels.
const SIDE: usize = 640;
/// Views on each side that a view's sharpness is compared with.
const NEAR: usize = 4;
/// Two views are neighbours if they share this many points.
const SHARED: usize = 15;
/// The fewest shared points from which a change of colour is measured.
const ENOUGH: usize = 20;
/// Sightings that are compared between all views, and views of a point, at most.
const SIGHTINGS: usize = 600_000;
const LONGEST: usize = 12;
/// The fewest pairs of views from which two cameras or folders are compared.
const GROUPED: usize = 3;
/// Sweeps over the views that find the exposure of each.
const SWEEPS: usize = 100;
/// Values outside of this range are clipped or too dark to compare, display range.
const COMPARABLE: std::ops::Range<f64> = 0.04..0.96;
/// A point is seen from different distances if its farthest view is this many times as far as its nearest.
pub(crate) const FARTHER: f64 = 1.25;

/// The figures of a view.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct ViewFigures {
    /// Its name.
    pub name: String,
    /// Sparse points that it sees.
    pub points: usize,
    /// Views that share at least fifteen points with it.
    pub neighbours: usize,
    /// Its sharpness divided by the median of the views around it.
    pub sharpness: Option<f64>,
    /// The mean of its pixels, display range.
    pub brightness: Option<f64>,
    /// The range of brightness from the 5th to the 95th percentile of its pixels, display range.
    pub contrast: Option<f64>,
    /// The change of exposure since the view before it, stops.
    pub exposure_step: Option<f64>,
    /// The larger change of `R/G` and `B/G` since the view before it, as a share.
    pub balance_step: Option<f64>,
    /// The share of its pixels that its mask leaves; `None` without a mask.
    pub unmasked: Option<f64>,
    /// The share of its points that its mask hides; `None` without a mask, or with few points.
    pub hidden_points: Option<f64>,
    /// The number of its points before which something stands that the views around it do not show; `None`
    /// if too few points could be compared.
    pub passed_points: Option<usize>,
}

/// The figures of a capture.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Figures {
    /// The views, in the order of names.
    pub views: Vec<ViewFigures>,
    /// Sparse points.
    pub points: usize,
    /// Mean number of views that see a point.
    pub track_length: f64,
    /// The agreement of the model with its tracks and photographs; `None` if it was not tested.
    pub agreement: Option<ModelAgreement>,
    /// The share of points whose farthest view is at least 1.25 times as far away as its nearest.
    pub seen_from_distances: f64,
    /// The distances of points from the views that see them: 5th, 50th and 95th percentile, units of the
    /// capture.
    pub distances: [f64; 3],
    /// Mean of `|cos|` between a camera's step and its viewing direction: near 1 if it moves along its sight.
    pub forward: Option<f64>,
    /// The spread of camera positions across their main line, as a share of the spread along it.
    pub breadth: Option<f64>,
    /// The largest sample of all photographs, if all of them have 16 bits.
    pub largest_sample: Option<u16>,
    /// Cameras and folders whose exposure differs from that of the first, where they see the same points.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub groups: Vec<GroupExposure>,
    /// The change of exposure from the first views to the last, stops; `None` without pixels and tracks.
    pub drift: Option<f64>,
    /// The parts of the pictures that tracks reach, for each camera with enough views.
    pub reach: Vec<Reach>,
    /// The numbers of views of groups that share no points with each other, the largest first; views that
    /// share none with any other one are left out.
    pub parts: Vec<usize>,
}

/// Measures a capture, without its agreement. `load` gives the pixels of a view at the size of its camera;
/// without it, the figures of pixels are left out.
///
/// # Errors
/// The errors of `load`.
pub fn measure<E>(
    capture: &Capture,
    tracks: &[Track],
    load: Option<&mut dyn FnMut(usize) -> Result<Image, E>>,
) -> Result<Figures, E> {
    measure_and(capture, tracks, load, &mut |_, _| Ok(()))
}

/// Measures a capture, and hands each picture on to `look`, at about [`SIDE`] pixels.
pub(crate) fn measure_and<E>(
    capture: &Capture,
    tracks: &[Track],
    load: Option<&mut dyn FnMut(usize) -> Result<Image, E>>,
    look: &mut dyn FnMut(usize, &Image8) -> Result<(), E>,
) -> Result<Figures, E> {
    let count = capture.views.len();
    let mut figures = Figures { points: capture.points.len(), ..Figures::default() };
    let mut seen: Vec<Vec<(usize, f64, f64)>> = vec![Vec::new(); count];
    let mut distances = Vec::new();
    let (mut ranged, mut tracked, mut lengths) = (0usize, 0usize, 0usize);
    for (point, track) in tracks.iter().enumerate() {
        let mut range = (f64::INFINITY, 0.0f64);
        for s in track.sightings.iter().filter(|s| s.view < count) {
            seen[s.view].push((point, s.x, s.y));
            let d = capture.views[s.view].camera.pose.center().distance(track.position);
            range = (range.0.min(d), range.1.max(d));
            distances.push(d);
        }
        if !track.sightings.is_empty() {
            tracked += 1;
            lengths += track.sightings.len();
            ranged += usize::from(range.1 >= FARTHER * range.0);
        }
    }
    let share = |part: usize, of: usize| part as f64 / of.max(1) as f64;
    figures.track_length = share(lengths, tracked);
    figures.seen_from_distances = share(ranged, tracked);
    let distances = Ascending::of(distances);
    figures.distances = [0.05, 0.5, 0.95].map(|share| distances.at(share).unwrap_or(0.0));
    (figures.forward, figures.breadth) = motion(capture);
    figures.reach = reaches_of(capture, tracks);

    let (neighbours, parts) = neighbours(tracks, count);
    figures.parts = parts;
    for (i, view) in capture.views.iter().enumerate() {
        figures.views.push(ViewFigures {
            name: view.name.to_string(),
            points: seen[i].len(),
            neighbours: neighbours[i],
            ..ViewFigures::default()
        });
    }
    if let Some(load) = load {
        let exposures = pixels(&mut figures.views, &seen, load, look)?;
        figures.groups = group_exposures(capture, &exposures);
        figures.drift = drift(&exposures, count);
    }
    Ok(figures)
}

/// The pixels of the points that each of `views` saw.
pub(crate) fn seen_places(tracks: &[Track], views: usize) -> Vec<Vec<(f64, f64)>> {
    let mut seen = vec![Vec::new(); views];
    for s in tracks.iter().flat_map(|track| &track.sightings) {
        if let Some(seen) = seen.get_mut(s.view) {
            seen.push((s.x, s.y));
        }
    }
    seen
}

/// The share of a view's pixels that its mask leaves, and the share of its points that it hides: `None` with
/// few points. The mask has the size of the view's camera.
pub(crate) fn measure_mask(mask: &Map, seen: &[(f64, f64)]) -> (f64, Option<f64>) {
    let (w, h) = (mask.width(), mask.height());
    let white = mask.data().iter().filter(|v| **v >= 0.5).count();
    let inside = seen.iter().filter(|(x, y)| *x >= 0.0 && *y >= 0.0 && *x < w as f64 && *y < h as f64);
    let hidden: Vec<bool> = inside.map(|(x, y)| mask.data()[*y as usize * w + *x as usize] < 0.5).collect();
    let count = hidden.iter().filter(|hidden| **hidden).count();
    let share = (hidden.len() >= ENOUGH).then(|| count as f64 / hidden.len() as f64);
    (white as f64 / mask.data().len().max(1) as f64, share)
}

/// The number of neighbours of each view, and the numbers of views of groups that are no neighbours.
fn neighbours(tracks: &[Track], count: usize) -> (Vec<usize>, Vec<usize>) {
    let mut shared: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    // Long tracks add many pairs; a few thousand points tell enough.
    let step = (tracks.len() / 20_000).max(1);
    for track in tracks.iter().step_by(step) {
        for (i, a) in track.sightings.iter().enumerate() {
            for b in &track.sightings[i + 1..] {
                if a.view != b.view {
                    *shared.entry((a.view.min(b.view), a.view.max(b.view))).or_default() += step;
                }
            }
        }
    }
    let mut found = vec![0; count];
    let mut group: Vec<usize> = (0..count).collect();
    for ((a, b), _) in shared.into_iter().filter(|((a, b), n)| *n >= SHARED && a.max(b) < &count) {
        found[a] += 1;
        found[b] += 1;
        let (from, to) = (group[a].max(group[b]), group[a].min(group[b]));
        group.iter_mut().filter(|g| **g == from).for_each(|g| *g = to);
    }
    let sizes = (0..count).map(|g| group.iter().filter(|own| **own == g).count());
    let mut parts: Vec<usize> = sizes.filter(|size| *size > 1).collect();
    parts.sort_unstable_by(|a, b| b.cmp(a));
    (found, parts)
}

/// The reach of the tracks for each camera: views with the same intrinsics share one.
fn reaches_of(capture: &Capture, tracks: &[Track]) -> Vec<Reach> {
    let mut cameras: Vec<Intrinsics> = Vec::new();
    let camera_of = |view: &View| {
        let own = view.camera.intrinsics;
        cameras.iter().position(|known| *known == own).unwrap_or_else(|| {
            cameras.push(own);
            cameras.len() - 1
        })
    };
    let of_view: Vec<usize> = capture.views.iter().map(camera_of).collect();
    let sightings = tracks.iter().flat_map(|track| &track.sightings).map(|s| (s.view, [s.x, s.y]));
    reaches(&cameras, &of_view, sightings)
}

/// The share of the motion along the sight, and the breadth of the positions.
fn motion(capture: &Capture) -> (Option<f64>, Option<f64>) {
    let centres: Vec<DVec3> = capture.views.iter().map(|v| v.camera.pose.center()).collect();
    if centres.len() < 3 {
        return (None, None);
    }
    let sight = |i: usize| capture.views[i].camera.pose.rotation.transpose() * DVec3::Z;
    let steps = (1..centres.len()).filter_map(|i| {
        let step = (centres[i] - centres[i - 1]).try_normalize()?;
        Some(step.dot(sight(i)).abs())
    });
    let steps: Vec<f64> = steps.collect();
    let forward = (!steps.is_empty()).then(|| steps.iter().sum::<f64>() / steps.len() as f64);
    let mean = centres.iter().sum::<DVec3>() / centres.len() as f64;
    let offsets: Vec<DVec3> = centres.iter().map(|c| *c - mean).collect();
    let Some(line) = main_line(&offsets) else { return (forward, None) };
    let (mut along, mut across) = (0.0, 0.0);
    for d in offsets {
        along += d.dot(line) * d.dot(line);
        across += (d - line * d.dot(line)).length_squared();
    }
    (forward, (along > 0.0).then(|| (across / along).sqrt()))
}

/// The exposure of a camera or folder against another one's.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct GroupExposure {
    /// Its name.
    pub name: String,
    /// The name of the other one.
    pub other: String,
    /// The change of exposure from the other one to it, stops.
    pub stops: f64,
}

/// Changes of exposure from the first to the second of two views, stops.
type ExposureSteps = BTreeMap<(usize, usize), f64>;

/// Compares the views of each folder, or of each camera, with those of the first one.
fn group_exposures(capture: &Capture, exposures: &ExposureSteps) -> Vec<GroupExposure> {
    let folders = capture.views.iter().map(|view| view.name.as_str().rsplit_once('/').map_or("", |n| n.0));
    let folders: Vec<&str> = folders.collect();
    let mut cameras: Vec<Intrinsics> = Vec::new();
    let mut key = |i: usize| {
        let own = capture.views[i].camera.intrinsics;
        let camera = cameras.iter().position(|known| *known == own).unwrap_or_else(|| {
            cameras.push(own);
            cameras.len() - 1
        });
        (folders[i], camera)
    };
    let keys: Vec<(&str, usize)> = (0..capture.views.len()).map(&mut key).collect();
    let mut all: Vec<(&str, usize)> = keys.clone();
    all.sort_unstable();
    all.dedup();
    let several = all.iter().any(|group| group.0 != all[0].0);
    let name = |(folder, camera): (&str, usize)| match several {
        true => format!("{folder}/"),
        false => format!("camera {}", camera + 1),
    };
    let mut found = Vec::new();
    for group in all.iter().skip(1) {
        let changes = exposures.iter().filter_map(|((a, b), stops)| match (keys[*a], keys[*b]) {
            (a, b) if a == all[0] && b == *group => Some(*stops),
            (a, b) if a == *group && b == all[0] => Some(-*stops),
            _ => None,
        });
        let changes: Vec<f64> = changes.collect();
        if changes.len() >= GROUPED {
            found.push(GroupExposure {
                name: name(*group),
                other: name(all[0]),
                stops: median(changes).unwrap_or(0.0),
            });
        }
    }
    found.sort_by(|a, b| b.stops.abs().total_cmp(&a.stops.abs()));
    found
}

/// The change of exposure along the swim: every view gets the stops that agree best with all pairs, and the
/// first fifth of the views is compared with the last.
fn drift(exposures: &ExposureSteps, count: usize) -> Option<f64> {
    let mut of_view: Vec<Vec<(usize, f64)>> = vec![Vec::new(); count];
    for ((a, b), stops) in exposures {
        of_view[*a].push((*b, -stops));
        of_view[*b].push((*a, *stops));
    }
    let mut level = vec![0.0; count];
    for i in 1..count {
        level[i] = level[i - 1] + exposures.get(&(i - 1, i)).copied().unwrap_or(0.0);
    }
    for _ in 0..SWEEPS {
        for i in 0..count {
            let sum: f64 = of_view[i].iter().map(|(other, stops)| level[*other] + stops).sum();
            if !of_view[i].is_empty() {
                level[i] = sum / of_view[i].len() as f64;
            }
        }
    }
    let fifth = (count / 5).max(1);
    let middle = |views: &[f64]| median(views.iter().copied()).unwrap_or(0.0);
    (!exposures.is_empty()).then(|| middle(&level[count - fifth..]) - middle(&level[..fifth]))
}

/// The changes of exposure between all pairs of views that share enough points.
fn exposures(levels: &BTreeMap<usize, Vec<(usize, f64)>>) -> ExposureSteps {
    let mut changes: BTreeMap<(usize, usize), Vec<f64>> = BTreeMap::new();
    for seen in levels.values() {
        let step = seen.len().div_ceil(LONGEST).max(1);
        let few: Vec<_> = seen.iter().step_by(step).collect();
        for (i, (a, of_a)) in few.iter().enumerate() {
            for (b, of_b) in few[i + 1..].iter().filter(|(b, _)| b != a) {
                changes.entry((*a, *b)).or_default().push(of_b - of_a);
            }
        }
    }
    changes.retain(|_, all| all.len() >= ENOUGH);
    changes.into_iter().filter_map(|(pair, all)| Some((pair, median(all)?))).collect()
}

/// Measures the pixels of all views, one image in memory at a time. Returns the changes of exposure.
fn pixels<E>(
    views: &mut [ViewFigures],
    seen: &[Vec<(usize, f64, f64)>],
    load: &mut dyn FnMut(usize) -> Result<Image, E>,
    look: &mut dyn FnMut(usize, &Image8) -> Result<(), E>,
) -> Result<ExposureSteps, E> {
    let luma = |c: [f64; 3]| 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2];
    let light = |c: [f64; 3]| luma(c.map(linear));
    // Every view takes the same points, so that views still share them.
    let every = (seen.iter().map(Vec::len).sum::<usize>() / SIGHTINGS).max(1);
    let mut levels: BTreeMap<usize, Vec<(usize, f64)>> = BTreeMap::new();
    let mut sharpness = Vec::with_capacity(views.len());
    let mut before: BTreeMap<usize, [f64; 3]> = BTreeMap::new();
    for i in 0..views.len() {
        let image = load(i)?;
        let colours: BTreeMap<usize, [f64; 3]> =
            seen[i].iter().filter_map(|&(point, x, y)| Some((point, colour(&image, x, y)?))).collect();
        let shared: Vec<([f64; 3], [f64; 3])> =
            colours.iter().filter_map(|(point, now)| Some((*before.get(point)?, *now))).collect();
        if shared.len() >= ENOUGH {
            let step = |of: &dyn Fn([f64; 3]) -> f64| {
                median(shared.iter().map(|(a, b)| math::ln(of(*b) / of(*a)))).unwrap_or(0.0)
            };
            views[i].exposure_step = Some(step(&light) / std::f64::consts::LN_2);
            let changes = [step(&|c| c[0] / c[1]), step(&|c| c[2] / c[1])];
            views[i].balance_step = Some(changes.iter().fold(0.0f64, |m, c| m.max(c.abs())));
        }
        for (point, colour) in colours.iter().filter(|(point, _)| *point % every == 0) {
            levels.entry(*point).or_default().push((i, math::log2(light(*colour))));
        }
        before = colours;
        views[i].brightness =
            Some(image.data().iter().map(|v| f64::from(*v)).sum::<f64>() / image.data().len().max(1) as f64);
        let small = shrunk(&image, SIDE);
        views[i].contrast = Some(contrast(&small));
        sharpness.push(laplacian(&small));
        look(i, &small)?;
    }
    for i in 0..views.len() {
        let around = &sharpness[i.saturating_sub(NEAR)..(i + NEAR + 1).min(sharpness.len())];
        let usual = median(around.iter().copied()).unwrap_or(0.0);
        views[i].sharpness = (usual > 0.0).then(|| sharpness[i] / usual);
    }
    Ok(exposures(&levels))
}

/// The light of a display value, by sRGB.
fn linear(v: f64) -> f64 {
    if v <= 0.040_45 { v / 12.92 } else { math::exp(2.4 * math::ln((v + 0.055) / 1.055)) }
}

/// The range of a picture's brightness from the 5th to the 95th percentile.
fn contrast(small: &Image8) -> f64 {
    let pixels = (0..small.height()).flat_map(|y| (0..small.width()).map(move |x| (x, y)));
    let luma = |[r, g, b]: [u8; 3]| 0.2126 * f64::from(r) + 0.7152 * f64::from(g) + 0.0722 * f64::from(b);
    let all = Ascending::of(pixels.map(|(x, y)| luma(small.pixel(x, y)) / 255.0));
    let at = |share: f64| all.at(share).unwrap_or(0.0);
    at(0.95) - at(0.05)
}

/// The mean of 3×3 pixels around a place; `None` if it is outside, clipped or dark.
fn colour(image: &Image, x: f64, y: f64) -> Option<[f64; 3]> {
    let (column, row) = (x.floor(), y.floor());
    if column < 1.0 || row < 1.0 || column + 2.0 > image.width() as f64 || row + 2.0 > image.height() as f64 {
        return None;
    }
    let mut sum = [0.0; 3];
    for v in row as usize - 1..row as usize + 2 {
        for u in column as usize - 1..column as usize + 2 {
            let pixel = image.pixel(u, v);
            (0..3).for_each(|c| sum[c] += f64::from(pixel[c]) / 9.0);
        }
    }
    sum.iter().all(|v| COMPARABLE.contains(v)).then_some(sum)
}

/// The mean squared Laplacian of the green channel over its squared mean. A darker exposure of the same
/// picture is as sharp.
fn laplacian(small: &Image8) -> f64 {
    let (w, h) = (small.width(), small.height());
    if w < 3 || h < 3 {
        return 0.0;
    }
    let green = &small.data()[w * h..2 * w * h];
    let at = |x: usize, y: usize| i32::from(green[y * w + x]);
    let mean = green.iter().map(|v| f64::from(*v)).sum::<f64>() / (w * h) as f64;
    let mut sum = 0.0;
    for y in 1..h - 1 {
        for x in 1..w - 1 {
            let l = 4 * at(x, y) - at(x - 1, y) - at(x + 1, y) - at(x, y - 1) - at(x, y + 1);
            sum += f64::from(l * l);
        }
    }
    // One step of 255 stands for a picture without light.
    sum / ((w - 2) * (h - 2)) as f64 / (mean * mean).max(1.0)
}
