//! Depth priors like those of a monocular network, made from the true depth.

use glam::Vec3;
use use3d_capture::Map;
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};

use crate::geometry::noise::Noise;
use crate::scene::Draws;

/// A prior like that of a monocular network: disparity up to an unknown scale and a power, with a slowly
/// varying error and a little noise.
pub(crate) fn depth_prior(depth: &Map, seed: u64, view: usize) -> Map {
    let nearest = depth.data().iter().filter(|&&z| z > 0.0).fold(f32::INFINITY, |m, &z| m.min(z));
    let mut draws = Draws::new(seed, "depth prior", view as u64);
    let (power, gain) = (draws.range(0.75, 0.95), draws.range(0.8, 0.92));
    let wobble = Noise::new(draws.bits());
    let grain = Stream::new(seed, Purpose::new("depth prior grain"), view as u64);
    let (w, h) = (depth.width(), depth.height());
    let mut prior = Map::new(w, h);
    for (p, (out, &z)) in prior.data_mut().iter_mut().zip(depth.data()).enumerate() {
        if z > 0.0 {
            let at = Vec3::new(3.0 * (p % w) as f32 / w as f32, 3.0 * (p / w) as f32 / w as f32, 0.5);
            let error = 1.0 + 0.04 * wobble.value(at) + 0.004 * grain.normal(p as u64) as f32;
            *out = (0.03 + gain * math::powf(nearest / z, power) * error).clamp(1.0 / 65535.0, 1.0);
        }
    }
    prior
}
