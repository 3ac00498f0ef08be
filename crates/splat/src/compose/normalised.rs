//! Distances normalised to `[0, 1]` in each view, as SeaSplat takes them for its water and its priors.
//!
//! ```text
//! ẑ = (z − z_min) / (z_max − z_min)    where something is hit;  ẑ = 1 where nothing is
//! I = clamp(J e^{−β_a ẑ} + c_m (1 − e^{−β_b ẑ}), 0, 1)
//! ```
//!
//! `z` is a pixel's expected depth, and the minimum and maximum run over the pixels of the view that are hit.
//! With one depth alone, `ẑ = 1`. [The formula of whole images](super::per_image) has the rest.
//!
//! With `g = ∂ẑ` and `e = z_max − z_min` the derivatives are `∂z = g / e`, and in addition
//! `−Σ g ẑ / e` for the farthest pixel and `−Σ g (1 − ẑ) / e` for the nearest one. The sums run over the
//! pixels that are hit. Of several such pixels, the first has the derivative.

use use3d_capture::Map;
use use3d_numerics::sums::sums;

/// The nearest and the farthest expected depth of a view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthRange {
    least: f32,
    extent: f32,
    /// Indices of the nearest and of the farthest pixel.
    ends: [usize; 2],
}

impl DepthRange {
    /// The range of a view's depths over the pixels with an accumulated weight.
    pub fn of(depth: &Map, accumulation: &Map) -> Self {
        let mut ends: Option<[(f32, usize); 2]> = None;
        for (i, (&z, &weight)) in depth.data().iter().zip(accumulation.data()).enumerate() {
            if weight > 0.0 {
                let [near, far] = ends.get_or_insert([(z, i); 2]);
                if z < near.0 {
                    *near = (z, i);
                }
                if z > far.0 {
                    *far = (z, i);
                }
            }
        }
        let [near, far] = ends.unwrap_or_default();
        Self { least: near.0, extent: far.0 - near.0, ends: [near.1, far.1] }
    }

    /// The normalised distance `ẑ` of a pixel.
    #[inline(always)]
    pub fn at(&self, depth: f32, accumulation: f32) -> f32 {
        if accumulation > 0.0 && self.extent > 0.0 { (depth - self.least) / self.extent } else { 1.0 }
    }

    /// Divides a loss that is linear in the differences of depths by `z_max − z_min`, and completes its
    /// gradient, which has the factor `weight`. Both are 0 if the view has one depth.
    pub fn per_extent(&self, value: f64, weight: f64, gradient: &mut Map) -> f64 {
        if self.extent <= 0.0 {
            gradient.data_mut().fill(0.0);
            return 0.0;
        }
        let extent = f64::from(self.extent);
        let value = value / extent;
        gradient.data_mut().iter_mut().for_each(|g| *g /= self.extent);
        let [near, far] = self.ends;
        gradient.data_mut()[near] += (weight * value / extent) as f32;
        gradient.data_mut()[far] -= (weight * value / extent) as f32;
        value
    }

