//! Numerical functions that several method crates share.
//!
//! Everything here is deterministic: the same inputs give the same bits on any number of threads, and the
//! vector code gives the bits of its scalar twin wherever fused multiply-add exists.

pub mod adam;
pub mod functions;
pub mod lanes;
pub mod math;
pub mod product;
pub mod random;
pub mod range;
pub mod rows;
pub mod spherical_harmonics;
pub mod sums;
#[cfg(test)]
mod testing;
