//! Counts the work of a view pair by pair. This is slow, and meant for benches and reports.

use rayon::prelude::*;

use super::inputs::{input, row_splats};
use super::plain;
use super::tile::{CELL, CELLS, ForwardTile, NEVER, TileWater, place};
use crate::lists::Prepared;
use crate::project::{LOG2_255, Splat};

/// Counts of the (pixel, Gaussian) pairs of a prepared view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Pairs {
    /// Pairs on which a pixel's colour depends.
    pub contributing: u64,
    /// Pairs that the lane kernels evaluate: the pixels of each 4×4 cell that a Gaussian's contour meets,
    /// until all pixels of the cell have stopped.
    pub tested: u64,
    /// (tile, Gaussian) entries of the lists.
    pub entries: u64,
}

impl Prepared {
    /// Counts the pairs of this view.
    pub fn pairs(&self) -> Pairs {
        let tiles = self.columns.tiles();
        (0..self.rows.tiles())
            .into_par_iter()
            .flat_map_iter(|row| {
                let splats = row_splats(self, row);
                (0..tiles).map(move |column| self.pairs_of(&splats, row, column))
            })
            .reduce(Pairs::default, |a, b| Pairs {
                contributing: a.contributing + b.contributing,
                tested: a.tested + b.tested,
                entries: a.entries + b.entries,
            })
    }

    fn pairs_of(&self, splats: &[Splat], row: usize, column: usize) -> Pairs {
        let input = input(self, splats, row, column);
        let (rows, columns) = (input.filled_rows, input.filled_columns);
        let mut state = ForwardTile::new(rows, columns);
        plain::forward::<false, false>(&input, &TileWater::default(), &mut state);
        let mut pairs = Pairs { entries: input.list.len() as u64, ..Pairs::default() };
        // The last entry that some pixel of each cell receives.
        let last = state.cells.each_ref().map(|cell| cell.stop.into_iter().max().unwrap_or(NEVER));
        for k in 0..input.list.len() {
            let splat = input.entry(k).1;
            let mut met = 0u32;
            for r in 0..rows {
                let terms = splat.row(input.rows[r]);
                let power = |x: f32| {
                    let t = x - terms.peak;
                    (t * splat.steepness).mul_add(-t, terms.power)
                };
                for (l, &x) in input.columns[..columns].iter().enumerate() {
                    let (cell, lane) = place(r, l);
                    if last[cell] < k as i32 {
                        continue;
                    }
                    let ends = [input.columns[l / CELL * CELL], input.columns[l / CELL * CELL + CELL - 1]];
                    if power(terms.peak.max(ends[0]).min(ends[1])) >= -LOG2_255 {
                        met |= 1 << cell;
                    }
                    let live = power(x) >= -LOG2_255 && state.cells[cell].stop[lane] > k as i32;
                    pairs.contributing += u64::from(live);
                }
            }
            let inside = |pixels: usize, cell: usize| pixels.saturating_sub(cell * CELL).min(CELL) as u64;
            let pixels = |cell: usize| inside(rows, cell / CELL) * inside(columns, cell % CELL);
            pairs.tested += (0..CELLS).filter(|cell| met >> cell & 1 == 1).map(pixels).sum::<u64>();
        }
        pairs
    }
}
