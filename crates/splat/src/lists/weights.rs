//! The weights `w = T α` with which a tile row's Gaussians add to its pixels: constants of a view while the
//! geometry is frozen. A pair is one Gaussian at one pixel, and takes ten bytes.

use super::TILE;

/// The pairs of one row of tiles, pixel after pixel, and by ascending depth in each pixel.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct RowWeights {
    /// Position of each pixel's first pair, with one element more than there are pixels. Pixels are ordered
    /// by tile, then by row, then by column; padding pixels have no pairs.
    pub(crate) starts: Vec<u32>,
    /// Position of each pair's Gaussian in its tile's list.
    pub(crate) entries: Vec<u16>,
    /// Depth `z` and weight `w` of each pair, followed by [`TILE`] pairs of weight zero, so that sixteen
    /// lanes can be read at any pair.
    pub(crate) depths: Vec<f32>,
    pub(crate) weights: Vec<f32>,
    /// `Σ w z` and `Σ w` of each pixel.
    pub(crate) sums: Vec<[f32; 2]>,
}

impl RowWeights {
    /// The first pair of pixel (`r`, `l`) of tile `column`, and the first one after them.
    #[inline(always)]
    pub(crate) fn pairs(&self, column: usize, r: usize, l: usize) -> (usize, usize) {
        let pixel = (column * TILE + r) * TILE + l;
        (self.starts[pixel] as usize, self.starts[pixel + 1] as usize)
    }

    /// Number of bytes held.
    pub(crate) fn memory(&self) -> usize {
        4 * (self.starts.capacity() + self.depths.capacity() + self.weights.capacity())
            + 2 * self.entries.capacity()
            + 8 * self.sums.capacity()
    }
}
