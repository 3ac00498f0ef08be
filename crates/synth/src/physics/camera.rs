//! A camera that exposes and balances every view separately, and its sensor.
//!
//! The gains of a view follow its own mean light m (per channel, linear, over a coarse grid of rays), as in
//! automatic cameras:
//!
//! ```text
//! balance_c  = (mean(m) / m_c)^w                        w the share of the grey-world balance
//! exposure   = 0.14 / luminance(balance m) · e^{0.06 n}  n normal: metering is never quite the same
//! g_c        = (view's exposure balance_c)^a (capture's)^{1-a}
//! display    = sRGB(g_c L_c + noise)
//!              noise deviation σ sqrt(g_c / g₀ · (x + 0.004) / 0.222)  for x = g_c L_c
//! ```
//!
//! A camera that develops as action cameras do ([`Development::Action`]) bounds the balance (a channel's gain
//! over green's is 1/3 to 3). After the gains it clips, converts its sensor's colours to sRGB by a matrix,
//! increases the distance of colours from grey by 1.2, applies sRGB and a contrast curve, and clips again.
//! Linear light and the method's equation no longer hold after this, as in most real captures.
//!
//! a = 0 is one setting for the whole capture (geometric means over its views), a = 1 a separate setting for
//! each view. Noise grows like that of photons: an amplified channel is noisy. g₀ is the capture's middle
//! green gain; σ is then the deviation of a middle tone of green in display range. Gains are at most 40.

use glam::{Mat3, Vec3};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_capture::{Camera, Image};
use use3d_numerics::math;
use use3d_numerics::order::median;
use use3d_numerics::random::{Purpose, Stream};

use crate::render::{RayColor, coarse_rays};
use crate::scene::{Caustics, MeshScene, display};

/// Rec. 601 luminance.
const LUMINANCE: Vec3 = Vec3::new(0.299, 0.587, 0.114);
/// Linear luminance to which a view is exposed.
const MIDDLE: f32 = 0.14;
/// Largest gain: no camera amplifies without limit.
const HIGHEST_GAIN: f32 = 40.0;

/// The development of a sensor's light.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Development {
    /// sRGB with a soft shoulder, like a simple raw developer.
    #[default]
    Plain,
    /// Like action cameras, see the header of the module `physics`.
    Action,
}

impl Development {
    /// All developments.
    pub const ALL: [Self; 2] = [Self::Plain, Self::Action];

    /// Its name in parameter files.
    pub fn name(self) -> &'static str {
        ["plain", "action"][self as usize]
    }

    /// The largest gain of a channel over green's that white balance sets; its reciprocal is the smallest.
    fn most_balance(self) -> f32 {
        match self {
            Self::Plain => f32::INFINITY,
            Self::Action => 3.0,
        }
    }

    /// Display values of balanced and exposed sensor light.
    pub(crate) fn display(self, light: Vec3) -> Vec3 {
        match self {
            Self::Plain => display(light),
            Self::Action => {
                let color = MATRIX * light.min(Vec3::ONE);
                let grey = Vec3::splat(color.dot(LUMINANCE));
                let color = (grey + SATURATION * (color - grey)).clamp(Vec3::ZERO, Vec3::ONE);
                let srgb = color.to_array().map(|x| {
                    if x <= 0.003_130_8 { 12.92 * x } else { 1.055 * math::powf(x, 1.0 / 2.4) - 0.055 }
                });
                let curve = |v: f32| v + CONTRAST * (v * v * (3.0 - 2.0 * v) - v);
                Vec3::from_array(srgb.map(curve))
            }
        }
    }
}

/// Converts the sensor's colours to sRGB, by columns; rows sum to 1, so that grey stays grey.
const MATRIX: Mat3 = Mat3::from_cols(
    Vec3::new(1.62, -0.18, 0.02),
    Vec3::new(-0.48, 1.50, -0.52),
    Vec3::new(-0.14, -0.32, 1.50),
);
/// Factor by which the distance of colours from grey is increased.
const SATURATION: f32 = 1.2;
/// Share of a smooth step in the curve of display values.
const CONTRAST: f32 = 0.35;

/// The settings of an automatic camera.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Automatic {
    /// Share of the grey-world balance, 0 to 1.
    pub(crate) white_balance: f32,
    /// Degree to which each view is set separately, 0 to 1.
    pub(crate) per_view: f32,
    /// The capture's seed.
    pub(crate) seed: u64,
    /// The development, which bounds the balance.
    pub(crate) development: Development,
}

/// Mean light of a view per channel, linear.
fn mean_light(scene: &MeshScene, camera: &Camera, look: &dyn RayColor) -> Vec3 {
    let rays = coarse_rays(camera);
    let sum: Vec3 = rays.iter().map(|ray| look.color(scene.look(ray, 0.05, Caustics::OFF), ray)).sum();
    sum / rays.len().max(1) as f32
}

