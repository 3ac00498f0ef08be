//! The sums over windows behind SSIM and MS-SSIM, forward and backward in one pass over rows.
//!
//! A window has 11 Gaussian taps per side, is separable and lies wholly in the image. Four products (x, y,
//! x² + y², x y) are blurred down columns and then along rows. The means per window and their derivatives
//! follow, and the derivatives are blurred back, along the row and then down the columns:
//!
//! ```text
//! d sum / d x = Bᵀ(d_mean) + 2 x Bᵀ(d_square) + y Bᵀ(d_product)
//! ```
//!
//! A task owns one channel of a strip of rows, which it reads band by band. Within a band, a tile of some
//! columns goes down two rows at a time. It keeps the products and the blurred derivatives of the last twelve
//! rows, which fit into the first-level cache, and leaves the right ends of its rows to the tile beside it.
//! Tasks and tiles are cut by rows and columns, never by threads, and their sums are added in order, so the
//! bits do not depend on the number of threads.

use std::ops::Range;

use fearless_simd::prelude::*;
use fearless_simd::{Level, Simd, dispatch, f32x16};
use rayon::prelude::*;
use use3d_capture::Image;
use use3d_numerics::math;
use use3d_numerics::rows::{LANES, load, store};

/// Number of taps of the window.
pub const WINDOW: usize = 11;
/// Columns and rows by which the valid windows are fewer than the pixels.
pub(crate) const MARGIN: usize = WINDOW - 1;
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// Number of rows of the gradient that one task owns; even, as rows are taken in pairs.
const STRIP: usize = 96;
/// Number of rows of a band; even.
const BAND: usize = 16;
/// Number of rows that a tile keeps: those that a pair of windows covers.
const RING: usize = WINDOW + 1;
/// Number of vectors of the gradient that a tile's row has.
const VECTORS: usize = 5;
/// The same in columns.
const COLUMNS: usize = VECTORS * LANES;
/// Ones before zeros: sixteen of them from `16 - n` on begin with `n` ones.
const INSIDE: [f32; 2 * LANES] = {
    let mut inside = [0.0; 2 * LANES];
    let mut i = 0;
    while i < LANES {
        inside[i] = 1.0;
        i += 1;
    }
    inside
};

/// The normalised Gaussian window, σ = 1.5.
pub fn window() -> [f32; WINDOW] {
    let raw: [f64; WINDOW] =
        std::array::from_fn(|i| math::exp(-math::powi(i as f64 - 5.0, 2) / (2.0 * 1.5 * 1.5)));
    let total: f64 = raw.iter().sum();
    raw.map(|v| (v / total) as f32)
}

/// Two images that are compared, minus an offset: `x`, to which the gradient belongs, and `y`.
pub trait Pair: Sync {
    /// A row of both.
    type Row<'a>
    where
        Self: 'a;

    /// Columns and rows.
    fn size(&self) -> (usize, usize);

    /// A row of a channel.
    fn row(&self, channel: usize, row: usize) -> Self::Row<'_>;

    /// Columns `from..from + 16` of a row of both images; finite beyond the end of the row.
    fn read<'a, S: Simd>(simd: S, row: &Self::Row<'a>, from: usize) -> [f32x16<S>; 2]
    where
        Self: 'a;
}

impl Pair for [&Image; 2] {
    type Row<'a>
        = [&'a [f32]; 2]
    where
        Self: 'a;

    fn size(&self) -> (usize, usize) {
        (self[0].width(), self[0].height())
    }

    #[inline(always)]
    fn row(&self, channel: usize, row: usize) -> Self::Row<'_> {
        [self[0].row(channel, row), self[1].row(channel, row)]
    }

    #[inline(always)]
    fn read<'a, S: Simd>(simd: S, [x, y]: &Self::Row<'a>, from: usize) -> [f32x16<S>; 2]
    where
        Self: 'a,
    {
        [load(simd, x, from), load(simd, y, from)]
    }
}

/// One scale of two images.
pub(crate) struct Scale<'a, P> {
    pub(crate) pair: &'a P,
    pub(crate) offset: f32,
    /// True if luminance counts.
    pub(crate) luminance: bool,
}

