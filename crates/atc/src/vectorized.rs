//! Plain loops compiled once per instruction set.
//!
//! The kernels of this crate are ordinary Rust over slices. [`vectorized!`] compiles them for the best
//! instruction set of the machine, so that the compiler turns them into lanes. They use no fused operation
//! that the source does not contain, and they sum into a fixed number of partial sums. So every level
//! computes the same bits: the scalar twin of each kernel is the kernel itself at
//! [`fearless_simd::Level::baseline`].

/// Evaluates an expression compiled for the best available instruction set. The functions that it calls
/// must be `#[inline(always)]`. A function that is not inlined is compiled for the baseline, where it is
/// slower (much slower if it fuses multiplications and additions).
macro_rules! vectorized {
    ($kernel:expr) => {
        fearless_simd::dispatch!(fearless_simd::Level::new(), _simd => $kernel)
    };
}

pub(crate) use vectorized;

/// Number of lanes of the fixed partial sums.
pub(crate) const LANES: usize = 8;

/// The sum of the lanes, first to last.
#[inline(always)]
pub(crate) fn total(lanes: &[f64; LANES]) -> f64 {
    lanes.iter().sum()
}
