//! Passes over all Gaussians of a view: from parameters to [`Splat`]s, and from the compositor's sums back
//! to gradients of parameters.

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use use3d_capture::Camera;
use use3d_numerics::math;

use super::color;
use super::projection::Projector;
use super::splat::{EntryGradient, ScreenGradient, Splat, SplatGradient, splat_of};
use crate::{Colors, GaussianGradients, Gaussians};

/// Gaussians per parallel task of the backward pass.
const CHUNK: usize = 512;
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
    /// set; otherwise multiply-add would be a function call.
    #[inline(always)]
    pub(crate) fn forward(&self, first: usize, out: &mut [Splat]) {
        let gaussians = self.gaussians;
        for (out, i) in out.iter_mut().zip(first..) {
            let mean = gaussians.means[i];
            let projection = self.projector.project(mean, gaussians.log_scales[i], gaussians.quaternions[i]);
            let splat = match &projection {
                Some(p) => splat_of(p, gaussians.opacity_logits[i], self.columns, self.rows),
                None => None,
            };
            *out = match splat {
                Some(splat) => {
                    let color = match (self.source, self.colors) {
                        (ColorSource::Harmonics(degree), _) => {
                            color::color(degree, self.center, mean, &gaussians.sh[i])
                        }
                        (_, Colors::Given(colors)) => colors[i],
                        (ColorSource::Given, Colors::Sh { .. }) => [0.0; 3],
                    };
                    Splat { color, index: i as u32, ..splat }
                }
                None => Splat { z: f32::INFINITY, ..Splat::default() },
            };
        }
    }
}

/// Converts sums of records to gradients of raw parameters. Overwrites `grads`.
pub(crate) fn backward(
    drawn: &VisibleSplats<'_>,
    sums: &[EntryGradient],
    gaussians: &Gaussians,
    camera: &Camera,
    grads: &mut GaussianGradients,
) {
    grads.resize(gaussians.len());
    let (projector, center) = (Projector::new(camera), color::center(camera));
    let input = BackwardInput { drawn, sums, gaussians, projector, center };
    let level = Level::new();
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
            let out = Chunk { means, scales, quats, logits, sh, screen, signed, visible };
            dispatch!(level, _simd => backward_chunk(&input, chunk * CHUNK, ranks, out));
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
/// instruction set; otherwise multiply-add would be a function call.
#[inline(always)]
fn backward_chunk(input: &BackwardInput<'_>, first: usize, ranks: &[u32], out: Chunk<'_>) {
    let BackwardInput { drawn, sums, gaussians, projector, center } = input;
    let Chunk { means, scales, quats, logits, sh, screen, signed, visible } = out;
    // Ranks are scattered over the view. Reading them all first lets the waits for memory overlap.
    let mut fetched = [(Splat::default(), EntryGradient::default()); CHUNK];
    for (fetched, &rank) in fetched.iter_mut().zip(ranks) {
        if rank != HIDDEN {
            *fetched = (drawn.splats[rank as usize], sums[rank as usize]);
        }
    }
    for (i, &rank) in ranks.iter().enumerate() {
        visible[i] = rank != HIDDEN;
        if rank == HIDDEN {
            (means[i], scales[i], quats[i]) = ([0.0; 3], [0.0; 3], [0.0; 4]);
            (logits[i], sh[i], screen[i]) = (0.0, [[0.0; 3]; 16], [0.0; 2]);
            signed.get_mut(i).iter_mut().for_each(|signed| **signed = [0.0; 2]);
            continue;
        }
        let index = first + i;
        let (splat, sum) = &fetched[i];
        let s = SplatGradient::of(sum);
        let derived = ScreenGradient::of(splat, &s);
        let g = projector.backward(
            gaussians.means[index],
            gaussians.log_scales[index],
            gaussians.quaternions[index],
            derived.mean,
            derived.z,
            derived.cov,
        );
        means[i] = g.mean.map(|v| v as f32);
        scales[i] = g.log_scale.map(|v| v as f32);
        quats[i] = g.quaternion.map(|v| v as f32);
        // α = o e^{-σ}, so ∂L/∂logit = (1 − o) Σ α ∂L/∂α.
        let closed = 1.0 / (1.0 + math::exp(f64::from(gaussians.opacity_logits[index])));
        logits[i] = (closed * f64::from(s.weight)) as f32;
        screen[i] = derived.screen;
        if let Some(signed) = signed.get_mut(i) {
            *signed = derived.mean.map(|v| v as f32);
        }
        match drawn.source {
            ColorSource::Harmonics(degree) => color::color_backward(
                degree,
                *center,
                gaussians.means[index],
                &gaussians.sh[index],
                s.color,
                &mut sh[i],
            ),
            ColorSource::Given => sh[i] = [[0.0; 3]; 16],
        }
    }
}
