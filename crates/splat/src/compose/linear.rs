//! The linear attribute splat `S_v` and its adjoint: `(S_v x)(p) = Σ_i w_i(p) x_i`,
//! `(S_vᵀ y)_i = Σ_p w_i(p) y(p)`.
//!
//! The weights are those of the compositor, `w = T α`, without water. Any number of channels is allowed;
//! eight are computed at a time.

use fearless_simd::dispatch;

use super::groups::in_groups;
use super::inputs::{input, row_splats};
use super::rasterizer::{Kernels, Rasterizer};
use super::strips::{Strips, for_each};
use super::sums::scatter;
use super::tile::{CHANNELS, ForwardTile, Lanes, Sink};
use super::{lanes, plain};
use crate::lists::{Prepared, TILE};
use crate::project::EntryGradient;

/// The planes of some channels of a planar raster, cut at tile rows.
struct ChannelPlanes<'a> {
    planes: [&'a mut [f32]; CHANNELS],
    width: usize,
}

impl Strips for ChannelPlanes<'_> {
    fn cut(self, tile_rows: usize, _at: usize) -> (Self, Self) {
        let width = self.width;
        let (mut a, mut b): ([&mut [f32]; CHANNELS], [&mut [f32]; CHANNELS]) = Default::default();
        for (c, plane) in self.planes.into_iter().enumerate() {
            let middle = (tile_rows * TILE * width).min(plane.len());
            (a[c], b[c]) = plane.split_at_mut(middle);
        }
        (Self { planes: a, width }, Self { planes: b, width })
    }
}

impl Rasterizer {
    /// `S_v`: splats `values` (`[N][channels]`, in the order of the Gaussians) into `out`
    /// (`[channels][height][width]`), overwriting it. Values of Gaussians that are not visible have no
    /// effect. Panics if a length does not match.
    pub fn splat(&mut self, prepared: &Prepared, channels: usize, values: &[f32], out: &mut [f32]) {
        let pixels = prepared.width * prepared.height;
        assert_eq!(values.len(), prepared.gaussians * channels, "one value per Gaussian and channel");
        assert_eq!(out.len(), pixels * channels, "one plane per channel");
        let kernels = self.kernels;
        if pixels == 0 {
            return;
        }
        for (group, planes) in out.chunks_mut(pixels * CHANNELS).enumerate() {
            let (first, count) = (group * CHANNELS, planes.len() / pixels);
            let mut slots: [&mut [f32]; CHANNELS] = Default::default();
            for (slot, plane) in slots.iter_mut().zip(planes.chunks_mut(pixels)) {
                *slot = plane;
            }
            let strips = ChannelPlanes { planes: slots, width: prepared.width };
            let of = |index: u32| -> [f32; CHANNELS] {
                let row = &values[index as usize * channels + first..][..count];
                std::array::from_fn(|c| row.get(c).copied().unwrap_or(0.0))
            };
            for_each(0..prepared.rows.tiles(), strips, &|row, mut strips: ChannelPlanes<'_>| {
                let splats = row_splats(prepared, row);
                for column in 0..prepared.columns.tiles() {
                    let input = input(prepared, &splats, row, column);
                    let mut state = ForwardTile::new(input.filled_rows, input.filled_columns);
                    let mut tile = [[[0.0; TILE]; CHANNELS]; TILE];
                    match kernels {
                        Kernels::Plain => plain::splat(&input, of, &mut state, &mut tile),
                        Kernels::Lanes(level) => {
                            dispatch!(level, simd => match count {
                                1 => lanes::splat::<_, 1>(simd, &input, of, &mut state, &mut tile),
                                2..=4 => lanes::splat::<_, 4>(simd, &input, of, &mut state, &mut tile),
                                _ => lanes::splat::<_, CHANNELS>(simd, &input, of, &mut state, &mut tile),
                            });
                        }
                    }
                    for (r, from) in tile[..input.filled_rows].iter().enumerate() {
                        let start = r * strips.width + column * TILE;
                        for (plane, lanes) in strips.planes[..count].iter_mut().zip(from) {
                            plane[start..start + input.filled_columns]
                                .copy_from_slice(&lanes[..input.filled_columns]);
                        }
                    }
                }
            });
        }
    }

    /// `S_vᵀ`: lifts `maps` (`[channels][height][width]`) to Gaussians, `out` (`[N][channels]`),
    /// overwriting it; 0 where a Gaussian is not visible. Panics if a length does not match.
    pub fn splat_adjoint(&mut self, prepared: &Prepared, channels: usize, maps: &[f32], out: &mut [f32]) {
        let pixels = prepared.width * prepared.height;
        assert_eq!(out.len(), prepared.gaussians * channels, "one value per Gaussian and channel");
        assert_eq!(maps.len(), pixels * channels, "one plane per channel");
        let kernels = self.kernels;
        for first in (0..channels).step_by(CHANNELS) {
            let count = (channels - first).min(CHANNELS);
            let planes = &maps[first * pixels..(first + count) * pixels];
            in_groups(
                prepared,
                &mut self.records,
                &mut self.sums,
                (),
                &|row, records: &mut [EntryGradient], ()| {
                    let splats = row_splats(prepared, row);
                    for column in 0..prepared.columns.tiles() {
                        let input = input(prepared, &splats, row, column);
                        let mut state = ForwardTile::new(input.filled_rows, input.filled_columns);
                        let mut tile = [[[0.0; TILE]; CHANNELS]; TILE];
                        load(
                            prepared,
                            planes,
                            row,
                            column,
                            input.filled_rows,
                            input.filled_columns,
                            &mut tile,
                        );
                        let mut sink = Sink { records: &mut *records, column: column as u32 };
                        match kernels {
                            Kernels::Plain => plain::splat_adjoint(&input, &tile, &mut state, &mut sink),
                            Kernels::Lanes(level) => {
                                dispatch!(level, simd => match count {
                                    1 => lanes::splat_adjoint::<_, 1>(simd, &input, &tile, &mut state, &mut sink),
                                    2..=4 => lanes::splat_adjoint::<_, 4>(simd, &input, &tile, &mut state, &mut sink),
                                    _ => lanes::splat_adjoint::<_, CHANNELS>(simd, &input, &tile, &mut state, &mut sink),
                                });
                            }
                        }
                    }
                },
            );
            let mut sums = vec![[0.0; CHANNELS]; prepared.gaussians];
            scatter(prepared, &self.sums, &mut sums, |sum| std::array::from_fn(|c| sum[c]));
            for (out, sum) in out.chunks_exact_mut(channels).zip(&sums) {
                out[first..first + count].copy_from_slice(&sum[..count]);
            }
        }
    }
}

/// Copies one tile of some planes.
fn load(
    prepared: &Prepared,
    planes: &[f32],
    row: usize,
    column: usize,
    rows: usize,
    columns: usize,
    tile: &mut [[Lanes; CHANNELS]; TILE],
) {
    for (c, plane) in planes.chunks_exact((prepared.width * prepared.height).max(1)).enumerate() {
        for (r, out) in tile[..rows].iter_mut().enumerate() {
            let start = (row * TILE + r) * prepared.width + column * TILE;
            out[c][..columns].copy_from_slice(&plane[start..start + columns]);
        }
    }
}
