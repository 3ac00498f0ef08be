//! Other photographs of the same cameras: for example 16-bit files of a raw developer.
//!
//! The scene knows the colours of the photographs that it was made from. Those of another development `Q` are
//! brought there first, by a curve for each channel and an affine map of colours:
//!
//! ```text
//! P ≈ A c(Q) + b,       c_i rising, linear between [`KNOTS`] values (k / [`KNOTS`] − 1)² of Q
//! ```
//!
//! Fitted over all views at once, by turns: `A`, `b` of least squares for the curves, then each curve of
//! least squares for `A⁻¹ (P − b)`, made to rise. `P` is the stage-1 render, and both are means over windows,
//! so that sharpness does not count. All values are in display range.

use use3d_capture::Image;

use crate::boxes::{mean, symmetric_inverse};
use crate::known::radius;

/// Values of a curve.
const KNOTS: usize = 17;
/// Radius of the windows, as a share of the width, and pixels between samples.
const WINDOW: (f64, usize) = (0.012, 5);
/// Rounds of curves and map.
const ROUNDS: usize = 8;
/// Share of the scene's own spread of colours that other pictures are apart and the same pictures are not,
/// and the least such difference (mean over the channels).
const STRANGE: (f64, f64) = (0.6, 0.03);

/// A change of colours from another development to that of the scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Development {
    curves: [[f32; KNOTS]; 3],
    rows: [[f32; 4]; 3],
}

/// ColourPairs of colours of one view: of the other photograph, and of the scene.
#[derive(Clone, Debug, Default)]
pub struct ColourPairs(Vec<([f64; 3], [f64; 3])>);

impl ColourPairs {
    /// ColourPairs from a photograph and the stage-1 render of its view, of one size.
    pub fn of(photograph: &Image, render: &Image) -> Self {
        let (w, h, n) = (photograph.width(), photograph.height(), photograph.pixels());
        let smooth = |image: &Image| {
            let mut planes = image.data().to_vec();
            planes.chunks_exact_mut(n.max(1)).for_each(|plane| mean(plane, w, radius(w, WINDOW.0, 2)));
            planes
        };
        let (p, r) = (smooth(photograph), smooth(render));
        let at = |planes: &[f32], i: usize| [0, 1, 2].map(|c| f64::from(planes[c * n + i]));
        let places = (0..h).step_by(WINDOW.1).flat_map(|y| (0..w).step_by(WINDOW.1).map(move |x| y * w + x));
        Self(places.map(|i| (at(&p, i), at(&r, i))).collect())
    }

    /// The mean difference from the scene after a change; `None` for no change.
    pub fn apart(&self, by: Option<&Development>) -> f64 {
        let one = |(q, p): &([f64; 3], [f64; 3])| {
            let q = by.map_or(*q, |by| by.of(q.map(|v| v as f32)).map(f64::from));
            (0..3).map(|c| (q[c] - p[c]).abs()).sum::<f64>() / 3.0
        };
        self.0.iter().map(one).sum::<f64>() / self.0.len().max(1) as f64
    }
}

/// The value of a knot.
#[inline(always)]
fn knot(k: usize) -> f64 {
    let share = k as f64 / (KNOTS - 1) as f64;
    share * share
}

/// For each view, whether it shows something else than the scene: neither as it is nor after a change do its
/// colours follow the scene's.
pub fn strange(views: &[ColourPairs], by: &Development) -> Vec<bool> {
    let all = || views.iter().flat_map(|pairs| &pairs.0).map(|(_, p)| *p);
    let count = all().count().max(1) as f64;
    let mean: [f64; 3] = std::array::from_fn(|c| all().map(|p| p[c]).sum::<f64>() / count);
    let spread =
        all().map(|p| (0..3).map(|c| (p[c] - mean[c]).abs()).sum::<f64>() / 3.0).sum::<f64>() / count;
    let limit = STRANGE.1.max(STRANGE.0 * spread);
    views.iter().map(|pairs| pairs.apart(Some(by)).min(pairs.apart(None)) > limit).collect()
}

/// The place of a value among the knots: the one before, and the share of the next.
fn place(value: f64) -> (usize, f64) {
    let at = value.clamp(0.0, 1.0).sqrt() * (KNOTS - 1) as f64;
    let first = (at as usize).min(KNOTS - 2);
    (first, (value - knot(first)) / (knot(first + 1) - knot(first)))
}

