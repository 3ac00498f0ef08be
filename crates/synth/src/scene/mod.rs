//! The scene: a reef or a tiled pool with the objects on it, as triangles with procedural textures under soft
//! daylight.
//!
//! Nothing here is a Gaussian: the scene is opaque geometry, rendered by casting rays. Coordinates are
//! metres, x to the right of the swim, y ahead, z up.

mod artefacts;
mod draws;
mod layout;
mod light;
mod organisms;
mod pool;
mod surface;
mod terrain;

use glam::{Vec2, Vec3};
use use3d_numerics::math;

pub(crate) use draws::Draws;
pub(crate) use layout::Layout;
pub use layout::Location;
use surface::Surface;
pub(crate) use surface::{display, linear};
pub(crate) use terrain::Terrain;

use crate::geometry::bvh::{Bvh, Ray};
use crate::geometry::mesh::Mesh;
use crate::geometry::noise::Noise;
use light::{Daylight, VertexLight};

/// A scene that is ready to be rendered.
pub(crate) struct MeshScene {
    pub(crate) mesh: Mesh,
    surfaces: Vec<Surface>,
    bvh: Bvh,
    light: VertexLight,
    daylight: Daylight,
    noise: Noise,
    /// The sea floor's shape, for the path of the swimmer.
    pub(crate) terrain: Terrain,
}

/// The surface point that a ray hits.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SurfaceHit {
    /// Position along the ray, in lengths of its direction.
    pub(crate) t: f32,
    /// Light towards the camera, linear, under neutral daylight of unit exposure.
    pub(crate) light: Vec3,
    /// Surface index, to distinguish objects.
    pub(crate) surface: u16,
}

/// Caustics: their strength (0 is off) and time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Caustics {
    pub(crate) strength: f32,
    pub(crate) time: f32,
}

impl Caustics {
    pub(crate) const OFF: Self = Self { strength: 0.0, time: 0.0 };
}

/// Surfaces beyond this distance are ignored, metres: no water is clear enough to show them.
const FAR: f32 = 70.0;

impl MeshScene {
    /// Builds the scene.
    pub(crate) fn new(layout: &Layout) -> Self {
        let (mesh, palette, terrain) = match layout.place {
            Location::Reef => layout::build(layout),
            Location::Pool => pool::build(layout.seed, pool::blue()),
            Location::VeilPool => pool::build(layout.seed, layout.veil),
        };
        let bvh = Bvh::build(&mesh.positions, &mesh.triangles);
        let mut draws = Draws::new(layout.seed, "daylight", 0);
        let azimuth = draws.range(0.0, std::f32::consts::TAU);
        // Refraction brings the sun to within 48 degrees of the vertical.
        let lean = draws.range(0.55, 0.85);
        let sun = Vec3::new(lean * math::cos(azimuth), lean * math::sin(azimuth), 1.0).normalize();
        let daylight = Daylight {
            sun,
            strength: [Vec3::new(1.1, 1.06, 0.99), Vec3::new(0.40, 0.43, 0.46), Vec3::new(0.20, 0.19, 0.16)],
        };
        let light = VertexLight::new(mesh.positions.len(), sun, layout.seed);
        let noise = Noise::new(draws.bits());
        Self { mesh, surfaces: palette.surfaces, bvh, light, daylight, noise, terrain }
    }

    /// Unit vector towards the sun.
    pub(crate) fn sun(&self) -> Vec3 {
        self.daylight.sun
    }

    /// Casts a ray; `spread` is the width of a pixel at unit `t`, metres. `None` is open water.
    pub(crate) fn look(&self, ray: &Ray, spread: f32, caustics: Caustics) -> Option<SurfaceHit> {
        let hit = self.bvh.nearest(ray, FAR)?;
        let triangle = hit.triangle as usize;
        let corners = self.mesh.triangles[triangle].map(|i| i as usize);
        let weights = [1.0 - hit.u - hit.v, hit.u, hit.v];
        let (mut normal, mut parameter, mut free) = (Vec3::ZERO, Vec2::ZERO, Vec2::ZERO);
        for (i, w) in corners.into_iter().zip(weights) {
            normal += w * self.mesh.normals[i];
            parameter += w * self.mesh.parameters[i];
            free += w * self.light.of(i, &self.mesh, &self.bvh);
        }
        let normal = normal.normalize_or(Vec3::Z);
        let point = ray.origin + hit.t * ray.direction;
        let surface = self.mesh.surfaces[triangle];
        let (albedo, bump) =
            self.surfaces[surface as usize].look(self.noise, point, parameter, spread * hit.t);
        let tilted = (normal - (bump - bump.dot(normal) * normal)).normalize_or(normal);
        let mut sunlight = free.y;
        if caustics.strength > 0.0 {
            sunlight *=
                (1.0 + caustics.strength * light::caustics(self.noise, point, caustics.time)).max(0.0);
        }
        let mut light = self.daylight.at(tilted, free.x, sunlight);
        if self.is_grey(surface) {
            // A board of greys is lit by neutral light, whatever tint the daylight has.
            light = Vec3::splat(light.dot(Vec3::splat(1.0 / 3.0)));
        }
        Some(SurfaceHit { t: hit.t, light: albedo * light, surface })
    }

    /// True if a surface is a patch of a board of greys.
    pub(crate) fn is_grey(&self, surface: u16) -> bool {
        matches!(self.surfaces.get(usize::from(surface)), Some(Surface::Grey { .. }))
    }

    /// Distance to the nearest surface along a ray, in lengths of its direction.
    pub(crate) fn distance(&self, ray: &Ray) -> Option<f32> {
        self.bvh.nearest(ray, FAR).map(|hit| hit.t)
    }
}