/// The gains (red, green, blue) of every view; `look` returns the formation for each camera.
pub(crate) fn gains(
    scene: &MeshScene,
    cameras: &[Camera],
    look: &(dyn Fn(&Camera) -> Box<dyn RayColor> + Sync),
    automatic: Automatic,
) -> Vec<Vec3> {
    let metering = Stream::new(automatic.seed, Purpose::new("metering"), 0);
    let own: Vec<Vec3> = cameras
        .par_iter()
        .enumerate()
        .map(|(view, camera)| {
            let mean = mean_light(scene, camera, look(camera).as_ref()).max(Vec3::splat(1e-6));
            let grey = (mean.x + mean.y + mean.z) / 3.0;
            let balance = (grey / mean).to_array().map(|v| math::powf(v, automatic.white_balance));
            let most = automatic.development.most_balance();
            let balance = Vec3::from_array(balance.map(|v| v.clamp(balance[1] / most, balance[1] * most)));
            let slip = math::exp(0.06 * metering.normal(view as u64) as f32);
            (balance * (MIDDLE * slip / (balance * mean).dot(LUMINANCE))).min(Vec3::splat(HIGHEST_GAIN))
        })
        .collect();
    let log = |g: &Vec3| Vec3::new(math::ln(g.x), math::ln(g.y), math::ln(g.z));
    let mean = own.iter().map(log).sum::<Vec3>() / own.len().max(1) as f32;
    let a = automatic.per_view;
    own.iter()
        .map(|g| (a * log(g) + (1.0 - a) * mean).to_array().map(math::exp))
        .map(Vec3::from_array)
        .collect()
}

/// The median green gain of a capture, to which noise is relative.
pub(crate) fn middle_gain(gains: &[Vec3]) -> f32 {
    median(gains.iter().map(|g| g.y)).unwrap_or(1.0)
}

/// A camera's settings for one view.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Settings {
    /// Exposure times balance.
    pub(crate) gains: Vec3,
    /// The capture's middle green gain.
    pub(crate) middle: f32,
    /// Deviation of the photon noise.
    pub(crate) sigma: f32,
    /// The development from light to a picture.
    pub(crate) development: Development,
}

/// Converts linear light to display values in place: gains, photon noise, development. Noise is keyed by
/// (seed, view, pixel).
pub(crate) fn develop(image: &mut Image, settings: Settings, seed: u64, view: u64) {
    let Settings { gains, middle, sigma, development } = settings;
    let stream = Stream::new(seed, Purpose::new("photon noise"), view);
    let n = image.pixels();
    let block = 4096;
    for channel in 0..3 {
        let (gain, first) = (gains[channel], channel * n);
        image.plane_mut(channel).par_chunks_mut(block).enumerate().for_each(|(b, values)| {
            for (i, value) in values.iter_mut().enumerate() {
                let x = (gain * *value).max(0.0);
                let deviation = sigma * (gain / middle * (x + 0.004) / 0.222).sqrt();
                let noise = if sigma > 0.0 {
                    deviation * stream.normal((first + b * block + i) as u64) as f32
                } else {
                    0.0
                };
                *value = match development {
                    Development::Plain => display(Vec3::splat(x + noise)).x,
                    Development::Action => x + noise,
                };
            }
        });
    }
    if development == Development::Action {
        for y in 0..image.height() {
            for x in 0..image.width() {
                let light = Vec3::from_array(image.pixel(x, y));
                image.set_pixel(x, y, development.display(light).to_array());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_grows_with_gain_and_vanishes_without_sigma() {
        let deviation = |gain: f32, sigma: f32| {
            let mut image = Image::filled(64, 64, 0.2 / gain);
            let settings =
                Settings { gains: Vec3::splat(gain), middle: 1.0, sigma, development: Development::Plain };
            develop(&mut image, settings, 7, 3);
            let values: Vec<f64> = image.plane(1).iter().map(|v| f64::from(*v)).collect();
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            (values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / values.len() as f64).sqrt()
        };
        assert!(deviation(1.0, 0.0) < 1e-6);
        let (plain, amplified) = (deviation(1.0, 0.01), deviation(9.0, 0.01));
        assert!((0.007..0.013).contains(&plain), "{plain}");
        assert!((2.6..3.4).contains(&(amplified / plain)), "{amplified} against {plain}");
    }

    #[test]
    fn an_action_camera_keeps_grey_grey_and_clips_what_is_far_from_it() {
        let action = Development::Action;
        for v in [0.02, 0.18, 0.6] {
            let [r, g, b] = action.display(Vec3::splat(v)).to_array();
            assert!((r - g).abs() < 1e-5 && (b - g).abs() < 1e-5, "{v}: {r} {g} {b}");
        }
        // In blue water, red becomes negative and is clipped.
        assert_eq!(action.display(Vec3::new(0.01, 0.2, 0.4)).x, 0.0);
        assert!(action.display(Vec3::splat(3.0)).min_element() > 0.9999);
        // Darks are darker and brights brighter than without its curve.
        assert!(action.display(Vec3::splat(0.03)).y < display(Vec3::splat(0.03)).y);
        assert!(action.display(Vec3::splat(0.5)).y > display(Vec3::splat(0.5)).y);
    }
}
