//! The choice of the engine that draws a scene's pictures: the processor, or a graphics card that holds the
//! scene.

use use3d_capture::Formation;
use use3d_reconstruct::EngineChoice;
use use3d_render::{Look, RenderError, SceneRenderer};
use use3d_scene::Scene;

use super::{CardError, Renderers, open};

/// A scene on the engine that draws it. Renderers made from it share the data on the card.
pub struct Drawn<'s> {
    /// The scene.
    pub scene: &'s Scene,
    renderers: Option<Renderers<'s>>,
    /// The name of the card that draws; `None` for the processor.
    pub card: Option<String>,
    /// A description of the engine that draws, with the reason if `auto` found no card.
    pub told: String,
}

impl<'s> Drawn<'s> {
    /// Loads a scene into the engine that will draw it. `auto` is the processor if there is no card.
    ///
    /// # Errors
    /// A card is missing, fails its check or cannot hold the scene.
    pub fn new(scene: &'s Scene, engine: &EngineChoice) -> Result<Self, CardError> {
        let kind = scene.medium.kind();
        let per_image = kind.formation() != Formation::PerGaussian;
        let beyond = per_image.then(|| CardError::Drawing(kind.name()));
        let chosen = match (engine, beyond) {
            (EngineChoice::Cpu, _) => Err(None),
            (EngineChoice::Auto, Some(why)) => Err(Some(why)),
            (EngineChoice::Auto, None) => open(None).map_err(|why| Some(why.into())),
            (EngineChoice::Gpu(_), Some(why)) => return Err(CardError::Requested(Box::new(why))),
            (EngineChoice::Gpu(name), None) => Ok(open(name.as_deref())?),
        };
        let name = chosen.as_ref().ok().map(|card| card.name());
        let told = match &chosen {
            Ok(card) => format!("gpu, {}", card.told()),
            Err(Some(why)) => format!("cpu ({why})"),
            Err(None) => "cpu".into(),
        };
        let renderers = chosen.ok().map(|card| card.renderers(scene)).transpose()?;
        Ok(Self { scene, renderers, card: name, told })
    }

    /// A renderer of every mode, with this strength of the enhancement.
    ///
    /// # Errors
    /// Fails for a strength outside `[0, 1]`.
    pub fn renderer(&self, strength: f32) -> Result<SceneRenderer<'s>, RenderError> {
        let Some(on) = &self.renderers else { return SceneRenderer::new(self.scene, strength) };
        let enhanced = match self.scene.enhancement {
            Some(_) => Some(on(Look::Enhanced { strength })?),
            None => None,
        };
        Ok(SceneRenderer::on(on(Look::Reconstruction)?, enhanced))
    }
}

#[cfg(all(test, feature = "gpu"))]
mod tests {
    use use3d_capture::{Appearance, Camera, Frame, Intrinsics, KeptWater, Pose};
    use use3d_medium::{MediumModel, MediumRbf};
    use use3d_numerics::random::{Purpose, Stream};
    use use3d_render::{Mode, Rendering};
    use use3d_splat::Gaussians;
    use use3d_ubaf::{Enhancement, Field, FieldBox, ObjectPass, Shape};

    use super::*;

