//! One row of tiles, tile by tile: the work of one task in the forward or the backward pass.

use fearless_simd::Simd;
use use3d_capture::MediumMaps;

use super::inputs::{BackwardRead, input, load_derivatives, load_water, row_splats};
use super::outputs::{
    Composed, ImagePlanes, LayerPlanes, MediumPlanes, SavedPlanes, store_images, store_layers,
    store_medium_gradient, store_saved,
};
use super::tile::{BackwardTile, EntrySink, ForwardTile, Sink, TileInput, TileWater};
use crate::lists::{Prepared, TILE};
use crate::project::EntryGradient;

/// The strips that the forward pass writes.
pub(super) type ForwardStrips<'a> = (SavedPlanes<'a>, (ImagePlanes<'a>, LayerPlanes<'a>));

/// Composes a tile row with `compose`. Always inlined, so that the loops around the kernel are compiled for
/// its instruction set too.
#[inline(always)]
pub(super) fn forward_row<S: Simd, const WATER: bool>(
    simd: S,
    prepared: &Prepared,
    medium: Option<&MediumMaps>,
    row: usize,
    (mut saved, (mut images, mut layers)): ForwardStrips<'_>,
    compose: impl Fn(&TileInput<'_>, &TileWater, &mut ForwardTile),
) {
    let mut water = TileWater::default();
    let splats = row_splats(prepared, row);
    for column in 0..prepared.columns.tiles() {
        let input = input(prepared, &splats, row, column);
        if WATER && let Some(medium) = medium {
            load_water(simd, prepared, medium, row, column, &mut water);
        }
        let mut tile = ForwardTile::new(input.filled_rows, input.filled_columns);
        compose(&input, &water, &mut tile);
        let columns = column * TILE..column * TILE + input.filled_columns;
        store_saved(simd, columns.clone(), &input, &tile, &mut saved);
        if images.present() {
            store_images::<_, WATER>(simd, medium, row, columns, &input, &tile, &mut images);
        }
        if layers.present() {
            let composed = Composed { input: &input, water: &water, tile: &tile };
            store_layers::<_, WATER>(simd, prepared, medium, row, column, &composed, &mut layers);
        }
    }
}

/// Differentiates a tile row with `compose`, which stores its records through the closure it receives.
#[inline(always)]
pub(super) fn backward_row<S: Simd, const WATER: bool>(
    simd: S,
    read: &BackwardRead<'_>,
    row: usize,
    records: &mut [EntryGradient],
    mut grads: MediumPlanes<'_>,
    compose: impl Fn(&TileInput<'_>, &TileWater, &mut BackwardTile, &mut EntrySink<'_>),
) {
    let mut water = TileWater::default();
    let mut tile = BackwardTile::ZERO;
    let BackwardRead { prepared, medium, .. } = *read;
    let splats = row_splats(prepared, row);
    for column in 0..prepared.columns.tiles() {
        let input = input(prepared, &splats, row, column);
        if WATER && let Some(medium) = medium {
            load_water(simd, prepared, medium, row, column, &mut water);
        }
        load_derivatives(simd, read, row, column, &mut tile);
        let mut sink = Sink { spans: input.spans, records: &mut *records, column: column as u32 };
        compose(&input, &water, &mut tile, &mut sink);
        if grads.present() {
            store_medium_gradient::<_, WATER>(simd, prepared, &input, row, column, &tile, &mut grads);
        }
    }
}
