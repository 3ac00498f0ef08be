//! Passes over all Gaussians of a view: from parameters to [`Splat`]s, and from the compositor's sums back
//! to gradients of parameters.
//!
//! Both work on [`BLOCK`] Gaussians at a time: their numbers are read into one array per parameter, computed
//! in lanes, and written.

use fearless_simd::prelude::*;
use fearless_simd::{Level, Simd, dispatch, f64x8};
use rayon::prelude::*;
use use3d_capture::Camera;
use use3d_numerics::number::{Number, exp};

use super::color;
use super::projection::{Ellipsoid, Projector};
use super::splat::{
    EntryGradient, Outline, ScreenSums, Splat, SplatGradient, outline, screen_gradient, splat_of,
};
use crate::{Colors, GaussianGradients, Gaussians};

/// Gaussians per parallel task of the backward pass.
const CHUNK: usize = 512;
/// Gaussians whose numbers are in the nearest cache at once.
const BLOCK: usize = 64;
/// Number of lanes.
const LANES: usize = 8;
/// The rank of a Gaussian that is not visible.
pub(crate) const HIDDEN: u32 = u32::MAX;

/// The source of a view's colours, stored for the backward pass.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) enum ColorSource {
    Harmonics(usize),
    #[default]
    Given,
}

/// The data with which the Gaussians of a view are projected.
pub(crate) struct Projecting<'a> {
    gaussians: &'a Gaussians,
    colors: Colors<'a>,
    source: ColorSource,
    projector: Projector,
    center: [f32; 3],
    columns: [f32; 2],
    rows: [f32; 2],
}

impl<'a> Projecting<'a> {
    /// The projection of these Gaussians for `camera`; `[columns, rows]` are the first and last pixel
    /// centres of the lattice.
    pub(crate) fn new(
        gaussians: &'a Gaussians,
        camera: &Camera,
        colors: Colors<'a>,
        source: ColorSource,
        [columns, rows]: [[f32; 2]; 2],
    ) -> Self {
        let (projector, center) = (Projector::new(camera), color::center(camera));
        Self { gaussians, colors, source, projector, center, columns, rows }
    }

    /// Projects the Gaussians from `first` on. Always inlined, so that it is compiled for the instruction
    /// set.
    #[inline(always)]
    pub(crate) fn forward<S: Simd>(&self, simd: S, first: usize, out: &mut [Splat]) {
        let gaussians = self.gaussians;
        for (out, first) in out.chunks_mut(BLOCK).zip((first..).step_by(BLOCK)) {
            let mut raw = [[0.0; BLOCK]; 11];
            for (lane, i) in (first..first + out.len()).enumerate() {
                read(gaussians, i, lane, &mut raw);
            }
            for (at, out) in out.chunks_mut(LANES).enumerate() {
                let (outline, drawn) = self.outline(lanes(simd, &raw, at));
                let (outline, drawn) = (rounded(outline), drawn.to_bitmask());
                for (lane, out) in out.iter_mut().enumerate() {
                    // An infinite depth marks a Gaussian that is not drawn.
                    *out = Splat { z: f32::INFINITY, ..Splat::default() };
                    if drawn >> lane & 1 != 0
                        && let Some(splat) = splat_of(&column(&outline, lane), self.columns, self.rows)
                    {
                        let i = first + at * LANES + lane;
                        *out = Splat { color: self.color(i), index: i as u32, ..splat };
                    }
                }
            }
        }
    }

    /// The outline of Gaussians given by their raw numbers; the mask is false if they are not drawn.
    #[inline(always)]
    fn outline<V: Number>(&self, raw: [V; 11]) -> (Outline<V>, V::Mask) {
        let (projection, visible) = self.projector.project(&geometry(&raw));
        let (outline, drawn) = outline(&projection, raw[10]);
        (outline, visible & drawn)
    }

    #[inline(always)]
    fn color(&self, i: usize) -> [f32; 3] {
        match (self.source, self.colors) {
            (ColorSource::Harmonics(degree), _) => {
                color::color(degree, self.center, self.gaussians.means[i], &self.gaussians.sh[i])
            }
            (_, Colors::Given(colors)) => colors[i],
            (ColorSource::Given, Colors::Sh { .. }) => [0.0; 3],
        }
    }
}

