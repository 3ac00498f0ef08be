//! The sea floor: a rippled sand channel between two reef walls, with a mound at its far end.

use glam::{Vec2, Vec3};
use use3d_numerics::math;

use super::draws::Draws;
use crate::geometry::mesh::Mesh;
use crate::geometry::noise::{Noise, smooth_step};

/// The shape of the sea floor. Coordinates in metres: x to the right, y ahead, z up.
#[derive(Clone, Debug)]
pub(crate) struct Terrain {
    noise: Noise,
    /// Half the width of the sand channel.
    channel: f32,
    /// Amplitude of the channel's meanders, and their phase.
    meander: [f32; 2],
    /// Height of the reef above the sand.
    reef: f32,
    /// The ripples on its sand.
    pub(crate) ripples: Ripples,
    /// True if the floor is that of a pool, at height 0 everywhere.
    flat: bool,
}

/// Sand ripples: sharp crests, wide troughs, a varying phase, fading in patches.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Ripples {
    noise: Noise,
    /// Height of a crest.
    height: f32,
    /// Direction across the ripples, times the wave number.
    wave: Vec3,
}

impl Ripples {
    /// Height at a point, and its gradient.
    pub(crate) fn at(&self, p: Vec3) -> (f32, Vec3) {
        let (wander, turn) = self.noise.octaves(p, 0.9, 2, 0.0);
        let phase = self.wave.dot(p) + 4.0 * wander;
        let (sin, cos) = math::sin_cos(0.5 * phase);
        let crest = 1.0 - sin.abs();
        let patch = self.height * smooth_step(-0.7, 0.1, self.noise.value(0.5 * p + Vec3::splat(31.0)));
        let slope = 2.0 * 2.2 * crest * (-0.5 * cos * sin.signum());
        (patch * (2.2 * crest * crest - 0.6), patch * slope * (self.wave + 4.0 * turn))
    }

    /// Ripples per metre.
    pub(crate) fn frequency(&self) -> f32 {
        self.wave.length() / std::f32::consts::TAU
    }
}

impl Terrain {
    pub(crate) fn new(seed: u64) -> Self {
        let mut draws = Draws::new(seed, "terrain", 0);
        let angle = draws.range(-0.5, 0.5) + 1.2;
        let noise = Noise::new(draws.bits());
        let wave = (draws.range(30.0, 40.0) * Vec2::from_angle(angle)).extend(0.0);
        Self {
            noise,
            channel: draws.range(0.8, 1.2),
            meander: [draws.range(0.3, 0.7), draws.range(0.0, std::f32::consts::TAU)],
            reef: draws.range(0.75, 1.15),
            ripples: Ripples { noise, height: draws.range(0.012, 0.018), wave },
            flat: false,
        }
    }

    /// A flat floor with a straight channel.
    pub(crate) fn flat(seed: u64) -> Self {
        Self { meander: [0.0; 2], flat: true, ..Self::new(seed) }
    }

    /// The x coordinate of the middle of the sand channel at `y`.
    pub(crate) fn channel_center(&self, y: f32) -> f32 {
        self.meander[0] * math::sin(0.42 * y + self.meander[1])
    }

    /// Height of the floor without ripples, and the share of reef: 0 on sand to 1 on reef.
    fn smooth(&self, x: f32, y: f32) -> (f32, f32) {
        let p = Vec3::new(x, y, 0.0);
        let broad = self.noise.value(0.11 * p + Vec3::splat(3.7));
        let outline = self.noise.octaves(p, 0.38, 3, 0.0).0;
        let off_center = (x - self.channel_center(y)).abs() + 0.75 * outline;
        let far_mound = Vec2::new(x - 1.0, (y - 15.5) * 0.8).length() + 0.9 * outline;
        let reef =
            smooth_step(self.channel, self.channel + 1.1, off_center).max(smooth_step(4.2, 2.6, far_mound));
        let ruggedness = self.noise.octaves(p + Vec3::splat(9.1), 0.9, 5, 0.0).0;
        let knobs = self.noise.octaves(p + Vec3::splat(4.4), 5.0, 2, 0.0).0;
        let rise = self.reef * (0.75 + 0.5 * broad) + 0.34 * ruggedness + 0.05 * knobs;
        // The reef's shoulders rise further, so that distant ground is visible against the water.
        let shoulder = 0.10 * (off_center - self.channel - 1.0).clamp(0.0, 9.0);
        let height = 0.22 * broad + reef * (rise + shoulder);
        (height, reef)
    }

    /// Height of the floor, and the share of reef: 0 on sand to 1 on reef.
    pub(crate) fn at(&self, x: f32, y: f32) -> (f32, f32) {
        if self.flat {
            return (0.0, 0.0);
        }
        let (height, reef) = self.smooth(x, y);
        (height + (1.0 - reef) * self.ripples.at(Vec3::new(x, y, 0.0)).0, reef)
    }

    /// Height of the floor only.
    pub(crate) fn height(&self, x: f32, y: f32) -> f32 {
        self.at(x, y).0
    }

    /// Adds the floor to a mesh: fine in the region of the swim (`spacing` metres), and coarser towards the
    /// distance, where water hides it.
    pub(crate) fn add_to(&self, mesh: &mut Mesh, spacing: f32, surface: u16) {
        let xs = graded(-4.5, 4.5, -45.0, 45.0, spacing);
        let ys = graded(-1.5, 11.0, -9.0, 60.0, spacing);
        let shape = |x: f32, y: f32| {
            let (height, reef) = self.at(x, y);
            (height, Vec2::new(reef, 0.0))
        };
        mesh.height_field(&xs, &ys, surface, shape, |x, y| self.smooth(x, y).0);
    }
}

/// Coordinates from `start` to `end`: `spacing` apart between `low` and `high`, with growing distances
/// outside.
fn graded(low: f32, high: f32, start: f32, end: f32, spacing: f32) -> Vec<f32> {
    let n = ((high - low) / spacing).round().max(1.0) as usize;
    let step = (high - low) / n as f32;
    let mut xs: Vec<f32> = (0..=n).map(|i| low + step * i as f32).collect();
    let outwards = |from: f32, to: f32| {
        let sign = (to - from).signum();
        let (mut list, mut x, mut d) = (Vec::new(), from, step);
        while (to - x) * sign > 0.0 {
            d *= 1.06;
            x += sign * d;
            list.push(x);
        }
        list
    };
    let mut before = outwards(low, start);
    before.reverse();
    before.append(&mut xs);
    before.extend(outwards(high, end));
    before
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sand_in_the_middle_reef_at_the_sides() {
        for seed in 0..4 {
            let terrain = Terrain::new(seed);
            for i in 0..20 {
                let y = 0.4 * i as f32;
                let center = terrain.channel_center(y);
                let reef = |x: f32| terrain.at(center + x, y).1;
                assert!(reef(0.0) < 0.6, "seed {seed}, y {y}");
                assert!(reef(4.5) > 0.5 && reef(-4.5) > 0.5, "seed {seed}, y {y}");
            }
        }
        let xs = graded(-1.0, 1.0, -5.0, 6.0, 0.1);
        assert!(xs.windows(2).all(|w| w[0] < w[1]) && xs[0] <= -5.0 && xs[xs.len() - 1] >= 6.0);
    }
}
