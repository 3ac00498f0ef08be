//! Every picture of a scene, for one camera at a time.
//!
//! `reconstruction` is stage 1 with its water, `clear` its object radiance without water. `enhanced` is
//! stage 2's full image, `enhanced-clear` its object radiance without water. No 2D network is used: the
//! enhancement is in the scene. The share of the water in `reconstruction` and `enhanced` can be set at any
//! time ([`SceneRenderer::with_water`]), and so can a white balance ([`SceneRenderer::with_white`]).

use use3d_capture::{Appearance, Camera, Image, Lattice, Map, MediumMaps};
use use3d_scene::Scene;
use use3d_scene::white::Gains;
use use3d_splat::{Layers, Rendered};

use crate::RenderError;
use crate::pictures::spread;
use crate::renderer::{Look, Renderer};

/// A kind of picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Mode {
    /// Stage 1 with its water.
    Reconstruction,
    /// Object radiance without water.
    Clear,
    /// Stage 2: object, medium and transport enhanced.
    Enhanced,
    /// Stage 2's object radiance without water.
    EnhancedClear,
    /// Expected depth along the optical axis, scene units; 0 where nothing is hit.
    Depth,
    /// Accumulated opacity.
    Alpha,
    /// Attenuated object radiance, the object part of `reconstruction`.
    Object,
    /// Backscatter, the water part of `reconstruction`.
    Medium,
    /// The backscatter coefficient per pixel.
    Backscatter,
    /// The attenuation coefficient per pixel.
    Attenuation,
}

impl Mode {
    /// All modes.
    pub const ALL: [Self; 10] = [
        Self::Reconstruction,
        Self::Clear,
        Self::Enhanced,
        Self::EnhancedClear,
        Self::Depth,
        Self::Alpha,
        Self::Object,
        Self::Medium,
        Self::Backscatter,
        Self::Attenuation,
    ];

    /// Its name on the command line and as a folder.
    pub fn name(self) -> &'static str {
        match self {
            Self::Reconstruction => "reconstruction",
            Self::Clear => "clear",
            Self::Enhanced => "enhanced",
            Self::EnhancedClear => "enhanced-clear",
            Self::Depth => "depth",
            Self::Alpha => "alpha",
            Self::Object => "object",
            Self::Medium => "medium",
            Self::Backscatter => "backscatter",
            Self::Attenuation => "attenuation",
        }
    }

    /// The mode with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.name() == name)
    }

    /// The default look of a scene: the one in which its enhancement was learnt, or the reconstruction of a
    /// scene that is not enhanced. Colours that were learnt to look right through water are too strong
    /// without it.
    pub fn opening(scene: &Scene) -> Self {
        match scene.enhancement.as_ref().map(|enhancement| enhancement.appearance) {
            Some(Appearance::Clear) => Self::EnhancedClear,
            Some(Appearance::Water) => Self::Enhanced,
            None => Self::Reconstruction,
        }
    }

    /// True if its colours are too strong in this scene: those of an enhancement that was learnt in water and
    /// is shown without it.
    pub fn is_too_strong(self, scene: &Scene) -> bool {
        self == Self::EnhancedClear && Self::opening(scene) == Self::Enhanced
    }

    /// True if it shows stage 2.
    pub fn is_enhanced(self) -> bool {
        matches!(self, Self::Enhanced | Self::EnhancedClear)
    }

    /// The gains of a white balance for its colours, per channel; `None` for a mode without a white
    /// balance.
    pub fn gains(self, gains: &Gains) -> Option<[f32; 3]> {
        match self {
            Self::Clear => Some(gains.clear),
            Self::Enhanced => Some(gains.enhanced),
            Self::EnhancedClear => Some(gains.enhanced_clear),
            _ => None,
        }
    }

    /// True if [`SceneRenderer::with_water`] changes it.
    pub fn shows_water(self) -> bool {
        matches!(self, Self::Reconstruction | Self::Enhanced | Self::Object | Self::Medium)
    }

    fn needs_layers(self) -> bool {
        matches!(self, Self::Clear | Self::EnhancedClear | Self::Object | Self::Medium)
    }
}

/// The result of a mode.
#[derive(Clone, Debug, PartialEq)]
pub enum Rendering {
    /// A colour image, unclamped.
    Color(Image),
    /// One number per pixel.
    Scalar(Map),
}

