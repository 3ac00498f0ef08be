//! Between images and tiles: what a tile reads from the maps before it is composed, and what it writes back.
//!
//! Always inlined, so that the lane code's instruction set applies to these loops too.

use std::cell::Cell;
use std::ops::{Deref, Range};

use use3d_capture::{Image, Map, MediumMaps};
use use3d_numerics::lanes::exp2;

use super::strips::{Planes, Strips};
use super::tile::{BackwardTile, ForwardTile, Input, Lanes, TileWater};
use crate::lists::{Prepared, TILE};
use crate::project::Splat;
use crate::view::{Cotangents, Layers};

thread_local! {
    /// The memory of the thread's last [`RowSplats`], taken up again by its next one.
    static SPARE: Cell<Vec<Splat>> = const { Cell::new(Vec::new()) };
}

/// The Gaussians of a tile row, one per span, side by side. A tile takes few of its row's Gaussians, each a wait for memory where
/// they lie scattered over all of the view's; copied in one go the waits overlap, and the copy fits the second-level cache.
pub(crate) struct RowSplats(Vec<Splat>);

impl Deref for RowSplats {
    type Target = [Splat];

    #[inline(always)]
    fn deref(&self) -> &[Splat] {
        &self.0
    }
}

impl Drop for RowSplats {
    fn drop(&mut self) {
        // Nothing to keep it for in a thread that ends.
        let _ = SPARE.try_with(|spare| spare.set(std::mem::take(&mut self.0)));
    }
}

/// Copies the Gaussians of a tile row.
pub(crate) fn row_splats(prepared: &Prepared, row: usize) -> RowSplats {
    let mut splats = SPARE.take();
    splats.clear();
    splats.extend(prepared.tile_rows[row].spans.iter().map(|span| prepared.splats[span.rank as usize]));
    RowSplats(splats)
}

/// The input of tile (`row`, `column`), with what [`row_splats`] gives for the row.
#[inline(always)]
pub(crate) fn input<'a>(prepared: &'a Prepared, splats: &'a [Splat], row: usize, column: usize) -> Input<'a> {
    let tile_row = &prepared.tile_rows[row];
    Input {
        splats,
        spans: &tile_row.spans,
        list: tile_row.list(column),
        columns: prepared.columns.lanes(column),
        rows: prepared.rows.lanes(row),
        filled_rows: prepared.rows.filled(row),
        filled_columns: prepared.columns.filled(column),
    }
}

/// 16 pixels of a row from `start`; past the end, the last one again.
#[inline(always)]
pub(super) fn get(row: &[f32], start: usize, n: usize) -> Lanes {
    match row[start..].first_chunk() {
        Some(lanes) => *lanes,
        None => each(|l| row[start + l.min(n - 1)]),
    }
}

/// Writes the first `pixels.len()` of the lanes.
#[inline(always)]
pub(super) fn put<T: Copy>(pixels: &mut [T], lanes: &[T; TILE]) {
    match pixels.first_chunk_mut() {
        Some(out) => *out = *lanes,
        None => pixels.copy_from_slice(&lanes[..pixels.len()]),
    }
}

/// A loop, since `array::from_fn` is a call that the instruction set does not reach into.
#[inline(always)]
pub(super) fn each(mut f: impl FnMut(usize) -> f32) -> Lanes {
    let mut lanes = [0.0; TILE];
    for (l, lane) in lanes.iter_mut().enumerate() {
        *lane = f(l);
    }
    lanes
}

/// `|d(p)|` of the 16 pixels of a tile's row.
#[inline(always)]
pub(super) fn ray_lengths(prepared: &Prepared, y: usize, column: usize) -> Lanes {
    let across = get(&prepared.ray_x2, column * TILE, TILE);
    let down = prepared.ray_y2[y];
    each(|l| (1.0 + (across[l] + down)).sqrt())
}

