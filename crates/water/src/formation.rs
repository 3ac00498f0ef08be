//! The image formation of one channel with every point's radiance eliminated.
//!
//! An observation i of a point, at distance `s_i` along the unit direction `d_i` in view v:
//!
//! ```text
//! m_i  = a_i J + b_i,       a_i = e^{γ_v} e^{−β_a s_i},   b_i = e^{γ_v} B(d_i) (1 − e^{−β_b s_i}),
//! B(d) = B_0 (1 + g·(d − d̄))
//! ```
//!
//! J is the point's radiance without water. For given parameters and weights it has a closed form,
//! `J = Σ w a (I − b) / Σ w a²` (0 where that is negative, because no surface radiates less than nothing).
//! So only the shared parameters are left: variable projection (Golub and Pereyra, "The differentiation of
//! pseudo-inverses and nonlinear least squares problems whose variables separate", SIAM J. Numer. Anal. 10,
//! 1973). With `r = I − b − a J` and `x_i = ∂m_i/∂θ` at fixed J, the projected residual's exact derivative
//! is
//!
//! ```text
//! dr_i = −x_i + a_i (u − v)/S,   S = Σ w a²,   u = Σ w a x,   v = Σ w r ∂a/∂θ
//! ```
//!
//! so that gradient and Gauss-Newton matrix of `½ Σ w r²` are `−Σ w r x` and `Σ w x xᵀ − u uᵀ/S + v vᵀ/S`.
//! A point affects only the shared parameters and the gains of the views that saw it.
//!
//! Distances are in units of the capture's median distance.

use rayon::prelude::*;
use use3d_numerics::math;

/// Index of `ln β_a`.
pub(crate) const ATTENUATION: usize = 0;
/// Index of `ln β_b`.
pub(crate) const BACKSCATTER: usize = 1;
/// Index of `ln B_0`; `g` follows.
pub(crate) const VEIL: usize = 2;
/// Index of the first view's `γ`.
pub(crate) const GAIN: usize = 6;

/// One channel's observations, grouped by point.
#[derive(Clone, Debug, Default)]
pub(crate) struct Channel {
    /// Point p has observations `start[p] .. start[p + 1]`.
    pub(crate) start: Vec<usize>,
    /// The view of each observation.
    pub(crate) view: Vec<usize>,
    /// Distance over the median distance.
    pub(crate) distance: Vec<f64>,
    /// Unit direction minus the mean direction.
    pub(crate) direction: Vec<[f64; 3]>,
    /// The observed value, display range.
    pub(crate) value: Vec<f64>,
    /// The unevenness of the surface at the observation, display range.
    pub(crate) spread: Vec<f64>,
    /// Number of views of the capture.
    pub(crate) views: usize,
}

impl Channel {
    pub(crate) fn points(&self) -> usize {
        self.start.len().saturating_sub(1)
    }

    pub(crate) fn parameters(&self) -> usize {
        GAIN + self.views
    }

    pub(crate) fn of_point(&self, p: usize) -> std::ops::Range<usize> {
        self.start[p]..self.start[p + 1]
    }
}

/// The parameters in the form of the equation.
pub(crate) struct Shared {
    attenuation: f64,
    backscatter: f64,
    veil: f64,
    slope: [f64; 3],
    gains: Vec<f64>,
}

impl Shared {
    pub(crate) fn new(theta: &[f64]) -> Self {
        Self {
            attenuation: math::exp(theta[ATTENUATION]),
            backscatter: math::exp(theta[BACKSCATTER]),
            veil: math::exp(theta[VEIL]),
            slope: std::array::from_fn(|k| theta[VEIL + 1 + k]),
            gains: theta[GAIN..].iter().map(|g| math::exp(*g)).collect(),
        }
    }
}

/// The terms of one observation at given parameters.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Terms {
    /// `a`: the fraction of the radiance that is left.
    pub(crate) left: f64,
    /// `b`: the light that the water adds.
    pub(crate) added: f64,
    gain: f64,
    /// `B(d)` and `B_0`.
    veil: [f64; 2],
    /// `1 − e^{−β_b s}`.
    fill: f64,
    attn: f64,
    back: f64,
}

