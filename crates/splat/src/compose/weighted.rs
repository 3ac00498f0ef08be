//! Composes a view from its kept weights: a sparse product forward, and its transpose backward.
//!
//! With frozen geometry (stage 2) the weights `w = T α` of a pixel and the depths `z` of its Gaussians are
//! constants. No list is walked and no opacity is computed again. With `E = e^{−β z |d|}` for attenuation
//! `a` and backscatter `b`, and `g = ∂I`, sums over the pairs of a pixel (of a Gaussian `i` in `∂c_i`) are
//!
//! ```text
//! I = Σ w E_a c + c_m (1 − Σ w E_b)
//! ∂c_i = Σ w E_a g          ∂c_m = g (1 − Σ w E_b)
//! ∂β_a = −|d| Σ w z E_a c g          ∂β_b = |d| g c_m Σ w z E_b
//! ```
//!
//! Sixteen pairs of a pixel compute their exponentials at once. The products with colours run pair by pair
//! in depth order, with the channels as lanes. Gradients are summed per tile, then per Gaussian in the order
//! of tiles.
//!
//! Limit: a view keeps weights if it has at most [`MOST_PIXELS`] pixels, so that a large view does not take
//! hundreds of megabytes.

use fearless_simd::{Level, Simd, SimdBase, SimdFloat, dispatch, f32x4, f32x16};
use rayon::prelude::*;
use use3d_capture::{Image, MediumMaps};
use use3d_numerics::lanes::{exp2_lanes, sum};

use super::groups::{Records, in_groups};
use super::inputs::{input, row_splats};
use super::outputs::{ImagePlanes, MediumPlanes, image_planes, medium_planes};
use super::pixels::{each, get, put, ray_lengths};
use super::plain;
use super::strips::for_each;
use super::tile::{ForwardTile, Lanes, Sink, place};
use crate::lists::{Prepared, RowWeights, TILE};
use crate::project::LOG2_255;
use crate::view::Rendered;

/// Most pixels of a view that keeps its weights.
const MOST_PIXELS: usize = 1 << 14;

/// Red, green, blue and a zero.
pub(super) type Channels = [f32; 4];

/// Composes views that keep their weights, in both directions. Its working memory has one element per entry
/// of the lists.
#[derive(Clone, Debug, Default)]
pub(super) struct Weighted {
    /// The stamps of the view whose colours are loaded.
    colored: (u64, u64),
    /// Colours and their gradients, tile after tile.
    colors: Vec<Channels>,
    sums: Vec<Channels>,
    /// The gradients again, in the order of spans.
    records: Vec<Channels>,
    /// The gradients of the visible Gaussians' colours, by rank.
    pub(super) d_colors: Vec<Channels>,
}

impl Weighted {
    /// Number of bytes of working memory held.
    pub(super) fn memory(&self) -> usize {
        let Self { colored: _, colors, sums, records, d_colors } = self;
        [colors, sums, records, d_colors].iter().map(|v| v.capacity()).sum::<usize>() * size_of::<Channels>()
    }

    /// Copies the view's colours to the order in which tiles read them.
    fn load_colors(&mut self, prepared: &Prepared) {
        let stamps = (prepared.stamp, prepared.colors);
        if self.colored == stamps {
            return;
        }
        self.colored = stamps;
        let colors = Records::per_entry(&mut self.colors, prepared);
        for_each(0..prepared.rows.tiles(), colors, &|row, colors: Records<'_, 4>| {
            let row = &prepared.tile_rows[row];
            for (out, &span) in colors.records.iter_mut().zip(&row.entries) {
                let [r, g, b] = prepared.splats[row.spans[span as usize].rank as usize].color;
                *out = [r, g, b, 0.0];
            }
        });
    }

    /// Composes a view that keeps its weights.
    pub(super) fn forward<const WATER: bool>(
        &mut self,
        level: Level,
        prepared: &Prepared,
        medium: Option<&MediumMaps>,
        out: &mut Rendered,
    ) {
        self.load_colors(prepared);
        let colors = Records::per_entry(&mut self.colors, prepared);
        let images = image_planes(&mut out.image, &mut out.depth, &mut out.accumulation);
        for_each(0..prepared.rows.tiles(), (colors, images), &|row, strips| {
            dispatch!(level, simd => forward_row::<_, WATER>(simd, prepared, medium, row, strips));
        });
    }

    /// Differentiates a view that keeps its weights, into `self.d_colors` and `d_medium`.
    pub(super) fn backward<const WATER: bool>(
        &mut self,
        level: Level,
        prepared: &Prepared,
        medium: Option<&MediumMaps>,
        d_image: &Image,
        d_medium: Option<&mut MediumMaps>,
    ) {
        self.load_colors(prepared);
        let Self { colors, sums, records, d_colors, .. } = self;
        let scratch = (Records::per_entry(colors, prepared), Records::per_entry(sums, prepared));
        let strips = (scratch, medium_planes(d_medium, prepared));
        in_groups(prepared, records, d_colors, strips, &|row, records: &mut [Channels], strips| {
            dispatch!(level, simd => backward_row::<_, WATER>(
                simd, prepared, (medium, d_image), row, records, strips
            ));
        });
    }
}

