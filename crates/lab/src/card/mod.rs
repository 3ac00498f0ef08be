//! Measurements of a graphics card in one file, and their report in words.
//!
//! [`measured`] runs the benchmark and fills its [`records`]; [`mod@read`] reads the file of any machine,
//! which needs no card.

#[cfg(feature = "gpu")]
pub mod measured;
pub mod read;
#[cfg(feature = "gpu")]
pub mod records;
#[cfg(feature = "gpu")]
pub mod summary;
#[cfg(feature = "gpu")]
mod work;
