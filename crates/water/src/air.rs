//! Air told from water without tracks, by the darkest and the brightest points.
//!
//! Water adds a veil to whatever is seen through it and takes light away, the more the farther: `I = J
//! e^{−β_a s} + B (1 − e^{−β_b s})` with `J ≥ 0`. What is darkest at a distance is therefore an upper bound
//! of the veil there, in every channel. Where some far points are nearly black, there is no veil; where the
//! brightest far points are as bright as the brightest near ones, nothing is taken away, as dark water lit
//! by lamps would. Both together are air. The opposite is not said: a lawn has nothing black, near or far.
//!
//! A point counts in a view where the view shows the colour that the model gives to the point, so that what
//! stands before it is not taken for it. Distances are sorted into [`CLASSES`] of equal numbers.

use use3d_capture::{Camera, Image, Map, SparsePoint};

/// Classes of distances.
const CLASSES: usize = 5;
/// The farthest ones, that tell.
const FAR: usize = 2;
/// A class has at least so many points.
const FEWEST: usize = 150;
/// The median distance of the farthest class over that of the nearest, at least.
const RANGE: f64 = 1.4;
/// Largest distance of a pixel from the point's colour, display range.
const SAME: f64 = 0.08;
/// The share of a class that is darker than its darkest value, and brighter than its brightest.
const TAIL: f64 = 0.02;
/// The brightest far points are at least this share of the brightest near ones.
const BRIGHT: f64 = 0.8;
/// Values up to here are nearly black, display range.
const BLACK: f64 = 0.06;

/// One view's glance at one point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Glance {
    /// From the camera centre, any unit.
    pub distance: f64,
    /// R, G, B, display range.
    pub value: [f64; 3],
}

/// A view's glances at the points that lie in it, with a mask where 1 counts.
pub fn glances(camera: &Camera, points: &[SparsePoint], image: &Image, mask: Option<&Map>) -> Vec<Glance> {
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
            found.push(Glance { distance: (point.position - camera.pose.center()).length(), value });
        }
    }
    found
}

/// True if the glances show air. `false` says nothing: there may be water, or nothing dark.
pub fn shows_air(glances: &[Glance]) -> bool {
    let whole = |g: &&Glance| g.distance.is_finite() && g.value.iter().all(|v| v.is_finite());
    let mut sorted: Vec<&Glance> = glances.iter().filter(whole).collect();
    sorted.sort_by(|a, b| a.distance.total_cmp(&b.distance));
    let n = sorted.len() / CLASSES;
    if n < FEWEST {
        return false;
    }
    let classes: Vec<&[&Glance]> = sorted.chunks_exact(n).take(CLASSES).collect();
    let middle = |class: &[&Glance]| class[class.len() / 2].distance;
    if middle(classes[CLASSES - 1]) < RANGE * middle(classes[0]) {
        return false;
    }
    (0..3).all(|c| {
        let at = |class: &[&Glance], q: f64| {
            let mut values: Vec<f64> = class.iter().map(|g| g.value[c]).collect();
            values.sort_by(f64::total_cmp);
            values[((q * n as f64) as usize).min(n - 1)]
        };
        let brightest = at(classes[0], 1.0 - TAIL);
        let far = &classes[CLASSES - FAR..];
        far.iter().all(|class| at(class, TAIL) <= BLACK && at(class, 1.0 - TAIL) >= BRIGHT * brightest)
    })
}
