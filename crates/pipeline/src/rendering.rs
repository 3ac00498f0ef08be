//! Every picture a scene can give, for one camera at a time.
//!
//! `reconstruction` is stage 1 with its water, `clear` its object radiance without water. `enhanced` is stage 2's full composite,
//! `enhanced-clear` its object radiance without water. No 2D network is involved: the enhancement is in the scene. How much of the
//! water is left in `reconstruction` and `enhanced` is a matter of the moment ([`SceneRenderer::with_water`]).

use use3d_capture::{Camera, Image, Lattice, Map, MediumMaps, Pose};
use use3d_enhance::{EnhanceError, Look, Renderer};
use use3d_medium::MediumModel;
use use3d_numerics::math;
use use3d_scene::Scene;
use use3d_splat::{Layers, Rendered};

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
    /// Expected depth along the optical axis, scene units; 0 where nothing is.
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

    /// The mode of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|m| m.name() == name)
    }

    /// Whether it shows stage 2.
    pub fn is_enhanced(self) -> bool {
        matches!(self, Self::Enhanced | Self::EnhancedClear)
    }

    /// Whether [`SceneRenderer::with_water`] changes it.
    pub fn shows_water(self) -> bool {
        matches!(self, Self::Reconstruction | Self::Enhanced | Self::Object | Self::Medium)
    }

    fn needs_layers(self) -> bool {
        matches!(self, Self::Clear | Self::EnhancedClear | Self::Object | Self::Medium)
    }
}

/// What a mode gives.
#[derive(Clone, Debug, PartialEq)]
pub enum Frame {
    /// A colour image, unclamped.
    Color(Image),
    /// One number per pixel.
    Scalar(Map),
}

/// A scene ready to be rendered from many cameras.
pub struct SceneRenderer<'a> {
    plain: Renderer<'a>,
    enhanced: Option<Renderer<'a>>,
    rendered: Rendered,
}

impl<'a> SceneRenderer<'a> {
    /// Prepares a scene; `strength` in `[0, 1]` is how much of its enhancement, if it has one, `enhanced` and `enhanced-clear` show.
    ///
    /// # Errors
    /// A strength outside that range.
    pub fn new(scene: &'a Scene, strength: f32) -> Result<Self, EnhanceError> {
        let enhanced = match scene.enhancement {
            Some(_) => Some(Renderer::new(scene, Look::Enhanced { strength })?),
            None => None,
        };
        Ok(Self { plain: Renderer::new(scene, Look::Reconstruction)?, enhanced, rendered: Rendered::new() })
    }

    /// Leaves only a share of the water, in `[0, 1]`, in `reconstruction`, its parts `object` and `medium`, and `enhanced`: at 0 these are
    /// `clear` and `enhanced-clear`. Coefficients are shown as they are.
    ///
    /// # Errors
    /// A share outside that range.
    pub fn with_water(self, water: f32) -> Result<Self, EnhanceError> {
        let Self { plain, enhanced, rendered } = self;
        let enhanced = enhanced.map(|renderer| renderer.with_water(water)).transpose()?;
        Ok(Self { plain: plain.with_water(water)?, enhanced, rendered })
    }

    /// Whether the scene can show [`Mode::Enhanced`] and [`Mode::EnhancedClear`].
    pub fn is_enhanced(&self) -> bool {
        self.enhanced.is_some()
    }

    /// Renders `modes` from a camera in the scene's normalised frame, in the order asked for. `Enhanced` and `EnhancedClear` of a scene
    /// without an enhancement are its reconstruction and its clear rendering.
    pub fn render(&mut self, camera: &Camera, modes: &[Mode]) -> Vec<Frame> {
        let lattice = Lattice::full(&camera.intrinsics);
        let mut frames: Vec<Option<Frame>> = vec![None; modes.len()];
        if let Some(enhanced) = &mut self.enhanced {
            let wanted = |mode| modes.contains(&mode);
            match (wanted(Mode::Enhanced), wanted(Mode::EnhancedClear)) {
                (false, false) => {}
                (false, true) => enhanced.render_clear(camera, &lattice, &mut self.rendered),
                (true, clear) => enhanced.render(camera, &lattice, clear, &mut self.rendered),
            }
            let Rendered { image, layers, .. } = &self.rendered;
            for (frame, mode) in frames.iter_mut().zip(modes).filter(|(_, mode)| mode.is_enhanced()) {
                // Rendered without water, the picture has no layers and is itself clear.
                let clear = layers.as_ref().map_or(image, |layers| &layers.clear);
                let shown = if *mode == Mode::Enhanced { image } else { clear };
                *frame = Some(Frame::Color(shown.clone()));
            }
        }
        if frames.iter().any(Option::is_none) {
            let layers = modes.iter().any(|m| m.needs_layers());
            self.plain.render(camera, &lattice, layers, &mut self.rendered);
        }
        frames
            .into_iter()
            .zip(modes)
            .map(|(frame, mode)| frame.unwrap_or_else(|| self.frame(*mode)))
            .collect()
    }

