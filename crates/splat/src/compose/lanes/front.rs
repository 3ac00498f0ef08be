//! Composing front to back: the transmittance of each pixel before the next Gaussian, and the entry at
//! which a pixel stops.

use fearless_simd::{Simd, SimdBase, SimdMask, f32x16, i32x16};
use use3d_numerics::lanes::exp2_unclamped_lanes;

use super::batch::{EntryBatch, Items};
use super::{load, select};
use crate::compose::tile::{ALPHA_MAX, CELL, CELLS, ForwardTile, NEVER, STOP, TileInput};
use crate::project::LOG2_255;

/// A tile that is composed front to back.
pub(super) struct Front<'a> {
    pub(super) tile: &'a mut ForwardTile,
    /// Cells that are not all padding and have pixels that have not stopped, as bits.
    pub(super) alive: u32,
    /// The weights of the last batch.
    pub(super) weights: Items,
}

impl<'a> Front<'a> {
    /// The state before the first Gaussian of `input`.
    #[inline(always)]
    pub(super) fn new(input: &TileInput<'_>, tile: &'a mut ForwardTile) -> Self {
        let filled = |pixels: usize| (1u32 << pixels.div_ceil(CELL)) - 1;
        let (columns, rows) = (filled(input.filled_columns), filled(input.filled_rows));
        // The cells of the filled columns, in each of the filled rows of cells.
        let alive = (0..CELL).filter(|row| rows >> row & 1 == 1).map(|row| columns << (row * CELL)).sum();
        Self { tile, alive, weights: Items::ZERO }
    }

    /// Applies a batch: computes its weights, and updates transmittances and stops. A cell is no longer
    /// alive after a batch in which the last of its pixels has stopped.
    #[inline(always)]
    pub(super) fn apply<S: Simd>(&mut self, simd: S, batch: &EntryBatch<'_, S>) {
        let c = |v: f32| f32x16::splat(simd, v);
        let never = i32x16::splat(simd, NEVER);
        for item in batch.items() {
            let power = batch.log2_alpha(simd, item);
            let state = &mut self.tile.cells[item.cell];
            let live = power.simd_ge(c(-LOG2_255));
            let alpha = select(live, exp2_unclamped_lanes(simd, power).min(c(ALPHA_MAX)), c(0.0));
            // The transmittance of a pixel that has stopped is negative.
            let before = load(simd, &state.transmittance);
            let open = before.max(c(0.0));
            let rest = open * (c(1.0) - alpha);
            let stopped = rest.simd_le(c(STOP));
            self.weights.set(item.number, select(stopped, c(0.0), open * alpha));
            select(stopped, -before.abs(), rest).store_array(&mut state.transmittance);
            // The least entry, because a pixel that has stopped counts as stopped in every later entry.
            let k = i32x16::splat(simd, batch.places[item.entry]);
            let here: i32x16<S> = fearless_simd::Select::select(stopped, k, never);
            i32x16::load_array_ref(simd, &state.stop).min(here).store_array(&mut state.stop);
        }
        for cell in 0..CELLS {
            let open = load(simd, &self.tile.cells[cell].transmittance).simd_gt(c(0.0));
            self.alive &= !(u32::from(open.all_false()) << cell);
        }
    }
}
