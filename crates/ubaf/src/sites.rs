//! Where each Gaussian looks the field up: everything about it that is constant in Stage 2.
//!
//! Positions do not move, so the nodes and fractions on the x, y and z grids are found once; the guide coordinate depends on
//! the learned `w, b`, so only the signed logs `h(c̄)` of the colour are stored. 27 bytes per Gaussian.

use use3d_numerics::spherical_harmonics::C0;

use crate::field_box::FieldBox;
use crate::guide::{locate, signed_log};

/// Lanes of the kernels.
pub(crate) const LANES: usize = 16;
/// Gaussians per block: the unit of parallel work and of fixed-order sums. A multiple of [`LANES`].
pub(crate) const BLOCK: usize = 2048;

/// The constant part of every Gaussian's lookup, padded to whole lanes with harmless entries.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Sites {
    len: usize,
    /// Lower node on the x, y, z grids.
    pub(crate) nodes: Vec<[u8; 3]>,
    /// Fraction towards the next node, `[0, 1]`.
    pub(crate) fractions: Vec<[f32; 3]>,
    /// Signed logs of the guide colour, three planes of `padded()` values.
    pub(crate) signed_logs: [Vec<f32>; 3],
}

impl Sites {
    /// Sites of points with guide colours `c̄`, for a grid of `resolution` nodes per axis.
    pub(crate) fn new(
        points: impl ExactSizeIterator<Item = ([f32; 3], [f32; 3])>,
        bounds: &FieldBox,
        resolution: usize,
    ) -> Self {
        let len = points.len();
        let padded = len.div_ceil(LANES) * LANES;
        let mut out = Self {
            len,
            nodes: vec![[0; 3]; padded],
            fractions: vec![[0.0; 3]; padded],
            signed_logs: std::array::from_fn(|_| vec![0.0; padded]),
        };
        for (i, (position, color)) in points.enumerate() {
            let u = bounds.normalise(position);
            for axis in 0..3 {
                let (node, fraction) = locate(u[axis], resolution);
                out.nodes[i][axis] = node as u8;
                out.fractions[i][axis] = fraction;
                out.signed_logs[axis][i] = signed_log(color[axis]);
            }
        }
        out
    }

    /// Number of real sites.
    pub(crate) fn len(&self) -> usize {
        self.len
    }

    /// Number of blocks.
    pub(crate) fn blocks(&self) -> usize {
        self.len.div_ceil(BLOCK)
    }
}

/// The guide colour of a Gaussian: `c̄ = 0.5 + C₀ · (SH band 0)`, unclamped.
#[inline]
pub fn guide_color(sh_dc: [f32; 3]) -> [f32; 3] {
    sh_dc.map(|v| C0.mul_add(v, 0.5))
}
