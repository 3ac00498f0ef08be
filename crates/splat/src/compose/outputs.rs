//! The values that a tile writes to images and maps after it was composed.
//!
//! These functions are always inlined, so that the lane code's instruction set applies to these loops too.

use std::ops::Range;

use fearless_simd::{Simd, SimdBase, SimdFloat, f32x16};
use use3d_capture::{Image, Map, MediumMaps};
use use3d_numerics::lanes::exp2_lanes;

use super::pixels::{load, load_row, put, rays, row_of, store};
use super::strips::PlanesMut;
use super::tile::{BackwardTile, ForwardTile, TileInput, TileWater};
use crate::lists::{Prepared, TILE};
use crate::view::Layers;

/// Values that a forward pass stores for the backward pass. They depend on geometry alone, so the backward
/// pass may use any medium, colours and `d_rendered`.
#[derive(Clone, Debug, Default)]
pub(crate) struct Saved {
    stamp: u64,
    /// Planes: final transmittance, expected depth, accumulation.
    pub(super) values: Vec<f32>,
    /// For each pixel, the entry of its tile's list at which compositing stopped; `NEVER` where it did not
    /// stop.
    pub(super) stop: Vec<i32>,
}

/// The strips of [`Saved`]: values and stop.
pub(crate) type SavedPlanes<'a> = (PlanesMut<'a, f32, 3>, PlanesMut<'a, i32, 1>);

impl Saved {
    pub(crate) fn planes(&mut self, prepared: &Prepared) -> SavedPlanes<'_> {
        let (w, h) = (prepared.width, prepared.height);
        self.stamp = prepared.stamp;
        self.values.resize(3 * w * h, 0.0);
        self.stop.resize(w * h, 0);
        (PlanesMut::of([&mut self.values[..]], w, h), PlanesMut::of([&mut self.stop[..]], w, h))
    }

    pub(crate) fn is_of(&self, prepared: &Prepared) -> bool {
        self.stamp == prepared.stamp && self.stop.len() == prepared.width * prepared.height
    }

    pub(crate) fn memory(&self) -> usize {
        (self.values.capacity() + self.stop.capacity()) * 4
    }
}

/// Stores the values of a tile.
#[inline(always)]
pub(crate) fn store_saved<S: Simd>(
    simd: S,
    columns: Range<usize>,
    input: &TileInput<'_>,
    tile: &ForwardTile,
    (values, stop): &mut SavedPlanes<'_>,
) {
    for r in 0..input.filled_rows {
        let (depth, accumulation) = depth_of(simd, tile, r);
        store(values.row(0, r, columns.clone()), transmittance_of(simd, tile, r));
        store(values.row(1, r, columns.clone()), depth);
        store(values.row(2, r, columns.clone()), accumulation);
        put(stop.row(0, r, columns.clone()), &row_of(&tile.cells, r, |cell| &cell.stop));
    }
}

/// The transmittance of a row, whose sign says whether the pixel has stopped.
#[inline(always)]
fn transmittance_of<S: Simd>(simd: S, tile: &ForwardTile, r: usize) -> f32x16<S> {
    load_row(simd, &tile.cells, r, |cell| &cell.transmittance).abs()
}

/// The expected depth `Σ w z / max(Σ w, 1e-6)` and the accumulation `Σ w` of a row.
#[inline(always)]
fn depth_of<S: Simd>(simd: S, tile: &ForwardTile, r: usize) -> (f32x16<S>, f32x16<S>) {
    let sum = load_row(simd, &tile.cells, r, |cell| &cell.depth);
    let weight = load_row(simd, &tile.cells, r, |cell| &cell.accumulation);
    (sum / weight.max(f32x16::splat(simd, 1e-6)), weight)
}

/// The strips of a rendered view: the image (three planes), depth and accumulation.
pub(crate) type ImagePlanes<'a> = PlanesMut<'a, f32, 5>;

/// The strips of these results.
pub(crate) fn image_planes<'a>(
    image: &'a mut Image,
    depth: &'a mut Map,
    accumulation: &'a mut Map,
) -> ImagePlanes<'a> {
    let (w, h) = (image.width(), image.height());
    PlanesMut::of([image.data_mut(), depth.data_mut(), accumulation.data_mut()], w, h)
}

/// Writes image, depth and accumulation of a tile.
#[inline(always)]
pub(crate) fn store_images<S: Simd, const WATER: bool>(
    simd: S,
    medium: Option<&MediumMaps>,
    row: usize,
    columns: Range<usize>,
    input: &TileInput<'_>,
    tile: &ForwardTile,
    out: &mut ImagePlanes<'_>,
) {
    for r in 0..input.filled_rows {
        let y = row * TILE + r;
        for c in 0..3 {
            let mut lanes = load_row(simd, &tile.cells, r, |cell| &cell.object[c]);
            if WATER && let Some(medium) = medium {
                let veil = load_row(simd, &tile.cells, r, |cell| &cell.veil[c]);
                let color = load(simd, medium.color.row(c, y), columns.start, columns.len());
                lanes = color.mul_add(f32x16::splat(simd, 1.0) - veil, lanes);
            }
            store(out.row(c, r, columns.clone()), lanes);
        }
        let (depth, accumulation) = depth_of(simd, tile, r);
        store(out.row(3, r, columns.clone()), depth);
        store(out.row(4, r, columns.clone()), accumulation);
    }
}

