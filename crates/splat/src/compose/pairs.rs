//! Counts the work of a view pair by pair. This is slow, and meant for benches and reports.

use rayon::prelude::*;

use super::inputs::{input, row_splats};
use super::plain;
use super::tile::{ForwardTile, NEVER, TileWater};
use crate::lists::{Prepared, TILE};
use crate::project::{LOG2_255, Splat};

/// Counts of the (pixel, Gaussian) pairs of a prepared view.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Pairs {
    /// Pairs on which a pixel's colour depends.
    pub contributing: u64,
    /// Pairs that the lane kernels evaluate: pixels of rows that a Gaussian's contour meets, until all
    /// pixels of the row have stopped.
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
        for k in 0..input.list.len() {
            let splat = input.entry(k).1;
            for r in 0..rows {
                let state = &state.rows[r];
                let last = state.stop[..columns].iter().copied().max().unwrap_or(NEVER);
                if last < k as i32 {
                    continue;
                }
                let terms = splat.row(input.rows[r]);
                let power = |x: f32| {
                    let t = x - terms.peak;
                    (t * splat.steepness).mul_add(-t, terms.power)
                };
                let nearest = terms.peak.max(input.columns[0]).min(input.columns[TILE - 1]);
                if power(nearest) >= -LOG2_255 {
                    pairs.tested += columns as u64;
                    let live = |l: &usize| power(input.columns[*l]) >= -LOG2_255 && state.stop[*l] > k as i32;
                    pairs.contributing += (0..columns).filter(live).count() as u64;
                }
            }
        }
        pairs
    }
}
