//! The method as a pipeline: from captures to results, computing nothing twice.
//!
//! The inputs are a pipeline file or a folder with a capture. The outputs are artifacts in the cache and a
//! results folder. The losses and gradients of the method are in other crates; this one connects their
//! functions.
//!
//! The crate `workflow` defines stages and decides when one must run. [`stages`] is the table of the method's
//! stages, [`code`] is the table of the source code that they are made of, and [`config`] reads pipeline
//! files. [`judge`] compares, times and tabulates. [`results`] copies the results to the results folder, with
//! a [page per scene](scene_page) for a browser and a record of the settings behind them (`made_by`).
//! [`photographs`] gives the diver's own photographs back, enhanced by a scene.
//! [`water`] estimates a capture's water before any stage runs.

pub mod baked;
pub mod code;
pub mod config;
mod engines;
pub mod judge;
mod made_by;
pub mod photographs;
pub mod results;
pub mod scene_page;
mod sights;
pub mod stages;
pub mod water;
pub mod written;

pub use engines::{Drawn, close_devices};
