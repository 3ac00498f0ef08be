//! The coordinates of each Gaussian's lookup: everything about it that is constant in stage 2.
//!
//! Positions do not move, so the nodes and fractions on the x, y and z grids are computed once. The guide
//! coordinate depends on the learned `w, b`, so only the signed logs `h(c̄)` of the colour are stored. This
//! takes 27 bytes per Gaussian.
//!
//! The first [`Sites::centred`] of them define the constant mode that is removed. By default these are all
//! of a scene's Gaussians. With [`Sites::select`] a training step uses only the Gaussians that its view
//! sees and those that define the mean.

use use3d_numerics::spherical_harmonics::C0;

use crate::field_box::FieldBox;
use crate::guide::{locate, signed_log};

/// Lanes of the kernels.
pub(crate) const LANES: usize = 16;
/// Gaussians per block: the unit of parallel work and of fixed-order sums. A multiple of [`LANES`].
pub(crate) const BLOCK: usize = 2048;

/// The constant part of every Gaussian's lookup, padded to whole lanes with harmless entries.
#[derive(Clone, Debug, PartialEq)]
pub struct Sites {
    len: usize,
    /// Number of sites, from the first, that define the mean.
    pub(crate) centred: usize,
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
        let mut out = Self::blank(len, len);
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

    fn blank(len: usize, centred: usize) -> Self {
        let padded = len.div_ceil(LANES) * LANES;
        Self {
            len,
            centred,
            nodes: vec![[0; 3]; padded],
            fractions: vec![[0.0; 3]; padded],
            signed_logs: std::array::from_fn(|_| vec![0.0; padded]),
        }
    }

    /// Selects some of these sites, in the order of `indices`; the first `centred` of them define the mean.
    ///
    /// # Panics
    ///
    /// Panics if an index is not below [`Sites::len`], or if `centred` exceeds the number of indices.
    pub fn select(&self, indices: &[u32], centred: usize) -> Self {
        assert!(centred <= indices.len(), "{centred} of {} sites cannot define the mean", indices.len());
        let mut out = Self::blank(indices.len(), centred);
        for (to, &from) in indices.iter().enumerate() {
            let from = from as usize;
            assert!(from < self.len, "site {from} of {}", self.len);
            out.nodes[to] = self.nodes[from];
            out.fractions[to] = self.fractions[from];
            for (to_plane, plane) in out.signed_logs.iter_mut().zip(&self.signed_logs) {
                to_plane[to] = plane[from];
            }
        }
        out
    }

    /// Number of sites without padding.
    pub fn len(&self) -> usize {
        self.len
    }

    /// True if there are no sites.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// The data of site `i`: its lower nodes on the x, y, z grids, the fractions towards the next nodes in
    /// `[0, 1]`, and the signed logs of its guide colour. An engine on another device copies them.
    ///
    /// # Panics
    ///
    /// Panics if `i` is not below [`Sites::len`].
    pub fn site(&self, i: usize) -> ([u8; 3], [f32; 3], [f32; 3]) {
        assert!(i < self.len, "site {i} of {}", self.len);
        (self.nodes[i], self.fractions[i], std::array::from_fn(|c| self.signed_logs[c][i]))
    }

    /// Number of bytes held.
    pub fn bytes(&self) -> usize {
        self.nodes.len() * (size_of::<[u8; 3]>() + size_of::<[f32; 3]>() + 3 * size_of::<f32>())
    }

    /// Number of blocks.
    pub(crate) fn blocks(&self) -> usize {
        self.len.div_ceil(BLOCK)
    }
}

/// The guide colour of a Gaussian: `c̄ = 0.5 + C₀ · (SH band 0)`, unclamped.
#[inline]
pub(crate) fn guide_color(sh_dc: [f32; 3]) -> [f32; 3] {
    sh_dc.map(|v| C0.mul_add(v, 0.5))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_site_has_its_nodes_its_fractions_and_its_colour() {
        let bounds = FieldBox { low: [0.0; 3], high: [4.0; 3] };
        let points = [([0.0; 3], [0.5; 3]), ([1.0, 2.5, 4.0], [0.1, -0.2, 0.3])];
        let sites = Sites::new(points.into_iter(), &bounds, 5);
        let (nodes, fractions, logs) = sites.site(1);
        let along = |axis: usize| f32::from(nodes[axis]) + fractions[axis];
        assert_eq!([along(0), along(1), along(2)], [1.0, 2.5, 4.0]);
        assert_eq!(logs, [0.1, -0.2, 0.3].map(signed_log));
    }
}