/// The rows of one tile.
struct Tile {
    /// x, y, x² + y², x y of twelve rows, with the first vector of the tile to the right.
    products: [[[[f32; LANES]; 4]; RING]; VECTORS + 1],
    /// The derivatives of twelve rows of windows with respect to the means of x, of x² + y², of x y, blurred
    /// back along rows.
    spread: [[[[f32; LANES]; 3]; RING]; VECTORS],
}

impl Tile {
    const EMPTY: Self = Self {
        products: [[[[0.0; LANES]; 4]; RING]; VECTORS + 1],
        spread: [[[[0.0; LANES]; 3]; RING]; VECTORS],
    };

    fn clear(&mut self) {
        self.products.as_flattened_mut().as_flattened_mut().as_flattened_mut().fill(0.0);
        self.spread.as_flattened_mut().as_flattened_mut().as_flattened_mut().fill(0.0);
    }
}

/// The products of a pair of rows, blurred down columns.
type WindowSums<const N: usize> = [[[f32; N]; 4]; 2];

/// The right end of a pair of rows in the tile to the left.
#[derive(Clone, Copy)]
struct End {
    /// The sums that begin this tile.
    sums: WindowSums<LANES>,
    /// The derivatives of the windows before this tile's.
    derivatives: [[[f32; LANES]; 3]; 2],
}

/// The memory of a task.
struct RowBand {
    /// Floats from one row to the next: whole vectors.
    stride: usize,
    /// The rows of both images that are new in the band.
    rows: [Vec<f32>; 2],
    tiles: Vec<Tile>,
    /// By pair of rows.
    ends: [End; BAND / 2],
    sums: WindowSums<{ COLUMNS + LANES }>,
}

impl RowBand {
    fn new(width: usize) -> Self {
        let stride = width.next_multiple_of(LANES);
        let rows = || vec![0.0; stride * (BAND + MARGIN)];
        let tiles = (0..width.div_ceil(COLUMNS)).map(|_| Tile::EMPTY).collect();
        let end = End { sums: [[[0.0; LANES]; 4]; 2], derivatives: [[[0.0; LANES]; 3]; 2] };
        let sums = [[[0.0; COLUMNS + LANES]; 4]; 2];
        Self { stride, rows: [rows(), rows()], tiles, ends: [end; BAND / 2], sums }
    }
}

