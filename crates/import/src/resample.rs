//! Resizes images and adapts the intrinsics: output pixel centre `(x, y)` shows the source at `((x + left) /
//! sx, (y + top) / sy)`.
//!
//! Shrinking averages exactly the source area that an output pixel covers (2 x 2 boxes at one half),
//! enlarging interpolates linearly; both are separable and in f32. Shrinking depths averages only known
//! (positive) values; enlarging them takes the nearest pixel.

use use3d_capture::{Intrinsics, Map, Raster};

/// A scale and a crop.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Resize {
    pub(crate) sx: f64,
    pub(crate) sy: f64,
    pub(crate) left: f64,
    pub(crate) top: f64,
    pub(crate) width: usize,
    pub(crate) height: usize,
}

impl Resize {
    /// Scales to cover `width × height` and crops centrally.
    pub(crate) fn cover(from: (usize, usize), width: usize, height: usize) -> Self {
        let (w, h) = (from.0 as f64, from.1 as f64);
        let s = (width as f64 / w).max(height as f64 / h);
        let (left, top) = (0.5 * (w * s - width as f64), 0.5 * (h * s - height as f64));
        Self { sx: s, sy: s, left, top, width, height }
    }

    /// Divides each side by `divisor`, rounded down (the rest is cut off on the right and at the bottom).
    pub(crate) fn fraction(from: (usize, usize), divisor: usize) -> Self {
        let s = 1.0 / divisor as f64;
        let (width, height) = ((from.0 / divisor).max(1), (from.1 / divisor).max(1));
        Self { sx: s, sy: s, left: 0.0, top: 0.0, width, height }
    }

    /// The whole picture at a size.
    pub(crate) fn whole(from: (usize, usize), width: usize, height: usize) -> Self {
        let (sx, sy) = (width as f64 / from.0 as f64, height as f64 / from.1 as f64);
        Self { sx, sy, left: 0.0, top: 0.0, width, height }
    }

    /// True if nothing changes.
    pub(crate) fn is_identity(&self, from: (usize, usize)) -> bool {
        *self == Self { sx: 1.0, sy: 1.0, left: 0.0, top: 0.0, width: from.0, height: from.1 }
    }

    /// The intrinsics of the resized picture.
    pub(crate) fn intrinsics(&self, k: &Intrinsics) -> Intrinsics {
        k.scaled(self.sx, self.sy, k.width, k.height).cropped(self.left, self.top, self.width, self.height)
    }

    pub(crate) fn apply<T: Copy + Into<f32>, const C: usize>(&self, source: &Raster<T, C>) -> Raster<f32, C> {
        let columns = Taps::new(source.width(), self.width, self.sx, self.left);
        let rows = Taps::new(source.height(), self.height, self.sy, self.top);
        let (w, h) = (source.width(), source.height());
        let mut out = Raster::<f32, C>::new(self.width, self.height);
        // Only the rows that some output row reads are resampled horizontally.
        let mut squeezed = vec![0.0f32; self.width * h];
        for c in 0..C {
            for y in rows.range.0..rows.range.1 {
                let row = source.row(c, y);
                debug_assert_eq!(row.len(), w);
                for x in 0..self.width {
                    squeezed[y * self.width + x] = columns.read(x, |i| row[i].into());
                }
            }
            let plane = out.plane_mut(c);
            for y in 0..self.height {
                let target = &mut plane[y * self.width..(y + 1) * self.width];
                let (start, weights) = rows.at(y);
                for (k, &weight) in weights.iter().enumerate() {
                    let from = &squeezed[(start + k) * self.width..(start + k + 1) * self.width];
                    for (t, f) in target.iter_mut().zip(from) {
                        *t += weight * f;
                    }
                }
            }
        }
        out
    }

    /// Resizes depths, in which 0 is unknown.
    pub(crate) fn apply_to_depth(&self, source: &Map) -> Map {
        let (w, h) = (source.width(), source.height());
        if self.sx > 1.0 || self.sy > 1.0 {
            let mut out = Map::new(self.width, self.height);
            let at = |i: usize, offset: f64, scale: f64, n: usize| {
                (((i as f64 + 0.5 + offset) / scale).max(0.0) as usize).min(n - 1)
            };
            for y in 0..self.height {
                let sy = at(y, self.top, self.sy, h);
                for x in 0..self.width {
                    out.set_pixel(x, y, source.pixel(at(x, self.left, self.sx, w), sy));
                }
            }
            return out;
        }
        let known = source.map(|v| f32::from(v > 0.0));
        let (sum, share) = (self.apply(&source.map(|v| v.max(0.0))), self.apply(&known));
        let mut out = sum;
        for (v, s) in out.data_mut().iter_mut().zip(share.data()) {
            *v = if *s > 0.0 { *v / *s } else { 0.0 };
        }
        out
    }
}

/// For each output position along one axis: the first source index, and the weights from there on (they sum
/// to 1).
struct Taps {
    starts: Vec<usize>,
    ends: Vec<usize>,
    weights: Vec<f32>,
    /// The range of source indices that are read at all.
    range: (usize, usize),
}

