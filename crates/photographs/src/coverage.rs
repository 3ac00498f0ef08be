//! The number of training views that saw the surface of a pixel.
//!
//! A surface that one view alone saw is no more than that view's own picture, and one that no view saw is a
//! guess. A point `x` at the expected depth of a pixel counts as seen by a training view if it lies inside
//! its picture and is not hidden there:
//!
//! ```text
//! z_v(x) ≤ (1 + [`SLACK`]) d_v(π_v(x))          c = min(1, views / [`ENOUGH`])
//! ```
//!
//! with the depth `z_v` of the point in the view and the view's own expected depth `d_v`. Pixels without a
//! surface (open water) count as covered: structure and colour decide there. `c` is averaged over regions,
//! and a region counts in part from 30 %, and fully from 80 %, of covered pixels.

use rayon::prelude::*;
use use3d_capture::{Camera, Map};
use use3d_render::{Mode, RenderError, Rendering, SceneRenderer};

use crate::boxes::mean;
use crate::known::{REGION, radius};

/// Longer side of the depth maps, pixels.
const SIDE: usize = 192;
/// Relative depth by which a point may lie behind the surface of a view.
const SLACK: f64 = 0.1;
/// Views that make a surface known.
const ENOUGH: f32 = 2.0;
/// The most training views that are asked for one photograph: those nearest to its camera.
const MOST: usize = 48;
/// Pixels between those that are computed.
const STEP: usize = 4;

/// The training views of a scene with what they see.
#[derive(Clone, Debug, Default)]
pub struct Coverage {
    views: Vec<(Camera, Map)>,
}

impl Coverage {
    /// Draws the depth of every training view, small.
    ///
    /// # Errors
    /// The error of the backend's device.
    pub fn new(renderer: &mut SceneRenderer<'_>, training: &[Camera]) -> Result<Self, RenderError> {
        let mut views = Vec::with_capacity(training.len());
        for camera in training {
            let camera = camera.no_larger_than(SIDE);
            if let Some(Rendering::Scalar(depth)) = renderer.render(&camera, &[Mode::Depth])?.pop() {
                views.push((camera, depth));
            }
        }
        Ok(Self { views })
    }

    /// The share `c` for every pixel of a picture with this expected depth. `own` is the index of the
    /// training view that is the photograph itself: it does not count.
    pub fn of(&self, camera: &Camera, depth: &Map, own: Option<usize>) -> Map {
        let (w, h) = (depth.width(), depth.height());
        let centre = camera.pose.center();
        let mut near: Vec<(usize, f64)> =
            self.views.iter().map(|(c, _)| c.pose.center().distance_squared(centre)).enumerate().collect();
        near.retain(|(i, _)| Some(*i) != own);
        near.sort_by(|a, b| a.1.total_cmp(&b.1));
        near.truncate(MOST);
        let back = camera.pose.rotation.transpose();
        let seen = |x: usize, y: usize| {
            let z = f64::from(depth.pixel(x, y)[0]);
            if z <= 0.0 {
                return 1.0;
            }
            let point = centre + back * (camera.ray(x as f64 + 0.5, y as f64 + 0.5) * z);
            let mut count = 0.0f32;
            for (i, _) in &near {
                let (view, surface) = &self.views[*i];
                let Some((pixel, z)) = view.project(point) else { continue };
                if pixel.x < 0.0 || pixel.y < 0.0 {
                    continue;
                }
                let (u, v) = (pixel.x as usize, pixel.y as usize);
                if u < surface.width() && v < surface.height() {
                    let there = f64::from(surface.pixel(u, v)[0]);
                    count += if there <= 0.0 || z <= (1.0 + SLACK) * there { 1.0 } else { 0.0 };
                }
                if count >= ENOUGH {
                    break;
                }
            }
            (count / ENOUGH).min(1.0)
        };
        let mut out = Map::new(w, h);
        let n = w.max(1);
        out.data_mut().par_chunks_mut(n * STEP).enumerate().for_each(|(block, lines)| {
            let y = (block * STEP + STEP / 2).min(h - 1);
            let (line, rest) = lines.split_at_mut(w);
            for (k, part) in line.chunks_mut(STEP).enumerate() {
                part.fill(seen((k * STEP + STEP / 2).min(w - 1), y));
            }
            rest.chunks_exact_mut(w).for_each(|other| other.copy_from_slice(line));
        });
        // Regions decide: single points miss by the errors of two depths.
        mean(out.data_mut(), w, radius(w, REGION, STEP));
        out.data_mut().iter_mut().for_each(|c| *c = ((*c - 0.3) / 0.5).clamp(0.0, 1.0));
        mean(out.data_mut(), w, radius(w, REGION, STEP));
        out
    }
}
