//! Transport of light through water by wavelength, as single scattering in a homogeneous body of water.
//!
//! There are ten wavelengths λ from 425 to 650 nm. `K(λ)` is Jerlov's diffuse attenuation (1/m), `z` are
//! depths below the surface, s is the distance along the ray (m) and `d_z` the ray's upward component. The
//! light of λ that reaches the camera is
//!
//! ```text
//! L(λ) = ρ(λ) [E₀ e^{-K z_point} σ + lamps(point)] e^{-c s}
//!        + v(λ, d) E₀ e^{-K z_camera} (1 - e^{-m s}) / m  +  lamp haze
//! m    = c - K d_z                 daylight grows along a rising ray, so that haze builds up with m, not c
//! c    = 0.75 K + 0.5 b            image-forming attenuation: absorption, and scattering out of the image
//! b    = b₅₅₀ (550 nm / λ)         scattering by particles, b₅₅₀ = 0.04 + 1.5 (K(550 nm) - 0.0565) 1/m
//! v    = 0.16 b (1 + 0.35 d·sun)   daylight scattered towards the camera, a little more with the sun ahead
//! ```
//!
//! with ρ the reflectance, σ the neutral shading of the scene under its soft daylight and `E₀ = 1` for every
//! wavelength. The camera integrates with bell-shaped responses around 465, 532 and 605 nm; a white surface
//! in air under E₀ reads 1 in every channel. The sum over wavelengths of one channel is not an exponential:
//! by design, a single β per channel cannot express it.
//!
//! Approximations: reflectances have three degrees of freedom (those of the scene's albedo); scattering is
//! single and does not blur; b and its share towards the camera are plausible, not measured; E₀ is flat. The
//! table of K is from N. G. Jerlov, *Marine Optics*, 2nd edition, 1976, table XXVII.

use glam::Vec3;
use use3d_numerics::math;

use crate::geometry::bvh::Ray;
use crate::render::RayColor;
use crate::scene::SurfaceHit;
use crate::water::{BANDS, WAVELENGTHS, WaterType};

/// The index of 550 nm.
const MIDDLE: usize = 5;

/// A value for every wavelength.
type Spectrum = [f32; BANDS];

/// The camera's relative response of a channel (red, green, blue), summing to 1 over the wavelengths.
fn response(channel: usize) -> Spectrum {
    let (centre, width) = [(605.0f32, 32.0f32), (532.0, 36.0), (465.0, 28.0)][channel];
    let bell = WAVELENGTHS.map(|l| math::exp(-0.5 * ((l - centre) / width) * ((l - centre) / width)));
    let sum: f32 = bell.iter().sum();
    bell.map(|v| v / sum)
}

/// The share of each channel's albedo that a wavelength reflects: smooth steps at 495 and 580 nm that sum to
/// 1, so that grey is grey at every wavelength.
fn reflectance(band: usize) -> [f32; 3] {
    let step = |at: f32| 1.0 / (1.0 + math::exp(-(WAVELENGTHS[band] - at) / 12.0));
    let (above_blue, above_green) = (step(495.0), step(580.0));
    [above_blue * above_green, above_blue * (1.0 - above_green), 1.0 - above_blue]
}

/// Deviation of reef animals and algae from smooth spectra, at [`WAVELENGTHS`], for a colour at the greatest
/// distance from grey: pigments absorb below 520 nm, and there are three peaks between 570 and 650 nm.
const REEF: Spectrum = [-0.20, -0.25, -0.25, -0.15, -0.02, 0.08, 0.32, 0.15, 0.12, 0.30];

/// `(1 - e^{-m s}) / m`, for m of any sign and near zero; `s` at most a few hundred metres.
fn built_up(m: f32, s: f32) -> f32 {
    let x = m * s;
    if x.abs() < 1e-3 { s * (1.0 - 0.5 * x) } else { -math::exp_m1(-x) / m }
}

/// Two lamps that move with the camera.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Lamps {
    /// Light of both on a white surface one metre ahead, in units of E₀.
    pub(crate) strength: f32,
}

