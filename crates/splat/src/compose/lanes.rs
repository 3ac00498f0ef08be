//! The compositor on 16 lanes: one row of a tile is one vector. Every function here is the lane form of its namesake in
//! [`plain`](crate::compose::plain), with the same operations in the same order per pixel and per sum.
//!
//! The Gaussian is outermost inside a tile: the tile's pixel state stays in the first-level cache, the Gaussian's gradient sums in
//! registers. For each (tile, Gaussian) entry one vector holds the 16 rows and says which of them the 1/255
//! contour meets (exactly: the row's nearest pixel centre is put to the test that the pixels face), so that dead rows cost nothing.

use fearless_simd::{Simd, SimdBase, SimdFloat, SimdMask, f32x4, f32x16, i32x16, mask32x16};
use use3d_numerics::lanes::{SMALL_COEFFICIENTS, exp2_lanes, exp2_unclamped_lanes};

use super::tile::{
    ALPHA_MAX, BackwardTile, CHANNELS, ForwardRow, ForwardTile, Input, Lanes, NEVER, STOP, Sink, Water,
    WaterRow, moments,
};
use crate::lists::{Span, TILE};
use crate::project::{LOG2_255, Record, Splat, SplatGradient};

#[inline(always)]
fn load<S: Simd>(simd: S, lanes: &Lanes) -> f32x16<S> {
    f32x16::load_array_ref(simd, lanes)
}

/// `lanes += a b`.
#[inline(always)]
fn accumulate<S: Simd>(simd: S, lanes: &mut Lanes, a: f32x16<S>, b: f32x16<S>) {
    a.mul_add(b, load(simd, lanes)).store_array(lanes);
}

/// One Gaussian against the 16 rows of a tile.
struct RowsOf {
    /// Rows that the contour meets.
    live: u32,
    peak: Lanes,
    power: Lanes,
}

#[inline(always)]
fn rows_of<S: Simd>(simd: S, splat: &Splat, rows: f32x16<S>, columns: &Lanes) -> RowsOf {
    let c = |v: f32| f32x16::splat(simd, v);
    let dy = rows - c(splat.y);
    let peak = c(splat.shear).mul_add(-dy, c(splat.x));
    let power = c(splat.steepness_y).mul_add(-(dy * dy), c(splat.log2_opacity));
    // The pixel centre nearest to the peak, if the peak were between the first and the last: at least as near as any pixel.
    let t = peak.max(c(columns[0])).min(c(columns[TILE - 1])) - peak;
    let best = (t * c(splat.steepness)).mul_add(-t, power);
    let live = best.simd_ge(c(-LOG2_255)).to_bitmask() as u32;
    RowsOf { live, peak: peak.to_array(), power: power.to_array() }
}

/// Entry `k` (the last one, past the end) with its rows. Callers look one entry ahead: how many rows the next entry has is then known before
/// its turn, and the processor does not stall where it guessed wrong.
#[inline(always)]
fn entry_rows<'a, S: Simd>(
    simd: S,
    input: &Input<'a>,
    k: usize,
    rows: f32x16<S>,
) -> (&'a Span, &'a Splat, RowsOf) {
    let (span, splat) = input.entry(k.min(input.list.len() - 1));
    (span, splat, rows_of(simd, splat, rows, input.columns))
}

/// The rows' bit mask as an iterator.
struct Bits(u32);

impl Iterator for Bits {
    type Item = usize;

    #[inline(always)]
    fn next(&mut self) -> Option<usize> {
        if self.0 == 0 {
            return None;
        }
        let bit = self.0.trailing_zeros() as usize;
        self.0 &= self.0 - 1;
        // The mask tells the compiler that rows are in range.
        Some(bit & (TILE - 1))
    }
}

/// The exponentials of one Gaussian in one tile; see the scalar `Decay`.
struct Decay<S: Simd> {
    z: f32x16<S>,
    /// `factor · scale · q_j`, or unused.
    coefficients: [Lanes; 4],
    exponent: Lanes,
    scale: Lanes,
}

