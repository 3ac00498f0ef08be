//! These functions compare the photographs at the places where the model saw points.
//!
//! * The *detail* of a point in a view is the brightness of its pixel less the mean around it, in a picture
//!   of about 640 pixels. The *likeness* of a view is the rank correlation (Spearman's ρ) of its details with
//!   the means of those in the other views. It is above 0.7 if a photograph belongs to its pose, and near 0
//!   if another photograph is there, or the same one turned. Exposure and water hardly change the order of
//!   details. Grain does: a view has no likeness if more than a share of the spread of its details is grain.
//! * The likeness is also measured with all places moved away from the middle of the pictures by a factor,
//!   the *zoom*. It is best at 1, unless all photographs were enlarged, or a border was cut off or added.
//!   In pictures of less than 300 pixels the best zoom is too blunt. There the likeness is compared between
//!   two zooms on both sides of 1, with narrower details, at the projections of the points, since the errors
//!   of keypoints are large there. If the likeness of the larger zoom is higher, a border was cut off.
//! * The *hue* of a point is its red less its blue. Its rank correlation between a view and the model's
//!   points is positive, and negative if red and blue are exchanged on one side.

use use3d_capture::Image;
use use3d_io_image::shrunk;
use use3d_numerics::order::median;
use use3d_survey::{PointSight, SurveyPoint, rank_correlation};

use crate::grain::grain;

/// The longer side of the pictures in which details are compared, pixels.
const SIDE: usize = 640;
/// Pixels on each side of a point that its brightness is compared with.
const AROUND: usize = 10;
/// The fewest sightings from which a view's figures are taken.
pub(crate) const FEWEST: usize = 30;
/// The most sightings of a view that are compared with its pixels; they are evenly chosen.
pub(crate) const MOST: usize = 1500;
/// The zooms that are tried; the first one is that of the model.
const ZOOMS: [f64; 19] = [
    1.0, 0.5, 0.67, 0.75, 0.8, 0.85, 0.9, 0.93, 0.95, 0.98, 1.02, 1.05, 1.07, 1.11, 1.18, 1.25, 1.33, 1.5,
    2.0,
];
/// Another zoom is the right one if it makes the likeness so much better, or takes such a share of what lacks
/// to 1, and this much at least.
const BETTER: (f64, f64, f64) = (0.08, 0.4, 0.03);
/// The least likeness at the right zoom.
const GOOD: f64 = 0.6;
/// Smaller pictures are small, pixels on the longer side.
const SMALL: usize = 300;
/// Pixels on each side that a point is compared with at other zooms of small pictures.
const NARROW: usize = 3;
/// The two zooms of small pictures whose likeness is compared, and how much that of the second is higher.
const SIDES: [f64; 2] = [0.9, 1.11];
const HIGHER: f64 = 0.01;
/// The share of the spread of details that may be grain.
const GRAINY: f64 = 0.2;
/// A correlation of hues below this is that of exchanged channels.
const EXCHANGED: f64 = -0.3;

/// Details of points, by index of the point.
type Details = Vec<(usize, f64)>;

/// A photograph at the places of points.
pub(crate) struct Shown {
    /// The standard deviation of its grain, brightness.
    grain: f64,
    /// The details for each zoom.
    details: Vec<Details>,
    /// Red and blue at each point, display range.
    hues: Vec<(usize, [f64; 2])>,
    /// True if it is small.
    small: bool,
}

/// The side on which red and blue are exchanged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Exchanged {
    /// The photographs: they are red where water makes them blue.
    Photographs,
    /// The points of the model.
    Points,
}

/// Sums of the brightness of all pixels above and to the left of each.
struct Sums {
    width: usize,
    height: usize,
    sums: Vec<f64>,
}

