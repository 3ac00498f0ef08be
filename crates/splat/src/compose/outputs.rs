//! The values that a tile writes to images and maps after it was composed.
//!
//! These functions are always inlined, so that the lane code's instruction set applies to these loops too.

use std::ops::Range;

use use3d_capture::{Image, Map, MediumMaps};
use use3d_numerics::lanes::exp2;

use super::pixels::{each, get, put, ray_lengths};
use super::strips::{PlanesMut, Strips};
use super::tile::{BackwardTile, ForwardTile, Lanes, TileInput, TileWater};
use crate::lists::{Prepared, TILE};
use crate::view::Layers;

/// Values that a forward pass stores for the backward pass. They depend on geometry alone, so the backward
/// pass may use any medium, colours and `d_rendered`.
#[derive(Clone, Debug, Default)]
pub(crate) struct Saved {
    stamp: u64,
    /// Planes: final transmittance, expected depth, accumulation.
    pub(super) values: Vec<f32>,
    pub(super) stop: Vec<i32>,
}

/// The strips of [`Saved`].
pub(crate) struct SavedPlanes<'a> {
    values: PlanesMut<'a, f32, 3>,
    stop: PlanesMut<'a, i32, 1>,
}

impl Strips for SavedPlanes<'_> {
    fn cut(self, tile_rows: usize, at: usize) -> (Self, Self) {
        let (values, stop) = (self.values.cut(tile_rows, at), self.stop.cut(tile_rows, at));
        (Self { values: values.0, stop: stop.0 }, Self { values: values.1, stop: stop.1 })
    }
}

impl Saved {
    pub(crate) fn planes(&mut self, prepared: &Prepared) -> SavedPlanes<'_> {
        let (w, h) = (prepared.width, prepared.height);
        self.stamp = prepared.stamp;
        self.values.resize(3 * w * h, 0.0);
        self.stop.resize(w * h, 0);
        SavedPlanes {
            values: PlanesMut::of(&mut self.values, w, h),
            stop: PlanesMut::of(&mut self.stop, w, h),
        }
    }

    pub(crate) fn is_of(&self, prepared: &Prepared) -> bool {
        self.stamp == prepared.stamp && self.stop.len() == prepared.width * prepared.height
    }

    /// For each pixel, the entry of its tile's list at which compositing stopped; `NEVER` where it did not
    /// stop.
    pub(crate) fn stop(&self) -> &[i32] {
        &self.stop
    }

    pub(crate) fn memory(&self) -> usize {
        (self.values.capacity() + self.stop.capacity()) * 4
    }
}

impl SavedPlanes<'_> {
    #[inline(always)]
    pub(crate) fn store(&mut self, input: &TileInput<'_>, tile: &ForwardTile, columns: Range<usize>) {
        for (r, row) in tile.rows[..input.filled_rows].iter().enumerate() {
            put(self.values.row(0, r, columns.clone()), &row.transmittance);
            put(self.values.row(1, r, columns.clone()), &expected(&row.depth, &row.accumulation));
            put(self.values.row(2, r, columns.clone()), &row.accumulation);
            put(self.stop.row(0, r, columns.clone()), &row.stop);
        }
    }
}

/// `Σ w z / max(Σ w, 1e-6)`.
#[inline(always)]
fn expected(sum: &Lanes, weight: &Lanes) -> Lanes {
    each(|l| sum[l] / weight[l].max(1e-6))
}

/// The strips of a rendered view: image, depth and accumulation.
pub(crate) struct ImagePlanes<'a> {
    pub(super) image: PlanesMut<'a, f32, 3>,
    pub(super) maps: [PlanesMut<'a, f32, 1>; 2],
}

impl<'a> ImagePlanes<'a> {
    pub(crate) fn of(image: &'a mut Image, depth: &'a mut Map, accumulation: &'a mut Map) -> Self {
        let (w, h) = (image.width(), image.height());
        let maps = [PlanesMut::of(depth.data_mut(), w, h), PlanesMut::of(accumulation.data_mut(), w, h)];
        Self { image: PlanesMut::of(image.data_mut(), w, h), maps }
    }

    pub(crate) fn absent(width: usize) -> Self {
        Self { image: PlanesMut::absent(width), maps: [PlanesMut::absent(width), PlanesMut::absent(width)] }
    }

    pub(crate) fn present(&self) -> bool {
        self.image.present()
    }
}

impl Strips for ImagePlanes<'_> {
    fn cut(self, tile_rows: usize, at: usize) -> (Self, Self) {
        let (i0, i1) = self.image.cut(tile_rows, at);
        let [depth, accumulation] = self.maps;
        let ((d0, d1), (a0, a1)) = (depth.cut(tile_rows, at), accumulation.cut(tile_rows, at));
        (Self { image: i0, maps: [d0, a0] }, Self { image: i1, maps: [d1, a1] })
    }
}

/// Writes image, depth and accumulation of a tile.
#[inline(always)]
pub(crate) fn store_images<const WATER: bool>(
    medium: Option<&MediumMaps>,
    row: usize,
    columns: Range<usize>,
    input: &TileInput<'_>,
    tile: &ForwardTile,
    out: &mut ImagePlanes<'_>,
) {
    for (r, from) in tile.rows[..input.filled_rows].iter().enumerate() {
        let y = row * TILE + r;
        for c in 0..3 {
            let lanes = match medium {
                Some(medium) if WATER => {
                    let color = get(medium.color.row(c, y), columns.start, columns.len());
                    each(|l| color[l].mul_add(1.0 - from.veil[c][l], from.object[c][l]))
                }
                _ => from.object[c],
            };
            put(out.image.row(c, r, columns.clone()), &lanes);
        }
        put(out.maps[0].row(0, r, columns.clone()), &expected(&from.depth, &from.accumulation));
        put(out.maps[1].row(0, r, columns.clone()), &from.accumulation);
    }
}

