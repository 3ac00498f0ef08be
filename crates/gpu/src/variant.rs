//! Two ways to add a tile's gradients up. Which one a device takes is part of what its results depend on.

use std::fmt;

/// How the backward pass adds up over the pixels of a tile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Variant {
    /// A: one thread per Gaussian. No operation across threads, so the bits are the
    /// same however many run in step.
    #[default]
    Portable,
    /// B: threads have pixels, and so many of them, which run in step, add up together.
    Subgroups(u32),
}

/// Threads in step that there are kernels for.
pub(crate) const WIDTHS: [u32; 5] = [4, 8, 16, 32, 64];

impl Variant {
    /// B for a device that has operations across threads and always as many in step; `None` for any other.
    pub(crate) fn of_subgroups(has: bool, [least, most]: [u32; 2]) -> Option<Self> {
        (has && least == most && WIDTHS.contains(&least)).then_some(Self::Subgroups(least))
    }
}

impl fmt::Display for Variant {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Portable => f.write_str("portable"),
            Self::Subgroups(width) => write!(f, "subgroups of {width}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_width_that_varies_or_has_no_kernel_is_left_to_the_portable_one() {
        assert_eq!(Variant::of_subgroups(true, [32, 32]), Some(Variant::Subgroups(32)));
        for (has, widths) in [(false, [32, 32]), (true, [32, 64]), (true, [1, 1]), (true, [128, 128])] {
            assert_eq!(Variant::of_subgroups(has, widths), None, "{has} {widths:?}");
        }
        assert_eq!(Variant::Subgroups(8).to_string(), "subgroups of 8");
    }
}