impl Sums {
    fn of(width: usize, height: usize, luma: impl Fn(usize, usize) -> f64) -> Self {
        let mut sums = vec![0.0; (width + 1) * (height + 1)];
        for y in 0..height {
            let mut row = 0.0;
            for x in 0..width {
                row += luma(x, y);
                sums[(y + 1) * (width + 1) + x + 1] = sums[y * (width + 1) + x + 1] + row;
            }
        }
        Self { width, height, sums }
    }

    /// The mean of the square of `r` pixels on each side, as far as it is in the picture.
    fn mean(&self, x: usize, y: usize, r: usize) -> f64 {
        let (x0, x1) = (x.saturating_sub(r), (x + r + 1).min(self.width));
        let (y0, y1) = (y.saturating_sub(r), (y + r + 1).min(self.height));
        let at = |x: usize, y: usize| self.sums[y * (self.width + 1) + x];
        (at(x1, y1) - at(x0, y1) - at(x1, y0) + at(x0, y0)) / ((x1 - x0) * (y1 - y0)) as f64
    }
}

/// Reads a photograph at its sights. `size` is that of the model's photograph, pixels, and `projection` gives
/// the pixel on which the point of a sight lands.
pub(crate) fn shown(
    image: &Image,
    sights: &[PointSight],
    size: [f64; 2],
    projection: impl Fn(&PointSight) -> Option<[f64; 2]>,
) -> Shown {
    let small = shrunk(image, SIDE);
    let (w, h) = (small.width(), small.height());
    let lumas: Vec<f64> = (0..w * h)
        .map(|i| {
            let [r, g, b] = small.pixel(i % w, i / w).map(f64::from);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        })
        .collect();
    let luma = |x: usize, y: usize| lumas[y * w + x];
    let sums = Sums::of(w, h, luma);
    let sides = [w as f64, h as f64];
    let place = |at: [f64; 2], zoom: f64| {
        let [x, y] = [0, 1].map(|i| (sides[i] * (0.5 + zoom * (at[i] / size[i] - 0.5))).floor());
        let inside = x >= 1.0 && y >= 1.0 && x + 2.0 <= sides[0] && y + 2.0 <= sides[1];
        inside.then_some((x as usize, y as usize))
    };
    let chosen: Vec<&PointSight> = sights.iter().step_by((sights.len() / MOST).max(1)).collect();
    let is_small = w.max(h) < SMALL;
    let details = |zoom: f64| {
        let narrow = is_small && zoom != ZOOMS[0];
        let around = if narrow { NARROW } else { AROUND };
        let detail = |sight: &&PointSight| {
            let (x, y) = place(if narrow { projection(sight)? } else { sight.at }, zoom)?;
            Some((sight.point, sums.mean(x, y, 1) - sums.mean(x, y, around)))
        };
        chosen.iter().filter_map(detail).collect()
    };
    let hue = |sight: &&PointSight| {
        let (x, y) = place(sight.at, 1.0)?;
        let mut sum = [0.0; 2];
        for (u, v) in (0..9).map(|k| (x + k % 3 - 1, y + k / 3 - 1)) {
            let [red, _, blue] = small.pixel(u, v).map(f64::from);
            sum = [sum[0] + red / (9.0 * 255.0), sum[1] + blue / (9.0 * 255.0)];
        }
        Some((sight.point, sum))
    };
    Shown {
        grain: grain(w, h, luma),
        details: ZOOMS.iter().map(|zoom| details(*zoom)).collect(),
        hues: chosen.iter().filter_map(hue).collect(),
        small: is_small,
    }
}

