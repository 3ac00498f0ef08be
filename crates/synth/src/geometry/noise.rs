//! Seeded lattice noise with derivatives, limited to the wavelengths that a pixel can resolve.
//!
//! Gradient noise (Perlin's construction with a quintic blend) in three dimensions: every integer point has a
//! pseudo-random gradient, and the gradients of the eight corners of a cell are blended. The value range is
//! about `[-1, 1]`. The derivative is exact, so bumps need no finite differences. Octaves whose wavelength is
//! below twice the `footprint` (the size of a pixel on the surface, metres) fade out, so that textures do not
//! alias at any distance.

use glam::{IVec3, Vec3};

/// A noise field; two seeds give unrelated fields.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Noise {
    seed: u32,
}

/// The edges of a cube as gradient directions; four appear twice so that a 4-bit index selects one.
const GRADIENTS: [[f32; 3]; 16] = [
    [1.0, 1.0, 0.0],
    [-1.0, 1.0, 0.0],
    [1.0, -1.0, 0.0],
    [-1.0, -1.0, 0.0],
    [1.0, 0.0, 1.0],
    [-1.0, 0.0, 1.0],
    [1.0, 0.0, -1.0],
    [-1.0, 0.0, -1.0],
    [0.0, 1.0, 1.0],
    [0.0, -1.0, 1.0],
    [0.0, 1.0, -1.0],
    [0.0, -1.0, -1.0],
    [1.0, 1.0, 0.0],
    [-1.0, 1.0, 0.0],
    [0.0, -1.0, 1.0],
    [0.0, -1.0, -1.0],
];

const CORNER_X: [f32; 8] = [0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0];
const CORNER_Y: [f32; 8] = [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0];
const CORNER_Z: [f32; 8] = [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0];

/// The sum of eight values in a tree, in the order in which SIMD lanes are added.
#[inline]
fn sum8(v: &[f32; 8]) -> f32 {
    let four = [v[0] + v[4], v[1] + v[5], v[2] + v[6], v[3] + v[7]];
    (four[0] + four[2]) + (four[1] + four[3])
}

/// The largest integer vector not above `p` (coordinates are far below 2^31).
#[inline]
fn floor(p: Vec3) -> IVec3 {
    let cut = p.as_ivec3();
    let down = |cut: i32, p: f32| cut - i32::from(cut as f32 > p);
    IVec3::new(down(cut.x, p.x), down(cut.y, p.y), down(cut.z, p.z))
}

impl Noise {
    pub(crate) const fn new(seed: u32) -> Self {
        Self { seed }
    }

    /// 32 well-mixed bits for a lattice point.
    #[inline]
    fn hash(&self, p: IVec3) -> u32 {
        let mut h = self.seed
            ^ (p.x as u32).wrapping_mul(0x8da6_b343)
            ^ (p.y as u32).wrapping_mul(0xd816_3841)
            ^ (p.z as u32).wrapping_mul(0xcb1a_b31f);
        h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
        h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
        h ^ (h >> 15)
    }

