//! One axis of a lattice cut into tiles of 16 pixel centres.

/// Pixels along a tile's side; one row of a tile is one vector of lanes.
pub(crate) const TILE: usize = 16;
/// Ascending pixel-centre coordinates, padded to whole tiles by repeating the last centre (padding is
/// masked and never drawn).
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Axis {
    centres: Vec<f32>,
    length: usize,
}

impl Axis {
    pub(crate) fn set(&mut self, centres: &[f32]) {
        self.length = centres.len();
        self.centres.clear();
        self.centres.extend_from_slice(centres);
        let last = centres.last().copied().unwrap_or(0.0);
        self.centres.resize(centres.len().div_ceil(TILE) * TILE, last);
    }

    /// All centres, including padding.
    pub(crate) fn centres(&self) -> &[f32] {
        &self.centres
    }

    /// Number of tiles.
    pub(crate) fn tiles(&self) -> usize {
        self.centres.len() / TILE
    }

    /// Pixels of tile `t` that are not padding.
    pub(crate) fn filled(&self, t: usize) -> usize {
        (self.length - t * TILE).min(TILE)
    }

    /// The first and last centre of tile `t`.
    pub(crate) fn tile(&self, t: usize) -> (f32, f32) {
        (self.centres[t * TILE], self.centres[t * TILE + TILE - 1])
    }

    /// The 16 centres of tile `t`.
    pub(crate) fn lanes(&self, t: usize) -> &[f32; TILE] {
        self.centres[t * TILE..].first_chunk().expect("the axis is padded to whole tiles")
    }

    /// The first and last centre; an empty range if there are no centres.
    pub(crate) fn range(&self) -> [f32; 2] {
        match (self.centres.first(), self.centres.last()) {
            (Some(&first), Some(&last)) => [first, last],
            _ => [f32::INFINITY, f32::NEG_INFINITY],
        }
    }

    /// The half-open range of tiles with a centre between `low` and `high` (widened to whole tiles).
    pub(crate) fn tiles_meeting(&self, low: f32, high: f32) -> (usize, usize) {
        let (mut a, mut b) = (0, self.tiles());
        // The first tile whose last centre is not below `low`.
        while a < b {
            let middle = (a + b) / 2;
            if self.tile(middle).1 < low { a = middle + 1 } else { b = middle }
        }
        let first = a;
        let mut b = self.tiles();
        // The first tile whose first centre is above `high`.
        while a < b {
            let middle = (a + b) / 2;
            if self.tile(middle).0 <= high { a = middle + 1 } else { b = middle }
        }
        (first, a)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tiles_meeting_a_range() {
        let mut axis = Axis::default();
        axis.set(&(0..40).map(|i| i as f32 + 0.5).collect::<Vec<_>>());
        assert_eq!((axis.tiles(), axis.filled(0), axis.filled(2)), (3, 16, 8));
        assert_eq!(axis.tiles_meeting(-5.0, -1.0), (0, 0));
        assert_eq!(axis.tiles_meeting(-5.0, 0.5), (0, 1));
        assert_eq!(axis.tiles_meeting(15.6, 16.4), (1, 1));
        assert_eq!(axis.tiles_meeting(15.5, 16.5), (0, 2));
        assert_eq!(axis.tiles_meeting(20.0, 1e9), (1, 3));
        assert_eq!(axis.tiles_meeting(39.6, 1e9), (3, 3));
        assert_eq!(axis.range(), [0.5, 39.5]);
    }
}
