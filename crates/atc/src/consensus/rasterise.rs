//! The targets of the Gaussians rendered into a view, with which stage 2 compares its local operators.
//!
//! `S = S_v(support)` clamped to `[0, 1]` and `target = S_v(μ · support) / max(S, 10⁻⁸)` at the camera's
//! size. Both are then resized bilinearly (no antialias) to the operator grid, and `S` is clamped once
//! more. The resize reads at most two columns and rows per cell, so only those pixels are splatted: the
//! same numbers from a few hundred pixels instead of a million. The targets are not centred again.

use use3d_capture::{Camera, Lattice, Map};
use use3d_splat::{Colors, Gaussians, Prepared, Rasterizer};

use super::LocalConsensus;
use crate::extractor::resize::{Resize, ResizeAxis};

/// The local targets of a view, over its operator grid.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewTarget {
    /// Columns and rows of the grid.
    pub grid: (usize, usize),
    /// Target per cell, row-major; zero where no supported Gaussian is seen.
    pub local: Vec<[f64; 6]>,
    /// Support per cell, `[0, 1]`: the cell's weight in the loss.
    pub weight: Vec<f64>,
}

const CHANNELS: usize = 7;

/// Splats the supported part of `state` into `camera` on a grid of `grid` = (columns, rows) cells.
pub fn view_target(
    gaussians: &Gaussians,
    state: &LocalConsensus,
    camera: &Camera,
    grid: (usize, usize),
    rasterizer: &mut Rasterizer,
) -> ViewTarget {
    let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
    let (x, y) = (ResizeAxis::new(w, grid.0), ResizeAxis::new(h, grid.1));
    let lattice = Lattice::subset(&x.support(), &y.support()).unwrap_or_else(|| Lattice::size(w, h));
    let resize = Resize::new(x.compact(), y.compact());
    let pixels = lattice.width() * lattice.height();

    let mut values = vec![0.0f32; CHANNELS * gaussians.len()];
    for (i, row) in values.chunks_exact_mut(CHANNELS).enumerate() {
        if state.supported(i) {
            row[..6].copy_from_slice(&state.mean[i]);
            row[6] = 1.0;
        }
    }
    let mut prepared = Prepared::new();
    prepared.prepare(gaussians, camera, &lattice, Colors::Sh { degree: 0 });
    let mut maps = vec![0.0f32; CHANNELS * pixels];
    rasterizer.splat(&prepared, CHANNELS, &values, &mut maps);
    let (operators, support) = maps.split_at_mut(6 * pixels);
    for s in support.iter_mut() {
        *s = s.clamp(0.0, 1.0);
    }
    for plane in operators.chunks_exact_mut(pixels) {
        for (v, &s) in plane.iter_mut().zip(&*support) {
            *v /= s.max(1e-8);
        }
    }
    let cells = grid.0 * grid.1;
    let mut gridded = vec![0.0f32; CHANNELS * cells];
    resize.forward_planes(&maps, &mut gridded);
    ViewTarget {
        grid,
        local: (0..cells).map(|p| std::array::from_fn(|k| f64::from(gridded[k * cells + p]))).collect(),
        weight: (0..cells).map(|p| f64::from(gridded[6 * cells + p]).clamp(0.0, 1.0)).collect(),
    }
}

/// The share of each pixel of a view that shows Gaussians with a target: `S_v(support)`, `[0, 1]`.
pub fn support_map(
    gaussians: &Gaussians,
    state: &LocalConsensus,
    camera: &Camera,
    rasterizer: &mut Rasterizer,
) -> Map {
    let (w, h) = (camera.intrinsics.width, camera.intrinsics.height);
    let values: Vec<f32> = (0..gaussians.len()).map(|i| f32::from(u8::from(state.supported(i)))).collect();
    let mut prepared = Prepared::new();
    prepared.prepare(gaussians, camera, &Lattice::size(w, h), Colors::Sh { degree: 0 });
    let mut map = Map::new(w, h);
    rasterizer.splat(&prepared, 1, &values, map.data_mut());
    for v in map.data_mut() {
        *v = v.clamp(0.0, 1.0);
    }
    map
}
