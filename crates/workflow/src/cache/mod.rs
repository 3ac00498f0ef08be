//! The cache on disk: keys, manifests, digests of contents, and artifacts; and result folders outside it.
//!
//! This room has no code for stages: the files that a stage promises are data here.

pub(crate) mod artifacts;
pub mod canonical;
pub mod content;
pub mod delivered;
pub mod files;
pub mod key;
pub mod leftovers;
pub mod machine;
pub mod manifest;
pub(crate) mod memory;
pub mod node;
pub mod place;
pub mod task;
pub(crate) mod watch;

pub use artifacts::{Artifact, Cache, Lookup};
