//! Distinguishes air from water without tracks, by the darkest and the brightest points.
//!
//! Water adds a veil to everything seen through it and removes light, both increasing with distance:
//! `I = J e^{−β_a s} + B (1 − e^{−β_b s})` with `J ≥ 0`. So the darkest value at a distance is an upper
//! bound of the veil there, in every channel. If some far points are nearly black, there is no veil. If
//! the brightest far points are as bright as the brightest near ones, no light is removed, as dark water
//! lit by lamps would do. Both together mean air. The converse does not hold: a lawn has nothing
//! black, near or far.
//!
//! A point counts in a view only if the view shows the colour that the model has for the point. So an
//! object in front of the point is not mistaken for it. Distances are sorted into [`CLASSES`] classes of
//! equal size.

use use3d_capture::{Camera, Image, Map, SparsePoint};
use use3d_numerics::order::Ascending;

/// Number of classes of distances.
const CLASSES: usize = 5;
/// Number of farthest classes that are tested.
const FAR: usize = 2;
/// Fewest points in a class.
const FEWEST: usize = 150;
/// Smallest ratio of the median distance of the farthest class to that of the nearest.
const RANGE: f64 = 1.4;
/// Largest difference of a pixel from the point's colour, display range.
const SAME: f64 = 0.08;
/// The share of a class that is darker than its lower limit, and the share that is brighter than its upper
/// limit.
const TAIL: f64 = 0.02;
/// Smallest ratio of the brightest far points to the brightest near ones.
const BRIGHT: f64 = 0.8;
/// Values up to this are nearly black, display range.
const BLACK: f64 = 0.06;

/// One view of one point: its distance and colour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointColor {
    /// Distance from the camera centre, any unit.
    pub distance: f64,
    /// R, G, B, display range.
    pub value: [f64; 3],
}

/// Returns the colours of a view at the points that lie in it; `mask` is 1 where pixels count.
pub fn point_colors(
    camera: &Camera,
    points: &[SparsePoint],
    image: &Image,
    mask: Option<&Map>,
) -> Vec<PointColor> {
    let mut found = Vec::new();
    for point in points {
        let Some((at, depth)) = camera.project(point.position) else { continue };
        let inside = at.x >= 0.0 && at.y >= 0.0 && depth > 0.0;
        let (x, y) = (at.x as usize, at.y as usize);
        if !inside || x >= image.width() || y >= image.height() {
            continue;
        }
        let counts = mask.is_none_or(|m| x < m.width() && y < m.height() && m.pixel(x, y)[0] >= 0.5);
        let value = image.pixel(x, y).map(f64::from);
        let same = value.iter().zip(point.color).all(|(v, c)| (v - f64::from(c) / 255.0).abs() <= SAME);
        if counts && same {
            found.push(PointColor { distance: (point.position - camera.pose.center()).length(), value });
        }
    }
    found
}

/// True if these colours of points show air. `false` does not mean water: the scene may simply have nothing
/// dark.
pub fn shows_air(point_colors: &[PointColor]) -> bool {
    let whole = |g: &&PointColor| g.distance.is_finite() && g.value.iter().all(|v| v.is_finite());
    let mut sorted: Vec<&PointColor> = point_colors.iter().filter(whole).collect();
    sorted.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    let n = sorted.len() / CLASSES;
    if n < FEWEST {
        return false;
    }
    let classes: Vec<&[&PointColor]> = sorted.chunks_exact(n).take(CLASSES).collect();
    let middle = |class: &[&PointColor]| class[class.len() / 2].distance;
    if middle(classes[CLASSES - 1]) < RANGE * middle(classes[0]) {
        return false;
    }
    (0..3).all(|c| {
        let at = |class: &[&PointColor], share: f64| {
            Ascending::of(class.iter().map(|g| g.value[c])).at(share).unwrap_or(0.0)
        };
        let brightest = at(classes[0], 1.0 - TAIL);
        let far = &classes[CLASSES - FAR..];
        far.iter().all(|class| at(class, TAIL) <= BLACK && at(class, 1.0 - TAIL) >= BRIGHT * brightest)
    })
}