impl<S: Simd> Decay<S> {
    #[inline(always)]
    fn new(simd: S, water: &Water, z: f32, color: [f32; 3]) -> Self {
        let mut scale = [1.0; TILE];
        scale[..3].copy_from_slice(&color);
        let depth = f32x16::splat(simd, z);
        let exponent = load(simd, &water.centre) * depth;
        let factor = exp2_lanes(simd, exponent) * load(simd, &scale);
        let [_, q1, q2, q3] = SMALL_COEFFICIENTS;
        let coefficients = [
            factor.to_array(),
            (factor * f32x16::splat(simd, q1)).to_array(),
            (factor * f32x16::splat(simd, q2)).to_array(),
            (factor * f32x16::splat(simd, q3)).to_array(),
        ];
        Self { z: depth, coefficients, exponent: exponent.to_array(), scale }
    }

    #[inline(always)]
    fn at<const SMALL: bool, const SCALED: bool>(
        &self,
        simd: S,
        q: usize,
        deviation: f32x16<S>,
    ) -> f32x16<S> {
        let c = |v: f32| f32x16::splat(simd, v);
        if SMALL {
            let x = deviation * self.z;
            let k = &self.coefficients;
            c(k[3][q]).mul_add(x, c(k[2][q])).mul_add(x, c(k[1][q])).mul_add(x, c(k[0][q]))
        } else {
            let e = exp2_lanes(simd, deviation.mul_add(self.z, c(self.exponent[q])));
            if SCALED { e * c(self.scale[q]) } else { e }
        }
    }
}

#[inline(always)]
fn filled(input: &Input<'_>) -> u32 {
    ((1u64 << input.filled_rows) - 1) as u32
}

/// `log₂ α` and `t` of a row.
#[inline(always)]
fn log2_alpha<S: Simd>(
    simd: S,
    steepness: f32x16<S>,
    columns: f32x16<S>,
    rows: &RowsOf,
    r: usize,
) -> (f32x16<S>, f32x16<S>) {
    let t = columns - f32x16::splat(simd, rows.peak[r]);
    ((t * steepness).mul_add(-t, f32x16::splat(simd, rows.power[r])), t)
}

/// Lets the Gaussian through a row: its weights, with transmittance, threshold and stop brought up to date. `alive` loses the row once all its
/// pixels have stopped.
#[inline(always)]
fn weights<S: Simd>(
    simd: S,
    power: f32x16<S>,
    row: &mut ForwardRow,
    r: usize,
    k: usize,
    alive: &mut u32,
) -> f32x16<S> {
    let c = |v: f32| f32x16::splat(simd, v);
    let live = power.simd_ge(load(simd, &row.threshold));
    let alpha = exp2_unclamped_lanes(simd, power).min(c(ALPHA_MAX));
    let alpha = select(live, alpha, c(0.0));
    let before = load(simd, &row.transmittance);
    let w = before * alpha;
    let rest = before * (c(1.0) - alpha);
    let stopped = rest.simd_le(c(STOP));
    if stopped.any_true() {
        stop(simd, stopped, row, r, k, alive);
        select(stopped, before, rest).store_array(&mut row.transmittance);
        select(stopped, c(0.0), w)
    } else {
        rest.store_array(&mut row.transmittance);
        w
    }
}

#[inline(always)]
fn select<S: Simd>(mask: mask32x16<S>, a: f32x16<S>, b: f32x16<S>) -> f32x16<S> {
    fearless_simd::Select::select(mask, a, b)
}

#[inline(always)]
fn stop<S: Simd>(simd: S, stopped: mask32x16<S>, row: &mut ForwardRow, r: usize, k: usize, alive: &mut u32) {
    let threshold = select(stopped, f32x16::splat(simd, f32::INFINITY), load(simd, &row.threshold));
    threshold.store_array(&mut row.threshold);
    let stops: i32x16<S> = fearless_simd::Select::select(
        stopped,
        i32x16::splat(simd, k as i32),
        i32x16::load_array_ref(simd, &row.stop),
    );
    stops.store_array(&mut row.stop);
    if threshold.simd_ge(f32x16::splat(simd, f32::INFINITY)).all_true() {
        *alive &= !(1 << r);
    }
}

