//! The linear attribute splat `S_v` and its adjoint: `(S_v x)(p) = Σ_i w_i(p) x_i`,
//! `(S_vᵀ y)_i = Σ_p w_i(p) y(p)`.
//!
//! The weights are those of the compositor, `w = T α`, without water. Any number of channels is allowed;
//! eight are computed at a time.

use fearless_simd::dispatch;

use super::groups::in_groups;
use super::inputs::{input, row_splats};
use super::pixels::{get, put, row_of, set_row};
use super::rasterizer::{Kernels, Rasterizer};
use super::strips::{PlanesMut, for_each};
use super::sums::scatter;
use super::tile::{CELLS, CHANNELS, ForwardTile, Lanes, Sink};
use super::{lanes, plain};
use crate::lists::{Prepared, TILE};
use crate::project::EntryGradient;

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
            let strips = PlanesMut::of([planes], prepared.width, prepared.height);
            let of = |index: u32| -> [f32; CHANNELS] {
                let row = &values[index as usize * channels + first..][..count];
                std::array::from_fn(|c| row.get(c).copied().unwrap_or(0.0))
            };
            for_each(0..prepared.rows.tiles(), strips, &|row, mut strips: PlanesMut<'_, f32, CHANNELS>| {
                let splats = row_splats(prepared, row);
                for column in 0..prepared.columns.tiles() {
                    let input = input(prepared, &splats, row, column);
                    let mut state = ForwardTile::new(input.filled_rows, input.filled_columns);
                    let mut tile = [[[0.0; TILE]; CHANNELS]; CELLS];
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
                    let columns = column * TILE..column * TILE + input.filled_columns;
                    for r in 0..input.filled_rows {
                        for c in 0..count {
                            put(strips.row(c, r, columns.clone()), &row_of(&tile, r, |cell| &cell[c]));
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
                        let mut tile = [[[0.0; TILE]; CHANNELS]; CELLS];
                        load(planes, prepared, row, column, &mut tile);
                        let mut sink =
                            Sink { spans: input.spans, records: &mut *records, column: column as u32 };
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
    planes: &[f32],
    prepared: &Prepared,
    row: usize,
    column: usize,
    tile: &mut [[Lanes; CHANNELS]; CELLS],
) {
    let (rows, columns) = (prepared.rows.filled(row), prepared.columns.filled(column));
    for (c, plane) in planes.chunks_exact((prepared.width * prepared.height).max(1)).enumerate() {
        for r in 0..rows {
            let from = &plane[(row * TILE + r) * prepared.width..][..prepared.width];
            set_row(tile, r, &get(from, column * TILE, columns), |cell| &mut cell[c]);
        }
    }
}
