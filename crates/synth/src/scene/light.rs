//! Daylight under water: a soft sun from above, light from the whole upper half space, and a little light
//! reflected by the sand.
//!
//! Linear light per unit albedo at a point with normal n, sun direction l, openness a (0 enclosed to 1 free)
//! and sun visibility v:
//!
//! `E = v max(n·l, 0) E_sun + a (1 + n_z)/2 E_sky + a (1 - n_z)/2 E_sand`
//!
//! Openness and visibility are computed at vertices by casting rays, and are interpolated.
//! Approximations: no light is reflected from one object to another except by the sand, and no light is
//! absorbed on its way along the sea floor.

use std::sync::OnceLock;

use glam::{Vec2, Vec3};
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

/// Openness and sun visibility of vertices. Each is computed when a ray first asks for it, because the
/// cameras of a capture see only a part of the scene. The value does not depend on the order of questions.
pub(crate) struct VertexLight {
    found: Vec<OnceLock<Vec2>>,
    /// The direction of the sun, and two directions across it.
    sun: [Vec3; 3],
    turn: Stream,
}

impl VertexLight {
    pub(crate) fn new(vertices: usize, sun: Vec3, seed: u64) -> Self {
        let (x, y) = sun.any_orthonormal_pair();
        let turn = Stream::new(seed, Purpose::new("light rays"), 0);
        Self { found: vec![OnceLock::new(); vertices], sun: [sun, x, y], turn }
    }

    /// Openness and sun visibility of the vertex with this index.
    pub(crate) fn of(&self, vertex: usize, mesh: &Mesh, bvh: &Bvh) -> Vec2 {
        *self.found[vertex]
            .get_or_init(|| self.cast(vertex, mesh.positions[vertex], mesh.normals[vertex], bvh))
    }

    fn cast(&self, vertex: usize, position: Vec3, normal: Vec3, bvh: &Bvh) -> Vec2 {
        let origin = position + 0.004 * normal;
        let start = self.turn.uniform(vertex as u64) as f32 * std::f32::consts::TAU;
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
        let [sun, sun_x, sun_y] = self.sun;
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
    }
}

/// The pattern of light focused by waves on the floor: bright curved lines, 1 on average; `time` in seconds.
pub(crate) fn caustics(noise: Noise, p: Vec3, time: f32) -> f32 {
    let q = Vec3::new(1.7 * p.x, 1.7 * p.y, 0.35 * time + 0.3 * p.z);
    let bend = noise.value(0.7 * q);
    let a = 1.0 - noise.value(q + Vec3::splat(0.8 * bend)).abs() * 2.4;
    let b = 1.0 - noise.value(1.4 * q + Vec3::splat(7.0 - 0.8 * bend)).abs() * 2.4;
    (math::powi(a.max(0.0), 3) + math::powi(b.max(0.0), 3)) * 1.15 - 0.5
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A floor with a wall on it: vertices at its foot are shaded, and those far from it are free.
    fn scene() -> (Mesh, Bvh) {
        let steps: Vec<f32> = (0..40).map(|i| 0.1 * i as f32).collect();
        let mut mesh = Mesh::default();
        let wall = |x: f32| if (x - 2.0).abs() < 0.25 { 1.5 } else { 0.0 };
        mesh.height_field(&steps, &steps, 0, |x, _| (wall(x), Vec2::ZERO), |_, _| 0.0);
        let bvh = Bvh::build(&mesh.positions, &mesh.triangles);
        (mesh, bvh)
    }

    #[test]
    fn the_light_of_a_vertex_does_not_depend_on_the_order_of_the_questions() {
        let (mesh, bvh) = scene();
        let count = mesh.positions.len();
        let sun = Vec3::new(0.6, 0.2, 1.0).normalize();
        let [forwards, backwards] = [0, 1].map(|_| VertexLight::new(count, sun, 7));
        let first: Vec<Vec2> = (0..count).map(|i| forwards.of(i, &mesh, &bvh)).collect();
        let mut second: Vec<Vec2> = (0..count).rev().map(|i| backwards.of(i, &mesh, &bvh)).collect();
        second.reverse();
        assert_eq!(first, second);
        assert_eq!(first[3], forwards.of(3, &mesh, &bvh), "a second answer is the first one");
        let least = first.iter().fold(Vec2::ONE, |least, free| least.min(*free));
        let most = first.iter().fold(Vec2::ZERO, |most, free| most.max(*free));
        assert!(least.x < 0.7 && least.y < 0.3, "the wall shades: {least}");
        assert!(most.x > 0.95 && most.y == 1.0, "the rest is free: {most}");
    }
}
