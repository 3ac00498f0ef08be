//! Faults of captures: each makes one thing of a sound capture wrong, as people's captures have it.
//!
//! [`FAULTS`] lists them with the finding that a check owes each. [`ChosenFault::spoil`] changes a folder
//! that [`crate::write_capture`] made; [`crate::write_faulty_capture`] does both. A fault with a strength has
//! three values, and takes any number from a hundredth of the largest to twice the largest. Random numbers
//! come from the capture's seed. The folder `truth` stays that of the sound capture.

mod bytes;
mod fault;
mod folder;
mod frames;
mod masks;
mod measures;
mod model;
mod names;
mod photographs;
mod table;
mod tracks;

pub use fault::{CaptureFault, ChosenFault, Due, Strengths, UnknownFault};
pub use table::FAULTS;

#[cfg(test)]
mod tests;
