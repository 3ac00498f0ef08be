//! The method as a pipeline: from captures to results, computing nothing twice.
//!
//! The inputs are a pipeline file or a folder with a capture. The outputs are artifacts in the cache and a
//! results folder. The losses and gradients of the method are in other crates; this one connects their
//! functions.
//!
//! The crate `workflow` defines stages and decides when one must run, `stages` is the table of the method's
//! stages, and `report` lays out their results. `config` reads pipeline files. [`results`] copies the
//! results to the results folder, with a [page per scene](scene_page) for a browser and a record of the
//! settings behind them (`made_by`). [`photographs`] gives the diver's own photographs back, enhanced by a
//! scene.
//!
//! The verbs of the command call one function each and print what it returns. Around a run these are
//! [`loaded`], [`remarks`], [`by_hand`], [`preparation`], [`history`], [`outcome`], [`whole_run`] and
//! [`submission`];
//! around a finished scene [`found`], [`scene_views`], [`white`], [`export`], [`scored`], [`compare`] and
//! [`follow`]. No stage uses this crate, so nothing here is in a key.

pub mod aged;
pub mod baked;
pub mod by_hand;
pub mod compare;
pub mod destination;
mod error;
pub mod export;
pub mod follow;
pub mod found;
pub mod history;
pub mod host;
pub mod loaded;
mod made_by;
pub mod outcome;
pub mod photographs;
pub mod points;
pub mod preparation;
pub mod remarks;
pub mod results;
pub mod scene_page;
pub mod scene_views;
pub mod scored;
pub mod spelled;
pub mod submission;
pub mod white;
pub mod whole_run;
pub mod written;

pub use error::WorkError;