impl<P: Pair> Scale<'_, P> {
    /// Returns the means of the three channels; computes the gradient of their *sums*.
    pub(crate) fn means(&self, level: Level, gradient: &mut Image) -> [f64; 3] {
        let (w, h) = self.pair.size();
        gradient.resize(w, h);
        let taps = window();
        let strips = h.div_ceil(STRIP);
        let tasks: Vec<&mut [f32]> =
            gradient.data_mut().chunks_mut(w * h).flat_map(|plane| plane.chunks_mut(w * STRIP)).collect();
        let sums: Vec<f64> = tasks
            .into_par_iter()
            .enumerate()
            .map_init(
                || RowBand::new(w),
                |band, (task, out)| {
                    let (channel, first) = (task / strips, (task % strips) * STRIP);
                    dispatch!(level, simd => self.strip(simd, &taps, channel, first, band, out))
                },
            )
            .collect();
        let count = ((w - MARGIN) * (h - MARGIN)) as f64;
        std::array::from_fn(|c| sums[c * strips..(c + 1) * strips].iter().sum::<f64>() / count)
    }

    /// Computes the gradient rows from `first` on of one channel, and the sum over the windows that start
    /// there.
    #[inline(always)]
    fn strip<S: Simd>(
        &self,
        simd: S,
        taps: &[f32; WINDOW],
        channel: usize,
        first: usize,
        band: &mut RowBand,
        out: &mut [f32],
    ) -> f64 {
        let (w, h) = self.pair.size();
        let end = (first + STRIP).min(h);
        let mut sum = 0.0;
        band.tiles.iter_mut().for_each(Tile::clear);
        let mut read = first.saturating_sub(MARGIN);
        for top in (read..end).step_by(BAND) {
            let bottom = (top + BAND).min(end);
            // The windows of the band reach below it.
            let new = read..(bottom + MARGIN).min(h);
            self.read_rows(simd, channel, new.clone(), band);
            let RowBand { stride, rows: [xs, ys], tiles, ends, sums } = &mut *band;
            for (t, tile) in tiles.iter_mut().enumerate() {
                let column = t * COLUMNS;
                let mut next = read;
                for (row, end) in (top..bottom).step_by(2).zip(&mut *ends) {
                    while next < (row + RING).min(new.end) {
                        let at = (next - read) * *stride;
                        let rows = [&xs[at..at + *stride], &ys[at..at + *stride]];
                        multiply(simd, rows, [next, column], tile);
                        next += 1;
                    }
                    let of_pair = self.windows(simd, taps, [row, column], tile, sums, end);
                    if row >= first {
                        sum += of_pair;
                        let lines = &mut out[(row - first) * w..((row + 2).min(bottom) - first) * w];
                        self.gradient(simd, taps, [row, column], tile, lines);
                    }
                }
            }
            read = new.end;
        }
        sum
    }

    /// Reads rows of both images into the band.
    #[inline(always)]
    fn read_rows<S: Simd>(&self, simd: S, channel: usize, rows: Range<usize>, band: &mut RowBand) {
        let (w, [xs, ys]) = (self.pair.size().0, &mut band.rows);
        for ((row, xs), ys) in rows.zip(xs.chunks_mut(band.stride)).zip(ys.chunks_mut(band.stride)) {
            let values = self.pair.row(channel, row);
            for i in (0..w).step_by(LANES) {
                let [x, y] = P::read(simd, &values, i);
                x.store_slice(&mut xs[i..i + LANES]);
                y.store_slice(&mut ys[i..i + LANES]);
            }
        }
    }

    /// Returns the sum over a pair of rows of windows; blurs their derivatives back along the rows.
    #[inline(always)]
    fn windows<S: Simd>(
        &self,
        simd: S,
        taps: &[f32; WINDOW],
        [row, column]: [usize; 2],
        tile: &mut Tile,
        sums: &mut WindowSums<{ COLUMNS + LANES }>,
        end: &mut End,
    ) -> f64 {
        let (w, h) = self.pair.size();
        let (columns, rows) = (w - MARGIN, h - MARGIN);
        let slots = slots(row, 1);
        let zero = f32x16::splat(simd, 0.0);
        if column == 0 {
            let first = pair_of_sums(simd, taps, &slots, &tile.products[0]);
            for below in 0..2 {
                for q in 0..4 {
                    first[below][q].store_slice(&mut end.sums[below][q]);
                }
            }
            end.derivatives = [[[0.0; LANES]; 3]; 2];
        }
        for below in 0..2 {
            for q in 0..4 {
                sums[below][q][..LANES].copy_from_slice(&end.sums[below][q]);
            }
        }
        for v in 1..VECTORS + 1 {
            let next = pair_of_sums(simd, taps, &slots, &tile.products[v]);
            for below in 0..2 {
                for q in 0..4 {
                    next[below][q].store_slice(&mut sums[below][q][v * LANES..(v + 1) * LANES]);
                }
            }
        }
        for below in 0..2 {
            for q in 0..4 {
                end.sums[below][q].copy_from_slice(&sums[below][q][COLUMNS..]);
            }
        }
        let mut sum = zero;
        for below in 0..2 {
            let mut before = [zero; 3];
            for q in 0..3 {
                before[q] = f32x16::from_slice(simd, &end.derivatives[below][q]);
            }
            for v in 0..VECTORS {
                let from = column + v * LANES;
                if from >= w {
                    break;
                }
                let mut means = [zero; 4];
                for q in 0..4 {
                    let values = &sums[below][q][v * LANES..(v + 2) * LANES];
                    means[q] = f32x16::from_slice(simd, &values[..LANES]) * taps[0];
                    for k in 1..WINDOW {
                        means[q] = f32x16::from_slice(simd, &values[k..k + LANES]).mul_add(taps[k], means[q]);
                    }
                }
                let mut found = self.window(simd, means);
                let inside = if row + below < rows { columns.saturating_sub(from).min(LANES) } else { 0 };
                if inside < LANES {
                    let inside = f32x16::from_slice(simd, &INSIDE[LANES - inside..2 * LANES - inside]);
                    for q in 0..4 {
                        found[q] *= inside;
                    }
                }
                sum += found[0];
                let spread = &mut tile.spread[v][(row + below) % RING];
                for q in 0..3 {
                    blur_back(taps, before[q], found[q + 1]).store_slice(&mut spread[q]);
                    before[q] = found[q + 1];
                }
            }
            for q in 0..3 {
                before[q].store_slice(&mut end.derivatives[below][q]);
            }
        }
        sum.as_slice().iter().map(|v| f64::from(*v)).sum()
    }

    /// The value of a window, and its derivatives with respect to the means of x, of x² + y², of x y.
    #[inline(always)]
    fn window<S: Simd>(&self, simd: S, [mean_x, mean_y, square, product]: [f32x16<S>; 4]) -> [f32x16<S>; 4] {
        let (zero, one) = (f32x16::splat(simd, 0.0), f32x16::splat(simd, 1.0));
        let spread = (square - mean_x * mean_x - mean_y * mean_y).max(zero);
        let twice = (product - mean_x * mean_y) * 2.0;
        let covariance = twice.max(zero - spread).min(spread);
        let inverse = one / (spread + C2);
        let cs = (covariance + C2) * inverse;
        let d_mean = (mean_x * cs - mean_y) * inverse * 2.0;
        let d_square = zero - cs * inverse;
        let d_product = inverse * 2.0;
        if !self.luminance {
            return [cs, d_mean, d_square, d_product];
        }
        let (full_x, full_y) = (mean_x + self.offset, mean_y + self.offset);
        let below = one / (full_x.mul_add(full_x, full_y * full_y) + C1);
        let luminance = (full_x * full_y * 2.0 + C1) * below;
        let d_mean = d_mean * luminance + cs * (full_y - full_x * luminance) * below * 2.0;
        [luminance * cs, d_mean, d_square * luminance, d_product * luminance]
    }

    /// Computes a pair of rows of the gradient from the ring of derivatives; the last pair may have one row.
    #[inline(always)]
    fn gradient<S: Simd>(
        &self,
        simd: S,
        taps: &[f32; WINDOW],
        [row, column]: [usize; 2],
        tile: &Tile,
        lines: &mut [f32],
    ) {
        let w = self.pair.size().0;
        let (first, second) = lines.split_at_mut(w);
        // The rows of windows that cover the pair, nearest first: the second row of the pair comes first.
        let slots = slots(row + 1, RING - 1);
        for v in 0..VECTORS {
            let from = column + v * LANES;
            if from >= w {
                break;
            }
            let [of_second, of_first] = pair_of_sums(simd, taps, &slots, &tile.spread[v]);
            let products = &tile.products[v];
            store(self.at(simd, of_first, &products[slots[1]]), first, from);
            if !second.is_empty() {
                store(self.at(simd, of_second, &products[slots[0]]), second, from);
            }
        }
    }

    /// The gradient of sixteen pixels.
    #[inline(always)]
    fn at<S: Simd>(&self, simd: S, sums: [f32x16<S>; 3], products: &[[f32; LANES]; 4]) -> f32x16<S> {
        let (x, y) = (f32x16::from_slice(simd, &products[0]), f32x16::from_slice(simd, &products[1]));
        (x * 2.0).mul_add(sums[1], y.mul_add(sums[2], sums[0]))
    }
}

