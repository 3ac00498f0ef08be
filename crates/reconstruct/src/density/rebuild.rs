//! Computes the rows of a refined scene.

use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::Gaussians;

/// The purpose of the random draws for children.
const SPLIT: Purpose = Purpose::new("split Gaussians");

/// The origin of a row of the refined scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// An existing Gaussian, with its moments.
    Kept(usize),
    /// A twin of a Gaussian.
    Twin(usize),
    /// A child of a split: 0 or 1.
    Child(usize, usize),
}

impl Origin {
    /// Index of the Gaussian that it is, or from which it is made.
    pub fn source(self) -> usize {
        match self {
            Self::Kept(i) | Self::Twin(i) | Self::Child(i, _) => i,
        }
    }
}

/// The random draws for the children of a refinement; they are the same in every engine.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Draws {
    /// Seed of the run.
    pub seed: u64,
    /// The step, from 0.
    pub step: u64,
    /// Factor by which the children of a split are smaller.
    pub shrink: f64,
}

impl Draws {
    /// The position of a child in its parent, in standard deviations along the parent's axes.
    pub fn place(&self, parent: usize, child: usize) -> [f64; 3] {
        let stream = Stream::new(self.seed, SPLIT, self.step);
        std::array::from_fn(|axis| stream.normal((6 * parent + 3 * child + axis) as u64))
    }

    /// The difference between a parent's and a child's log scales.
    pub fn smaller(&self) -> f32 {
        math::ln(self.shrink) as f32
    }

    /// Mean (scene units) and log scales of child 0 or 1 of a Gaussian. All other parameters are the
    /// parent's. The colours in `gaussians` are not used.
    pub fn child(&self, gaussians: &Gaussians, parent: usize, child: usize) -> ([f32; 3], [f32; 3]) {
        let (place, smaller) = (self.place(parent, child), self.smaller());
        let (mean, log_scales) = (gaussians.means[parent], gaussians.log_scales[parent]);
        let local = std::array::from_fn(|axis| math::exp(f64::from(log_scales[axis])) * place[axis]);
        let offset = rotate(gaussians.quaternions[parent], local);
        let mean = std::array::from_fn(|axis| mean[axis] + offset[axis] as f32);
        (mean, log_scales.map(|s| s - smaller))
    }
}

/// Makes the Gaussians of these rows: kept ones and twins unchanged, children drawn from their parents and
/// smaller.
pub fn rebuilt(gaussians: &Gaussians, rows: &[Origin], draws: &Draws) -> Gaussians {
    let sources: Vec<usize> = rows.iter().map(|row| row.source()).collect();
    let mut refined = gaussians.select(&sources);
    for (row, origin) in rows.iter().enumerate() {
        if let Origin::Child(parent, child) = *origin {
            (refined.means[row], refined.log_scales[row]) = draws.child(gaussians, parent, child);
        }
    }
    refined
}

/// Computes `R(q) x` for a quaternion of any length.
pub(super) fn rotate(q: [f32; 4], x: [f64; 3]) -> [f64; 3] {
    let q = glam::DQuat::from_xyzw(q[1].into(), q[2].into(), q[3].into(), q[0].into());
    let norm = q.length();
    if norm == 0.0 { x } else { ((q * (1.0 / norm)) * glam::DVec3::from(x)).to_array() }
}
