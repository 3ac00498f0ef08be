//! The local operator: a gain and a bias per cell and channel that explain the remainder after the global
//! affine.
//!
//! The samples are adaptive means, 8 × 8 per cell, of `x' = M x̃` and of the target `y`. With `n = 64`,
//! `ρ = 10⁻²` and `m₂ = max(mean x'², 10⁻⁴)` the fit minimises
//! `Σ (g x' + b − y)² + ρ n m₂ (g − 1)² + ρ n b²`. With the samples' population moments — `var`, `mx` of
//! `x'`; `mr` of the residual `r = y − x'`; `cov = cov(x', r)` — the solution without cancellation is
//! ```text
//! D     = (1+ρ) var + ρ mx² + ρ (1+ρ) m₂          (≥ 10⁻⁶, because m₂ has a floor)
//! g − 1 = ((1+ρ) cov + ρ mx mr) / D
//! b     = ((var + ρ m₂) mr − mx cov) / D
//! ```
//!
//! The cell's operator is `(ln max(g, 0.05), b)` (log form, R16) or `(g − 1, b)` (linear form). Below the
//! gain floor the log-gain has no gradient; the bias keeps its own. Pooling is linear, so `x'` at the
//! samples is `M` applied to the pooled source, which is computed once per source.

use use3d_numerics::math;

use super::{Affine, Form, affine_apply};

/// Number of samples along a side of a cell.
pub(crate) const SIDE: usize = 8;
const SAMPLES: usize = SIDE * SIDE;
const RIDGE: f64 = 1e-2;
const ENERGY_FLOOR: f64 = 1e-4;
const GAIN_FLOOR: f64 = 0.05;

/// The samples of one channel of one cell, their residual, and the moments from which the fit is computed.
struct CellFit {
    x: [f64; SAMPLES],
    r: [f64; SAMPLES],
    mean_x: f64,
    mean_r: f64,
    variance: f64,
    covariance: f64,
    /// `max(mean x'², floor)`, and true if the floor is inactive.
    energy: f64,
    energy_active: bool,
    denominator: f64,
    /// `g − 1`.
    excess: f64,
    bias: f64,
}

impl CellFit {
    #[inline(always)]
    fn new(x: [f64; SAMPLES], y: &[f64; SAMPLES]) -> Self {
        let n = SAMPLES as f64;
        let r: [f64; SAMPLES] = std::array::from_fn(|i| y[i] - x[i]);
        let mean_x = x.iter().sum::<f64>() / n;
        let mean_r = r.iter().sum::<f64>() / n;
        let (mut variance, mut covariance) = (0.0, 0.0);
        for i in 0..SAMPLES {
            let d = x[i] - mean_x;
            variance += d * d;
            covariance += d * (r[i] - mean_r);
        }
        let (variance, covariance) = (variance / n, covariance / n);
        let raw_energy = variance + mean_x * mean_x;
        let energy = raw_energy.max(ENERGY_FLOOR);
        let denominator = (1.0 + RIDGE) * variance + RIDGE * mean_x * mean_x + RIDGE * (1.0 + RIDGE) * energy;
        let excess = ((1.0 + RIDGE) * covariance + RIDGE * mean_x * mean_r) / denominator;
        let bias = ((variance + RIDGE * energy) * mean_r - mean_x * covariance) / denominator;
        Self {
            x,
            r,
            mean_x,
            mean_r,
            variance,
            covariance,
            energy,
            energy_active: raw_energy > ENERGY_FLOOR,
            denominator,
            excess,
            bias,
        }
    }

    /// Converts gradients of `(g − 1, b)` to those of the samples of `x'` (with `y` fixed) and of `y`.
    #[inline(always)]
    fn backward(&self, d_excess: f64, d_bias: f64) -> ([f64; SAMPLES], [f64; SAMPLES]) {
        let n = SAMPLES as f64;
        let (p, q) = (d_excess / self.denominator, d_bias / self.denominator);
        let d_denominator = -(p * self.excess + q * self.bias);
        let d_covariance = (1.0 + RIDGE) * p - self.mean_x * q;
        let d_mean_r = RIDGE * self.mean_x * p + (self.variance + RIDGE * self.energy) * q;
        let mut d_variance = self.mean_r * q + (1.0 + RIDGE) * d_denominator;
        let mut d_mean_x =
            RIDGE * self.mean_r * p - self.covariance * q + 2.0 * RIDGE * self.mean_x * d_denominator;
        if self.energy_active {
            let d_energy = RIDGE * self.mean_r * q + RIDGE * (1.0 + RIDGE) * d_denominator;
            d_variance += d_energy;
            d_mean_x += 2.0 * self.mean_x * d_energy;
        }
        let mut d_x = [0.0; SAMPLES];
        let mut d_y = [0.0; SAMPLES];
        for i in 0..SAMPLES {
            let d = self.x[i] - self.mean_x;
            d_y[i] = (d_mean_r + d_covariance * d) / n;
            // The last term comes from r = y − x'.
            d_x[i] =
                (d_mean_x + 2.0 * d_variance * d + d_covariance * (self.r[i] - self.mean_r)) / n - d_y[i];
        }
        (d_x, d_y)
    }
}

