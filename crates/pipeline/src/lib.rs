//! The method as a pipeline: from captures to results, computing nothing twice.
//!
//! What a stage is and when it must run is `build`'s. [`stages`] is the table of the method's stages,
//! [`code`] what they are made of, [`config`] reads pipeline files. [`judge`] compares, times and
//! tabulates; [`results`] puts what was made where a person looks, with a [page per scene](scene_page)
//! for a browser, and says what made it (`made_by`). [`water`] is a capture's water before any stage; [`mod@bench`] does all of it on
//! captures whose truth is known.

pub mod baked;
pub mod bench;
pub mod code;
pub mod config;
mod engines;
pub mod judge;
mod made_by;
pub mod results;
pub mod scene_page;
mod sights;
pub mod stages;
pub mod water;

pub use engines::Drawn;
