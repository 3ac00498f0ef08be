//! Water that is known before training: the water's start, the time for which it is held, and the colours
//! behind it.
//!
//! Trained jointly from nothing, water drifts: Gaussians start with the photographs' hazy colours, so that
//! correct water in front of them is too much haze. The water, whose rates are high, then changes before
//! the colours do. Water that is known beforehand (from the capture's tracks) therefore has three effects:
//!
//! * every anchor starts from it: `c_m(d) = v + g·d` in the bands of degree 0 and 1, `β` in the constant
//!   band through the inverse of softplus. The water's active degree is at least 1 from the first step on
//!   (0 if `sh_degree` is 0; the slope is then not used);
//! * Gaussians start with the radiance J behind the water where tracks determine it, weighted by its
//!   certainty: `(w J + (1-w) I)` with `w = σ₀² / (σ₀² + σ_J²)`, σ₀ = 0.2 of display range, I the point's
//!   colour in the photographs;
//! * it is held for a share of the run (`medium_hold`) and then learnt at a fraction of its rates
//!   (`medium_release`).

use use3d_medium::{Coefficients, MediumModel};
use use3d_numerics::math;
use use3d_numerics::spherical_harmonics::{C0, C1};

use crate::ReconstructParams;

/// Error of J, display range, at which the photographs' colour has the same weight.
const EVEN: f64 = 0.2;
/// Smallest coefficient passed to the inverse of softplus, 1/normalised unit.
const LEAST: f64 = 1e-4;

/// The prior knowledge about a capture before training.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Known {
    /// The capture's water; `None` if it is not known.
    pub water: Option<FoundWater>,
    /// Gains of all views of the capture, red, green, blue, all positive; empty if they are not known. A view
    /// beyond the end has the gain 1.
    pub gains: Vec<[f64; 3]>,
}

/// Water found beforehand, in the normalised frame; channels are red, green, blue.
#[derive(Clone, Debug, PartialEq)]
pub struct FoundWater {
    /// `β_attn`, 1/normalised unit, not negative.
    pub attenuation: [f64; 3],
    /// `β_bs`, 1/normalised unit, not negative.
    pub backscatter: [f64; 3],
    /// `v` of `c_m(d) = v + g·d`, display range, for unit directions d of the normalised frame.
    pub veil: [f64; 3],
    /// `g` per channel.
    pub veil_slope: [[f64; 3]; 3],
    /// Radiance behind the water and its standard error, per channel, of the capture's points in their
    /// order; `None` where they are not known.
    pub radiances: Vec<Option<[(f64, f64); 3]>>,
}

impl FoundWater {
    /// Smallest active degree of the water: its veil needs the bands of degree 1.
    pub(crate) const DEGREE: usize = 1;

    /// The water as spherical-harmonic coefficients `[c_m, β_bs, β_attn][band][RGB]`.
    pub fn coefficients(&self) -> Coefficients {
        let mut out = Coefficients::default();
        let (c0, c1) = (f64::from(C0), f64::from(C1));
        // softplus⁻¹(β) = ln(e^β - 1)
        let raw = |beta: f64| (math::ln(math::exp_m1(beta.max(LEAST))) / c0) as f32;
        for c in 0..3 {
            let [x, y, z] = self.veil_slope[c];
            out[0][0][c] = ((self.veil[c] - 0.5) / c0) as f32;
            out[0][1][c] = (-y / c1) as f32;
            out[0][2][c] = (z / c1) as f32;
            out[0][3][c] = (-x / c1) as f32;
            out[1][0][c] = raw(self.backscatter[c]);
            out[2][0][c] = raw(self.attenuation[c]);
        }
        out
    }

    /// The model of the water at the start; `None` for a model that does not start from spherical
    /// harmonics.
    pub(crate) fn model(&self, params: &ReconstructParams) -> Option<MediumModel> {
        MediumModel::start_from(params.medium, &params.medium_start(&[]), &self.coefficients()).ok().flatten()
    }