/// Reads mean, log-scales, quaternion and opacity logit of Gaussian `i` into column `lane`.
#[inline(always)]
fn read(gaussians: &Gaussians, i: usize, lane: usize, raw: &mut [[f64; BLOCK]]) {
    let [a, b, c] = gaussians.means[i];
    let [d, e, f] = gaussians.log_scales[i];
    let [w, x, y, z] = gaussians.quaternions[i];
    for (row, v) in raw.iter_mut().zip([a, b, c, d, e, f, w, x, y, z, gaussians.opacity_logits[i]]) {
        row[lane] = f64::from(v);
    }
}

/// The vectors at position `at` of `N` arrays.
#[inline(always)]
fn lanes<S: Simd, const N: usize>(simd: S, rows: &[[f64; BLOCK]], at: usize) -> [f64x8<S>; N] {
    let mut out = [f64x8::splat(simd, 0.0); N];
    for (out, row) in out.iter_mut().zip(rows) {
        *out = f64x8::from_slice(simd, &row[at * LANES..(at + 1) * LANES]);
    }
    out
}

/// The numbers of `N` vectors in f32.
#[inline(always)]
fn rounded<S: Simd, const N: usize>(vectors: [f64x8<S>; N]) -> [[f32; 2 * LANES]; N] {
    let mut out = [[0.0; 2 * LANES]; N];
    for (out, v) in out.iter_mut().zip(vectors) {
        *out = v.narrow(v).to_array();
    }
    out
}

/// Number `lane` of `N` arrays.
#[inline(always)]
fn column<const N: usize>(rows: &[[f32; 2 * LANES]; N], lane: usize) -> [f32; N] {
    let mut out = [0.0; N];
    for (out, row) in out.iter_mut().zip(rows) {
        *out = row[lane];
    }
    out
}

#[inline(always)]
fn geometry<V: Number>(raw: &[V; 11]) -> Ellipsoid<V> {
    let &[a, b, c, d, e, f, w, x, y, z, _] = raw;
    Ellipsoid { mean: [a, b, c], log_scale: [d, e, f], quaternion: [w, x, y, z] }
}

/// Converts sums of records to gradients of raw parameters. Overwrites `grads`.
pub(crate) fn backward(
    drawn: &VisibleSplats<'_>,
    sums: &[EntryGradient],
    gaussians: &Gaussians,
    camera: &Camera,
    grads: &mut GaussianGradients,
) {
    let (projector, center) = (Projector::new(camera), color::center(camera));
    backward_at(Level::new(), &BackwardInput { drawn, sums, gaussians, projector, center }, grads);
}

fn backward_at(level: Level, input: &BackwardInput<'_>, grads: &mut GaussianGradients) {
    let &BackwardInput { drawn, gaussians, .. } = input;
    grads.resize(gaussians.len());
    grads.signed_screen.resize(if drawn.signed { gaussians.len() } else { 0 }, [0.0; 2]);
    let GaussianGradients {
        means,
        log_scales,
        quaternions,
        opacity_logits,
        sh,
        screen,
        signed_screen,
        visible,
    } = grads;
    let mut signed: Vec<&mut [[f32; 2]]> = signed_screen.chunks_mut(CHUNK).collect();
    signed.resize_with(gaussians.len().div_ceil(CHUNK), Default::default);
    (
        means.par_chunks_mut(CHUNK),
        log_scales.par_chunks_mut(CHUNK),
        quaternions.par_chunks_mut(CHUNK),
        opacity_logits.par_chunks_mut(CHUNK),
        sh.par_chunks_mut(CHUNK),
        screen.par_chunks_mut(CHUNK),
        signed,
        visible.par_chunks_mut(CHUNK),
        drawn.ranks.par_chunks(CHUNK),
    )
        .into_par_iter()
        .enumerate()
        .for_each(|(chunk, (means, scales, quats, logits, sh, screen, signed, visible, ranks))| {
            let mut out = Chunk { means, scales, quats, logits, sh, screen, signed, visible };
            dispatch!(level, simd => backward_chunk(simd, input, chunk * CHUNK, ranks, &mut out));
        });
}

