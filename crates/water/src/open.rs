//! Open water: parts of a view that show no surface, so that their colour *is* the veil, `I = g_v B(d)`.
//!
//! Tracks show the veil only by the way it fills in with distance, and often only `B β_b`, the beginning of
//! that curve. Where a view shows water behind the last surface, the veil can be measured directly. A cell
//! of a grid over the view counts as open water if
//!
//! * no point was triangulated in it or beside it;
//! * the nearest triangulated points are far: the middle one of five is at least as far as the capture's
//!   middle distance (a flat floor or wall has no points either, but has near ones around it);
//! * it is even: the means of its 4×4 parts differ from a plane by less than [`EVEN`], which no textured
//!   surface does;
//! * the camera did not clip its bright end, and the mask leaves it whole.
//!
//! Surfaces that still look like open water are far away in haze, where the veil is nearly everything there
//! is to see. Single cells that do not fit the others of their direction lose their weight ([`Open::new`]).

use glam::DVec3;
use use3d_capture::{Camera, Image, Map};

use crate::blocks::order;
use crate::formation::square;
use crate::solve::CAUCHY;
use use3d_numerics::cholesky::Factor;
use use3d_numerics::order::median;

/// Number of cells along the longer side of a view.
const CELLS: usize = 40;
/// A cell's side is at least this many pixels.
const SMALLEST: usize = 8;
/// Smallest distance of a sighting from a cell's centre, in cells.
const CLEAR: f64 = 1.5;
/// Number of sightings around a cell by which the scene's distance there is judged.
const NEAREST: usize = 5;
/// Largest root-mean-square difference of the parts of an even cell from a plane, display range.
const EVEN: f64 = 0.012;
/// Values at or above this are clipped by the camera, display range. There is no lower limit, because a
/// veil may be black.
const BRIGHT: f64 = 253.5 / 255.0;
/// With fewer cells than this, or cells in fewer views than [`FEWEST_VIEWS`], open water is not used.
const FEWEST: usize = 12;
/// See [`FEWEST`].
const FEWEST_VIEWS: usize = 3;
/// Largest number of cells used; more cells add no information.
const MOST: usize = 2000;
/// Expected error of the veil that is linear in the direction, display range: the standard deviation of a
/// cell of weight 1.
pub(crate) const WIDTH: f64 = 0.03;
/// Largest number of cells that count as independent: a veil that is not linear in the direction, or far
/// walls among the cells, shift many cells in the same way.
const INDEPENDENT: f64 = 4.0;

/// A cell of a view that shows only water.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OpenWater {
    /// Index of the view.
    pub view: usize,
    /// Unit direction from the camera centre through the cell's centre, world frame.
    pub direction: DVec3,
    /// The cell's mean, R, G, B, display range.
    pub value: [f64; 3],
}

/// The pixel at which a view saw a point, and the point's distance.
#[derive(Clone, Copy, Debug)]
pub(crate) struct ObservedPoint {
    pub(crate) x: f64,
    pub(crate) y: f64,
    pub(crate) distance: f64,
}

/// Finds the open water of one view; `middle` is the capture's median distance of all sightings.
pub(crate) fn open_water(
    view: usize,
    camera: &Camera,
    image: &Image,
    mask: Option<&Map>,
    seen: &[ObservedPoint],
    middle: f64,
) -> Vec<OpenWater> {
    let (w, h) = (image.width(), image.height());
    let side = (w.max(h) / CELLS).max(SMALLEST);
    let mut found = Vec::new();
    if seen.len() < NEAREST {
        return found;
    }
    for row in 0..h / side {
        for column in 0..w / side {
            let (x0, y0) = (column * side, row * side);
            let (x, y) = (x0 as f64 + 0.5 * side as f64, y0 as f64 + 0.5 * side as f64);
            if !far_and_empty(seen, x, y, CLEAR * side as f64, middle) {
                continue;
            }
            if let Some(value) = even(image, mask, x0, y0, side) {
                let ray = camera.pose.rotation.transpose() * camera.ray(x, y);
                found.push(OpenWater { view, direction: ray.normalize(), value });
            }
        }
    }
    found
}

/// True if no sighting is within `reach` of `(x, y)` and those around it are far.
fn far_and_empty(seen: &[ObservedPoint], x: f64, y: f64, reach: f64, middle: f64) -> bool {
    let mut nearest = [(f64::INFINITY, 0.0); NEAREST];
    for s in seen {
        let off = square(s.x - x) + square(s.y - y);
        if off < reach * reach {
            return false;
        }
        let Some(last) = nearest.last_mut().filter(|last| off < last.0) else { continue };
        *last = (off, s.distance);
        nearest.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
    }
    median(nearest.map(|(_, distance)| distance)).is_some_and(|usual| usual >= middle)
}

