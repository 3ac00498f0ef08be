//! Bilinear resize and its exact adjoint.
//!
//! Output sample `i` of an axis that goes from `n_in` to `n_out` reads the source at
//! `max((i + 0.5) n_in / n_out − 0.5, 0)`: half-pixel centres, clamped at the edge, without antialiasing.
//! An image is resized by the tensor product of two axes, and the adjoint scatters a gradient back with the
//! same four weights. An axis may be *compacted* to the indices that it reads; the arithmetic, and so every
//! bit of the result, stays the same.

use rayon::prelude::*;
use use3d_capture::Image;

use crate::vectorized::vectorized;

/// The positions at which one axis of the resize reads: `value = low + (high − low) · fraction`.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ResizeAxis {
    /// Number of samples of the source along the axis.
    pub(crate) source_len: usize,
    low: Vec<u32>,
    high: Vec<u32>,
    fraction: Vec<f32>,
    /// For each source index, the outputs that read it, ascending, with their weights: the adjoint as a
    /// gather.
    readers: Vec<(u32, f32)>,
    reader_start: Vec<u32>,
}

impl ResizeAxis {
    /// The axis from `n_in` to `n_out` samples (both at least 1).
    pub(crate) fn new(n_in: usize, n_out: usize) -> Self {
        let (mut low, mut high, mut fraction) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..n_out {
            let x = ((i as f64 + 0.5) * n_in as f64 / n_out as f64 - 0.5).max(0.0);
            let l = (x.floor() as usize).min(n_in - 1);
            let h = (l + 1).min(n_in - 1);
            let f = (x - l as f64) as f32;
            // An index with weight zero is not read, so that its pixel need not be rendered.
            let f = if h == l { 0.0 } else { f };
            low.push(l as u32);
            high.push(if f == 0.0 { l } else { h } as u32);
            fraction.push(f);
        }
        Self::from_taps(n_in, low, high, fraction)
    }

    fn from_taps(source_len: usize, low: Vec<u32>, high: Vec<u32>, fraction: Vec<f32>) -> Self {
        let mut lists: Vec<Vec<(u32, f32)>> = vec![Vec::new(); source_len];
        for i in 0..low.len() {
            lists[low[i] as usize].push((i as u32, 1.0 - fraction[i]));
            if high[i] != low[i] {
                lists[high[i] as usize].push((i as u32, fraction[i]));
            }
        }
        let mut reader_start = vec![0u32];
        let mut readers = Vec::new();
        for list in lists {
            readers.extend(list);
            reader_start.push(readers.len() as u32);
        }
        Self { source_len, low, high, fraction, readers, reader_start }
    }

    /// Number of samples of the output along the axis.
    pub(crate) fn len(&self) -> usize {
        self.low.len()
    }

    /// The source indices that are read, ascending.
    pub(crate) fn support(&self) -> Vec<usize> {
        let mut indices: Vec<usize> = self.low.iter().chain(&self.high).map(|&i| i as usize).collect();
        indices.sort_unstable();
        indices.dedup();
        indices
    }

    /// The same axis over a source that holds only [`ResizeAxis::support`].
    pub(crate) fn compact(&self) -> Self {
        let support = self.support();
        let position = |taps: &[u32]| {
            taps.iter().map(|&i| support.partition_point(|&s| s < i as usize) as u32).collect()
        };
        Self::from_taps(support.len(), position(&self.low), position(&self.high), self.fraction.clone())
    }

    fn is_identity(&self) -> bool {
        self.len() == self.source_len
            && self.fraction.iter().all(|&f| f == 0.0)
            && self.low.iter().enumerate().all(|(i, &l)| l as usize == i)
    }

    fn readers_of(&self, source: usize) -> &[(u32, f32)] {
        &self.readers[self.reader_start[source] as usize..self.reader_start[source + 1] as usize]
    }
}

/// A bilinear resize of whole images.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Resize {
    /// The axis along x.
    pub(crate) x: ResizeAxis,
    /// The axis along y.
    pub(crate) y: ResizeAxis,
    identity: bool,
}

impl Resize {
    /// A resize with the given axes.
    pub(crate) fn new(x: ResizeAxis, y: ResizeAxis) -> Self {
        let identity = x.is_identity() && y.is_identity();
        Self { x, y, identity }
    }

    /// A resize from one `(width, height)` to another.
    pub(crate) fn between(from: (usize, usize), to: (usize, usize)) -> Self {
        Self::new(ResizeAxis::new(from.0, to.0), ResizeAxis::new(from.1, to.1))
    }

    /// The source size that [`Resize::forward`] expects.
    pub(crate) fn source_size(&self) -> (usize, usize) {
        (self.x.source_len, self.y.source_len)
    }

    /// The output size.
    pub(crate) fn output_size(&self) -> (usize, usize) {
        (self.x.len(), self.y.len())
    }