/// The Gaussians that a view draws.
pub(crate) struct VisibleSplats<'a> {
    /// In depth order.
    pub(crate) splats: &'a [Splat],
    /// Position in depth order of every Gaussian, [`HIDDEN`] if it is not visible.
    pub(crate) ranks: &'a [u32],
    pub(crate) source: ColorSource,
    /// True if screen gradients keep their signs.
    pub(crate) signed: bool,
}

/// The inputs from which the gradients of a view's Gaussians are computed.
struct BackwardInput<'a> {
    drawn: &'a VisibleSplats<'a>,
    sums: &'a [EntryGradient],
    gaussians: &'a Gaussians,
    projector: Projector,
    center: [f32; 3],
}

/// The gradients of consecutive Gaussians.
struct Chunk<'a> {
    means: &'a mut [[f32; 3]],
    scales: &'a mut [[f32; 3]],
    quats: &'a mut [[f32; 4]],
    logits: &'a mut [f32],
    sh: &'a mut [[[f32; 3]; 16]],
    screen: &'a mut [[f32; 2]],
    /// Empty if they are not wanted.
    signed: &'a mut [[f32; 2]],
    visible: &'a mut [bool],
}

/// Computes the gradients of the Gaussians from `first` on. Always inlined, so that it is compiled for the
/// instruction set.
#[inline(always)]
fn backward_chunk<S: Simd>(
    simd: S,
    input: &BackwardInput<'_>,
    first: usize,
    ranks: &[u32],
    out: &mut Chunk<'_>,
) {
    // The visible Gaussians of the chunk.
    let (mut visible, mut count) = ([0u16; CHUNK], 0);
    for (i, &rank) in ranks.iter().enumerate() {
        out.visible[i] = rank != HIDDEN;
        if rank == HIDDEN {
            (out.means[i], out.scales[i], out.quats[i]) = ([0.0; 3], [0.0; 3], [0.0; 4]);
            (out.logits[i], out.sh[i], out.screen[i]) = (0.0, [[0.0; 3]; 16], [0.0; 2]);
            out.signed.get_mut(i).iter_mut().for_each(|signed| **signed = [0.0; 2]);
        } else {
            visible[count] = i as u16;
            count += 1;
        }
    }
    for block in visible[..count].chunks(BLOCK) {
        // Ranks are scattered over the view, so these reads wait for memory, all at once.
        let mut fetched = [(Splat::default(), EntryGradient::default()); BLOCK];
        for (fetched, &i) in fetched.iter_mut().zip(block) {
            let rank = ranks[usize::from(i)] as usize;
            *fetched = (input.drawn.splats[rank], input.sums[rank]);
        }
        let (mut raw, mut kept) = ([[0.0; BLOCK]; 22], [[0.0; 4]; BLOCK]);
        for (lane, (&i, (splat, record))) in block.iter().zip(&fetched).enumerate() {
            let s = SplatGradient::of(record);
            read(input.gaussians, first + usize::from(i), lane, &mut raw);
            let of_splat = [splat.shear, splat.steepness, splat.steepness_y];
            let of_record = [s.t, s.dy, s.t_t, s.t_dy, s.dy_dy, s.z, s.screen[0], s.weight];
            for (row, v) in raw[11..].iter_mut().zip(of_splat.into_iter().chain(of_record)) {
                row[lane] = f64::from(v);
            }
            // Where the colour is clamped to zero, its gradient is zero.
            let [r, g, b] = std::array::from_fn(|c| if splat.color[c] > 0.0 { s.color[c] } else { 0.0 });
            kept[lane] = [r, g, b, s.screen[1]];
        }
        for (at, (block, kept)) in block.chunks(LANES).zip(kept.chunks(LANES)).enumerate() {
            let (own, moments) = (lanes(simd, &raw, at), lanes(simd, &raw[11..], at));
            let [weight] = lanes(simd, &raw[21..], at);
            let numbers = rounded(gradient(&input.projector, &own, &moments, weight));
            for (lane, (&i, &[r, g, b, screen_y])) in block.iter().zip(kept).enumerate() {
                let i = usize::from(i);
                let [mx, my, mz, sx, sy, sz, qw, qx, qy, qz, logit, x, y, screen_x] = column(&numbers, lane);
                out.means[i] = [mx, my, mz];
                out.scales[i] = [sx, sy, sz];
                out.quats[i] = [qw, qx, qy, qz];
                out.logits[i] = logit;
                out.screen[i] = [screen_x, screen_y];
                if let Some(signed) = out.signed.get_mut(i) {
                    *signed = [x, y];
                }
                match input.drawn.source {
                    ColorSource::Harmonics(degree) => {
                        let mean = input.gaussians.means[first + i];
                        color::color_backward(degree, input.center, mean, [r, g, b], &mut out.sh[i]);
                    }
                    ColorSource::Given => out.sh[i] = [[0.0; 3]; 16],
                }
            }
        }
    }
}

