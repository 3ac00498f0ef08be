//! Drops from the tile lists the entries that no pixel sees, for views that are composed many times with
//! frozen geometry.
//!
//! An entry of a tile's list stays if some pixel of the tile is still being composed at that entry and lies
//! within its 1/255 contour: it then adds to the pixel or ends it. The compositor skips all other entries
//! anyway, so images keep every bit, and so do gradients up to the order of their sums: a Gaussian that
//! loses a tile in the middle of a row adds the tiles on both sides one after the other. On a sparse lattice
//! (stage 2) most small Gaussians fall between the pixels of their tiles. A small view then also keeps its
//! weights (see `weighted`).

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

use super::inputs::{input, row_splats};
use super::weighted::weights;
use crate::Rasterizer;
use crate::lists::{Prepared, Span, TILE, TileRow};
use crate::project::LOG2_255;

/// Margin of the contour test, so that an entry is kept even if this test rounds differently from the
/// compositor's.
const MARGIN: f32 = 1e-3;

impl Rasterizer {
    /// Drops the entries of `prepared` that no pixel sees, and the Gaussians without entries. Images stay the
    /// same to the bit, and gradients up to the order of their sums. A view of at most 16384 pixels also
    /// keeps its weights, which makes composing and [`Rasterizer::backward_colors`] faster and changes the
    /// last bits.
    pub fn trim(&mut self, prepared: &mut Prepared) {
        let stop = self.stops(prepared);
        let view = &*prepared;
        let level = Level::new();
        let rows: Vec<TileRow> = (0..view.tile_rows.len())
            .into_par_iter()
            .with_max_len(1)
            .map(|row| dispatch!(level, _simd => trimmed(view, stop, row)))
            .collect();
        prepared.replace_lists(rows);
        prepared.weights = weights(prepared);
    }
}

/// One tile row with only the entries that some pixel sees. A Gaussian's span is cut where a tile drops it.
#[inline(always)]
fn trimmed(prepared: &Prepared, stop: &[i32], row: usize) -> TileRow {
    let old = &prepared.tile_rows[row];
    let tiles = prepared.columns.tiles();
    // One flag per entry, in the order of spans, and the place of each span's first.
    let mut seen = vec![false; old.entries.len()];
    let starts: Vec<usize> = old
        .spans
        .iter()
        .scan(0, |end, span| Some(std::mem::replace(end, *end + span.count as usize)))
        .collect();
    let splats = row_splats(prepared, row);
    for column in 0..tiles {
        let input = input(prepared, &splats, row, column);
        let mut stops = [[-1i32; TILE]; TILE];
        for (r, stops) in stops[..input.filled_rows].iter_mut().enumerate() {
            let start = (row * TILE + r) * prepared.width + column * TILE;
            let n = input.filled_columns;
            stops[..n].copy_from_slice(&stop[start..start + n]);
        }
        for (k, &at) in old.list(column).iter().enumerate() {
            let (splat, first) = (input.entry(k).1, old.spans[at as usize].first as usize);
            let mut sees = false;
            for r in 0..input.filled_rows {
                let terms = splat.row(input.rows[r]);
                if terms.power < -LOG2_255 - MARGIN {
                    continue;
                }
                // No early exit, so that sixteen lanes run at once.
                for l in 0..TILE {
                    let t = input.columns[l] - terms.peak;
                    let power = terms.power - t * splat.steepness * t;
                    sees |= stops[r][l] >= k as i32 && power >= -LOG2_255 - MARGIN;
                }
                if sees {
                    break;
                }
            }
            seen[starts[at as usize] + column - first] = sees;
        }
    }
    let mut new = TileRow::default();
    for (span, start) in old.spans.iter().zip(starts) {
        let mut first = span.first;
        let entries = &seen[start..start + span.count as usize];
        for run in entries.chunk_by(|a, b| a == b) {
            let count = run.len() as u32;
            if run[0] {
                new.spans.push(Span { rank: span.rank, first, count });
            }
            first += count;
        }
    }
    new.list_spans(tiles);
    new
}

#[cfg(test)]
mod tests {
    use use3d_capture::{Camera, Formation, Image, Intrinsics, Lattice, MediumMaps, Pose};
    use use3d_numerics::math;

    use super::*;
    use crate::lists::tests::cloud;
    use crate::{Colors, Options, Rendered};

    #[test]
    fn trimming_changes_no_bit() {
        let intrinsics = Intrinsics { width: 150, height: 116, fx: 120.0, fy: 124.0, cx: 70.0, cy: 60.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let every = |step: usize, n: usize| (0..n).step_by(step).collect::<Vec<_>>();
        // The Gaussians are so opaque that most pixels stop, and so sparse that small ones fall between
        // pixels.
        let gaussians = cloud(3000, -3.0, 3.0);
        for lattice in [Lattice::full(&intrinsics), Lattice::subset(&every(3, 150), &every(4, 116)).unwrap()]
        {
            let mut view = Prepared::new();
            view.prepare(&gaussians, &camera, &lattice, Colors::Sh { degree: 0 });
            let (w, h) = (lattice.width(), lattice.height());
            let wave = |k: usize| {
                let data = (0..3 * w * h).map(|i| 0.3 + 0.2 * math::sin((i + k) as f32)).collect();
                Image::from_planes(w, h, data).unwrap()
            };
            let (color, backscatter, attenuation) = (wave(1), wave(2), wave(3));
            let water = MediumMaps {
                color,
                backscatter,
                attenuation,
                formation: Formation::default(),
                network: None,
            };
            for mut rasterizer in [Rasterizer::plain(), Rasterizer::new()] {
                let mut trimmed = view.clone();
                rasterizer.trim(&mut trimmed);
                trimmed.weights.clear();
                assert!(
                    trimmed.entries() * 4 < view.entries() * 3,
                    "{} {}",
                    trimmed.entries(),
                    view.entries()
                );
                let mut run = |view: &Prepared| {
                    let mut out = Rendered::new();
                    let mut colors = vec![[0.0; 3]; gaussians.len()];
                    let mut d_water = MediumMaps::zeros(0, 0);
                    rasterizer.forward(view, Some(&water), &Options::default(), &mut out);
                    rasterizer.backward_colors(view, Some(&water), &wave(4), &mut colors, &mut d_water);
                    (out, colors, d_water)
                };
                let (all, seen) = (run(&view), run(&trimmed));
                assert!(all.0 == seen.0 && all.2 == seen.2);
                let pairs = all.1.as_flattened().iter().zip(seen.1.as_flattened());
                let largest = pairs.clone().fold(0.0f32, |most, (a, _)| most.max(a.abs()));
                assert!(pairs.clone().all(|(a, b)| (a - b).abs() <= 1e-6 * largest));
                assert_eq!(view.pairs().contributing, trimmed.pairs().contributing);
            }
        }
    }
}
