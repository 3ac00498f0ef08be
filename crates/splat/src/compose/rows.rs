//! One row of tiles, tile by tile: the work of one task in the forward or the backward pass.

use use3d_capture::MediumMaps;

use super::inputs::{BackwardRead, input, load_derivatives, load_water, row_splats};
use super::outputs::{
    Composed, ImagePlanes, LayerPlanes, MediumPlanes, SavedPlanes, store_images, store_layers,
    store_medium_gradient, store_saved,
};
use super::tile::{BackwardTile, ForwardTile, Sink, TileInput, TileWater};
use crate::lists::{Prepared, TILE};
use crate::project::EntryGradient;

/// The strips that the forward pass writes.
pub(super) type ForwardStrips<'a> = (SavedPlanes<'a>, (ImagePlanes<'a>, LayerPlanes<'a>));

/// Composes a tile row with `compose`. Always inlined, so that the loops around the kernel are compiled for
/// its instruction set too.
#[inline(always)]
pub(super) fn forward_row<const WATER: bool>(
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
            load_water(prepared, medium, row, column, &mut water);
        }
        let mut tile = ForwardTile::new(input.filled_rows, input.filled_columns);
        compose(&input, &water, &mut tile);
        let columns = column * TILE..column * TILE + input.filled_columns;
        store_saved(columns.clone(), &input, &tile, &mut saved);
        if images.present() {
            store_images::<WATER>(medium, row, columns, &input, &tile, &mut images);
        }
        if layers.present() {
            let composed = Composed { input: &input, water: &water, tile: &tile };
            store_layers::<WATER>(prepared, medium, row, column, &composed, &mut layers);
        }
    }
}

/// Differentiates a tile row with `compose`, which stores its records through the closure it receives.
#[inline(always)]
pub(super) fn backward_row<const WATER: bool>(
    read: &BackwardRead<'_>,
    row: usize,
    records: &mut [EntryGradient],
    mut grads: MediumPlanes<'_>,
    compose: impl Fn(&TileInput<'_>, &TileWater, &mut BackwardTile, &mut Sink<'_>),
) {
    let mut water = TileWater::default();
    let mut tile = BackwardTile::ZERO;
    let BackwardRead { prepared, medium, .. } = *read;
    let splats = row_splats(prepared, row);
    for column in 0..prepared.columns.tiles() {
        let input = input(prepared, &splats, row, column);
        if WATER && let Some(medium) = medium {
            load_water(prepared, medium, row, column, &mut water);
        }
        load_derivatives(read, row, column, &mut tile);
        compose(&input, &water, &mut tile, &mut Sink { records, column: column as u32 });
        if grads.present() {
            store_medium_gradient::<WATER>(prepared, &input, row, column, &tile, &mut grads);
        }
    }
}
