//! A Gaussian in the form that the compositor reads: from a projection to a [`Splat`], and from the
//! compositor's sums back to the projection.
//!
//! The forward pass ([`outline`]) computes `shear`, `steepness` and `steepness_y` from the covariance of the
//! projection; the backward pass ([`screen_gradient`]) inverts this step. With
//! `v = conic · (pixel − centre) = (a t, shear a t + dy / cov_yy)`, the compositor's sums over pixels are
//! the derivatives with respect to mean and covariance, up to factors of the splat itself.

use use3d_numerics::number::{Number, log2_logistic};

use super::projection::Projection;

/// `log₂ 255`: a Gaussian contributes where `log₂ α ≥ −LOG2_255`.
pub const LOG2_255: f32 = 7.994_353_3;

/// A projected Gaussian in the form that the compositor reads.
///
/// With `dx, dy` from the centre to the pixel, `σ` is written as a completed square along the pixel row:
/// `log₂ α = log2_opacity − steepness (dx + shear dy)² − steepness_y dy²`. In this form `σ` cannot become
/// negative by rounding, and it keeps the accuracy of the f64 determinant for needles.
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
    /// Index of the Gaussian.
    pub(crate) index: u32,
    /// Half height of the 1/255 contour, pixels.
    pub(crate) reach_y: f32,
}

impl Splat {
    /// Standard deviation along the longest axis of the ellipse, pixels.
    pub(crate) fn deviation(&self) -> f32 {
        let (yy, det) = self.covariance();
        let xy = -self.shear * yy;
        let middle = 0.5 * ((det + xy * xy) / yy + yy);
        (middle + (middle * middle - det).max(0.0).sqrt()).sqrt()
    }

    /// Geometric mean of the ellipse's two standard deviations, pixels.
    pub(crate) fn mean_deviation(&self) -> f32 {
        self.covariance().1.sqrt().sqrt()
    }

    /// `cov_yy` and the determinant of the covariance: the inverse of `outline`.
    fn covariance(&self) -> (f32, f32) {
        let half = 0.5 * std::f32::consts::LOG2_E;
        let yy = half / self.steepness_y;
        (yy, half * yy / self.steepness)
    }
}

/// The gradient of one (tile, Gaussian) entry, or the sum of several: the floats of a [`SplatGradient`] as
/// an array, so that sums are one loop, in the order in which the tile's lanes are added
/// ([`sums`](crate::compose)). The linear adjoint uses the first floats as channels.
pub(crate) type EntryGradient = [f32; 16];

/// The compositor's gradient of a Gaussian by name, which is the input of the projection's backward pass:
/// sums over pixels with `G = α ∂L/∂α` and, from the Gaussian's centre, `t = dx + shear dy`.
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
    /// The values of a record by name.
    #[inline(always)]
    pub(crate) fn of(record: &EntryGradient) -> Self {
        let &[weight, g, t_dy, _, dy, x, z, _, t, b, dy_dy, _, t_t, y, r, _] = record;
        Self { weight, t, dy, t_t, t_dy, dy_dy, z, color: [r, g, b], screen: [x, y] }
    }

    /// The values as a record; the floats without a name repeat others.
    #[inline(always)]
    pub(crate) fn record(self) -> EntryGradient {
        let Self { weight, t, dy, t_t, t_dy, dy_dy, z, color: [r, g, b], screen: [x, y] } = self;
        [weight, g, t_dy, g, dy, x, z, x, t, b, dy_dy, b, t_t, y, r, y]
    }

    /// The record of a gradient with respect to colour alone.
    #[inline(always)]
    pub(crate) fn of_color([r, g, b]: [f32; 3]) -> EntryGradient {
        [0.0, g, 0.0, g, 0.0, 0.0, 0.0, 0.0, 0.0, b, 0.0, b, 0.0, 0.0, r, 0.0]
    }
}

/// `x, y, shear, steepness, steepness_y, log2_opacity, z, reach_y` of a [`Splat`], and the half width of the
/// 1/255 contour.
pub(super) type Outline<V> = [V; 9];

/// Converts a projection to the compositor's form; the mask is false if it is never drawn.
#[inline(always)]
pub(super) fn outline<V: Number>(p: &Projection<V>, logit: V) -> (Outline<V>, V::Mask) {
    let log2_opacity = log2_logistic(logit);
    let level = log2_opacity + f64::from(LOG2_255);
    let [xx, xy, yy] = p.cov;
    let det = xx * yy - xy * xy;
    let zero = level.fill(0.0);
    let drawn = zero.at_most(level) & zero.less(det);
    // σ ≤ level / log₂e: half extents √(2 σ cov). Slightly more than the exact value, so that rounding never
    // loses a pixel on the contour.
    let twice_sigma = level * (2.0 * std::f64::consts::LN_2);
    let reach_x = (twice_sigma * xx).sqrt() * (1.0 + 1e-6) + 1e-3;
    let reach_y = (twice_sigma * yy).sqrt() * (1.0 + 1e-6) + 1e-3;
    let half = yy.fill(0.5 * std::f64::consts::LOG2_E);
    let inverse_yy = yy.fill(1.0) / yy;
    let (shear, steepness, steepness_y) = (-xy * inverse_yy, half * yy / det, half * inverse_yy);
    let [x, y] = p.mean;
    ([x, y, shear, steepness, steepness_y, log2_opacity, p.z, reach_y, reach_x], drawn)
}

/// The splat of an outline in f32; `None` if its contour misses the lattice.
#[inline(always)]
pub(super) fn splat_of(outline: &Outline<f32>, columns: [f32; 2], rows: [f32; 2]) -> Option<Splat> {
    let &[x, y, shear, steepness, steepness_y, log2_opacity, z, reach_y, reach_x] = outline;
    let meets =
        |centre: f32, reach: f32, [low, high]: [f32; 2]| centre + reach >= low && centre - reach <= high;
    let finite = shear.is_finite() && steepness > 0.0 && steepness_y > 0.0;
    let splat = Splat { x, y, shear, steepness, steepness_y, log2_opacity, z, reach_y, ..Splat::default() };
    (finite && meets(x, reach_x, columns) && meets(y, reach_y, rows)).then_some(splat)
}

/// A splat's `shear, steepness, steepness_y`, and `ΣG t, ΣG dy, ΣG t², ΣG t dy, ΣG dy²`, `∂L/∂z / ln 2` and
/// `Σ|G t|` of its record.
pub(super) type ScreenSums<V> = [V; 10];

/// Computes the gradient with respect to a projection from the compositor's sums, which is the derivative of
/// [`outline`], and the sum of absolute derivatives with respect to `x`.
#[inline(always)]
pub(super) fn screen_gradient<V: Number>(sums: &ScreenSums<V>) -> (Projection<V>, V) {
    let &[k, steepness, steepness_y, t, dy, t_t, t_dy, dy_dy, z, along_x] = sums;
    // v = conic · (pixel − centre) = (a t, shear a t + dy / cov_yy), a = conic_xx.
    let twice = 2.0 * std::f64::consts::LN_2;
    let (a, b) = (steepness * twice, steepness_y * twice);
    let at = a * t;
    let xx = a * a * t_t;
    let xy = k.mul_add(xx, a * b * t_dy);
    let yy = k.mul_add(xy + xy - k * xx, b * b * dy_dy);
    let mean = [at, k.mul_add(at, b * dy)];
    let cov = [xx * 0.5, xy, yy * 0.5];
    (Projection { mean, z: z * std::f64::consts::LN_2, cov }, a * along_x)
}