    /// Resizes any number of planes: `source` is `[planes][h_in][w_in]`, `output` `[planes][h_out][w_out]`.
    pub(crate) fn forward_planes(&self, source: &[f32], output: &mut [f32]) {
        let (w_in, h_in) = self.source_size();
        let (w, h) = self.output_size();
        debug_assert_eq!(source.len() * w * h, output.len() * w_in * h_in);
        if self.identity {
            output.copy_from_slice(source);
            return;
        }
        output.par_chunks_mut(w).enumerate().for_each(|(row, out)| {
            let (plane, y) = (row / h, row % h);
            let line = |i: u32| &source[(plane * h_in + i as usize) * w_in..][..w_in];
            let (top, bottom) = (line(self.y.low[y]), line(self.y.high[y]));
            resize_row(top, bottom, self.y.fraction[y], &self.x, out);
        });
    }

    /// Resizes an image; `output` gets the output size.
    pub(crate) fn forward(&self, source: &Image, output: &mut Image) {
        let (w, h) = self.output_size();
        output.resize(w, h);
        self.forward_planes(source.data(), output.data_mut());
    }

    /// The adjoint of [`Resize::forward`]: `d_source` gets the source size and is overwritten; `scratch` is
    /// working memory that may be reused.
    pub(crate) fn backward(&self, d_out: &Image, d_source: &mut Image, scratch: &mut Vec<f32>) {
        let (w_in, h_in) = self.source_size();
        let (w, h) = self.output_size();
        d_source.resize(w_in, h_in);
        if self.identity {
            d_source.data_mut().copy_from_slice(d_out.data());
            return;
        }
        scratch.resize(3 * h * w_in, 0.0);
        scratch.par_chunks_mut(w_in).zip(d_out.data().par_chunks(w)).for_each(|(wide, row)| {
            wide.fill(0.0);
            for (i, &g) in row.iter().enumerate() {
                let f = self.x.fraction[i];
                wide[self.x.low[i] as usize] += g * (1.0 - f);
                wide[self.x.high[i] as usize] += g * f;
            }
        });
        let wide = &*scratch;
        d_source.data_mut().par_chunks_mut(w_in).enumerate().for_each(|(row, out)| {
            let (plane, y) = (row / h_in, row % h_in);
            out.fill(0.0);
            for &(reader, weight) in self.y.readers_of(y) {
                let line = &wide[(plane * h + reader as usize) * w_in..][..w_in];
                vectorized!(add_scaled(out, line, weight));
            }
        });
    }
}

/// Computes one output row from two source rows.
fn resize_row(top: &[f32], bottom: &[f32], fraction: f32, x: &ResizeAxis, out: &mut [f32]) {
    let taps = x.low.iter().zip(&x.high).zip(&x.fraction);
    if fraction == 0.0 {
        for (o, ((&l, &h), &f)) in out.iter_mut().zip(taps) {
            let (a, b) = (top[l as usize], top[h as usize]);
            *o = a + (b - a) * f;
        }
    } else {
        for (o, ((&l, &h), &f)) in out.iter_mut().zip(taps) {
            let (l, h) = (l as usize, h as usize);
            let a = top[l] + (top[h] - top[l]) * f;
            let b = bottom[l] + (bottom[h] - bottom[l]) * f;
            *o = a + (b - a) * fraction;
        }
    }
}

#[inline(always)]
fn add_scaled(out: &mut [f32], line: &[f32], weight: f32) {
    for (o, &v) in out.iter_mut().zip(line) {
        *o += v * weight;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise(width: usize, height: usize, seed: u64) -> Image {
        let stream =
            use3d_numerics::random::Stream::new(seed, use3d_numerics::random::Purpose::new("test image"), 0);
        let data = (0..3 * width * height).map(|i| stream.uniform(i as u64) as f32).collect();
        Image::from_planes(width, height, data).unwrap()
    }

    fn dot(a: &Image, b: &Image) -> f64 {
        a.data().iter().zip(b.data()).map(|(&x, &y)| f64::from(x) * f64::from(y)).sum()
    }

    #[test]
    fn the_adjoint_is_the_transpose_and_a_compact_axis_gives_the_same_bits() {
        for (from, to) in [((37, 21), (16, 9)), ((16, 9), (37, 21)), ((13, 8), (13, 8)), ((50, 3), (8, 8))] {
            let resize = Resize::between(from, to);
            let source = noise(from.0, from.1, 1);
            let d_out = noise(to.0, to.1, 2);
            let (mut out, mut back, mut scratch) = (Image::new(1, 1), Image::new(1, 1), Vec::new());
            resize.forward(&source, &mut out);
            resize.backward(&d_out, &mut back, &mut scratch);
            assert!((dot(&out, &d_out) - dot(&source, &back)).abs() < 1e-5 * dot(&out, &d_out));

            let (columns, rows) = (resize.x.support(), resize.y.support());
            let compact = Resize::new(resize.x.compact(), resize.y.compact());
            let mut sampled = Image::new(columns.len(), rows.len());
            for (j, &y) in rows.iter().enumerate() {
                for (i, &x) in columns.iter().enumerate() {
                    sampled.set_pixel(i, j, source.pixel(x, y));
                }
            }
            let mut again = Image::new(1, 1);
            compact.forward(&sampled, &mut again);
            assert_eq!(out, again);
        }
    }

    #[test]
    fn constants_stay_exactly_constant() {
        let image = Image::filled(31, 17, 0.3);
        let mut out = Image::new(1, 1);
        Resize::between((31, 17), (12, 8)).forward(&image, &mut out);
        assert!(out.data().iter().all(|&v| v == 0.3));
    }
}
