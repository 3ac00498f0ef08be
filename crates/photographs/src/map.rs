//! The change of colours of one photograph, at the size at which the scene was drawn, and its use on the
//! photograph at full size.
//!
//! The smooth factors are read between their pixel centres (bilinear); all detail comes from the photograph
//! itself, which is never resampled. With `P` the photograph's pixel,
//!
//! ```text
//! P⁺ = M P + b
//! ```
//!
//! where `M` (3 × 3) and `b` are per pixel of the small grid, display range. Noise is left out before
//! ([`crate::quiet`]), and highlights then run to white ([`crate::highlights`]).

use std::sync::Arc;

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use crate::development::Development;
use crate::highlights::calm;
use crate::quiet::Quiet;
use crate::sample::Sample;

/// The change of colours of one photograph: `P⁺ = M P + b`, with factors on a small grid.
#[derive(Clone, Debug)]
pub struct ColourMap {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// The map of the photograph's colours: planes `A_ij`, then `b_i`.
    pub(crate) first: Vec<f32>,
    /// The calm picture and the share of the photograph's detail that is shown; `None` if all of it is.
    pub(crate) quiet: Option<Quiet>,
    /// True if highlights run to white.
    pub(crate) soft: bool,
    /// The change before all others, of photographs of another development.
    pub(crate) development: Option<Arc<Development>>,
}

/// The two small pixels between which a pixel of a large row lies, and the share of the second one.
#[derive(Clone, Copy)]
struct Neighbours {
    first: usize,
    second: usize,
    share: f32,
}

/// For each of `large` pixels: its place among `small` ones.
fn places(large: usize, small: usize) -> Vec<Neighbours> {
    let scale = small as f64 / large as f64;
    let place = |i: usize| {
        let at = ((i as f64 + 0.5) * scale - 0.5).clamp(0.0, (small - 1) as f64);
        let first = at as usize;
        Neighbours { first, second: (first + 1).min(small - 1), share: (at - first as f64) as f32 }
    };
    (0..large).map(place).collect()
}

/// An affine map of three values to three values for every pixel: planes `3 i + j` are the slopes `A_ij`,
/// planes `9 + i` are the constants `b_i`.
pub(crate) const AFFINE: usize = 12;

/// The factors of one pixel, as four columns `A_·0, A_·1, A_·2, b`; the last value of each is one of
/// [`Quiet`]: the calm picture, then the share of the detail.
type Factors = [[f32; 4]; 4];

impl ColourMap {
    /// The size of the grid of its factors, pixels.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// The same change for photographs that were not multiplied by these gains before.
    #[must_use]
    pub fn after(mut self, gains: [f32; 3]) -> Self {
        let n = (self.width * self.height).max(1);
        for (k, plane) in self.first.chunks_exact_mut(n).take(9).enumerate() {
            plane.iter_mut().for_each(|v| *v *= gains[k % 3]);
        }
        if let Some(quiet) = &mut self.quiet {
            for (plane, gain) in quiet.base.chunks_exact_mut(n).zip(gains) {
                plane.iter_mut().for_each(|v| *v /= gain.max(1e-6));
            }
        }
        self
    }

    /// The same change for photographs of another development.
    #[must_use]
    pub fn developed(self, development: Option<Arc<Development>>) -> Self {
        Self { development, ..self }
    }

    /// The mean with the map of an earlier picture of the same size, which counts `share`. A map of
    /// another size does not count.
    #[must_use]
    pub fn mixed(mut self, earlier: &Self, share: f32) -> Self {
        if self.size() != earlier.size() {
            return self;
        }
        self.first.iter_mut().zip(&earlier.first).for_each(|(v, before)| *v += share * (before - *v));
        self
    }

    /// The factors of a row of the large picture at the pixels of the small one.
    #[inline(always)]
    fn row(&self, row: Neighbours, out: &mut Vec<Factors>) {
        let (w, n) = (self.width, self.width * self.height);
        out.resize(w, [[0.0, 0.0, 0.0, 1.0]; 4]);
        let mut put = |plane: &[f32], column: usize, value: usize| {
            let (a, b) = (&plane[row.first * w..][..w], &plane[row.second * w..][..w]);
            for ((out, a), b) in out.iter_mut().zip(a).zip(b) {
                out[column][value] = a + row.share * (b - a);
            }
        };
        for i in 0..3 {
            (0..3).for_each(|j| put(&self.first[(3 * i + j) * n..], j, i));
            put(&self.first[(9 + i) * n..], 3, i);
        }
        if let Some(quiet) = &self.quiet {
            (0..3).for_each(|c| put(&quiet.base[c * n..], c, 3));
            put(&quiet.share, 3, 3);
        }
    }

