//! The values that a tile reads from images and maps before it is composed.
//!
//! These functions are always inlined, so that the lane code's instruction set applies to these loops too.

use std::cell::Cell;
use std::ops::Deref;

use fearless_simd::{Select, Simd, SimdBase, f32x16};
use use3d_capture::MediumMaps;

use super::outputs::Saved;
use super::pixels::{load, rays, set_row, store_row};
use super::tile::{BackwardTile, TileInput, TileWater};
use crate::lists::{Prepared, TILE};
use crate::project::Splat;
use crate::view::RenderGradients;

thread_local! {
    /// The memory of the thread's last [`RowSplats`], which the next one of this thread reuses.
    static SPARE: Cell<Vec<Splat>> = const { Cell::new(Vec::new()) };
}

/// The Gaussians of a tile row, one per span, in one array.
///
/// A tile reads only a few of its row's Gaussians. In the view's own array they lie far apart, and each
/// read waits for memory. Copied in one pass, these waits overlap, and the copy fits the second-level
/// cache.
pub(crate) struct RowSplats(Vec<Splat>);

impl Deref for RowSplats {
    type Target = [Splat];

    #[inline(always)]
    fn deref(&self) -> &[Splat] {
        &self.0
    }
}

impl Drop for RowSplats {
    fn drop(&mut self) {
        // A thread that is ending has no thread-local storage left; the memory is then freed.
        let _ = SPARE.try_with(|spare| spare.set(std::mem::take(&mut self.0)));
    }
}

/// Copies the Gaussians of a tile row.
pub(crate) fn row_splats(prepared: &Prepared, row: usize) -> RowSplats {
    let mut splats = SPARE.take();
    splats.clear();
    splats.extend(prepared.tile_rows[row].spans.iter().map(|span| prepared.splats[span.rank as usize]));
    RowSplats(splats)
}

/// The input of tile (`row`, `column`); `splats` is the result of [`row_splats`] for this row.
#[inline(always)]
pub(crate) fn input<'a>(
    prepared: &'a Prepared,
    splats: &'a [Splat],
    row: usize,
    column: usize,
) -> TileInput<'a> {
    let tile_row = &prepared.tile_rows[row];
    TileInput {
        splats,
        spans: &tile_row.spans,
        list: tile_row.list(column),
        columns: prepared.columns.lanes(column),
        rows: prepared.rows.lanes(row),
        filled_rows: prepared.rows.filled(row),
        filled_columns: prepared.columns.filled(column),
    }
}

/// Reads the medium's exponents of a tile.
#[inline(always)]
pub(crate) fn load_water<S: Simd>(
    simd: S,
    prepared: &Prepared,
    medium: &MediumMaps,
    row: usize,
    column: usize,
    water: &mut TileWater,
) {
    let (rows, n) = (prepared.rows.filled(row), prepared.columns.filled(column));
    for r in 0..TILE {
        // Padding repeats the last row.
        let y = row * TILE + r.min(rows - 1);
        let factor = rays(simd, prepared, y, column) * f32x16::splat(simd, -std::f32::consts::LOG2_E);
        for c in 0..3 {
            let attenuation = load(simd, medium.attenuation.row(c, y), column * TILE, n);
            let backscatter = load(simd, medium.backscatter.row(c, y), column * TILE, n);
            let cells = &mut water.cells;
            store_row(simd, cells, r, attenuation * factor, |cell| &mut cell.attenuation[c]);
            store_row(simd, cells, r, backscatter * factor, |cell| &mut cell.backscatter[c]);
        }
    }
    water.centre(simd);
}

/// The parts of a view that a backward pass reads.
#[derive(Clone, Copy)]
pub(crate) struct BackwardRead<'a> {
    pub(crate) prepared: &'a Prepared,
    pub(crate) medium: Option<&'a MediumMaps>,
    pub(crate) d_rendered: &'a RenderGradients<'a>,
    /// Values that the forward pass stored; `None` if this pass composes front to back itself.
    pub(crate) saved: Option<&'a Saved>,
}

/// Prepares a tile for the backward pass.
#[inline(always)]
pub(crate) fn load_derivatives<S: Simd>(
    simd: S,
    read: &BackwardRead<'_>,
    row: usize,
    column: usize,
    tile: &mut BackwardTile,
) {
    let BackwardRead { prepared, medium, d_rendered, saved } = *read;
    let (rows, n) = (prepared.rows.filled(row), prepared.columns.filled(column));
    let (x, pixels) = (column * TILE, prepared.width * prepared.height);
    *tile = BackwardTile::ZERO;
    let cells = &mut tile.cells;
    for r in 0..rows {
        let y = row * TILE + r;
        let lanes = |row: &[f32]| load(simd, row, x, n);
        for c in 0..3 {
            let image = lanes(d_rendered.image.row(c, y));
            store_row(simd, cells, r, image, |cell| &mut cell.image[c]);
            if let Some(medium) = medium {
                let veiled = -(image * lanes(medium.color.row(c, y)));
                store_row(simd, cells, r, veiled, |cell| &mut cell.veiled[c]);
            }
            if let Some(clear) = d_rendered.clear {
                store_row(simd, cells, r, lanes(clear.row(c, y)), |cell| &mut cell.clear[c]);
            }
        }
        let Some(saved) = saved else { continue };
        let start = y * prepared.width + x;
        // Padding keeps its stop of 0 and so takes no part.
        let mut stop = [0; TILE];
        stop[..n].copy_from_slice(&saved.stop[start..start + n]);
        set_row(cells, r, &stop, |cell| &mut cell.stop);
        let row = |plane: usize| &saved.values[plane * pixels + y * prepared.width..][..prepared.width];
        store_row(simd, cells, r, lanes(row(0)), |cell| &mut cell.transmittance);
        let weight = d_rendered.accumulation.map(|accumulation| lanes(accumulation.row(0, y)));
        let mut weight = weight.unwrap_or(f32x16::splat(simd, 0.0));
        if let Some(depth) = d_rendered.depth {
            // depth = Σwz / max(Σw, 1e-6)
            let least = f32x16::splat(simd, 1e-6);
            let (value, sum) = (lanes(row(1)), lanes(row(2)));
            let d_sum = lanes(depth.row(0, y)) / sum.max(least);
            weight = sum.simd_gt(least).select(weight - d_sum * value, weight);
            store_row(simd, cells, r, d_sum, |cell| &mut cell.depth);
        }
        store_row(simd, cells, r, weight, |cell| &mut cell.weight);
    }
}