/// The mean of a cell, if it is even in every channel.
fn even(image: &Image, mask: Option<&Map>, x0: usize, y0: usize, side: usize) -> Option<[f64; 3]> {
    const PARTS: usize = 4;
    let mut sums = [[0.0; 3]; PARTS * PARTS];
    let mut counts = [0.0; PARTS * PARTS];
    for y in 0..side {
        for x in 0..side {
            if mask.is_some_and(|m| m.pixel(x0 + x, y0 + y)[0] < 0.5) {
                return None;
            }
            let part = y * PARTS / side * PARTS + x * PARTS / side;
            counts[part] += 1.0;
            for (sum, v) in sums[part].iter_mut().zip(image.pixel(x0 + x, y0 + y)) {
                *sum += f64::from(v);
            }
        }
    }
    let n = (PARTS * PARTS) as f64;
    let mut mean = [0.0; 3];
    for c in 0..3 {
        let parts: [f64; PARTS * PARTS] = std::array::from_fn(|i| sums[i][c] / counts[i]);
        let middle = parts.iter().sum::<f64>() / n;
        // Centred positions along an axis: the sum of their squares is n · 5/4.
        let at = |k: usize| k as f64 - 0.5 * (PARTS - 1) as f64;
        let slope = |axis: fn(usize) -> usize| {
            parts.iter().enumerate().map(|(i, v)| at(axis(i)) * v).sum::<f64>() / (n * 1.25)
        };
        let (right, down) = (slope(|i| i % PARTS), slope(|i| i / PARTS));
        let off = |(i, v): (usize, &f64)| square(v - middle - right * at(i % PARTS) - down * at(i / PARTS));
        let off = (parts.iter().enumerate().map(off).sum::<f64>() / n).sqrt();
        if !(off < EVEN && middle < BRIGHT) {
            return None;
        }
        mean[c] = middle;
    }
    Some(mean)
}

/// The open water of one channel's fit: `g_v B(d)` in some directions, each with a weight.
#[derive(Clone, Debug, Default)]
pub(crate) struct Open {
    /// View, unit direction minus the mean direction, value, weight in units of [`WIDTH`]⁻².
    pub(crate) cells: Vec<(usize, [f64; 3], f64, f64)>,
}

impl Open {
    /// The finite cells, sorted and thinned; none if there are too few to measure the veil.
    pub(crate) fn usable(cells: &[OpenWater], views: usize) -> Vec<OpenWater> {
        let finite = |o: &&OpenWater| {
            o.view < views && o.direction.is_finite() && o.value.iter().all(|v| v.is_finite())
        };
        let mut cells: Vec<OpenWater> = cells.iter().filter(finite).copied().collect();
        let by_direction =
            |a: &OpenWater, b: &OpenWater| order(&a.direction.to_array(), &b.direction.to_array());
        cells.sort_by(|a, b| a.view.cmp(&b.view).then_with(|| by_direction(a, b)));
        let mut seen: Vec<usize> = cells.iter().map(|o| o.view).collect();
        seen.dedup();
        if cells.len() < FEWEST || seen.len() < FEWEST_VIEWS {
            return Vec::new();
        }
        let step = cells.len().div_ceil(MOST);
        cells.into_iter().step_by(step).collect()
    }

    /// The cells of channel `c`, with directions relative to `center`. Cells that are off a plane through
    /// the others lose their weight, by Cauchy's loss at the scale of their own scatter; all cells together
    /// weigh at most as much as `INDEPENDENT` observations.
    pub(crate) fn new(cells: &[OpenWater], c: usize, center: DVec3) -> Self {
        let mut cells: Vec<(usize, [f64; 3], f64, f64)> =
            cells.iter().map(|o| (o.view, (o.direction - center).to_array(), o.value[c], 1.0)).collect();
        for _ in 0..12 {
            let Some(plane) = plane(&cells) else { break };
            let off: Vec<f64> = cells
                .iter()
                .map(|(_, d, v, _)| v - plane[0] - (0..3).map(|k| plane[k + 1] * d[k]).sum::<f64>())
                .collect();
            let usual = median(off.iter().map(|o| o.abs())).unwrap_or(0.0);
            let scale = (1.4826 * usual).max(0.3 * WIDTH);
            for (cell, off) in cells.iter_mut().zip(&off) {
                cell.3 = 1.0 / (1.0 + square(off / (scale * CAUCHY)));
            }
        }
        let total: f64 = cells.iter().map(|cell| cell.3).sum();
        let share = INDEPENDENT.min(total) / total;
        cells.iter_mut().for_each(|cell| cell.3 *= share);
        Self { cells }
    }
}

