//! The correlation of all pairs of pixels, evaluated without storing the full volume.
//!
//! The correlation of pixel p of the first picture with pixel q of the second is ⟨f₁(p), f₂(q)⟩/√256. The
//! pyramid halves the second picture's axes by 2×2 means, which by linearity is the correlation with the
//! halved features f₂. A lookup at (x, y) in level l reads the values at (x/2ˡ + i − 4, y/2ˡ + j − 4) for i,
//! j in 0..9, bilinear with zeros outside. All 81 samples have the same fractional parts, so 10 × 10 products
//! at whole positions are enough. The full volume at 1400×933 would take 2.2 GB; this code stores only the
//! features.

use fearless_simd::{Level, Simd, dispatch, f32x16, prelude::*};
use rayon::prelude::*;

use crate::engine::planes::Planes;
use crate::engine::pool;

const LEVELS: usize = 4;
const RADIUS: isize = 4;
const WINDOW: usize = 9;
const CORNERS: usize = WINDOW + 1;
const FEATURES: usize = 256;
/// Number of channels of a lookup.
pub(crate) const CHANNELS: usize = LEVELS * WINDOW * WINDOW;

/// Features of both pictures, `[pixel][feature]`; those of the second at four sizes.
#[derive(Clone, Debug)]
pub(crate) struct Correlation {
    height: usize,
    width: usize,
    first: Vec<f32>,
    pyramid: Vec<LevelFeatures>,
}

#[derive(Clone, Debug)]
struct LevelFeatures {
    height: usize,
    width: usize,
    values: Vec<f32>,
}

impl Correlation {
    pub(crate) fn new(first: &Planes, second: Planes) -> Self {
        let (height, width) = (first.height, first.width);
        let mut pyramid = Vec::with_capacity(LEVELS);
        let mut level = second;
        for l in 0..LEVELS {
            if l > 0 {
                level = pool::halve(&level);
            }
            pyramid.push(LevelFeatures {
                height: level.height,
                width: level.width,
                values: features_last(&level, 1.0),
            });
        }
        let scale = 1.0 / (FEATURES as f32).sqrt();
        Self { height, width, first: features_last(first, scale), pyramid }
    }

    /// The samples around p + flow(p) for every pixel p: `[CHANNELS, height, width]`, channel l·81 + 9i + j,
    /// i along x.
    pub(crate) fn lookup(&self, flow: &Planes) -> Planes {
        let level = Level::new();
        let area = self.height * self.width;
        let mut samples = vec![0.0f32; area * CHANNELS];
        samples.par_chunks_mut(CHANNELS).enumerate().for_each(|(p, out)| {
            let x = (p % self.width) as f32 + flow.data[p];
            let y = (p / self.width) as f32 + flow.data[area + p];
            let first = &self.first[p * FEATURES..(p + 1) * FEATURES];
            for (l, out) in out.chunks_exact_mut(WINDOW * WINDOW).enumerate() {
                let scale = 1.0 / (1 << l) as f32;
                let features = &self.pyramid[l];
                dispatch!(level, simd => sample(simd, first, features, x * scale, y * scale, out));
            }
        });
        let mut out = Planes::new(CHANNELS, self.height, self.width);
        out.data.par_chunks_mut(area).enumerate().for_each(|(c, plane)| {
            for (p, o) in plane.iter_mut().enumerate() {
                *o = samples[p * CHANNELS + c];
            }
        });
        out
    }
}

/// The 9 × 9 samples around (x, y) of one level.
#[inline(always)]
fn sample<S: Simd>(simd: S, first: &[f32], second: &LevelFeatures, x: f32, y: f32, out: &mut [f32]) {
    let (x0, y0) = (x.floor(), y.floor());
    let (tx, ty) = (x - x0, y - y0);
    // Casts saturate, so that even an extreme flow only gives a position outside the picture.
    let (left, top) = ((x0 as isize).saturating_sub(RADIUS), (y0 as isize).saturating_sub(RADIUS));
    // corners[i][j] is the product at column left + i, row top + j.
    let mut corners = [[0.0f32; CORNERS]; CORNERS];
    for (j, row) in (0..CORNERS).map(|j| (j, top.saturating_add(j as isize))) {
        if row < 0 || row >= second.height as isize {
            continue;
        }
        for (i, corners) in corners.iter_mut().enumerate() {
            let column = left.saturating_add(i as isize);
            if column >= 0 && column < second.width as isize {
                let q = row as usize * second.width + column as usize;
                corners[j] = dot(simd, first, &second.values[q * FEATURES..(q + 1) * FEATURES]);
            }
        }
    }
    for i in 0..WINDOW {
        for j in 0..WINDOW {
            let near = corners[i][j] * (1.0 - ty) + corners[i][j + 1] * ty;
            let far = corners[i + 1][j] * (1.0 - ty) + corners[i + 1][j + 1] * ty;
            out[i * WINDOW + j] = near * (1.0 - tx) + far * tx;
        }
    }
}