/// Computes the weights of a view, if it is small enough; otherwise returns no rows.
pub(super) fn weights(prepared: &Prepared) -> Vec<RowWeights> {
    let rows = &prepared.tile_rows;
    let longest = rows.iter().flat_map(|row| row.offsets.windows(2).map(|o| o[1] - o[0])).max();
    if prepared.width * prepared.height > MOST_PIXELS || longest > Some(1 << u16::BITS) {
        return Vec::new();
    }
    let level = Level::new();
    (0..rows.len())
        .into_par_iter()
        .with_max_len(1)
        .map(|row| dispatch!(level, _simd => row_weights(prepared, row)))
        .collect()
}

#[inline(always)]
fn row_weights(prepared: &Prepared, row: usize) -> RowWeights {
    let splats = row_splats(prepared, row);
    let mut out = RowWeights { starts: vec![0], ..RowWeights::default() };
    let mut pairs: Vec<(usize, u16, f32)> = Vec::new();
    for column in 0..prepared.columns.tiles() {
        let input = input(prepared, &splats, row, column);
        let mut state = ForwardTile::new(input.filled_rows, input.filled_columns);
        pairs.clear();
        for k in 0..input.list.len() {
            let splat = input.entry(k).1;
            for r in 0..input.filled_rows {
                let terms = splat.row(input.rows[r]);
                // No pixel of the row is nearer to the row's peak than this.
                let t = terms.peak.max(input.columns[0]).min(input.columns[TILE - 1]) - terms.peak;
                if (t * splat.steepness).mul_add(-t, terms.power) < -LOG2_255 {
                    continue;
                }
                for (l, &x) in input.columns.iter().enumerate() {
                    let (cell, lane) = place(r, l);
                    if let Some(w) = plain::weight(splat, terms, x, &mut state.cells[cell], lane, k) {
                        pairs.push((r * TILE + l, k as u16, w));
                    }
                }
            }
        }
        // Counts the pairs of each pixel, and then places them; they stay in depth order.
        let mut next = [0usize; TILE * TILE];
        pairs.iter().for_each(|&(pixel, ..)| next[pixel] += 1);
        let mut end = out.entries.len();
        for next in &mut next {
            (*next, end) = (end, end + *next);
            out.starts.push(end as u32);
        }
        out.entries.resize(end, 0);
        out.depths.resize(end, 0.0);
        out.weights.resize(end, 0.0);
        let sums = out.sums.len();
        out.sums.resize(sums + TILE * TILE, [0.0; 2]);
        for &(pixel, k, w) in &pairs {
            let (at, z) = (next[pixel], input.entry(k.into()).1.z);
            next[pixel] += 1;
            (out.entries[at], out.depths[at], out.weights[at]) = (k, z, w);
            let [wz, total] = &mut out.sums[sums + pixel];
            (*wz, *total) = (w.mul_add(z, *wz), *total + w);
        }
    }
    let padded = out.entries.len() + TILE;
    out.depths.resize(padded, 1.0);
    out.weights.resize(padded, 0.0);
    for plane in [&mut out.depths, &mut out.weights] {
        plane.shrink_to_fit();
    }
    out.starts.shrink_to_fit();
    out.entries.shrink_to_fit();
    out.sums.shrink_to_fit();
    out
}

/// Up to sixteen pairs of a pixel.
struct Block<S: Simd> {
    z: f32x16<S>,
    /// `w E_a` of each pair.
    object: [Channels; TILE],
    /// `w E_b` of each channel.
    veil: [f32x16<S>; 3],
}

