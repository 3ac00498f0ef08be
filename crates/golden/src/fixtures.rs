//! Inputs that many cases share: cameras and Gaussians.

use glam::{DMat3, DVec3};
use use3d_capture::{Camera, Intrinsics, Pose};

use crate::Case;

/// Gaussians of a case, array by array: the crate with a type for them depends on this one.
#[derive(Clone, Debug)]
pub struct CaseGaussians {
    /// `in.means`, `[N, 3]`.
    pub means: Vec<[f32; 3]>,
    /// `in.log_scales`, `[N, 3]`.
    pub log_scales: Vec<[f32; 3]>,
    /// `in.quats`, `[N, 4]`, wxyz.
    pub quaternions: Vec<[f32; 4]>,
    /// `in.opacity_logits`, `[N]`.
    pub opacity_logits: Vec<f32>,
    /// `in.sh`, `[N, 16, 3]`; zeros where a case has no colours.
    pub sh: Vec<[[f32; 3]; 16]>,
}

impl Case<'_> {
    /// The intrinsics in its configuration: `width`, `height`, `fx`, `fy`, `cx`, `cy`.
    pub fn intrinsics(&self) -> Intrinsics {
        Intrinsics {
            width: self.count("width"),
            height: self.count("height"),
            fx: self.number("fx"),
            fy: self.number("fy"),
            cx: self.number("cx"),
            cy: self.number("cy"),
        }
    }

    /// Rotation from world to camera for each of its cameras: `in.R_cw`, row-major.
    pub fn rotations(&self) -> Vec<DMat3> {
        let flat = self.f64("in.R_cw");
        flat.chunks_exact(9).map(|rows| DMat3::from_cols_slice(rows).transpose()).collect()
    }

    /// Its cameras: `in.R_cw` and `in.t_cw`, with the intrinsics, which they share.
    pub fn cameras(&self) -> Vec<Camera> {
        let (intrinsics, translations) = (self.intrinsics(), self.f64("in.t_cw"));
        let poses = self.rotations().into_iter().zip(translations.chunks_exact(3));
        poses
            .map(|(rotation, t)| Camera {
                intrinsics,
                pose: Pose { rotation, translation: DVec3::from_slice(t) },
            })
            .collect()
    }

    /// Its only camera.
    pub fn camera(&self) -> Camera {
        let [camera] = self.cameras()[..] else { panic!("{}: not one camera", self.name()) };
        camera
    }

    /// Its Gaussians.
    pub fn gaussians(&self) -> CaseGaussians {
        let means = self.rows::<3>("in.means");
        let colors = |row: &[f32; 48]| std::array::from_fn(|k| std::array::from_fn(|c| row[3 * k + c]));
        let sh = match self.has("in.sh") {
            true => self.rows::<48>("in.sh").iter().map(colors).collect(),
            false => vec![[[0.0; 3]; 16]; means.len()],
        };
        CaseGaussians {
            means,
            log_scales: self.rows("in.log_scales"),
            quaternions: self.rows("in.quats"),
            opacity_logits: self.f32("in.opacity_logits"),
            sh,
        }
    }
}