/// Computes the products of an input row.
#[inline(always)]
fn multiply<S: Simd>(simd: S, [xs, ys]: [&[f32]; 2], [row, column]: [usize; 2], tile: &mut Tile) {
    let slot = row % RING;
    for v in 0..VECTORS + 1 {
        let from = column + v * LANES;
        if from >= xs.len() {
            break;
        }
        let x = f32x16::from_slice(simd, &xs[from..from + LANES]);
        let y = f32x16::from_slice(simd, &ys[from..from + LANES]);
        let [out_x, out_y, out_square, out_product] = &mut tile.products[v][slot];
        x.store_slice(out_x);
        y.store_slice(out_y);
        x.mul_add(x, y * y).store_slice(out_square);
        (x * y).store_slice(out_product);
    }
}

/// The places of twelve rows in the ring, from a row on by a step.
#[inline(always)]
fn slots(row: usize, step: usize) -> [usize; RING] {
    let mut slots = [row % RING; RING];
    for k in 1..RING {
        slots[k] = (slots[k - 1] + step) % RING;
    }
    slots
}

/// The weighted sums down a column over the first eleven of twelve rows and over the last eleven; a row is
/// read once for both.
#[inline(always)]
fn pair_of_sums<S: Simd, const Q: usize>(
    simd: S,
    taps: &[f32; WINDOW],
    slots: &[usize; RING],
    column: &[[[f32; LANES]; Q]; RING],
) -> [[f32x16<S>; Q]; 2] {
    let zero = f32x16::splat(simd, 0.0);
    let mut sums = [[zero; Q]; 2];
    for q in 0..Q {
        let first = f32x16::from_slice(simd, &column[slots[0]][q]);
        sums[0][q] = first * taps[0];
    }
    for q in 0..Q {
        let row = f32x16::from_slice(simd, &column[slots[1]][q]);
        sums[0][q] = row.mul_add(taps[1], sums[0][q]);
        sums[1][q] = row * taps[0];
    }
    for k in 2..WINDOW {
        for q in 0..Q {
            let row = f32x16::from_slice(simd, &column[slots[k]][q]);
            sums[0][q] = row.mul_add(taps[k], sums[0][q]);
            sums[1][q] = row.mul_add(taps[k - 1], sums[1][q]);
        }
    }
    for q in 0..Q {
        let last = f32x16::from_slice(simd, &column[slots[WINDOW]][q]);
        sums[1][q] = last.mul_add(taps[WINDOW - 1], sums[1][q]);
    }
    sums
}