    /// [`ColourMap::apply`] for one type of sample.
    pub(crate) fn change<T: Sample>(&self, pixels: &mut [T], width: usize) {
        if width == 0 || pixels.is_empty() || self.width == 0 || self.height == 0 {
            return;
        }
        let height = pixels.len() / (3 * width);
        let (columns, rows) = (places(width, self.width), places(height, self.height));
        let level = Level::new();
        pixels.par_chunks_exact_mut(3 * width).zip(&rows).with_min_len(8).for_each_init(
            Vec::new,
            |factors, (line, row)| {
                dispatch!(level, _simd => {
                    self.row(*row, factors);
                    affine(line, factors, &columns, (self.soft, self.development.as_deref()));
                });
            },
        );
    }
}

/// The map on a row of pixels. Where all detail is shown, the share is 1 and the calm picture does not count.
#[inline(always)]
fn affine<T: Sample>(
    line: &mut [T],
    factors: &[Factors],
    columns: &[Neighbours],
    (soft, development): (bool, Option<&Development>),
) {
    for (pixel, at) in line.chunks_exact_mut(3).zip(columns) {
        let (a, b) = (&factors[at.first], &factors[at.second]);
        let mut f = *a;
        for (f, b) in f.as_flattened_mut().iter_mut().zip(b.as_flattened()) {
            *f += at.share * (b - *f);
        }
        let mut p = [pixel[0].value(), pixel[1].value(), pixel[2].value()];
        if let Some(development) = development {
            p = development.of(p);
        }
        if f[3][3] != 1.0 {
            (0..3).for_each(|c| p[c] = f[c][3] + f[3][3] * (p[c] - f[c][3]));
        }
        let mut out = f[3];
        for (column, p) in f[..3].iter().zip(p) {
            out.iter_mut().zip(column).for_each(|(out, slope)| *out = slope.mul_add(p, *out));
        }
        let out = [out[0], out[1], out[2]];
        let out = if soft { calm(out, p) } else { out };
        (0..3).for_each(|c| pixel[c] = T::of(out[c]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn constant(width: usize, height: usize, values: &[f32]) -> Vec<f32> {
        values.iter().flat_map(|v| std::iter::repeat_n(*v, width * height)).collect()
    }

    const IDENTITY: [f32; AFFINE] = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];

    #[test]
    fn the_identity_changes_no_sample_of_any_depth() {
        let map = ColourMap {
            width: 3,
            height: 2,
            first: constant(3, 2, &IDENTITY),
            quiet: None,
            soft: true,
            development: None,
        };
        let mut eight: Vec<u8> = (0..=255).cycle().take(3 * 10 * 8).collect();
        let before = eight.clone();
        map.apply(&mut eight, 10);
        assert_eq!(eight, before);
        let mut sixteen: Vec<u16> = (0..240).map(|i| i * 273).collect();
        let before = sixteen.clone();
        map.apply(&mut sixteen, 10);
        assert_eq!(sixteen, before);
    }

    #[test]
    fn off_diagonal_terms_mix_channels_and_factors_are_read_between_their_centres() {
        let mut first = constant(2, 1, &IDENTITY);
        // Red takes 0.25 of green in the left pixel and 0.75 in the right one.
        (first[2], first[3]) = (0.25, 0.75);
        let map = ColourMap { width: 2, height: 1, first, quiet: None, soft: true, development: None };
        let mut line: Vec<f32> = [0.1, 0.4, 0.2].repeat(4);
        map.apply(&mut line, 4);
        // Centres of four pixels lie at −0.25, 0.25, 0.75 and 1.25 among two.
        for (x, share) in [0.25f32, 0.375, 0.625, 0.75].into_iter().enumerate() {
            assert!((line[3 * x] - (0.1 + share * 0.4)).abs() < 1e-6, "{x}");
            assert_eq!(&line[3 * x + 1..3 * x + 3], &[0.4, 0.2]);
        }
    }

    #[test]
    fn a_row_does_not_depend_on_the_others() {
        let (w, h) = (5usize, 4usize);
        let wave = |n: usize| (0..n).map(|i| 0.3 + 0.2 * ((i * 37 % 17) as f32 / 17.0)).collect::<Vec<f32>>();
        let map = ColourMap {
            width: w,
            height: h,
            first: wave(AFFINE * w * h),
            quiet: Some(Quiet { base: wave(3 * w * h), share: wave(w * h) }),
            soft: true,
            development: None,
        };
        let mut all: Vec<u8> = (0..3 * 40 * 33).map(|i| (i * 7 % 256) as u8).collect();
        let mut again = all.clone();
        map.apply(&mut all, 40);
        rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap().install(|| map.apply(&mut again, 40));
        assert_eq!(all, again);
    }
}
