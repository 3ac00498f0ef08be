//! Water: measured attenuation by Jerlov's types, veiling light, and their effect on an image.
//!
//! `I = J e^{-β_attn s} + c_m(d) (1 - e^{-β_bs s})` per channel, with s the distance along the pixel's ray in
//! metres, d its direction, J the image without water in display range. The equation applies to display
//! values, as in the method.
//!
//! Coefficients. Jerlov's diffuse attenuation of daylight, K_d (1/m), for five oceanic and five coastal types
//! (N. G. Jerlov, *Marine Optics*, 2nd edition, 1976, table XXVII), averaged over 600-625 nm (red), 525-550
//! nm (green), 450-475 nm (blue). A beam is attenuated two to three times faster than daylight, and in
//! display values (a power of about 1/2.2 of light) an exponential is slower by the same factor, so `β_attn =
//! K_d`. Scattering by particles hardly depends on the wavelength, so the backscatter coefficient is drawn
//! towards the mean of green and blue: `β_bs = 0.55 K_d + 0.35 mean + 0.015`.
//!
//! The veiling light is daylight that reached the depth, was scattered once and was absorbed on its way: `c_m
//! ∝ b e^{-K_d (z (1-w) + 3)} / (K_d + 0.06)`. Here z is the depth, w the share of the colour cast that the
//! camera's white balance removed, and b inversely proportional to the wavelength. The light is brighter
//! upwards and towards the sun (a linear function of the ray's direction).

use glam::Vec3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::math;

/// Jerlov's optical water types: I to III oceanic, clear to dull; 1C to 9C coastal, increasingly turbid and
/// green.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "UPPERCASE")]
#[allow(missing_docs, reason = "the variants are Jerlov's names")]
pub enum WaterType {
    I,
    Ia,
    Ib,
    Ii,
    Iii,
    #[serde(rename = "1C")]
    Coastal1,
    #[serde(rename = "3C")]
    Coastal3,
    #[serde(rename = "5C")]
    Coastal5,
    #[serde(rename = "7C")]
    Coastal7,
    #[serde(rename = "9C")]
    Coastal9,
}

/// A name of an unknown water type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("unknown water type {0:?}; expected one of I, IA, IB, II, III, 1C, 3C, 5C, 7C, 9C")]
pub struct UnknownWaterType(pub String);

impl WaterType {
    /// Every type, clearest first within oceanic and coastal waters.
    pub const ALL: [Self; 10] = [
        Self::I,
        Self::Ia,
        Self::Ib,
        Self::Ii,
        Self::Iii,
        Self::Coastal1,
        Self::Coastal3,
        Self::Coastal5,
        Self::Coastal7,
        Self::Coastal9,
    ];

    /// Jerlov's name.
    pub fn name(self) -> &'static str {
        ["I", "IA", "IB", "II", "III", "1C", "3C", "5C", "7C", "9C"][self as usize]
    }

    /// `K_d` of red, green and blue, 1/m: the attenuation of display values in this water.
    pub fn attenuation(self) -> [f32; 3] {
        let k = self.diffuse_attenuation();
        // At 600 and 625, 525 and 550, 450 and 475 nm.
        [(7, 8), (4, 5), (1, 2)].map(|(a, b)| 0.5 * (k[a] + k[b]))
    }

    /// K_d in 1/m at [`WAVELENGTHS`].
    pub(crate) fn diffuse_attenuation(self) -> [f32; BANDS] {
        match self {
            Self::I => [0.022, 0.019, 0.018, 0.027, 0.043, 0.063, 0.089, 0.235, 0.305, 0.36],
            Self::Ia => [0.031, 0.026, 0.025, 0.032, 0.048, 0.067, 0.094, 0.24, 0.31, 0.37],
            Self::Ib => [0.042, 0.036, 0.033, 0.042, 0.054, 0.072, 0.099, 0.245, 0.315, 0.375],
            Self::Ii => [0.081, 0.068, 0.062, 0.070, 0.076, 0.089, 0.115, 0.26, 0.335, 0.40],
            Self::Iii => [0.160, 0.135, 0.116, 0.115, 0.116, 0.120, 0.148, 0.295, 0.375, 0.445],
            Self::Coastal1 => [0.36, 0.25, 0.17, 0.14, 0.13, 0.12, 0.15, 0.30, 0.37, 0.45],
            Self::Coastal3 => [0.54, 0.39, 0.29, 0.22, 0.20, 0.19, 0.21, 0.33, 0.40, 0.46],
            Self::Coastal5 => [0.78, 0.56, 0.43, 0.36, 0.31, 0.30, 0.33, 0.40, 0.48, 0.54],
            Self::Coastal7 => [1.20, 0.89, 0.71, 0.58, 0.49, 0.46, 0.46, 0.48, 0.54, 0.63],
            Self::Coastal9 => [2.40, 1.60, 1.23, 0.99, 0.78, 0.63, 0.58, 0.60, 0.65, 0.76],
        }
    }
}

impl std::fmt::Display for WaterType {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for WaterType {
    type Err = UnknownWaterType;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        let found = Self::ALL.into_iter().find(|t| t.name().eq_ignore_ascii_case(name));
        found.ok_or_else(|| UnknownWaterType(name.to_string()))
    }
}

/// Wavelengths of Jerlov's table, nm.
pub(crate) const WAVELENGTHS: [f32; BANDS] =
    [425.0, 450.0, 475.0, 500.0, 525.0, 550.0, 575.0, 600.0, 625.0, 650.0];
