//! A look with its water written into spherical harmonics, as seen by the training cameras.
//!
//! The compositor's picture is `c_m + Σ w_i (f_i − c_m)` with
//!
//! ```text
//! f_i = c_i⁺ e^{−β_attn s_i} + c_m (1 − e^{−β_bs s_i})
//! ```
//!
//! So a viewer without water shows the same picture if Gaussian `i` has the colour `f_i` and open water
//! stands behind everything. `f_i` depends on the distance `s_i` to the camera. It is averaged over the
//! training cameras `v`, weighted by the visibility `ω_iv = Σ_pixels w_i`:
//!
//! ```text
//! t_i = Σ_v ω_iv e^{−β̄_attn,iv s_iv} / Σ_v ω_iv
//! b_i = Σ_v ω_iv c̄_m,iv (1 − e^{−β̄_bs,iv s_iv}) / Σ_v ω_iv
//! f_i(ω) ≈ t_i c_i⁺(ω) + b_i
//! ```
//!
//! Here the water's coefficients and colour are averaged over the pixels that the Gaussian covers. A
//! Gaussian that no camera saw is treated as seen from the nearest camera through the mean water. All
//! values are in scene units and display range.
//!
//! Cameras saw a Gaussian from several distances, and so in several colours. Each camera saw it from one
//! direction, so harmonics can hold the difference. Bands 0 to 2 are fitted to it by least squares, with a
//! penalty `λ` (`PENALTY`) that keeps the harmonics from above where the cameras do not determine them:
//!
//! ```text
//! h_i = h̄_i + argmin_δ Σ_v ω_iv |t_iv c_i⁺(ω_v) + b_iv − h̄_i(ω_v) − δ·y(ω_v)|² + λ Σ_v ω_iv |δ|²
//! ```
//!
//! On a reef that the camera swims towards, this halves the difference at held-out views. With cameras of
//! half the swim alone it also halves the difference at the other half, so the fit does not only repeat its
//! views.
//!
//! Open water becomes a *backdrop*: a sphere of opaque Gaussians around the scene, each with the colour of
//! the water in its direction, as seen from the middle of the cameras.
//!
//! Limits: a picture from a distance that no camera had (a close-up, or a flight away from the scene) still
//! shows the water of the cameras' distances. Only the page and `render` show the water of the viewer's
//! actual position.

use rayon::prelude::*;
use use3d_capture::{Camera, Intrinsics, Lattice, MediumMaps, Pose};
use use3d_numerics::cholesky::Factor;
use use3d_numerics::math;
use use3d_numerics::spherical_harmonics::{C0, bands, basis};
use use3d_scene::Scene;
use use3d_splat::{Colors, Gaussians, Prepared, Rasterizer};

use super::{BakeReport, bake_maps, color, mapped};
use crate::RenderError;
use crate::look::{grades, look_through, thin};
use crate::renderer::Look;

/// The longest side, in pixels, at which visibility is measured.
const SIDE: usize = 400;
/// Number of planes that are lifted together: attenuation, backscatter and colour of the water, and ones.
const PLANES: usize = 10;
/// Number of functions of the harmonics that are fitted to the cameras: bands 0 to 2.
const FITTED: usize = 9;
/// The penalty `λ` of a change of the harmonics, as a share of the visibility.
const PENALTY: f64 = 0.001;
/// Number of Gaussians of the backdrop.
const BACKDROP: usize = 3000;
/// The backdrop's distance from the middle of the cameras, in units of the distance within which 99.5 % of
/// the Gaussians lie.
const BEYOND: f32 = 1.3;

/// A baked look with water.
#[derive(Clone, Debug, PartialEq)]
pub struct InWater {
    /// The scene's Gaussians with their colours in water, in its frame; the backdrop's come last.
    pub gaussians: Gaussians,
    /// The number of them that are the backdrop; 0 in a scene without water.
    pub backdrop: usize,
    /// The difference between the harmonics and the colours that they represent.
    pub report: BakeReport,
}