/// A scene ready to be rendered from many cameras.
pub struct SceneRenderer<'a> {
    plain: Renderer<'a>,
    enhanced: Option<Renderer<'a>>,
    /// Gains of a white balance, from the next picture on.
    pub gains: Gains,
    rendered: Rendered,
}

impl<'a> SceneRenderer<'a> {
    /// Prepares a scene. `strength` in `[0, 1]` is the strength of its enhancement, if it has one, in
    /// `enhanced` and `enhanced-clear`.
    ///
    /// # Errors
    /// The strength is outside that range.
    pub fn new(scene: &'a Scene, strength: f32) -> Result<Self, RenderError> {
        let look = scene.enhancement.as_ref().map(|_| Look::Enhanced { strength });
        let enhanced = look.map(|look| Renderer::new(scene, look)).transpose()?;
        Ok(Self::on(Renderer::new(scene, Look::Reconstruction)?, enhanced))
    }

    /// A scene renderer from renderers on any backend: one of the reconstruction, and one of the
    /// enhancement if the scene has one.
    pub fn on(plain: Renderer<'a>, enhanced: Option<Renderer<'a>>) -> Self {
        Self { plain, enhanced, gains: Gains::ONE, rendered: Rendered::new() }
    }

    /// Leaves only a share of the water, in `[0, 1]`, in `reconstruction`, its parts `object` and `medium`,
    /// and `enhanced`: at 0 these are `clear` and `enhanced-clear`. The coefficients are shown unchanged.
    ///
    /// # Errors
    /// The share is outside that range.
    pub fn with_water(self, water: f32) -> Result<Self, RenderError> {
        let Self { plain, enhanced, gains, rendered } = self;
        let enhanced = enhanced.map(|renderer| renderer.with_water(water)).transpose()?;
        Ok(Self { plain: plain.with_water(water)?, enhanced, gains, rendered })
    }

    /// Multiplies the colours of `clear`, `enhanced` and `enhanced-clear` with the gains of a white balance.
    #[must_use]
    pub fn with_white(mut self, gains: Gains) -> Self {
        self.gains = gains;
        self
    }

    /// True if the scene can show [`Mode::Enhanced`] and [`Mode::EnhancedClear`].
    pub fn is_enhanced(&self) -> bool {
        self.enhanced.is_some()
    }

    /// Renders `modes` from a camera in the scene's normalised frame, in the given order. `Enhanced` and
    /// `EnhancedClear` of a scene without an enhancement are its reconstruction and its clear rendering.
    ///
    /// # Errors
    /// The error of the backend's device.
    pub fn render(&mut self, camera: &Camera, modes: &[Mode]) -> Result<Vec<Rendering>, RenderError> {
        self.render_on(camera, &Lattice::full(&camera.intrinsics), modes)
    }

    /// Like [`SceneRenderer::render`], for the pixels of a lattice alone.
    ///
    /// # Errors
    /// The error of the backend's device.
    pub fn render_on(
        &mut self,
        camera: &Camera,
        lattice: &Lattice,
        modes: &[Mode],
    ) -> Result<Vec<Rendering>, RenderError> {
        let mut frames: Vec<Option<Rendering>> = vec![None; modes.len()];
        if let Some(enhanced) = &mut self.enhanced {
            let wanted = |mode| modes.contains(&mode);
            match (wanted(Mode::Enhanced), wanted(Mode::EnhancedClear)) {
                (false, false) => {}
                (false, true) => enhanced.render_clear(camera, lattice, &mut self.rendered)?,
                (true, clear) => enhanced.render(camera, lattice, clear, &mut self.rendered)?,
            }
            let Rendered { image, layers, .. } = &self.rendered;
            for (frame, mode) in frames.iter_mut().zip(modes).filter(|(_, mode)| mode.is_enhanced()) {
                // A picture rendered without water has no layers and is itself clear.
                let clear = layers.as_ref().map_or(image, |layers| &layers.clear);
                let shown = if *mode == Mode::Enhanced { image } else { clear };
                *frame = Some(Rendering::Color(shown.clone()));
            }
        }
        if frames.iter().any(Option::is_none) {
            let layers = modes.iter().any(|m| m.needs_layers());
            self.plain.render(camera, lattice, layers, &mut self.rendered)?;
        }
        let finished = |(frame, mode): (Option<Rendering>, &Mode)| {
            let mut frame = frame.unwrap_or_else(|| self.frame(*mode));
            if let (Rendering::Color(image), Some(gains)) = (&mut frame, mode.gains(&self.gains)) {
                balance(image, gains);
            }
            frame
        };
        Ok(frames.into_iter().zip(modes).map(finished).collect())
    }