impl Development {
    /// The change of least squares over all views.
    pub fn fit(views: &[ColourPairs]) -> Self {
        let pairs: Vec<&([f64; 3], [f64; 3])> = views.iter().flat_map(|pairs| &pairs.0).collect();
        let mut curves = [std::array::from_fn::<f64, KNOTS, _>(knot); 3];
        let mut rows = [[0.0f64; 4]; 3];
        for _ in 0..ROUNDS {
            let value = |c: usize, v: f64| {
                let (k, share) = place(v);
                curves[c][k] + share * (curves[c][k + 1] - curves[c][k])
            };
            let bent = pairs.iter().map(|(q, p)| ([0, 1, 2].map(|c| value(c, q[c])), *p));
            rows = affine(bent);
            let Some(back) = inverse(&rows) else { break };
            for (c, curve) in curves.iter_mut().enumerate() {
                let wanted = pairs.iter().map(|(q, p)| {
                    let target = (0..3).map(|j| back[c][j] * (p[j] - rows[j][3])).sum::<f64>();
                    (q[c], target)
                });
                *curve = rising(wanted, curve);
            }
        }
        let curves = curves.map(|curve| curve.map(|v| v as f32));
        Self { curves, rows: rows.map(|row| row.map(|v| v as f32)) }
    }

    /// A photograph of the other development in the colours of the scene.
    #[must_use]
    pub fn on(&self, photograph: &Image) -> Image {
        let mut out = photograph.clone();
        let n = out.pixels();
        for i in 0..n {
            let q = [0, 1, 2].map(|c| photograph.data()[c * n + i]);
            self.of(q).into_iter().enumerate().for_each(|(c, v)| out.data_mut()[c * n + i] = v);
        }
        out
    }

    /// A colour of the other development in that of the scene.
    #[inline(always)]
    pub fn of(&self, q: [f32; 3]) -> [f32; 3] {
        let bent: [f32; 3] = std::array::from_fn(|c| {
            let at = q[c].clamp(0.0, 1.0).sqrt() * (KNOTS - 1) as f32;
            let first = (at as usize).min(KNOTS - 2);
            let step = 1.0 / (KNOTS - 1) as f32;
            let (low, high) = (first as f32 * step, (first + 1) as f32 * step);
            let share = (q[c] - low * low) / (high * high - low * low);
            self.curves[c][first] + share * (self.curves[c][first + 1] - self.curves[c][first])
        });
        self.rows.map(|row| row[0] * bent[0] + row[1] * bent[1] + row[2] * bent[2] + row[3])
    }
}

/// Rows `A | b` of least squares.
fn affine(pairs: impl Iterator<Item = ([f64; 3], [f64; 3])> + Clone) -> [[f64; 4]; 3] {
    let count = pairs.clone().count().max(1) as f64;
    let (mut mean_q, mut mean_p) = ([0.0f64; 3], [0.0f64; 3]);
    for (q, p) in pairs.clone() {
        (0..3).for_each(|c| (mean_q[c], mean_p[c]) = (mean_q[c] + q[c] / count, mean_p[c] + p[c] / count));
    }
    let (mut qq, mut pq) = ([[0.0f64; 3]; 3], [[0.0f64; 3]; 3]);
    for (q, p) in pairs {
        for i in 0..3 {
            for j in 0..3 {
                qq[i][j] += (q[i] - mean_q[i]) * (q[j] - mean_q[j]) / count;
                pq[i][j] += (p[i] - mean_p[i]) * (q[j] - mean_q[j]) / count;
            }
        }
    }
    // The ridge keeps colours that do not vary on their own gain.
    let ridge = 1e-5;
    for c in 0..3 {
        qq[c][c] += ridge;
        pq[c][c] += ridge * (mean_p[c] / mean_q[c].max(0.01)).clamp(0.1, 10.0);
    }
    let back = symmetric_inverse(&qq);
    std::array::from_fn(|i| {
        let row: [f64; 3] = std::array::from_fn(|j| (0..3).map(|k| pq[i][k] * back[k][j]).sum());
        [row[0], row[1], row[2], mean_p[i] - (0..3).map(|j| row[j] * mean_q[j]).sum::<f64>()]
    })
}

