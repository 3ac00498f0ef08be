//! Two ways to sum a tile's gradients. A device's results depend on the one that it uses.

use std::fmt;

/// The method by which the backward pass sums over the pixels of a tile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Variant {
    /// A: one thread per Gaussian. There is no operation across threads, so the bits do not depend on the
    /// size of a subgroup.
    #[default]
    Portable,
    /// B: threads hold pixels, and the threads of a subgroup sum together.
    Subgroups {
        /// Number of threads in a subgroup.
        width: u32,
        /// Number of pixels per thread.
        pixels: u32,
    },
}

/// The subgroup sizes for which there are kernels.
pub(crate) const WIDTHS: [u32; 5] = [4, 8, 16, 32, 64];
/// The numbers of pixels per thread for which there are kernels; the default comes first.
pub(crate) const EACH: [u32; 3] = [2, 1, 4];

impl Variant {
    /// B for a device that runs with this width; `None` if there is no kernel for it.
    pub(crate) fn of_width(width: u32) -> Option<Self> {
        WIDTHS.contains(&width).then_some(Self::Subgroups { width, pixels: EACH[0] })
    }

    /// B with every number of pixels per thread, or A alone.
    pub(crate) fn each(self) -> Vec<Self> {
        match self {
            Self::Portable => vec![self],
            Self::Subgroups { width, .. } => EACH.map(|pixels| Self::Subgroups { width, pixels }).into(),
        }
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Portable => f.write_str("portable"),
            Self::Subgroups { width, pixels } if *pixels == EACH[0] => write!(f, "subgroups of {width}"),
            Self::Subgroups { width, pixels: 1 } => write!(f, "subgroups of {width}, 1 pixel a thread"),
            Self::Subgroups { width, pixels } => write!(f, "subgroups of {width}, {pixels} pixels a thread"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_width_without_a_kernel_is_left_to_the_portable_one() {
        let two = |width| Variant::Subgroups { width, pixels: 2 };
        assert_eq!(Variant::of_width(32), Some(two(32)));
        for width in [0, 1, 24, 128] {
            assert_eq!(Variant::of_width(width), None, "{width}");
        }
        let names: Vec<String> = two(8).each().iter().map(Variant::to_string).collect();
        let expected =
            ["subgroups of 8", "subgroups of 8, 1 pixel a thread", "subgroups of 8, 4 pixels a thread"];
        assert_eq!(names, expected);
        assert_eq!(Variant::Portable.each(), [Variant::Portable]);
    }
}
