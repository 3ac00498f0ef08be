//! Finds the tiles that every Gaussian meets, and makes the list of every tile.
//!
//! Binning has two levels. Each band of tile rows first collects the Gaussians that may meet it. Each tile
//! row then takes from its band the Gaussians whose contour meets it, each with its range of tiles.

use std::ops::Range;

use fearless_simd::prelude::*;
use fearless_simd::{Level, Simd, dispatch, f32x16};
use rayon::prelude::*;

use super::axis::Axis;
use crate::project::{LOG2_255, Splat};

/// Number of tile rows per band of the first binning level.
const BAND: usize = 8;
/// Number of lanes.
const LANES: usize = 16;

/// The Gaussians that may meet a band of tile rows, in depth order.
#[derive(Clone, Debug, Default)]
pub(super) struct Band {
    ranks: Vec<u32>,
    /// Height of the centre and half height of the contour; padded with one vector of Gaussians that meet
    /// nothing.
    y: Vec<f32>,
    reach_y: Vec<f32>,
}

impl Band {
    /// Takes the Gaussians whose contour meets the rows between `first` and `last`.
    fn fill(&mut self, splats: &[Splat], first: f32, last: f32) {
        self.ranks.clear();
        self.y.clear();
        self.reach_y.clear();
        for (s, rank) in splats.iter().zip(0..) {
            if s.y + s.reach_y >= first && s.y - s.reach_y <= last {
                self.ranks.push(rank);
                self.y.push(s.y);
                self.reach_y.push(s.reach_y);
            }
        }
        self.y.resize(self.ranks.len() + LANES, 0.0);
        self.reach_y.resize(self.ranks.len() + LANES, f32::NEG_INFINITY);
    }

    /// Number of bytes held.
    pub(super) fn memory(&self) -> usize {
        4 * (self.ranks.capacity() + self.y.capacity() + self.reach_y.capacity())
    }
}

/// The tiles of one tile row that one Gaussian meets.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Span {
    /// Position of the Gaussian in depth order.
    pub(crate) rank: u32,
    /// The first tile and the number of tiles.
    pub(crate) first: u32,
    pub(crate) count: u32,
}

/// One row of tiles.
#[derive(Clone, Debug, Default)]
pub(crate) struct TileRow {
    /// The spans, in depth order.
    pub(crate) spans: Vec<Span>,
    /// Lists of span positions, tile after tile.
    pub(crate) entries: Vec<u32>,
    /// Position at which each tile's list starts; one element more than there are tiles.
    pub(crate) offsets: Vec<u32>,
}

impl TileRow {
    /// Span positions of tile `column`, in depth order.
    pub(crate) fn list(&self, column: usize) -> &[u32] {
        &self.entries[self.range(column)]
    }

    /// The positions of tile `column` among the entries.
    pub(crate) fn range(&self, column: usize) -> Range<usize> {
        self.offsets[column] as usize..self.offsets[column + 1] as usize
    }

    /// Makes the lists of `tiles` tiles from the spans.
    pub(crate) fn list_spans(&mut self, tiles: usize) {
        // Changes of the number of spans from tile to tile, then its running sum.
        self.offsets.clear();
        self.offsets.resize(tiles + 1, 0);
        for span in &self.spans {
            let (first, end) = (span.first as usize, (span.first + span.count) as usize);
            self.offsets[first] = self.offsets[first].wrapping_add(1);
            self.offsets[end] = self.offsets[end].wrapping_sub(1);
        }
        let (mut here, mut start) = (0u32, 0);
        for offset in &mut self.offsets {
            here = here.wrapping_add(*offset);
            *offset = start;
            start += here;
        }
        self.entries.resize(start as usize, 0);
        // Fills the lists with the offsets as cursors, then shifts the offsets back.
        for (i, span) in self.spans.iter().enumerate() {
            for t in span.first..span.first + span.count {
                let cursor = &mut self.offsets[t as usize];
                self.entries[*cursor as usize] = i as u32;
                *cursor += 1;
            }
        }
        for t in (1..=tiles).rev() {
            self.offsets[t] = self.offsets[t - 1];
        }
        self.offsets[0] = 0;
    }
}

/// Makes the lists of `splats`, which are in depth order, for the tiles of `[columns, rows]`. `bands` is
/// working memory.
pub(super) fn list(
    splats: &[Splat],
    [columns, rows]: [&Axis; 2],
    bands: &mut Vec<Band>,
    out: &mut Vec<TileRow>,
) {
    let tile_rows = rows.tiles();
    bands.resize_with(tile_rows.div_ceil(BAND), Band::default);
    bands.par_iter_mut().enumerate().for_each(|(band, out)| {
        let first = rows.tile(band * BAND).0;
        let last = rows.tile(((band + 1) * BAND).min(tile_rows) - 1).1;
        out.fill(splats, first, last);
    });
    let level = Level::new();
    out.resize_with(tile_rows, TileRow::default);
    out.par_iter_mut().enumerate().with_max_len(1).for_each(|(row, out)| {
        let row = RowInput { band: &bands[row / BAND], splats, heights: rows.tile(row), columns };
        dispatch!(level, simd => row.fill(simd, out));
    });
}

/// One row of tiles and the Gaussians that may meet it.
struct RowInput<'a> {
    band: &'a Band,
    splats: &'a [Splat],
    /// The first and last height.
    heights: (f32, f32),
    columns: &'a Axis,
}

