//! Computes the rows of a refined scene.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use use3d_numerics::math;
use use3d_numerics::random::{Purpose, Stream};
use use3d_splat::Gaussians;

/// Distance of a child from its parent's centre in a split of the long axis, in lengths of that half axis.
const APART: f64 = 0.45;
/// The half axis of a Gaussian, in standard deviations.
const HALF_AXIS: f64 = 3.0;
/// The factor by which children of a split of the long axis are less opaque.
const FAINTER: f64 = 0.6;

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

/// The places of the two children of a split.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Children {
    /// Both are drawn from the parent, and smaller than it by `shrink`.
    #[default]
    Drawn,
    /// They stand on both sides of the parent's centre on its longest axis, shorter and fainter than it.
    LongAxis,
}

/// The parameters of a child that are not its parent's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Child {
    /// Centre, scene units.
    pub mean: [f32; 3],
    /// Log standard deviations.
    pub log_scales: [f32; 3],
    /// Opacity logit.
    pub opacity_logit: f32,
}

/// The rule for the children of a refinement, with its random draws. It is the same in every engine.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Draws {
    /// The places of children.
    pub split: Children,
    /// Seed of the run.
    pub seed: u64,
    /// The step, from 0.
    pub step: u64,
    /// Factor by which drawn children of a split are smaller.
    pub shrink: f64,
}

impl Draws {
    /// The position of a drawn child in its parent, in standard deviations along the parent's axes.
    pub fn place(&self, parent: usize, child: usize) -> [f64; 3] {
        let stream = Stream::new(self.seed, SPLIT, self.step);
        std::array::from_fn(|axis| stream.normal((6 * parent + 3 * child + axis) as u64))
    }

    /// The difference between a parent's and a drawn child's log scales.
    pub fn smaller(&self) -> f32 {
        math::ln(self.shrink) as f32
    }

    /// Child 0 or 1 of a Gaussian. The colours in `gaussians` are not used.
    ///
    /// Children on the long axis stand at both sides of the parent's centre. With the parent's half axis
    /// `a = 3 s` and `o = 0.45`, their centres are at `± o a`, and a child
    ///
    /// ```text
    /// ends on the axis where the parent ends:                   s_long' = (1 − o) s_long
    /// is as thick as the parent's section through its centre:   s'      = √(1 − o²) s
    /// ```
    ///
    /// It has 0.6 of the opacity, since both overlap in the middle.
    pub fn child(&self, gaussians: &Gaussians, parent: usize, child: usize) -> Child {
        let log_scales = gaussians.log_scales[parent];
        let mut opacity_logit = gaussians.opacity_logits[parent];
        let (place, log_scales_of_child) = match self.split {
            Children::Drawn => (self.place(parent, child), log_scales.map(|s| s - self.smaller())),
            Children::LongAxis => {
                let long = (1..3)
                    .fold(0, |long, axis| if log_scales[axis] > log_scales[long] { axis } else { long });
                let mut place = [0.0; 3];
                place[long] = if child == 0 { -APART * HALF_AXIS } else { APART * HALF_AXIS };
                let across = 0.5 * math::ln(1.0 - APART * APART) as f32;
                let mut smaller = log_scales.map(|s| s + across);
                smaller[long] = log_scales[long] + math::ln(1.0 - APART) as f32;
                let opacity = FAINTER / (1.0 + math::exp(-f64::from(opacity_logit)));
                opacity_logit = math::ln(opacity / (1.0 - opacity)) as f32;
                (place, smaller)
            }
        };
        let local = std::array::from_fn(|axis| math::exp(f64::from(log_scales[axis])) * place[axis]);
        let offset = rotate(gaussians.quaternions[parent], local);
        let mean = std::array::from_fn(|axis| gaussians.means[parent][axis] + offset[axis] as f32);
        Child { mean, log_scales: log_scales_of_child, opacity_logit }
    }

    /// The factor by which the geometric mean of a child's standard deviations on the screen is smaller, of
    /// a Gaussian whose long axis lies in the picture.
    pub(super) fn shrinkage(&self) -> f64 {
        match self.split {
            Children::Drawn => self.shrink,
            Children::LongAxis => 1.0 / ((1.0 - APART) * (1.0 - APART * APART).sqrt()).sqrt(),
        }
    }
}

/// Makes the Gaussians of these rows: kept ones and twins unchanged, children in their parents and smaller.
pub fn rebuilt(gaussians: &Gaussians, rows: &[Origin], draws: &Draws) -> Gaussians {
    let sources: Vec<usize> = rows.iter().map(|row| row.source()).collect();
    let mut refined = gaussians.select(&sources);
    for (row, origin) in rows.iter().enumerate() {
        if let Origin::Child(parent, child) = *origin {
            let child = draws.child(gaussians, parent, child);
            (refined.means[row], refined.log_scales[row]) = (child.mean, child.log_scales);
            refined.opacity_logits[row] = child.opacity_logit;
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
