//! The sharing of one cache by several processes, and of one store by several caches.
//!
//! A lease marks a key that is being computed, and its pulse shows that the holder is alive. A remote store
//! has artifacts for machines without a common cache.

pub(crate) mod killed;
pub(crate) mod lease;
pub(crate) mod pulse;
pub mod remote;
pub(crate) mod sweep;