/// See [`plain::forward`](crate::compose::plain::forward).
#[inline(always)]
pub(crate) fn forward<S: Simd, const WATER: bool, const LAYERS: bool>(
    simd: S,
    input: &Input<'_>,
    water: &Water,
    tile: &mut ForwardTile,
) {
    let (columns, rows) = (load(simd, input.columns), load(simd, input.rows));
    let mut alive = filled(input);
    if input.list.is_empty() {
        return;
    }
    let mut next = entry_rows(simd, input, 0, rows);
    for k in 0..input.list.len() {
        let (_, splat, mut of) = next;
        next = entry_rows(simd, input, k + 1, rows);
        of.live &= alive;
        if of.live == 0 {
            continue;
        }
        if !WATER {
            forward_rows::<S, false, LAYERS, false>(
                simd, splat, &of, None, columns, water, tile, k, &mut alive,
            );
        } else {
            let decay = Decay::new(simd, water, splat.z, splat.color);
            if splat.z <= water.near {
                forward_rows::<S, true, LAYERS, true>(
                    simd,
                    splat,
                    &of,
                    Some(&decay),
                    columns,
                    water,
                    tile,
                    k,
                    &mut alive,
                );
            } else {
                forward_rows::<S, true, LAYERS, false>(
                    simd,
                    splat,
                    &of,
                    Some(&decay),
                    columns,
                    water,
                    tile,
                    k,
                    &mut alive,
                );
            }
        }
        if alive == 0 {
            break;
        }
    }
}

#[inline(always)]
fn forward_rows<S: Simd, const WATER: bool, const LAYERS: bool, const SMALL: bool>(
    simd: S,
    splat: &Splat,
    of: &RowsOf,
    decay: Option<&Decay<S>>,
    columns: f32x16<S>,
    water: &Water,
    tile: &mut ForwardTile,
    k: usize,
    alive: &mut u32,
) {
    let c = |v: f32| f32x16::splat(simd, v);
    let (steepness, z) = (c(splat.steepness), c(splat.z));
    for r in Bits(of.live) {
        let row = &mut tile.rows[r];
        let (power, _) = log2_alpha(simd, steepness, columns, of, r);
        let w = weights(simd, power, row, r, k, alive);
        accumulate(simd, &mut row.depth, w, z);
        (load(simd, &row.accumulation) + w).store_array(&mut row.accumulation);
        for q in 0..3 {
            if WATER && let Some(decay) = decay {
                let water = &water.rows[r];
                let object = decay.at::<SMALL, true>(simd, q, load(simd, &water.attenuation[q]));
                let veil = decay.at::<SMALL, false>(simd, q + 3, load(simd, &water.backscatter[q]));
                accumulate(simd, &mut row.object[q], w, object);
                accumulate(simd, &mut row.veil[q], w, veil);
            } else {
                accumulate(simd, &mut row.object[q], w, c(splat.color[q]));
            }
            if LAYERS {
                accumulate(simd, &mut row.clear[q], w, c(splat.color[q]));
            }
        }
        if LAYERS {
            let last = select(w.simd_gt(c(0.0)), z, load(simd, &row.last));
            last.store_array(&mut row.last);
        }
    }
}

/// See [`plain::backward`](crate::compose::plain::backward).
#[inline(always)]
pub(crate) fn backward<S: Simd, const WATER: bool, const EXTRAS: bool>(
    simd: S,
    input: &Input<'_>,
    water: &Water,
    tile: &mut BackwardTile,
    s_gradient: f32,
    sink: &mut Sink<'_>,
) {
    let (columns, rows) = (load(simd, input.columns), load(simd, input.rows));
    let origin = [input.columns[TILE / 2], input.rows[TILE / 2]];
    let offset = columns - f32x16::splat(simd, origin[0]);
    let eta: Lanes = (rows - f32x16::splat(simd, origin[1])).to_array();
    // A row takes part below the farthest of its stops.
    let mut stops = [0; TILE];
    for (stop, row) in stops.iter_mut().zip(&tile.rows[..input.filled_rows]) {
        *stop = row.stop.iter().copied().max().unwrap_or(NEVER);
    }
    let stops = i32x16::load_array_ref(simd, &stops);
    if input.list.is_empty() {
        return;
    }
    let mut next = entry_rows(simd, input, input.list.len() - 1, rows);
    for k in (0..input.list.len()).rev() {
        let (span, splat, mut of) = next;
        next = entry_rows(simd, input, k.saturating_sub(1), rows);
        of.live &= stops.simd_gt(i32x16::splat(simd, k as i32)).to_bitmask() as u32;
        if of.live == 0 {
            sink.put(span, [0.0; 12]);
            continue;
        }
        let lanes = if !WATER {
            backward_rows::<S, false, EXTRAS, false>(
                simd, splat, &of, None, columns, &eta, input.rows, water, tile, k, s_gradient,
            )
        } else {
            let decay = Decay::new(simd, water, splat.z, [1.0; 3]);
            if splat.z <= water.near {
                backward_rows::<S, true, EXTRAS, true>(
                    simd,
                    splat,
                    &of,
                    Some(&decay),
                    columns,
                    &eta,
                    input.rows,
                    water,
                    tile,
                    k,
                    s_gradient,
                )
            } else {
                backward_rows::<S, true, EXTRAS, false>(
                    simd,
                    splat,
                    &of,
                    Some(&decay),
                    columns,
                    &eta,
                    input.rows,
                    water,
                    tile,
                    k,
                    s_gradient,
                )
            }
        };
        sink.put(span, finish(simd, splat, origin, offset, lanes));
    }
}

