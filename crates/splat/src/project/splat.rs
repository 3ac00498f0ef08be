//! A Gaussian as the compositor reads it: from its parameters to a [`Splat`], and from the splat's gradient back to the parameters.
//!
//! The forward pass gives `shear`, `steepness` and `steepness_y` from the covariance of the projection ([`splat_of`]); the backward pass
//! undoes them: with `v = conic · (pixel − centre) = (a t, shear a t + dy / cov_yy)`, the compositor's sums over pixels are
//! the derivatives with respect to mean and covariance up to factors of the splat itself.

use fearless_simd::{Level, dispatch};
use rayon::prelude::*;
use use3d_capture::Camera;
use use3d_numerics::math;

use super::color;
use super::projection::{Projection, Projector};
use crate::{Colors, GaussianGradients, Gaussians};

/// Gaussians per parallel task of the backward pass.
const CHUNK: usize = 512;
/// The rank of a Gaussian that is not visible.
pub(crate) const HIDDEN: u32 = u32::MAX;
/// `log₂ 255`: a Gaussian contributes where `log₂ α ≥ −LOG2_255`.
pub(crate) const LOG2_255: f32 = 7.994_353_3;

/// A projected Gaussian as the compositor reads it.
///
/// With `dx, dy` from the centre to the pixel, `σ` is written as a completed square along the pixel row:
/// `log₂ α = log2_opacity − steepness (dx + shear dy)² − steepness_y dy²`. It cannot become negative by rounding and keeps
/// the accuracy of the f64 determinant for needles.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(C)]
pub(crate) struct Splat {
    /// Centre, pixels.
    pub(crate) x: f32,
    pub(crate) y: f32,
    /// `−cov_xy / cov_yy`.
    pub(crate) shear: f32,
    /// `½ log₂e · conic_xx`.
    pub(crate) steepness: f32,
    /// `½ log₂e / cov_yy`.
    pub(crate) steepness_y: f32,
    /// `log₂` of the opacity.
    pub(crate) log2_opacity: f32,
    /// Depth.
    pub(crate) z: f32,
    /// Colour of this view.
    pub(crate) color: [f32; 3],
    /// Which Gaussian.
    pub(crate) index: u32,
    /// Half height of the 1/255 contour, pixels.
    pub(crate) reach_y: f32,
}

/// Where a view's colours come from, remembered for the backward pass.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum ColorSource {
    Harmonics(usize),
    Given,
}

/// Gradient of one (tile, Gaussian) entry, or the sum of several: the floats of a [`SplatGradient`], so that sums are one loop. The linear
/// adjoint uses them as channels.
pub(crate) type Record = [f32; 12];

/// What the compositor's backward pass hands to the projection's, by name: sums over pixels with `G = α ∂L/∂α` and, from the Gaussian's
/// centre, `t = dx + shear dy`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SplatGradient {
    /// `ΣG`.
    pub(crate) weight: f32,
    /// `ΣG t`.
    pub(crate) t: f32,
    /// `ΣG dy`.
    pub(crate) dy: f32,
    /// `ΣG t²`.
    pub(crate) t_t: f32,
    /// `ΣG t dy`.
    pub(crate) t_dy: f32,
    /// `ΣG dy²`.
    pub(crate) dy_dy: f32,
    /// `∂L/∂z / ln 2`.
    pub(crate) z: f32,
    /// `∂L/∂c`.
    pub(crate) color: [f32; 3],
    /// `Σ|G t|` and `Σ|G v_y|`, for density control.
    pub(crate) screen: [f32; 2],
}

impl SplatGradient {
    /// A record by name.
    #[inline(always)]
    pub(crate) fn of(record: &Record) -> Self {
        let &[weight, t, dy, t_t, t_dy, dy_dy, z, r, g, b, x, y] = record;
        Self { weight, t, dy, t_t, t_dy, dy_dy, z, color: [r, g, b], screen: [x, y] }
    }

    /// Its floats.
    #[inline(always)]
    pub(crate) fn record(self) -> Record {
        let Self { weight, t, dy, t_t, t_dy, dy_dy, z, color: [r, g, b], screen: [x, y] } = self;
        [weight, t, dy, t_t, t_dy, dy_dy, z, r, g, b, x, y]
    }

    /// The record of a gradient with respect to colour alone.
    #[inline(always)]
    pub(crate) fn of_color(color: [f32; 3]) -> Record {
        let [r, g, b] = color;
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, r, g, b, 0.0, 0.0]
    }
}

/// What the Gaussians of a view are projected with.
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
    /// Of these Gaussians for `camera`; `[columns, rows]` are the first and last pixel centres of the lattice.
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

    /// Projects the Gaussians from `first` on. Always inlined, so that the instruction set reaches it: multiply-add is a call without.
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

