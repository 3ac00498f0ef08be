//! The scores of a scene: held-out views against photographs, neighbouring views against each other, and
//! everything against a truth where one is known. This crate does not depend on stages, keys or caches.
//!
//! [`scoring`] compares pictures, [`flow`] stores the flow between them, [`truth`] compares scenes with their
//! known truth, [`speed`] times drawing,
//! and [`strip`] shows a spot in neighbouring views. [`scores`] is the record of one scene, and
//! [`configuration`] describes the settings behind it.

pub mod configuration;
pub mod flow;
pub mod names;
pub mod scores;
pub mod scoring;
pub mod speed;
pub mod strip;
pub mod truth;