    /// Draws `Clear`, `Enhanced`, `EnhancedClear` or, for any other mode, `Reconstruction`, and lends the image: a frame at the least cost.
    pub fn draw(&mut self, camera: &Camera, mode: Mode) -> &Image {
        let renderer = match &mut self.enhanced {
            Some(enhanced) if mode.is_enhanced() => enhanced,
            _ => &mut self.plain,
        };
        let lattice = Lattice::full(&camera.intrinsics);
        match mode {
            Mode::Clear | Mode::EnhancedClear => renderer.render_clear(camera, &lattice, &mut self.rendered),
            _ => renderer.render(camera, &lattice, false, &mut self.rendered),
        }
        &self.rendered.image
    }

    /// One colour image; a convenience over [`SceneRenderer::render`].
    pub fn color(&mut self, camera: &Camera, mode: Mode) -> Image {
        match self.render(camera, &[mode]).pop() {
            Some(Frame::Color(image)) => image,
            Some(Frame::Scalar(map)) => spread(&map),
            None => Image::new(0, 0),
        }
    }

    fn frame(&self, mode: Mode) -> Frame {
        let rendered = &self.rendered;
        let none = || Image::new(rendered.image.width(), rendered.image.height());
        let layer = |pick: fn(&Layers) -> &Image| {
            Frame::Color(rendered.layers.as_ref().map_or_else(none, |l| pick(l).clone()))
        };
        let water = |pick: fn(&MediumMaps) -> &Image| {
            Frame::Color(self.plain.medium().map_or_else(none, |maps| pick(maps).clone()))
        };
        match mode {
            Mode::Reconstruction | Mode::Enhanced => Frame::Color(rendered.image.clone()),
            Mode::Clear | Mode::EnhancedClear => layer(|l| &l.clear),
            Mode::Object => layer(|l| &l.object),
            Mode::Medium => {
                let mut sum = rendered.layers.as_ref().map_or_else(none, |l| l.medium.clone());
                if let Some(layers) = &rendered.layers {
                    for (s, f) in sum.data_mut().iter_mut().zip(layers.far.data()) {
                        *s += f;
                    }
                }
                Frame::Color(sum)
            }
            Mode::Depth => Frame::Scalar(rendered.depth.clone()),
            Mode::Alpha => Frame::Scalar(rendered.accumulation.clone()),
            Mode::Backscatter => water(|maps| &maps.backscatter),
            Mode::Attenuation => water(|maps| &maps.attenuation),
        }
    }
}

/// A map as a grey image.
fn spread(map: &Map) -> Image {
    let mut image = Image::new(map.width(), map.height());
    let n = map.pixels();
    for c in 0..3 {
        image.data_mut()[c * n..(c + 1) * n].copy_from_slice(map.data());
    }
    image
}

/// A map for people: near is bright, far is deep blue, unknown (0) is black; scaled between the 2 % and 98 % quantiles of its
/// positive values.
pub fn depth_picture(depth: &Map) -> Image {
    let mut known: Vec<f32> = depth.data().iter().copied().filter(|d| d.is_finite() && *d > 0.0).collect();
    let mut image = Image::new(depth.width(), depth.height());
    if known.is_empty() {
        return image;
    }
    known.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| known[((known.len() - 1) as f64 * share) as usize];
    let (near, far) = (at(0.02), at(0.98).max(at(0.02) * 1.0001));
    // Inverse depth: what the eye reads as distance.
    let scale = |d: f32| ((1.0 / d - 1.0 / far) / (1.0 / near - 1.0 / far)).clamp(0.0, 1.0);
    for y in 0..depth.height() {
        for x in 0..depth.width() {
            let [d] = depth.pixel(x, y);
            if d.is_finite() && d > 0.0 {
                image.set_pixel(x, y, ramp(scale(d)));
            }
        }
    }
    image
}

/// Dark blue over teal and sand to pale yellow; lightness rises evenly.
fn ramp(t: f32) -> [f32; 3] {
    const STOPS: [[f32; 3]; 5] =
        [[0.03, 0.05, 0.22], [0.06, 0.28, 0.47], [0.13, 0.55, 0.55], [0.62, 0.76, 0.45], [0.99, 0.95, 0.70]];
    let place = t.clamp(0.0, 1.0) * (STOPS.len() - 1) as f32;
    let i = (place as usize).min(STOPS.len() - 2);
    let f = place - i as f32;
    std::array::from_fn(|c| STOPS[i][c] * (1.0 - f) + STOPS[i + 1][c] * f)
}

/// Coefficients for people: divided by the largest value of the image, so that the hue shows which channel the water takes.
pub fn coefficient_picture(map: &Image) -> Image {
    let most = map.data().iter().copied().filter(|v| v.is_finite()).fold(1e-6f32, f32::max);
    map.map(|v| v / most)
}