/// The strips of the layers: object, medium, far, clear (three planes each) and distance.
pub(crate) type LayerPlanes<'a> = PlanesMut<'a, f32, 13>;

/// The strips of the layers; absent without layers.
pub(crate) fn layer_planes(layers: &mut Option<Layers>, width: usize) -> LayerPlanes<'_> {
    let Some(Layers { object, medium, far, clear, distance }) = layers else {
        return PlanesMut::absent(width);
    };
    let height = object.height();
    let images = [object, medium, far, clear].map(Image::data_mut);
    PlanesMut::of(images.into_iter().chain([distance.data_mut()]), width, height)
}

/// A tile after the forward pass, with the inputs of that pass.
pub(crate) struct Composed<'a> {
    pub(crate) input: &'a TileInput<'a>,
    pub(crate) water: &'a TileWater,
    pub(crate) tile: &'a ForwardTile,
}

/// Writes the layers of a tile. The interval medium is `c_m (1 − Σ w E) − far`: the telescoped sum without
/// its last term.
#[inline(always)]
pub(crate) fn store_layers<S: Simd, const WATER: bool>(
    simd: S,
    prepared: &Prepared,
    medium: Option<&MediumMaps>,
    row: usize,
    column: usize,
    composed: &Composed<'_>,
    out: &mut LayerPlanes<'_>,
) {
    let Composed { input, water, tile } = composed;
    let columns = column * TILE..column * TILE + input.filled_columns;
    for r in 0..input.filled_rows {
        let y = row * TILE + r;
        let transmittance = transmittance_of(simd, tile, r);
        let last = load_row(simd, &tile.cells, r, |cell| &cell.last);
        for c in 0..3 {
            let zero = f32x16::splat(simd, 0.0);
            let (mut interval, mut far) = (zero, zero);
            if WATER && let Some(medium) = medium {
                let color = load(simd, medium.color.row(c, y), columns.start, columns.len());
                let deviation = load_row(simd, &water.cells, r, |cell| &cell.backscatter[c]);
                let veil = load_row(simd, &tile.cells, r, |cell| &cell.veil[c]);
                let centre = f32x16::splat(simd, water.centre[3 + c]);
                far = transmittance * color * exp2_lanes(simd, (deviation + centre) * last);
                interval = color.mul_add(f32x16::splat(simd, 1.0) - veil, -far);
            }
            let object = load_row(simd, &tile.cells, r, |cell| &cell.object[c]);
            let clear = load_row(simd, &tile.cells, r, |cell| &cell.clear[c]);
            for (k, lanes) in [object, interval, far, clear].into_iter().enumerate() {
                store(out.row(3 * k + c, r, columns.clone()), lanes);
            }
        }
        let (depth, _) = depth_of(simd, tile, r);
        store(out.row(12, r, columns.clone()), depth * rays(simd, prepared, y, column));
    }
}

/// The strips of the medium's gradient: colour, backscatter, attenuation (three planes each).
pub(crate) type MediumPlanes<'a> = PlanesMut<'a, f32, 9>;

/// The strips of these gradients, which get the view's size; absent without them.
pub(crate) fn medium_planes<'a>(grads: Option<&'a mut MediumMaps>, prepared: &Prepared) -> MediumPlanes<'a> {
    let (w, h) = (prepared.width, prepared.height);
    let Some(grads) = grads else { return PlanesMut::absent(w) };
    grads.resize(w, h);
    PlanesMut::of(
        [&mut grads.color, &mut grads.backscatter, &mut grads.attenuation].map(Image::data_mut),
        w,
        h,
    )
}

/// Writes the medium's gradient of a tile: `∂c_m = g (1 − Σ w E_b)`,
/// `∂β_b = |d| Σ w z g c_m E_b`, `∂β_a = −|d| Σ w z g c E_a`.
#[inline(always)]
pub(crate) fn store_medium_gradient<S: Simd, const WATER: bool>(
    simd: S,
    prepared: &Prepared,
    input: &TileInput<'_>,
    row: usize,
    column: usize,
    tile: &BackwardTile,
    out: &mut MediumPlanes<'_>,
) {
    let columns = column * TILE..column * TILE + input.filled_columns;
    for r in 0..input.filled_rows {
        let ray = rays(simd, prepared, row * TILE + r, column);
        for c in 0..3 {
            let image = load_row(simd, &tile.cells, r, |cell| &cell.image[c]);
            let veil = load_row(simd, &tile.cells, r, |cell| &cell.veil[c]);
            let veil_moment = load_row(simd, &tile.cells, r, |cell| &cell.veil_moment[c]);
            let object_moment = load_row(simd, &tile.cells, r, |cell| &cell.object_moment[c]);
            let one = f32x16::splat(simd, 1.0);
            let color = if WATER { image * (one - veil) } else { f32x16::splat(simd, 0.0) };
            store(out.row(c, r, columns.clone()), color);
            store(out.row(3 + c, r, columns.clone()), -veil_moment * ray);
            store(out.row(6 + c, r, columns.clone()), -object_moment * ray);
        }
    }
}
