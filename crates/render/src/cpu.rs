//! Draws a look at a scene: grades its colours, thins its water, and leaves the rest to a [`Composer`].
//!
//! [`Cpu`] composes on the processor and is the reference: the same bytes on any number of threads.

use use3d_capture::{Camera, Image, KeptWater, Lattice, MediumMaps};
use use3d_scene::{Compositor, Scene};
use use3d_splat::{Options, Rendered};
use use3d_ubaf::enhancement::ObjectGrades;

use crate::RenderError;
use crate::backend::{Backend, Composer, Composition, Recolor, Request};
use crate::renderer::Look;

/// Composes on the processor.
pub struct Processor<'s> {
    scene: &'s Scene,
    compositor: Compositor,
}

impl Composer for Processor<'_> {
    fn compose(&mut self, view: &Composition<'_>, out: &mut Rendered) -> Result<(), RenderError> {
        let Composition { camera, lattice, recolor, medium, layers } = *view;
        self.compositor.prepare(self.scene, camera, lattice, |colors| {
            if let Some(recolor) = recolor {
                recolor(colors);
            }
        });
        self.compositor.draw(medium, &Options { layers, ..Options::default() }, out);
        Ok(())
    }
}

/// Draws on the processor.
pub type Cpu<'s> = Looking<'s, Processor<'s>>;

/// One look at a scene, composed by any composer `C`.
pub struct Looking<'s, C> {
    scene: &'s Scene,
    /// Per-Gaussian grades and the strength, if enhanced.
    grades: Option<(ObjectGrades, f32)>,
    composer: C,
    /// The water in front of the last camera, in this look.
    maps: MediumMaps,
    /// `maps` with the coefficients of the remaining water.
    thinned: MediumMaps,
    /// The camera and the lattice of `maps`, which are costly to compute.
    seen: Option<(Camera, Lattice)>,
}

impl<'s> Cpu<'s> {
    /// A look on the processor.
    ///
    /// # Errors
    /// See [`Looking::on`].
    pub fn new(scene: &'s Scene, look: Look) -> Result<Self, RenderError> {
        Self::on(Processor { scene, compositor: Compositor::default() }, scene, look)
    }
}

impl<'s, C: Composer> Looking<'s, C> {
    /// A look with a composer of the same scene. The field is evaluated here, once; a view then costs one
    /// more affine per Gaussian than the reconstruction.
    ///
    /// # Errors
    /// The strength is outside `[0, 1]`, or the scene is not enhanced.
    pub fn on(composer: C, scene: &'s Scene, look: Look) -> Result<Self, RenderError> {
        let grades = match look {
            Look::Reconstruction => None,
            Look::Enhanced { strength } => Some((grades(scene, strength)?, strength)),
        };
        let (maps, thinned) = (MediumMaps::zeros(0, 0), MediumMaps::zeros(0, 0));
        Ok(Self { scene, grades, composer, maps, thinned, seen: None })
    }
}

impl<C> Looking<'_, C> {
    /// Computes `maps` for a camera, unless they are there.
    fn look_through(&mut self, camera: &Camera, lattice: &Lattice) {
        if self.seen.as_ref().is_some_and(|(c, l)| c == camera && l == lattice) {
            return;
        }
        let strength = self.grades.as_ref().map(|(_, strength)| *strength);
        look_through(self.scene, strength, camera, lattice, &mut self.maps);
        self.seen = Some((*camera, lattice.clone()));
    }
}

