//! One axis of a lattice cut into tiles of 16 pixel centres.

/// Pixels along a tile's side; one row of a tile is one vector of lanes.
pub(crate) const TILE: usize = 16;
/// Ascending pixel-centre coordinates, padded to whole tiles by repeating the last centre (padding is
/// masked and never drawn).
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Axis {
    /// The centres of each tile.
    centres: Vec<[f32; TILE]>,
    length: usize,
    /// True if centre `i` is `i + ½`, as in a whole image.
    whole: bool,
}

impl Axis {
    pub(crate) fn set(&mut self, centres: &[f32]) {
        self.length = centres.len();
        self.whole = centres.iter().enumerate().all(|(i, &v)| v == i as f32 + 0.5);
        let last = centres.last().copied().unwrap_or(0.0);
        self.centres.clear();
        self.centres.resize(centres.len().div_ceil(TILE), [last; TILE]);
        self.centres.as_flattened_mut()[..centres.len()].copy_from_slice(centres);
    }

    /// All centres, including padding.
    pub(crate) fn centres(&self) -> &[f32] {
        self.centres.as_flattened()
    }

    /// Number of tiles.
    pub(crate) fn tiles(&self) -> usize {
        self.centres.len()
    }

    /// Pixels of tile `t` that are not padding.
    pub(crate) fn filled(&self, t: usize) -> usize {
        (self.length - t * TILE).min(TILE)
    }

    /// The first and last centre of tile `t`.
    pub(crate) fn tile(&self, t: usize) -> (f32, f32) {
        (self.centres[t][0], self.centres[t][TILE - 1])
    }

    /// The 16 centres of tile `t`.
    pub(crate) fn lanes(&self, t: usize) -> &[f32; TILE] {
        &self.centres[t]
    }

    /// The first and last centre; an empty range if there are no centres.
    pub(crate) fn range(&self) -> [f32; 2] {
        match (self.centres.first(), self.centres.last()) {
            (Some(first), Some(last)) => [first[0], last[TILE - 1]],
            _ => [f32::INFINITY, f32::NEG_INFINITY],
        }
    }

    /// The half-open range of tiles with a centre between `low` and `high` (widened to whole tiles).
    #[inline(always)]
    pub(crate) fn tiles_meeting(&self, low: f32, high: f32) -> (usize, usize) {
        let ([_, last], tiles) = (self.range(), self.tiles());
        let (first, end) = if self.whole {
            // Both differences and quotients are exact. NaN becomes zero.
            const SIDE: f32 = TILE as f32;
            let guess = (((low - (SIDE - 0.5)) / SIDE) as usize).min(tiles);
            let first = guess + usize::from(guess as f32 * SIDE + (SIDE - 0.5) < low);
            let end = if high >= 0.5 { (((high - 0.5) / SIDE) as usize).min(tiles) + 1 } else { 0 };
            (if low > last { tiles } else { first }, end.min(tiles))
        } else {
            let first = self.centres.partition_point(|tile| tile[TILE - 1] < low);
            (first, self.centres.partition_point(|tile| tile[0] <= high))
        };
        (first, end.max(first))
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

    #[test]
    fn arithmetic_finds_the_tiles_that_a_search_finds() {
        let mut axis = Axis::default();
        for length in [1, 16, 17, 40, 1280, 1283] {
            axis.set(&(0..length).map(|i| i as f32 + 0.5).collect::<Vec<_>>());
            assert!(axis.whole);
            let searched = Axis { whole: false, ..axis.clone() };
            let mut bounds = vec![f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e30, -1e30, 0.0, -1e-30];
            for i in -3..=axis.tiles() as i32 + 3 {
                for at in [16 * i, 16 * i + 1, 16 * i + 7].map(|v| v as f32 - 0.5) {
                    bounds.extend([at.next_down(), at, at.next_up(), at + 0.3]);
                }
            }
            for &low in &bounds {
                for &high in &bounds {
                    assert_eq!(
                        axis.tiles_meeting(low, high),
                        searched.tiles_meeting(low, high),
                        "{low} {high}"
                    );
                }
            }
        }
    }
}
