//! The amount of work in the last drawn view, counted in main memory from the data on the device.

use use3d_splat::LOG2_255;
use use3d_training::EngineError;

use super::Stage1;
use crate::buffer::read_together;
use crate::constants::{TILE, counts};
use crate::raster::kept;
use crate::rows::SPLAT;

/// Sizes of a view, and its pairs of pixel and Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ViewWork {
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Number of Gaussians on the screen.
    pub visible: usize,
    /// Number of (tile, Gaussian) entries.
    pub entries: usize,
    /// Number of pairs that a pixel tests before it stops.
    pub tested: u64,
    /// Number of these pairs that contribute to the pixel.
    pub live: u64,
    /// Number of pixels.
    pub pixels: usize,
    /// Number of entries of the longest list of a tile.
    pub longest_list: usize,
    /// The largest number of Gaussians that a pixel tests before it stops.
    pub deepest_pixel: usize,
    /// Number of passes of the order by tile.
    pub tile_passes: u32,
}

impl Stage1 {
    /// Waits and counts the view of the last step, which had this many pixels across and down.
    pub fn last_view(&self, [width, height]: [usize; 2]) -> Result<ViewWork, EngineError> {
        let (gpu, n, pixels) = (&self.gpu, self.scene.count, width * height);
        let side = TILE as usize;
        let [across, down] = [width.div_ceil(side), height.div_ceil(side)];
        let entries = self.counts.read(gpu, counts::WORDS)?[counts::ENTRIES] as usize;
        let drawn = self.lists.drawn();
        let [splats, starts, lists, owners, values, axes] = read_together(
            gpu,
            [
                (drawn.splats.raw(), 4 * SPLAT * n),
                (drawn.starts.raw(), across * down + 1),
                (drawn.lists.raw(), entries),
                (drawn.owners.raw(), entries),
                (self.compositor.kept.raw(), (kept::STOP + 1) * pixels),
                (drawn.axes.raw(), side * (across + down)),
            ],
        )?;
        let stops = values.get(kept::STOP * pixels..).unwrap_or_default();
        let splats: &[f32] = bytemuck::cast_slice(&splats);
        let (columns, rows) = bytemuck::cast_slice::<u32, f32>(&axes).split_at(side * across);
        let splat = |i: u32| splats.get(4 * SPLAT * i as usize..)?.first_chunk::<12>();
        let (mut tested, mut live) = (0, 0);
        let (mut longest_list, mut deepest_pixel) = (0, 0);
        for (tile, ends) in starts.windows(2).enumerate() {
            let listed = lists.get(ends[0] as usize..ends[1] as usize).unwrap_or_default();
            let own: Vec<&[f32; 12]> =
                listed.iter().filter_map(|&at| splat(*owners.get(at as usize)?)).collect();
            let (left, top) = (side * (tile % across), side * (tile / across));
            longest_list = own.len().max(longest_list);
            for y in top..(top + side).min(height) {
                for x in left..(left + side).min(width) {
                    let until = (stops[y * width + x] as usize).saturating_add(1).min(own.len());
                    tested += until as u64;
                    deepest_pixel = until.max(deepest_pixel);
                    let meets = |s: &&&[f32; 12]| {
                        let dy = rows[y] - s[1];
                        let t = columns[x] - (s[0] - s[2] * dy);
                        s[5] - s[4] * dy * dy - s[3] * t * t >= -LOG2_255
                    };
                    live += own[..until].iter().filter(meets).count() as u64;
                }
            }
        }
        let visible = splats.chunks_exact(4 * SPLAT).filter(|splat| splat[11] == 1.0).count();
        let tile_passes = (usize::BITS - (across * down).leading_zeros()).div_ceil(8);
        Ok(ViewWork {
            gaussians: n,
            visible,
            entries,
            tested,
            live,
            pixels,
            longest_list,
            deepest_pixel,
            tile_passes,
        })
    }
}
