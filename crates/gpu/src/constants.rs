//! The values that every kernel of a step may read: camera, sizes, the step's constants. They form one
//! uniform, which is written before each step.

use bytemuck::{Pod, Zeroable};
use use3d_capture::{Camera, Lattice};
use use3d_numerics::spherical_harmonics::bands;

use crate::kernel::{Access, Binding};

/// Pixels along a tile's side.
pub(crate) const TILE: u32 = 16;

/// The WGSL struct with the same words as [`StepConstants`].
pub(crate) const CONSTANTS: &str = include_str!("constants.wgsl");

/// The binding by which kernels read it.
pub(crate) const CONSTANTS_BINDING: Binding = (Access::Uniform, "constants", "StepConstants");

/// The constants of a step, in rows of four words; the comments list the words.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub(crate) struct StepConstants {
    /// The rows of the world-to-camera rotation; the fourth word is 0.
    pub(crate) rotation: [[f32; 4]; 3],
    /// The camera's centre, and its rounding error: `centre + rest` is the centre with twice the digits.
    pub(crate) center: [f32; 4],
    /// See `center`.
    pub(crate) center_rest: [f32; 4],
    /// `fx, fy, cx, cy`, pixels.
    pub(crate) lens: [f32; 4],
    /// Limits of x/z and y/z in the projection's Jacobian: low x, high x, low y, high y.
    pub(crate) limits: [f32; 4],
    /// First and last pixel centre: columns, rows.
    pub(crate) extent: [f32; 4],
    /// Size of the lattice: width, height, tiles across, tiles down.
    pub(crate) size: [u32; 4],
    /// Number of Gaussians, active colour bands (1, 4, 9 or 16; 0 means given colours, three numbers each),
    /// number of entries for which there is room, the step modulo 2^32.
    pub(crate) counts: [u32; 4],
    /// Water (0 or 1), gradients through distances (0 or 1), statistics gathered (0 or 1), index of the
    /// step's report.
    pub(crate) flags: [u32; 4],
    /// Adam: β₁, β₂, 1/√(1 − β₂ᵗ), ε.
    pub(crate) adam: [f32; 4],
    /// Rates divided by 1 − β₁ᵗ: means, log scales, quaternions, opacity logits.
    pub(crate) rates: [f32; 4],
    /// Rates divided by 1 − β₁ᵗ: constant colours, directional colours, 0, 0.
    pub(crate) color_rates: [f32; 4],
    /// Statistics: half width and half height times the scale, 0, 0.
    pub(crate) screen: [f32; 4],
}

impl StepConstants {
    /// The constants for the pixels of a lattice seen by a camera: the geometry of the view and the numbers
    /// of Gaussians; the rest is zero.
    pub(crate) fn on(
        camera: &Camera,
        lattice: &Lattice,
        gaussians: usize,
        degree: usize,
        entries: usize,
    ) -> Self {
        let (k, pose) = (&camera.intrinsics, &camera.pose);
        let single = |v: f64| v as f32;
        let center = pose.center().to_array();
        let near = center.map(single);
        let rest = std::array::from_fn::<f64, 3, _>(|i| center[i] - f64::from(near[i])).map(single);
        let limits = |size: usize, focal: f64, centre: f64| {
            let size = size as f64;
            let margin = 0.3 * (size / 2.0) / focal;
            [single(-(centre / focal + margin)), single((size - centre) / focal + margin)]
        };
        let ([x0, x1], [y0, y1]) = (limits(k.width, k.fx, k.cx), limits(k.height, k.fy, k.cy));
        let ends =
            |centres: &[f32]| [centres.first(), centres.last()].map(|c| c.copied().unwrap_or_default());
        let ([left, right], [top, bottom]) = (ends(lattice.columns()), ends(lattice.rows()));
        let (width, height) = (lattice.width() as u32, lattice.height() as u32);
        Self {
            rotation: std::array::from_fn(|r| {
                std::array::from_fn(|c| if c < 3 { single(pose.rotation.col(c)[r]) } else { 0.0 })
            }),
            center: [near[0], near[1], near[2], 0.0],
            center_rest: [rest[0], rest[1], rest[2], 0.0],
            lens: [k.fx, k.fy, k.cx, k.cy].map(single),
            limits: [x0, x1, y0, y1],
            extent: [left, right, top, bottom],
            size: [width, height, width.div_ceil(TILE), height.div_ceil(TILE)],
            counts: [gaussians as u32, bands(degree.min(3)) as u32, entries as u32, 0],
            ..Self::default()
        }
    }