impl<S: Simd> Block<S> {
    /// The pairs from `at`, at most up to `end`; `exponents` are `−β |d| log₂e`, attenuation rgb, then
    /// backscatter rgb.
    #[inline(always)]
    fn new<const WATER: bool>(
        simd: S,
        of: &RowWeights,
        (at, end): (usize, usize),
        exponents: [f32; 6],
    ) -> Self {
        const NUMBERS: Lanes = [0., 1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 11., 12., 13., 14., 15.];
        let c = |v: f32| f32x16::splat(simd, v);
        let lanes = |plane: &[f32]| f32x16::from_slice(simd, &plane[at..at + TILE]);
        let z = lanes(&of.depths);
        let inside = f32x16::load_array_ref(simd, &NUMBERS).simd_lt(c((end - at) as f32));
        let w = fearless_simd::Select::select(inside, lanes(&of.weights), c(0.0));
        let mut through = [w; 6];
        if WATER {
            for q in 0..6 {
                through[q] = w * exp2_lanes(simd, z * c(exponents[q]));
            }
        }
        let [r, g, b, veil @ ..] = through;
        let (low, high) = (r.zip_low(b), r.zip_high(b));
        let (low_g, high_g) = (g.zip_low(c(0.0)), g.zip_high(c(0.0)));
        let mut object = [[0.0; 4]; TILE];
        let quarters = [low.zip_low(low_g), low.zip_high(low_g), high.zip_low(high_g), high.zip_high(high_g)];
        for q in 0..4 {
            quarters[q].store_slice(object[4 * q..4 * q + 4].as_flattened_mut());
        }
        Self { z, object, veil }
    }
}

/// `−β |d| log₂e` of the six quantities of a tile's pixel row, and `|d|`.
#[inline(always)]
fn exponents(prepared: &Prepared, medium: &MediumMaps, y: usize, column: usize) -> ([Lanes; 6], Lanes) {
    let (x, n) = (column * TILE, prepared.columns.filled(column));
    let ray = ray_lengths(prepared, y, column);
    let mut out = [[0.0; TILE]; 6];
    for (q, out) in out.iter_mut().enumerate() {
        let map = if q < 3 { &medium.attenuation } else { &medium.backscatter };
        let beta = get(map.row(q % 3, y), x, n);
        *out = each(|l| beta[l] * (ray[l] * -std::f32::consts::LOG2_E));
    }
    (out, ray)
}

/// The values of pixel `l`.
#[inline(always)]
fn lane<const N: usize>(planes: &[Lanes; N], l: usize) -> [f32; N] {
    let mut out = [0.0; N];
    for q in 0..N {
        out[q] = planes[q][l];
    }
    out
}

/// Composes a tile row.
#[inline(always)]
fn forward_row<S: Simd, const WATER: bool>(
    simd: S,
    prepared: &Prepared,
    medium: Option<&MediumMaps>,
    row: usize,
    (colors, mut images): (Records<'_, 4>, ImagePlanes<'_>),
) {
    let (of, tile_row) = (&prepared.weights[row], &prepared.tile_rows[row]);
    for column in 0..prepared.columns.tiles() {
        let colors = &colors.records[tile_row.range(column)];
        let (x, n) = (column * TILE, prepared.columns.filled(column));
        for r in 0..prepared.rows.filled(row) {
            let y = row * TILE + r;
            let water = medium.map(|medium| exponents(prepared, medium, y, column).0);
            let (mut object, mut veil) = ([[0.0; TILE]; 4], [[0.0; TILE]; 3]);
            let (mut depth, mut accumulation) = ([0.0; TILE], [0.0; TILE]);
            for l in 0..n {
                let exponents = water.as_ref().map_or([0.0; 6], |planes| lane(planes, l));
                let (start, end) = of.pairs(column, r, l);
                let (mut light, mut hidden) = (f32x4::splat(simd, 0.0), [f32x16::splat(simd, 0.0); 3]);
                for at in (start..end).step_by(TILE) {
                    let block = Block::new::<WATER>(simd, of, (at, end), exponents);
                    for (&k, w) in of.entries[at..end.min(at + TILE)].iter().zip(&block.object) {
                        let color = f32x4::load_array_ref(simd, &colors[usize::from(k)]);
                        light = f32x4::load_array_ref(simd, w).mul_add(color, light);
                    }
                    for q in 0..3 {
                        hidden[q] += block.veil[q];
                    }
                }
                let light = light.to_array();
                for q in 0..3 {
                    object[q][l] = light[q];
                    veil[q][l] = sum(&hidden[q].to_array());
                }
                let [wz, w] = of.sums[(column * TILE + r) * TILE + l];
                (depth[l], accumulation[l]) = (wz / w.max(1e-6), w);
            }
            for q in 0..3 {
                if let Some(medium) = medium {
                    let color = get(medium.color.row(q, y), x, n);
                    object[q] = each(|l| color[l].mul_add(1.0 - veil[q][l], object[q][l]));
                }
                put(images.row(q, r, x..x + n), &object[q]);
            }
            put(images.row(3, r, x..x + n), &depth);
            put(images.row(4, r, x..x + n), &accumulation);
        }
    }
}

