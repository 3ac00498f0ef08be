//! Renders a camera's view: anti-aliased colours under several conditions at once, and depth.
//!
//! One ray is cast through every pixel's centre. Pixels at the edge of a surface (a neighbour shows another
//! surface, or another depth) get further rays spread over their area, and the colours are averaged. Textures
//! are limited to the resolution of a pixel and need no more rays. The lens then blurs by about a pixel.
//! Depth is that of the centre ray, never an average.

use glam::Vec3;
use rayon::prelude::*;
use use3d_capture::{Camera, Image, Map};
use use3d_numerics::random::{Purpose, Stream};
use use3d_survey::Lens;

use crate::geometry::bvh::Ray;
use crate::scene::{Caustics, MeshScene, SurfaceHit, display};
use crate::water::Water;

/// Light and water under which the scene is photographed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Condition {
    /// Exposure times the colour of daylight, linear.
    pub(crate) light: Vec3,
    /// The water in front of the camera; without water, open water is black.
    pub(crate) water: Option<Water>,
}

/// The colour of a ray's end in a picture.
pub(crate) trait RayColor: Sync {
    /// The colour of the surface that `ray` hits (`None` is open water), in display values or linear light,
    /// depending on the implementation.
    fn color(&self, seen: Option<SurfaceHit>, ray: &Ray) -> Vec3;
}

impl RayColor for Condition {
    /// Returns display values.
    fn color(&self, seen: Option<SurfaceHit>, ray: &Ray) -> Vec3 {
        let per_t = ray.direction.length();
        let clean = seen.map_or(Vec3::ZERO, |s| display(s.light * self.light));
        let distance = seen.map_or(f32::INFINITY, |s| s.t * per_t);
        self.water.map_or(clean, |water| {
            Vec3::from_array(water.seen_through(clean.to_array(), distance, ray.direction / per_t))
        })
    }
}

/// A view: one image per condition, and z-depth in metres (0 is open water).
pub(crate) struct Shot {
    pub(crate) images: Vec<Image>,
    pub(crate) depth: Map,
    /// The surface of every pixel's centre; `u16::MAX` is open water.
    pub(crate) surfaces: Vec<u16>,
}

/// Number of further rays of a pixel that needs them.
const EXTRA: usize = 6;

/// A camera's rays in the scene's frame: `direction(u, v)` has unit depth, so that `t` is z-depth.
pub(crate) struct Rays {
    origin: Vec3,
    columns: [Vec3; 3],
    lens: [f32; 4],
    bent: Option<Lens>,
}

impl Rays {
    /// The rays of a pinhole, or of the lens in front of it.
    pub(crate) fn new(camera: &Camera, lens: Option<&Lens>) -> Self {
        let back = camera.pose.rotation.transpose();
        let k = &camera.intrinsics;
        Self {
            origin: camera.pose.center().as_vec3(),
            columns: [back.x_axis.as_vec3(), back.y_axis.as_vec3(), back.z_axis.as_vec3()],
            lens: [k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32],
            bent: lens.copied(),
        }
    }

    pub(crate) fn through(&self, u: f32, v: f32) -> Ray {
        let [fx, fy, cx, cy] = self.lens;
        let straight = ((u - cx) / fx, (v - cy) / fy);
        let (x, y) = self.bent.map_or(straight, |lens| {
            // The lenses of this crate have a ray for every pixel.
            let ray = lens.unproject(f64::from(u), f64::from(v));
            ray.map_or(straight, |(x, y)| (x as f32, y as f32))
        });
        let direction = x * self.columns[0] + y * self.columns[1] + self.columns[2];
        Ray { origin: self.origin, direction }
    }
}

/// Renders a camera's view under every condition.
pub(crate) fn render(
    scene: &MeshScene,
    camera: &Camera,
    lens: Option<&Lens>,
    conditions: &[&dyn RayColor],
    caustics: Caustics,
) -> Shot {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let rays = Rays::new(camera, lens);
    let spread = 1.0 / rays.lens[0];
    let colors = |u: f32, v: f32, out: &mut [Vec3]| {
        let ray = rays.through(u, v);
        let seen = scene.look(&ray, spread, caustics);
        for (color, condition) in out.iter_mut().zip(conditions) {
            *color = condition.color(seen, &ray);
        }
        seen
    };
    let n = conditions.len();
    let mut centers = vec![Vec3::ZERO; width * height * n];
    let mut depth = vec![0.0f32; width * height];
    let mut surfaces = vec![u16::MAX; width * height];
    centers
        .par_chunks_mut((width * n).max(1))
        .zip(depth.par_chunks_mut(width.max(1)))
        .zip(surfaces.par_chunks_mut(width.max(1)))
        .enumerate()
        .for_each(|(y, ((row, depths), ids))| {
            for x in 0..width {
                let out = &mut row[x * n..(x + 1) * n];
                if let Some(seen) = colors(x as f32 + 0.5, y as f32 + 0.5, out) {
                    depths[x] = seen.t;
                    ids[x] = seen.surface;
                }
            }
        });
    let differ = |p: usize, q: usize| {
        let (a, b) = (depth[p], depth[q]);
        surfaces[p] != surfaces[q] || (a - b).abs() > 0.03 * a.min(b)
    };
    let rows: Vec<Vec<Vec3>> = (0..height)
        .into_par_iter()
        .map(|y| {
            let mut row = centers[y * width * n..(y + 1) * width * n].to_vec();
            let mut extra = vec![Vec3::ZERO; n];
            for x in 0..width {
                let p = y * width + x;
                let edge = (x > 0 && differ(p, p - 1))
                    || (x + 1 < width && differ(p, p + 1))
                    || (y > 0 && differ(p, p - width))
                    || (y + 1 < height && differ(p, p + width));
                if !edge {
                    continue;
                }
                let out = &mut row[x * n..(x + 1) * n];
                for k in 0..EXTRA {
                    // The plastic-number sequence covers the pixel evenly for any count.
                    let (du, dv) = (0.754_877_7 * (k + 1) as f32, 0.569_840_3 * (k + 1) as f32);
                    colors(x as f32 + du.fract(), y as f32 + dv.fract(), &mut extra);
                    for (sum, value) in out.iter_mut().zip(&extra) {
                        *sum += *value;
                    }
                }
                for sum in out {
                    *sum /= (EXTRA + 1) as f32;
                }
            }
            row
        })
        .collect();
    let images = (0..n)
        .map(|c| {
            let mut image = Image::new(width, height);
            for channel in 0..3 {
                for (y, line) in image.plane_mut(channel).chunks_exact_mut(width.max(1)).enumerate() {
                    for (x, value) in line.iter_mut().enumerate() {
                        *value = rows[y][x * n + c][channel];
                    }
                }
            }
            lens_blur(&mut image);
            image
        })
        .collect();
    // The raster has as many values as pixels.
    let depth = Map::from_planes(width, height, depth).unwrap_or_else(|| Map::new(width, height));
    Shot { images, depth, surfaces }
}

