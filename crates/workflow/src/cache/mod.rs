//! The cache on disk: keys, manifests, digests of contents, and artifacts; and result folders outside it.
//!
//! This room has no code for stages: the files that a stage promises are data here.

pub(crate) mod artifacts;
pub mod canonical;
pub mod content;
pub mod delivered;
mod device;
mod equal;
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

use std::sync::{Mutex, MutexGuard, PoisonError};

pub use artifacts::{Artifact, Cache, Lookup};

/// Locks a mutex, also after a panic of another thread that held it.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The parts that are not empty, with a text between them.
pub(crate) fn joined(parts: &[&str], between: &str) -> String {
    parts.iter().filter(|part| !part.is_empty()).copied().collect::<Vec<_>>().join(between)
}
