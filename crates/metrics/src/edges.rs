//! The width of step edges in a render, as a multiple of their width in the photograph of the same view.
//!
//! A width is the distance from 10 % to 90 % of the rise between an edge's two plateaus, in pixels of luma
//! `Y = 0.299 R + 0.587 G + 0.114 B`. An edge that a Gaussian of standard deviation σ blurs has a width of
//! 2.563 σ. The score of a view is the median over edges of `width in the render / width in the photograph`;
//! 1 is as sharp as the photograph, and 2 is twice as blurred.
//!
//! | symbol | meaning |
//! |---|---|
//! | `g` | gradient of Y after a Gaussian of σ = 1 pixel |
//! | A, B, C | sums of g_x², g_x g_y, g_y² over 9 × 9 pixels |
//! | straightness | coherence of the structure tensor, `√((A − C)² + 4 B²) / (A + C)`; 1 is a straight edge |
//! | profile | Y at −8 … 8 pixels across the edge, by half pixels; mean of nine lines a pixel apart |
//! | plateaus | means of the profile at −8 … −5 and at 5 … 8 pixels |
//! | contrast | difference of the plateaus |
//!
//! **Edges** are found in the photograph alone. They are straight maxima of `|g|` across the edge. Their
//! profile rises from one flat plateau to the other, within 6 pixels and without a fall. It stays near the
//! ideal blurred step, and crosses the middle at the same place along the whole edge. The 200 with the most
//! straightness × contrast count, at least 8 pixels apart. With fewer than 20 there is no score.
//!
//! **In a render** the same lines are read. The plateaus are those of the render, and the middle of the rise
//! may be up to 2 pixels away, as a render can be displaced. An edge is *lost* if less than 30 % of its
//! contrast is left, or if the middle is farther away. It then counts with the widest width that can be
//! measured, 16 pixels.
//!
//! Limits: plateaus that begin 5 pixels from the middle belong to the rise of an edge that is wider than
//! about 8 pixels, so larger widths are underestimated. Reading between pixels is cubic and widens the
//! sharpest edges by some percent, in both images alike.

use rayon::prelude::*;
use use3d_capture::{Image, Map};
use use3d_numerics::math;
use use3d_numerics::order::Ascending;

use crate::error::{MetricError, finite, same_size};
use crate::warp::Mask;

/// The most edges of a view.
const MOST: usize = 200;
/// The fewest edges for a score.
const FEWEST: usize = 20;
/// Half of a profile's length, pixels.
const REACH: f64 = 8.0;
/// Positions of a profile: every half pixel.
const POSITIONS: usize = 33;
/// Positions of a plateau: three pixels.
const PLATEAU: usize = 7;
/// Lines to each side of an edge's middle line, one pixel apart.
const LINES: isize = 4;
/// Pixels around an edge that its lines and their interpolation may read.
const AROUND: usize = 12;
/// Smallest `|g|` at an edge.
const LEAST_SLOPE: f32 = 0.01;
/// Smallest straightness.
const LEAST_STRAIGHTNESS: f32 = 0.7;
/// Smallest contrast.
const LEAST_CONTRAST: f64 = 0.04;
/// Largest width in a photograph, pixels.
const WIDEST: f64 = 6.0;
/// Largest standard deviation of a plateau, largest fall within the rise, and largest root mean square of the
/// distance from the ideal step, as shares of the contrast.
const ROUGHEST: [f64; 3] = [0.35, 0.35, 0.15];
/// Farthest that the middle of the rise is from the maximum of `|g|`, and from the middle along another third
/// of the edge, pixels.
const OFF_MIDDLE: [f64; 2] = [1.0, 0.4];
/// Farthest shift of an edge in a render, pixels.
const SHIFT: f64 = 2.0;
/// Smallest share of the contrast that an edge keeps in a render.
const KEPT: f64 = 0.3;
/// Smallest distance of two edges, pixels.
const APART: f64 = 8.0;
/// The same of two places whose profiles are read to find them.
const APART_BEFORE: f64 = 3.0;
/// Widths of a Gaussian step: from 10 % to 90 %, per standard deviation.
const WIDTH_OF_SIGMA: f64 = 2.563_103_131_089_2;
/// `1 / (1 + exp(−1.702 z))` differs from the normal distribution by less than 0.01.
const LOGISTIC: f64 = 1.702;

/// The step edges of a photograph.
#[derive(Clone, Debug)]
pub struct StepEdges {
    luma: Map,
    edges: Vec<StepEdge>,
}

/// A step edge of a photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepEdge {
    /// Its place; pixel centres are whole numbers.
    pub at: [f64; 2],
    /// Its unit normal, from dark to bright.
    pub normal: [f64; 2],
    /// Straightness × contrast.
    pub strength: f64,
    /// Difference of its plateaus.
    pub contrast: f64,
    /// Distance from 10 % to 90 % of the rise, pixels.
    pub width: f64,
    /// Position of the middle of the rise along the normal, pixels.
    middle: f64,
}