/// The compositor's form of a projection; `None` if it is never drawn or its contour misses the lattice.
#[inline(always)]
fn splat_of(p: &Projection, logit: f32, columns: [f32; 2], rows: [f32; 2]) -> Option<Splat> {
    // log₂ of the logistic function, stable at both ends; NaN compares false below.
    let x = f64::from(logit);
    let log2_opacity = -(math::ln_1p(math::exp(-x.abs())) - x.min(0.0)) * std::f64::consts::LOG2_E;
    let level = log2_opacity + f64::from(LOG2_255);
    if level.is_nan() || level < 0.0 {
        return None;
    }
    let [xx, xy, yy] = p.cov;
    let det = xx * yy - xy * xy;
    if det.is_nan() || det <= 0.0 {
        return None;
    }
    // σ ≤ level / log₂e: half extents √(2 σ cov).
    let twice_sigma = 2.0 * level * std::f64::consts::LN_2;
    let (reach_x, reach_y) = ((twice_sigma * xx).sqrt(), (twice_sigma * yy).sqrt());
    let half = 0.5 * std::f64::consts::LOG2_E;
    let splat = Splat {
        x: p.mean[0] as f32,
        y: p.mean[1] as f32,
        shear: (-xy / yy) as f32,
        steepness: (half * yy / det) as f32,
        steepness_y: (half / yy) as f32,
        log2_opacity: log2_opacity as f32,
        z: p.z as f32,
        // A hair more than exact, so that rounding never loses a pixel on the contour.
        reach_y: (reach_y * (1.0 + 1e-6) + 1e-3) as f32,
        ..Splat::default()
    };
    let reach_x = (reach_x * (1.0 + 1e-6) + 1e-3) as f32;
    let meets =
        |centre: f32, reach: f32, [low, high]: [f32; 2]| centre + reach >= low && centre - reach <= high;
    let finite = splat.shear.is_finite() && splat.steepness > 0.0 && splat.steepness_y > 0.0;
    (finite && meets(splat.x, reach_x, columns) && meets(splat.y, splat.reach_y, rows)).then_some(splat)
}

/// From sums of records to gradients of raw parameters. Overwrites `grads`.
pub(crate) fn backward(
    drawn: &Drawn<'_>,
    sums: &[Record],
    gaussians: &Gaussians,
    camera: &Camera,
    grads: &mut GaussianGradients,
) {
    grads.resize(gaussians.len());
    let (projector, center) = (Projector::new(camera), color::center(camera));
    let input = BackwardInput { drawn, sums, gaussians, projector, center };
    let level = Level::new();
    let GaussianGradients { means, log_scales, quaternions, opacity_logits, sh, screen, visible } = grads;
    (
        means.par_chunks_mut(CHUNK),
        log_scales.par_chunks_mut(CHUNK),
        quaternions.par_chunks_mut(CHUNK),
        opacity_logits.par_chunks_mut(CHUNK),
        sh.par_chunks_mut(CHUNK),
        screen.par_chunks_mut(CHUNK),
        visible.par_chunks_mut(CHUNK),
        drawn.ranks.par_chunks(CHUNK),
    )
        .into_par_iter()
        .enumerate()
        .for_each(|(chunk, (means, scales, quats, logits, sh, screen, visible, ranks))| {
            let out = Chunk { means, scales, quats, logits, sh, screen, visible };
            dispatch!(level, _simd => backward_chunk(&input, chunk * CHUNK, ranks, out));
        });
}

/// The Gaussians that a view draws.
pub(crate) struct Drawn<'a> {
    /// In depth order.
    pub(crate) splats: &'a [Splat],
    /// Position in depth order of every Gaussian, [`HIDDEN`] if it is not visible.
    pub(crate) ranks: &'a [u32],
    pub(crate) source: ColorSource,
}

/// What the gradients of a view's Gaussians are made from.
struct BackwardInput<'a> {
    drawn: &'a Drawn<'a>,
    sums: &'a [Record],
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
    visible: &'a mut [bool],
}

/// The gradients of the Gaussians from `first` on. Always inlined, so that the instruction set reaches it: multiply-add is a call
/// without.
#[inline(always)]
fn backward_chunk(input: &BackwardInput<'_>, first: usize, ranks: &[u32], out: Chunk<'_>) {
    let BackwardInput { drawn, sums, gaussians, projector, center } = input;
    let Chunk { means, scales, quats, logits, sh, screen, visible } = out;
    // Ranks are scattered over the view: fetched together, the waits for memory overlap.
    let mut fetched = [(Splat::default(), [0.0; 12]); CHUNK];
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
            continue;
        }
        let index = first + i;
        let (splat, sum) = &fetched[i];
        let s = SplatGradient::of(sum);
        let f = f64::from;
        // v = conic · (pixel − centre) = (a t, shear a t + dy / cov_yy), a = conic_xx.
        let twice = 2.0 * std::f64::consts::LN_2;
        let (k, a, b) = (f(splat.shear), f(splat.steepness) * twice, f(splat.steepness_y) * twice);
        let d_mean = [a * f(s.t), k * a * f(s.t) + b * f(s.dy)];
        let xx = a * a * f(s.t_t);
        let xy = k * xx + a * b * f(s.t_dy);
        let yy = k * (2.0 * xy - k * xx) + b * b * f(s.dy_dy);
        let d_z = f(s.z) * std::f64::consts::LN_2;
        let g = projector.backward(
            gaussians.means[index],
            gaussians.log_scales[index],
            gaussians.quaternions[index],
            d_mean,
            d_z,
            [0.5 * xx, xy, 0.5 * yy],
        );
        means[i] = g.mean.map(|v| v as f32);
        scales[i] = g.log_scale.map(|v| v as f32);
        quats[i] = g.quaternion.map(|v| v as f32);
        // α = o e^{-σ}, so ∂L/∂logit = (1 − o) Σ α ∂L/∂α.
        let closed = 1.0 / (1.0 + math::exp(f64::from(gaussians.opacity_logits[index])));
        logits[i] = (closed * f(s.weight)) as f32;
        screen[i] = [(a * f(s.screen[0])) as f32, s.screen[1]];
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
