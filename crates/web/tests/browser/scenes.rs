//! Small scenes for the browser: Gaussians of every shape in front of a camera, each kind of water, and an
//! enhancement in which every part has an effect.

use glam::{DMat3, DVec3};
use use3d_capture::{Appearance, Camera, Frame, Intrinsics, KeptWater, Pose};
use use3d_medium::{MediumGlobal, MediumMlp, MediumModel, MediumRbf};
use use3d_numerics::random::{Purpose, Stream};
use use3d_scene::Scene;
use use3d_splat::Gaussians;
use use3d_ubaf::{Enhancement, Field, FieldBox, ObjectPass, Shape};

/// Number of Gaussians in a scene.
const COUNT: usize = 700;

/// A sequence of random numbers.
pub(crate) struct Draws(Stream, u64);

impl Draws {
    pub(crate) fn new(name: &'static str, seed: u64) -> Self {
        Self(Stream::new(seed, Purpose::new(name), 0), 0)
    }

    pub(crate) fn normal(&mut self) -> f32 {
        self.1 += 1;
        self.0.normal(self.1) as f32
    }

    pub(crate) fn uniform(&mut self) -> f32 {
        self.1 += 1;
        self.0.uniform(self.1) as f32
    }
}

fn gaussians() -> Gaussians {
    let mut draw = Draws::new("web scene", 11);
    let mut out = Gaussians::empty(3);
    for _ in 0..COUNT {
        out.means.push([draw.normal() * 0.7, draw.normal() * 0.6, draw.normal() * 0.4]);
        // Discs, needles and balls, from one centimetre to a tenth of the scene.
        out.log_scales.push(std::array::from_fn(|_| -3.2 + 0.7 * draw.normal()));
        out.quaternions.push(std::array::from_fn(|_| draw.normal()));
        out.opacity_logits.push(1.5 * draw.normal());
        let mut sh = [[0.0; 3]; 16];
        for (k, band) in sh.iter_mut().enumerate() {
            let size = if k == 0 { 0.9 } else { 0.12 };
            band.iter_mut().for_each(|v| *v = size * draw.normal());
        }
        out.sh.push(sh);
    }
    out
}

/// The waters by name, with coefficients such as a training finds.
pub(crate) fn water(kind: &str) -> MediumModel {
    let mut draw = Draws::new("web water", 5);
    let mut wild = |coefficients: &mut use3d_medium::Coefficients| {
        for (q, quantity) in coefficients.iter_mut().enumerate() {
            for (b, band) in quantity.iter_mut().enumerate() {
                band.iter_mut().for_each(|v| *v += if b == 0 { 0.3 } else { 0.15 } * draw.normal());
            }
            let start = if q == 0 { [-1.2, 0.1, 0.5] } else { [0.4, -0.6, -1.2] };
            if q > 0 {
                quantity[0] = [0.0; 3];
            }
            quantity[0].iter_mut().zip(start).for_each(|(v, s)| *v += s);
        }
    };
    match kind {
        "global" => {
            let mut global = MediumGlobal::default();
            wild(&mut global.coefficients);
            MediumModel::Global(global)
        }
        "rbf" => {
            let mut rbf = MediumRbf::new(8, 4);
            rbf.coefficients.iter_mut().for_each(&mut wild);
            MediumModel::Rbf(rbf)
        }
        "mlp" => MediumModel::Mlp(MediumMlp::new(3)),
        _ => MediumModel::None,
    }
}

/// A scene with that water, in a frame of its own, with an enhancement in which every parameter has an
/// effect.
pub(crate) fn scene(kind: &str, degree: usize) -> Scene {
    let mut gaussians = gaussians();
    gaussians.sh_degree = degree;
    let bounds = FieldBox::of_scene(&gaussians.means, &[]);
    let mut field = Field::identity(Shape::default(), bounds, 7).expect("a field");
    let mut draw = Draws::new("web enhancement", 9);
    let shape = field.shape();
    for i in shape.factors().chain(shape.output_weight()) {
        field.parameters[i] += 0.12 * draw.normal();
    }
    let affine = [0.35, 0.05, 0.0, 0.02, 0.0, 0.15, 0.0, -0.02, -0.05, 0.0, -0.1, 0.0];
    field.parameters[shape.affine()].copy_from_slice(&affine);
    field.parameters[shape.transport()].copy_from_slice(&[-0.25, 0.1]);
    let mut pass = ObjectPass::new(&field, &gaussians.means, gaussians.sh.iter().map(|sh| sh[0]));
    pass.forward(&field);
    let enhancement = Some(Enhancement {
        centre: pass.mean,
        field,
        appearance: Appearance::Water,
        kept_water: KeptWater::ALL,
    });
    let frame = Frame {
        scale: 0.4,
        rotation: DMat3::from_axis_angle(DVec3::new(0.48, -0.6, 0.64).normalize(), 1.1),
        translation: DVec3::new(0.3, -0.2, 0.9),
    };
    Scene { gaussians, frame, medium: water(kind), medium_degree: 3, enhancement }
}

/// Cameras around the scene, near and far, level and rolled, with principal points off the middle of the
/// picture.
pub(crate) fn cameras(count: usize, width: usize, height: usize) -> Vec<Camera> {
    let mut draw = Draws::new("web cameras", 2);
    (0..count)
        .map(|i| {
            let (w, h) = (width as f64, height as f64);
            let f = w * (0.6 + 0.8 * f64::from(draw.uniform()));
            let [cx, cy] = [w, h].map(|side| side * (0.5 + 0.08 * f64::from(draw.normal())));
            let intrinsics = Intrinsics { width, height, fx: f, fy: 1.02 * f, cx, cy };
            let side = DVec3::new(
                f64::from(draw.normal()),
                f64::from(draw.normal()),
                0.6 * f64::from(draw.normal()),
            );
            let eye = side.normalize_or(DVec3::X) * if i % 4 == 0 { 0.9 } else { 2.0 };
            let up = if i % 3 == 0 { DVec3::new(0.3, 0.2, 1.0) } else { DVec3::Z };
            let target = 0.2 * DVec3::new(f64::from(draw.normal()), f64::from(draw.normal()), 0.0);
            Camera { intrinsics, pose: Pose::look_at(eye, target, up) }
        })
        .collect()
}
