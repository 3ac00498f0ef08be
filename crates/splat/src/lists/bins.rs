//! Finds the tiles that every Gaussian meets, and makes the list of every tile.
//!
//! Binning has two levels. Each band of tile rows first collects the Gaussians that may meet it. Each tile
//! row then takes from its band the Gaussians whose contour meets it, each with its range of tiles.

use std::ops::Range;

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::axis::Axis;
use crate::project::{LOG2_255, Splat};

/// Number of tile rows per band of the first binning level.
const BAND: usize = 8;

/// The tiles of one tile row that one Gaussian meets.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Span {
    /// Position of the Gaussian in depth order.
    pub(crate) rank: u32,
    /// The first tile and the number of tiles.
    pub(crate) first: u32,
    pub(crate) count: u32,
    /// Position of its first entry among the row's gradient records.
    pub(crate) start: u32,
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
        self.offsets.clear();
        self.offsets.resize(tiles + 1, 0);
        for span in &self.spans {
            for t in span.first..span.first + span.count {
                self.offsets[t as usize + 1] += 1;
            }
        }
        for t in 0..tiles {
            self.offsets[t + 1] += self.offsets[t];
        }
        // Fills the lists with the offsets as cursors, then shifts the offsets back.
        self.entries.resize(self.offsets[tiles] as usize, 0);
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
    bands: &mut Vec<Vec<u32>>,
    out: &mut Vec<TileRow>,
) {
    let tile_rows = rows.tiles();
    bands.resize_with(tile_rows.div_ceil(BAND), Vec::new);
    bands.par_iter_mut().enumerate().for_each(|(band, ranks)| {
        let first = rows.tile(band * BAND).0;
        let last = rows.tile(((band + 1) * BAND).min(tile_rows) - 1).1;
        ranks.clear();
        ranks.extend((0..splats.len() as u32).filter(|&rank| {
            let s = &splats[rank as usize];
            s.y + s.reach_y >= first && s.y - s.reach_y <= last
        }));
    });
    let level = Level::new();
    out.resize_with(tile_rows, TileRow::default);
    out.par_iter_mut().enumerate().with_max_len(1).for_each(|(row, out)| {
        let ranks = &bands[row / BAND];
        dispatch!(level, _simd => fill_tile_row(out, row, ranks, splats, rows, columns));
    });
}

/// The x range of the contour between two heights, both as offsets from the Gaussian's centre.
#[inline(always)]
fn contour_range(s: &Splat, low: f32, high: f32) -> Option<[f32; 2]> {
    let (low, high) = (low.max(-s.reach_y), high.min(s.reach_y));
    if low > high {
        return None;
    }
    let level = s.log2_opacity + LOG2_255;
    // x(dy) = −shear dy ± √((level − steepness_y dy²)/steepness) has its extremes where the ellipse has a
    // vertical tangent.
    let (a, d) = (s.steepness, s.steepness_y);
    let tangent = s.shear * (level * a / (d * (d + a * s.shear * s.shear))).sqrt();
    let half_width = |dy: f32| ((level - d * dy * dy).max(0.0) / a).sqrt();
    let clamp = |dy: f32| if dy.is_nan() { low } else { dy.max(low).min(high) };
    let (right, left) = (clamp(-tangent), clamp(tangent));
    let margin = |x: f32| 1e-3 + 1e-5 * x.abs();
    let (x0, x1) = (-s.shear * left - half_width(left), -s.shear * right + half_width(right));
    Some([x0 - margin(x0), x1 + margin(x1)])
}

#[inline(always)]
fn fill_tile_row(
    out: &mut TileRow,
    row: usize,
    ranks: &[u32],
    splats: &[Splat],
    rows: &Axis,
    columns: &Axis,
) {
    let (first, last) = rows.tile(row);
    let tiles = columns.tiles();
    out.spans.clear();
    let mut start = 0u32;
    for &rank in ranks {
        let s = &splats[rank as usize];
        let Some([x0, x1]) = contour_range(s, first - s.y, last - s.y) else { continue };
        let (t0, t1) = columns.tiles_meeting(s.x + x0, s.x + x1);
        if t0 >= t1 {
            continue;
        }
        out.spans.push(Span { rank, first: t0 as u32, count: (t1 - t0) as u32, start });
        start += (t1 - t0) as u32;
    }
    out.list_spans(tiles);
}

#[cfg(test)]
mod tests {
    use super::*;

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
            let [x0, x1] = contour_range(&s, low, high).unwrap();
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
        assert!(contour_range(&s, 30.0, 40.0).is_none());
    }
}