    /// The colour with which the Gaussian of a point starts, computed from its colour in the photographs
    /// (display range).
    pub(crate) fn color(&self, point: usize, photographed: [f64; 3]) -> [f64; 3] {
        let Some(Some(radiance)) = self.radiances.get(point) else { return photographed };
        let sure = self.sure(point);
        std::array::from_fn(|c| match sure[c] {
            0.0 => photographed[c],
            w => w * radiance[c].0.clamp(0.0, 1.0) + (1.0 - w) * photographed[c],
        })
    }

    /// The weight w of a point's radiance in its start colour, per channel; 0 where the radiance is not
    /// known.
    pub(crate) fn sure(&self, point: usize) -> [f64; 3] {
        let Some(Some(radiance)) = self.radiances.get(point) else { return [0.0; 3] };
        radiance.map(|(value, error)| {
            let sure = EVEN * EVEN / (EVEN * EVEN + error * error);
            if value.is_finite() && sure.is_finite() { sure } else { 0.0 }
        })
    }
}

#[cfg(test)]
mod tests {
    use use3d_capture::{Camera, Intrinsics, Lattice, MediumMaps, Pose};

    use super::*;
    use crate::Medium;

    fn found() -> FoundWater {
        FoundWater {
            attenuation: [0.9, 0.31, 0.0],
            backscatter: [0.7, 0.42, 0.05],
            veil: [0.2, 0.5, 0.55],
            veil_slope: [[0.05, -0.02, 0.08], [0.0, 0.1, -0.04], [0.03, 0.0, 0.06]],
            radiances: vec![Some([(0.8, 0.0), (1.7, 0.1), (0.4, f64::INFINITY)]), None],
        }
    }

    #[test]
    fn every_model_starts_at_the_water_that_was_found() {
        let found = found();
        let intrinsics = Intrinsics { width: 5, height: 4, fx: 4.0, fy: 4.0, cx: 2.5, cy: 2.0 };
        let pose = Pose::look_at([0.3, -0.2, 0.1].into(), [1.0, 0.4, -0.3].into(), glam::DVec3::Z);
        let camera = Camera { intrinsics, pose };
        let lattice = Lattice::full(&camera.intrinsics);
        for medium in [Medium::Rbf, Medium::Global, Medium::Image] {
            let params = ReconstructParams { medium, ..ReconstructParams::default() };
            let model = found.model(&params).expect("spherical harmonics");
            let mut maps = MediumMaps::zeros(5, 4);
            model.maps(&camera, &lattice, FoundWater::DEGREE, &mut maps);
            for y in 0..4 {
                for x in 0..5 {
                    let ray = camera.ray(x as f64 + 0.5, y as f64 + 0.5).normalize();
                    let d = camera.pose.rotation.transpose() * ray;
                    for c in 0..3 {
                        let close = |what: &str, got: f32, wanted: f64| {
                            assert!(
                                (f64::from(got) - wanted).abs() < 2e-5,
                                "{what} {c}: {got}, not {wanted}"
                            );
                        };
                        let slope = glam::DVec3::from_array(found.veil_slope[c]).dot(d);
                        close("veil", maps.color.pixel(x, y)[c], found.veil[c] + slope);
                        close("backscatter", maps.backscatter.pixel(x, y)[c], found.backscatter[c]);
                        close(
                            "attenuation",
                            maps.attenuation.pixel(x, y)[c],
                            found.attenuation[c].max(LEAST),
                        );
                    }
                }
            }
        }
        let none = ReconstructParams { medium: Medium::Mlp, ..ReconstructParams::default() };
        assert!(found.model(&none).is_none());
    }

    #[test]
    fn colours_are_the_radiance_as_far_as_it_is_known() {
        let found = found();
        let seen = [0.3, 0.4, 0.5];
        let [red, green, blue] = found.color(0, seen);
        assert_eq!((red, blue), (0.8, 0.5));
        // Clamped to display range, then four parts of five.
        assert!((green - (0.8 * 1.0 + 0.2 * 0.4)).abs() < 1e-12, "{green}");
        assert_eq!(found.color(1, seen), seen);
        assert_eq!(found.color(7, seen), seen);
    }
}
