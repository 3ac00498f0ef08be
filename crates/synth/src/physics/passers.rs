//! Objects between camera and scene: fish, which a mask hides, and marine snow, which no mask hides.
//!
//! Both are drawn over the finished linear picture, at a different position and distance in every view. They
//! are hidden by nearer surfaces, and their light is attenuated by the water. A fish is an ellipse with a
//! tail; a particle is a soft disc, larger if it is near and out of focus.

use glam::{Vec2, Vec3};
use use3d_capture::{Camera, Image, Map};
use use3d_numerics::math;
use use3d_survey::Lens;

use super::spectral::Spectral;
use crate::render::Rays;
use crate::scene::Draws;

/// Number of particles in a view with `snow = 1`.
const PARTICLES: f32 = 160.0;
/// Margin of the masks around a fish, pixels.
const MARGIN: f32 = 1.5;

/// A view to paint on.
pub(crate) struct Canvas<'a> {
    /// Linear light.
    pub(crate) image: &'a mut Image,
    /// z-depth, metres; 0 is open water.
    pub(crate) depth: &'a Map,
    pub(crate) camera: &'a Camera,
    /// The lens, if it is no pinhole.
    pub(crate) lens: Option<&'a Lens>,
    pub(crate) water: &'a Spectral,
}

impl Canvas<'_> {
    /// Paints pixels around `centre` (pixels): `cover` gives a pixel's share from its offset, 0 to 1.
    fn paint(&mut self, centre: Vec2, reach: f32, z: f32, albedo: Vec3, cover: &dyn Fn(Vec2) -> f32) {
        let (w, h) = (self.image.width(), self.image.height());
        let rays = Rays::new(self.camera, self.lens);
        for y in span(centre.y, reach, h) {
            for x in span(centre.x, reach, w) {
                let hidden = self.depth.pixel(x, y)[0];
                if hidden > 0.0 && hidden < z {
                    continue;
                }
                let at = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
                let share = cover(at - centre);
                if share <= 0.0 {
                    continue;
                }
                let ray = rays.through(at.x, at.y);
                let per_t = ray.direction.length();
                let light = self.water.light(Some(albedo), ray.origin, ray.direction / per_t, z * per_t);
                let behind = Vec3::from_array(self.image.pixel(x, y));
                self.image.set_pixel(x, y, behind.lerp(light, share).to_array());
            }
        }
    }
}

/// Paints soft discs near the camera: `amount` 0 to 1.
pub(crate) fn snow(canvas: &mut Canvas<'_>, amount: f32, seed: u64, view: usize) {
    let mut draws = Draws::new(seed, "marine snow", view as u64);
    let size = Vec2::new(canvas.image.width() as f32, canvas.image.height() as f32);
    for _ in 0..(amount * PARTICLES) as usize {
        // Uniform over the visible volume up to 2.4 m: most particles are far and small.
        let z = 2.4 * math::cbrt(draws.range(0.0, 1.0)) + 0.12;
        let centre = Vec2::new(draws.range(0.0, size.x), draws.range(0.0, size.y));
        // Half a millimetre, plus the blur out of focus.
        let radius = size.x * (0.000_6 + 0.000_9 / z);
        let strength = draws.range(0.25, 0.8);
        let tone = draws.range(0.5, 1.0);
        let cover = |d: Vec2| strength * (1.0 - d.length_squared() / (radius * radius)).max(0.0);
        canvas.paint(centre, radius, z, Vec3::splat(tone), &cover);
    }
}

/// Paints `count` fish, at a different place in every view; the mask is 0 on them, 1 elsewhere.
pub(crate) fn fish(canvas: &mut Canvas<'_>, count: usize, seed: u64, view: usize) -> Map {
    let (w, h) = (canvas.image.width(), canvas.image.height());
    let mut mask = Map::filled(w, h, 1.0);
    for number in 0..count {
        let mut draws = Draws::new(seed, "fish", (view as u64) << 16 | number as u64);
        let z = draws.range(1.0, 3.4);
        let length = draws.range(0.10, 0.30) * canvas.camera.intrinsics.fx as f32 / z;
        let centre = Vec2::new(draws.range(0.0, w as f32), draws.range(0.1, 0.8) * h as f32);
        let sin = draws.about(0.35);
        let cos = (1.0 - sin * sin).sqrt();
        let side = if draws.below(2) == 0 { 1.0 } else { -1.0 };
        let albedo = [Vec3::new(0.75, 0.78, 0.80), Vec3::new(0.85, 0.70, 0.10), Vec3::new(0.10, 0.18, 0.45)]
            [draws.below(3)];
        let half = Vec2::new(0.5 * length, 0.19 * length);
        let inside = move |d: Vec2| {
            let p = Vec2::new(side * (cos * d.x + sin * d.y), cos * d.y - sin * d.x);
            let body = (p / half).length_squared() < 1.0;
            let behind = (-p.x - 0.85 * half.x) / (0.5 * half.x);
            body || ((0.0..1.0).contains(&behind) && p.y.abs() < 0.7 * half.y * (0.2 + behind))
        };
        let reach = 0.8 * length + MARGIN + 1.0;
        // The margin comes first: it belongs only to the mask.
        let near = [Vec2::X, Vec2::Y, Vec2::NEG_X, Vec2::NEG_Y];
        let margin = |d: Vec2| near.iter().any(|n| inside(d + MARGIN * *n)) || inside(d);
        hide(&mut mask, centre, reach, &margin);
        let cover = |d: Vec2| if inside(d) { 1.0 } else { 0.0 };
        canvas.paint(centre, reach, z, 0.9 * albedo, &cover);
    }
    mask
}

/// The pixels within `reach` of a coordinate, out of `n`.
fn span(centre: f32, reach: f32, n: usize) -> std::ops::Range<usize> {
    let within = |v: f32| v.clamp(0.0, n as f32) as usize;
    within((centre - reach).floor())..within((centre + reach).ceil())
}

fn hide(mask: &mut Map, centre: Vec2, reach: f32, inside: &dyn Fn(Vec2) -> bool) {
    for y in span(centre.y, reach, mask.height()) {
        for x in span(centre.x, reach, mask.width()) {
            if inside(Vec2::new(x as f32 + 0.5, y as f32 + 0.5) - centre) {
                mask.set_pixel(x, y, [0.0]);
            }
        }
    }
}