/// The gradient with respect to mean, log-scales, quaternion and opacity logit, that with respect to the mean
/// on screen, and the sum of absolute derivatives along `x`; from the raw numbers and the record.
#[inline(always)]
fn gradient<V: Number>(projector: &Projector, raw: &[V; 11], moments: &ScreenSums<V>, weight: V) -> [V; 14] {
    let (d, along_x) = screen_gradient(moments);
    let Ellipsoid { mean: [a, b, c], log_scale: [e, f, g], quaternion: [w, x, y, z] } =
        projector.backward(&geometry(raw), &d);
    // α = o e^{−σ}, so ∂L/∂logit = (1 − o) Σ α ∂L/∂α.
    let logit = weight / (exp(raw[10]) + 1.0);
    [a, b, c, e, f, g, w, x, y, z, logit, d.mean[0], d.mean[1], along_x]
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use use3d_capture::{Intrinsics, Pose};
    use use3d_numerics::random::{Purpose, Stream};

    /// Gaussians around the view, one third of them with numbers that no scene has.
    fn hostile() -> Gaussians {
        let s = Stream::new(8, Purpose::new("lanes of the projection"), 0);
        let bad = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 1e-42, 1e38, -1e38, 0.0, 88.0, -80.0];
        let mut out = Gaussians::empty(3);
        for i in 0..3001u64 {
            let z = |k: u64| s.normal(i * 128 + k) as f32;
            let needle = if i % 5 == 0 { 4.0 } else { 1.0 };
            let mut raw: [f32; 11] = std::array::from_fn(|k| {
                let scale = if (3..6).contains(&k) { needle } else { 1.5 };
                scale * z(k as u64) - if (3..6).contains(&k) { 3.0 } else { 0.0 }
            });
            if i % 3 == 0 {
                for k in 0..=s.below(i * 16, 2) as u64 {
                    raw[s.below(i * 16 + 2 * k + 1, 11)] = bad[s.below(i * 16 + 2 * k + 2, bad.len())];
                }
            }
            let [a, b, c, d, e, f, w, x, y, z_, logit] = raw;
            out.means.push([a, b, c]);
            out.log_scales.push([d, e, f]);
            out.quaternions.push(if i % 50 == 0 { [0.0; 4] } else { [w, x, y, z_] });
            out.opacity_logits.push(2.0 * logit);
            out.sh.push(std::array::from_fn(|k| std::array::from_fn(|c| z(16 + 3 * k as u64 + c as u64))));
        }
        out
    }

    fn camera() -> Camera {
        let intrinsics = Intrinsics { width: 80, height: 60, fx: 55.0, fy: 58.0, cx: 41.0, cy: 28.5 };
        let (eye, at, down) =
            (DVec3::new(0.3, -0.2, -4.0), DVec3::new(0.1, 0.0, 0.0), DVec3::new(0.0, -1.0, 0.1));
        Camera { intrinsics, pose: Pose::look_at(eye, at, down) }
    }

    /// Every instruction set with fused multiply-add that this machine has.
    fn fused_levels() -> Vec<Level> {
        #[cfg(target_arch = "x86_64")]
        return [Level::new().as_avx2().map(Level::Avx2), Level::new().as_avx512().map(Level::Avx512)]
            .into_iter()
            .flatten()
            .collect();
        #[cfg(not(target_arch = "x86_64"))]
        vec![Level::new()]
    }

    #[test]
    fn lanes_have_the_bits_of_the_plain_twin() {
        let (gaussians, camera) = (hostile(), camera());
        let n = gaussians.len();
        let colors = Colors::Sh { degree: 3 };
        let source = ColorSource::Harmonics(3);
        let projecting = Projecting::new(&gaussians, &camera, colors, source, [[0.5, 79.5], [0.5, 59.5]]);
        let raw = |i: usize| -> [f64; 11] {
            let mut out = [[0.0; BLOCK]; 11];
            read(&gaussians, i, 0, &mut out);
            out.map(|row| row[0])
        };
        let plain: Vec<Splat> = (0..n)
            .map(|i| {
                let (outline, drawn) = projecting.outline(raw(i));
                let splat = splat_of(&outline.map(|v| v as f32), projecting.columns, projecting.rows);
                match splat.filter(|_| drawn) {
                    Some(splat) => Splat { color: projecting.color(i), index: i as u32, ..splat },
                    None => Splat { z: f32::INFINITY, ..Splat::default() },
                }
            })
            .collect();
        let ranks: Vec<u32> =
            plain.iter().zip(0..).map(|(s, i)| if s.z.is_finite() { i } else { HIDDEN }).collect();
        let drawn = ranks.iter().filter(|rank| **rank != HIDDEN).count();
        assert!((n / 4..n - n / 8).contains(&drawn), "{drawn} of {n}");
        let s = Stream::new(9, Purpose::new("records"), 0);
        let sums: Vec<EntryGradient> =
            (0..n).map(|i| std::array::from_fn(|k| s.normal((16 * i + k) as u64) as f32)).collect();
        let view = VisibleSplats { splats: &plain, ranks: &ranks, source, signed: true };
        for level in fused_levels() {
            let mut lanes = vec![Splat::default(); n];
            dispatch!(level, simd => projecting.forward(simd, 0, &mut lanes));
            for (lane, plain) in lanes.iter().zip(&plain) {
                assert_eq!(lane, plain, "{level:?}");
            }
            let mut g = GaussianGradients::default();
            let (projector, center) = (projecting.projector, projecting.center);
            let input = BackwardInput { drawn: &view, sums: &sums, gaussians: &gaussians, projector, center };
            backward_at(level, &input, &mut g);
            for i in 0..n {
                if ranks[i] == HIDDEN {
                    assert_eq!((g.means[i], g.quaternions[i], g.visible[i]), ([0.0; 3], [0.0; 4], false));
                    continue;
                }
                let f = f64::from;
                let (splat, record) = (&plain[i], SplatGradient::of(&sums[i]));
                let SplatGradient { weight, t, dy, t_t, t_dy, dy_dy, z, screen, .. } = record;
                let moments = [splat.shear, splat.steepness, splat.steepness_y, t, dy, t_t, t_dy, dy_dy, z];
                let mut moments = moments.into_iter().chain([screen[0]]).map(f);
                let moments = std::array::from_fn(|_| moments.next().unwrap());
                let numbers = gradient(&projecting.projector, &raw(i), &moments, f(weight));
                let lanes = g.means[i].into_iter().chain(g.log_scales[i]).chain(g.quaternions[i]);
                let lanes =
                    lanes.chain([g.opacity_logits[i]]).chain(g.signed_screen[i]).chain([g.screen[i][0]]);
                for (lane, plain) in lanes.zip(numbers) {
                    assert_eq!(lane.to_bits(), (plain as f32).to_bits(), "{level:?}: Gaussian {i}");
                }
                let d_color =
                    std::array::from_fn(|c| if splat.color[c] == 0.0 { 0.0 } else { record.color[c] });
                let mut d_sh = [[0.0; 3]; 16];
                color::color_backward(3, projecting.center, gaussians.means[i], d_color, &mut d_sh);
                assert_eq!(g.sh[i], d_sh, "{level:?}: Gaussian {i}");
            }
        }
    }
}
