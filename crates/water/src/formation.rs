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

/// Returns a point's radiance and `Σ w a²` at these parameters and weights; stores the terms of its
/// observations in `seen`.
fn point(channel: &Channel, shared: &Shared, weights: &[f64], p: usize, seen: &mut Vec<Terms>) -> (f64, f64) {
    let range = channel.of_point(p);
    seen.clear();
    seen.extend(range.clone().map(|i| terms(channel, shared, i)));
    let triple = |(i, t): (usize, &Terms)| (weights[i], t.left, channel.value[i] - t.added);
    radiance(range.zip(&*seen).map(triple))
}

/// Returns the residuals of all observations, with every point's radiance at its optimum for these weights.
pub(crate) fn residuals(channel: &Channel, theta: &[f64], weights: &[f64]) -> Vec<f64> {
    let shared = Shared::new(theta);
    let mut all = vec![0.0; channel.value.len()];
    let mut seen: Vec<Terms> = Vec::new();
    for p in 0..channel.points() {
        let range = channel.of_point(p);
        let (j, _) = point(channel, &shared, weights, p, &mut seen);
        for (i, t) in range.zip(&seen) {
            all[i] = channel.value[i] - t.added - t.left * j;
        }
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

/// Sums the normal equations; `each` receives every point's index and its part of the gradient, as
/// parameters and values. Without `gains` the entries of the gains stay 0, which saves most of the work.
pub(crate) fn normal(
    channel: &Channel,
    theta: &[f64],
    weights: &[f64],
    gains: bool,
    mut each: impl FnMut(usize, &[usize], &[f64]),
) -> Normal {
    let (n, shared) = (channel.parameters(), Shared::new(theta));
    let (mut gradient, mut matrix) = (vec![0.0; n], vec![0.0; n * n]);
    let (mut index, mut local, mut u, mut v, mut part) =
        (Vec::new(), Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut seen: Vec<Terms> = Vec::new();
    for p in 0..channel.points() {
        let range = channel.of_point(p);
        let (j, below) = point(channel, &shared, weights, p, &mut seen);
        // The parameters that affect the point: the shared ones, then one gain per observation (a view sees
        // a point once).
        index.clear();
        index.extend(0..GAIN);
        if gains {
            index.extend(range.clone().map(|i| GAIN + channel.view[i]));
        }
        let k = index.len();
        let last = if gains { GAIN + 1 } else { GAIN };
        local.clear();
        local.resize(k * k, 0.0);
        for list in [&mut u, &mut v, &mut part] {
            list.clear();
            list.resize(k, 0.0);
        }
        for (o, (i, t)) in range.zip(&seen).enumerate() {
            let w = weights[i];
            let r = channel.value[i] - t.added - t.left * j;
            let x = t.derivative(j, &channel.direction[i]);
            let at = |e: usize| if e == GAIN { GAIN + o } else { e };
            for e in 0..last {
                u[at(e)] += w * t.left * x[e];
                part[at(e)] -= w * r * x[e];
                for f in 0..=e {
                    local[at(e) * k + at(f)] += w * x[e] * x[f];
                }
            }
            v[ATTENUATION] -= w * r * t.attn * t.left;
            if gains {
                v[GAIN + o] += w * r * t.left;
            }
        }
        // A radiance at its bound does not change with the parameters.
        if j > 0.0 {
            for e in 0..k {
                for f in 0..=e {
                    local[e * k + f] += (v[e] * v[f] - u[e] * u[f]) / below;
                }
            }
        }
        for e in 0..k {
            gradient[index[e]] += part[e];
            for f in 0..=e {
                let (row, column) = (index[e].max(index[f]), index[e].min(index[f]));
                matrix[row * n + column] += local[e * k + f];
            }
        }
        each(p, &index, &part);
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