    /// Gaussians in water, with an invented enhancement.
    fn scene() -> Scene {
        let draw = Stream::new(5, Purpose::new("a scene to draw"), 0);
        let normal = |i: usize, k: u64| draw.normal(64 * i as u64 + k) as f32;
        let mut gaussians = Gaussians::empty(3);
        for i in 0..300 {
            gaussians.means.push([0.5 * normal(i, 0), 0.4 * normal(i, 1), 2.0 + 0.4 * normal(i, 2)]);
            gaussians.log_scales.push(std::array::from_fn(|k| -2.5 + 0.5 * normal(i, 3 + k as u64)));
            gaussians.quaternions.push(std::array::from_fn(|k| normal(i, 6 + k as u64)));
            gaussians.opacity_logits.push(normal(i, 10));
            gaussians.sh.push(std::array::from_fn(|b| {
                std::array::from_fn(|c| 0.3 * normal(i, 11 + (3 * b + c) as u64))
            }));
        }
        let bounds = FieldBox::of_scene(&gaussians.means, &[]);
        let mut field = Field::identity(Shape::default(), bounds, 7).unwrap();
        let shape = field.shape();
        for i in shape.factors().chain(shape.output_weight()) {
            field.parameters[i] += 0.1 * draw.normal(1_000_000 + i as u64) as f32;
        }
        field.parameters[shape.transport()].copy_from_slice(&[-0.25, -0.1]);
        let mut pass = ObjectPass::new(&field, &gaussians.means, gaussians.sh.iter().map(|sh| sh[0]));
        pass.forward(&field);
        let enhancement = Enhancement {
            centre: pass.mean,
            field,
            appearance: Appearance::Water,
            kept_water: KeptWater::ALL,
        };
        Scene {
            gaussians,
            frame: Frame::IDENTITY,
            medium: MediumModel::Rbf(MediumRbf::new(8, 4)),
            medium_degree: 3,
            enhancement: Some(enhancement),
        }
    }

    /// The software card, if this machine has one.
    fn on_card(scene: &Scene) -> Option<Drawn<'_>> {
        match Drawn::new(scene, &EngineChoice::Gpu(Some("llvmpipe".into()))) {
            Ok(drawn) => Some(drawn),
            Err(error) => {
                assert!(std::env::var("USE3D_REQUIRE_GPU").as_deref() != Ok("1"), "{error}");
                eprintln!("SKIPPED, no software adapter (package mesa-vulkan-drivers): {error}");
                None
            }
        }
    }

    #[test]
    fn every_mode_is_drawn_on_a_card_as_on_the_processor() {
        let scene = scene();
        let Some(card) = on_card(&scene) else { return };
        assert!(card.told.contains("gpu, llvmpipe"), "{}", card.told);
        let cpu = Drawn::new(&scene, &EngineChoice::Cpu).unwrap();
        assert_eq!(cpu.told, "cpu");
        let intrinsics = Intrinsics { width: 72, height: 50, fx: 60.0, fy: 62.0, cx: 35.0, cy: 26.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let values = |frame: &Rendering| match frame {
            Rendering::Color(image) => image.data().to_vec(),
            Rendering::Scalar(map) => map.data().to_vec(),
        };
        for (strength, water) in [(1.0, 1.0), (0.6, 0.4)] {
            let draw = |drawn: &Drawn<'_>| {
                let mut renderer = drawn.renderer(strength).unwrap().with_water(water).unwrap();
                renderer.render(&camera, &Mode::ALL).unwrap()
            };
            for ((mode, found), expected) in Mode::ALL.iter().zip(draw(&card)).zip(draw(&cpu)) {
                let (found, expected) = (values(&found), values(&expected));
                let norm = |v: &mut dyn Iterator<Item = f32>| {
                    v.map(|v| f64::from(v) * f64::from(v)).sum::<f64>().sqrt()
                };
                let off = norm(&mut found.iter().zip(&expected).map(|(a, b)| a - b));
                let size = norm(&mut expected.iter().copied());
                assert_eq!(found.len(), expected.len());
                assert!(size > 0.0 && off <= 1e-5 * size, "{} off by {:.1e}", mode.name(), off / size);
            }
        }
    }

    #[test]
    fn water_over_finished_images_is_drawn_by_the_processor() {
        let water = MediumModel::Image(use3d_medium::MediumGlobal::default());
        let scene = Scene { medium: water, enhancement: None, ..scene() };
        let told = Drawn::new(&scene, &EngineChoice::Auto).unwrap();
        assert!(told.told.contains("cpu (the water `image`"), "{}", told.told);
        let said = Drawn::new(&scene, &EngineChoice::Gpu(None)).err().unwrap().to_string();
        assert!(said.contains("`image`") && said.contains("--engine cpu"), "{said}");
    }

    #[test]
    fn a_card_that_is_not_there_is_refused_by_name() {
        let scene = scene();
        let said = Drawn::new(&scene, &EngineChoice::Gpu(Some("no such card".into()))).err().unwrap();
        let said = said.to_string();
        assert!(said.contains("no such card"), "{said}");
    }
}