/// The edges of a photograph as a render shows them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EdgeWidth {
    /// Median over edges of the width in the render by the width in the photograph.
    pub ratio: f64,
    /// Share of the edges that are lost, 0 to 1.
    pub lost: f64,
}

/// The rise between two plateaus.
struct Rise {
    dark: f64,
    bright: f64,
    middle: f64,
    width: f64,
}

impl StepEdges {
    /// Finds the edges of a photograph, in pixels around which all pixels count.
    ///
    /// # Errors
    /// Values are not finite, the mask has another size, or there are fewer than 20 edges.
    pub fn of(photograph: &Image, mask: Option<&Mask>) -> Result<Self, MetricError> {
        finite("the photograph", photograph)?;
        if let Some(mask) = mask {
            same_size("the mask", photograph, mask)?;
        }
        let luma = luma(photograph);
        let mut found: Vec<StepEdge> = apart(candidates(&luma, mask), APART_BEFORE)
            .into_par_iter()
            .filter_map(|(place, straightness)| edge(&luma, place, straightness))
            .collect();
        found.sort_by(|a, b| b.strength.total_cmp(&a.strength));
        let mut edges = apart(found.into_iter().map(|edge| (edge, edge.at)).collect(), APART);
        edges.truncate(MOST);
        if edges.len() < FEWEST {
            return Err(MetricError::FewEdges { found: edges.len(), least: FEWEST });
        }
        Ok(Self { luma, edges })
    }

    /// The edges, the strongest first.
    pub fn edges(&self) -> &[StepEdge] {
        &self.edges
    }

    /// The width of the edges in a render of the view.
    ///
    /// # Errors
    /// The render has another size than the photograph, or values that are not finite.
    pub fn in_render(&self, render: &Image) -> Result<EdgeWidth, MetricError> {
        same_size("the photograph", render, &self.luma)?;
        finite("the render", render)?;
        let luma = luma(render);
        let width = |edge: &StepEdge| -> Option<f64> {
            let profile = profile(&luma, edge.at, edge.normal, -LINES..=LINES);
            let rise = rise(&profile, edge.middle)?;
            let kept = rise.bright - rise.dark >= KEPT * edge.contrast;
            (kept && (rise.middle - edge.middle).abs() <= SHIFT).then_some(rise.width)
        };
        let widths: Vec<Option<f64>> = self.edges.par_iter().map(width).collect();
        let lost = widths.iter().filter(|width| width.is_none()).count() as f64 / self.edges.len() as f64;
        let ratios =
            widths.iter().zip(&self.edges).map(|(width, edge)| width.unwrap_or(2.0 * REACH) / edge.width);
        let ratio = Ascending::of(ratios).interpolated(0.5).ok_or(MetricError::NothingCounts)?;
        Ok(EdgeWidth { ratio, lost })
    }
}

fn luma(image: &Image) -> Map {
    let mut luma = Map::new(image.width(), image.height());
    let [r, g, b] = [0, 1, 2].map(|c| image.plane(c));
    for (i, y) in luma.data_mut().iter_mut().enumerate() {
        *y = 0.299 * r[i] + 0.587 * g[i] + 0.114 * b[i];
    }
    luma
}

/// The map under a Gaussian of σ = 1; outside, the nearest pixel counts.
fn smoothed(map: &Map) -> Map {
    let (w, h) = (map.width(), map.height());
    let raw: [f32; 7] = std::array::from_fn(|k| math::exp(-0.5 * math::powi(k as f32 - 3.0, 2)));
    let total: f32 = raw.iter().sum();
    let taps = raw.map(|tap| tap / total);
    let mut out = Map::new(w, h);
    out.data_mut().par_chunks_mut(w).enumerate().for_each_init(
        || vec![0.0f32; w + 6],
        |column_sums, (y, out)| {
            column_sums.fill(0.0);
            for (k, tap) in taps.iter().enumerate() {
                let row = map.row(0, (y + k).saturating_sub(3).min(h - 1));
                column_sums[3..w + 3].iter_mut().zip(row).for_each(|(sum, v)| *sum += tap * v);
            }
            let (left, right) = (column_sums[3], column_sums[w + 2]);
            column_sums[..3].fill(left);
            column_sums[w + 3..].fill(right);
            for (k, tap) in taps.iter().enumerate() {
                out.iter_mut().zip(&column_sums[k..]).for_each(|(out, sum)| *out += tap * sum);
            }
        },
    );
    out
}