/// The strips that the backward pass of a tile row uses: colours, sums of gradients, and the water's
/// gradient.
type Backward<'a> = ((Records<'a, 4>, Records<'a, 4>), MediumPlanes<'a>);

/// Differentiates a tile row, and writes one record per span.
#[inline(always)]
fn backward_row<S: Simd, const WATER: bool>(
    simd: S,
    prepared: &Prepared,
    (medium, d_image): (Option<&MediumMaps>, &Image),
    row: usize,
    records: &mut [Channels],
    ((colors, sums), mut d_medium): Backward<'_>,
) {
    let (of, tile_row) = (&prepared.weights[row], &prepared.tile_rows[row]);
    for column in 0..prepared.columns.tiles() {
        let colors = &colors.records[tile_row.range(column)];
        let sums = &mut sums.records[tile_row.range(column)];
        sums.fill([0.0; 4]);
        let (x, n) = (column * TILE, prepared.columns.filled(column));
        for r in 0..prepared.rows.filled(row) {
            let y = row * TILE + r;
            let water = medium.map(|medium| exponents(prepared, medium, y, column));
            let mut image = [[0.0; TILE]; 3];
            for q in 0..3 {
                image[q] = get(d_image.row(q, y), x, n);
            }
            let (mut veil, mut veil_moment, mut object_moment) =
                ([[0.0; TILE]; 3], [[0.0; TILE]; 3], [[0.0; TILE]; 3]);
            for l in 0..n {
                let exponents = water.as_ref().map_or([0.0; 6], |(planes, _)| lane(planes, l));
                let [red, green, blue] = lane(&image, l);
                let g = f32x4::load_array_ref(simd, &[red, green, blue, 0.0]);
                let zero = f32x16::splat(simd, 0.0);
                let (mut hidden, mut hidden_z, mut light_z) = ([zero; 3], [zero; 3], f32x4::splat(simd, 0.0));
                let (start, end) = of.pairs(column, r, l);
                for at in (start..end).step_by(TILE) {
                    let block = Block::new::<WATER>(simd, of, (at, end), exponents);
                    let pairs = of.entries[at..end.min(at + TILE)].iter().zip(&of.depths[at..]);
                    for ((&k, &z), w) in pairs.zip(&block.object) {
                        let k = usize::from(k);
                        let d = f32x4::load_array_ref(simd, w) * g;
                        (f32x4::load_array_ref(simd, &sums[k]) + d).store_array(&mut sums[k]);
                        if WATER {
                            let lit = d * f32x4::load_array_ref(simd, &colors[k]);
                            light_z = f32x4::splat(simd, z).mul_add(lit, light_z);
                        }
                    }
                    for q in 0..3 {
                        hidden[q] += block.veil[q];
                        hidden_z[q] = block.z.mul_add(block.veil[q], hidden_z[q]);
                    }
                }
                let light_z = light_z.to_array();
                for q in 0..3 {
                    veil[q][l] = sum(&hidden[q].to_array());
                    veil_moment[q][l] = sum(&hidden_z[q].to_array());
                    object_moment[q][l] = light_z[q];
                }
            }
            if !d_medium.present() {
                continue;
            }
            for q in 0..3 {
                let mut d = [[0.0; TILE]; 3];
                if let Some((medium, (_, ray))) = medium.zip(water.as_ref()) {
                    let color = get(medium.color.row(q, y), x, n);
                    d = [
                        each(|l| image[q][l] * (1.0 - veil[q][l])),
                        each(|l| image[q][l] * color[l] * veil_moment[q][l] * ray[l]),
                        each(|l| -object_moment[q][l] * ray[l]),
                    ];
                }
                for (k, d) in d.iter().enumerate() {
                    put(d_medium.row(3 * k + q, r, x..x + n), d);
                }
            }
        }
        let mut sink = Sink { spans: &tile_row.spans, records: &mut *records, column: column as u32 };
        for (&span, &sum) in tile_row.list(column).iter().zip(&*sums) {
            sink.put(span as usize, sum);
        }
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{Camera, Formation, Intrinsics, Lattice, Pose};
    use use3d_numerics::math;

    use super::*;
    use crate::lists::tests::cloud;
    use crate::{Colors, Options, Rasterizer};

    /// An image, its depth and accumulation, and the gradients of colours and water.
    type Results = (Rendered, Vec<[f32; 3]>, MediumMaps);

    fn run(rasterizer: &mut Rasterizer, view: &Prepared, water: Option<&MediumMaps>, d: &Image) -> Results {
        let mut out = Rendered::new();
        let mut colors = vec![[0.0; 3]; view.gaussians()];
        let mut d_water = MediumMaps::zeros(0, 0);
        rasterizer.forward(view, water, &Options::default(), &mut out);
        rasterizer.backward_colors(view, water, d, &mut colors, &mut d_water);
        (out, colors, d_water)
    }

    fn close(what: &str, a: &[f32], b: &[f32]) {
        let largest = b.iter().fold(0.0f32, |m, v| m.max(v.abs()));
        for (a, b) in a.iter().zip(b) {
            assert!((a - b).abs() <= 2e-6 * largest, "{what}: {a} {b}, largest {largest}");
        }
    }

    #[test]
    fn kept_weights_compose_what_the_lists_compose() {
        let intrinsics = Intrinsics { width: 150, height: 116, fx: 120.0, fy: 124.0, cx: 70.0, cy: 60.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let every = |step: usize, n: usize| (0..n).step_by(step).collect::<Vec<_>>();
        let lattice = Lattice::subset(&every(3, 150), &every(4, 116)).unwrap();
        let gaussians = cloud(3000, -3.0, 1.0);
        let mut lists = Prepared::new();
        lists.prepare(&gaussians, &camera, &lattice, Colors::Sh { degree: 0 });
        let mut kept = lists.clone();
        Rasterizer::new().trim(&mut kept);
        let pairs: usize = kept.weights.iter().map(|row| row.entries.len()).sum();
        assert_eq!(kept.pairs().contributing, pairs as u64);
        let (w, h) = (lattice.width(), lattice.height());
        let wave = |k: usize, scale: f32| {
            let data = (0..3 * w * h).map(|i| scale * (0.3 + 0.2 * math::sin((i + k) as f32))).collect();
            Image::from_planes(w, h, data).unwrap()
        };
        let d = wave(4, 1.0);
        // Thin water, water with strong differences inside a tile, and the form that is applied per image.
        let waters =
            [(0.1, Formation::PerGaussian), (4.0, Formation::PerGaussian), (1.0, Formation::PerImage)];
        let waters = waters.map(|(scale, formation)| {
            let [backscatter, attenuation] = [2, 3].map(|k| wave(k, scale));
            MediumMaps { color: wave(1, 1.0), backscatter, attenuation, formation, network: None }
        });
        for water in waters.iter().map(Some).chain([None]) {
            let (image, colors, d_water) = run(&mut Rasterizer::plain(), &lists, water, &d);
            let weighted = run(&mut Rasterizer::new(), &kept, water, &d);
            close("image", weighted.0.image.data(), image.image.data());
            close("depth", weighted.0.depth.data(), image.depth.data());
            close("accumulation", weighted.0.accumulation.data(), image.accumulation.data());
            close("colours", weighted.1.as_flattened(), colors.as_flattened());
            for (a, b) in [
                (&weighted.2.color, &d_water.color),
                (&weighted.2.backscatter, &d_water.backscatter),
                (&weighted.2.attenuation, &d_water.attenuation),
            ] {
                close("water", a.data(), b.data());
            }
            if let Some(avx2) = Level::new().as_avx2() {
                let mut rasterizer = Rasterizer::with_level(Level::Avx2(avx2));
                assert!(run(&mut rasterizer, &kept, water, &d) == weighted, "the bits of AVX2 differ");
            }
            let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
            assert!(one.install(|| run(&mut Rasterizer::new(), &kept, water, &d)) == weighted);
        }
    }

    #[test]
    fn a_large_view_keeps_no_weights() {
        let intrinsics = Intrinsics { width: 150, height: 116, fx: 120.0, fy: 124.0, cx: 70.0, cy: 60.0 };
        let mut view = Prepared::new();
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        view.prepare(&cloud(30, -3.0, 1.0), &camera, &Lattice::full(&intrinsics), Colors::Sh { degree: 0 });
        Rasterizer::new().trim(&mut view);
        assert!(view.weights.is_empty() && view.width * view.height > MOST_PIXELS);
    }
}