#[inline(always)]
fn backward_rows<S: Simd, const WATER: bool, const EXTRAS: bool, const SMALL: bool>(
    simd: S,
    splat: &Splat,
    of: &RowsOf,
    decay: Option<&Decay<S>>,
    columns: f32x16<S>,
    eta: &Lanes,
    heights: &Lanes,
    water: &Water,
    tile: &mut BackwardTile,
    k: usize,
    s_gradient: f32,
) -> [f32x16<S>; 9] {
    let c = |v: f32| f32x16::splat(simd, v);
    let (steepness, z) = (c(splat.steepness), c(splat.z));
    let (kappa, inverse) = splat.conic_terms();
    let kappa = c(kappa);
    let mut lanes = [c(0.0); 9];
    for r in Bits(of.live) {
        let row = &mut tile.rows[r];
        let (power, t) = log2_alpha(simd, steepness, columns, of, r);
        let stops = i32x16::load_array_ref(simd, &row.stop);
        let live = power.simd_ge(c(-LOG2_255)) & stops.simd_gt(i32x16::splat(simd, k as i32));
        let raw = exp2_unclamped_lanes(simd, power);
        let alpha = select(live, raw.min(c(ALPHA_MAX)), c(0.0));
        let over = c(1.0) / (c(1.0) - alpha);
        let transmittance = load(simd, &row.transmittance) * over;
        transmittance.store_array(&mut row.transmittance);
        let w = transmittance * alpha;
        let mut v = if EXTRAS { load(simd, &row.depth).mul_add(z, load(simd, &row.weight)) } else { c(0.0) };
        let mut slope = c(0.0);
        let wz = w * z;
        for q in 0..3 {
            let g = load(simd, &row.image[q]);
            if WATER && let Some(decay) = decay {
                let water_row: &WaterRow = &water.rows[r];
                let (attenuation, backscatter) =
                    (load(simd, &water_row.attenuation[q]), load(simd, &water_row.backscatter[q]));
                let object = g * decay.at::<SMALL, false>(simd, q, attenuation);
                let veil = decay.at::<SMALL, false>(simd, q + 3, backscatter);
                let colored = object * c(splat.color[q]);
                let veiled = load(simd, &row.veiled[q]) * veil;
                v = (v + colored) + veiled;
                slope = (attenuation + c(water.centre[q])).mul_add(colored, slope);
                slope = (backscatter + c(water.centre[q + 3])).mul_add(veiled, slope);
                let mut color = object;
                if EXTRAS {
                    let clear = load(simd, &row.clear[q]);
                    color += clear;
                    v = clear.mul_add(c(splat.color[q]), v);
                }
                lanes[4 + q] = w.mul_add(color, lanes[4 + q]);
                accumulate(simd, &mut row.object_moment[q], wz, colored);
                accumulate(simd, &mut row.veil_moment[q], wz, veiled);
                accumulate(simd, &mut row.veil[q], w, veil);
            } else {
                let color = if EXTRAS { g + load(simd, &row.clear[q]) } else { g };
                v = color.mul_add(c(splat.color[q]), v);
                lanes[4 + q] = w.mul_add(color, lanes[4 + q]);
            }
        }
        slope *= c(s_gradient);
        if EXTRAS {
            slope = load(simd, &row.depth).mul_add(c(std::f32::consts::LOG2_E), slope);
        }
        if EXTRAS || WATER {
            lanes[3] = w.mul_add(slope, lanes[3]);
        }
        let wv = w * v;
        let behind = load(simd, &row.behind);
        let g = (alpha * over).mul_add(behind, wv);
        (behind - wv).store_array(&mut row.behind);
        let g = select(raw.simd_le(c(ALPHA_MAX)), g, c(0.0));
        let height = c(eta[r]);
        lanes[0] += g;
        lanes[1] = g.mul_add(height, lanes[1]);
        lanes[2] = g.mul_add(height * height, lanes[2]);
        let size = g.abs();
        lanes[7] = size.mul_add(t.abs(), lanes[7]);
        let dy_term = (heights[r] - splat.y) * inverse;
        lanes[8] = size.mul_add(t.mul_add(kappa, c(dy_term)).abs(), lanes[8]);
    }
    lanes
}