/// The strips of the layers: object, medium, far, clear (three planes each) and distance.
pub(crate) struct LayerPlanes<'a> {
    images: [PlanesMut<'a, f32, 3>; 4],
    distance: PlanesMut<'a, f32, 1>,
}

impl<'a> LayerPlanes<'a> {
    pub(crate) fn of(layers: &'a mut Layers) -> Self {
        let (w, h) = (layers.object.width(), layers.object.height());
        let images = [&mut layers.object, &mut layers.medium, &mut layers.far, &mut layers.clear];
        Self {
            images: images.map(|image| PlanesMut::of(image.data_mut(), w, h)),
            distance: PlanesMut::of(layers.distance.data_mut(), w, h),
        }
    }

    pub(crate) fn absent(width: usize) -> Self {
        Self { images: std::array::from_fn(|_| PlanesMut::absent(width)), distance: PlanesMut::absent(width) }
    }
}

impl LayerPlanes<'_> {
    pub(crate) fn present(&self) -> bool {
        self.distance.present()
    }
}

impl Strips for LayerPlanes<'_> {
    fn cut(self, tile_rows: usize, at: usize) -> (Self, Self) {
        let [a, b, c, d] = self.images.map(|image| image.cut(tile_rows, at));
        let (near, rest) = self.distance.cut(tile_rows, at);
        (
            Self { images: [a.0, b.0, c.0, d.0], distance: near },
            Self { images: [a.1, b.1, c.1, d.1], distance: rest },
        )
    }
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
pub(crate) fn store_layers<const WATER: bool>(
    prepared: &Prepared,
    medium: Option<&MediumMaps>,
    row: usize,
    column: usize,
    composed: &Composed<'_>,
    out: &mut LayerPlanes<'_>,
) {
    let Composed { input, water, tile } = composed;
    let columns = column * TILE..column * TILE + input.filled_columns;
    for (r, from) in tile.rows[..input.filled_rows].iter().enumerate() {
        let y = row * TILE + r;
        for c in 0..3 {
            let (mut interval, mut far) = ([0.0; TILE], [0.0; TILE]);
            if WATER && let Some(medium) = medium {
                let color = get(medium.color.row(c, y), columns.start, columns.len());
                let (deviation, centre) = (&water.rows[r].backscatter[c], water.centre[3 + c]);
                far =
                    each(|l| from.transmittance[l] * color[l] * exp2((deviation[l] + centre) * from.last[l]));
                interval = each(|l| color[l].mul_add(1.0 - from.veil[c][l], -far[l]));
            }
            for (image, lanes) in
                out.images.iter_mut().zip([&from.object[c], &interval, &far, &from.clear[c]])
            {
                put(image.row(c, r, columns.clone()), lanes);
            }
        }
        let ray = ray_lengths(prepared, y, column);
        let depth = expected(&from.depth, &from.accumulation);
        put(out.distance.row(0, r, columns.clone()), &each(|l| depth[l] * ray[l]));
    }
}

/// The strips of the medium's gradient: colour, backscatter, attenuation.
pub(crate) struct MediumPlanes<'a> {
    pub(super) maps: [PlanesMut<'a, f32, 3>; 3],
}

impl<'a> MediumPlanes<'a> {
    pub(crate) fn of(grads: Option<&'a mut MediumMaps>, prepared: &Prepared) -> Self {
        let (w, h) = (prepared.width, prepared.height);
        let maps = match grads {
            Some(grads) => {
                grads.resize(w, h);
                [&mut grads.color, &mut grads.backscatter, &mut grads.attenuation]
                    .map(|image| PlanesMut::of(image.data_mut(), w, h))
            }
            None => std::array::from_fn(|_| PlanesMut::absent(w)),
        };
        Self { maps }
    }

    pub(crate) fn present(&self) -> bool {
        self.maps[0].present()
    }
}

impl Strips for MediumPlanes<'_> {
    fn cut(self, tile_rows: usize, at: usize) -> (Self, Self) {
        let [a, b, c] = self.maps.map(|map| map.cut(tile_rows, at));
        (Self { maps: [a.0, b.0, c.0] }, Self { maps: [a.1, b.1, c.1] })
    }
}

/// Writes the medium's gradient of a tile: `∂c_m = g (1 − Σ w E_b)`,
/// `∂β_b = |d| Σ w z g c_m E_b`, `∂β_a = −|d| Σ w z g c E_a`.
#[inline(always)]
pub(crate) fn store_medium_gradient<const WATER: bool>(
    prepared: &Prepared,
    input: &TileInput<'_>,
    row: usize,
    column: usize,
    tile: &BackwardTile,
    out: &mut MediumPlanes<'_>,
) {
    let columns = column * TILE..column * TILE + input.filled_columns;
    for (r, from) in tile.rows[..input.filled_rows].iter().enumerate() {
        let ray = ray_lengths(prepared, row * TILE + r, column);
        for c in 0..3 {
            let color =
                if WATER { each(|l| from.image[c][l] * (1.0 - from.veil[c][l])) } else { [0.0; TILE] };
            put(out.maps[0].row(c, r, columns.clone()), &color);
            put(out.maps[1].row(c, r, columns.clone()), &each(|l| -from.veil_moment[c][l] * ray[l]));
            put(out.maps[2].row(c, r, columns.clone()), &each(|l| -from.object_moment[c][l] * ray[l]));
        }
    }
}