impl<C: Composer> Backend for Looking<'_, C> {
    fn draw(&mut self, request: &Request<'_>, out: &mut Rendered) -> Result<(), RenderError> {
        let Request { camera, lattice, water, layers } = *request;
        if water.is_some() {
            self.look_through(camera, lattice);
        }
        let water = water.unwrap_or(0.0);
        let graded =
            self.grades.as_ref().map(|(grades, _)| move |colors: &mut [[f32; 3]]| grades.apply(colors));
        let recolor = graded.as_ref().map(|graded| graded as &Recolor<'_>);
        let dry = self.scene.medium.is_none() || water == 0.0;
        let thinned = !dry && water < 1.0;
        let medium = if dry {
            None
        } else if thinned {
            thin(&self.maps, water, &mut self.thinned);
            Some(&self.thinned)
        } else {
            Some(&self.maps)
        };
        self.composer.compose(&Composition { camera, lattice, recolor, medium, layers }, out)?;
        if thinned {
            dim_open_water(&self.maps.color, water, out);
        }
        Ok(())
    }

    fn respond(
        &mut self,
        request: &Request<'_>,
        channel: Option<usize>,
        out: &mut Rendered,
    ) -> Result<(), RenderError> {
        let Request { camera, lattice, water, .. } = *request;
        let share = water.unwrap_or(0.0);
        let wet = share > 0.0 && !self.scene.medium.is_none();
        if wet {
            self.look_through(camera, lattice);
            thin(&self.maps, share, &mut self.thinned);
            self.thinned.color.data_mut().fill(0.0);
        }
        let grades = self.grades.as_ref().map(|(grades, _)| grades);
        let recolor = |colors: &mut [[f32; 3]]| match (channel, grades) {
            (None, _) => colors.fill([1.0; 3]),
            (Some(j), None) => colors.fill(std::array::from_fn(|i| if i == j { 1.0 } else { 0.0 })),
            (Some(j), Some(grades)) => {
                colors.iter_mut().enumerate().for_each(|(i, c)| *c = grades.matrix(i).map(|row| row[j]));
            }
        };
        let medium = wet.then_some(&self.thinned);
        let view = Composition { camera, lattice, recolor: Some(&recolor), medium, layers: false };
        self.composer.compose(&view, out)
    }

    fn medium(&self) -> Option<&MediumMaps> {
        (!self.scene.medium.is_none()).then_some(&self.maps)
    }
}

/// Computes the water in front of a camera: that of the enhanced look at `strength`, or without a strength
/// that of stage 1. Returns `false` and leaves `maps` unchanged in a scene without water.
pub(crate) fn look_through(
    scene: &Scene,
    strength: Option<f32>,
    camera: &Camera,
    lattice: &Lattice,
    maps: &mut MediumMaps,
) -> bool {
    if !scene.look_through(camera, lattice, maps) {
        return false;
    }
    if let (Some(strength), Some(enhancement)) = (strength, &scene.enhancement) {
        let center = camera.pose.center().as_vec3().to_array();
        let frozen = std::mem::replace(maps, MediumMaps::zeros(0, 0));
        *maps = enhancement.water(center, frozen, strength);
    }
    true
}

/// Water of the same colour with `share` of its coefficients.
pub(crate) fn thin(maps: &MediumMaps, share: f32, out: &mut MediumMaps) {
    out.resize(maps.color.width(), maps.color.height());
    out.color.data_mut().copy_from_slice(maps.color.data());
    out.backscatter.data_mut().copy_from_slice(maps.backscatter.data());
    out.attenuation.data_mut().copy_from_slice(maps.attenuation.data());
    out.formation = maps.formation;
    KeptWater([share; 3]).thin(out);
}

/// Multiplies open water by its factor, in the picture and in its layers. Of the water's light,
/// `(1 − Σ w) c_m` belongs to rays that no surface ends; a part of it is in the intervals before the last
/// Gaussian and a part at the far end.
fn dim_open_water(color: &Image, share: f32, out: &mut Rendered) {
    let pixels = out.accumulation.pixels();
    let open = |i: usize| (1.0 - out.accumulation.data()[i % pixels]) * color.data()[i];
    if let Some(layers) = &mut out.layers {
        let parts = layers.medium.data_mut().iter_mut().zip(layers.far.data_mut());
        for (i, (intervals, far)) in parts.enumerate() {
            *intervals -= (1.0 - share) * (open(i) - *far);
            *far *= share;
        }
    }
    for (i, pixel) in out.image.data_mut().iter_mut().enumerate() {
        *pixel -= (1.0 - share) * open(i);
    }
}

/// The grades of a scene's Gaussians at a strength.
pub(crate) fn grades(scene: &Scene, strength: f32) -> Result<ObjectGrades, RenderError> {
    if !(0.0..=1.0).contains(&strength) {
        return Err(RenderError::Strength(strength));
    }
    let enhancement = scene.enhancement.as_ref().ok_or(RenderError::NotEnhanced)?;
    let g = &scene.gaussians;
    Ok(enhancement.objects(&g.means, g.sh.iter().map(|sh| sh[0]), strength))
}
