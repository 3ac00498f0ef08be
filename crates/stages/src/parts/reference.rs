//! The stage 1 of the reference variant, which depth, masks and flow of all variants of a scene come from.

use use3d_capture::{Camera, Frame, Image, Map};
use use3d_render::{Mode, Rendering, SceneRenderer};
use use3d_workflow::StageError;

use crate::engines::Drawn;

/// The reference variant's stage 1, rendered from cameras of the scene that is scored. A variant that is
/// imported with other parameters may have another frame; both frames come from the same model.
pub(crate) struct Reference<'a> {
    renderer: SceneRenderer<'a>,
    /// The frame of the scored scene and that of the reference, if they differ.
    between: Option<[Frame; 2]>,
}

impl<'a> Reference<'a> {
    /// The reference for scenes in the frame `scored`.
    pub(crate) fn new(reference: &Drawn<'a>, scored: Frame) -> Result<Self, StageError> {
        let [from, to] = [scored, reference.scene.frame];
        Ok(Self { renderer: reference.renderer(1.0)?, between: (from != to).then_some([from, to]) })
    }

    /// Depth, in units of the scored scene, and the rendering at one of the scored scene's cameras.
    pub(crate) fn look(&mut self, camera: &Camera) -> Result<(Map, Image), StageError> {
        let (mut camera, mut unit) = (*camera, 1.0);
        if let Some([scored, reference]) = &self.between {
            camera.pose = reference.apply_pose(&scored.invert_pose(&camera.pose));
            unit = (scored.scale / reference.scale) as f32;
        }
        let (mut depth, mut image) = (Map::new(0, 0), Image::new(0, 0));
        for frame in self.renderer.render(&camera, &[Mode::Depth, Mode::Reconstruction])? {
            match frame {
                Rendering::Scalar(map) if unit == 1.0 => depth = map,
                Rendering::Scalar(map) => depth = map.map(|z| unit * z),
                Rendering::Color(rendered) => image = rendered,
            }
        }
        Ok((depth, image))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use use3d_capture::{Intrinsics, Pose};
    use use3d_medium::MediumModel;
    use use3d_scene::Scene;
    use use3d_splat::Gaussians;

    use crate::engines::EngineChoice;

    /// One Gaussian two COLMAP units in front of the origin, in a frame of that scale.
    fn scene(scale: f64) -> Scene {
        let gaussians = Gaussians {
            sh_degree: 0,
            means: vec![[0.0, 0.0, 2.0 * scale as f32]],
            log_scales: vec![[use3d_numerics::math::ln(0.2 * scale as f32); 3]],
            quaternions: vec![[1.0, 0.0, 0.0, 0.0]],
            opacity_logits: vec![4.0],
            sh: vec![[[0.5; 3]; 16]],
        };
        Scene {
            gaussians,
            frame: Frame { scale, ..Frame::IDENTITY },
            medium: MediumModel::None,
            medium_degree: 0,
            enhancement: None,
        }
    }

    #[test]
    fn a_reference_of_another_frame_is_seen_from_the_same_place_in_the_same_units() {
        let intrinsics = Intrinsics { width: 16, height: 12, fx: 12.0, fy: 12.0, cx: 8.0, cy: 6.0 };
        let camera = Camera { intrinsics, pose: Pose::IDENTITY };
        let (scored, other) = (scene(1.0), scene(0.25));
        let depth = |reference: &Scene| {
            let reference = Drawn::new(reference, &EngineChoice::Cpu).expect("the processor");
            let mut reference = Reference::new(&reference, scored.frame).map_err(|_| ()).expect("a renderer");
            reference.look(&camera).map_err(|_| ()).expect("a picture").0.pixel(8, 6)[0]
        };
        assert!((depth(&scored) - 2.0).abs() < 0.2, "{}", depth(&scored));
        assert!((depth(&other) - depth(&scored)).abs() < 1e-2, "{} {}", depth(&other), depth(&scored));
    }
}