/// Bakes a look with a share of its water in `[0, 1]`, as seen by `cameras` (in the scene's frame).
///
/// # Errors
/// The strength or the share is outside `[0, 1]`, the enhanced look of a scene without enhancement is
/// requested, there is no camera, or the water belongs to finished images (`seasplat`, `uir`).
pub fn bake_in_water(
    scene: &Scene,
    look: Look,
    water: f32,
    cameras: &[Camera],
) -> Result<InWater, RenderError> {
    if !(0.0..=1.0).contains(&water) {
        return Err(RenderError::Water(water));
    }
    let (grades, strength) = match look {
        Look::Reconstruction => (None, None),
        Look::Enhanced { strength } => (Some(grades(scene, strength)?), Some(strength)),
    };
    let matrix = |i: usize| grades.as_ref().map_or(IDENTITY, |grades| grades.matrix(i));
    if scene.medium.is_none() || water == 0.0 {
        let (gaussians, report) = bake_maps(&scene.gaussians, matrix);
        return Ok(InWater { gaussians, backdrop: 0, report });
    }
    if cameras.is_empty() {
        return Err(RenderError::NoCameras);
    }
    let kind = scene.medium.kind();
    if !kind.is_per_length() {
        return Err(RenderError::NoPlace(kind.name()));
    }
    let look = WaterLook { scene, strength, water, cameras };
    let effects = look.effects();
    let in_water = |i: usize| {
        let WaterEffect { arriving, veil, .. } = effects[i];
        let mut rows = matrix(i);
        for (c, row) in rows.iter_mut().enumerate() {
            *row = row.map(|v| arriving[c] * v);
            row[3] += veil[c];
        }
        rows
    };
    let (mut gaussians, report) = bake_maps(&scene.gaussians, in_water);
    look.fit(matrix, &mut gaussians);
    let backdrop = look.backdrop();
    gaussians.extend(&backdrop);
    Ok(InWater { gaussians, backdrop: backdrop.len(), report })
}

