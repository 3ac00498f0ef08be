//! Plain loops compiled once per instruction set.
//!
//! The kernels of this crate are ordinary Rust over slices; [`vectorized!`] runs them inside a context of the
//! best instruction set that the machine has, where the compiler turns them into lanes. They use no fused
//! operation that the source does not spell out and sum into a fixed number of partial sums, so every level
//! gives the same bits: the scalar twin of each kernel is the kernel itself at
//! [`fearless_simd::Level::baseline`].

/// Evaluates an expression compiled for the best available instruction set. The functions that it calls must
/// be `#[inline(always)]`: one that is not inlined is compiled for the baseline, where it is slower (much
/// slower, if it fuses multiplications and additions).
macro_rules! vectorized {
    ($kernel:expr) => {
        fearless_simd::dispatch!(fearless_simd::Level::new(), _simd => $kernel)
    };
}

pub(crate) use vectorized;

/// Lanes of the fixed partial sums.
pub(crate) const LANES: usize = 8;

/// The sum of the lanes, first to last.
#[inline(always)]
pub(crate) fn total(lanes: &[f64; LANES]) -> f64 {
    lanes.iter().sum()
}