impl Taps {
    fn new(source: usize, target: usize, scale: f64, offset: f64) -> Self {
        let mut taps = Self { starts: Vec::new(), ends: Vec::new(), weights: Vec::new(), range: (source, 0) };
        for i in 0..target {
            let (low, high) = if scale < 1.0 {
                ((i as f64 + offset) / scale, (i as f64 + 1.0 + offset) / scale)
            } else {
                // One source pixel wide about the centre: its overlaps are the linear weights.
                let center = (i as f64 + 0.5 + offset) / scale;
                (center - 0.5, center + 0.5)
            };
            let last = (source - 1) as f64;
            let first = low.floor().clamp(0.0, last) as usize;
            // The small number prevents an empty tap by a rounding error.
            let end = ((high - 1e-9).ceil().clamp(1.0, last + 1.0) as usize).max(first + 1);
            let overlap = |j: usize| {
                // The outermost pixels extend beyond the edge.
                let left = if j == 0 { f64::NEG_INFINITY } else { j as f64 };
                let right = if j + 1 == source { f64::INFINITY } else { j as f64 + 1.0 };
                (high.min(right) - low.max(left)).max(0.0)
            };
            let total: f64 = (first..end).map(overlap).sum();
            taps.starts.push(first);
            for j in first..end {
                taps.weights
                    .push(if total > 0.0 { overlap(j) / total } else { 1.0 / (end - first) as f64 } as f32);
            }
            taps.ends.push(taps.weights.len());
            taps.range = (taps.range.0.min(first), taps.range.1.max(end));
        }
        taps
    }

    fn at(&self, i: usize) -> (usize, &[f32]) {
        let begin = if i == 0 { 0 } else { self.ends[i - 1] };
        (self.starts[i], &self.weights[begin..self.ends[i]])
    }

    fn read(&self, i: usize, value: impl Fn(usize) -> f32) -> f32 {
        let (start, weights) = self.at(i);
        weights.iter().enumerate().map(|(k, w)| w * value(start + k)).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn one_half_is_the_mean_of_two_by_two_boxes() {
        let source = Map::from_planes(4, 2, vec![0.0, 2.0, 10.0, 20.0, 4.0, 6.0, 30.0, 40.0]).unwrap();
        let out = Resize::fraction((4, 2), 2).apply(&source);
        assert_eq!(out.data(), [3.0, 25.0]);
        // The odd column is dropped, and the intrinsics agree with those of the image pyramid.
        let resize = Resize::fraction((5, 3), 2);
        assert_eq!((resize.width, resize.height), (2, 1));
        let k = Intrinsics { width: 5, height: 3, fx: 7.0, fy: 8.0, cx: 2.4, cy: 1.3 };
        assert_eq!(resize.intrinsics(&k), k.downscaled(2));
    }

    #[test]
    fn cover_crops_centrally_and_moves_the_principal_point() {
        let resize = Resize::cover((200, 100), 50, 50);
        assert_eq!((resize.sx, resize.left, resize.top), (0.5, 25.0, 0.0));
        let k = Intrinsics { width: 200, height: 100, fx: 80.0, fy: 80.0, cx: 100.0, cy: 50.0 };
        let k = resize.intrinsics(&k);
        assert_eq!((k.width, k.height, k.fx, k.cx, k.cy), (50, 50, 40.0, 25.0, 25.0));
        assert!(Resize::cover((50, 20), 50, 20).is_identity((50, 20)));
    }

    #[test]
    fn unknown_depths_do_not_dilute_known_ones() {
        let source = Map::from_planes(4, 1, vec![3.0, 0.0, 0.0, 0.0]).unwrap();
        let out =
            Resize { sx: 0.5, sy: 1.0, left: 0.0, top: 0.0, width: 2, height: 1 }.apply_to_depth(&source);
        assert_eq!(out.data(), [3.0, 0.0]);
        let out = Resize::whole((4, 1), 8, 1).apply_to_depth(&source);
        assert_eq!(out.data(), [3.0, 3.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    }

    proptest! {
        /// A linear ramp of pixel positions stays the same ramp, so the resampling and the intrinsics agree.
        #[test]
        fn a_ramp_shows_where_each_pixel_came_from(w in 8usize..60, h in 8usize..60, tw in 4usize..120, th in 4usize..120) {
            let mut ramp = Raster::<f32, 2>::new(w, h);
            for y in 0..h {
                for x in 0..w {
                    ramp.set_pixel(x, y, [x as f32 + 0.5, y as f32 + 0.5]);
                }
            }
            let resize = Resize::cover((w, h), tw, th);
            let out = resize.apply(&ramp);
            let k = Intrinsics { width: w, height: h, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
            let k = resize.intrinsics(&k);
            for y in 0..th {
                for x in 0..tw {
                    let expected = [(x as f64 + 0.5 - k.cx) / k.fx, (y as f64 + 0.5 - k.cy) / k.fy];
                    let found = out.pixel(x, y);
                    for axis in 0..2 {
                        let n = [w, h][axis] as f64;
                        // Beyond the outermost centres the edge values continue.
                        let e = expected[axis].clamp(0.5, n - 0.5);
                        let at_edge = expected[axis] < 0.5 + 0.5 / k.fx || expected[axis] > n - 0.5 - 0.5 / k.fx;
                        // A box over part of two pixels treats each as constant: the error is up to 1/8 pixel
                        // over its width.
                        let flat = if k.fx < 1.0 { 0.125 * k.fx } else { 0.0 };
                        let tolerance = if at_edge { 0.5 / k.fx } else { flat } + 1e-3;
                        prop_assert!((f64::from(found[axis]) - e).abs() < tolerance, "{x} {y}: {found:?} {expected:?}");
                    }
                }
            }
        }
    }
}