/// Reads the medium's exponents of a tile.
#[inline(always)]
pub(crate) fn load_water(
    prepared: &Prepared,
    medium: &MediumMaps,
    row: usize,
    column: usize,
    water: &mut TileWater,
) {
    let (rows, n) = (prepared.rows.filled(row), prepared.columns.filled(column));
    for r in 0..rows {
        let y = row * TILE + r;
        let ray = ray_lengths(prepared, y, column);
        let factor = each(|l| ray[l] * -std::f32::consts::LOG2_E);
        let out = &mut water.rows[r];
        for c in 0..3 {
            let attenuation = get(medium.attenuation.row(c, y), column * TILE, n);
            let backscatter = get(medium.backscatter.row(c, y), column * TILE, n);
            out.attenuation[c] = each(|l| attenuation[l] * factor[l]);
            out.backscatter[c] = each(|l| backscatter[l] * factor[l]);
        }
    }
    water.centre(rows);
}

/// What a forward pass leaves for the backward pass. It depends on geometry alone, so any medium, colours and cotangents may
/// follow.
#[derive(Clone, Debug, Default)]
pub(crate) struct Saved {
    stamp: u64,
    /// Planes: final transmittance, expected depth, accumulation.
    values: Vec<f32>,
    stop: Vec<i32>,
}

/// Strips of [`Saved`].
pub(crate) struct SavedPlanes<'a> {
    values: Planes<'a, f32, 3>,
    stop: Planes<'a, i32, 1>,
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
        SavedPlanes { values: Planes::of(&mut self.values, w, h), stop: Planes::of(&mut self.stop, w, h) }
    }

    pub(crate) fn is_of(&self, prepared: &Prepared) -> bool {
        self.stamp == prepared.stamp && self.stop.len() == prepared.width * prepared.height
    }

    /// Per pixel, the entry of its tile's list at which compositing stopped; `NEVER` where it did not.
    pub(crate) fn stop(&self) -> &[i32] {
        &self.stop
    }

    pub(crate) fn memory(&self) -> usize {
        (self.values.capacity() + self.stop.capacity()) * 4
    }
}

