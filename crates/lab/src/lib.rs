//! Measurements of the program itself, for developers. Only the command uses this crate.
//!
//! [`truth`] runs the whole pipeline on synthetic captures whose truth is known, and tabulates the distances
//! from the truth. [`card`] measures a graphics card: limits, agreement with the processor, equal bits, and
//! times. [`scene`] measures a training step on a trained scene. The command prints what they return.

pub mod card;
pub mod scene;
pub mod truth;