/// The terms of observation `i`.
pub(crate) fn terms(channel: &Channel, shared: &Shared, i: usize) -> Terms {
    let s = channel.distance[i];
    let (attn, back) = (shared.attenuation * s, shared.backscatter * s);
    let d = &channel.direction[i];
    let veil = shared.veil * (1.0 + (0..3).map(|k| shared.slope[k] * d[k]).sum::<f64>());
    let (gain, fill) = (shared.gains[channel.view[i]], -math::exp_m1(-back));
    Terms {
        left: gain * math::exp(-attn),
        added: gain * veil * fill,
        gain,
        veil: [veil, shared.veil],
        fill,
        attn,
        back,
    }
}

impl Terms {
    /// `∂m/∂θ` at fixed radiance: the six shared parameters, then the view's gain.
    pub(crate) fn derivative(&self, radiance: f64, direction: &[f64; 3]) -> [f64; GAIN + 1] {
        let level = self.gain * self.veil[1] * self.fill;
        [
            -radiance * self.left * self.attn,
            self.gain * self.veil[0] * (1.0 - self.fill) * self.back,
            self.added,
            level * direction[0],
            level * direction[1],
            level * direction[2],
            radiance * self.left + self.added,
        ]
    }
}

/// Returns the radiance of a point from `(weight, a, I − b)` of its observations, and `Σ w a²`.
pub(crate) fn radiance(observations: impl Iterator<Item = (f64, f64, f64)>) -> (f64, f64) {
    let (mut above, mut below) = (0.0, 0.0);
    for (w, a, y) in observations {
        above += w * a * y;
        below += w * a * a;
    }
    (if below > 0.0 { (above / below).max(0.0) } else { 0.0 }, below)
}

/// Number of points of one task; the results do not depend on it.
const CHUNK: usize = 128;

/// Computes the terms of all observations. They depend on the parameters alone, so one computation serves the
/// residuals and the normal equations for any weights.
pub(crate) fn all_terms(channel: &Channel, theta: &[f64]) -> Vec<Terms> {
    let shared = Shared::new(theta);
    let observations = (0..channel.value.len()).into_par_iter().with_min_len(1024);
    observations.map(|i| terms(channel, &shared, i)).collect()
}

/// Returns a point's radiance and `Σ w a²` for these weights.
fn point(channel: &Channel, terms: &[Terms], weights: &[f64], p: usize) -> (f64, f64) {
    radiance(channel.of_point(p).map(|i| (weights[i], terms[i].left, channel.value[i] - terms[i].added)))
}

/// Returns the residuals of all observations, with every point's radiance at its optimum for these weights.
pub(crate) fn residuals(channel: &Channel, terms: &[Terms], weights: &[f64]) -> Vec<f64> {
    let points = (0..channel.points()).into_par_iter().with_min_len(CHUNK);
    let radiances: Vec<f64> = points.map(|p| point(channel, terms, weights, p).0).collect();
    let mut all = Vec::with_capacity(channel.value.len());
    for (p, j) in radiances.iter().enumerate() {
        all.extend(channel.of_point(p).map(|i| channel.value[i] - terms[i].added - terms[i].left * j));
    }
    all
}

/// Gradient and Gauss-Newton matrix of `½ Σ w r²` over all parameters.
pub(crate) struct Normal {
    /// `−Σ w r x`.
    pub(crate) gradient: Vec<f64>,
    /// `Σ w D Dᵀ` with `D = dr/dθ`, row-major.
    pub(crate) matrix: Vec<f64>,
}