/// Sums of lanes four apart, in the order of [`use3d_numerics::lanes::sum`].
#[inline(always)]
fn quarter<S: Simd>(simd: S, v: f32x16<S>) -> f32x4<S> {
    let (low, high) = simd.split_f32x16(v);
    let (a, b) = simd.split_f32x8(low + high);
    a + b
}

/// Four sums at once, each in the order of [`use3d_numerics::lanes::sum`].
#[inline(always)]
fn sums<S: Simd>(simd: S, [a, b, c, d]: [f32x16<S>; 4]) -> [f32; 4] {
    // Named one by one: `array::map` is a call that the instruction set does not reach into.
    let (a, b, c, d) = (quarter(simd, a), quarter(simd, b), quarter(simd, c), quarter(simd, d));
    let ab = (a.zip_low(b) + a.zip_high(b)).to_array();
    let cd = (c.zip_low(d) + c.zip_high(d)).to_array();
    [ab[0] + ab[2], ab[1] + ab[3], cd[0] + cd[2], cd[1] + cd[3]]
}

#[inline(always)]
fn finish<S: Simd>(
    simd: S,
    splat: &Splat,
    origin: [f32; 2],
    offset: f32x16<S>,
    lanes: [f32x16<S>; 9],
) -> Record {
    let [p0, p1, p2, slope, r, g, b, ax, ay] = lanes;
    let x0 = p0 * offset;
    let [s0, sx, sxx, s1] = sums(simd, [p0, x0, x0 * offset, p1]);
    let [sx1, s2, slope, r] = sums(simd, [p1 * offset, p2, slope, r]);
    let [g, b, ax, ay] = sums(simd, [g, b, ax, ay]);
    let [s0, t, y, tt, ty, yy] = moments(splat, origin, [s0, sx, sxx, s1, sx1, s2]);
    let (color, screen) = ([r, g, b], [ax, ay]);
    SplatGradient { weight: s0, t, dy: y, t_t: tt, t_dy: ty, dy_dy: yy, z: slope, color, screen }.record()
}

/// See [`plain::backward_colors`](crate::compose::plain::backward_colors).
#[inline(always)]
pub(crate) fn backward_colors<S: Simd, const WATER: bool>(
    simd: S,
    input: &Input<'_>,
    water: &Water,
    tile: &mut BackwardTile,
    sink: &mut Sink<'_>,
) {
    let (columns, rows) = (load(simd, input.columns), load(simd, input.rows));
    let mut state = ForwardTile::new(input.filled_rows, input.filled_columns);
    let forward = &mut state;
    let mut alive = filled(input);
    if input.list.is_empty() {
        return;
    }
    let mut next = entry_rows(simd, input, 0, rows);
    for k in 0..input.list.len() {
        let (span, splat, mut of) = next;
        next = entry_rows(simd, input, k + 1, rows);
        of.live &= alive;
        let mut out = [0.0; 12];
        if of.live != 0 {
            let lanes = if !WATER {
                color_rows::<S, false, false>(
                    simd, splat, &of, None, columns, water, forward, tile, k, &mut alive,
                )
            } else {
                let decay = Decay::new(simd, water, splat.z, [1.0; 3]);
                if splat.z <= water.near {
                    color_rows::<S, true, true>(
                        simd,
                        splat,
                        &of,
                        Some(&decay),
                        columns,
                        water,
                        forward,
                        tile,
                        k,
                        &mut alive,
                    )
                } else {
                    color_rows::<S, true, false>(
                        simd,
                        splat,
                        &of,
                        Some(&decay),
                        columns,
                        water,
                        forward,
                        tile,
                        k,
                        &mut alive,
                    )
                }
            };
            let [r, g, b] = lanes;
            let [r, g, b, _] = sums(simd, [r, g, b, b]);
            out = SplatGradient::of_color([r, g, b]);
        }
        sink.put(span, out);
    }
}