/// One band of cells: eight rows of samples, `[8][3][columns]`, of the pooled source and of the pooled
/// target.
pub(crate) struct Band<'a> {
    /// Pooled source.
    pub(crate) source: &'a [f64],
    /// Pooled target.
    pub(crate) target: &'a [f64],
    /// Number of sample columns, eight per cell.
    pub(crate) columns: usize,
}

impl Band<'_> {
    #[inline(always)]
    fn gather(&self, plane: usize, cell: usize, from: &[f64]) -> [f64; SAMPLES] {
        std::array::from_fn(|i| from[((i / SIDE) * 3 + plane) * self.columns + cell * SIDE + i % SIDE])
    }

    /// The fits of the three channels of `cell` under the global operator `global`.
    #[inline(always)]
    fn fits(&self, global: &Affine, cell: usize) -> ([[f64; SAMPLES]; 3], [CellFit; 3]) {
        let source: [[f64; SAMPLES]; 3] = std::array::from_fn(|c| self.gather(c, cell, self.source));
        let mut mapped = [[0.0; SAMPLES]; 3];
        for i in 0..SAMPLES {
            let colour = affine_apply(global, [source[0][i], source[1][i], source[2][i]]);
            for c in 0..3 {
                mapped[c][i] = colour[c];
            }
        }
        let fits = std::array::from_fn(|c| CellFit::new(mapped[c], &self.gather(c, cell, self.target)));
        (source, fits)
    }

    /// The operators of the band's cells.
    #[inline(always)]
    pub(crate) fn forward(&self, global: &Affine, form: Form, operators: &mut [[f64; 6]]) {
        for (cell, operator) in operators.iter_mut().enumerate() {
            let (_, fits) = self.fits(global, cell);
            for c in 0..3 {
                operator[c] = match form {
                    Form::Log if fits[c].excess > GAIN_FLOOR - 1.0 => math::ln_1p(fits[c].excess),
                    Form::Log => math::ln(GAIN_FLOOR),
                    Form::Linear => fits[c].excess,
                };
                operator[3 + c] = fits[c].bias;
            }
        }
    }

    /// Converts gradients of the operators to those of the pooled target (`[8][3][columns]`, overwritten);
    /// returns the gradient with respect to the global operator through `x'`.
    #[inline(always)]
    pub(crate) fn backward(
        &self,
        global: &Affine,
        form: Form,
        d_cells: &[[f64; 6]],
        d_target: &mut [f64],
    ) -> Affine {
        let mut d_global = [0.0; 12];
        for (cell, d_cell) in d_cells.iter().enumerate() {
            let (source, fits) = self.fits(global, cell);
            for c in 0..3 {
                let d_excess = match form {
                    Form::Log if fits[c].excess > GAIN_FLOOR - 1.0 => d_cell[c] / (1.0 + fits[c].excess),
                    Form::Log => 0.0,
                    Form::Linear => d_cell[c],
                };
                let (d_x, d_y) = fits[c].backward(d_excess, d_cell[3 + c]);
                for i in 0..SAMPLES {
                    d_target[((i / SIDE) * 3 + c) * self.columns + cell * SIDE + i % SIDE] = d_y[i];
                }
                for j in 0..3 {
                    let mut sum = 0.0;
                    for i in 0..SAMPLES {
                        sum += d_x[i] * source[j][i];
                    }
                    d_global[4 * c + j] += sum;
                }
                d_global[4 * c + 3] += d_x.iter().sum::<f64>();
            }
        }
        d_global
    }

    /// The calibration weight of the band's cells: `v / (v + 10⁻³) · exp(−mse / 0.02)`, clamped to
    /// `[0, 1]`; `v` is the mean over channels of the samples' variance, and `mse` is the mean squared
    /// residual of the fit. It has no gradient.
    pub(crate) fn confidence(&self, global: &Affine, confidence: &mut [f64]) {
        for (cell, out) in confidence.iter_mut().enumerate() {
            let (_, fits) = self.fits(global, cell);
            let (mut variance, mut error) = (0.0, 0.0);
            for fit in &fits {
                variance += fit.variance / 3.0;
                for i in 0..SAMPLES {
                    let e = fit.excess * fit.x[i] + fit.bias - fit.r[i];
                    error += e * e / (3 * SAMPLES) as f64;
                }
            }
            *out = (variance / (variance + 1e-3) * math::exp(-error / 0.02)).clamp(0.0, 1.0);
        }
    }
}