/// The product of two feature vectors, in 64 interleaved partial sums.
#[inline(always)]
fn dot<S: Simd>(simd: S, a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [f32x16::splat(simd, 0.0); 4];
    for (a, b) in a.as_chunks::<64>().0.iter().zip(b.as_chunks::<64>().0) {
        for v in 0..4 {
            let a = f32x16::from_slice(simd, &a[16 * v..16 * v + 16]);
            let b = f32x16::from_slice(simd, &b[16 * v..16 * v + 16]);
            sums[v] = a.mul_add(b, sums[v]);
        }
    }
    let total = (sums[0] + sums[1]) + (sums[2] + sums[3]);
    let mut lanes = [0.0f32; 16];
    total.store_slice(&mut lanes);
    for half in [8, 4, 2, 1] {
        for i in 0..half {
            lanes[i] += lanes[i + half];
        }
    }
    lanes[0]
}

/// Converts `[feature][pixel]` to `[pixel][feature]`, scaled.
fn features_last(planes: &Planes, scale: f32) -> Vec<f32> {
    let area = planes.area();
    let mut out = vec![0.0; area * planes.channels];
    out.par_chunks_mut(planes.channels).enumerate().for_each(|(p, features)| {
        for (c, f) in features.iter_mut().enumerate() {
            *f = planes.data[c * area + p] * scale;
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::noise;

    #[test]
    fn equals_the_stored_volume_also_at_borders_and_far_outside() {
        let (height, width) = (17, 19);
        let area = height * width;
        let a = Planes::from_data(FEATURES, height, width, noise(1, FEATURES * area));
        let b = Planes::from_data(FEATURES, height, width, noise(2, FEATURES * area));
        let flow: Vec<f32> = noise(3, 2 * area).iter().map(|v| 14.0 * v).collect();
        let mut flow = Planes::from_data(2, height, width, flow);
        flow.data[5] = 1e30;
        flow.data[area + 6] = -1e30;
        let found = Correlation::new(&a, b.clone()).lookup(&flow);
        for p in (0..area).step_by(7).chain([5, 6]) {
            // The volume's row for p, pooled level by level.
            let volume: Vec<f32> = (0..area)
                .map(|q| {
                    let sum: f64 = (0..FEATURES)
                        .map(|c| f64::from(a.data[c * area + p]) * f64::from(b.data[c * area + q]))
                        .sum();
                    (sum / 16.0) as f32
                })
                .collect();
            let mut level = Planes::from_data(1, height, width, volume);
            for l in 0..LEVELS {
                if l > 0 {
                    level = pool::halve(&level);
                }
                let at = |x: f64, y: f64| {
                    if x < 0.0 || y < 0.0 || x >= level.width as f64 || y >= level.height as f64 {
                        return 0.0;
                    }
                    f64::from(level.data[y as usize * level.width + x as usize])
                };
                let scale = 1.0 / f64::from(1 << l);
                let x = f64::from((p % width) as f32 + flow.data[p]) * scale;
                let y = f64::from((p / width) as f32 + flow.data[area + p]) * scale;
                for i in 0..WINDOW {
                    for j in 0..WINDOW {
                        let (sx, sy) = (x + i as f64 - 4.0, y + j as f64 - 4.0);
                        let (x0, y0) = (sx.floor(), sy.floor());
                        let (tx, ty) = (sx - x0, sy - y0);
                        let expected = (at(x0, y0) * (1.0 - tx) + at(x0 + 1.0, y0) * tx) * (1.0 - ty)
                            + (at(x0, y0 + 1.0) * (1.0 - tx) + at(x0 + 1.0, y0 + 1.0) * tx) * ty;
                        let actual = found.data[((l * WINDOW + i) * WINDOW + j) * area + p];
                        assert!(
                            (f64::from(actual) - expected).abs() < 2e-5,
                            "{actual} instead of {expected}"
                        );
                    }
                }
            }
        }
    }
}