/// Share of scattered daylight that turns into the view, in units of a white surface's light. It includes
/// higher orders of scattering.
const DAYLIGHT_HAZE: f32 = 0.16;
/// The same share for lamp light, which has to be scattered back.
const LAMP_HAZE: f32 = 0.02;
/// Light of the sky above a scene in air, per channel, in units of a white surface's light.
const SKY: Vec3 = Vec3::new(0.55, 0.68, 0.85);

/// Distance of each lamp from the camera's axis, metres: along the picture's rows, on both sides.
const LAMP_ARM: f32 = 0.45;
/// Points along a ray at which the lamps' haze is summed, metres; the weights are the distances between them.
const HAZE_STEPS: [(f32, f32); 8] =
    [(0.3, 0.25), (0.6, 0.3), (0.9, 0.35), (1.3, 0.5), (1.9, 0.7), (2.7, 0.9), (3.8, 1.3), (5.4, 1.9)];

/// A body of water with its daylight, seen by a camera.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Spectral {
    /// Diffuse attenuation K, image-forming attenuation c, scattering b, 1/m.
    diffuse: Spectrum,
    beam: Spectrum,
    scattering: Spectrum,
    /// Depth below the surface of the height 0, metres.
    depth: f32,
    sun: Vec3,
    lamps: Option<Lamps>,
    /// The picture's x axis, along which the lamps' arms extend.
    sideways: Vec3,
    /// The colour where no surface is seen: sky, or black (then only haze is seen).
    pub(crate) background: Vec3,
    /// True if surfaces have the spectra of reefs; grey ones keep smooth spectra.
    pub(crate) reef: bool,
    /// Light of the sky ahead that the lens spreads over the picture, as a share of the sky's light.
    glare: f32,
    responses: [Spectrum; 3],
    reflectances: [[f32; 3]; BANDS],
}

impl Spectral {
    /// Water of a type whose surface is `depth` metres above height 0; `sun` points to the sun.
    pub(crate) fn new(kind: WaterType, depth: f32, sun: Vec3, lamps: Option<Lamps>) -> Self {
        let diffuse = kind.diffuse_attenuation();
        let particles = 0.04 + 1.5 * (diffuse[MIDDLE] - 0.0565).max(0.0);
        let scattering: Spectrum = std::array::from_fn(|i| particles * WAVELENGTHS[MIDDLE] / WAVELENGTHS[i]);
        Self {
            diffuse,
            beam: std::array::from_fn(|i| 0.75 * diffuse[i] + 0.5 * scattering[i]),
            scattering,
            depth,
            sun,
            lamps,
            sideways: Vec3::X,
            background: Vec3::ZERO,
            reef: false,
            glare: 0.0,
            responses: [0, 1, 2].map(response),
            reflectances: std::array::from_fn(reflectance),
        }
    }

    /// No water: the scene in air, under the sky.
    pub(crate) fn air(sun: Vec3) -> Self {
        let none = [0.0; BANDS];
        let water = Self::new(WaterType::I, 0.0, sun, None);
        Self { diffuse: none, beam: none, scattering: none, background: SKY, ..water }
    }

    /// The same against the light: the sky is 1 + 3 `strength` times as bright, and the lens spreads a share
    /// of the visible sky's light over the whole picture.
    pub(crate) fn against_light(self, strength: f32) -> Self {
        Self { background: (1.0 + 3.0 * strength) * self.background, glare: 0.06 * strength, ..self }
    }

    /// The light that the lens spreads over a picture in which the sky fills this `share`.
    pub(crate) fn glare(&self, share: f32) -> Vec3 {
        self.glare * share * self.background
    }

    /// The same water for a camera whose picture has this x axis.
    pub(crate) fn seen_from(&self, sideways: Vec3) -> Self {
        Self { sideways, ..*self }
    }

    /// Daylight of a wavelength at a height; at the surface and above it is complete.
    fn daylight(&self, band: usize, height: f32) -> f32 {
        math::exp(-self.diffuse[band] * (self.depth - height).max(0.0))
    }