/// The places with a maximum of `|g|` and enough straightness, strongest first: position, normal and
/// straightness, and the position.
#[allow(clippy::type_complexity, reason = "a place with the position by which it is kept apart")]
fn candidates(luma: &Map, mask: Option<&Mask>) -> Vec<((([f64; 2], [f64; 2]), f64), [f64; 2])> {
    let (w, h) = (luma.width(), luma.height());
    if w <= 2 * AROUND || h <= 2 * AROUND {
        return Vec::new();
    }
    let smooth = smoothed(luma);
    let values = smooth.data();
    let gradient = |x: usize, y: usize| -> [f32; 2] {
        let i = y * w + x;
        [0.5 * (values[i + 1] - values[i - 1]), 0.5 * (values[i + w] - values[i - w])]
    };
    let slope = |x: usize, y: usize| -> f32 {
        let [gx, gy] = gradient(x, y);
        (gx * gx + gy * gy).sqrt()
    };
    let blocked = |x: usize, y: usize| {
        let outside = |mask: &Mask| {
            let rows = y - AROUND..=y + AROUND;
            rows.into_iter().any(|row| mask.row(0, row)[x - AROUND..=x + AROUND].contains(&0))
        };
        mask.is_some_and(outside)
    };
    let mut found: Vec<(f32, _)> = (AROUND..h - AROUND)
        .into_par_iter()
        .flat_map_iter(|y| {
            (AROUND..w - AROUND).filter_map(move |x| {
                let [gx, gy] = gradient(x, y);
                let own = (gx * gx + gy * gy).sqrt();
                if own < LEAST_SLOPE {
                    return None;
                }
                // The neighbours across the edge, among the eight.
                let step = |along: f32, other: f32| -> isize {
                    if along.abs() < 0.414 * other.abs() { 0 } else { along.signum() as isize }
                };
                let (dx, dy) = (step(gx, gy), step(gy, gx));
                let ahead = slope(x.saturating_add_signed(dx), y.saturating_add_signed(dy));
                let behind = slope(x.saturating_add_signed(-dx), y.saturating_add_signed(-dy));
                if own < behind || own <= ahead {
                    return None;
                }
                let [mut a, mut b, mut c] = [0.0f32; 3];
                for v in y - 4..=y + 4 {
                    for u in x - 4..=x + 4 {
                        let [gx, gy] = gradient(u, v);
                        (a, b, c) = (a + gx * gx, b + gx * gy, c + gy * gy);
                    }
                }
                let spread = ((a - c) * (a - c) + 4.0 * b * b).sqrt();
                let straightness = spread / (a + c).max(f32::MIN_POSITIVE);
                if straightness < LEAST_STRAIGHTNESS || blocked(x, y) {
                    return None;
                }
                // The eigenvector of the larger eigenvalue, towards brighter pixels.
                let of_first = [f64::from(a - c + spread), f64::from(2.0 * b)];
                let of_second = [f64::from(2.0 * b), f64::from(c - a + spread)];
                let [nx, ny] = if a >= c { of_first } else { of_second };
                let bright = f64::from(gx) * nx + f64::from(gy) * ny;
                let scale = bright.signum() / (nx * nx + ny * ny).sqrt();
                let at = [x as f64, y as f64];
                let place = (at, [nx * scale, ny * scale]);
                Some((own * straightness, ((place, f64::from(straightness)), at)))
            })
        })
        .collect();
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.into_iter().map(|(_, place)| place).collect()
}

/// Those that are at least `distance` from all that were kept before them.
fn apart<T>(all: Vec<(T, [f64; 2])>, distance: f64) -> Vec<T> {
    let cell = |at: [f64; 2]| at.map(|v| (v / distance) as i64);
    let mut kept = std::collections::BTreeMap::<[i64; 2], Vec<[f64; 2]>>::new();
    all.into_iter()
        .filter_map(|(one, at)| {
            let [x, y] = cell(at);
            let near = |other: &[f64; 2]| {
                math::powi(other[0] - at[0], 2) + math::powi(other[1] - at[1], 2) < distance * distance
            };
            let cells = (x - 1..=x + 1).flat_map(|x| (y - 1..=y + 1).map(move |y| [x, y]));
            if cells.into_iter().filter_map(|cell| kept.get(&cell)).flatten().any(near) {
                return None;
            }
            kept.entry([x, y]).or_default().push(at);
            Some(one)
        })
        .collect()
}

