//! The inputs of water that is laid over a composed image, and the walk over its pixels.

use std::ops::Range;

use use3d_capture::{Formation, MediumMaps};

use super::normalised::DepthRange;
use crate::lists::{Prepared, TILE};
use crate::view::Rendered;

/// The inputs of forming an image and of its derivative.
#[derive(Clone, Copy)]
pub(super) struct Read<'a> {
    pub(super) prepared: &'a Prepared,
    pub(super) water: &'a MediumMaps,
    pub(super) composed: &'a Rendered,
    /// The range of depths by which distances are normalised.
    pub(super) range: Option<DepthRange>,
}

impl<'a> Read<'a> {
    pub(super) fn new(prepared: &'a Prepared, water: &'a MediumMaps, composed: &'a Rendered) -> Self {
        let range = (water.formation == Formation::Normalised)
            .then(|| DepthRange::of(&composed.depth, &composed.accumulation));
        Self { prepared, water, composed, range }
    }

    /// Calls `work` for every part of a pixel row that lies in one tile, over the tile row `row`. Its
    /// arguments are the pixel row in the view, the pixel row in the strip, the tile's column, and the
    /// range of pixel columns.
    #[inline(always)]
    pub(super) fn for_each(&self, row: usize, mut work: impl FnMut(usize, usize, usize, Range<usize>)) {
        for r in 0..self.prepared.rows.filled(row) {
            for column in 0..self.prepared.columns.tiles() {
                let x = column * TILE;
                work(row * TILE + r, r, column, x..x + self.prepared.columns.filled(column));
            }
        }
    }
}