    /// Draws `Clear`, `Enhanced`, `EnhancedClear` or, for any other mode, `Reconstruction`, and lends the
    /// image. This is the cheapest way to draw a frame.
    ///
    /// # Errors
    /// The error of the backend's device.
    pub fn draw(&mut self, camera: &Camera, mode: Mode) -> Result<&Image, RenderError> {
        let renderer = match &mut self.enhanced {
            Some(enhanced) if mode.is_enhanced() => enhanced,
            _ => &mut self.plain,
        };
        let lattice = Lattice::full(&camera.intrinsics);
        match mode {
            Mode::Clear | Mode::EnhancedClear => {
                renderer.render_clear(camera, &lattice, &mut self.rendered)?;
            }
            _ => renderer.render(camera, &lattice, false, &mut self.rendered)?,
        }
        if let Some(gains) = mode.gains(&self.gains) {
            balance(&mut self.rendered.image, gains);
        }
        Ok(&self.rendered.image)
    }

    /// Renders one colour image; a convenience over [`SceneRenderer::render`].
    ///
    /// # Errors
    /// The error of the backend's device.
    pub fn color(&mut self, camera: &Camera, mode: Mode) -> Result<Image, RenderError> {
        Ok(match self.render(camera, &[mode])?.pop() {
            Some(Rendering::Color(image)) => image,
            Some(Rendering::Scalar(map)) => spread(&map),
            None => Image::new(0, 0),
        })
    }

    /// The share of light that arrives through all of the stage-1 water, per channel: `τ` of
    /// [`Response`](crate::Response).
    ///
    /// # Errors
    /// The error of the backend's device.
    pub fn arriving(&mut self, camera: &Camera, lattice: &Lattice) -> Result<Image, RenderError> {
        self.plain.arriving((camera, lattice), &mut self.rendered)?;
        Ok(self.rendered.image.clone())
    }

    /// One column of the answer to light of a look, before its white balance.
    pub(crate) fn column(
        &mut self,
        place: (&Camera, &Lattice),
        enhanced: bool,
        dry: bool,
        channel: usize,
    ) -> Result<&mut Image, RenderError> {
        let renderer = match &mut self.enhanced {
            Some(renderer) if enhanced => renderer,
            _ => &mut self.plain,
        };
        renderer.respond(place, dry, Some(channel), &mut self.rendered)?;
        Ok(&mut self.rendered.image)
    }

    fn frame(&self, mode: Mode) -> Rendering {
        let rendered = &self.rendered;
        let none = || Image::new(rendered.image.width(), rendered.image.height());
        let layer = |pick: fn(&Layers) -> &Image| {
            Rendering::Color(rendered.layers.as_ref().map_or_else(none, |l| pick(l).clone()))
        };
        let water = |pick: fn(&MediumMaps) -> &Image| {
            Rendering::Color(self.plain.medium().map_or_else(none, |maps| pick(maps).clone()))
        };
        match mode {
            Mode::Reconstruction | Mode::Enhanced => Rendering::Color(rendered.image.clone()),
            Mode::Clear | Mode::EnhancedClear => layer(|l| &l.clear),
            Mode::Object => layer(|l| &l.object),
            Mode::Medium => {
                let mut sum = rendered.layers.as_ref().map_or_else(none, |l| l.medium.clone());
                if let Some(layers) = &rendered.layers {
                    for (s, f) in sum.data_mut().iter_mut().zip(layers.far.data()) {
                        *s += f;
                    }
                }
                Rendering::Color(sum)
            }
            Mode::Depth => Rendering::Scalar(rendered.depth.clone()),
            Mode::Alpha => Rendering::Scalar(rendered.accumulation.clone()),
            Mode::Backscatter => water(|maps| &maps.backscatter),
            Mode::Attenuation => water(|maps| &maps.attenuation),
        }
    }
}