/// The water along one ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WaterSample {
    /// Where: the angle from the optical axis in degrees (right is positive), or the camera's place in its list.
    pub at: f64,
    /// `c_m`.
    pub color: [f32; 3],
    /// `β_bs`, per normalised scene unit.
    pub backscatter: [f32; 3],
    /// `β_attn`, per normalised scene unit.
    pub attenuation: [f32; 3],
}

/// The water along the rays of the row through an image's middle; `None` for a scene without water.
pub fn medium_profile(medium: &MediumModel, degree: usize, camera: &Camera) -> Option<Vec<WaterSample>> {
    if medium.is_none() {
        return None;
    }
    let k = &camera.intrinsics;
    let mut columns: Vec<usize> = (0..64).map(|i| i * k.width / 64).collect();
    columns.dedup();
    let lattice = Lattice::subset(&columns, &[k.height / 2])?;
    let mut maps = MediumMaps::zeros(0, 0);
    medium.maps(camera, &lattice, degree, &mut maps);
    let samples = lattice.columns().iter().enumerate().map(|(i, &u)| WaterSample {
        at: math::atan((f64::from(u) - k.cx) / k.fx).to_degrees(),
        color: maps.color.pixel(i, 0),
        backscatter: maps.backscatter.pixel(i, 0),
        attenuation: maps.attenuation.pixel(i, 0),
    });
    Some(samples.collect())
}

/// The water at the places of cameras, along the optical axis of the first; `None` for a scene without water, or without cameras.
pub fn medium_along(medium: &MediumModel, degree: usize, cameras: &[Camera]) -> Option<Vec<WaterSample>> {
    let first = cameras.first()?;
    if medium.is_none() {
        return None;
    }
    let k = &first.intrinsics;
    let lattice = Lattice::subset(&[k.width / 2], &[k.height / 2])?;
    let mut maps = MediumMaps::zeros(0, 0);
    let samples = cameras.iter().enumerate().map(|(i, camera)| {
        let pose = Pose::from_center(first.pose.rotation, camera.pose.center());
        medium.maps(&Camera { intrinsics: *k, pose }, &lattice, degree, &mut maps);
        WaterSample {
            at: i as f64,
            color: maps.color.pixel(0, 0),
            backscatter: maps.backscatter.pixel(0, 0),
            attenuation: maps.attenuation.pixel(0, 0),
        }
    });
    Some(samples.collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Frame as FrameOf, Intrinsics};
    use use3d_medium::MediumRbf;
    use use3d_splat::Gaussians;

    /// A Gaussian two units ahead in water, not enhanced.
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
            frame: FrameOf::IDENTITY,
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
        let frames = whole.render(&camera, &Mode::ALL);
        let of =
            |frames: &[Frame], mode: Mode| frames[Mode::ALL.iter().position(|m| *m == mode).unwrap()].clone();
        assert_ne!(of(&frames, Mode::Reconstruction), of(&frames, Mode::Clear));
        // Nothing is enhanced here.
        assert_eq!(of(&frames, Mode::Enhanced), of(&frames, Mode::Reconstruction));
        assert_eq!(of(&frames, Mode::EnhancedClear), of(&frames, Mode::Clear));
        for mode in [Mode::Reconstruction, Mode::Clear, Mode::Enhanced, Mode::EnhancedClear] {
            assert_eq!(Frame::Color(whole.draw(&camera, mode).clone()), of(&frames, mode), "{}", mode.name());
        }
        let mut none = SceneRenderer::new(&scene, 1.0).unwrap().with_water(0.0).unwrap();
        let dry = none.render(&camera, &Mode::ALL);
        for mode in Mode::ALL {
            let same = of(&dry, mode) == of(&frames, mode);
            assert_eq!(same, !mode.shows_water(), "{}", mode.name());
        }
        assert_eq!(of(&dry, Mode::Reconstruction), of(&frames, Mode::Clear));
        assert!(SceneRenderer::new(&scene, 1.0).unwrap().with_water(1.01).is_err());
    }

    #[test]
    fn the_water_changes_along_the_cameras_as_its_anchors_do() {
        let mut rbf = MediumRbf::new(8, 4);
        for (i, anchor) in rbf.coefficients.iter_mut().enumerate() {
            anchor[2][0] = [0.2 * i as f32 - 1.0; 3];
        }
        let intrinsics = Intrinsics { width: 8, height: 6, fx: 8.0, fy: 8.0, cx: 4.0, cy: 3.0 };
        let at = |x: f64| {
            let mut pose = Pose::IDENTITY;
            pose.translation.x = -x;
            Camera { intrinsics, pose }
        };
        let cameras = [at(-0.9), at(0.9), at(-0.9)];
        let samples = medium_along(&MediumModel::Rbf(rbf), 3, &cameras).expect("water");
        assert_eq!(samples[0].attenuation, samples[2].attenuation);
        assert_ne!(samples[0].attenuation, samples[1].attenuation, "MediumRBF depends on the position");
        assert!(medium_along(&MediumModel::None, 3, &cameras).is_none());
    }
}
