//! Numerical functions that several method crates share: elementary functions, vector code with scalar twins,
//! tiles of matrix products, small linear systems, spherical harmonics, Adam, random numbers, sums, values in
//! ascending order.
//!
//! The inputs and outputs are numbers and slices. This crate has no tensor type, no files and no knowledge of
//! images.
//!
//! Everything here is deterministic: the same inputs give the same bits on any number of threads. The vector
//! code gives the bits of its scalar twin wherever fused multiply-add exists.

pub mod adam;
pub mod cholesky;
pub mod functions;
pub mod lanes;
pub mod math;
pub mod number;
pub mod order;
pub mod product;
pub mod random;
pub mod range;
pub mod rows;
pub mod spherical_harmonics;
pub mod sums;
#[cfg(test)]
mod test_support;