/// The colour map that changes nothing.
const IDENTITY: [[f32; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// `t_i` and `b_i` of a Gaussian, and the sum of its visibilities.
#[derive(Clone, Copy, Default)]
struct WaterEffect {
    arriving: [f32; 3],
    veil: [f32; 3],
    weight: f32,
}

/// A look with a share of its water, and the cameras that see it.
struct WaterLook<'a> {
    scene: &'a Scene,
    strength: Option<f32>,
    water: f32,
    cameras: &'a [Camera],
}

impl WaterLook<'_> {
    /// Computes the remaining water in front of a camera; `whole` is working memory.
    fn maps(&self, camera: &Camera, lattice: &Lattice, whole: &mut MediumMaps, maps: &mut MediumMaps) {
        look_through(self.scene, self.strength, camera, lattice, whole);
        thin(whole, self.water, maps);
    }

    /// The effect of the water on every Gaussian.
    fn effects(&self) -> Vec<WaterEffect> {
        let means = &self.scene.gaussians.means;
        let mut effects = vec![WaterEffect::default(); means.len()];
        // The mean water over all pixels, for Gaussians that no camera saw.
        let mut mean = [0.0f64; 9];
        self.each_camera(|center, planes, sums| {
            let pixels = planes.len() / PLANES;
            for (m, plane) in mean.iter_mut().zip(planes.chunks_exact(pixels)) {
                *m += plane.iter().map(|v| f64::from(*v)).sum::<f64>() / (pixels * self.cameras.len()) as f64;
            }
            effects.par_iter_mut().zip(sums.par_chunks_exact(PLANES)).zip(means).for_each(
                |((effect, sums), at)| {
                    let Some((visible, t, b)) = seen_through(sums, *at, center) else { return };
                    for c in 0..3 {
                        effect.arriving[c] += visible * t[c];
                        effect.veil[c] += visible * b[c];
                    }
                    effect.weight += visible;
                },
            );
        });
        let centers: Vec<[f32; 3]> =
            self.cameras.iter().map(|c| c.pose.center().as_vec3().to_array()).collect();
        let mean = mean.map(|m| m as f32);
        effects.par_iter_mut().zip(means).for_each(|(WaterEffect { arriving, veil, weight }, at)| {
            if *weight > 0.0 {
                *arriving = arriving.map(|v| v / *weight);
                *veil = veil.map(|v| v / *weight);
            } else {
                let near = centers.iter().map(|c| distance(*at, *c)).fold(f32::INFINITY, f32::min);
                (*arriving, *veil) = through(&mean, near);
            }
        });
        effects
    }

    /// Calls `visit` for each camera with its centre, the planes of its water (`β_attn`, `β_bs` and `c_m`
    /// with three channels each, and ones), and the sums of these planes over each Gaussian's pixels,
    /// weighted by visibility.
    fn each_camera(&self, mut visit: impl FnMut([f32; 3], &[f32], &[f32])) {
        let gaussians = &self.scene.gaussians;
        let (mut whole, mut maps) = (MediumMaps::zeros(0, 0), MediumMaps::zeros(0, 0));
        let (mut rasterizer, mut prepared) = (Rasterizer::new(), Prepared::new());
        let (mut planes, mut sums) = (Vec::new(), vec![0.0f32; PLANES * gaussians.len()]);
        for camera in self.cameras {
            let camera = camera.no_larger_than(SIDE);
            let lattice = Lattice::full(&camera.intrinsics);
            self.maps(&camera, &lattice, &mut whole, &mut maps);
            planes.clear();
            for image in [&maps.attenuation, &maps.backscatter, &maps.color] {
                planes.extend_from_slice(image.data());
            }
            planes.resize(PLANES * lattice.width() * lattice.height(), 1.0);
            prepared.prepare(gaussians, &camera, &lattice, Colors::Sh { degree: 0 });
            rasterizer.splat_adjoint(&prepared, PLANES, &planes, &mut sums);
            visit(camera.pose.center().as_vec3().to_array(), &planes, &sums);
        }
    }

    /// Fits bands 0 to 2 of `baked` to the colours in which each camera saw a Gaussian (module
    /// documentation).
    fn fit(&self, matrix: impl Fn(usize) -> [[f32; 4]; 3] + Sync, baked: &mut Gaussians) {
        let gaussians = &self.scene.gaussians;
        let degree = baked.sh_degree.min(3);
        let used = bands(degree).min(FITTED);
        let mut normals = vec![Normal::ZERO; baked.len()];
        self.each_camera(|center, _, sums| {
            normals.par_iter_mut().zip(sums.par_chunks_exact(PLANES)).enumerate().for_each(
                |(i, (normal, sums))| {
                    let at = gaussians.means[i];
                    let Some((visible, t, b)) = seen_through(sums, at, center) else { return };
                    let s = distance(at, center).max(f32::MIN_POSITIVE);
                    let y = basis(degree, std::array::from_fn(|k| (at[k] - center[k]) / s));
                    let [own, shown] = [&gaussians.sh[i], &baked.sh[i]].map(|sh| color(sh, &y, degree));
                    let enhanced = mapped(&matrix(i), own.map(|v| v.max(0.0)));
                    let residual = std::array::from_fn(|c| t[c] * enhanced[c] + b[c] - shown[c]);
                    normal.add(visible, &y, residual);
                },
            );
        });
        baked.sh.par_iter_mut().zip(&normals).filter(|(_, normal)| normal.weight > 0.0).for_each(
            |(sh, normal)| {
                for (band, change) in sh.iter_mut().zip(normal.solve(used)).take(used) {
                    *band = std::array::from_fn(|c| band[c] + change[c]);
                }
            },
        );
    }

    /// A sphere of Gaussians around the scene, in the colours of open water.
    fn backdrop(&self) -> Gaussians {
        let (gaussians, cameras) = (&self.scene.gaussians, self.cameras);
        let count = cameras.len() as f64;
        let middle = cameras.iter().map(|c| c.pose.center()).sum::<glam::DVec3>() / count;
        let middle_f32 = middle.as_vec3().to_array();
        let mut distances: Vec<f32> = gaussians.means.iter().map(|m| distance(*m, middle_f32)).collect();
        let farthest_camera =
            cameras.iter().map(|c| (c.pose.center() - middle).length()).fold(0.0, f64::max) as f32;
        let most = distances.len().saturating_sub(1) * 995 / 1000;
        let reach = if distances.is_empty() {
            1.0
        } else {
            *distances.select_nth_unstable_by(most, f32::total_cmp).1
        };
        let radius = BEYOND * reach.max(4.0 * farthest_camera).max(1e-3);
        let mut out = Gaussians::empty(gaussians.sh_degree);
        // Golden-angle spiral: every Gaussian represents the same area of the sphere.
        let turn = std::f64::consts::PI * (3.0 - 5f64.sqrt());
        let spacing = (4.0 * std::f64::consts::PI / BACKDROP as f64).sqrt() as f32;
        let (mut whole, mut maps) = (MediumMaps::zeros(0, 0), MediumMaps::zeros(0, 0));
        let lens = Intrinsics { width: 1, height: 1, fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
        for k in 0..BACKDROP {
            let z = 1.0 - (2.0 * k as f64 + 1.0) / BACKDROP as f64;
            let (r, phi) = ((1.0 - z * z).sqrt(), k as f64 * turn);
            let direction = glam::DVec3::new(r * math::cos(phi), r * math::sin(phi), z);
            let up = if direction.y.abs() < 0.9 { glam::DVec3::Y } else { glam::DVec3::X };
            let camera = Camera { intrinsics: lens, pose: Pose::look_at(middle, middle + direction, up) };
            self.maps(&camera, &Lattice::full(&lens), &mut whole, &mut maps);
            // `Renderer` dims open water by the same share.
            let color = maps.color.pixel(0, 0).map(|v| self.water * v);
            let at = (middle + f64::from(radius) * direction).as_vec3().to_array();
            out.means.push(at);
            out.log_scales.push([math::ln(radius * spacing); 3]);
            out.quaternions.push([1.0, 0.0, 0.0, 0.0]);
            out.opacity_logits.push(6.0);
            let mut sh = [[0.0; 3]; 16];
            sh[0] = color.map(|v| (v.max(0.0) - 0.5) / C0);
            out.sh.push(sh);
        }
        out
    }
}

/// The visibility, transmission and veil of one Gaussian in one camera, or `None` if it is not visible there.
fn seen_through(sums: &[f32], at: [f32; 3], center: [f32; 3]) -> Option<(f32, [f32; 3], [f32; 3])> {
    let visible = sums[PLANES - 1];
    if visible.is_nan() || visible <= 0.0 {
        return None;
    }
    let water: [f32; 9] = std::array::from_fn(|k| sums[k] / visible);
    let (t, b) = through(&water, distance(at, center));
    Some((visible, t, b))
}

/// The normal equations of one Gaussian's fit: `Σ ω y yᵀ` (lower triangle), `Σ ω y r` per channel, and `Σ ω`.
#[derive(Clone, Copy)]
struct Normal {
    left: [f32; FITTED * (FITTED + 1) / 2],
    right: [[f32; 3]; FITTED],
    weight: f32,
}

impl Normal {
    const ZERO: Self =
        Self { left: [0.0; FITTED * (FITTED + 1) / 2], right: [[0.0; 3]; FITTED], weight: 0.0 };

    fn add(&mut self, weight: f32, basis: &[f32; 16], residual: [f32; 3]) {
        for (i, y) in basis.iter().enumerate().take(FITTED) {
            for (sum, other) in self.left[i * (i + 1) / 2..].iter_mut().zip(&basis[..=i]) {
                *sum += weight * y * other;
            }
            for (sum, r) in self.right[i].iter_mut().zip(residual) {
                *sum += weight * y * r;
            }
        }
        self.weight += weight;
    }

    /// The change `δ` of the first `used` bands; zero if sums are not finite.
    fn solve(&self, used: usize) -> [[f32; 3]; FITTED] {
        let mut change = [[0.0; 3]; FITTED];
        let mut matrix = vec![0.0; used * used];
        for i in 0..used {
            for j in 0..=i {
                matrix[i * used + j] = f64::from(self.left[i * (i + 1) / 2 + j]);
            }
            matrix[i * used + i] += PENALTY * f64::from(self.weight);
        }
        let Some(factor) = Factor::new(matrix, used) else { return change };
        for c in 0..3 {
            let right: Vec<f64> = self.right[..used].iter().map(|r| f64::from(r[c])).collect();
            for (row, v) in change.iter_mut().zip(factor.solve(&right)) {
                row[c] = v as f32;
            }
        }
        change
    }
}

/// `(e^{−β_attn s}, c_m (1 − e^{−β_bs s}))` of water `[β_attn, β_bs, c_m]` at a distance.
fn through(water: &[f32; 9], s: f32) -> ([f32; 3], [f32; 3]) {
    (
        std::array::from_fn(|c| math::exp(-water[c] * s)),
        std::array::from_fn(|c| water[6 + c] * (1.0 - math::exp(-water[3 + c] * s))),
    )
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|k| (a[k] - b[k]) * (a[k] - b[k])).sum::<f32>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_numerics::random::{Purpose, Stream};

    #[test]
    fn the_fit_is_where_the_derivative_of_its_objective_is_zero() {
        let draw = Stream::new(3, Purpose::new("fit in water"), 0);
        let cameras: Vec<(f32, [f32; 16], [f32; 3])> = (0..12u64)
            .map(|v| {
                let d = glam::DVec3::new(draw.normal(9 * v), draw.normal(9 * v + 1), 3.0).normalize();
                let residual = std::array::from_fn(|c| draw.normal(9 * v + 2 + c as u64) as f32);
                (draw.uniform(9 * v + 8) as f32 + 0.1, basis(3, d.as_vec3().to_array()), residual)
            })
            .collect();
        let mut normal = Normal::ZERO;
        cameras.iter().for_each(|(weight, y, residual)| normal.add(*weight, y, *residual));
        for used in [1, 4, FITTED] {
            let objective = |change: &[[f64; 3]; FITTED]| {
                let mut sum = 0.0;
                for (weight, y, residual) in &cameras {
                    for c in 0..3 {
                        let fitted: f64 = (0..used).map(|k| f64::from(y[k]) * change[k][c]).sum();
                        let apart = f64::from(residual[c]) - fitted;
                        sum += f64::from(*weight) * apart * apart;
                    }
                }
                let size: f64 = change[..used].iter().flatten().map(|v| v * v).sum();
                sum + PENALTY * f64::from(normal.weight) * size
            };
            let best = normal.solve(used).map(|row| row.map(f64::from));
            assert!(best[used..].iter().flatten().all(|v| *v == 0.0));
            let least = objective(&best);
            for (k, c) in (0..used).flat_map(|k| [(k, 0), (k, 1), (k, 2)]) {
                let at = |step: f64| {
                    let mut moved = best;
                    moved[k][c] += step;
                    objective(&moved)
                };
                let (more, less) = (at(1e-3), at(-1e-3));
                assert!(more > least && less > least, "{used} {k} {c}: {less} {least} {more}");
                let (slope, curvature) = ((more - less) / 2e-3, (more + less - 2.0 * least) / 1e-6);
                assert!((slope / curvature).abs() < 1e-4, "{used} {k} {c}: {slope} of {curvature}");
            }
        }
    }
}
