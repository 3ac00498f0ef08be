//! Images cut into strips of one tile row each, and distributed to threads without allocation.

use std::ops::Range;

use crate::lists::TILE;

/// A value that can be cut after a number of tile rows.
pub(crate) trait Strips: Sized + Send {
    /// Returns the first `tile_rows` tile rows, and the rest.
    fn cut(self, tile_rows: usize) -> (Self, Self);
}

/// Mutable planes of one width; an absent plane is empty, and so are all its strips.
pub(crate) struct PlanesMut<'a, T, const N: usize> {
    pub(crate) planes: [&'a mut [T]; N],
    pub(crate) width: usize,
}

impl<'a, T, const N: usize> PlanesMut<'a, T, N> {
    /// `N` planes of `width × height` that lie one after another in `buffers`.
    pub(crate) fn of(buffers: impl IntoIterator<Item = &'a mut [T]>, width: usize, height: usize) -> Self {
        let size = (width * height).max(1);
        let mut planes = buffers.into_iter().flat_map(|buffer| buffer.chunks_exact_mut(size));
        Self { planes: std::array::from_fn(|_| planes.next().unwrap_or_default()), width }
    }

    /// Planes without pixels.
    pub(crate) fn absent(width: usize) -> Self {
        Self { planes: std::array::from_fn(|_| Default::default()), width }
    }

    /// Pixels `columns` of row `y` of the strip, in plane `c`.
    #[inline(always)]
    pub(crate) fn row(&mut self, c: usize, y: usize, columns: Range<usize>) -> &mut [T] {
        let start = y * self.width;
        &mut self.planes[c][start + columns.start..start + columns.end]
    }

    /// True if there are pixels to write.
    pub(crate) fn present(&self) -> bool {
        N > 0 && !self.planes[0].is_empty()
    }
}

impl<T: Send, const N: usize> Strips for PlanesMut<'_, T, N> {
    fn cut(self, tile_rows: usize) -> (Self, Self) {
        let width = self.width;
        let (mut first, mut second) = (Self::absent(width), Self::absent(width));
        for (c, plane) in self.planes.into_iter().enumerate() {
            let middle = (tile_rows * TILE * width).min(plane.len());
            (first.planes[c], second.planes[c]) = plane.split_at_mut(middle);
        }
        (first, second)
    }
}

/// One value per tile row.
pub(crate) struct PerRow<'a, T>(pub(crate) &'a mut [T]);

impl<T: Send> Strips for PerRow<'_, T> {
    fn cut(self, tile_rows: usize) -> (Self, Self) {
        let middle = tile_rows.min(self.0.len());
        let (first, second) = self.0.split_at_mut(middle);
        (Self(first), Self(second))
    }
}

impl<A: Strips, B: Strips> Strips for (A, B) {
    fn cut(self, tile_rows: usize) -> (Self, Self) {
        let (a, b) = (self.0.cut(tile_rows), self.1.cut(tile_rows));
        ((a.0, b.0), (a.1, b.1))
    }
}

impl Strips for () {
    fn cut(self, _tile_rows: usize) -> (Self, Self) {
        ((), ())
    }
}

/// Calls `work(tile row, its strips)` for every tile row of `rows`, in parallel.
pub(crate) fn for_each<T: Strips>(rows: Range<usize>, strips: T, work: &(impl Fn(usize, T) + Sync)) {
    match rows.len() {
        0 => {}
        1 => work(rows.start, strips),
        n => {
            let middle = rows.start + n / 2;
            let (first, second) = strips.cut(n / 2);
            rayon::join(
                || for_each(rows.start..middle, first, work),
                || for_each(middle..rows.end, second, work),
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_gets_its_own_pixels() {
        let (width, height) = (3, 40);
        let mut data = vec![0u32; 2 * width * height];
        let strips =
            (PlanesMut::<u32, 2>::of([&mut data[..]], width, height), PlanesMut::<f32, 1>::absent(width));
        for_each(0..3, strips, &|row, (mut planes, absent)| {
            assert!(planes.present() && !absent.present());
            let rows = planes.planes[0].len() / width;
            for c in 0..2 {
                for y in 0..rows {
                    planes.row(c, y, 0..width).fill((100 * c + 10 * row + 1) as u32);
                }
            }
        });
        for (i, &v) in data.iter().enumerate() {
            let (plane, y) = (i / (width * height), i % (width * height) / width);
            assert_eq!(v as usize, 100 * plane + 10 * (y / TILE) + 1);
        }
    }
}