#[inline(always)]
fn color_rows<S: Simd, const WATER: bool, const SMALL: bool>(
    simd: S,
    splat: &Splat,
    of: &RowsOf,
    decay: Option<&Decay<S>>,
    columns: f32x16<S>,
    water: &Water,
    forward: &mut ForwardTile,
    tile: &mut BackwardTile,
    k: usize,
    alive: &mut u32,
) -> [f32x16<S>; 3] {
    let c = |v: f32| f32x16::splat(simd, v);
    let (steepness, z) = (c(splat.steepness), c(splat.z));
    let mut lanes = [c(0.0); 3];
    for r in Bits(of.live) {
        let row = &mut tile.rows[r];
        let (power, _) = log2_alpha(simd, steepness, columns, of, r);
        let w = weights(simd, power, &mut forward.rows[r], r, k, alive);
        let wz = w * z;
        for q in 0..3 {
            let g = load(simd, &row.image[q]);
            if WATER && let Some(decay) = decay {
                let water = &water.rows[r];
                let object = g * decay.at::<SMALL, false>(simd, q, load(simd, &water.attenuation[q]));
                let veil = decay.at::<SMALL, false>(simd, q + 3, load(simd, &water.backscatter[q]));
                lanes[q] = w.mul_add(object, lanes[q]);
                accumulate(simd, &mut row.object_moment[q], wz, object * c(splat.color[q]));
                let veiled = load(simd, &row.veiled[q]) * veil;
                accumulate(simd, &mut row.veil_moment[q], wz, veiled);
                accumulate(simd, &mut row.veil[q], w, veil);
            } else {
                lanes[q] = w.mul_add(g, lanes[q]);
            }
        }
    }
    lanes
}

/// See [`plain::splat`](crate::compose::plain::splat); the first `C` channels.
#[inline(always)]
pub(crate) fn splat<S: Simd, const C: usize>(
    simd: S,
    input: &Input<'_>,
    values: impl Fn(u32) -> [f32; CHANNELS],
    forward: &mut ForwardTile,
    out: &mut [[Lanes; CHANNELS]; TILE],
) {
    let (columns, rows) = (load(simd, input.columns), load(simd, input.rows));
    let mut alive = filled(input);
    if input.list.is_empty() {
        return;
    }
    let mut next = entry_rows(simd, input, 0, rows);
    for k in 0..input.list.len() {
        let (_, splat, mut of) = next;
        next = entry_rows(simd, input, k + 1, rows);
        of.live &= alive;
        if of.live == 0 {
            continue;
        }
        let values = values(splat.index);
        let steepness = f32x16::splat(simd, splat.steepness);
        for r in Bits(of.live) {
            let (power, _) = log2_alpha(simd, steepness, columns, &of, r);
            let w = weights(simd, power, &mut forward.rows[r], r, k, &mut alive);
            for (lanes, v) in out[r][..C].iter_mut().zip(values) {
                accumulate(simd, lanes, w, f32x16::splat(simd, v));
            }
        }
    }
}

/// See [`plain::splat_adjoint`](crate::compose::plain::splat_adjoint); the first `C` channels.
#[inline(always)]
pub(crate) fn splat_adjoint<S: Simd, const C: usize>(
    simd: S,
    input: &Input<'_>,
    maps: &[[Lanes; CHANNELS]; TILE],
    forward: &mut ForwardTile,
    sink: &mut Sink<'_>,
) {
    let (columns, rows) = (load(simd, input.columns), load(simd, input.rows));
    let zero = f32x16::splat(simd, 0.0);
    let mut alive = filled(input);
    if input.list.is_empty() {
        return;
    }
    let mut next = entry_rows(simd, input, 0, rows);
    for k in 0..input.list.len() {
        let (span, splat, mut of) = next;
        next = entry_rows(simd, input, k + 1, rows);
        of.live &= alive;
        let mut out = [0.0; 12];
        if of.live != 0 {
            let steepness = f32x16::splat(simd, splat.steepness);
            let mut lanes = [zero; CHANNELS];
            for r in Bits(of.live) {
                let (power, _) = log2_alpha(simd, steepness, columns, &of, r);
                let w = weights(simd, power, &mut forward.rows[r], r, k, &mut alive);
                for (lanes, map) in lanes[..C].iter_mut().zip(&maps[r]) {
                    *lanes = w.mul_add(load(simd, map), *lanes);
                }
            }
            let [a, b, c, d, e, f, g, h] = lanes;
            out[..4].copy_from_slice(&sums(simd, [a, b, c, d]));
            out[4..8].copy_from_slice(&sums(simd, [e, f, g, h]));
        }
        sink.put(span, out);
    }
}