/// Multiplies every pixel of a picture, channel by channel. Gains of 1 leave its bytes unchanged.
fn balance(image: &mut Image, gains: [f32; 3]) {
    let pixels = image.pixels();
    for (channel, gain) in image.data_mut().chunks_mut(pixels.max(1)).zip(gains) {
        if gain != 1.0 {
            channel.iter_mut().for_each(|v| *v *= gain);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Frame, Intrinsics, Pose};
    use use3d_medium::{MediumModel, MediumRbf};
    use use3d_splat::Gaussians;

    /// A scene that is not enhanced: a Gaussian two units ahead in water.
    fn scene() -> (Scene, Camera) {
        let gaussians = Gaussians {
            sh_degree: 0,
            means: vec![[0.0, 0.0, 2.0]],
            log_scales: vec![[-1.5; 3]],
            quaternions: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![2.0],
            sh: vec![[[0.5, 0.2, -0.3]; 16]],
        };
        let scene = Scene {
            gaussians,
            frame: Frame::IDENTITY,
            medium: MediumModel::Rbf(MediumRbf::new(8, 4)),
            medium_degree: 3,
            enhancement: None,
        };
        let intrinsics = Intrinsics { width: 20, height: 14, fx: 16.0, fy: 16.0, cx: 10.0, cy: 7.0 };
        (scene, Camera { intrinsics, pose: Pose::IDENTITY })
    }

    #[test]
    fn every_mode_has_a_name_of_its_own() {
        for mode in Mode::ALL {
            assert_eq!(Mode::from_name(mode.name()), Some(mode));
        }
        assert_eq!(Mode::from_name("enhanced-clear"), Some(Mode::EnhancedClear));
        assert_eq!(Mode::from_name("Enhanced"), None);
    }

    #[test]
    fn with_no_water_left_the_reconstruction_is_clear_and_its_coefficients_stay() {
        let (scene, camera) = scene();
        let mut whole = SceneRenderer::new(&scene, 1.0).unwrap();
        let frames = whole.render(&camera, &Mode::ALL).unwrap();
        let of = |frames: &[Rendering], mode: Mode| {
            frames[Mode::ALL.iter().position(|m| *m == mode).unwrap()].clone()
        };
        assert_ne!(of(&frames, Mode::Reconstruction), of(&frames, Mode::Clear));
        // This scene is not enhanced.
        assert_eq!(of(&frames, Mode::Enhanced), of(&frames, Mode::Reconstruction));
        assert_eq!(of(&frames, Mode::EnhancedClear), of(&frames, Mode::Clear));
        for mode in [Mode::Reconstruction, Mode::Clear, Mode::Enhanced, Mode::EnhancedClear] {
            assert_eq!(
                Rendering::Color(whole.draw(&camera, mode).unwrap().clone()),
                of(&frames, mode),
                "{}",
                mode.name()
            );
        }
        let mut none = SceneRenderer::new(&scene, 1.0).unwrap().with_water(0.0).unwrap();
        let dry = none.render(&camera, &Mode::ALL).unwrap();
        for mode in Mode::ALL {
            let same = of(&dry, mode) == of(&frames, mode);
            assert_eq!(same, !mode.shows_water(), "{}", mode.name());
        }
        assert_eq!(of(&dry, Mode::Reconstruction), of(&frames, Mode::Clear));
        assert!(SceneRenderer::new(&scene, 1.0).unwrap().with_water(1.01).is_err());
    }

    #[test]
    fn a_white_balance_multiplies_the_looks_that_have_gains_and_no_other() {
        let (scene, camera) = scene();
        let gains =
            Gains { clear: [2.0, 1.0, 0.5], enhanced: [0.5, 1.0, 2.0], enhanced_clear: [1.5, 1.0, 1.0] };
        let plain = SceneRenderer::new(&scene, 1.0).unwrap().render(&camera, &Mode::ALL).unwrap();
        let mut renderer = SceneRenderer::new(&scene, 1.0).unwrap().with_white(gains);
        let white = renderer.render(&camera, &Mode::ALL).unwrap();
        for ((mode, plain), white) in Mode::ALL.into_iter().zip(&plain).zip(&white) {
            let (Some(g), Rendering::Color(plain), Rendering::Color(white)) =
                (mode.gains(&gains), plain, white)
            else {
                assert_eq!(plain, white, "{}", mode.name());
                continue;
            };
            let n = plain.pixels();
            let scaled: Vec<f32> = plain.data().iter().enumerate().map(|(i, v)| v * g[i / n]).collect();
            assert_eq!(white.data(), scaled, "{}", mode.name());
            assert_eq!(renderer.draw(&camera, mode).unwrap(), white, "{}", mode.name());
        }
    }
}