/// The edge at a place, if its profile is a step.
fn edge(luma: &Map, (at, normal): ([f64; 2], [f64; 2]), straightness: f64) -> Option<StepEdge> {
    let profile_of = |lines| profile(luma, at, normal, lines);
    let whole = profile_of(-LINES..=LINES);
    let Rise { dark, bright, middle, width } = rise(&whole, 0.0)?;
    let contrast = bright - dark;
    if contrast < LEAST_CONTRAST || width > WIDEST || middle.abs() > OFF_MIDDLE[0] {
        return None;
    }
    let [uneven, fall, off] = ROUGHEST.map(|share| share * contrast);
    let rough = |values: &[f64], mean: f64| {
        values.iter().map(|v| math::powi(v - mean, 2)).sum::<f64>() > PLATEAU as f64 * uneven * uneven
    };
    if rough(&whole[..PLATEAU], dark) || rough(&whole[POSITIONS - PLATEAU..], bright) {
        return None;
    }
    let mut highest = f64::NEG_INFINITY;
    let falls = |v: &f64| {
        highest = highest.max(*v);
        highest - v > fall
    };
    if whole.iter().any(falls) {
        return None;
    }
    let ideal = |i: usize| {
        let z = (position(i) - middle) * WIDTH_OF_SIGMA / width;
        dark + contrast / (1.0 + math::exp(-LOGISTIC * z))
    };
    let squares: f64 = whole.iter().enumerate().map(|(i, v)| math::powi(v - ideal(i), 2)).sum();
    if squares > POSITIONS as f64 * off * off {
        return None;
    }
    let thirds = [-LINES..=-2, -1..=1, 2..=LINES];
    for lines in thirds {
        let third = rise(&profile_of(lines), middle)?;
        if (third.middle - middle).abs() > OFF_MIDDLE[1] {
            return None;
        }
    }
    Some(StepEdge { at, normal, strength: straightness * contrast, contrast, width, middle })
}

/// Distance of a profile's position from its place along the normal, pixels.
fn position(i: usize) -> f64 {
    0.5 * i as f64 - REACH
}

/// The profile across an edge, the mean of some lines.
fn profile(
    luma: &Map,
    [x, y]: [f64; 2],
    [nx, ny]: [f64; 2],
    lines: std::ops::RangeInclusive<isize>,
) -> [f64; POSITIONS] {
    let mut profile = [0.0; POSITIONS];
    let count = lines.clone().count() as f64;
    for line in lines {
        let along = line as f64;
        for (i, sum) in profile.iter_mut().enumerate() {
            let across = position(i);
            *sum += cubic(luma, x + across * nx - along * ny, y + across * ny + along * nx) / count;
        }
    }
    profile
}

/// The map between its pixels: Catmull and Rom's cubic in both directions. The 4 × 4 pixels are inside.
fn cubic(map: &Map, x: f64, y: f64) -> f64 {
    let weights = |t: f64| {
        let (t2, t3) = (t * t, t * t * t);
        [-0.5 * t + t2 - 0.5 * t3, 1.0 - 2.5 * t2 + 1.5 * t3, 0.5 * t + 2.0 * t2 - 1.5 * t3, 0.5 * (t3 - t2)]
    };
    let (left, top) = (x.floor(), y.floor());
    let (across, down) = (weights(x - left), weights(y - top));
    let (left, top) = (left as usize - 1, top as usize - 1);
    let mut sum = 0.0;
    for (k, down) in down.iter().enumerate() {
        let row = &map.row(0, top + k)[left..left + 4];
        sum += down * row.iter().zip(&across).map(|(v, weight)| weight * f64::from(*v)).sum::<f64>();
    }
    sum
}

/// The rise of a profile from its left to its right plateau, at the crossing of the middle that is nearest to
/// a position; `None` if it does not rise.
fn rise(profile: &[f64; POSITIONS], near: f64) -> Option<Rise> {
    let mean = |values: &[f64]| values.iter().sum::<f64>() / PLATEAU as f64;
    let (dark, bright) = (mean(&profile[..PLATEAU]), mean(&profile[POSITIONS - PLATEAU..]));
    if bright <= dark {
        return None;
    }
    let share = |i: usize| (profile[i] - dark) / (bright - dark);
    // The place of a share between two neighbouring positions.
    let between = |i: usize, level: f64| {
        let (a, b) = (share(i), share(i + 1));
        position(i) + 0.5 * ((level - a) / (b - a)).clamp(0.0, 1.0)
    };
    let crossings = (0..POSITIONS - 1).filter(|i| share(*i) < 0.5 && share(*i + 1) >= 0.5);
    let distance = |i: &usize| (between(*i, 0.5) - near).abs();
    let at = crossings.min_by(|a, b| distance(a).total_cmp(&distance(b)))?;
    let low = (0..=at).rev().find(|i| share(*i) < 0.1).map_or(-REACH, |i| between(i, 0.1));
    let high = (at..POSITIONS - 1).find(|i| share(*i + 1) > 0.9).map_or(REACH, |i| between(i, 0.9));
    Some(Rise { dark, bright, middle: between(at, 0.5), width: high - low })
}

#[cfg(test)]
mod tests;