    /// Turns the gradient with respect to `ẑ` into the gradient with respect to expected depth.
    pub fn backward(&self, depth: &Map, accumulation: &Map, gradient: &mut Map) {
        if self.extent <= 0.0 {
            gradient.data_mut().fill(0.0);
            return;
        }
        let (z, weight) = (depth.data(), accumulation.data());
        let given = gradient.data();
        let [near, far] = sums::<2>(z.len(), |i, totals| {
            if weight[i] > 0.0 {
                let (g, at) = (f64::from(given[i]), f64::from(self.at(z[i], weight[i])));
                totals[0] -= g * (1.0 - at);
                totals[1] -= g * at;
            }
        });
        let extent = f64::from(self.extent);
        for (g, weight) in gradient.data_mut().iter_mut().zip(weight) {
            *g = if *weight > 0.0 { *g / self.extent } else { 0.0 };
        }
        for (end, sum) in self.ends.into_iter().zip([near, far]) {
            gradient.data_mut()[end] += (sum / extent) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use fearless_simd::Level;
    use use3d_capture::{Camera, Formation, Image, Intrinsics, Lattice, MediumMaps, Pose};
    use use3d_golden::{Case, Part};

    use super::super::per_image::Clear;
    use super::super::rasterizer::Kernels;
    use super::*;
    use crate::{Colors, Gaussians, Options, Prepared, RenderGradients, Rendered};

    fn image(case: &Case<'_>, name: &str) -> Image {
        let (w, h, planes) = case.planes(name);
        Image::from_planes(w, h, planes).unwrap()
    }

    fn map(case: &Case<'_>, name: &str) -> Map {
        let (w, h, planes) = case.planes(name);
        Map::from_planes(w, h, planes).unwrap()
    }

    #[test]
    fn golden_formation() {
        let part = Part::math("seasplat");
        let case = part.cases().into_iter().find(|case| case.name() == "formation").unwrap();
        let (width, height) = (case.count("width"), case.count("height"));
        let intrinsics = Intrinsics { width, height, fx: 9.0, fy: 9.0, cx: 5.0, cy: 4.0 };
        let pose = Pose { rotation: glam::DMat3::IDENTITY, translation: glam::DVec3::ZERO };
        let camera = Camera { intrinsics, pose };
        let mut prepared = Prepared::new();
        let lattice = Lattice::full(&intrinsics);
        prepared.prepare(&Gaussians::empty(0), &camera, &lattice, Colors::Sh { degree: 0 });
        let water = MediumMaps {
            color: image(&case, "in.c_m"),
            backscatter: image(&case, "in.beta_bs"),
            attenuation: image(&case, "in.beta_attn"),
            formation: Formation::Normalised,
            network: None,
        };
        for kernels in [Kernels::Plain, Kernels::Lanes(Level::baseline()), Kernels::Lanes(Level::new())] {
            let mut clear = Clear::default();
            let mut formed = Rendered {
                image: image(&case, "in.light"),
                depth: map(&case, "in.depth"),
                accumulation: map(&case, "in.accumulation"),
                layers: None,
            };
            clear.form(kernels, &prepared, &water, &mut formed);
            case.check_planes("out.image", formed.image.data());
            let count = |value: f32| formed.image.data().iter().filter(|v| **v == value).count();
            assert_eq!((count(0.0), count(1.0)), (case.count("low"), case.count("high")));
            let d_image = image(&case, "cot.image");
            let own = Map::filled(width, height, 0.25);
            let zeros = Map::filled(width, height, 0.0);
            // A gradient of the depth itself is added, and one of the accumulation is kept.
            for (given, more) in [(&zeros, 0.0), (&own, 0.25)] {
                let d_rendered = RenderGradients {
                    image: &d_image,
                    depth: Some(given),
                    accumulation: Some(&own),
                    clear: None,
                };
                let mut maps = MediumMaps::zeros(0, 0);
                let wanted = (&d_rendered, &Options::default());
                clear.differentiate(kernels, &prepared, &water, wanted, Some(&mut maps));
                case.check_planes("grad.image.light", clear.d_image.data());
                case.check_planes("grad.image.depth", clear.d_depth.map(|d| d - more).data());
                assert_eq!(clear.d_accumulation, own);
                case.check_planes("grad.image.c_m", maps.color.data());
                case.check_planes("grad.image.beta_bs", maps.backscatter.data());
                case.check_planes("grad.image.beta_attn", maps.attenuation.data());
            }
            // Distances that are held have no derivative.
            let d_rendered =
                RenderGradients { image: &d_image, depth: None, accumulation: None, clear: None };
            let held = Options { depth_gradient: false, ..Options::default() };
            clear.differentiate(kernels, &prepared, &water, (&d_rendered, &held), None);
            assert_eq!(clear.d_depth, zeros);
        }
    }

    #[test]
    fn one_depth_and_no_depth_at_all_are_the_farthest() {
        let weight = Map::from_planes(3, 1, vec![0.5, 0.0, 0.9]).unwrap();
        for (depth, weight) in
            [(Map::from_planes(3, 1, vec![2.0, 0.0, 2.0]).unwrap(), weight), (Map::new(3, 1), Map::new(3, 1))]
        {
            let range = DepthRange::of(&depth, &weight);
            let mut gradient = Map::filled(3, 1, 7.0);
            range.backward(&depth, &weight, &mut gradient);
            for i in 0..3 {
                assert_eq!((range.at(depth.data()[i], weight.data()[i]), gradient.data()[i]), (1.0, 0.0));
            }
        }
    }
}