impl SavedPlanes<'_> {
    #[inline(always)]
    pub(crate) fn store(&mut self, input: &Input<'_>, tile: &ForwardTile, columns: Range<usize>) {
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

/// Strips of a rendered view: image, depth and accumulation.
pub(crate) struct ImagePlanes<'a> {
    image: Planes<'a, f32, 3>,
    maps: [Planes<'a, f32, 1>; 2],
}

impl<'a> ImagePlanes<'a> {
    pub(crate) fn of(image: &'a mut Image, depth: &'a mut Map, accumulation: &'a mut Map) -> Self {
        let (w, h) = (image.width(), image.height());
        let maps = [Planes::of(depth.data_mut(), w, h), Planes::of(accumulation.data_mut(), w, h)];
        Self { image: Planes::of(image.data_mut(), w, h), maps }
    }

    pub(crate) fn absent(width: usize) -> Self {
        Self { image: Planes::absent(width), maps: [Planes::absent(width), Planes::absent(width)] }
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
    input: &Input<'_>,
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

/// Strips of the layers: object, medium, far, clear (three planes each) and distance.
pub(crate) struct LayerPlanes<'a> {
    images: [Planes<'a, f32, 3>; 4],
    distance: Planes<'a, f32, 1>,
}

impl<'a> LayerPlanes<'a> {
    pub(crate) fn of(layers: &'a mut Layers) -> Self {
        let (w, h) = (layers.object.width(), layers.object.height());
        let images = [&mut layers.object, &mut layers.medium, &mut layers.far, &mut layers.clear];
        Self {
            images: images.map(|image| Planes::of(image.data_mut(), w, h)),
            distance: Planes::of(layers.distance.data_mut(), w, h),
        }
    }

    pub(crate) fn absent(width: usize) -> Self {
        Self { images: std::array::from_fn(|_| Planes::absent(width)), distance: Planes::absent(width) }
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

/// A tile after the forward pass, with what it was composed of.
pub(crate) struct Composed<'a> {
    pub(crate) input: &'a Input<'a>,
    pub(crate) water: &'a TileWater,
    pub(crate) tile: &'a ForwardTile,
}

/// Writes the layers of a tile. The interval medium is `c_m (1 − Σ w E) − far`: the telescoped sum without its last term.
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

/// What a backward pass reads of a view.
#[derive(Clone, Copy)]
pub(crate) struct BackwardRead<'a> {
    pub(crate) prepared: &'a Prepared,
    pub(crate) medium: Option<&'a MediumMaps>,
    pub(crate) cotangents: &'a Cotangents<'a>,
    /// What the forward pass left; `None` where the pass goes front to back itself.
    pub(crate) saved: Option<&'a Saved>,
}

/// Sets a tile up for the backward pass.
#[inline(always)]
pub(crate) fn load_cotangents(read: &BackwardRead<'_>, row: usize, column: usize, tile: &mut BackwardTile) {
    let BackwardRead { prepared, medium, cotangents, saved } = *read;
    let (rows, n) = (prepared.rows.filled(row), prepared.columns.filled(column));
    let x = column * TILE;
    let pixels = prepared.width * prepared.height;
    *tile = BackwardTile::ZERO;
    for (r, out) in tile.rows[..rows].iter_mut().enumerate() {
        let y = row * TILE + r;
        for c in 0..3 {
            out.image[c] = get(cotangents.image.row(c, y), x, n);
            if let Some(medium) = medium {
                let color = get(medium.color.row(c, y), x, n);
                out.veiled[c] = each(|l| -(out.image[c][l] * color[l]));
            }
            if let Some(clear) = cotangents.clear {
                out.clear[c] = get(clear.row(c, y), x, n);
            }
        }
        let Some(saved) = saved else { continue };
        let start = y * prepared.width + x;
        // Padding keeps its stop of 0: it takes no part.
        out.stop[..n].copy_from_slice(&saved.stop[start..start + n]);
        let row = |plane: usize| &saved.values[plane * pixels + y * prepared.width..][..prepared.width];
        out.transmittance = get(row(0), x, n);
        if let Some(accumulation) = cotangents.accumulation {
            out.weight = get(accumulation.row(0, y), x, n);
        }
        if let Some(depth) = cotangents.depth {
            // depth = Σwz / max(Σw, 1e-6)
            let (g, value, sum) = (get(depth.row(0, y), x, n), get(row(1), x, n), get(row(2), x, n));
            out.depth = each(|l| g[l] / sum[l].max(1e-6));
            let weight = out.weight;
            out.weight =
                each(|l| if sum[l] > 1e-6 { weight[l] - out.depth[l] * value[l] } else { weight[l] });
        }
    }
}

/// Strips of the medium's gradient: colour, backscatter, attenuation.
pub(crate) struct MediumPlanes<'a> {
    pub(super) maps: [Planes<'a, f32, 3>; 3],
}

impl<'a> MediumPlanes<'a> {
    pub(crate) fn of(grads: Option<&'a mut MediumMaps>, prepared: &Prepared) -> Self {
        let (w, h) = (prepared.width, prepared.height);
        let maps = match grads {
            Some(grads) => {
                grads.resize(w, h);
                [&mut grads.color, &mut grads.backscatter, &mut grads.attenuation]
                    .map(|image| Planes::of(image.data_mut(), w, h))
            }
            None => std::array::from_fn(|_| Planes::absent(w)),
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

/// Writes the medium's gradient of a tile: `∂c_m = g (1 − Σ w E_b)`, `∂β_b = |d| Σ w z g c_m E_b`, `∂β_a = −|d| Σ w z g c E_a`.
#[inline(always)]
pub(crate) fn store_medium_gradient<const WATER: bool>(
    prepared: &Prepared,
    input: &Input<'_>,
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