/// The likeness of each view at the zoom of this index; `None` with too few points.
fn likeness_at(all: &[Option<Shown>], zoom: usize, points: usize) -> Vec<Option<f64>> {
    let mut sums = vec![(0.0, 0usize); points];
    for (point, detail) in all.iter().flatten().filter_map(|shown| shown.details.get(zoom)).flatten() {
        sums[*point].0 += detail;
        sums[*point].1 += 1;
    }
    let of = |shown: &Option<Shown>| {
        let (mut own, mut others) = (Vec::new(), Vec::new());
        for (point, detail) in shown.iter().filter_map(|shown| shown.details.get(zoom)).flatten() {
            let (sum, count) = sums[*point];
            if count > 1 {
                own.push(*detail);
                others.push((sum - detail) / (count - 1) as f64);
            }
        }
        (own.len() >= FEWEST).then(|| rank_correlation(&own, &others)).flatten()
    };
    all.iter().map(of).collect()
}

/// The likeness of each view at the model's own zoom.
pub(crate) fn likeness(all: &[Option<Shown>], points: usize) -> Vec<Option<f64>> {
    let clear = |shown: &Option<Shown>| shown.as_ref().is_some_and(|shown| shown.grain_in_details() < GRAINY);
    let likeness = likeness_at(all, 0, points);
    likeness.into_iter().zip(all).map(|(likeness, shown)| likeness.filter(|_| clear(shown))).collect()
}

impl Shown {
    /// The grain, as a share of white.
    pub(crate) fn grain(&self) -> f64 {
        self.grain / 255.0
    }

    /// The share of the details' variance that is grain, of which a mean of nine pixels keeps a ninth.
    fn grain_in_details(&self) -> f64 {
        let own = self.details[0].iter().map(|(_, detail)| *detail);
        let (count, mean) = (self.details[0].len().max(1) as f64, own.clone().sum::<f64>());
        let variance = own.map(|d| (d - mean / count) * (d - mean / count)).sum::<f64>() / count;
        self.grain * self.grain / 9.0 / variance.max(f64::MIN_POSITIVE)
    }
}

/// The zoom of the photographs against the model, if it is not 1.
pub(crate) fn zoom(all: &[Option<Shown>], points: usize) -> Option<f64> {
    let of = |zoom: usize| median(likeness_at(all, zoom, points).into_iter().flatten());
    let own = of(0)?;
    let others: Vec<(f64, f64)> =
        (1..ZOOMS.len()).filter_map(|zoom| Some((ZOOMS[zoom], of(zoom)?))).collect();
    let best_of = |least: f64| {
        let there = others.iter().filter(|(zoom, _)| *zoom >= least);
        there.copied().max_by(|a, b| a.1.total_cmp(&b.1))
    };
    if all.iter().flatten().any(|shown| shown.small) {
        let like = |zoom: f64| others.iter().find(|(z, _)| *z == zoom).map(|(_, like)| *like);
        let [below, above] = SIDES.map(like);
        let (zoom, best) = best_of(1.0)?;
        return (above? > below? + HIGHER && best > GOOD).then_some(zoom);
    }
    let (zoom, best) = best_of(0.0)?;
    let (most, share, least) = BETTER;
    (best > own + (share * (1.0 - own)).clamp(least, most) && best > GOOD).then_some(zoom)
}

/// The side on which red and blue are exchanged, if they are.
pub(crate) fn exchanged(all: &[Option<Shown>], points: &[SurveyPoint]) -> Option<Exchanged> {
    let (mut sums, mut count) = ([0.0; 2], 0.0);
    let mut of = |shown: &Shown| {
        let (mut own, mut models) = (Vec::new(), Vec::new());
        for (point, [red, blue]) in &shown.hues {
            let [r, _, b] = points[*point].color.map(f64::from);
            own.push(red - blue);
            models.push(r - b);
            sums = [sums[0] + red - blue, sums[1] + r - b];
            count += 1.0;
        }
        (own.len() >= FEWEST).then(|| rank_correlation(&own, &models)).flatten()
    };
    let exchanged = median(all.iter().flatten().filter_map(&mut of))? < EXCHANGED;
    let red_photographs = sums[0] > 0.0 && sums[1] <= 0.0;
    exchanged.then_some(if red_photographs { Exchanged::Photographs } else { Exchanged::Points })
}
