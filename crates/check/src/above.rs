//! The path of the camera over the points, as a drawing.
//!
//! The first axis is the line along which the cameras spread most, and the second one the direction across it
//! in which the points spread most. Over a reef that is the view from above; along a wall it is that from the
//! front.

use std::fmt::Write;

use glam::DVec3;
use use3d_capture::Capture;

/// The width of the drawing, and its largest height, pixels.
const SIDES: (f64, f64) = (640.0, 480.0);
/// Pixels that stay free at each side.
const MARGIN: f64 = 12.0;
/// The most points that are drawn.
const POINTS: usize = 1500;
/// The share of points on each side that the drawing may leave out.
const OUTLYING: f64 = 0.03;

/// The direction in which offsets spread most, by power iteration; `None` if they do not spread.
pub(crate) fn main_line(offsets: &[DVec3]) -> Option<DVec3> {
    let mut line = DVec3::new(1.0, 0.7, 0.4);
    for _ in 0..100 {
        line = offsets.iter().map(|d| *d * d.dot(line)).sum::<DVec3>().try_normalize()?;
    }
    Some(line)
}

/// The drawing of a capture: points in their colours, and a line through the cameras in the order of names.
/// It is empty for fewer than two places.
pub(crate) fn drawing(capture: &Capture) -> String {
    let centres: Vec<DVec3> = capture.views.iter().map(|v| v.camera.pose.center()).collect();
    let mean = centres.iter().sum::<DVec3>() / centres.len().max(1) as f64;
    let offsets: Vec<DVec3> = centres.iter().map(|c| *c - mean).collect();
    let Some(along) = main_line(&offsets) else { return String::new() };
    let step = (capture.points.len() / POINTS).max(1);
    let points: Vec<_> = capture.points.iter().step_by(step).map(|p| (p.position - mean, p.color)).collect();
    let beside: Vec<DVec3> = points.iter().map(|(p, _)| *p - along * p.dot(along)).collect();
    let across = main_line(&beside).unwrap_or_else(|| along.any_orthonormal_vector());
    let flat = |d: DVec3| [d.dot(along), d.dot(across)];
    let path: Vec<[f64; 2]> = offsets.into_iter().map(flat).collect();
    let points: Vec<([f64; 2], [u8; 3])> = points.into_iter().map(|(p, color)| (flat(p), color)).collect();
    let ranges = [0, 1].map(|i| {
        let mut values: Vec<f64> = points.iter().map(|(p, _)| p[i]).collect();
        values.sort_unstable_by(f64::total_cmp);
        let spare = (OUTLYING * values.len() as f64) as usize;
        let inner = values.get(spare..values.len() - spare).unwrap_or_default();
        let all = path.iter().map(|p| p[i]).chain(inner.iter().copied());
        all.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
    });
    let [width, height] = ranges.map(|(low, high)| (high - low).max(1e-12));
    let scale = ((SIDES.0 - 2.0 * MARGIN) / width).min((SIDES.1 - 2.0 * MARGIN) / height);
    let place = |p: [f64; 2]| [0, 1].map(|i| MARGIN + (p[i] - ranges[i].0) * scale);
    let size = [width, height].map(|side| (side * scale + 2.0 * MARGIN).round());
    let mut out = format!(
        "<svg viewBox=\"0 0 {} {}\" role=\"img\" aria-label=\"the path of the camera over the points\">",
        size[0], size[1]
    );
    // Writing to a string cannot fail.
    for (point, [r, g, b]) in points {
        let [x, y] = place(point);
        if x >= 0.0 && y >= 0.0 && x <= size[0] && y <= size[1] {
            let _ = write!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"1.5\" fill=\"rgb({r},{g},{b})\"/>");
        }
    }
    let line: Vec<String> = path.iter().map(|p| place(*p)).map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
    let _ = write!(
        out,
        "<polyline points=\"{}\" fill=\"none\" stroke=\"#d9480f\" stroke-width=\"1.5\"/>",
        line.join(" ")
    );
    for (i, p) in path.iter().enumerate() {
        let ([x, y], r) = (place(*p), if i == 0 { 5.0 } else { 2.5 });
        let _ = write!(out, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{r}\" fill=\"#d9480f\"/>");
    }
    out.push_str("</svg>");
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_main_line_is_that_of_the_largest_spread() {
        let offsets = [-2.0, -1.0, 1.0, 2.0].map(|i| DVec3::new(0.1 * i * i, 3.0 * i, 0.2));
        let line = main_line(&offsets).unwrap();
        assert!(line.y.abs() > 0.99, "{line}");
        assert_eq!(main_line(&[DVec3::ZERO; 3]), None);
    }
}