    /// Light of both lamps of a wavelength at a point: inverse square, attenuated on its way.
    fn lamp_light(&self, band: usize, eye: Vec3, point: Vec3) -> f32 {
        let Some(lamps) = self.lamps else { return 0.0 };
        [-LAMP_ARM, LAMP_ARM]
            .map(|arm| {
                let way = (point - eye - arm * self.sideways).length().max(0.2);
                0.5 * lamps.strength * math::exp(-self.beam[band] * way) / (way * way)
            })
            .iter()
            .sum()
    }

    /// Light scattered into the camera along the way to `s` (infinite in open water).
    fn haze(&self, band: usize, eye: Vec3, direction: Vec3, s: f32) -> f32 {
        let towards = DAYLIGHT_HAZE * self.scattering[band] * (1.0 + 0.35 * direction.dot(self.sun));
        // A rising ray leaves the water at the surface.
        let to_surface =
            if direction.z > 1e-4 { (self.depth - eye.z).max(0.0) / direction.z } else { f32::INFINITY };
        let way = s.min(to_surface).min(200.0);
        let m = self.beam[band] - self.diffuse[band] * direction.z;
        let mut haze = towards * self.daylight(band, eye.z) * built_up(m, way);
        if self.lamps.is_some() {
            for (at, width) in HAZE_STEPS {
                let part = (s - (at - 0.5 * width)).clamp(0.0, width);
                if part > 0.0 {
                    let lit = self.lamp_light(band, eye, eye + at * direction);
                    haze += part * LAMP_HAZE * self.scattering[band] * lit * math::exp(-self.beam[band] * at);
                }
            }
        }
        haze
    }

    /// The values of the camera's channels, linear, for a surface of this shaded albedo at `s` metres along a
    /// unit ray, or for open water. A white surface in air under daylight gives 1.
    pub(crate) fn light(&self, surface: Option<Vec3>, eye: Vec3, direction: Vec3, s: f32) -> Vec3 {
        let mut channels = if surface.is_none() { self.background } else { Vec3::ZERO };
        for band in 0..BANDS {
            let mut light = self.haze(band, eye, direction, s);
            if let Some(albedo) = surface {
                let point = eye + s * direction;
                let mut reflected = Vec3::from_array(self.reflectances[band]).dot(albedo);
                if self.reef {
                    let brightest = albedo.max_element();
                    let chroma = (brightest - albedo.min_element()) / brightest.max(1e-6);
                    reflected *= 1.0 + REEF[band] * chroma;
                }
                let lit = self.daylight(band, point.z) + self.lamp_light(band, eye, point);
                light += reflected * lit * math::exp(-self.beam[band] * s);
            }
            for c in 0..3 {
                channels[c] += self.responses[c][band] * light;
            }
        }
        channels
    }

    /// Light of a white surface at height 0 under daylight alone, per channel, seen from `s` metres away,
    /// without haze.
    pub(crate) fn white(&self, s: f32) -> [f32; 3] {
        std::array::from_fn(|c| {
            (0..BANDS)
                .map(|b| self.responses[c][b] * self.daylight(b, 0.0) * math::exp(-self.beam[b] * s))
                .sum()
        })
    }
}