    /// Number of tiles of the view.
    pub(crate) fn tiles(&self) -> usize {
        self.size[2] as usize * self.size[3] as usize
    }

    /// Number of pixels of the view.
    pub(crate) fn pixels(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    /// Number of Gaussians.
    pub(crate) fn gaussians(&self) -> usize {
        self.counts[0] as usize
    }
}

/// The words of the counts buffer.
pub(crate) mod counts {
    use crate::kernel::{Access, Binding, Constant, U32S};

    /// The counts as a read-only binding.
    pub(crate) const READ: Binding = (Access::Read, "counts", U32S);
    /// The counts as a binding that a kernel of one thread writes.
    pub(crate) const WRITE: Binding = (Access::Write, "counts", U32S);
    /// The counts as a binding that kernels of many threads write.
    pub(crate) const SHARED: Binding = (Access::Write, "counts", "array<atomic<u32>>");

    /// Number of (tile, Gaussian) entries of the view.
    pub(crate) const ENTRIES: usize = 0;
    /// The largest number of entries that a view has needed.
    pub(crate) const MOST: usize = 2;
    /// The sticky stop: 0 without an error, else [`OVERFLOW`] or [`NON_FINITE`]. Once it is set, updates
    /// change nothing.
    pub(crate) const STOP: usize = 4;
    /// The step, modulo 2^32, that set the stop.
    pub(crate) const STOP_STEP: usize = 5;
    /// The first values that were not finite: bit 0 means, 1 log scales, 2 quaternions, 3 opacity logits, 4
    /// colours, 5 water, 6 gains, 7 the loss.
    pub(crate) const BAD: usize = 6;
    /// Total number of words.
    pub(crate) const WORDS: usize = 64;
    /// The names of the words in WGSL.
    pub(crate) fn constants() -> Vec<(&'static str, Constant)> {
        let words =
            [("ENTRIES", ENTRIES), ("MOST", MOST), ("STOP", STOP), ("STOP_STEP", STOP_STEP), ("BAD", BAD)];
        let mut all: Vec<_> = words.map(|(name, at)| (name, Constant::Count(at as u32))).into();
        all.extend([("OVERFLOW", Constant::Count(OVERFLOW)), ("NON_FINITE", Constant::Count(NON_FINITE))]);
        all
    }

    /// There are more entries than room for them.
    pub(crate) const OVERFLOW: u32 = 1;
    /// A value is not finite.
    pub(crate) const NON_FINITE: u32 = 2;
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Tests that the two descriptions of the constants agree, word for word.
    #[test]
    fn the_kernels_see_the_constants_as_it_is_written() {
        let module = wgpu::naga::front::wgsl::parse_str(CONSTANTS).unwrap();
        let (_, found) =
            module.types.iter().find(|(_, t)| t.name.as_deref() == Some("StepConstants")).unwrap();
        let wgpu::naga::TypeInner::Struct { members, span } = &found.inner else { panic!("no struct") };
        assert_eq!(*span as usize, size_of::<StepConstants>());
        let ours = [
            ("rotation", std::mem::offset_of!(StepConstants, rotation)),
            ("center", std::mem::offset_of!(StepConstants, center)),
            ("center_rest", std::mem::offset_of!(StepConstants, center_rest)),
            ("lens", std::mem::offset_of!(StepConstants, lens)),
            ("limits", std::mem::offset_of!(StepConstants, limits)),
            ("extent", std::mem::offset_of!(StepConstants, extent)),
            ("size", std::mem::offset_of!(StepConstants, size)),
            ("counts", std::mem::offset_of!(StepConstants, counts)),
            ("flags", std::mem::offset_of!(StepConstants, flags)),
            ("adam", std::mem::offset_of!(StepConstants, adam)),
            ("rates", std::mem::offset_of!(StepConstants, rates)),
            ("color_rates", std::mem::offset_of!(StepConstants, color_rates)),
            ("screen", std::mem::offset_of!(StepConstants, screen)),
        ];
        assert_eq!(members.len(), ours.len());
        for (member, (name, offset)) in members.iter().zip(ours) {
            assert_eq!((member.name.as_deref(), member.offset as usize), (Some(name), offset));
        }
    }
}