/// The weighted sums over the windows that cover each of the right sixteen of 32 places.
#[inline(always)]
fn blur_back<S: Simd>(taps: &[f32; WINDOW], left: f32x16<S>, right: f32x16<S>) -> f32x16<S> {
    let sum = right * taps[0];
    let sum = left.slide::<15>(right).mul_add(taps[1], sum);
    let sum = left.slide::<14>(right).mul_add(taps[2], sum);
    let sum = left.slide::<13>(right).mul_add(taps[3], sum);
    let sum = left.slide::<12>(right).mul_add(taps[4], sum);
    let sum = left.slide::<11>(right).mul_add(taps[5], sum);
    let sum = left.slide::<10>(right).mul_add(taps[6], sum);
    let sum = left.slide::<9>(right).mul_add(taps[7], sum);
    let sum = left.slide::<8>(right).mul_add(taps[8], sum);
    let sum = left.slide::<7>(right).mul_add(taps[9], sum);
    left.slide::<6>(right).mul_add(taps[10], sum)
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::random::{Purpose, Stream};

    /// The means and gradients are the same where multiply-add is fused, for sides around whole tiles, strips
    /// and pairs of rows.
    #[test]
    #[cfg(target_arch = "x86_64")]
    fn instruction_sets_with_fused_multiply_add_give_the_same_bits() {
        let (Some(avx2), Some(avx512)) = (Level::new().as_avx2(), Level::new().as_avx512()) else { return };
        for (width, height) in [(11, 11), (81, 97), (96, 107), (175, 203)] {
            let stream = Stream::new(1, Purpose::new("windows"), 0);
            let noise = |from: u64| {
                let data = (0..3 * width * height).map(|i| stream.uniform(from + i as u64) as f32 - 0.5);
                Image::from_planes(width, height, data.collect()).unwrap()
            };
            let (x, y) = (noise(0), noise(1 << 30));
            for luminance in [false, true] {
                let of = |level| {
                    let mut gradient = Image::new(1, 1);
                    let scale = Scale { pair: &[&x, &y], offset: 0.5, luminance };
                    (scale.means(level, &mut gradient).map(f64::to_bits), gradient)
                };
                assert!(of(Level::Avx2(avx2)) == of(Level::Avx512(avx512)));
            }
        }
    }
}
