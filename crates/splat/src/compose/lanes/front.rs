//! Composing front to back: the transmittance of each pixel before the next Gaussian, and the entry at
//! which a pixel stops.

use fearless_simd::{Simd, SimdBase, SimdMask, f32x16, i32x16, mask32x16};
use use3d_numerics::lanes::exp2_unclamped_lanes;

use super::{load, select};
use crate::compose::tile::{ALPHA_MAX, ForwardRow, ForwardTile, STOP, TileInput};

/// A tile that is composed front to back.
pub(super) struct Front<'a> {
    pub(super) tile: &'a mut ForwardTile,
    /// Rows that are not padding and have pixels that have not stopped, as bits.
    pub(super) alive: u32,
}

impl<'a> Front<'a> {
    /// The state before the first Gaussian of `input`.
    #[inline(always)]
    pub(super) fn new(input: &TileInput<'_>, tile: &'a mut ForwardTile) -> Self {
        Self { tile, alive: ((1u64 << input.filled_rows) - 1) as u32 }
    }

    /// Applies entry `k` to row `r`: returns the weights and updates transmittance, threshold and stop. The
    /// row is no longer alive once all its pixels have stopped.
    #[inline(always)]
    pub(super) fn weights<S: Simd>(
        &mut self,
        simd: S,
        log2_alpha: f32x16<S>,
        r: usize,
        k: usize,
    ) -> f32x16<S> {
        let c = |v: f32| f32x16::splat(simd, v);
        let row = &mut self.tile.rows[r];
        let live = log2_alpha.simd_ge(load(simd, &row.threshold));
        let alpha = exp2_unclamped_lanes(simd, log2_alpha).min(c(ALPHA_MAX));
        let alpha = select(live, alpha, c(0.0));
        let before = load(simd, &row.transmittance);
        let w = before * alpha;
        let rest = before * (c(1.0) - alpha);
        let stopped = rest.simd_le(c(STOP));
        if stopped.any_true() {
            if stop(simd, stopped, row, k) {
                self.alive &= !(1 << r);
            }
            select(stopped, before, rest).store_array(&mut row.transmittance);
            select(stopped, c(0.0), w)
        } else {
            rest.store_array(&mut row.transmittance);
            w
        }
    }
}

/// Stops pixels of a row at entry `k`. Returns true if all pixels of the row have stopped.
#[inline(always)]
fn stop<S: Simd>(simd: S, stopped: mask32x16<S>, row: &mut ForwardRow, k: usize) -> bool {
    let threshold = select(stopped, f32x16::splat(simd, f32::INFINITY), load(simd, &row.threshold));
    threshold.store_array(&mut row.threshold);
    let stops: i32x16<S> = fearless_simd::Select::select(
        stopped,
        i32x16::splat(simd, k as i32),
        i32x16::load_array_ref(simd, &row.stop),
    );
    stops.store_array(&mut row.stop);
    threshold.simd_ge(f32x16::splat(simd, f32::INFINITY)).all_true()
}