pub(crate) const BANDS: usize = 10;

/// Scattering by particles relative to green: inversely proportional to the wavelength.
const SCATTERING: [f32; 3] = [0.88, 1.0, 1.16];
/// Average sideways distance of daylight before it is scattered into the view, metres.
const SIDEWAYS: f32 = 3.0;

/// A body of water seen from inside. Coefficients are per the same unit of length as distances.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Water {
    /// `β_attn` per channel, 1/length.
    pub attenuation: [f32; 3],
    /// `β_bs` per channel, 1/length.
    pub backscatter: [f32; 3],
    /// Veiling light along a horizontal ray at right angles to the sun, display range.
    pub veil: [f32; 3],
    /// `c_m(d) = veil (1 + gradient · d)` per channel: one vector per channel, for unit rays d.
    pub veil_gradient: [[f32; 3]; 3],
}

impl Water {
    /// Water of a type at a depth (metres), in a frame where `up` points to the surface and `sun` to the sun.
    /// `white_balance` is the share of the colour cast removed by the camera, 0 to 1.
    pub fn of_type(kind: WaterType, depth: f32, white_balance: f32, up: Vec3, sun: Vec3) -> Self {
        let k = kind.attenuation();
        let mean = 0.5 * (k[1] + k[2]);
        let way = depth * (1.0 - white_balance) + SIDEWAYS;
        let veil: [f32; 3] = std::array::from_fn(|c| SCATTERING[c] * math::exp(-k[c] * way) / (k[c] + 0.06));
        let brightest = veil.iter().fold(0.0f32, |m, &v| m.max(v));
        // Upwards the path of the light is shorter: red gains most.
        let towards_sun = sun - sun.dot(up) * up;
        let gradient = |up_share: f32| (up_share * up + 0.16 * towards_sun).to_array();
        Self {
            attenuation: k,
            backscatter: k.map(|k| 0.55 * k + 0.35 * mean + 0.015),
            veil: veil.map(|v| math::powf(0.26 * v / brightest, 1.0 / 2.2)),
            veil_gradient: [gradient(0.90), gradient(0.70), gradient(0.50)],
        }
    }

    /// The colour of daylight at a depth (linear, brightest channel 1), after the camera's white balance.
    pub fn daylight_tint(kind: WaterType, depth: f32, white_balance: f32) -> [f32; 3] {
        let k = kind.attenuation();
        let tint = k.map(|k| math::exp(-k * depth * (1.0 - white_balance)));
        let brightest = tint.iter().fold(0.0f32, |m, &v| m.max(v));
        tint.map(|v| v / brightest)
    }

    /// The veiling light `c_m` along a unit ray.
    pub fn veil_along(&self, direction: Vec3) -> [f32; 3] {
        std::array::from_fn(|c| {
            let slope = Vec3::from_array(self.veil_gradient[c]).dot(direction);
            (self.veil[c] * (1.0 + slope)).max(0.0)
        })
    }

    /// The colour of `clean` after `distance` along a unit ray through the water; infinite distance is open
    /// water.
    pub fn seen_through(&self, clean: [f32; 3], distance: f32, direction: Vec3) -> [f32; 3] {
        let veil = self.veil_along(direction);
        std::array::from_fn(|c| {
            clean[c] * math::exp(-self.attenuation[c] * distance)
                - veil[c] * math::exp_m1(-self.backscatter[c] * distance)
        })
    }

    /// The same water in another frame and unit: `x' = scale R x + t`.
    pub(crate) fn in_frame(&self, frame: &use3d_capture::Frame) -> Self {
        let per_length = |k: [f32; 3]| k.map(|v| (f64::from(v) / frame.scale) as f32);
        Self {
            attenuation: per_length(self.attenuation),
            backscatter: per_length(self.backscatter),
            veil: self.veil,
            veil_gradient: self
                .veil_gradient
                .map(|g| (frame.rotation * Vec3::from_array(g).as_dvec3()).as_vec3().to_array()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn near_is_clean_far_is_veil_and_red_goes_first() {
        for kind in WaterType::ALL {
            let water = Water::of_type(kind, 6.0, 0.5, Vec3::Z, Vec3::new(0.3, 0.2, 0.9).normalize());
            let (clean, d) = ([0.8, 0.5, 0.3], Vec3::new(0.6, 0.8, 0.0));
            assert_eq!(water.seen_through(clean, 0.0, d), clean);
            assert_eq!(water.seen_through(clean, f32::INFINITY, d), water.veil_along(d));
            assert!(water.veil_along(Vec3::Z)[1] > water.veil_along(Vec3::NEG_Z)[1]);
            assert!(water.veil.iter().all(|v| (0.0..0.8).contains(v)), "{kind}: {:?}", water.veil);
            assert_eq!(kind.name().parse::<WaterType>().unwrap(), kind);
        }
        let blue = Water::of_type(WaterType::I, 6.0, 0.5, Vec3::Z, Vec3::Z);
        assert!(blue.attenuation[0] > 5.0 * blue.attenuation[2] && blue.veil[2] > blue.veil[1]);
        let green = Water::of_type(WaterType::Coastal5, 6.0, 0.5, Vec3::Z, Vec3::Z);
        assert!(green.veil[1] > green.veil[2]);
        assert!("IV".parse::<WaterType>().unwrap_err().to_string().contains("IV"));
    }
}