/// The lens blur: it spreads every point over its neighbours, 1:2:1 along both axes, as real lenses do with
/// details finer than a pixel.
pub(crate) fn lens_blur(image: &mut Image) {
    let (width, height) = (image.width(), image.height());
    for channel in 0..3 {
        let plane = image.plane_mut(channel);
        let sharp = plane.to_vec();
        plane.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, line)| {
            let row = |y: usize| &sharp[y * width..(y + 1) * width];
            let (above, here, below) = (row(y.saturating_sub(1)), row(y), row((y + 1).min(height - 1)));
            let mixed = |x: usize| 0.25 * (above[x] + 2.0 * here[x] + below[x]);
            for (x, value) in line.iter_mut().enumerate() {
                let (left, right) = (x.saturating_sub(1), (x + 1).min(width - 1));
                *value = 0.25 * (mixed(left) + 2.0 * mixed(x) + mixed(right));
            }
        });
    }
}

/// Rays evenly over a picture, 24 by 16: enough to measure its exposure, without the bend of a lens.
pub(crate) fn coarse_rays(camera: &Camera) -> Vec<Ray> {
    let rays = Rays::new(camera, None);
    let (w, h) = (camera.intrinsics.width as f32, camera.intrinsics.height as f32);
    (0..24 * 16)
        .map(|i| rays.through((0.5 + (i % 24) as f32) / 24.0 * w, (0.5 + (i / 24) as f32) / 16.0 * h))
        .collect()
}

/// The exposure at which the cameras' views have this mean luminance on display (bisection on a coarse grid
/// of rays).
pub(crate) fn expose(scene: &MeshScene, cameras: &[Camera], condition: &Condition, luminance: f32) -> f32 {
    let rays: Vec<Ray> = cameras.iter().flat_map(coarse_rays).collect();
    let seen: Vec<Option<SurfaceHit>> = rays.iter().map(|ray| scene.look(ray, 0.05, Caustics::OFF)).collect();
    let mean = |exposure: f32| {
        let lit = Condition { light: exposure * condition.light, water: condition.water };
        let weights = Vec3::new(0.299, 0.587, 0.114);
        let sum: f32 = seen.iter().zip(&rays).map(|(seen, ray)| lit.color(*seen, ray).dot(weights)).sum();
        sum / rays.len().max(1) as f32
    };
    let (mut low, mut high) = (0.35f32, 1.9f32);
    for _ in 0..14 {
        let middle = 0.5 * (low + high);
        if mean(middle) < luminance { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// Adds sensor noise to an image in place: standard deviation `sigma sqrt(0.25 + 1.5 I)` of display range, so
/// `sigma` is that of a middle tone. Keyed by (seed, view, pixel).
pub(crate) fn add_noise(image: &mut Image, sigma: f32, seed: u64, view: u64) {
    if sigma <= 0.0 {
        return;
    }
    let stream = Stream::new(seed, Purpose::new("sensor noise"), view);
    let block = 4096;
    image.data_mut().par_chunks_mut(block).enumerate().for_each(|(b, values)| {
        for (i, value) in values.iter_mut().enumerate() {
            let normal = stream.normal((b * block + i) as u64) as f32;
            *value += sigma * (0.25 + 1.5 * value.max(0.0)).sqrt() * normal;
        }
    });
}

/// The distance to the nearest surface along the ray through pixel coordinates `(u, v)`, as z-depth in
/// metres.
pub(crate) fn depth_at(
    scene: &MeshScene,
    camera: &Camera,
    lens: Option<&Lens>,
    (u, v): (f64, f64),
) -> Option<f32> {
    scene.distance(&Rays::new(camera, lens).through(u as f32, v as f32))
}