impl RowInput<'_> {
    #[inline(always)]
    fn fill<S: Simd>(&self, simd: S, out: &mut TileRow) {
        out.spans.clear();
        let first = f32x16::splat(simd, self.heights.0);
        let last = f32x16::splat(simd, self.heights.1);
        let (mut met, mut count) = ([0; LANES], 0);
        for (at, ranks) in self.band.ranks.chunks(LANES).enumerate() {
            let at = at * LANES..(at + 1) * LANES;
            let y = f32x16::from_slice(simd, &self.band.y[at.clone()]);
            let reach = f32x16::from_slice(simd, &self.band.reach_y[at]);
            // The contour's heights meet the row's: the test of `contour_range`.
            let meets = (first - y).simd_le(reach) & (-reach).simd_le(last - y);
            let mut bits = meets.to_bitmask();
            while bits != 0 {
                met[count] = ranks[bits.trailing_zeros() as usize];
                count += 1;
                bits &= bits - 1;
                if count == LANES {
                    self.spans(simd, &met, out);
                    count = 0;
                }
            }
        }
        self.spans(simd, &met[..count], out);
        out.list_spans(self.columns.tiles());
    }

    /// Adds the spans of at most [`LANES`] Gaussians that meet the row.
    #[inline(always)]
    fn spans<S: Simd>(&self, simd: S, ranks: &[u32], out: &mut TileRow) {
        let mut numbers = [[0.0; LANES]; 6];
        for (lane, &rank) in ranks.iter().enumerate() {
            let s = &self.splats[rank as usize];
            let of_splat = [s.y, s.reach_y, s.log2_opacity, s.steepness, s.steepness_y, s.shear];
            for (row, v) in numbers.iter_mut().zip(of_splat) {
                row[lane] = v;
            }
        }
        let [low, high] = contour_range(simd, &numbers, self.heights);
        let (low, high) = (low.to_array(), high.to_array());
        for (lane, &rank) in ranks.iter().enumerate() {
            let x = self.splats[rank as usize].x;
            let (first, end) = self.columns.tiles_meeting(x + low[lane], x + high[lane]);
            if first < end {
                out.spans.push(Span { rank, first: first as u32, count: (end - first) as u32 });
            }
        }
    }
}

/// The x range, as offsets from the centre, of the contours of Gaussians that meet a row between two
/// heights; they are given by `y`, `reach_y`, `log2_opacity`, `steepness`, `steepness_y` and `shear`.
#[inline(always)]
fn contour_range<S: Simd>(simd: S, numbers: &[[f32; LANES]; 6], (first, last): (f32, f32)) -> [f32x16<S>; 2] {
    let [y, reach, level, a, d, shear] = numbers;
    let y = f32x16::load_array_ref(simd, y);
    let reach = f32x16::load_array_ref(simd, reach);
    let level = f32x16::load_array_ref(simd, level) + LOG2_255;
    let a = f32x16::load_array_ref(simd, a);
    let d = f32x16::load_array_ref(simd, d);
    let shear = f32x16::load_array_ref(simd, shear);
    let low = (f32x16::splat(simd, first) - y).max(-reach);
    let high = (f32x16::splat(simd, last) - y).min(reach);
    // x(dy) = −shear dy ± √((level − steepness_y dy²)/steepness) has its extremes where the ellipse has a
    // vertical tangent.
    let tangent = shear * (level * a / (d * (d + a * shear * shear))).sqrt();
    let nowhere = tangent.is_nan();
    let left = nowhere.select(low, tangent.max(low).min(high));
    let right = nowhere.select(low, (-tangent).max(low).min(high));
    let x0 = -shear * left - half_width(level, a, d, left);
    let x1 = -shear * right + half_width(level, a, d, right);
    [x0 - (x0.abs() * 1e-5 + 1e-3), x1 + (x1.abs() * 1e-5 + 1e-3)]
}

/// `√((level − d dy²)/a)`, zero outside the contour.
#[inline(always)]
fn half_width<S: Simd>(level: f32x16<S>, a: f32x16<S>, d: f32x16<S>, dy: f32x16<S>) -> f32x16<S> {
    let rest = level - d * dy * dy;
    (rest.max(0.0) / a).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn range(s: &Splat, first: f32, last: f32) -> [f32; 2] {
        let numbers = [s.y, s.reach_y, s.log2_opacity, s.steepness, s.steepness_y, s.shear];
        let numbers = numbers.map(|v| [v; LANES]);
        dispatch!(Level::new(), simd => {
            let [low, high] = contour_range(simd, &numbers, (first, last));
            [low.to_array()[0], high.to_array()[0]]
        })
    }

    /// Compares the tangent formula with a dense walk around the contour.
    #[test]
    fn the_contour_range_is_exact() {
        let s = Splat {
            shear: -0.8,
            steepness: 0.02,
            steepness_y: 0.01,
            log2_opacity: -1.0,
            reach_y: ((LOG2_255 - 1.0) / 0.01f32).sqrt(),
            ..Splat::default()
        };
        for (low, high) in [(-100.0, 100.0), (3.0, 18.0), (-30.0, -15.0), (20.0, 40.0)] {
            let [x0, x1] = range(&s, low, high);
            let (mut w0, mut w1) = (f32::INFINITY, f32::NEG_INFINITY);
            for i in 0..=100_000 {
                let dy = low + (high - low) * i as f32 / 1e5;
                let rest = (LOG2_255 - 1.0 - 0.01 * dy * dy) / 0.02;
                if rest >= 0.0 {
                    w0 = w0.min(0.8 * dy - rest.sqrt());
                    w1 = w1.max(0.8 * dy + rest.sqrt());
                }
            }
            assert!((x0 - w0).abs() < 5e-3 && (x1 - w1).abs() < 5e-3, "{x0} {w0} {x1} {w1}");
            assert!(x0 <= w0 && x1 >= w1);
        }
    }
}
