//! Daylight under water: a soft sun from above, light from the whole upper half space, and a little light
//! reflected by the sand.
//!
//! Linear light per unit albedo at a point with normal n, sun direction l, openness a (0 enclosed to 1 free)
//! and sun visibility v:
//!
//! `E = v max(n·l, 0) E_sun + a (1 + n_z)/2 E_sky + a (1 - n_z)/2 E_sand`
//!
//! Openness and visibility are computed once per vertex by casting rays, and are interpolated.
//! Approximations: no light is reflected from one object to another except by the sand, and no light is
//! absorbed on its way along the sea floor.

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};

use crate::geometry::bvh::{Bvh, Ray};
use crate::geometry::mesh::Mesh;
use crate::geometry::noise::Noise;

/// The light of a scene (linear, neutral; the water's tint is applied later).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Daylight {
    /// Unit vector towards the sun.
    pub(crate) sun: Vec3,
    /// Strength of the sun, of the upper half space, and of the light from the sand.
    pub(crate) strength: [Vec3; 3],
}

impl Daylight {
    /// Light per unit albedo; `sunlight` scales the sun (shadow, caustics).
    pub(crate) fn at(&self, normal: Vec3, openness: f32, sunlight: f32) -> Vec3 {
        let [sun, sky, sand] = self.strength;
        sun * (sunlight * normal.dot(self.sun).max(0.0))
            + openness * (sky * (0.5 + 0.5 * normal.z) + sand * (0.5 - 0.5 * normal.z))
    }
}

const SKY_RAYS: usize = 9;
const SUN_RAYS: usize = 4;
/// Objects beyond this distance do not shade the sky, metres.
const REACH: f32 = 0.9;

/// Openness and sun visibility of every vertex.
pub(crate) fn bake(mesh: &Mesh, bvh: &Bvh, sun: Vec3, seed: u64) -> Vec<Vec2> {
    let turn = Stream::new(seed, Purpose::new("light rays"), 0);
    let (sun_x, sun_y) = sun.any_orthonormal_pair();
    mesh.positions
        .par_iter()
        .zip(&mesh.normals)
        .enumerate()
        .map(|(i, (&position, &normal))| {
            let origin = position + 0.004 * normal;
            let start = turn.uniform(i as u64) as f32 * std::f32::consts::TAU;
            let (x, y) = normal.any_orthonormal_pair();
            let mut blocked = 0.0;
            for k in 0..SKY_RAYS {
                // Cosine-weighted directions on a golden-angle spiral.
                let r2 = (k as f32 + 0.5) / SKY_RAYS as f32;
                let (sin, cos) = math::sin_cos(start + 2.399_963 * k as f32);
                let direction = r2.sqrt() * (cos * x + sin * y) + (1.0 - r2).sqrt() * normal;
                if let Some(hit) = bvh.nearest(&Ray { origin, direction }, REACH) {
                    blocked += 1.0 - hit.t / REACH;
                }
            }
            let openness = (1.0 - 1.15 * blocked / SKY_RAYS as f32).clamp(0.05, 1.0);
            let mut lit = 0;
            if normal.dot(sun) > 0.0 {
                for k in 0..SUN_RAYS {
                    // The sun's disc is widened to about ten degrees by the waves above.
                    let r = 0.16 * ((k as f32 + 0.5) / SUN_RAYS as f32).sqrt();
                    let (sin, cos) = math::sin_cos(start + 2.399_963 * k as f32);
                    let direction = (sun + r * (cos * sun_x + sin * sun_y)).normalize();
                    lit += usize::from(bvh.any(&Ray { origin, direction }, 8.0).is_none());
                }
            }
            Vec2::new(openness, lit as f32 / SUN_RAYS as f32)
        })
        .collect()
}

/// The pattern of light focused by waves on the floor: bright curved lines, 1 on average; `time` in seconds.
pub(crate) fn caustics(noise: Noise, p: Vec3, time: f32) -> f32 {
    let q = Vec3::new(1.7 * p.x, 1.7 * p.y, 0.35 * time + 0.3 * p.z);
    let bend = noise.value(0.7 * q);
    let a = 1.0 - noise.value(q + Vec3::splat(0.8 * bend)).abs() * 2.4;
    let b = 1.0 - noise.value(1.4 * q + Vec3::splat(7.0 - 0.8 * bend)).abs() * 2.4;
    (math::powi(a.max(0.0), 3) + math::powi(b.max(0.0), 3)) * 1.15 - 0.5
}