/// The weighted least-squares plane `v = p_0 + p·d`; its slope is 0 for directions that hardly vary.
fn plane(cells: &[(usize, [f64; 3], f64, f64)]) -> Option<[f64; 4]> {
    let (mut matrix, mut rhs) = (vec![0.0; 16], vec![0.0; 4]);
    for (_, d, v, w) in cells {
        let row = [1.0, d[0], d[1], d[2]];
        for i in 0..4 {
            rhs[i] += w * row[i] * v;
            for j in 0..4 {
                matrix[4 * i + j] += w * row[i] * row[j];
            }
        }
    }
    for k in 1..4 {
        matrix[5 * k] += 1e-3 * matrix[0];
    }
    let solution = Factor::new(matrix, 4)?.solve(&rhs);
    Some(std::array::from_fn(|k| solution[k]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Intrinsics, Pose};

    const SIDE: (usize, usize) = (320, 160);

    fn camera() -> Camera {
        let intrinsics = Intrinsics { width: 320, height: 160, fx: 200.0, fy: 200.0, cx: 160.0, cy: 80.0 };
        Camera { intrinsics, pose: Pose::look_at([0.0; 3].into(), [0.0, 1.0, 0.0].into(), glam::DVec3::Z) }
    }

    /// An image that is even above the middle and rough below.
    fn view() -> Image {
        let mut image = Image::new(SIDE.0, SIDE.1);
        for y in 0..SIDE.1 {
            for x in 0..SIDE.0 {
                let rough = if y >= 80 { 0.2 * ((x / 2 * 7 + y / 2 * 13) % 5) as f32 } else { 0.0 };
                image.set_pixel(x, y, [0.0, 0.4 + 1e-4 * x as f32 + rough, 0.6]);
            }
        }
        image
    }

    /// Points all over the lower half, at `distance`.
    fn seen(distance: f64) -> Vec<ObservedPoint> {
        let at = |i: usize| ObservedPoint {
            x: (i % 32) as f64 * 10.0,
            y: 85.0 + (i / 32) as f64 * 10.0,
            distance,
        };
        (0..32 * 8).map(at).collect()
    }

    #[test]
    fn water_behind_far_surfaces_is_open_and_an_even_wall_near_by_is_not() {
        let found = open_water(3, &camera(), &view(), None, &seen(9.0), 5.0);
        assert_eq!(found.len(), 40 * 9, "every cell of the upper half but those beside points");
        for o in &found {
            assert!(o.direction.z > 0.0 && (o.direction.length() - 1.0).abs() < 1e-12, "{o:?}");
            assert!(
                o.value[0] == 0.0 && (o.value[2] - 0.6).abs() < 1e-6,
                "a black channel tells, too: {o:?}"
            );
            assert_eq!(o.view, 3);
        }
        let right = found.iter().filter(|o| o.direction.x > 0.5).count();
        assert!(right > 0, "the direction is the cell's");
        assert_eq!(open_water(3, &camera(), &view(), None, &seen(4.0), 5.0), [], "near points around it");
        assert_eq!(open_water(3, &camera(), &view(), None, &[], 5.0), [], "nothing says what is far");
        let mut half = Map::filled(SIDE.0, SIDE.1, 1.0);
        (0..SIDE.1).for_each(|y| (0..160).for_each(|x| half.set_pixel(x, y, [0.0])));
        assert_eq!(open_water(3, &camera(), &view(), Some(&half), &seen(9.0), 5.0).len(), 20 * 9);
        let mut white = view();
        (0..SIDE.0 * 80).for_each(|i| white.set_pixel(i % SIDE.0, i / SIDE.0, [1.0; 3]));
        assert_eq!(open_water(3, &camera(), &white, None, &seen(9.0), 5.0), [], "clipped");
    }

    fn cells(n: usize) -> Vec<OpenWater> {
        let direction = |i: usize| DVec3::new(0.02 * (i % 20) as f64, 1.0, 0.1 + 0.01 * (i / 20) as f64);
        let value = |d: DVec3| [0.01, 0.4 + 0.3 * d.x, 0.6];
        (0..n)
            .map(|i| OpenWater {
                view: i % 4,
                direction: direction(i).normalize(),
                value: value(direction(i)),
            })
            .collect()
    }

    #[test]
    fn what_does_not_fit_its_direction_loses_its_weight() {
        let mut all = cells(100);
        for o in all.iter_mut().step_by(7) {
            o.value[1] = 0.95;
        }
        let open = Open::new(&all, 1, DVec3::Y);
        let total: f64 = open.cells.iter().map(|c| c.3).sum();
        assert!((total - INDEPENDENT).abs() < 1e-9, "{total}");
        for (i, cell) in open.cells.iter().enumerate() {
            let (fits, share) = (i % 7 != 0, cell.3 * 86.0 / INDEPENDENT);
            assert_eq!(share > 0.5, fits, "{i}: {cell:?}");
            assert!(fits || share < 0.1, "{i}: {cell:?}");
        }
    }

    #[test]
    fn too_few_cells_or_views_tell_nothing_and_many_are_thinned() {
        assert_eq!(Open::usable(&cells(FEWEST - 1), 4), []);
        let mut one = cells(200);
        one.iter_mut().for_each(|o| o.view = 1);
        assert_eq!(Open::usable(&one, 4), []);
        assert_eq!(Open::usable(&cells(200), 2).len(), 0, "two of four views are the capture's");
        let mut wrong = cells(200);
        wrong[0].value[1] = f64::NAN;
        wrong[1].direction.x = f64::INFINITY;
        assert_eq!(Open::usable(&wrong, 4).len(), 198);
        assert_eq!(Open::usable(&cells(3 * MOST), 4).len(), MOST);
    }
}