    /// Value and gradient at `p`.
    #[inline]
    pub(crate) fn with_gradient(&self, p: Vec3) -> (f32, Vec3) {
        let cell = floor(p);
        let f = p - cell.as_vec3();
        let blend = f * f * f * (f * (f * 6.0 - 15.0) + 10.0);
        let slope = 30.0 * f * f * (f * (f - 2.0) + 1.0);
        // Corner k is at offset (k & 1, k >> 1 & 1, k >> 2); arrays of eight so that SIMD lanes correspond to
        // corners.
        let (mut gx, mut gy, mut gz) = ([0.0f32; 8], [0.0f32; 8], [0.0f32; 8]);
        for k in 0..8 {
            let corner = IVec3::new(k & 1, (k >> 1) & 1, k >> 2);
            let g = &GRADIENTS[(self.hash(cell + corner) & 15) as usize];
            (gx[k as usize], gy[k as usize], gz[k as usize]) = (g[0], g[1], g[2]);
        }
        let (x, y, z) = (CORNER_X, CORNER_Y, CORNER_Z);
        let (mut value, mut gradient) = ([0.0f32; 8], [[0.0f32; 8]; 3]);
        for k in 0..8 {
            let dot = gx[k] * (f.x - x[k]) + gy[k] * (f.y - y[k]) + gz[k] * (f.z - z[k]);
            // 1 - b at the corner's low side, b at its high side; the derivative is -s or +s.
            let wx = 1.0 - x[k] + (2.0 * x[k] - 1.0) * blend.x;
            let wy = 1.0 - y[k] + (2.0 * y[k] - 1.0) * blend.y;
            let wz = 1.0 - z[k] + (2.0 * z[k] - 1.0) * blend.z;
            let weight = wx * wy * wz;
            value[k] = weight * dot;
            gradient[0][k] = weight * gx[k] + dot * (2.0 * x[k] - 1.0) * slope.x * wy * wz;
            gradient[1][k] = weight * gy[k] + dot * (2.0 * y[k] - 1.0) * slope.y * wx * wz;
            gradient[2][k] = weight * gz[k] + dot * (2.0 * z[k] - 1.0) * slope.z * wx * wy;
        }
        (sum8(&value), Vec3::new(sum8(&gradient[0]), sum8(&gradient[1]), sum8(&gradient[2])))
    }

    /// Value at `p`.
    #[inline]
    pub(crate) fn value(&self, p: Vec3) -> f32 {
        self.with_gradient(p).0
    }

    /// Sum of octaves of halving amplitude and (a little more than) doubling frequency, with gradient.
    pub(crate) fn octaves(&self, p: Vec3, frequency: f32, count: u32, footprint: f32) -> (f32, Vec3) {
        let (mut value, mut gradient, mut amplitude, mut f) = (0.0, Vec3::ZERO, 1.0, frequency);
        for octave in 0..count {
            let keep = resolvable(f, footprint);
            if keep <= 0.0 {
                break;
            }
            // Each octave is shifted so that lattice points do not coincide.
            let (v, g) = self.with_gradient(p * f + Vec3::splat(17.3 * octave as f32));
            value += keep * amplitude * v;
            gradient += keep * amplitude * f * g;
            amplitude *= 0.5;
            f *= 2.07;
        }
        (value, gradient)
    }
}

/// The share of a pattern of `frequency` (cycles per metre) that remains in a pixel of size `footprint`
/// (metres): 1 above three pixels per cycle, 0 below one and a half.
#[inline]
pub(crate) fn resolvable(frequency: f32, footprint: f32) -> f32 {
    smooth_step(0.66, 0.33, frequency * footprint)
}

/// 0 at `a`, 1 at `b` (which may be smaller than `a`), with zero slopes at both.
#[inline]
pub(crate) fn smooth_step(a: f32, b: f32, x: f32) -> f32 {
    let t = ((x - a) / (b - a)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_gradient_is_the_derivative() {
        let noise = Noise::new(7);
        for i in 0..200 {
            let p = Vec3::new(0.37 * i as f32, -0.21 * i as f32, 0.11 * i as f32 + 0.5);
            let (_, gradient) = noise.with_gradient(p);
            for (axis, unit) in [Vec3::X, Vec3::Y, Vec3::Z].into_iter().enumerate() {
                let h = 1e-2;
                let difference = (noise.value(p + h * unit) - noise.value(p - h * unit)) / (2.0 * h);
                assert!((gradient[axis] - difference).abs() < 5e-3, "{gradient} {difference}");
            }
        }
    }

    #[test]
    fn seeds_differ_and_unresolvable_octaves_vanish() {
        let p = Vec3::new(1.3, 2.7, 0.4);
        assert_ne!(Noise::new(1).value(p), Noise::new(2).value(p));
        assert_eq!(Noise::new(1).octaves(p, 10.0, 4, 1.0).0, 0.0);
    }
}