/// The inverse of `A`; `None` if there is none.
fn inverse(rows: &[[f64; 4]; 3]) -> Option<[[f64; 3]; 3]> {
    let a = glam::DMat3::from_cols_array_2d(&std::array::from_fn(|j| std::array::from_fn(|i| rows[i][j])));
    let inverse = a.inverse();
    (a.determinant().abs() > 1e-9).then(|| std::array::from_fn(|i| inverse.row(i).to_array()))
}

/// The rising curve of least squares through pairs of argument and value, held at `before` where there are
/// hardly any.
fn rising(pairs: impl Iterator<Item = (f64, f64)>, before: &[f64; KNOTS]) -> [f64; KNOTS] {
    // Weighted means of the values near each knot, corrected by the slope of the curve before.
    let mut sums = [[1e-3f64, 0.0]; KNOTS];
    let (mut total, mut count) = (0.0, 1e-9);
    for (x, y) in pairs {
        let (k, share) = place(x);
        let share = share.clamp(0.0, 1.0);
        let now = before[k] + share * (before[k + 1] - before[k]);
        for (knot, weight) in [(k, 1.0 - share), (k + 1, share)] {
            sums[knot][0] += weight;
            sums[knot][1] += weight * (y - now);
        }
        (total, count) = (total + y - now, count + 1.0);
    }
    let offset = total / count;
    let curve: [f64; KNOTS] = std::array::from_fn(|k| {
        let [weight, sum] = sums[k];
        // Knots without pairs move with the others.
        before[k] + if weight < 5.0 { offset } else { sum / weight }
    });
    // Neighbours that fall are pooled.
    let mut pools: Vec<(f64, f64, usize)> = Vec::new();
    for (k, value) in curve.into_iter().enumerate() {
        pools.push((value, sums[k][0], 1));
        while let [.., (a, wa, na), (b, wb, nb)] = pools[..] {
            if a <= b {
                break;
            }
            pools.truncate(pools.len() - 2);
            pools.push(((a * wa + b * wb) / (wa + wb), wa + wb, na + nb));
        }
    }
    let mut values = pools.iter().flat_map(|(value, _, n)| std::iter::repeat_n(*value, *n));
    std::array::from_fn(|_| values.next().unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use use3d_numerics::random::{Purpose, Stream};

    use super::*;

    /// Stones of many colours.
    fn stones(seed: u64) -> Image {
        let draw = Stream::new(seed, Purpose::new("stones"), 0);
        let mut image = Image::new(160, 120);
        for y in 0..120 {
            for x in 0..160 {
                let of =
                    |c: usize| draw.uniform(((c * 100 + y / 12) * 100 + x / 12) as u64) as f32 * 0.8 + 0.05;
                image.set_pixel(x, y, [of(0), of(1), of(2)]);
            }
        }
        image
    }

    /// Another development: linear light, with other primaries.
    fn developed(image: &Image) -> Image {
        let mut out = image.clone();
        for y in 0..image.height() {
            for x in 0..image.width() {
                let [r, g, b] = image.pixel(x, y);
                let mixed = [0.9 * r + 0.08 * g, 0.05 * r + 0.85 * g + 0.03 * b, 0.1 * g + 0.8 * b];
                out.set_pixel(x, y, mixed.map(|v| v * v));
            }
        }
        out
    }

    #[test]
    fn another_development_is_brought_to_the_colours_of_the_scene() {
        let views: Vec<ColourPairs> =
            (0..4).map(|k| ColourPairs::of(&developed(&stones(k)), &stones(k))).collect();
        let found = Development::fit(&views);
        for view in &views {
            assert!(view.apart(None) > 0.1, "{}", view.apart(None));
            assert!(view.apart(Some(&found)) < 0.02, "{}", view.apart(Some(&found)));
        }
        assert!(strange(&views, &found).iter().all(|strange| !strange));
        // The curves rise.
        assert!(found.curves.iter().all(|curve| curve.windows(2).all(|pair| pair[0] <= pair[1])));
        // Other pictures stay strange.
        let others: Vec<ColourPairs> = (0..4).map(|k| ColourPairs::of(&stones(k + 50), &stones(k))).collect();
        let found = Development::fit(&others);
        assert!(strange(&others, &found).iter().all(|strange| *strange));
    }

    #[test]
    fn the_same_photographs_need_no_change() {
        let views = [ColourPairs::of(&stones(1), &stones(1).map(|v| v + 0.01))];
        assert!(views[0].apart(None) < 0.011);
    }
}