impl RayColor for Spectral {
    fn color(&self, seen: Option<SurfaceHit>, ray: &Ray) -> Vec3 {
        let per_t = ray.direction.length();
        let s = seen.map_or(f32::INFINITY, |seen| seen.t * per_t);
        self.light(seen.map(|seen| seen.light), ray.origin, ray.direction / per_t, s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EYE: Vec3 = Vec3::new(0.0, 0.0, 1.5);

    fn water(kind: WaterType, depth: f32) -> Spectral {
        Spectral::new(kind, depth, Vec3::new(0.3, 0.2, 0.9).normalize(), None)
    }

    #[test]
    fn near_the_surface_and_near_the_eye_a_surface_shows_its_albedo() {
        for kind in WaterType::ALL {
            let grey = water(kind, 0.0).light(Some(Vec3::splat(0.4)), Vec3::ZERO, Vec3::Y, 1e-4);
            assert!((grey - 0.4).abs().max_element() < 2e-3, "{kind}: {grey}");
        }
        let red = water(WaterType::I, 0.0).light(Some(Vec3::X), Vec3::ZERO, Vec3::Y, 1e-4);
        assert!(red.x > 0.7 && red.y < 0.2 && red.z < 0.05, "{red}");
    }

    #[test]
    fn red_goes_first_with_distance_and_with_depth() {
        let [near, far] = [1.0, 8.0].map(|s| water(WaterType::Ii, 5.0).white(s));
        assert!(far[0] / near[0] < far[2] / near[2], "{near:?} {far:?}");
        let [high, low] = [2.0, 12.0].map(|depth| water(WaterType::Ii, depth).white(1.0));
        assert!(low[0] / high[0] < low[2] / high[2], "{high:?} {low:?}");
    }

    #[test]
    fn no_single_exponential_describes_a_channel() {
        // The apparent coefficient of red falls with distance, because its longest wavelengths are absorbed
        // first.
        let water = water(WaterType::I, 5.0);
        let apparent = |s: f32| math::ln(water.white(s)[0] / water.white(s + 1.0)[0]);
        assert!(apparent(8.0) < 0.93 * apparent(0.0), "{} {}", apparent(0.0), apparent(8.0));
    }

    #[test]
    fn haze_grows_to_a_limit_and_is_brighter_upwards() {
        let water = water(WaterType::Iii, 8.0);
        let at = |s: f32, d: Vec3| water.light(None, EYE, d, s);
        assert!(at(1.0, Vec3::Y).y < at(4.0, Vec3::Y).y && at(4.0, Vec3::Y).y < at(f32::INFINITY, Vec3::Y).y);
        assert!(at(f32::INFINITY, Vec3::Z).is_finite());
        let up = Vec3::new(0.0, 0.8, 0.6);
        assert!(at(f32::INFINITY, up).y > at(f32::INFINITY, Vec3::new(0.0, 0.8, -0.6)).y);
    }

    #[test]
    fn the_build_up_of_haze_is_its_integral() {
        for m in [-0.3f32, -1e-5, 0.0, 1e-5, 0.2, 1.5] {
            for s in [0.01f32, 1.0, 9.0] {
                let n = 20_000;
                let sum: f64 = (0..n)
                    .map(|i| math::exp(-f64::from(m) * f64::from(s) * (f64::from(i) + 0.5) / f64::from(n)))
                    .sum();
                let wanted = sum * f64::from(s) / f64::from(n);
                assert!((f64::from(built_up(m, s)) / wanted - 1.0).abs() < 1e-3, "{m} {s}");
            }
        }
    }

    #[test]
    fn air_takes_nothing_away_and_has_a_sky() {
        let air = Spectral::air(Vec3::Z);
        let grey = air.light(Some(Vec3::splat(0.4)), EYE, Vec3::Y, 30.0);
        assert!((grey - 0.4).abs().max_element() < 1e-5, "{grey}");
        assert_eq!(air.light(None, EYE, Vec3::Y, f32::INFINITY), SKY);
        assert_eq!(air.white(30.0).map(|v| (v * 1e5).round()), [1e5; 3]);
    }

    #[test]
    fn lamps_light_what_is_near_and_make_haze() {
        let dark = Spectral::new(WaterType::I, 60.0, Vec3::Z, None);
        let lit = Spectral::new(WaterType::I, 60.0, Vec3::Z, Some(Lamps { strength: 2.0 }));
        let grey = Some(Vec3::splat(0.5));
        let near = lit.light(grey, EYE, Vec3::Y, 1.0);
        assert!(near.x > 20.0 * dark.light(grey, EYE, Vec3::Y, 1.0).x);
        assert!(near.x > 3.0 * lit.light(grey, EYE, Vec3::Y, 3.0).x);
        let open = |w: &Spectral| w.light(None, EYE, Vec3::Y, f32::INFINITY);
        assert!(open(&lit).y > open(&dark).y);
    }
}