/// The part of the normal equations that a point adds, over the parameters that affect it: the shared ones,
/// then one gain per observation (a view sees a point once). Appends the gradient, then the rows of the
/// matrix's lower triangle.
fn point_part(
    channel: &Channel,
    terms: &[Terms],
    weights: &[f64],
    gains: bool,
    p: usize,
    [u, v]: &mut [Vec<f64>; 2],
    out: &mut Vec<f64>,
) {
    let range = channel.of_point(p);
    let (j, below) = point(channel, terms, weights, p);
    let k = GAIN + if gains { range.len() } else { 0 };
    let first = out.len();
    out.resize(first + k + k * (k + 1) / 2, 0.0);
    let (part, triangle) = out[first..].split_at_mut(k);
    for sums in [&mut *u, &mut *v] {
        sums.clear();
        sums.resize(k, 0.0);
    }
    for (o, i) in range.enumerate() {
        let (w, t) = (weights[i], &terms[i]);
        let r = channel.value[i] - t.added - t.left * j;
        let x = t.derivative(j, &channel.direction[i]);
        for e in 0..GAIN {
            u[e] += w * t.left * x[e];
            part[e] -= w * r * x[e];
            let row = &mut triangle[e * (e + 1) / 2..][..=e];
            row.iter_mut().zip(&x).for_each(|(sum, f)| *sum += w * x[e] * f);
        }
        v[ATTENUATION] -= w * r * t.attn * t.left;
        if gains {
            let e = GAIN + o;
            u[e] += w * t.left * x[GAIN];
            part[e] -= w * r * x[GAIN];
            v[e] += w * r * t.left;
            let row = &mut triangle[e * (e + 1) / 2..][..=e];
            row.iter_mut().zip(&x[..GAIN]).for_each(|(sum, f)| *sum += w * x[GAIN] * f);
            row[e] += w * x[GAIN] * x[GAIN];
        }
    }
    // A radiance at its bound does not change with the parameters.
    if j > 0.0 {
        let mut at = 0;
        for e in 0..k {
            for f in 0..=e {
                triangle[at] += (v[e] * v[f] - u[e] * u[f]) / below;
                at += 1;
            }
        }
    }
}

/// `x²`.
pub(crate) fn square(x: f64) -> f64 {
    x * x
}

/// Sums the normal equations; `each` receives every point's index and its part of the gradient, as
/// parameters and values. Without `gains` the entries of the gains stay 0, which saves most of the work.
pub(crate) fn normal(
    channel: &Channel,
    terms: &[Terms],
    weights: &[f64],
    gains: bool,
    mut each: impl FnMut(usize, &[usize], &[f64]),
) -> Normal {
    let n = channel.parameters();
    let (mut gradient, mut matrix) = (vec![0.0; n], vec![0.0; n * n]);
    let points_of = |chunk: usize| chunk * CHUNK..channel.points().min((chunk + 1) * CHUNK);
    let chunk_parts = |chunk: usize| {
        let (mut scratch, mut out) = (Default::default(), Vec::new());
        for p in points_of(chunk) {
            point_part(channel, terms, weights, gains, p, &mut scratch, &mut out);
        }
        out
    };
    let chunks: Vec<Vec<f64>> =
        (0..channel.points().div_ceil(CHUNK)).into_par_iter().map(chunk_parts).collect();
    // The parts are added in the order of the points, so that the sums do not depend on the threads.
    let mut index: Vec<usize> = Vec::new();
    for (chunk, values) in chunks.iter().enumerate() {
        let mut rest = &values[..];
        for p in points_of(chunk) {
            index.clear();
            index.extend(0..GAIN);
            if gains {
                index.extend(channel.of_point(p).map(|i| GAIN + channel.view[i]));
            }
            let (part, after) = rest.split_at(index.len());
            let (triangle, after) = after.split_at(index.len() * (index.len() + 1) / 2);
            rest = after;
            let mut at = 0;
            for (e, &row) in index.iter().enumerate() {
                gradient[row] += part[e];
                for &column in &index[..=e] {
                    matrix[row.max(column) * n + row.min(column)] += triangle[at];
                    at += 1;
                }
            }
            each(p, &index, part);
        }
    }
    for row in 0..n {
        for column in row + 1..n {
            matrix[row * n + column] = matrix[column * n + row];
        }
    }
    Normal { gradient, matrix }
}

#[cfg(test)]
mod tests;
